"""Ctrl-C of a command while numba compiles."""

import functools
import signal

from asi_analysis.command import INTERRUPTED, SAID
from asi_common import executable


@functools.cache
def end_while_compiling() -> None:
    """Let SIGINT end this process with status 130 while it compiles. Only for a command."""
    executable.end_while_compiling({signal.SIGINT}, INTERRUPTED, SAID)
