"""A log message when a node begins to compile, which takes 15 s at its first start."""

from typing import Any

from numba.core import event
from rclpy.logging import get_logger


class _First(event.Listener):
    """Logs the first compilation of the process; loading code from the cache is none."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.told = False

    def on_start(self, event: Any) -> None:
        if not self.told:
            self.told = True
            get_logger(self.name).info('compiling, once for all later starts: about 15 s')

    def on_end(self, event: Any) -> None:
        """Do nothing."""


def tell_of_compilation(name: str) -> None:
    """Log a line, by the logger of this name, when this process begins to compile."""
    event.register('numba:compile', _First(name))
