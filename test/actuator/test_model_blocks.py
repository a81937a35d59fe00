"""Each block of the model against an independent reference: closed form or scipy."""

import math
import os
import subprocess
import sys
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import pytest
from scipy import signal
from study import STUDY

from asi_actuator.model.actuator import measure, rest, simulate, step
from asi_actuator.model.delay import delay, delay_steps
from asi_actuator.model.friction import (
    BEFORE,
    SEALS_SHAPE,
    Friction,
    deflected_seals,
    friction,
    quarter_wave,
    settle,
    sliding_friction,
    sliding_share,
)
from asi_actuator.model.hydraulic_damping import (
    damping_curve,
    damping_force,
    saturation,
    tanh,
)
from asi_actuator.model.valve_characteristic import valve_characteristic, valve_position
from asi_actuator.model.valve_hysteresis import AT_ONCE, half_width, magnet_step, magnetise
from asi_actuator.parameters import as_record as record_of
from asi_analysis.loop.closed_loop import close_many, loops_of, simulate_loop
from asi_common.jit import jit
from asi_common.parameter import ParameterError, Value
from asi_controller.compensator import compensate, compensator

PERIOD = 2e-4
BLOCKS = ('valve_hysteresis', 'valve_flexure', 'valve_characteristic', 'hydraulic_damping',
          'fluid_dynamics', 'friction', 'force_sensor')


def as_record(values: Mapping[str, Value] | None = None) -> np.void:
    """Return the record of the study's parameters, which the closed forms below know."""
    return record_of(STUDY | dict(values or {}))


# Every block replaced by its unit gain, the piston held still: force = 0.535 times the command.
NOTHING: dict[str, Value] = {f'{block}.model': 'off' for block in BLOCKS} | {
    'load.type': 'prescribed', 'load.velocity': 0.0}
STATIC_GAIN = float(as_record()['valve_characteristic_gain'])


def force(values: dict[str, Value], commands: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the measured force (N) with only the named parts of the model left in."""
    return simulate(as_record(NOTHING | values), commands, PERIOD).force_n


# --- valve hysteresis


@jit
def _flux(state, commands, p, period):
    out = np.empty(commands.size)
    for i in range(commands.size):
        magnetise(state, commands[i], p, AT_ONCE)
        magnetise(state, commands[i], p, magnet_step(p, period))
        out[i] = state.flux
    return out


def flux(values: dict[str, Value], commands: npt.ArrayLike, period: float
         ) -> npt.NDArray[np.float64]:
    """Return the flux (N) at the end of each period at a command."""
    return _flux(rest(), np.asarray(commands, float), as_record(values), period)


def triangle(amplitude: float, points: int) -> npt.NDArray[np.float64]:
    """Return one period of a triangle wave that begins at 0 and rises."""
    return amplitude * signal.sawtooth(2 * np.pi * (np.arange(points) / points + 0.25), 0.5)


def test_slow_loop_area_is_that_of_a_play() -> None:
    command = np.tile(triangle(300.0, 4000), 2)
    out = flux({}, command, 1.0)  # 0.3 N/s: at rest, as far as the rate goes
    u, y = command[4000:], out[4000:]
    # A play of half width r driven between +-A encloses 4 r (A - r).
    # Its area is the energy lost in a cycle, so the output lags and the sign is plus.
    area = np.sum(0.5 * (u + np.roll(u, 1)) * (y - np.roll(y, 1)))
    assert area == pytest.approx(4 * 14.0 * (300.0 - 14.0), rel=2e-3)


def test_half_width_grows_with_the_rate_as_the_formula_says() -> None:
    p = as_record()
    for rate in (0.0, 1e3, 1.9e5, -1e6):
        width = 14.0 + 0.654e-3 * abs(rate) * (abs(rate) / 1.9e5) ** 0.05
        assert half_width(rate, p) == pytest.approx(width, rel=1e-14)


def test_ramp_is_followed_at_the_half_width_of_its_rate() -> None:
    rate, period = 1e5, 1e-7
    command = rate * period * np.arange(40000)
    lag = command[-1] - flux({}, command, period)[-1]
    assert lag == pytest.approx(14.0 + 0.654e-3 * rate * (rate / 1.9e5) ** 0.05, rel=2e-3)


def test_flux_lags_behind_the_play_as_a_first_order_lag_does() -> None:
    """A step by 300 N: the play jumps at once, what lags follows with the time constant."""
    values = {'valve_hysteresis.radius': 14.0, 'valve_hysteresis.lag_time': 2e-3,
              'valve_hysteresis.model': 'full', 'valve_hysteresis.lagged': 1.0,
              'valve_hysteresis.saturation': 1e6}
    period = 2e-5
    force_n = simulate(as_record(NOTHING | values), np.full(400, 300.0), period).force_n
    time = period * np.arange(400)
    np.testing.assert_allclose(
        force_n, STATIC_GAIN * 286.0 * -np.expm1(-time / 2e-3), atol=1e-6)


@pytest.mark.parametrize('off', [
    {'valve_hysteresis.lagged': 0.0}, {'valve_hysteresis.lag_time': 0.0},
    {'valve_hysteresis.model': 'linear'}], ids=str)
def test_a_lag_that_is_switched_on_begins_where_the_flux_is(off: dict[str, Value]) -> None:
    lags = {'valve_hysteresis.lagged': 1.0, 'valve_hysteresis.lag_time': 5e-3,
            'valve_hysteresis.radius': 0.0, 'valve_hysteresis.saturation': 1e6}
    before, after = as_record(lags | off), as_record(lags)
    state = rest()
    for _ in range(3):
        magnetise(state, 400.0, before, magnet_step(before, 1e-3))
    assert magnetise(state, 400.0, after, magnet_step(after, 1e-3)) == pytest.approx(400.0)


def test_no_lag_time_is_no_lag_whatever_its_share() -> None:
    values = {'valve_hysteresis.lag_time': 0.0, 'load.type': 'spring'}
    command = 200.0 * np.sin(2.0 * np.pi * 30.0 * PERIOD * np.arange(200))
    plain, shared = (simulate(as_record(values | {'valve_hysteresis.lagged': share}), command,
                              PERIOD).force_n for share in (0.0, 1.0))
    np.testing.assert_array_equal(shared, plain)


def test_ramp_is_followed_by_a_lag_as_by_a_growing_width() -> None:
    """Where the width grows in proportion to the rate, a ramp cannot tell the two."""
    commands = 1e5 * 1e-6 * np.arange(20000)
    width, lag = (simulate(as_record(NOTHING | {
        'valve_hysteresis.model': 'full', 'valve_hysteresis.rate_exponent': 0.0,
        'valve_hysteresis.rate_filter': 10.0, 'valve_hysteresis.saturation': 1e6,
        'valve_hysteresis.lagged': share}),
        commands, 1e-5).valve_position_m[-1] for share in (0.0, 1.0))
    assert lag == pytest.approx(width, rel=1e-4)


def test_minor_loop_closes_and_the_major_loop_forgets_it() -> None:
    up, back = np.linspace(0, 300, 600), np.linspace(300, 100, 400)
    through = flux({}, np.concatenate([up, back, np.linspace(100, 300, 400)]), 1.0)
    assert through[-1] == pytest.approx(through[599], abs=1e-6)
    assert through[599] - through[999] == pytest.approx(200.0 - 2 * 14.0, abs=0.6)


def test_rounded_loop_has_the_width_and_slope_of_one_play() -> None:
    single = {'valve_hysteresis.lag_time': 0.0, 'valve_hysteresis.radius': 40.0,
              'valve_hysteresis.saturation': 1e6}
    u = way(0, 300, -300, 300, 280)
    plain, rounded = (drive(single | {'valve_hysteresis.rounding': share}, u)
                      for share in (0.0, 1.0))
    down, up = 300 + 300, 300 + 600 + 300   # at 0, on the way down and up
    assert plain[down] - plain[up] == pytest.approx(80.0, abs=1.5)
    assert rounded[down] - rounded[up] == pytest.approx(80.0, abs=1.5)
    # After a turn a single play sticks; the mean of plays up to twice as wide does not.
    assert plain[-1] == plain[-21]
    assert rounded[-1] < rounded[-21] - 1.0


WIDENING = {'valve_hysteresis.lag_time': 0.0, 'valve_hysteresis.radius': 10.0,
            'valve_hysteresis.saturation': 1e6, 'valve_hysteresis.widening': 2.0,
            'valve_hysteresis.widening_range': 800.0}


@jit
def _drive(state, commands, p):
    out = np.empty(commands.size)
    for i in range(commands.size):
        out[i] = magnetise(state, commands[i], p, AT_ONCE)
    return out


def drive(values: dict[str, Value], commands: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the drive (N) at each command of a static loop."""
    return _drive(rest(), np.asarray(commands, float), as_record(values))


def way(*turns: float) -> npt.NDArray[np.float64]:
    """Return commands by 1 N from turn to turn."""
    return np.concatenate([np.linspace(a, b, round(abs(b - a)), endpoint=False)
                           for a, b in zip(turns[:-1], turns[1:], strict=True)] + [[turns[-1]]])


def test_widening_loop_is_rayleighs() -> None:
    """Its area grows with the cube of the amplitude, its slope in proportion to that."""
    for amplitude in (400.0, 800.0):
        values = WIDENING | {'valve_hysteresis.radius': 0.0}
        u = way(0.0, amplitude, -amplitude, amplitude)
        y = drive(values, u)
        last = slice(-round(4 * amplitude) - 1, None)
        area = np.trapezoid(y[last], u[last])
        slope = 2.0 / 800.0
        assert -area == pytest.approx(2.0 / 3.0 * slope * amplitude**3, rel=0.05)
        # Eight plays are Rayleigh's law in steps.
        assert y[-1] / amplitude == pytest.approx(1.0 + 0.5 * slope * amplitude, rel=0.01)


def test_widening_loop_forgets_minor_loops_and_they_are_congruent() -> None:
    # Wiped out: after 600, the way over 200 and -100 is forgotten.
    assert drive(WIDENING, way(0, 600, 200, 450, -100, 700))[-1] == pytest.approx(
        drive(WIDENING, way(0, 700))[-1], abs=1e-9)
    # Congruent: loops between 100 and 400 have one shape, whether reached from above or below.
    loops = [drive(WIDENING, way(0, *before, 100, 400, 100, 400))[-601:]
             for before in ((900,), (-900,), (500, -300))]
    for loop in loops[1:]:
        np.testing.assert_allclose(loop - loop[0], loops[0] - loops[0][0], atol=1e-9)
    assert abs(loops[0][0] - loops[1][0]) > 50.0


def test_widening_loop_is_static_and_costs_nothing_when_null() -> None:
    u = way(0, 700, -300, 500)
    slowly = np.repeat(u, 7)
    np.testing.assert_array_equal(drive(WIDENING, slowly)[6::7], drive(WIDENING, u))
    null = WIDENING | {'valve_hysteresis.widening': 0.0}
    np.testing.assert_array_equal(drive(null, u), drive(
        null | {'valve_hysteresis.widening_from': 50.0}, u))


# --- linear dynamics


def test_sensor_steps_as_scipy_does() -> None:
    time = np.arange(80) * PERIOD
    ours = force({'force_sensor.model': 'full', 'force_sensor.card_frequency': 1e5,
                  'maximum_substep': 2e-6, 'force_sensor.delay': 4e-4}, np.full(80, 100.0))
    w = 2 * np.pi * 800.0
    fine = np.arange(16000) * 1e-6
    unit = signal.step((w**2, [1, 2 * 0.7 * w, w**2]), T=fine)[1]
    # The delay is two whole periods; the card at 100 kHz delays by 2.25 us more.
    theirs = STATIC_GAIN * 100.0 * np.interp(time[:-2] - 2.25e-6, fine, unit)
    np.testing.assert_allclose(ours[2:], theirs, atol=0.01)
    assert not ours[:2].any()


@pytest.mark.parametrize('frequency', [20.0, 90.0, 400.0])
def test_flexure_responds_as_its_transfer_function(frequency: float) -> None:
    period, delay_s = 2.5e-5, 1.003e-3
    time = np.arange(round(0.4 / period)) * period
    p = as_record(NOTHING | {'valve_flexure.model': 'full'})
    out = simulate(p, np.sin(2 * np.pi * frequency * time), period).force_n
    settled = time >= 0.4 - 5 / frequency - 1e-9
    wave = np.exp(-2j * np.pi * frequency * time[settled])
    ours = 2j * np.mean(out[settled] * wave)
    s = 2j * np.pi * frequency
    w = 2 * np.pi * 890.0
    # The command is held for a period: half of it is delay, too.
    theirs = (STATIC_GAIN / (1 + s / (2 * np.pi * 26.1)) * w**2 / (s**2 + 2 * 0.359 * w * s + w**2)
              * np.exp(-s * (delay_s + period / 2)))
    assert abs(ours / theirs - 1) < 2e-3


def test_fluid_is_a_first_order_lag() -> None:
    ours = force({'fluid_dynamics.model': 'full'}, np.full(30, 100.0))
    time = np.arange(30) * PERIOD
    np.testing.assert_allclose(
        ours, STATIC_GAIN * 100.0 * (1 - np.exp(-2 * np.pi * 1000.0 * time)), atol=1e-10)


@pytest.mark.parametrize('delay_s', [0.0, 1e-5, 3.3e-5, 1e-3, 1.0037e-3])
def test_delay_is_exact_for_ramps(delay_s: float) -> None:
    h, ring = 1e-5, np.zeros(1024)
    steps = delay_steps(delay_s, h)
    out = [delay(ring, i % 1024, 5.0 + 2.0 * i, steps) for i in range(3000)]
    expected = 5.0 + 2.0 * (np.arange(3000) - delay_s / h)
    np.testing.assert_allclose(out[200:], expected[200:], rtol=1e-12)


def test_delay_longer_than_the_ring_is_refused() -> None:
    as_record({'valve_flexure.delay': 0.01, 'force_sensor.delay': 0.01})
    with pytest.raises(ParameterError, match=r'force_sensor\.delay = 0\.006 .* at most 0\.00511'):
        as_record({'force_sensor.delay': 0.006, 'maximum_substep': 1e-5})
    with pytest.raises(ParameterError, match='a control period of 5e-06 s is not allowed'):
        simulate(as_record(), [0.0], 5e-6)


# --- static characteristic


def test_characteristic_is_linear_then_saturates() -> None:
    p = as_record()
    command = np.linspace(-4000, 4000, 801)
    ours = [valve_characteristic(valve_position(u, p), p) for u in command]
    np.testing.assert_allclose(ours, np.clip(STATIC_GAIN * command, -1000, 1000), rtol=1e-12)


# --- hydraulic damping


def test_tanh_is_the_hyperbolic_tangent() -> None:
    for x in (-800.0, -3.0, -1e-9, 0.0, 0.3, 20.0, 800.0):
        assert tanh(x) == pytest.approx(math.tanh(x), abs=4e-16)


def test_damping_is_odd_bounded_passive_and_its_slope_is_its_derivative() -> None:
    p = as_record()
    for opening in np.linspace(-1, 1, 9):
        curve, mirrored = damping_curve(opening, p), damping_curve(-opening, p)
        for v in np.linspace(-2, 2, 41):
            value, slope = damping_force(v, curve, p)
            assert damping_force(-v, mirrored, p)[0] == pytest.approx(-value, abs=1e-9)
            assert v * value >= 0 and abs(value) <= 1200.0
            numerical = (damping_force(v + 1e-6, curve, p)[0]
                         - damping_force(v - 1e-6, curve, p)[0]) / 2e-6
            assert slope == pytest.approx(numerical, abs=1e-4)


# --- friction


def seal_force(positions: npt.NDArray[np.float64], h: float,
               values: dict[str, Value] | None = None) -> npt.NDArray[np.float64]:
    """Return the friction (N) at the end of each of equal sub-steps between the positions."""
    p, seals, out = as_record(values or {}), np.zeros(SEALS_SHAPE), []
    velocity = np.diff(positions) / h
    ends = np.append(0.5 * (velocity[1:] + velocity[:-1]), velocity[-1])
    for mean, end in zip(velocity, ends, strict=True):
        out.append(friction(seals, mean, end, p, h).force)
        settle(seals, 0.0, p)
    return np.array(out)


def test_slow_pull_and_push_break_away_at_the_published_forces() -> None:
    slow = np.linspace(0, 5e-4, 2000)  # 0.25 mm/s
    assert seal_force(slow, 1e-3).max() == pytest.approx(27.0, rel=0.01)
    assert seal_force(-slow, 1e-3).min() == pytest.approx(-15.0, rel=0.01)
    fast = np.linspace(0, 0.1, 2000)  # 50 mm/s, ten Stribeck velocities
    assert seal_force(fast, 1e-3)[-1] == pytest.approx(7.0, rel=1e-3)
    assert seal_force(-fast, 1e-3)[-1] == pytest.approx(-7.0, rel=1e-3)


def test_elastoplastic_law_is_that_of_dupont() -> None:
    angles = np.linspace(-1.0, 1.0, 20001)
    np.testing.assert_allclose([quarter_wave(x) for x in angles], np.sin(0.5 * np.pi * angles),
                               rtol=0.0, atol=1e-15)
    shares = [sliding_share(along) for along in (-1.0, 0.0, 0.7, 0.775, 0.85, 1.0, 3.0)]
    np.testing.assert_allclose(shares, [0.0, 0.0, 0.0, 0.5 - math.sqrt(0.125), 0.5, 1.0, 1.0],
                               rtol=0.0, atol=1e-15)
    assert shares[2] == 0.0 and shares[5] == 1.0   # a held piston neither creeps nor slides late


@pytest.mark.parametrize('changed', [{'friction.softening': 1.0}, {'friction.element_ratio': 2.0},
                                     # Such an end is approached as 1 / way.
                                     {'friction.presliding_slip': 1.0,
                                      'friction.presliding_exponent': 2.0,
                                      'friction.presliding_stiffness': 1e7}])
@pytest.mark.parametrize('velocity', [
    -2e-3, 0.1, pytest.param(2e-3, marks=pytest.mark.slow)])
def test_steady_friction_does_not_depend_on_how_sliding_begins(
        changed: dict[str, Value], velocity: float) -> None:
    path = velocity * np.linspace(0.0, 10.0, 10001)
    assert seal_force(path, 1e-3, changed)[-1] == pytest.approx(
        math.copysign(sliding_friction(velocity, as_record()), velocity), rel=2e-3)


@pytest.mark.parametrize('changed', [
    {'friction.softening': 1.0}, {'friction.softening': 0.7, 'friction.element_ratio': 1.5}])
@pytest.mark.parametrize('velocity', [3e-3, -3e-3, 6e-3])
def test_slope_of_friction_that_softens_is_its_derivative(
        changed: dict[str, Value], velocity: float) -> None:
    p = as_record({'friction.presliding_slip': 1.0, 'friction.presliding_damping': 0.0} | changed)
    before, h = 2e-4 * np.sign(velocity), 1e-4

    def at(end: float) -> Friction:
        return friction(deflected_seals(before, p), 0.5 * (velocity + end), end, p, h)

    step = 1e-7
    numerical = (at(velocity + step).force - at(velocity - step).force) / (2.0 * step)
    # How the limit of the deflection changes with the velocity is left out.
    assert at(velocity).slope == pytest.approx(numerical, rel=0.02, abs=1.0)


def test_softening_needs_a_friction_that_depends_on_velocity_or_direction() -> None:
    values: dict[str, Value] = dict.fromkeys(
        ('friction.coulomb', 'friction.stiction_push', 'friction.stiction_pull'), 20.0)
    path = np.linspace(0.0, 2e-3, 400)
    np.testing.assert_array_equal(seal_force(path, 1e-3, values | {'friction.softening': 1.0}),
                                  seal_force(path, 1e-3, values))


def test_seals_that_soften_in_one_direction_are_deflected_as_in_the_other() -> None:
    values: dict[str, Value] = {
        'friction.coulomb': 20.0, 'friction.stiction_push': 5.0, 'friction.stiction_pull': 5.0,
        'friction.stribeck_velocity': 1e-6, 'friction.presliding_damping': 0.0}
    path = 1e-3 * np.sin(np.linspace(0.0, 20.0, 2000)) + 4e-4 * np.sin(np.linspace(0, 70.0, 2000))
    alike = seal_force(path, 1e-3, values)
    ours = seal_force(path, 1e-3, values | {
        'friction.coulomb_asymmetry': -0.4, 'friction.softening': 1.0})
    np.testing.assert_allclose(ours, alike * np.where(alike >= 0.0, 0.6, 1.4), atol=1e-5)
    hard = seal_force(path, 1e-3, values | {'friction.coulomb_asymmetry': -0.4})
    assert np.abs(hard - ours).max() > 5.0   # with the deflection: another law


@pytest.mark.parametrize('pull', [1.5e-201, 1e-310, 0.0])
@pytest.mark.parametrize('velocity', [-1e-3, 0.0, 1e-9, 0.2])
def test_the_slope_of_a_tiny_friction_that_softens_is_finite(pull: float, velocity: float) -> None:
    p = as_record({'friction.coulomb': 0.0, 'friction.stiction_push': 0.0,
                   'friction.stiction_pull': pull, 'friction.softening': 1.0})
    assert np.isfinite(friction(np.zeros(SEALS_SHAPE), velocity, velocity, p, 1e-4)).all()


def test_elements_that_are_switched_off_are_forgotten() -> None:
    seals = deflected_seals(1e-3, as_record({'friction.element_ratio': 3.0}))
    p = as_record()
    friction(seals, -0.1, -0.1, p, 1e-3)
    settle(seals, 0.0, p)
    assert not seals[BEFORE, 1:].any()


def test_seals_are_a_spring_before_they_slide() -> None:
    path = np.linspace(0, 2e-5, 100)  # to 4 N
    forth = seal_force(np.concatenate([path, path[::-1]]), 1.0)
    np.testing.assert_allclose(forth[98], 2e5 * 2e-5, rtol=1e-3)
    assert abs(forth[-1]) < 1e-2


@pytest.mark.parametrize(('amplitude', 'frequency'), [
    (5e-3, 1.0), (2e-4, 100.0), *(pytest.param(*each, marks=pytest.mark.slow) for each in (
        (1e-5, 1.0), (2e-4, 1.0), (1e-5, 100.0), (5e-3, 100.0)))])
def test_friction_dissipates_over_a_closed_cycle(amplitude: float, frequency: float) -> None:
    phase = np.linspace(0, 6 * np.pi, 9001)
    path = amplitude * np.sin(phase)
    h = (phase[1] - phase[0]) / (2 * np.pi * frequency)
    out = seal_force(path, h)
    power = 0.5 * (out + np.concatenate([[0], out[:-1]])) * np.diff(path)
    last = power[6000:].sum()
    assert last > -1e-9
    if amplitude == 5e-3 and frequency == 1.0:
        # Sliding all the way at up to 31 mm/s: Coulomb friction and the Stribeck rise at the ends.
        velocity = np.gradient(path, h)
        steady = sum(sliding_friction(v, as_record()) * abs(v) * h for v in velocity[6000:])
        assert last == pytest.approx(steady, rel=0.05)


@pytest.mark.parametrize(('slip', 'exponent', 'softening', 'ratio'), [
    (0.0, 1.0, 0.0, 1.0), (1.0, 1.0, 0.0, 1.0), (1.0, 0.6, 0.0, 1.0), (1.0, 2.0, 0.0, 1.0),
    (0.5, 1.4, 0.0, 1.0), (0.5, 1.0, 1.0, 1.0), (0.5, 1.0, 0.5, 1.0), (1.0, 1.0, 1.0, 1.8)])
def test_friction_converges_with_the_second_order_while_the_seals_begin_to_slide(
        slip: float, exponent: float, softening: float, ratio: float) -> None:
    p = as_record({
        'friction.presliding_slip': slip, 'friction.presliding_exponent': exponent,
        'friction.softening': softening, 'friction.element_ratio': ratio})

    def seal(substeps: int) -> float:
        time = np.linspace(0.0, 0.02, substeps + 1)
        path = 1.25e-4 * np.sin(0.5 * np.pi * time / time[-1])
        seals = np.zeros(SEALS_SHAPE)
        for velocity in np.diff(path) / time[1]:
            friction(seals, velocity, velocity, p, time[1])
            settle(seals, 0.0, p)
        return float(seals[BEFORE].sum())

    fine = seal(3200)
    errors = [seal(n) - fine for n in (100, 200, 400)]
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), 2.0, atol=0.3)


def test_vibration_below_breakaway_does_not_creep() -> None:
    values: dict[str, Value] = {'load.type': 'free', 'valve_hysteresis.model': 'off'}
    time = np.arange(5000) * PERIOD

    def creep(mean_n: float) -> float:
        command = (mean_n + 1.5 * np.sin(2 * np.pi * 20 * time)) / STATIC_GAIN
        position = simulate(as_record(values), command, PERIOD).position_m
        return abs(position[-1000:].mean() - position[1000:2000].mean())

    # The seals stay elastic below 0.7 of the Coulomb friction; well above it they must slide.
    assert creep(2.5) < 1e-9
    assert creep(30.0) > 1e-3


@pytest.mark.parametrize('changed', [
    {}, {'friction.softening': 1.0}, {'friction.element_ratio': 2.0},
    {'friction.softening': 1.0, 'friction.stribeck_velocity': 1e-4}])
def test_a_piston_that_friction_holds_does_not_creep(changed: dict[str, Value]) -> None:
    values: dict[str, Value] = {'load.type': 'spring', 'valve_hysteresis.model': 'off'}
    command = 20.0 * np.minimum(np.arange(3000) / 1000.0, 1.0)
    position = simulate(as_record(values | changed), command, 1e-3).position_m
    assert abs(position[-1] - position[-1000]) < 1e-12


# --- load


LINEAR: dict[str, Value] = NOTHING | {'maximum_substep': 1e-5}


def mass_spring(values: dict[str, Value], mass: float, stiffness: float, damper: float,
                push: float) -> None:
    """Compare position and velocity under a constant push with scipy's exact solution."""
    run = simulate(as_record(LINEAR | {'load.external_force': push, 'load.mass': mass} | values),
                   np.zeros(500), PERIOD)
    system = ([[0, 1], [-stiffness / mass, -damper / mass]], [[0], [1 / mass]], np.eye(2),
              np.zeros((2, 1)))
    exact = signal.lsim(system, np.full(500, push), run.time_s)[1]
    for ours, theirs in zip((run.position_m, run.velocity_m_s), exact.T, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=2e-3 * np.abs(theirs).max())


def test_spring_load_moves_as_scipy_says() -> None:
    mass_spring({'load.type': 'spring', 'load.stiffness': 2e5, 'load.damping': 60.0},
                0.5, 2e5, 60.0, 100.0)


def test_locked_load_moves_as_scipy_says() -> None:
    mass_spring({'load.type': 'locked', 'load.locked_damping': 400.0}, 0.5, 1.12e6, 400.0, 100.0)


def test_free_load_moves_as_scipy_says() -> None:
    mass_spring({'load.type': 'free'}, 0.5, 0.0, 0.0, 1.0)


def test_undamped_load_keeps_its_energy() -> None:
    values = LINEAR | {'load.type': 'spring', 'load.damping': 0.0, 'load.mass': 0.5}
    state = rest()
    state['velocity'] = 0.3
    run = simulate(as_record(values), np.zeros(2500), PERIOD, state)
    energy = 0.5 * 0.5 * run.velocity_m_s**2 + 0.5 * 2e5 * run.position_m**2
    np.testing.assert_allclose(energy, 0.5 * 0.5 * 0.09, rtol=1e-9)


def test_prescribed_motion_drives_the_damping_back() -> None:
    values = NOTHING | {'hydraulic_damping.model': 'full', 'load.velocity': 0.3}
    p = as_record(values)
    run = simulate(p, np.zeros(100), PERIOD)
    np.testing.assert_allclose(run.position_m, 0.3 * run.time_s, atol=1e-12)
    expected = -damping_force(0.3, damping_curve(0.0, p), p)[0]
    np.testing.assert_allclose(run.force_n[1:], expected, rtol=1e-12)


# --- force sensor: gain, offset, noise


def test_sensor_gain_and_offset_act_on_the_reading() -> None:
    out = force({'force_sensor.gain': 1.5, 'force_sensor.offset': -7.0}, np.full(3, 100.0))
    np.testing.assert_allclose(out, [-7.0, *[1.5 * STATIC_GAIN * 100.0 - 7.0] * 2])


def test_sensor_noise_is_white_normal_and_repeats_with_its_seed() -> None:
    noisy: dict[str, Value] = {'force_sensor.noise': 2.0}
    noise = force(noisy, np.zeros(20000))
    assert np.array_equal(noise, force(noisy, np.zeros(20000)))
    other = force(noisy | {'force_sensor.noise_seed': 2}, np.zeros(20000))
    n = noise.size
    # Four standard errors each: the seed is fixed, so this cannot fail by chance.
    assert abs(noise.mean()) < 4 * 2.0 / n**0.5
    assert noise.std() == pytest.approx(2.0, rel=4 / (2 * n)**0.5)
    assert abs(np.mean(noise**4) / noise.std()**4 - 3) < 4 * (24 / n)**0.5
    for lag in (1, 2, 3, 10, 100):
        assert abs(np.mean(noise[lag:] * noise[:-lag])) / 4.0 < 4 / n**0.5
    assert abs(np.mean(noise * other)) / 4.0 < 4 / n**0.5


@pytest.mark.parametrize('load', [
    {'load.type': 'locked'}, {'load.type': 'spring', 'load.mass': 3.0}], ids=str)
def test_sensor_before_or_behind_the_mass(load: dict[str, Value]) -> None:
    """Behind all of the mass it feels the spring, before it the mass's inertia as well."""
    p = as_record(load | {'force_sensor.model': 'off', 'force_sensor.mass_share': 1.0})
    stiffness, damper = ((p['load_locked_stiffness'], p['load_locked_damping'])
                         if load['load.type'] == 'locked'
                         else (p['load_stiffness'], p['load_damping']))
    commands = np.where(np.arange(300) > 5, 400.0, 0.0)
    run = simulate(p, commands, PERIOD)
    spring = stiffness * run.position_m + damper * run.velocity_m_s
    np.testing.assert_allclose(run.force_n, spring, atol=1e-9)
    p['force_sensor_mass_share'] = 0.0
    before = simulate(p, commands, PERIOD).force_n
    p['force_sensor_mass_share'] = 0.25
    np.testing.assert_allclose(simulate(p, commands, PERIOD).force_n,
                               0.75 * before + 0.25 * spring, atol=1e-9)
    inertia = p['load_mass'] * np.gradient(run.velocity_m_s, PERIOD)
    np.testing.assert_allclose((before - spring)[20:-20], inertia[20:-20],
                               atol=0.03 * np.abs(inertia).max())


def test_sensor_of_a_moved_mass_feels_its_share_of_the_inertia() -> None:
    moved: dict[str, Value] = {'load.type': 'prescribed', 'load.velocity': 0.01,
                               'load.frequency': 50.0, 'load.mass': 2.0}
    commands = np.zeros(200)
    all_, none = (force(moved | {'force_sensor.mass_share': share}, commands)
                  for share in (0.0, 1.0))
    w = 2.0 * math.pi * 50.0
    np.testing.assert_allclose((all_ - none)[1:],
                               2.0 * 0.01 * w * np.cos(w * PERIOD * np.arange(1, 200)), atol=1e-9)


# --- switches


@pytest.mark.parametrize('block', [
    'valve_hysteresis', 'valve_flexure', 'valve_characteristic', 'fluid_dynamics', 'force_sensor'])
def test_linear_block_is_its_gain_and_a_block_that_is_off_passes(block: str) -> None:
    command = np.array([100.0, -50.0, 3000.0, 0.0])
    expected = STATIC_GAIN * np.concatenate([[0.0], command[:-1]])
    np.testing.assert_allclose(force({}, command), expected)
    linear_ = {f'{block}.model': 'linear', f'{block}.linear_gain': 0.7}
    np.testing.assert_allclose(force(linear_, command), 0.7 * expected)


@pytest.mark.parametrize(('tail', 'expected'), [
    (-1.0, lambda x: math.erf(0.5 * math.sqrt(math.pi) * x)), (0.0, math.tanh),
    (1.0, lambda x: x / math.hypot(1.0, x)),
    (2.0, lambda x: 2.0 / math.pi * math.atan(0.5 * math.pi * x)),
    (-0.3, None), (0.6, None), (1.4, None)])
def test_damping_saturates_as_several_books_have_it(tail, expected):
    """Always monotonically, at -1 and 1, with slope 1 at 0."""
    x = np.linspace(-6.0, 6.0, 2401)
    values, slopes = np.array([saturation(each, tail) for each in x]).T
    assert np.abs(values).max() < 1.0 + 1e-12 and slopes.min() >= 0.0
    assert saturation(0.0, tail) == (0.0, 1.0)
    assert np.allclose(np.gradient(values, x)[1:-1], slopes[1:-1], atol=1e-4)
    if expected:
        assert values == pytest.approx([expected(each) for each in x], abs=1e-14)


@pytest.mark.parametrize('block', ['hydraulic_damping', 'friction'])
def test_linear_damping_and_friction_are_viscous(block: str) -> None:
    values = {f'{block}.model': 'linear', f'{block}.linear_gain': 30.0, 'load.velocity': 0.2}
    np.testing.assert_allclose(force(values, np.zeros(3)), [0.0, -6.0, -6.0], atol=1e-12)
    assert not force({'load.velocity': 0.2}, np.zeros(3)).any()


# --- ways to run the same code


def test_step_by_step_and_simulate_agree_to_the_bit() -> None:
    commands = np.random.default_rng(3).normal(0, 800, 400)
    values: dict[str, Value]
    for values in ({}, {'load.type': 'spring', 'force_sensor.noise': 1.0},
                   {'valve_flexure.model': 'off'}):
        p = as_record(values)
        whole = simulate(p, commands, PERIOD)
        state, stepped = rest(), []
        for command in commands:
            stepped.append(measure(state, p))
            step(state, command, p, PERIOD)
        assert np.array_equal(np.array(stepped), np.stack(whole[2:]).T)


def test_loop_in_one_process_is_measure_compensate_and_step() -> None:
    actuator: dict[str, Value] = STUDY | {'load.type': 'spring', 'force_sensor.noise': 0.5}
    gains: dict[str, Value] = {'compensator': 'lead_lag', 'gain': 18.0, 'integrator.rate': 5.0,
                               'velocity_feedforward.share': 0.3}
    whole = simulate_loop(
        actuator, gains | {'reference.shape': 'sine', 'reference.frequency': 15.0}, 0.2)
    p, state, c = as_record(actuator), rest(), compensator(gains, 5000.0)
    for k, reference in enumerate(whole.reference_n):
        force_n, _, _, velocity = measure(state, p)
        command = compensate(c, reference, force_n, velocity)
        assert (force_n, command) == (whole.force_n[k], whole.command_n[k])
        step(state, command, p, 1.0 / 5000.0)


def test_loops_side_by_side_do_what_each_does_alone_to_the_bit() -> None:
    sine: dict[str, Value] = {'reference.shape': 'sine', 'reference.frequency': 15.0}
    actuators: list[dict[str, Value]] = [{'force_sensor.noise': 0.1 * k} for k in range(40)]
    controllers = [{'gain': 2.0 + k} | sine for k in range(40)]
    for k, signals in enumerate(close_many(loops_of(actuators, controllers, 5000.0), 0.1)):
        alone = simulate_loop(actuators[k], controllers[k], 0.1)
        assert np.array_equal(signals, np.stack(alone[1:]))
    # In two goes, of which only an end is kept.
    loops = loops_of(actuators, [{'gain': 2.0 + k} for k in range(40)], 5000.0)
    twice = loops_of(actuators, [{'gain': 2.0 + k} for k in range(40)], 5000.0)
    loops.plants['load_external_force'] = twice.plants['load_external_force'] = 100.0
    whole = close_many(loops, 0.1)
    assert close_many(twice, 0.06, 0.0).shape == (40, 6, 0)
    assert np.array_equal(close_many(twice, 0.04, 0.01), whole[:, :, -50:])


SHORT_RUN = """
import numpy as np
from asi_actuator.model.actuator import rest, simulate
from asi_actuator.parameters import as_record
def attributes(record):  # which compiled code reads as attributes, interpreted code too
    return np.array([record]).view(np.recarray)[0]
commands = np.random.default_rng(3).normal(0, 800, 12)
for values in ({}, {'load.type': 'spring', 'force_sensor.noise': 1.0}):
    p = attributes(as_record(values))
    for row in simulate(p, commands, 2e-4, attributes(rest())):
        print(*(float(x).hex() for x in row))
"""


def test_compiled_and_interpreted_code_agree_to_the_bit() -> None:
    def run(disable: str) -> str:
        environment = os.environ | {'NUMBA_DISABLE_JIT': disable}
        return subprocess.run([sys.executable, '-c', SHORT_RUN], env=environment, check=True,
                              capture_output=True, text=True).stdout
    assert run('1') == run('0') != ''
