"""The whole model: order of convergence, error at the default sub-step, scipy, and stability."""

import math
import os
import subprocess
import sys
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from study import STUDY

from asi_actuator.model.actuator import advance, prepare, rest, simulate
from asi_actuator.model.hydraulic_damping import damping_curve, damping_force
from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_actuator.parameters import as_record as record_of
from asi_analysis.loop.closed_loop import simulate_loop
from asi_common.parameter import Parameter, ParameterError, Value

PERIOD = 2e-4


def as_record(values):
    """Return the record of the study's parameters: the references below know their numbers."""
    return record_of(STUDY | values)


DEFAULT = 25e-6
SMOOTH: dict[str, Value] = {'valve_hysteresis.model': 'off', 'friction.model': 'off'}
TIME = np.arange(600) * PERIOD
STEP = np.where(TIME >= 0.01, 300.0, 0.0)
SINE = 300.0 * np.sin(2 * np.pi * 20 * TIME)


def force(values: dict[str, Value], commands: npt.NDArray[np.float64], substep: float
          ) -> npt.NDArray[np.float64]:
    """Return the force (N) integrated with a sub-step (s)."""
    return simulate(as_record({'maximum_substep': substep} | values), commands, PERIOD).force_n


@pytest.mark.parametrize('values', [
    {}, {'hydraulic_damping.model': 'off'}, {'fluid_dynamics.model': 'off'},
    {'valve_flexure.model': 'off'},
    {'valve_flexure.model': 'off', 'fluid_dynamics.model': 'off'},
    {'load.type': 'spring'}, {'load.type': 'free'}, {'force_sensor.mass_share': 0.9},
    {'load.type': 'prescribed', 'load.velocity': 0.3, 'load.frequency': 30.0}], ids=str)
def test_smooth_model_converges_with_the_second_order(values: dict[str, Value]) -> None:
    # Whole sub-steps of delay, so that the error of interpolation does not come and go.
    smooth = SMOOTH | {'valve_flexure.delay': 1e-3, 'force_sensor.delay': 1e-4} | values
    runs = [force(smooth, SINE, h) for h in (50e-6, 25e-6, 12.5e-6, 6.25e-6)]
    errors = [np.abs(a - b).max() for a, b in zip(runs, runs[1:], strict=False)]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    np.testing.assert_allclose(orders, 2.0, atol=0.15)


LINEAR: dict[str, Value] = {'friction.model': 'linear', 'friction.linear_gain': 300.0,
                            'hydraulic_damping.model': 'linear', 'load.type': 'spring'}


@pytest.mark.parametrize(('values', 'linear'), [
    (LINEAR, True), (LINEAR | {'hydraulic_damping.opening_viscous': 900.0}, True),
    (LINEAR | {'fluid_dynamics.leakage_growth': 1e-3, 'fluid_dynamics.air_time': 1e-3}, True),
    (LINEAR | {'coupling.stiffness': 1e5}, True),
    (LINEAR | {'backlash.gap': 1e-4, 'backlash.location': 'mass'}, True),
    (LINEAR | {'hydraulic_damping.quadratic': 1e4}, False),
    (LINEAR | {'hydraulic_damping.model': 'full'}, False),
    (LINEAR | {'friction.model': 'full'}, False)], ids=str)
def test_one_newton_step_suffices_where_all_forces_are_linear_in_the_velocity(
        values: dict[str, Value], linear: bool) -> None:
    p = as_record(values)
    p['maximum_substep'] = 1e-3   # so long that one step is not enough elsewhere
    steady = prepare(p, 1e-3)
    assert steady.linear == linear
    forces = []
    for each in (True, False):
        state = rest()
        for command in SINE:
            advance(state, command, p, steady._replace(linear=each))
        forces.append(state['hydraulic_force'])
    assert (abs(forces[0] - forces[1]) < 1e-9) == linear


@pytest.mark.parametrize('commands', [STEP, SINE], ids=['step', 'sine'])
@pytest.mark.parametrize('values', [
    {}, {'load.type': 'spring'}, {'load.type': 'free'}, {'valve_hysteresis.lagged': 1.0},
    {'load.type': 'prescribed', 'load.velocity': 0.1, 'load.frequency': 20.0},
    *({f'{block}.model': 'off'} for block in (
        'valve_hysteresis', 'valve_flexure', 'hydraulic_damping', 'fluid_dynamics', 'friction',
        'force_sensor'))], ids=str)
def test_halving_the_default_substep_changes_the_force_by_less_than_a_thousandth(
        values: dict[str, Value], commands: npt.NDArray[np.float64]) -> None:
    here, halved = force(values, commands, DEFAULT), force(values, commands, DEFAULT / 2)
    assert np.abs(here - halved).max() < 1e-3 * np.abs(halved).max()


def limit_cycle(substep: float, gain: float, step_n: float) -> tuple[float, float]:
    """Return frequency (Hz) and amplitude (N) of the sustained oscillation."""
    run = simulate_loop({'maximum_substep': substep},
                        {'gain': gain, 'reference.shape': 'step', 'reference.amplitude': step_n},
                        3.0)
    late = run.time_s > 1.5
    time, wave = run.time_s[late], run.force_n[late] - run.force_n[late].mean()
    rising = np.flatnonzero((wave[:-1] < 0) & (wave[1:] >= 0))
    crossing = time[rising] - wave[rising] * PERIOD / (wave[rising + 1] - wave[rising])
    return (crossing.size - 1) / (crossing[-1] - crossing[0]), math.sqrt(2) * wave.std()


@pytest.mark.parametrize('step_n', [100.0, 300.0, 600.0])
def test_halving_the_default_substep_leaves_the_limit_cycle(step_n: float) -> None:
    here, halved = limit_cycle(DEFAULT, 10.5, step_n), limit_cycle(DEFAULT / 2, 10.5, step_n)
    assert here[1] > 50.0
    assert here == pytest.approx(halved, rel=1e-3)


# --- the whole actuator against scipy


def scipy_force(values: dict[str, Value], commands: npt.NDArray[np.float64]
                ) -> npt.NDArray[np.float64]:
    """
    Return the force (N) of the smooth model without delays, by Radau at tight tolerances.

    One solution a control period, because the command jumps there.
    """
    p = as_record(values)

    def second_order(u: float, y: float, dy: float, hz: float, zeta: float) -> float:
        w = 2 * math.pi * hz
        return w * w * (u - y) - 2 * zeta * w * dy

    def derivative(_: float, x: Any, command: float) -> list[float]:
        coil, pipe, pipe_rate, hydraulic, position, velocity, sensor, sensor_rate, card, rate = x
        static = min(max(p['valve_characteristic_gain'] * pipe, -1000.0), 1000.0)
        damping = damping_force(velocity, damping_curve(static / 1000.0, p), p)[0]
        return [
            2 * math.pi * 26.1 * (command - coil),
            pipe_rate, second_order(coil, pipe, pipe_rate, 890.0, 0.359),
            2 * math.pi * 1000.0 * (static - damping - hydraulic),
            velocity, (hydraulic - 1.12e6 * position - 50.0 * velocity) / 0.5,
            sensor_rate, second_order(hydraulic, sensor, sensor_rate, 800.0, 0.7),
            rate, second_order(sensor, card, rate, 1e4, math.sqrt(0.5))]

    x, out = np.zeros(10), []
    for command in commands:
        out.append(x[8])
        x = solve_ivp(derivative, (0.0, PERIOD), x, 'Radau', args=(command,),
                      rtol=1e-8, atol=1e-9).y[:, -1]
    return np.array(out)


def test_whole_actuator_agrees_with_scipy() -> None:
    commands = np.concatenate([np.full(60, 500.0), np.full(60, -2500.0), SINE[:60]])
    values = SMOOTH | {'valve_flexure.delay': 0.0, 'force_sensor.delay': 0.0}
    exact = scipy_force(values, commands)
    errors = [np.abs(force(values, commands, h) - exact).max() / np.abs(exact).max()
              for h in (DEFAULT, DEFAULT / 2, DEFAULT / 4)]
    assert errors[0] < 1e-3
    # Towards scipy's solution, not merely towards its own.
    assert errors[1] < errors[0] / 3 and errors[2] < errors[1] / 3


# --- it never diverges, whatever is allowed


def values_of(parameter: Parameter) -> st.SearchStrategy[Value]:
    """Return any allowed value, the ends of the range and the default more often."""
    if parameter.choices:
        return st.sampled_from(parameter.choices)
    ends = st.sampled_from([parameter.default, parameter.low, parameter.high])
    if isinstance(parameter.default, int):
        return st.integers(int(parameter.low), int(parameter.high))
    if parameter.low > 0.0:
        low, high = math.log(parameter.low), math.log(parameter.high)
        return ends | st.floats(low, high).map(
            lambda x: min(max(math.exp(x), parameter.low), parameter.high))
    return ends | st.floats(parameter.low, parameter.high)


ALLOWED = st.fixed_dictionaries(
    {}, optional={parameter.name: values_of(parameter) for parameter in ACTUATOR_PARAMETERS})
HARSH = np.concatenate([np.full(20, 4000.0), np.full(20, -4000.0),
                        np.random.default_rng(1).normal(0.0, 1500.0, 60)])


@settings(max_examples=120)
@given(ALLOWED)
@example({'friction.coulomb': 5.7e-303, 'friction.presliding_stiffness': 1.2e6})
def test_every_allowed_parameter_gives_a_finite_force(values: dict[str, Value]) -> None:
    check_finite(values)


@pytest.mark.slow
@settings(max_examples=400)
@given(ALLOWED)
def test_every_allowed_parameter_of_many_gives_a_finite_force(values: dict[str, Value]) -> None:
    check_finite(values)


def check_finite(values: dict[str, Value]) -> None:
    try:
        p = as_record(values)
    except ParameterError:
        return
    run = simulate(p, HARSH, PERIOD)
    for signal in run:
        assert np.isfinite(signal).all()
    # What adds a force of any size beyond those bounds, when it is on.
    unbounded = (p['hydraulic_damping_quadratic'] or p['hydraulic_damping_opening_viscous']
                 or p['valve_characteristic_supply_drop'] < 0.0)
    if (p['valve_characteristic_model'] == 2 and p['hydraulic_damping_model'] != 1
            and p['fluid_dynamics_model'] != 1 and not unbounded):
        # Valve and damping are bounded, so the hydraulic force is; the friction is bounded by
        # the seals' deflection, apart from their damping.
        bound = p['valve_characteristic_maximum_force'] + p['hydraulic_damping_maximum_force']
        assert np.abs(hydraulic(p)).max() <= bound * (1.0 + 1e-6)


def hydraulic(p: np.void) -> npt.NDArray[np.float64]:
    """Return the hydraulic force (N) after each of the harsh commands."""
    state, out = rest(), []
    for command in HARSH:
        simulate(p, [command], PERIOD, state)
        out.append(float(state['hydraulic_force']))
    return np.array(out)


def test_newtons_rule_finds_the_velocity_on_a_damper_as_steep_as_a_wall() -> None:
    # From the flat end of such a tanh a bare Newton step jumps to the other end, for ever.
    p = as_record(SMOOTH | {
        'valve_flexure.model': 'off', 'fluid_dynamics.model': 'off', 'load.type': 'free',
        'load.mass': 1e-3, 'hydraulic_damping.maximum_force': 2000.0,
        'hydraulic_damping.velocity_width': 1e-3, 'hydraulic_damping.centre_share': 1.0,
        'hydraulic_damping.viscous': 0.0, 'hydraulic_damping.saturation_velocity': 0.0,
        'hydraulic_damping.saturation_shift': 0.0, 'hydraulic_damping.saturation_narrowing': 0.0})
    run = simulate(p, np.repeat([1000.0, -1000.0, 1000.0], 20), PERIOD)
    # 535 N, or twice that for a sub-step, against 2000 N within some mm/s: it hardly moves.
    assert 0.0 < np.abs(run.velocity_m_s).max() < 1e-3


# --- where Newton's rule stops

# Interpreted, so that the compiled-in tolerance can be replaced.
HARD_LOOP = """
import numpy as np
from asi_actuator.model import load
from asi_actuator.model.actuator import measure, rest, step
from asi_actuator.parameters import as_record
default = load.LINEAR_STEP
def run(values, straight):
    load.LINEAR_STEP = straight
    p, state = (np.array([r]).view(np.recarray)[0] for r in (as_record(values), rest()))
    forces = []
    for k in range(100):
        forces.append(measure(state, p)[0])
        desired = 1000.0 if k % 60 < 30 else -300.0
        step(state, 15.0 * (desired - forces[-1]), p, 2e-4)
    return np.array(forces)
for values in (
        {}, {'load.type': 'free'}, {'load.type': 'spring', 'fluid_dynamics.model': 'off'},
        {'load.type': 'free', 'load.mass': 0.05, 'friction.stribeck_velocity': 1e-3},
        {'hydraulic_damping.velocity_width': 0.01, 'hydraulic_damping.centre_share': 1.0}):
    exact = run(values, 1e-14)
    print(np.abs(run(values, default) - exact).max() / np.abs(exact).max())
"""


@pytest.mark.slow
def test_hard_driven_loop_does_not_depend_on_where_newtons_rule_stops() -> None:
    differences = subprocess.run(
        [sys.executable, '-c', HARD_LOOP], env=os.environ | {'NUMBA_DISABLE_JIT': '1'},
        check=True, capture_output=True, text=True).stdout.split()
    assert len(differences) == 5
    assert all(float(difference) < 1e-5 for difference in differences)
