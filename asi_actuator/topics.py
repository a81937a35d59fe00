"""What both ends of a topic must agree on (design: names, frame, quality of service)."""

from typing import Final

from builtin_interfaces.msg import Time
from rclpy.qos import QoSProfile

FRAME: Final = 'piston'
PISTON: Final = 'piston'
JOINTS: Final = (PISTON, 'valve')

# A loop wants the newest message. A recorder may fall behind a little and must lose none, so
# what is published is kept for a while: 1000 messages are 0.2 s at 5 kHz.
CONTROL_QOS: Final = QoSProfile(depth=10)
STREAM_QOS: Final = QoSProfile(depth=1000)


def nanoseconds(time: Time) -> int:
    """Return a stamp in nanoseconds."""
    return time.sec * 1_000_000_000 + time.nanosec


def set_time(time: Time, stamp_ns: int) -> None:
    """Put nanoseconds into a stamp."""
    time.sec, time.nanosec = divmod(stamp_ns, 1_000_000_000)
