"""The simulated joint: its equations against other solvers, each effect, and the node's tables."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

from asi_actuator.driver.simulated import SimulatedActuator
from asi_actuator.joint import joint
from asi_actuator.joint_parameters import JOINT_PARAMETERS, as_record, units
from asi_actuator.node_parameters import ACTUATOR_NODE_PARAMETERS
from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_common.parameter import ParameterError, Value, completed, defaults

T = 2e-3
TIME = np.arange(1000) * T
COMMAND = 0.8 * np.sin(2.0 * np.pi * 1.3 * TIME) + 0.5 * np.sin(2.0 * np.pi * 0.37 * TIME)
Values = dict[str, Value]


def run(values: Values, command: np.ndarray = COMMAND) -> joint.Trajectory:
    return joint.simulate(as_record(values), command, T)


def solved(derivative: Callable[[np.ndarray, float], list[float]], start: list[float],
           command: np.ndarray = COMMAND) -> np.ndarray:
    """Return the state at each sample by a solver with small errors, the command held."""
    out, y = np.empty((len(start), command.size)), np.array(start)
    for k, u in enumerate(command):
        out[:, k] = y
        y = solve_ivp(lambda _, state, u=u: derivative(state, u), (0.0, T), y, rtol=1e-9,
                      atol=1e-11).y[:, -1]
    return out


@pytest.mark.slow
def test_every_effect_is_null_by_default():
    found = run({'load.mass': 0.05})
    force = np.append(0.0, COMMAND[:-1])    # held from sample to sample
    velocity = np.cumsum(force) * T / 0.05
    np.testing.assert_allclose(found.velocity, velocity, atol=1e-9)
    np.testing.assert_allclose(found.force, force, atol=1e-12)


def test_gravity_spring_ripple_and_offset_are_those_of_their_equations():
    found = run({'load.mass': 0.05, 'load.damping': 0.1, 'gravity.sine': 1.0,
                 'gravity.cosine': 0.2, 'load.stiffness': 0.3, 'load.rest': 0.2,
                 'load.offset': 0.1, 'ripple.force': 0.05, 'ripple.period': 0.5,
                 'ripple.phase': 0.1})

    def derivative(state, u):
        q, v = state
        held = (0.3 * (q - 0.2) + math.sin(q) + 0.2 * math.cos(q) + 0.1
                + 0.05 * math.sin(2.0 * math.pi * (q / 0.5 + 0.1)))
        return [v, (u - 0.1 * v - held) / 0.05]

    position, velocity = solved(derivative, [0.0, 0.0])
    np.testing.assert_allclose(found.position, position, atol=1e-6)
    np.testing.assert_allclose(found.velocity, velocity, atol=1e-5)


def test_two_masses_are_those_of_their_equations():
    found = run({'load.mass': 0.05, 'load.damping': 0.1, 'load.stiffness': 0.5,
                 'gravity.sine': 0.3, 'coupling.stiffness': 40.0, 'coupling.damping': 0.02,
                 'coupling.piston_share': 0.4, 'friction.viscous': 0.03})

    def derivative(state, u):
        q, v, x, w = state
        between = 40.0 * (q - x) + 0.02 * (v - w)
        return [v, (u - 0.03 * v - between) / 0.02,
                w, (between - 0.1 * w - 0.5 * x - 0.3 * math.sin(x)) / 0.03]

    # Of second order in the sub-step: 0.1 ms of a resonance of 9 Hz.
    np.testing.assert_allclose(found.position, solved(derivative, [0.0] * 4)[0], atol=1e-5)


def test_backlash_lets_the_load_stay_while_the_motor_crosses_the_gap():
    values: Values = {'load.mass': 0.05, 'load.damping': 0.05, 'backlash.gap': 0.1,
                      'coupling.piston_share': 0.3}
    p = as_record(values)
    state = joint.rest(p)
    crossing = next(k for k in range(1000) if not joint.step(state, 0.1, p, 1e-3)
                    and state['load_velocity'] != 0.0)
    # Half of the gap, by 0.1 / (0.3 * 0.05) rad/s2.
    assert crossing * 1e-3 == pytest.approx(math.sqrt(2.0 * 0.05 / (0.1 / 0.015)), abs=2e-3)


def test_a_servo_is_of_second_order_and_keeps_its_limits():
    command = np.where(TIME < 1.0, 0.0, 0.8)
    values: Values = {'servo.kp': 1600.0, 'servo.kv': 48.0}
    found = run(values, command)
    position, _ = solved(lambda y, u: [y[1], 1600.0 * (u - y[0]) - 48.0 * y[1]], [0.0, 0.0],
                         command)
    np.testing.assert_allclose(found.position, position, atol=2e-6)
    limited = run(values | {'servo.rate_limit': 3.0, 'servo.acceleration_limit': 60.0}, command)
    assert np.abs(limited.velocity).max() == pytest.approx(3.0)
    assert np.abs(np.diff(limited.velocity)).max() <= 60.0 * T + 1e-9
    # Of another inertia the same acceleration takes more force.
    heavy = run({name: 2.0 * float(value) for name, value in values.items()} | {
        'load.mass': 2.0, 'servo.rate_limit': 3.0, 'servo.acceleration_limit': 60.0}, command)
    np.testing.assert_allclose(heavy.position, limited.position, atol=1e-9)
    # An integral takes a constant load away, a proportional gain alone does not.
    held: Values = {**values, 'load.offset': 100.0}
    assert run(held, command).position[-1] == pytest.approx(0.8 - 100.0 / 1600.0, abs=1e-3)
    assert run(held | {'servo.ki': 2e4}, command).position[-1] == pytest.approx(0.8, abs=0.01)


@pytest.mark.parametrize('servo', [False, True])
def test_a_drive_that_gets_warm_loses_a_share_of_its_force(servo: bool):
    warm: Values = {'load.mass': 0.05, 'drive.warm_loss': 0.3, 'drive.warm_time': 0.5}
    gains: Values = {'servo.kp': 20.0, 'servo.kv': 2.0} if servo else {}
    kp, kv = (20.0, 2.0) if servo else (0.0, 0.0)

    def derivative(state, u):
        q, v, t = state
        share = 1.0 - 0.3 * (1.0 - math.exp(-t / 0.5))
        return [v, share * ((kp * (u - q) - kv * v) if servo else u) / 0.05, 1.0]

    position, velocity, _ = solved(derivative, [0.0, 0.0, 0.0])
    found = run(warm | gains)
    np.testing.assert_allclose(found.velocity, velocity, atol=2e-4 * np.abs(velocity).max())
    assert np.abs(run({'load.mass': 0.05} | gains).velocity - velocity).max() > 0.1


def test_the_drive_is_late_limited_and_has_a_dead_band():
    base: Values = {'load.mass': 1.0, 'load.damping': 1.0}
    force = run(base).force
    late = run(base | {'command_path.delay': 10 * T})
    np.testing.assert_allclose(late.force[10:], force[:-10], atol=1e-12)
    keep = math.exp(-T / 0.03)
    lagging = run(base | {'drive.lag_time': 0.03})
    np.testing.assert_allclose(lagging.force, lfilter([1.0 - keep], [1.0, -keep], force),
                               atol=2e-3)
    both = run(base | {'drive.lag_time': 0.02, 'drive.second_lag_time': 0.01}).force
    other = run(base | {'drive.lag_time': 0.01, 'drive.second_lag_time': 0.02}).force
    np.testing.assert_allclose(both, other, atol=1e-3)
    np.testing.assert_allclose(run(base | {'drive.force_limit': 0.5}).force,
                               np.clip(force, -0.5, 0.5), atol=1e-12)
    rate = run(base | {'drive.force_rate_limit': 2.0}).force
    assert np.abs(np.diff(rate)).max() <= 2.0 * T + 1e-12
    shifted = np.clip(np.abs(force) - 0.3, 0.0, None) * np.sign(force)
    np.testing.assert_allclose(run(base | {'drive.deadband': 0.3, 'drive.gain': 2.0}).force,
                               2.0 * shifted, atol=1e-12)
    steps = run(base | {'command_path.quantum': 0.25}).force / 0.25
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-12)


def test_friction_stops_a_joint_where_coulomb_says_and_breaks_away_at_stiction():
    p = as_record({'load.mass': 0.05, 'friction.coulomb': 0.15})
    state = joint.rest(p)
    state['velocity'] = 1.0
    stopped = joint.simulate(p, np.zeros(1000), T, state)
    assert stopped.position[-1] == pytest.approx(0.5 * 0.05 / 0.15, rel=1e-3)
    slow = np.linspace(0.0, 1.0, 1000)
    found = run({'load.mass': 0.05, 'friction.coulomb': 0.15, 'friction.stiction_push': 0.4,
                 'friction.stiction_pull': 0.2}, slow)
    assert slow[np.argmax(found.position > 2e-4)] == pytest.approx(0.4, abs=0.03)
    back = run({'load.mass': 0.05, 'friction.coulomb': 0.15, 'friction.stiction_push': 0.4,
                'friction.stiction_pull': 0.2}, -slow)
    assert slow[np.argmax(back.position < -2e-4)] == pytest.approx(0.2, abs=0.03)
    # Without more, breakaway is the sliding friction, not less.
    found = run({'load.mass': 0.05, 'friction.coulomb': 0.3}, slow)
    assert slow[np.argmax(found.position > 2e-4)] == pytest.approx(0.3, abs=0.03)


def test_sensors_read_what_they_are_told_to():
    base: Values = {'load.mass': 0.05, 'load.damping': 0.1, 'load.stiffness': 1.0}
    exact = run(base)
    found = run(base | {
        'position_sensor.gain': 1.1, 'position_sensor.offset': 0.2, 'position_sensor.drift': 0.1,
        'force_sensor.gain': 0.9, 'force_sensor.offset': -0.3, 'force_sensor.drift': 0.05})
    np.testing.assert_allclose(found.position, 1.1 * exact.position + 0.2 + 0.1 * TIME, atol=1e-9)
    np.testing.assert_allclose(found.force, 0.9 * exact.force - 0.3 + 0.05 * TIME, atol=1e-9)
    rough = run(base | {'position_sensor.resolution': 0.01})
    np.testing.assert_allclose(rough.position, 0.01 * np.floor(exact.position / 0.01 + 0.5),
                               atol=1e-12)
    noisy = run(base | {'position_sensor.noise': 1e-3, 'velocity_sensor.noise': 2e-3,
                        'force_sensor.noise': 3e-3})
    noises = [noisy.position - exact.position, noisy.velocity - exact.velocity,
              noisy.force - exact.force]
    assert [float(each.std()) for each in noises] == pytest.approx([1e-3, 2e-3, 3e-3], rel=0.1)
    assert np.abs(np.corrcoef(noises) - np.eye(3)).max() < 0.1
    np.testing.assert_array_equal(
        run(base | {'position_sensor.noise': 1e-3}).position, noisy.position)
    lagging = run(base | {'position_sensor.lag_time': 0.02})
    keep = math.exp(-T / 0.02)
    np.testing.assert_allclose(lagging.position, lfilter(
        [1.0 - keep], [1.0, -keep], exact.position), atol=0.1 * np.abs(exact.position).max())
    assert lagging.position[300] != exact.position[300]


@pytest.mark.parametrize(('values', 'reason'), [
    ({'servo.kv': 1.0}, 'servo.kv = 1.0 is not allowed with servo.kp = 0.0'),
    ({'load.mass': 0.0}, 'load.mass = 0.0 is not allowed'),
    ({'valve_flexure.lag_time': 0.1}, 'valve_flexure.lag_time is not a parameter')])
def test_what_a_joint_cannot_have_is_refused(values: Values, reason: str):
    with pytest.raises(ParameterError, match=reason):
        as_record(values)


def test_the_driver_runs_it_and_refuses_a_delay_that_it_cannot_remember():
    values = completed({'plant': 'joint'}, ACTUATOR_NODE_PARAMETERS) | defaults(
        JOINT_PARAMETERS) | {'load.mass': 0.05, 'gravity.sine': 1.0, 'drive.force_limit': 0.5}
    driver = SimulatedActuator(values, T)
    force, valve, position, velocity = driver.exchange(0.4, True, 3)
    expected = run({'load.mass': 0.05, 'gravity.sine': 1.0}, np.full(4, 0.4))
    assert (force, position, velocity) == (
        expected.force[3], expected.position[3], expected.velocity[3])
    assert valve == 0.0 and not driver.health.saturated
    driver.exchange(2.0, True, 1)
    assert driver.health.saturated
    with pytest.raises(ParameterError, match='command_path.delay = 1.0 is not allowed at 5000 Hz'):
        SimulatedActuator(values | {'command_path.delay': 1.0}, 2e-4)


def test_what_both_have_has_one_name_and_kind():
    ours = {parameter.name: parameter for parameter in JOINT_PARAMETERS}
    for theirs in ACTUATOR_PARAMETERS:
        if theirs.name in ours:
            assert isinstance(theirs.default, type(ours[theirs.name].default)), theirs.name
            assert ours[theirs.name].choices == theirs.choices, theirs.name
            assert theirs.unit in ours[theirs.name].unit, theirs.name


@pytest.mark.parametrize(('values', 'expected'), [
    ({}, {'reference': 'Nm', 'command': 'Nm', 'force': 'Nm', 'position': 'rad',
          'velocity': 'rad/s'}),
    ({'joint.type': 'prismatic'}, {}),
    ({'joint.type': 'prismatic', 'servo.kp': 1.0}, {'reference': 'm', 'command': 'm'})])
def test_units_are_those_of_the_joint(values: Values, expected: dict[str, str]):
    assert units(completed(values, JOINT_PARAMETERS)) == expected
