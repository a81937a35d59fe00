"""Real time: which nodes run in it, and their priority, so that other programs do not delay it."""

import contextlib
import os
from typing import Final

from rclpy.node import Node

PARAMETER: Final = 'thread_priority'


def prefer(node: Node) -> None:
    """
    Give all threads of a node that runs in real time their priority (SCHED_FIFO), if permitted.

    Those of the middleware too, as a message waits for them; threads that are made later inherit
    it. The log says whether it was permitted, as that of ros2_control does.
    """
    if not in_real_time(node) or not node.has_parameter(PARAMETER):
        return
    priority = node.get_parameter(PARAMETER).value
    if not priority:
        return
    try:
        _raise_all(priority)
    except (AttributeError, OSError) as error:   # the first: not on this system
        node.get_logger().info(
            f'no real-time priority ({PARAMETER} = {priority}): {error}. Other programs may delay '
            'this loop: doc/how_to/ros_conventions.md')
    else:
        node.get_logger().info(f'real-time priority {priority}')


def _raise_all(priority: int) -> None:
    """Raise every thread of this process, until none is new: one may make another meanwhile."""
    raised: set[int] = set()
    while new := set(map(int, os.listdir('/proc/self/task'))) - raised:
        for thread in new:
            with contextlib.suppress(ProcessLookupError):   # it has ended
                os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))
        raised |= new


def in_real_time(node: Node) -> bool:
    """Return whether a node runs on the wall clock."""
    return node.has_parameter('mode') and node.get_parameter('mode').value == 'realtime'
