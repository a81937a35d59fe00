"""`python -m asi_analysis.cli`: the `asi` command."""

import sys

from asi_analysis.executables import asi

sys.exit(asi())
