"""Bytes packed here are rclpy's messages; whatever rclpy packs is unpacked the same."""

import math
from typing import Any

import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import WrenchStamped
from rclpy.serialization import deserialize_message, serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64

from asi_common.node import messages as wire

STAMP_NS = 1_790_000_000_123_456_789
STAMP = Time(sec=1_790_000_000, nanosec=123_456_789)


def a_state(frame: str, effort: dict[str, float]) -> JointState:
    message = JointState(name=list(effort), position=[1.0, 2.0], velocity=[3.0, 4.0],
                         effort=list(effort.values()))
    message.header.frame_id, message.header.stamp = frame, STAMP
    return message


def a_wrench(frame: str, force_n: float) -> WrenchStamped:
    message = WrenchStamped()
    message.header.frame_id, message.header.stamp = frame, STAMP
    message.wrench.force.x = force_n
    return message


STATE = wire.state(STAMP_NS, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
ANSWER = wire.answer(STAMP_NS, -7.5, 8.5)


def statuses(text: str, count: int) -> DiagnosticArray:
    message = DiagnosticArray(status=count * [DiagnosticStatus(
        level=DiagnosticStatus.ERROR, name='node: state', hardware_id='node', message=text,
        values=[KeyValue(key='reason', value=text[1:])])])
    message.header.stamp = STAMP
    return message


@pytest.mark.parametrize(('data', 'message'), [
    *((wire.diagnostics(STAMP_NS, 'node', count * [wire.Status(
        DiagnosticStatus.ERROR, 'node: state', text, {'reason': text[1:]})]),
       statuses(text, count)) for text in ('', 'a', 'ab', 'abc', 'ö') for count in (1, 2)),
    (wire.clock(STAMP_NS), Clock(clock=STAMP)),
    *zip(STATE, (a_state('piston', {'piston': 5.0, 'valve': 6.0}), Clock(clock=STAMP),
                 a_wrench('piston', 5.0), Float64(data=2.0), Float64(data=3.0)), strict=True),
    *zip(ANSWER, (a_wrench('piston', -7.5), a_wrench('piston', 8.5)), strict=True)])
def test_rclpy_reads_what_is_packed(data: bytes, message: Any) -> None:
    assert deserialize_message(data, type(message)) == message
    assert len(serialize_message(message)) == len(data)


@pytest.mark.parametrize('frame', ['piston', 'valves', '', 'another frame'])
def test_what_rclpy_packs_is_unpacked_whatever_its_layout(frame: str) -> None:
    wrench = a_wrench(frame, -7.5)
    wrench.wrench.torque.z = 9.0
    assert wire.force(serialize_message(wrench)) == (STAMP_NS, -7.5)
    for effort in ({'piston': 5.0, 'valve': 6.0}, {'valves': 6.0, 'pisto': 1.0, 'piston': 5.0},
                   {'valve': 6.0, 'piston': 5.0}):
        velocity = dict(zip(effort, (3.0, 4.0), strict=False)).get('piston', math.nan)
        assert wire.piston(serialize_message(a_state(frame, effort))) == pytest.approx(
            (STAMP_NS, 5.0, velocity), rel=0.0, nan_ok=True)
    assert wire.time(serialize_message(Clock(clock=STAMP))) == STAMP_NS


def test_what_has_no_such_number_is_nan() -> None:
    for names in (['piston'], ['valve', 'piston'], ['valve', 'p']):
        state = JointState(name=names, effort=[1.0] * (len(names) - 1))
        assert math.isnan(wire.piston(serialize_message(state))[1])
    packed = STATE[0]
    for broken in (b'', packed[:50], b'\0\1\0\0' + b'\xff' * (len(packed) - 4)):
        assert math.isnan(wire.piston(broken)[1])
        assert math.isnan(wire.force(broken[:76])[1])
    assert wire.time(b'\0\1') == 0


def test_bytes_that_are_ours_are_not_left_to_rclpy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also as another publisher of the same message fills the gaps: with anything."""
    state = bytearray(STATE[0])
    wrench = bytearray(ANSWER[0])
    for place in (23, 39, 50, 51, 56, 59, 80, 104):
        state[place] = 0xA5
    wrench[23:28] = b'\xa5' * 5
    monkeypatch.setattr(wire, 'deserialize_message', None)
    assert wire.piston(bytes(state)) == (STAMP_NS, 5.0, 3.0)
    assert wire.force(bytes(wrench)) == (STAMP_NS, -7.5)
    assert wire.time(wire.clock(STAMP_NS)) == STAMP_NS
