"""
The messages of the loop as the bytes that go over the wire (CDR, little endian).

rclpy takes 4 to 11 us to serialise one of these messages and 4 to 31 us to deserialise one, more
than the rest of a tick; these functions take 1 to 2 us (`make bench BENCH=loop_rate`). So the
nodes publish and subscribe to bytes (`raw`). A message of another layout, such as one with another
frame or other joints, is deserialised by rclpy.
"""

from collections.abc import Mapping, Sequence
from math import nan
from struct import Struct
from typing import Any, Final, NamedTuple

from geometry_msgs.msg import WrenchStamped
from rclpy.serialization import deserialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from asi_common.node.topics import nanoseconds
from asi_common.topics import FRAME, JOINTS, PISTON

_SECOND_NS: Final = 1_000_000_000
_COUNT: Final = Struct('<I')
_HEADER: Final = b'\0\1\0\0'


def _string(text: str) -> bytes:
    data = text.encode() + b'\0'
    return _COUNT.pack(len(data)) + data


# The constant parts of the messages. A string is preceded by its length, a sequence by its count;
# `x` is padding up to the alignment of the next field, with any content.
_TWO: Final = _COUNT.pack(2)
_FRAME: Final = _string(FRAME)
_NAMES: Final = (_FRAME, _TWO, *map(_string, JOINTS), _TWO)
_NAMED: Final = Struct('<11sx4s11sx10s2x4s4x')
_BEFORE_NUMBERS: Final = _NAMED.pack(*_NAMES)

_CLOCK: Final = Struct('<4siI')
_FLOAT: Final = Struct('<4sd')
# For writing, after the bytes of a clock, which equal those of a stamp; and for reading.
_WRENCH: Final = Struct('<12s11s5xd40x')
_STATE: Final = Struct(f'<12s{_NAMED.size}s2d4s4x2d4s4x2d')
_WRENCH_READ: Final = Struct('<4siI11s5xd40x')
_STATE_READ: Final = Struct(f'<4siI{_NAMED.format[1:]}16x4s4xd8x4s4xd8x')
_AROUND_NUMBERS: Final = [*_NAMES, _TWO, _TWO]


def clock(stamp_ns: int) -> bytes:
    """Return a rosgraph_msgs/Clock."""
    return _CLOCK.pack(_HEADER, stamp_ns // _SECOND_NS, stamp_ns % _SECOND_NS)


def state(stamp_ns: int, position_m: float, valve_m: float, velocity: float,
          valve_velocity: float, force_n: float, command_n: float
          ) -> tuple[bytes, bytes, bytes, bytes, bytes]:
    """Return the actuator's joint_states, /clock, force, valve_position and velocity."""
    stamp = _CLOCK.pack(_HEADER, stamp_ns // _SECOND_NS, stamp_ns % _SECOND_NS)
    return (_STATE.pack(stamp, _BEFORE_NUMBERS, position_m, valve_m,
                        _TWO, velocity, valve_velocity, _TWO, force_n, command_n),
            stamp, _WRENCH.pack(stamp, _FRAME, force_n),
            _FLOAT.pack(_HEADER, valve_m), _FLOAT.pack(_HEADER, velocity))


def answer(stamp_ns: int, command_n: float, reference_n: float) -> tuple[bytes, bytes]:
    """Return the controller's valve_command and force_reference, forces along x."""
    stamp = _CLOCK.pack(_HEADER, stamp_ns // _SECOND_NS, stamp_ns % _SECOND_NS)
    return (_WRENCH.pack(stamp, _FRAME, command_n), _WRENCH.pack(stamp, _FRAME, reference_n))


class Status(NamedTuple):
    """A diagnostic_msgs/DiagnosticStatus."""

    level: bytes
    name: str
    text: str
    values: Mapping[str, str]


def diagnostics(stamp_ns: int, node: str, statuses: Sequence[Status]) -> bytes:
    """
    Return a diagnostic_msgs/DiagnosticArray; `node` becomes the hardware_id of each status.

    Not by rclpy, which leaves uninitialised memory in the padding between the strings, so that the
    bytes differ from run to run.
    """
    parts = [_string(''), _COUNT.pack(len(statuses))]
    for level, name, text, values in statuses:
        parts += [level, _string(name), _string(text), _string(node), _COUNT.pack(len(values)),
                  *(_string(each) for pair in values.items() for each in pair)]
    data = clock(stamp_ns)
    for part in parts:
        # A level is one byte, all else begins at a multiple of 4.
        data += bytes(-len(data) % 4 if len(part) > 1 else 0) + part
    return data


def time(data: bytes) -> int:
    """Return the time (ns) of a rosgraph_msgs/Clock; 0 if it is none."""
    if len(data) == _CLOCK.size:
        header, seconds, nanoseconds_ = _CLOCK.unpack(data)
        if header == _HEADER:
            return int(seconds * _SECOND_NS + nanoseconds_)
    message = _unpacked(data, Clock)
    return nanoseconds(message.clock) if message else 0


def force(data: bytes) -> tuple[int, float]:
    """Return stamp (ns) and force.x of a geometry_msgs/WrenchStamped; 0 and nan if it is none."""
    if len(data) == _WRENCH.size:
        header, seconds, nanoseconds_, frame, force_n = _WRENCH_READ.unpack(data)
        if header == _HEADER and frame == _FRAME:
            return seconds * _SECOND_NS + nanoseconds_, force_n
    message = _unpacked(data, WrenchStamped)
    return (nanoseconds(message.header.stamp), message.wrench.force.x) if message else (0, nan)


def piston(data: bytes) -> tuple[int, float, float]:
    """
    Return stamp (ns), effort (N) and velocity (m/s) of the piston in a sensor_msgs/JointState.

    0, nan, nan if there is no effort; a velocity that is missing is nan.
    """
    if len(data) == _STATE.size:
        header, seconds, nanoseconds_, *around, two, velocity, last, force_n = (
            _STATE_READ.unpack(data))
        if header == _HEADER and [*around, two, last] == _AROUND_NUMBERS:
            return seconds * _SECOND_NS + nanoseconds_, force_n, velocity
    message = _unpacked(data, JointState)
    if message is None or PISTON not in message.name[:len(message.effort)]:
        return 0, nan, nan
    k = message.name.index(PISTON)
    velocity = message.velocity[k] if k < len(message.velocity) else nan
    return nanoseconds(message.header.stamp), message.effort[k], velocity


def _unpacked(data: bytes, kind: Any) -> Any:
    """Return a message of a type; None if the bytes are none, as rclpy itself drops them."""
    try:
        return deserialize_message(data, kind)
    except RuntimeError:
        return None
