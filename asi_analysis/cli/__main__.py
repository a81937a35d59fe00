"""`python -m asi_analysis.cli`: the `asi` command."""

import sys

from asi_analysis.command import asi

sys.exit(asi())
