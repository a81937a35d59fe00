"""`python -m asi_analysis.cli`: the `asi` command."""

import sys

from asi_analysis.cli import main

sys.exit(main())
