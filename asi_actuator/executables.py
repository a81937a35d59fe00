"""
The executables that `ros2 run asi_actuator` starts.

What a node imports takes a second or more. Ctrl-C and SIGTERM in that time end it as they do
later, with status 0, not with a traceback.
"""

import os
import signal
from importlib import import_module


def _run(module: str) -> int:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(0))
    return import_module(module).main()


def actuator() -> int:
    """Run the node `asi_actuator`; return the exit status."""
    return _run('asi_actuator.actuator_node')


def controller() -> int:
    """Run the node `asi_controller`; return the exit status."""
    return _run('asi_controller.controller_node')


def recorder() -> int:
    """Run the node `asi_recorder`; return the exit status."""
    return _run('asi_analysis.bags.nodes.recorder_node')


def replay() -> int:
    """Run the node `asi_replay`; return the exit status."""
    return _run('asi_analysis.bags.nodes.replay_node')


def can_actuator() -> int:
    """Run the simulated firmware at the other end of the bridge; return the exit status."""
    return _run('asi_actuator.can_actuator')
