"""The figures of a force loop by which `asi tune` searches and `asi compare` compares."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.loop.closed_loop import Values, close_many, loops_of
from asi_analysis.measures.oscillation import amplitude_at

SIZES_N: Final = (20.0, 50.0, 100.0, 200.0, 300.0, 500.0, 700.0)
BAND_HZ: Final = (20.0, 40.0, 60.0, 80.0, 100.0)
# Velocity (m/s) and frequency (Hz) of the motions by which a user feels the actuator.
MOTIONS: Final = {'felt_force_slow_n': (0.2, 1.0), 'felt_force_fast_n': (0.5, 2.0)}
# Frequencies (Hz) and velocities (m/s) at which the apparent impedance is computed. A loop with
# integrator and velocity feed-forward is the least passive at 4 to 6 Hz, in fast motion.
IMPEDANCE_HZ: Final = (1.0, 2.0, 4.0, 6.0, 10.0, 20.0, 50.0)
IMPEDANCE_M_S: Final = (0.02, 0.1, 0.4)
# Duration of a step, and rest before it: a compensator starts in the steady state.
STEP_S: Final = 0.4
BEFORE_S: Final = 0.01
# Negative real part of the impedance (N s/m) that counts as much as a factor e of another figure;
# sensor noise (N).
IMPEDANCE_SCALE: Final = 100.0
NOISE_N: Final = 1.0
DIVERGED: Final = 1e6


class Row(NamedTuple):
    """A figure: its unit, the value to reach, and whether more is better."""

    name: str
    unit: str
    goal: float
    text: str
    more: bool = False


ROWS: Final = (
    Row('settling_median_s', 's', 0.015, 'settling to 2 % of steps of 20 to 700 N, median'),
    Row('settling_worst_s', 's', 0.030, 'the same, worst'),
    Row('overshoot_percent', '%', 5.0, 'overshoot of the same, worst'),
    Row('steady_state_error_n', 'N', 0.1, 'steady-state error of the same, worst'),
    Row('sine_error_percent', '%', 12.0, 'error on a sine of 10 Hz and 100 N, rms'),
    Row('gain_100_hz_db', 'dB', -3.0, 'least gain up to 100 Hz at 50 N', True),
    Row('peak_db', 'dB', 2.0, 'largest gain at 50 N'),
    Row('felt_force_slow_n', 'N', 30.0, 'felt force, moved at 0.2 m/s and 1 Hz'),
    Row('felt_force_fast_n', 'N', 80.0, 'felt force, moved at 0.5 m/s and 2 Hz'),
    Row('noise_gain', 'N/N', 100.0, 'command per sensor noise, rms'),
    Row('least_re_z_n_s_m', 'N s/m', 0.0, 'least real part of the impedance, 1 to 50 Hz', True),
)


def _harmonic(values: Array, frequency_hz: float, rate_hz: float) -> complex:
    """Return the complex amplitude at a frequency, over at least one period and about 0.2 s."""
    periods = max(1, round(0.2 * frequency_hz))
    return amplitude_at(values[-round(periods * rate_hz / frequency_hz):], frequency_hz, rate_hz)


def _runs(actuators: Sequence[Values], controllers: Sequence[Values], rate_hz: float,
          duration_s: float) -> Array:
    out = close_many(loops_of(actuators, controllers, rate_hz), duration_s)
    return np.nan_to_num(np.clip(out, -DIVERGED, DIVERGED), nan=DIVERGED)


class Responses(NamedTuple):
    """Runs from which the figures follow, each 6 signals of LoopRun x control periods."""

    steps: Array                    # of SIZES_N
    sines: Array                    # 100 N at 10 Hz, and 50 N at each of BAND_HZ
    motions: Mapping[str, Array]    # the last period of each of MOTIONS, the reference 0
    impedance: Array                # complex, N s/m: IMPEDANCE_M_S x IMPEDANCE_HZ


def _references(controller: Values, shape: str, **settings: float) -> dict[str, Any]:
    # Without the controller's own reference, which may have an offset, or an end.
    own = {name: value for name, value in controller.items() if not name.startswith('reference.')}
    return {**own, 'reference.shape': shape, 'reference.start': BEFORE_S,
            **{f'reference.{name}': value for name, value in settings.items()}}


def held(actuator: Values, controller: Values, rate_hz: float) -> tuple[Array, Array]:
    """Return the runs `steps` and `sines` of Responses, on the actuator's load."""
    steps = _runs([actuator] * len(SIZES_N),
                  [_references(controller, 'step', amplitude=size) for size in SIZES_N],
                  rate_hz, BEFORE_S + STEP_S)
    sines = [_references(controller, 'sine', amplitude=100.0, frequency=10.0)] + [
        _references(controller, 'sine', amplitude=50.0, frequency=frequency)
        for frequency in BAND_HZ]
    return steps, _runs([actuator] * len(sines), sines, rate_hz, 0.5)


def held_figures(steps: Array, sines: Array, rate_hz: float) -> dict[str, float]:
    """Return the figures of `held`."""
    wanted, force = sines[0, [0, 2], -round(0.3 * rate_hz):]
    gains = gains_db(sines, rate_hz)
    return {**_steps(steps, rate_hz),
            'sine_error_percent': float(100.0 * np.std(wanted - force) / np.std(wanted)),
            'gain_100_hz_db': min(gains), 'peak_db': max(gains)}


def gains_db(sines: Array, rate_hz: float) -> list[float]:
    """Return the gain (dB) at each of BAND_HZ."""
    return [float(20.0 * np.log10(max(abs(_harmonic(run[2], frequency, rate_hz)), 1e-6) / 50.0))
            for run, frequency in zip(sines[1:], BAND_HZ, strict=True)]


def moved(actuator: Values, controller: Values, name: str, rate_hz: float) -> Array:
    """Return the run of one of MOTIONS with no desired force: 6 signals x the last period."""
    velocity, frequency = MOTIONS[name]
    run = _runs([_moved(actuator, velocity, frequency)],
                [_references(controller, 'step', amplitude=0.0)], rate_hz, 1.5 / frequency)[0]
    return run[:, -round(rate_hz / frequency):]


def _moved(actuator: Values, velocity: float, frequency: float) -> dict[str, Any]:
    return {**actuator, 'load.type': 'prescribed', 'load.velocity': velocity,
            'load.frequency': frequency}


def impedance(actuator: Values, controller: Values, rate_hz: float) -> Array:
    """Return the impedance felt (complex, N s/m): IMPEDANCE_M_S x IMPEDANCE_HZ."""
    cases = [(velocity, frequency) for velocity in IMPEDANCE_M_S for frequency in IMPEDANCE_HZ]
    found = _runs([_moved(actuator, *case) for case in cases],
                  [_references(controller, 'step', amplitude=0.0)] * len(cases), rate_hz, 1.5)
    return np.array([
        -_harmonic(run[2], frequency, rate_hz) / _harmonic(run[5], frequency, rate_hz)
        for run, (_, frequency) in zip(found, cases, strict=True)]
        ).reshape(len(IMPEDANCE_M_S), -1)


def responses(actuator: Values, controller: Values, rate_hz: float) -> Responses:
    """Return the runs of a loop: on the locked piston, and moved."""
    return Responses(*held({**actuator, 'load.type': 'locked'}, controller, rate_hz),
                     {name: moved(actuator, controller, name, rate_hz) for name in MOTIONS},
                     impedance(actuator, controller, rate_hz))


def figures(actuator: Values, controller: Values, rate_hz: float = 5000.0,
            found: Responses | None = None) -> dict[str, float]:
    """
    Return the figures of ROWS.

    actuator, controller: parameters by name, the rest at their defaults; found: their responses,
    if they are known.
    """
    found = found or responses(actuator, controller, rate_hz)
    noisy = _runs([{**actuator, 'load.type': 'locked', 'force_sensor.noise': NOISE_N}],
                  [_references(controller, 'step', amplitude=100.0)], rate_hz, STEP_S)[0, 1]
    return {**held_figures(found.steps, found.sines, rate_hz),
            **{name: float(np.abs(run[2]).max()) for name, run in found.motions.items()},
            'least_re_z_n_s_m': float(found.impedance.real.min()),
            'noise_gain': float(np.std(noisy[len(noisy) // 2:]) / NOISE_N)}


class Step(NamedTuple):
    """Figures of a step: until it stays within 2 % of the reference, s, and beyond it, %."""

    size_n: float
    settling_s: float
    overshoot_percent: float
    steady_state_error_n: float


def step_figures(steps: Array, rate_hz: float) -> list[Step]:
    """Return the figures of each step of `held`; one that does not settle takes STEP_S."""
    found = []
    for run, size in zip(steps, SIZES_N, strict=True):
        force = run[2, round(BEFORE_S * rate_hz):]
        outside = np.flatnonzero(np.abs(force - size) > 0.02 * size)
        found.append(Step(
            size, float(outside[-1] + 1) / rate_hz if len(outside) else 0.0,
            float(100.0 * max(force.max() / size - 1.0, 0.0)),
            float(abs(size - force[-len(force) // 5:].mean()))))
    return found


def late_errors(steps: Array, rate_hz: float, after_s: float) -> list[float]:
    """
    Return of each step of `held` the logarithm of its largest error after a time over 2 % of it.

    It is at most 0 if the step settles within `after_s`. Unlike the settling time it does not
    jump where a ripple leaves the 2 %, so a search can follow it.
    """
    last = steps[:, 2, round((BEFORE_S + after_s) * rate_hz):]
    return [math.log(max(float(np.abs(force - size).max()), 1e-6 * size) / (0.02 * size))
            for force, size in zip(last, SIZES_N, strict=True)]


def _steps(runs: Array, rate_hz: float) -> dict[str, float]:
    _, settling, overshoot, error = zip(*step_figures(runs, rate_hz), strict=True)
    return {'settling_median_s': float(np.median(settling)), 'settling_worst_s': max(settling),
            'overshoot_percent': max(overshoot), 'steady_state_error_n': max(error)}


def missed(found: Mapping[str, float], goals: Mapping[str, float] | None = None
           ) -> dict[str, float]:
    """
    Return by how much each row misses its value: the logarithm of the ratio, below 0 if reached.

    goals: other values to reach, by name.
    """
    answer = {}
    for row in (row for row in ROWS if row.name in found):
        goal = (goals or {}).get(row.name, row.goal)
        value = found[row.name]
        if row.unit == 'dB':
            ratio = (value - goal) * np.log(10.0) / 20.0
            answer[row.name] = -ratio if row.more else ratio
        elif row.more:
            answer[row.name] = (goal - value) / IMPEDANCE_SCALE
        else:
            answer[row.name] = float(np.log(max(value, 1e-6) / goal))
    return answer
