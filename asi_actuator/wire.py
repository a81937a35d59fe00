"""
The messages of the loop as the bytes that go over the wire (CDR, little endian).

rclpy takes 4 to 11 us to make bytes of one of these messages and 4 to 31 us to make a message of
bytes, more than all else that a node does in a tick; here each way takes one or two
(`make bench BENCH=loop_rate`). So the nodes publish bytes and subscribe to bytes (`raw`).
Whatever is laid out in another way, as with another frame or other joints, rclpy unpacks.
"""

from collections.abc import Mapping
from math import nan
from struct import Struct
from typing import Any, Final, NamedTuple

from geometry_msgs.msg import WrenchStamped
from rclpy.serialization import deserialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from asi_actuator.topics import FRAME, JOINTS, PISTON, nanoseconds

_SECOND_NS: Final = 1_000_000_000
_COUNT: Final = Struct('<I')
_HEADER: Final = b'\0\1\0\0'


def _string(text: str) -> bytes:
    data = text.encode() + b'\0'
    return _COUNT.pack(len(data)) + data


# What is the same in every message. Each string comes with its length, the names and each pair
# of numbers with their count; `x` fills up to where the next may begin, and may be anything.
_TWO: Final = _COUNT.pack(2)
_FRAME: Final = _string(FRAME)
_NAMES: Final = (_FRAME, _TWO, *map(_string, JOINTS), _TWO)

_CLOCK: Final = Struct('<4siI')
_FLOAT: Final = Struct('<4sd')
_WRENCH: Final = Struct('<4siI11s5xd40s')
_STATE: Final = Struct('<4siI11sx4s11sx10s2x4s4x2d4s4x2d4s4x2d')


class Stamped(NamedTuple):
    """The number that a message is about, and its stamp."""

    stamp_ns: int
    value: float


def clock(stamp_ns: int) -> bytes:
    """Return a rosgraph_msgs/Clock."""
    return _CLOCK.pack(_HEADER, *divmod(stamp_ns, _SECOND_NS))


def number(value: float) -> bytes:
    """Return a std_msgs/Float64."""
    return _FLOAT.pack(_HEADER, value)


def wrench(stamp_ns: int, force_n: float) -> bytes:
    """Return a geometry_msgs/WrenchStamped of the piston: a force along x."""
    return _WRENCH.pack(_HEADER, *divmod(stamp_ns, _SECOND_NS), _FRAME, force_n, b'')


def state(stamp_ns: int, position: tuple[float, float], velocity: tuple[float, float],
          effort: tuple[float, float]) -> bytes:
    """Return a sensor_msgs/JointState: each quantity of piston and valve."""
    return _STATE.pack(_HEADER, *divmod(stamp_ns, _SECOND_NS), *_NAMES, *position, _TWO,
                       *velocity, _TWO, *effort)


def status(stamp_ns: int, level: bytes, node: str, name: str, text: str,
           values: Mapping[str, str]) -> bytes:
    """
    Return a diagnostic_msgs/DiagnosticArray of one status; `node` becomes its hardware_id.

    rclpy leaves in the gaps between the texts whatever was there in memory, which is not the same
    from run to run.
    """
    data = clock(stamp_ns)
    for part in (_string(''), _COUNT.pack(1), level, _string(name), _string(text), _string(node),
                 _COUNT.pack(len(values)),
                 *(_string(each) for pair in values.items() for each in pair)):
        data += bytes(-len(data) % 4) + part
    return data


def time(data: bytes) -> int:
    """Return the time (ns) of a rosgraph_msgs/Clock; 0 if it is none."""
    if len(data) == _CLOCK.size:
        header, seconds, nanoseconds_ = _CLOCK.unpack(data)
        if header == _HEADER:
            return int(seconds * _SECOND_NS + nanoseconds_)
    message = _unpacked(data, Clock)
    return nanoseconds(message.clock) if message else 0


def force(data: bytes) -> Stamped:
    """Return force.x of a geometry_msgs/WrenchStamped; nan at 0 if it is none."""
    if len(data) == _WRENCH.size:
        header, seconds, nanoseconds_, frame, force_n, _ = _WRENCH.unpack(data)
        if header == _HEADER and frame == _FRAME:
            return Stamped(seconds * _SECOND_NS + nanoseconds_, force_n)
    message = _unpacked(data, WrenchStamped)
    return (Stamped(nanoseconds(message.header.stamp), message.wrench.force.x) if message
            else Stamped(0, nan))


def piston_effort(data: bytes) -> Stamped:
    """Return the effort of the piston in a sensor_msgs/JointState; nan if there is none."""
    if len(data) == _STATE.size:
        found = _STATE.unpack(data)
        if found[0] == _HEADER and found[3:8] == _NAMES and found[10] == found[13] == _TWO:
            return Stamped(found[1] * _SECOND_NS + found[2], found[14])
    message = _unpacked(data, JointState)
    if message is None or PISTON not in message.name[:len(message.effort)]:
        return Stamped(0, nan)
    return Stamped(nanoseconds(message.header.stamp), message.effort[message.name.index(PISTON)])


def _unpacked(data: bytes, kind: Any) -> Any:
    """Return a message of a type; None if the bytes are none, as rclpy itself drops them."""
    try:
        return deserialize_message(data, kind)
    except RuntimeError:
        return None
