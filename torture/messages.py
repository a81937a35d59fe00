"""Unexpected messages on the topics of the loop."""

import math
import time
from random import Random
from typing import Any, Final

from builtin_interfaces.msg import Time
from geometry_msgs.msg import WrenchStamped
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from asi_common.node.topics import set_time
from torture.rig import ACTUATOR, CONTROLLER, Rig, Tally, is_alive, until

NUMBERS: Final = (math.nan, math.inf, -math.inf, 1e308, -1e308, 1e5, 0.0, -0.0, 5e-324)
BURST: Final = 50
RUNS: Final = 'the actuator to report that it runs'


def _stamp(random: Random) -> Time:
    """Return the present time, or an impossible one."""
    stamp = Time()
    set_time(stamp, random.choice((
        time.time_ns(), 0, 1, time.time_ns() - 10**9, time.time_ns() + 10**9, 2**31 * 10**9 - 1)))
    return stamp


def _numbers(random: Random) -> list[float]:
    return random.choices(NUMBERS, k=random.randrange(5))


def _wrench(random: Random) -> WrenchStamped:
    message = WrenchStamped()
    message.header.stamp = _stamp(random)
    message.header.frame_id = random.choice(('piston', '', 'ö' * 200))
    message.wrench.force.x = random.choice(NUMBERS)
    return message


def _state(random: Random) -> JointState:
    names = random.choice((['piston', 'valve'], ['valve', 'piston'], [], ['piston'] * 3, ['x']))
    message = JointState(name=names, position=_numbers(random), velocity=_numbers(random),
                         effort=_numbers(random))
    message.header.stamp = _stamp(random)
    return message


def _clock(random: Random) -> Clock:
    return Clock(clock=_stamp(random))


KINDS: Final[tuple[tuple[type, str, Any], ...]] = (
    (WrenchStamped, 'valve_command', _wrench), (JointState, 'joint_states', _state),
    (WrenchStamped, 'force_reference', _wrench), (Clock, '/clock', _clock))


def messages(rig: Rig, tally: Tally, end: float) -> None:
    """Bursts of each kind into a loop in real time, which must run again after a reset."""
    nodes = [rig.start(ACTUATOR, mode='realtime', rate_hz=200.0, command_timeout=1.0),
             rig.start(CONTROLLER, mode='realtime', rate_hz=200.0, gain=1.0, state_timeout=2.0)]
    publishers = [(rig.node.create_publisher(kind, topic, 10), make)
                  for kind, topic, make in KINDS]
    # A foreign state before the first of the actuator ends the controller, as documented.
    until(lambda: _runs(rig), RUNS)
    while time.monotonic() < end or not tally.tried:
        publisher, make = rig.random.choice(publishers)
        for _ in range(BURST):
            publisher.publish(make(rig.random))
            time.sleep(0.002)
        problem = next((f'a node has ended: {node.text[-500:]}' for node in nodes
                        if not is_alive(node)), '') or rig.tracebacks()
        if not problem:
            until(lambda: _runs(rig), RUNS)
        tally.count(publisher.topic_name, problem, BURST)
        if problem or tally.failures:
            return


def _runs(rig: Rig) -> bool:
    """Reset and enable the actuator; return whether its next diagnostics say that it runs."""
    rig.enable()
    since = time.monotonic()
    until(lambda: rig.diagnostics['asi_actuator']['at'] > since, 'diagnostics of the actuator')
    return rig.runs('asi_actuator')
