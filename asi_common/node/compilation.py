"""A log message when a node begins to compile, which takes 15 s at its first start."""

from rclpy.logging import get_logger

from asi_common.jit import when_compiling


def tell_of_compilation(name: str) -> None:
    """Log a line, by the logger of this name, when this process begins to compile."""
    when_compiling(lambda: get_logger(name).info(
        'compiling, once for all later starts: about 15 s'))
