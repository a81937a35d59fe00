"""The safety logic: watchdogs, limiter, states; and that no simulated run trips anything."""

import math
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from asi_actuator.driver import Health
from asi_actuator.joint_parameters import JOINT_PARAMETERS
from asi_actuator.node_parameters import ACTUATOR_NODE_PARAMETERS
from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_actuator.safety import Safety, State
from asi_analysis.loop.closed_loop import simulate_loop
from asi_common.parameter import Value, completed, defaults

TABLE = ACTUATOR_NODE_PARAMETERS + ACTUATOR_PARAMETERS


class Measured(NamedTuple):
    """A measurement with names."""

    force_n: float = 0.0
    valve_position_m: float = 0.0
    position_m: float = 0.0
    velocity_m_s: float = 0.0


STILL = Measured()
PERIOD_S = 1e-3


class Watched:
    """A Safety that is enabled, and the states it went through."""

    def __init__(self, period_s: float = PERIOD_S, **values: Value):
        self.went: list[str] = []
        self.safety = Safety(completed(values, TABLE), period_s, State.ENABLED,
                             lambda: self.went.append(str(self.safety.state)))

    def period(self, command_n: float, measured: Measured = STILL,
               health: Health = Health(), periods: int = 1) -> float:  # noqa: B008
        """Live through a control period; return the command that went to the actuator."""
        command = self.safety.command(command_n)
        self.safety.watch_state(measured, periods)
        self.safety.watch_link(health)
        return command


# What goes wrong in the second period, and how the reason begins and ends.
FAULTS: list[tuple[dict[str, Any], str, str]] = [
    ({'measured': STILL._replace(force_n=-3000.0)},
     'force = -3000 N exceeds', 'limit.force = 2500 N'),
    ({'measured': STILL._replace(force_n=math.nan)},
     'force = nan N exceeds', 'limit.force = 2500 N'),
    ({'measured': STILL._replace(valve_position_m=-2e-4)},
     'valve_position = -0.0002 m exceeds', 'limit.valve_position = 0.0001 m'),
    ({'measured': STILL._replace(valve_position_m=math.inf)}, 'valve_position = inf', ''),
    ({'measured': STILL._replace(velocity_m_s=21.0)},
     'velocity = 21 m/s exceeds', 'limit.velocity = 20 m/s'),
    ({'measured': STILL._replace(position_m=math.nan)}, 'position = nan m', ''),
    ({'health': Health(state_age_s=0.2)},
     'age of the newest state = 0.2 s exceeds', 'limit.state_age = 0.1 s'),
    ({'health': Health(lost_states=101)},
     'states lost within 1 s = 101 exceeds', 'limit.lost_states = 100'),
    ({'health': Health(bad_frames=11)},
     'bad frames within 1 s = 11 exceeds', 'limit.bad_frames = 10'),
    ({'health': Health(problem='the adapter is unplugged')}, 'the adapter is unplugged', ''),
    ({'command_n': math.nan}, 'valve_command = nan N', ''),
    ({'command_n': -math.inf}, 'valve_command = -inf N', ''),
]


@pytest.mark.parametrize(('kind', 'reason'), [
    ('revolute', 'velocity = 21 rad/s exceeds limit.velocity = 20 rad/s'),
    ('prismatic', 'velocity = 21 m/s exceeds limit.velocity = 20 m/s')])
def test_a_fault_of_a_joint_has_its_units(kind: str, reason: str) -> None:
    values = completed({'joint.type': kind}, ACTUATOR_NODE_PARAMETERS + JOINT_PARAMETERS)
    safety = Safety(values, PERIOD_S, State.ENABLED, lambda: None)
    safety.watch_state(STILL._replace(velocity_m_s=21.0), 1)
    assert safety.reason == reason


@pytest.mark.parametrize(('wrong', 'begin', 'end'), FAULTS, ids=[begin for _, begin, _ in FAULTS])
def test_fault_shuts_the_valve_in_the_next_period_until_the_reset(
        wrong: dict[str, Any], begin: str, end: str) -> None:
    watched = Watched()
    safety = watched.safety
    assert watched.period(100.0) == 100.0
    watched.period(**({'command_n': 100.0} | wrong))
    assert safety.reason.startswith(begin) and safety.reason.endswith(end)
    for _ in range(5):
        assert watched.period(100.0) == 0.0
    # What follows does not hide the first reason, and nobody enables over it.
    first = safety.reason
    watched.period(100.0, health=Health(problem='the valve is shut'))
    assert safety.reason == first and first in safety.enable()
    assert safety.state is State.FAULT
    safety.disable()
    assert safety.state is State.FAULT
    safety.reset()
    assert watched.period(100.0) == 100.0 and safety.reason == ''
    assert watched.went == ['fault', 'enabled']


def test_force_that_jumps_is_a_fault_but_not_one_that_had_time() -> None:
    watched = Watched(**{'limit.force_rate': 1e5})
    watched.period(0.0, STILL)
    watched.period(0.0, STILL._replace(force_n=99.0))
    watched.period(0.0, STILL._replace(force_n=-450.0), periods=6)
    assert watched.safety.state is State.ENABLED
    watched.period(0.0, STILL._replace(force_n=-349.0))
    assert watched.safety.reason == (
        'rate of the force = 101000 N/s exceeds limit.force_rate = 100000 N/s')


def test_old_command_is_a_fault_only_while_enabled() -> None:
    watched = Watched()
    watched.safety.watch_command(0.1)
    assert watched.safety.state is State.ENABLED
    watched.safety.disable()
    watched.safety.watch_command(0.2)
    assert watched.safety.state is State.DISABLED
    assert watched.safety.enable() == ''
    watched.safety.watch_command(0.2)
    assert watched.safety.reason == (
        'age of valve_command = 0.2 s exceeds command_timeout = 0.1 s: the controller is silent, '
        'or the machine too busy for this limit')


def test_more_commands_than_one_controller_gives_are_a_fault_only_while_enabled() -> None:
    watched = Watched()
    watched.safety.watch_number_of_commands(1400, 1000)
    assert watched.safety.state is State.ENABLED
    watched.safety.disable()
    watched.safety.watch_number_of_commands(2000, 1000)
    assert watched.safety.state is State.DISABLED
    watched.safety.enable()
    watched.safety.watch_number_of_commands(2000, 1000)
    assert watched.safety.reason.startswith('2000 valve_commands in 1000 control periods: do two')


LIMITS = [p for p in TABLE if p.name.startswith(('limit.', 'command_limit', 'command_timeout'))
          or p.name.startswith('valve_characteristic.') and isinstance(p.default, float)]


@given(st.data())
def test_limits_may_be_set_to_anything_allowed_at_any_time(data: st.DataObject) -> None:
    """The command stays a finite number within its limit, and 0 once anything has tripped."""
    watched = Watched()
    for _ in range(data.draw(st.integers(1, 5))):
        values = {p.name: data.draw(
            st.integers(int(p.low), int(p.high)) if isinstance(p.default, int)
            else st.sampled_from([float(p.low), float(p.high), float(p.default)])
            | st.floats(float(p.low), float(p.high))) for p in LIMITS}
        watched.safety.configure(completed(values, TABLE))
        shut = watched.safety.state is State.FAULT
        given_n = watched.period(data.draw(st.floats(-1e9, 1e9)), Measured(
            *(data.draw(st.floats(-1e9, 1e9)) for _ in range(4))))
        assert math.isfinite(given_n) and abs(given_n) <= float(values['command_limit'])
        assert not (shut and given_n)


@pytest.mark.parametrize('command_n', [-400.0, 400.0])
def test_a_limit_that_is_lowered_holds_at_once(command_n: float) -> None:
    slow = {'limit.command_rate': 1000.0}
    watched = Watched(**slow)
    for _ in range(400):
        assert watched.period(command_n) != 0.0
    watched.safety.configure(completed(slow | {'command_limit': 100.0}, TABLE))
    assert watched.period(command_n) == math.copysign(100.0, command_n)


def test_few_bad_frames_in_a_long_time_are_no_fault() -> None:
    watched = Watched()
    for count in range(50):
        for _ in range(200):
            watched.period(0.0, health=Health(bad_frames=count, lost_states=10 * count))
    assert watched.safety.state is State.ENABLED


@pytest.mark.parametrize(('command_n', 'valve_m', 'shut'), [
    (1500.0, 0.0, True),          # 0.8 of the full opening is wanted, nothing moves
    (0.0, 1.5e-5, True),          # it stays open
    (1500.0, 1.4e-5, False),      # hysteresis: 2 um short of 16
    (4000.0, 2e-5, False),        # at the stop, although more is wanted
])
def test_valve_that_does_not_follow_is_a_fault(
        command_n: float, valve_m: float, shut: bool) -> None:
    watched = Watched()
    for _ in range(1000):
        watched.period(command_n, STILL._replace(valve_position_m=valve_m))
    assert (watched.safety.state is State.FAULT) == shut
    assert ('limit.valve_disagreement = 1e-05 m' in watched.safety.reason) == shut


@given(st.lists(st.floats(-1e6, 1e6), max_size=30))
def test_limiter_bounds_size_and_rate_whatever_is_asked_for(commands: list[float]) -> None:
    watched = Watched(**{'command_limit': 900.0, 'limit.command_rate': 5e4,
                         'limit.valve_disagreement': 1.0})
    before = 0.0
    for wanted in commands:
        given_n = watched.period(wanted)
        assert abs(given_n) <= 900.0 and abs(given_n - before) <= 50.0 * (1.0 + 1e-12)
        # As near to what is wanted as the limits let it.
        assert given_n == wanted or given_n in (
            max(-900.0, before - 50.0), min(900.0, before + 50.0))
        before = given_n


@given(st.floats(-4000.0, 4000.0), st.floats(-4000.0, 4000.0))
def test_limiter_with_its_defaults_changes_no_bit(first: float, second: float) -> None:
    watched = Watched()
    assert watched.safety.command(first) == first
    assert watched.safety.command(second) == second


def test_file_for_hardware_narrows_every_limit_it_names() -> None:
    text = (Path(__file__).parents[2] / 'config' / 'can.yaml').read_text()
    values = yaml.safe_load(text)['/**/asi_actuator']['ros__parameters']
    hardware = completed(values, TABLE)
    assert hardware['driver'] == 'can' and hardware['mode'] == 'realtime'
    limits = [name for name in values if name.startswith(('limit.', 'command_'))]
    assert len(limits) > 5
    assert all(values[name] < defaults(TABLE)[name] for name in limits)


@pytest.mark.parametrize('controller', [
    {'gain': 15.0, 'reference.amplitude': 600.0},        # limit cycle, saturated
    {'gain': 8.8, 'reference.amplitude': 100.0},
    {'compensator': 'lead_lag', 'gain': 60.0, 'reference.amplitude': 600.0},
    {'gain': 3.0, 'reference.amplitude': -900.0},
])
@pytest.mark.parametrize('load', ['locked', 'spring', 'free'])
def test_no_watchdog_trips_in_a_simulated_run(controller: dict[str, Any], load: str) -> None:
    rate_hz = 5000.0
    run = simulate_loop({'load.type': load}, {'reference.shape': 'step'} | controller, 0.6,
                        rate_hz)
    watched = Watched(1.0 / rate_hz)
    limit = float(defaults(TABLE)['command_limit'])
    for k in range(run.time_s.size - 1):
        applied = watched.period(run.command_n[k], Measured(
            run.force_n[k + 1], run.valve_position_m[k + 1], run.position_m[k + 1],
            run.velocity_m_s[k + 1]))
        assert applied == min(max(run.command_n[k], -limit), limit), watched.safety.reason
