"""What both ends of a topic must agree on (design: names, frame, quality of service)."""

from typing import Final

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


def nanoseconds(time: Time) -> int:
    """Return a stamp in nanoseconds."""
    return time.sec * 1_000_000_000 + time.nanosec


def set_time(time: Time, stamp_ns: int) -> None:
    """Put nanoseconds into a stamp."""
    time.sec, time.nanosec = divmod(stamp_ns, 1_000_000_000)
