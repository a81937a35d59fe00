"""Topics: what both ends must agree on: frame, joints, quality of service, time stamps."""

import time
from importlib import import_module
from typing import Any, Final

from builtin_interfaces.msg import Time
from rclpy.qos import QoSProfile

FRAME: Final = 'piston'
PISTON: Final = 'piston'
JOINTS: Final = (PISTON, 'valve')

# A loop wants the newest message. A recorder may fall behind a little and must lose none, so
# what is published is kept until it has it, up to 30000 messages, 6 s at 5 kHz. On a machine
# with three times more to do than it has cores, 1000 lost one message in a thousand, 30000 none.
CONTROL_QOS: Final = QoSProfile(depth=10)
STREAM_QOS: Final = QoSProfile(depth=30_000)


class SteadyClock:
    """
    The wall clock as it was when this was made, going on evenly from there.

    In a loop in real time a clock that is set (by NTP at start-up, by hand) must neither look like
    a command from the past nor bring a recording out of its order.
    """

    def __init__(self) -> None:
        self._offset_ns = time.time_ns() - time.monotonic_ns()

    def now_ns(self) -> int:
        """Return the time, ns."""
        return time.monotonic_ns() + self._offset_ns


def message_class(type_: str) -> Any:
    """
    Return the class of a message type, as std_msgs/msg/Float64, found by ROS's convention.

    Raises ImportError, AttributeError or ValueError if there is none.
    """
    package, _, kind = type_.split('/')
    return getattr(import_module(f'{package}.msg'), kind)


def nanoseconds(stamp: Time) -> int:
    """Return a stamp in nanoseconds."""
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def set_time(stamp: Time, stamp_ns: int) -> None:
    """Put nanoseconds into a stamp."""
    stamp.sec, stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
