"""A line of log while a node compiles: its first start would be silent for long."""

from typing import Any

from numba.core import event
from rclpy.logging import get_logger


class _First(event.Listener):
    """Tells of the first compilation of the process; code from the cache is only loaded."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.told = False

    def on_start(self, event: Any) -> None:
        if not self.told:
            self.told = True
            get_logger(self.name).info('compiling, once for all later starts: about 15 s')

    def on_end(self, event: Any) -> None:
        """Nothing is told."""


def tell_of_compilation(name: str) -> None:
    """Log a line, by the logger of this name, when this process begins to compile."""
    event.register('numba:compile', _First(name))
