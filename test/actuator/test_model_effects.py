"""Each effect of the simulator that is null by default, against a closed form or a known rule."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.integrate import solve_ivp
from study import STUDY

from asi_actuator.model.actuator import Trajectory, measure, rest, simulate, step
from asi_actuator.model.effects import BLOCKS, EFFECTS
from asi_actuator.parameters import ACTUATOR_PARAMETERS, as_record
from asi_analysis.loop import linear_model
from asi_analysis.loop.closed_loop import simulate_loop
from asi_common.parameter import Value, defaults
from asi_common.record import copy_of

PERIOD = 2e-4
PARTS = ('valve_hysteresis', 'valve_flexure', 'valve_characteristic', 'hydraulic_damping',
         'fluid_dynamics', 'friction', 'force_sensor')
# Every block its unit gain, the piston held: the force is 0.535 times the command.
STILL: dict[str, Value] = STUDY | {f'{part}.model': 'off' for part in PARTS} | {
    'load.type': 'prescribed', 'load.velocity': 0.0}
GAIN = 0.535
RAMP = np.linspace(-300.0, 300.0, 601)
Array = npt.NDArray[np.float64]


def run(values: dict[str, Value], commands: npt.ArrayLike, period: float = PERIOD) -> Trajectory:
    """Return the run of valve commands (N) with the named parts alone."""
    return simulate(as_record(STILL | values), commands, period)


def force(values: dict[str, Value], commands: npt.ArrayLike, period: float = PERIOD) -> Array:
    """Return its force (N) at the end of each command's period."""
    return run(values, np.append(commands, 0.0), period).force_n[1:]


# --- the declarations


def test_each_effect_of_the_vocabulary_is_declared_once() -> None:
    words = [effect.name for effect in EFFECTS]
    assert len(set(words)) == len(words) == 23
    assert {effect.block for effect in EFFECTS} == set(BLOCKS)


@pytest.mark.parametrize('effect', EFFECTS, ids=lambda effect: effect.name)
def test_each_example_is_seen_in_what_is_measured(effect) -> None:
    loop: dict[str, Value] = {'reference.shape': 'multisine', 'reference.amplitude': 200.0,
                              'reference.frequency': 1.0, 'reference.end_frequency': 60.0}
    nominal: dict[str, Value] = {'load.type': 'spring', 'load.stiffness': 2e4, 'load.mass': 3.0}
    plain = simulate_loop(nominal, loop, 0.5)
    other = simulate_loop(nominal | dict(effect.example), loop, 0.5)
    assert np.isfinite(other.force_n).all()
    measured = ('force_n', 'valve_position_m', 'position_m', 'velocity_m_s')
    assert max(np.std(getattr(other, name) - getattr(plain, name)) / np.std(getattr(plain, name))
               for name in measured) > 0.005


def test_null_is_the_default() -> None:
    null = defaults(ACTUATOR_PARAMETERS)
    for effect in EFFECTS:
        for name, value in effect.example.items():
            assert null[name] != value
            physical = ('valve_hysteresis.radius', 'hydraulic_damping.viscous',
                        'friction.coulomb', 'friction.stiction_push', 'friction.stiction_pull',
                        'friction.stribeck_velocity', 'force_sensor.gain')
            assert null[name] == 0.0 or name in physical


# --- command path


@pytest.mark.parametrize('delay', [2e-4, 3.3e-4, 0.01, 0.0123, 0.05])
@pytest.mark.parametrize('period', [2e-4, 1e-3])
def test_delay_of_the_command_is_exact(delay: float, period: float) -> None:
    # With a coil of 18.9 Hz alone: a delayed response is the response, later.
    coil: dict[str, Value] = {'valve_flexure.model': 'full', 'valve_flexure.delay': 0.0,
                              'valve_flexure.natural_frequency': 5e3}
    commands = 100.0 * np.sin(np.arange(200) * 0.1)
    fine = 1e-5
    whole = round(period / fine)
    plain = run(coil | {'maximum_substep': fine}, np.repeat(commands, whole), fine).force_n
    late = run(coil | {'maximum_substep': fine, 'command_path.delay': delay}, commands, period)
    at = (np.arange(commands.size) * period - delay) / fine
    expected = np.interp(at, np.arange(plain.size), plain, left=0.0)
    np.testing.assert_allclose(late.force_n, expected, atol=0.02)


@pytest.mark.parametrize('rounding, steps', [
    ('nearest', lambda u: 20.0 * np.floor(u / 20.0 + 0.5)),
    ('edge', lambda u: 20.0 * (np.floor(u / 20.0) + 0.5)),
    ('zero', lambda u: 20.0 * np.trunc(u / 20.0))])
def test_quantised_command(rounding: str, steps) -> None:
    ours = force({'command_path.quantum': 20.0, 'command_path.rounding': rounding}, RAMP)
    np.testing.assert_allclose(ours, GAIN * steps(RAMP), rtol=1e-12, atol=1e-12)


# --- valve


def test_dead_band_of_the_drive_and_of_the_orifice() -> None:
    drive = force({'valve_flexure.deadband': 50.0}, RAMP)
    np.testing.assert_allclose(drive, GAIN * np.sign(RAMP) * np.maximum(np.abs(RAMP) - 50.0, 0.0),
                               atol=1e-9)
    # 20 um give 1000 N, so that 1 um covers 50 N of static force.
    orifice = force({'valve_characteristic.deadband': 1e-6}, RAMP)
    static = GAIN * RAMP
    np.testing.assert_allclose(
        orifice, np.sign(static) * np.maximum(np.abs(static) - 50.0, 0.0), atol=1e-9)


def test_bias_of_the_flexure_is_seen_by_the_valve_sensor_and_that_of_the_orifice_is_not() -> None:
    flexure = run({'valve_flexure.bias': 40.0}, np.zeros(3))
    assert flexure.force_n[-1] == pytest.approx(GAIN * 40.0)
    assert flexure.valve_position_m[-1] == pytest.approx(GAIN * 40.0 / 1000.0 * 2e-5)
    orifice = run({'valve_characteristic.bias': 1e-6}, np.zeros(3))
    assert orifice.force_n[-1] == pytest.approx(50.0)
    assert orifice.valve_position_m[-1] == 0.0


def test_limits_of_travel_and_of_flow() -> None:
    travel = run({'valve_flexure.travel_limit': 2e-6}, [1000.0, 1000.0, -1000.0, 0.0])
    assert travel.valve_position_m[1] == pytest.approx(2e-6)
    assert travel.force_n[1] == pytest.approx(100.0)
    assert travel.force_n[3] == pytest.approx(-100.0)
    flow = run({'valve_characteristic.flow_limit': 100.0}, [1000.0, 1000.0, -1000.0, 0.0])
    assert flow.valve_position_m[1] == pytest.approx(GAIN * 2e-5)
    assert flow.force_n[1] == pytest.approx(100.0)
    assert flow.force_n[3] == pytest.approx(-100.0)


def test_further_lag_of_the_valve_and_of_the_sensor() -> None:
    time = np.arange(1, 200) * PERIOD
    step = GAIN * 100.0 * (1.0 - np.exp(-time / 0.004))
    for name in ('valve_flexure.lag_time', 'valve_flexure.second_lag_time',
                 'force_sensor.lag_time', 'force_sensor.second_lag_time'):
        ours = force({name: 0.004}, np.full(time.size, 100.0))
        # The sub-step of 25 us: half of one later or earlier.
        np.testing.assert_allclose(ours, step, atol=0.4)
    both = GAIN * 100.0 * (1.0 - (0.004 * np.exp(-time / 0.004) - 0.001 * np.exp(-time / 0.001))
                           / 0.003)
    for block in ('valve_flexure', 'force_sensor'):
        ours = force({f'{block}.lag_time': 0.004, f'{block}.second_lag_time': 0.001},
                     np.full(time.size, 100.0))
        np.testing.assert_allclose(ours, both, atol=0.4)


@pytest.mark.parametrize('block', ['valve_flexure', 'force_sensor'])
@pytest.mark.parametrize('lag', ['lag_time', 'second_lag_time'])
def test_a_lag_that_is_switched_on_begins_at_the_present_force(block: str, lag: str) -> None:
    plain, state = as_record(STILL), rest()
    for _ in range(50):
        step(state, 100.0, plain, PERIOD)
    lagged, there = as_record(STILL | {f'{block}.{lag}': 0.01}), copy_of(state)
    step(there, 100.0, lagged, PERIOD)
    assert measure(there, lagged)[0] == pytest.approx(measure(state, plain)[0])


@pytest.mark.parametrize('model', ['off', 'full'])
def test_linear_model_has_the_further_lags(model: str) -> None:
    for block, response in (('valve_flexure', linear_model.flexure), ('force_sensor',
                                                                      linear_model.card)):
        values: dict[str, Value] = {f'{block}.model': model}
        plain, lagged = (response(as_record(values | more))(20.0) for more in (
            {}, {f'{block}.lag_time': 0.004, f'{block}.second_lag_time': 0.001}))
        s = 2j * np.pi * 20.0
        assert lagged == pytest.approx(plain / (1.0 + 0.004 * s) / (1.0 + 0.001 * s))


# --- hydraulics


def test_supply_pressure_drops_and_sags() -> None:
    drop = force({'valve_characteristic.supply_drop': 0.25}, RAMP)
    np.testing.assert_allclose(drop, 0.75 * GAIN * RAMP, atol=1e-9)
    command = np.full(4000, 1000.0)
    sag = force({'valve_characteristic.supply_sag': 0.4, 'valve_characteristic.supply_time': 0.2},
                command)
    time = np.arange(1, 4001) * PERIOD
    opening = GAIN * 1000.0 / 1000.0
    expected = GAIN * 1000.0 * (1.0 - 0.4 * opening * (1.0 - np.exp(-time / 0.2)))
    np.testing.assert_allclose(sag, expected, atol=0.05)
    none = force({'valve_characteristic.supply_sag': 3.0, 'valve_characteristic.supply_time': 0.2},
                 command)
    assert none[-1] == 0.0   # all of it is lost, and no more


def test_leakage_divides_the_force_and_makes_its_lag_faster() -> None:
    values: dict[str, Value] = {'fluid_dynamics.leakage': 0.5}
    assert force(values, [300.0])[-1] == pytest.approx(GAIN * 300.0 / 1.5)
    slow = values | {'fluid_dynamics.model': 'full', 'fluid_dynamics.frequency': 20.0,
                     'maximum_substep': 5e-6}
    time = np.arange(1, 300) * PERIOD
    expected = GAIN * 300.0 / 1.5 * (1.0 - np.exp(-2.0 * math.pi * 20.0 * 1.5 * time))
    np.testing.assert_allclose(force(slow, np.full(time.size, 300.0)), expected, atol=0.1)


def test_entrained_air_lags_most_at_small_forces() -> None:
    values: dict[str, Value] = {'fluid_dynamics.air_time': 0.01, 'fluid_dynamics.air_force': 100.0,
                                'maximum_substep': 5e-6}
    ours = force(values, np.full(400, 1000.0))
    target = GAIN * 1000.0

    def rate(_: float, y: Array) -> Array:
        return (target - y) / (0.01 / (1.0 + np.abs(y) / 100.0))

    time = np.arange(1, 401) * PERIOD
    expected = solve_ivp(rate, (0.0, time[-1]), [0.0], t_eval=time, rtol=1e-8, atol=1e-8).y[0]
    np.testing.assert_allclose(ours, expected, atol=0.02 * target)
    finer = force(values | {'maximum_substep': 2.5e-6}, np.full(400, 1000.0))
    assert np.abs(finer - expected).max() < 0.6 * np.abs(ours - expected).max()


def test_damping_with_the_square_of_the_velocity_and_with_the_opening() -> None:
    driven: dict[str, Value] = {'load.velocity': 0.2}
    square = force(driven | {'hydraulic_damping.quadratic': 500.0}, [0.0])
    assert square[-1] == pytest.approx(-500.0 * 0.04)
    opened = force(driven | {'hydraulic_damping.opening_viscous': 300.0}, [400.0])
    assert opened[-1] == pytest.approx(GAIN * 400.0 * (1.0 - 300.0 * 0.2 / 1000.0))


# --- mechanics


def test_viscous_and_asymmetric_friction() -> None:
    rubbed = force({'load.velocity': 0.2, 'friction.viscous': 100.0}, [0.0])
    assert rubbed[-1] == pytest.approx(-20.0)
    for velocity, level in ((0.2, 7.0 * 1.4), (-0.2, -7.0 * 0.6)):
        slid = force({'friction.model': 'full', 'friction.coulomb_asymmetry': 0.4,
                      'load.velocity': velocity}, np.zeros(300))
        assert slid[-1] == pytest.approx(-level, rel=1e-3)


def test_friction_behind_the_sensor_is_not_in_the_force_of_a_prescribed_motion() -> None:
    values: dict[str, Value] = {'load.velocity': 0.2, 'friction.viscous': 100.0,
                                'friction.location': 'load'}
    assert force(values, [0.0])[-1] == 0.0


def test_dahl_bristle_follows_its_exponential() -> None:
    # dF/dx = stiffness (1 - F / level): F = level (1 - exp(-stiffness x / level)).
    level, stiffness, velocity = 20.0, 2e5, 0.02
    ours = force({'friction.model': 'full', 'friction.presliding_slip': 1.0,
                  'friction.coulomb': level, 'friction.stiction_push': level,
                  'friction.stiction_pull': level, 'friction.presliding_stiffness': stiffness,
                  'friction.presliding_damping': 0.0, 'load.velocity': velocity}, np.zeros(200))
    way = velocity * PERIOD * np.arange(1, 201)
    np.testing.assert_allclose(ours, -level * (1.0 - np.exp(-stiffness * way / level)), atol=0.02)


@pytest.mark.parametrize('exponent', [0.5, 1.4, 2.0])
def test_dahls_law_with_its_exponent_through_reversals(exponent: float) -> None:
    # dF/dx = stiffness (1 - F / level sign v) ** exponent (Dahl 1968), v a sine.
    level, stiffness, peak, frequency = 20.0, 2e5, 0.02, 7.0
    ours = force({'friction.model': 'full', 'friction.presliding_slip': 1.0,
                  'friction.presliding_exponent': exponent,
                  'friction.coulomb': level, 'friction.stiction_push': level,
                  'friction.stiction_pull': level, 'friction.presliding_stiffness': stiffness,
                  'friction.presliding_damping': 0.0, 'load.velocity': peak,
                  'load.frequency': frequency}, np.zeros(500))

    def rate(t: float, f: Any) -> Any:
        v = peak * math.sin(2.0 * math.pi * frequency * t)
        return stiffness * v * np.maximum(1.0 - f / level * np.sign(v), 0.0) ** exponent

    time = PERIOD * np.arange(1, 501)
    friction = solve_ivp(rate, (0.0, time[-1]), [0.0], 'LSODA', time, rtol=1e-9, atol=1e-9,
                         max_step=1e-4).y[0]
    np.testing.assert_allclose(ours, -friction, atol=0.05)


@pytest.mark.parametrize('asymmetry', [0.999999, 1.0])
@pytest.mark.parametrize('ratio', [1.0, 2.0])
def test_friction_of_one_direction_keeps_the_force_bounded(asymmetry: float, ratio: float
                                                           ) -> None:
    values: dict[str, Value] = {
        'friction.model': 'full', 'friction.presliding_slip': 1.0,
        'friction.presliding_exponent': 2.0, 'friction.element_ratio': ratio,
        'friction.stribeck_velocity': 1e-6, 'friction.presliding_stiffness': 1.5e6,
        'friction.coulomb_asymmetry': asymmetry, 'friction.coulomb': 17.0, 'load.type': 'spring'}
    command = np.random.default_rng(2).normal(0.0, 200.0, 3000)
    friction = simulate(as_record(values), command, 1e-3)
    without = simulate(as_record(values | {'friction.coulomb': 0.0}), command, 1e-3)
    assert np.abs(friction.force_n - without.force_n).max() < 200.0


def test_elements_of_a_maxwell_slip_slide_one_after_the_other() -> None:
    # Four of Dahl's bristles side by side, each of which slides after twice the way of the last.
    level, stiffness, ratio, peak, frequency = 20.0, 2e5, 2.0, 0.02, 7.0
    ours = force({'friction.model': 'full', 'friction.presliding_slip': 1.0,
                  'friction.element_ratio': ratio, 'friction.coulomb': level,
                  'friction.stiction_push': level, 'friction.stiction_pull': level,
                  'friction.presliding_stiffness': stiffness, 'friction.presliding_damping': 0.0,
                  'load.velocity': peak, 'load.frequency': frequency}, np.zeros(500))
    shares = np.array([8.0, 4.0, 2.0, 1.0]) / 15.0   # of the stiffness

    def rate(t: float, f: Any) -> Any:
        v = peak * math.sin(2.0 * math.pi * frequency * t)
        return stiffness * shares * v * (1.0 - 4.0 * f / level * np.sign(v))

    time = PERIOD * np.arange(1, 501)
    elements = solve_ivp(rate, (0.0, time[-1]), np.zeros(4), 'LSODA', time, rtol=1e-9, atol=1e-9,
                         max_step=1e-4).y
    np.testing.assert_allclose(ours, -elements.sum(axis=0), atol=0.05)


@pytest.mark.parametrize('softening', [0.5, 1.0])
def test_stiction_that_falls_with_the_stiffness_of_the_seals(softening: float) -> None:
    coulomb, push, pull, stribeck, stiffness = 7.0, 27.0, 15.0, 0.005, 2e5
    peak, frequency = 0.01, 4.0
    ours = force({'friction.model': 'full', 'friction.presliding_slip': 1.0,
                  'friction.softening': softening, 'friction.coulomb': coulomb,
                  'friction.stiction_push': push, 'friction.stiction_pull': pull,
                  'friction.stribeck_velocity': stribeck,
                  'friction.presliding_stiffness': stiffness, 'friction.presliding_damping': 0.0,
                  'load.velocity': peak, 'load.frequency': frequency}, np.zeros(1500))

    def speed(t: Any) -> Any:
        return peak * np.sin(2.0 * np.pi * frequency * t)

    def levels(side: Any, v: Any) -> tuple[Any, Any]:
        held = np.where(side >= 0.0, push, pull)
        sliding = coulomb + (held - coulomb) * np.exp(-(v / stribeck) ** 2)
        return sliding, sliding + softening * (0.5 * (push + pull) - sliding)

    def rate(t: float, z: Any) -> Any:
        v = speed(t)
        return v - stiffness / levels(v, v)[1] * abs(v) * z

    time = PERIOD * np.arange(1, 1501)
    z = solve_ivp(rate, (0.0, time[-1]), [0.0], 'LSODA', time, rtol=1e-9, atol=1e-14,
                  max_step=1e-4).y[0]
    sliding, whole = levels(z, speed(time))
    np.testing.assert_allclose(ours, -stiffness * z * sliding / whole, atol=0.05)


def test_lugre_damps_the_bristle_through_reversals() -> None:
    # F = s0 z + s1 dz/dt, dz/dt = v - s0 |v| z / level (Canudas de Wit et al. 1995), v a sine.
    level, stiffness, damping, peak, frequency = 20.0, 2e5, 400.0, 0.01, 20.0
    ours = force({'friction.model': 'full', 'friction.presliding_slip': 1.0,
                  'friction.coulomb': level, 'friction.stiction_push': level,
                  'friction.stiction_pull': level, 'friction.presliding_stiffness': stiffness,
                  'friction.presliding_damping': damping, 'load.velocity': peak,
                  'load.frequency': frequency}, np.zeros(500))

    def rate(t: float, z: Any) -> Any:
        v = peak * math.sin(2.0 * math.pi * frequency * t)
        return v - stiffness * abs(v) * z / level

    time = PERIOD * np.arange(1, 501)
    z = solve_ivp(rate, (0.0, time[-1]), [0.0], 'LSODA', time, rtol=1e-9, atol=1e-14).y[0]
    slope = np.array([rate(t, each) for t, each in zip(time, z, strict=True)])
    np.testing.assert_allclose(ours, -(stiffness * z + damping * slope), atol=0.05)


SPRING: dict[str, Value] = {'load.type': 'spring', 'load.mass': 2.0, 'load.stiffness': 5e4,
                            'load.damping': 30.0}


def piston(values: dict[str, Value], time: Array, push: float) -> Array:
    """Return the position (m) of the piston pushed by a constant static force (N)."""
    # The command is on from the second period; the first is at rest.
    commands = np.full(time.size, push / GAIN)
    return run(SPRING | values | {'maximum_substep': 5e-6}, commands).position_m


def test_gap_before_the_spring_is_a_dead_zone_of_its_force() -> None:
    time = np.arange(400) * PERIOD
    gap, push = 1e-3, 60.0
    for location in ('spring', 'spring_damper'):
        ours = piston({'backlash.gap': gap, 'backlash.location': location}, time, push)

        def motion(_: float, y: Array, location: str = location) -> list[float]:
            past = y[0] - np.clip(y[0], -0.5 * gap, 0.5 * gap)
            damps = location == 'spring' or past != 0.0
            return [y[1], (push - 5e4 * past - 30.0 * y[1] * damps) / 2.0]

        expected = solve_ivp(motion, (0.0, time[-1]), [0.0, 0.0], t_eval=time, rtol=1e-9,
                             atol=1e-12, max_step=1e-5).y[0]
        np.testing.assert_allclose(ours, expected, atol=2e-3 * np.abs(expected).max())


@pytest.mark.parametrize('gap', [0.0, 4e-4])
def test_load_behind_a_compliance_and_a_gap_moves_as_scipy_says(gap: float) -> None:
    time = np.arange(400) * PERIOD
    push, stiff, damp, share = 60.0, 4e5, 80.0, 0.3
    ours = piston({'coupling.stiffness': stiff, 'coupling.damping': damp,
                   'coupling.piston_share': share, 'backlash.gap': gap}, time, push)

    def motion(_: float, y: Array) -> list[float]:
        apart = y[0] - y[2]
        reach = np.clip(apart, -0.5 * gap, 0.5 * gap)
        touch = stiff * (apart - reach) + damp * (y[1] - y[3])
        if gap and (apart == reach or touch * reach < 0.0):
            touch = 0.0
        return [y[1], (push - touch) / (2.0 * share), y[3],
                (touch - 5e4 * y[2] - 30.0 * y[3]) / (2.0 * (1.0 - share))]

    expected = solve_ivp(motion, (0.0, time[-1]), [0.0] * 4, t_eval=time, rtol=1e-9, atol=1e-12,
                         max_step=1e-5).y[0]
    np.testing.assert_allclose(ours, expected, atol=5e-3 * np.abs(expected).max())


def test_masses_that_collide_keep_their_momentum() -> None:
    # A free piston hits a free load across a gap; no force from outside after the push.
    values: dict[str, Value] = {'load.type': 'free', 'load.mass': 2.0, 'backlash.gap': 1e-3,
                                'coupling.piston_share': 0.25}
    commands = np.zeros(600)
    commands[:10] = 100.0
    ours, finer = (run(values | {'maximum_substep': h}, commands) for h in (25e-6, 5e-6))
    impulse = GAIN * 100.0 * 10 * PERIOD
    # Before it touches the piston alone has the momentum; at the end, in the mean, both.
    first = ours.velocity_m_s[11]
    assert first == pytest.approx(impulse / 0.5, rel=1e-3)
    # An elastic contact gives back what it took, but for the sub-step in which it begins.
    gained, less = (np.abs(each.velocity_m_s[40:]).max() / first - 1.0 for each in (ours, finer))
    assert abs(gained) < 0.005 and abs(less) < 0.001
    assert np.mean(np.diff(ours.position_m[100:]) / PERIOD) == pytest.approx(
        impulse / 2.0, rel=0.15)


def test_push_begins_ends_and_swings() -> None:
    values: dict[str, Value] = {'load.type': 'spring', 'load.mass': 0.01, 'load.stiffness': 1e6,
                                'load.damping': 200.0}
    pulse = run(values | {'load.external_force': 50.0, 'load.external_force_start': 0.02,
                          'load.external_force_end': 0.04}, np.zeros(300)).position_m
    time = np.arange(300) * PERIOD
    assert not pulse[time < 0.0199].any()
    assert pulse[round(0.039 / PERIOD)] == pytest.approx(5e-5, rel=1e-3)
    assert abs(pulse[-1]) < 1e-9
    wave = run(values | {'load.external_force': 50.0, 'load.external_force_frequency': 10.0,
                         'load.external_force_phase': 0.25}, np.zeros(1000)).position_m
    turn = np.exp(-2j * np.pi * 10.0 * np.arange(1000) * PERIOD)
    got = 2.0 * np.mean(wave[500:] * turn[500:])
    w = 2.0 * math.pi * 10.0
    assert abs(got - 50.0 / (1e6 + 200.0j * w - 0.01 * w * w)) < 1e-3 * 5e-5


# --- sensor


def test_drift_is_a_parabola_of_the_time() -> None:
    time = np.arange(1, 501) * PERIOD
    ours = force({'force_sensor.drift': 30.0, 'force_sensor.drift_curve': -50.0}, np.zeros(500))
    np.testing.assert_allclose(ours, 30.0 * time - 50.0 * time**2, atol=1e-9)


def test_lost_readings_hold_the_last_one_and_repeat_with_the_seed() -> None:
    commands = 100.0 * np.sin(np.arange(4000) * 0.05)
    values: dict[str, Value] = {'force_sensor.drop_rate': 0.3}
    ours, plain = force(values, commands), force({}, commands)
    held = ours[1:] == ours[:-1]
    kept = ours == plain
    assert np.all(held | kept[1:])
    assert np.mean(~kept) == pytest.approx(0.3, abs=0.03)
    np.testing.assert_array_equal(ours, force(values, commands))
    other = force(values | {'force_sensor.noise_seed': 2}, commands)
    assert np.any(other != ours)


# --- on a real node


def test_effects_are_switched_on_while_the_node_runs(
        start_node: Callable, states: Any, set_parameters: Callable) -> None:
    start_node('asi_actuator.actuator_node', mode='realtime',
               **{'friction.model': 'linear', 'load.type': 'locked'})
    states.wait_until(lambda m: abs(m.effort[0]) < 1e-6, 'an actuator at rest')
    result, = set_parameters('asi_actuator', {'valve_characteristic.bias': 2e-6})
    assert result.successful
    # 2 um of 20 um: a tenth of the thrust, on the locked structure.
    states.wait_until(lambda m: abs(m.effort[0] - 100.0) < 1.0, 'the force of an open valve')
    result, = set_parameters('asi_actuator', {'force_sensor.drop_rate': 1.5})
    assert not result.successful and 'force_sensor.drop_rate' in result.reason
    assert set_parameters('asi_actuator', {'valve_characteristic.bias': 0.0})[0].successful
    states.wait_until(lambda m: abs(m.effort[0]) < 1.0, 'an actuator at rest again')
