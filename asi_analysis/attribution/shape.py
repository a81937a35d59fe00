"""
What the shape of an oscillation, in command and output of a loop, says of its cause.

Numbers that depend on neither units, time scale nor sign: how much shorter each kind of valve
makes the description of the output than a linear one (Hammerstein models); the third harmonic of
both signals, which tells a triangle from a square and a sine (He et al. 2007, Hägglund 2011); the
phase between them (Horch, Control Engineering Practice 7, 1999); how steady the envelope is, for a
linear loop driven by noise has none that lasts; and flat tops of the command. Logistic regression
makes them a probability; its weights come from simulated loops of known cause (`calibration.py`).
"""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import signal

from asi_analysis.attribution.hammerstein import Explanation, explain
from asi_analysis.errors import InputError
from asi_analysis.limit_cycle.noise import autoregression
from asi_analysis.limit_cycle.sinusoid import dominant_frequency, fit, known, on_grid
from asi_analysis.limit_cycle.verdict import flat_share, reduce

Array = npt.NDArray[np.float64]

FEATURES: Final = (
    'stiction_gain', 'backlash_gain', 'hysteresis_gain', 'saturation_gain',
    'stiction_over_backlash', 'flat', 'line', 'unevenness',
    'output_second', 'command_second', 'output_third_cos', 'output_third_sin',
    'command_third_cos', 'command_third_sin', 'phase_cos', 'phase_sin', 'unexplained')
FEWEST_CYCLES: Final = 4.0
MOST_CYCLES: Final = 60.0


class Shape(NamedTuple):
    """The features of an oscillation, in the order of FEATURES, and where they come from."""

    features: Array
    frequency_hz: float
    cycles: float
    explanations: dict[str, Explanation]


def shape(time_s: Array, command: Array, output: Array) -> Shape:
    """
    Return the shape of the oscillation in a loop's command and output.

    Raises InputError if there is none of FEWEST_CYCLES or the command does not move.
    """
    time_s, both = _together(time_s, command, output)
    if len(time_s) < 30:
        raise InputError(f'{len(time_s)} samples of command and output: at least 30 are needed')
    if np.ptp(both[0]) == 0.0 or np.ptp(both[1]) == 0.0:
        raise InputError('command or output does not move: no oscillation to attribute')
    frequency = dominant_frequency(time_s, both[1], FEWEST_CYCLES)
    if not np.isfinite(frequency):
        raise InputError(f'no oscillation of at least {FEWEST_CYCLES:g} cycles')
    last = time_s >= time_s[-1] - MOST_CYCLES / frequency
    command, output = (_evenly(time_s[last], each[last], frequency) for each in both)
    t, period = _grid(time_s[last], frequency)
    cycle = 1.0 / (frequency * period)
    found = explain(command, output, cycle)
    return Shape(_features(t, command, output, frequency, cycle, found), frequency,
                 float(len(t) / cycle), found)


def _together(time_s: Array, command: Array, output: Array) -> tuple[Array, Array]:
    there = np.isfinite(time_s) & np.isfinite(command) & np.isfinite(output)
    return time_s[there], np.array([command[there], output[there]])


def _evenly(time_s: Array, values: Array, frequency: float) -> Array:
    return on_grid(*reduce(*known(time_s, values), frequency))[0]


def _grid(time_s: Array, frequency: float) -> tuple[Array, float]:
    t = reduce(time_s, time_s, frequency)[0]
    period = float(np.median(np.diff(t)))
    return np.arange(t[0], t[-1] + 0.5 * period, period), period


def _features(t: Array, command: Array, output: Array, frequency: float, cycle: float,
              found: dict[str, Explanation]) -> Array:
    values = dict.fromkeys(FEATURES, 0.0)
    described = {kind: autoregression(each.residual).description / len(each.residual)
                 for kind, each in found.items()}
    n = len(t)
    for kind in ('stiction', 'backlash', 'hysteresis', 'saturation'):
        if kind in described:
            # In nats for the record, on a scale that grows slowly.
            values[f'{kind}_gain'] = float(np.arcsinh(
                (described['linear'] - described[kind]) * n / 10.0))
    if 'stiction' in described and 'backlash' in described:
        values['stiction_over_backlash'] = float(np.arcsinh(
            (described['backlash'] - described['stiction']) * n / 10.0))
    values['flat'] = float(flat_share(command))
    values['unexplained'] = float(np.log10(max(found['linear'].unexplained, 1e-4)))

    swing_out, swing_in = fit(t, output, frequency), fit(t, command, frequency)
    if swing_out is None or swing_in is None:
        return np.array([values[name] for name in FEATURES])
    hiss = 3e-3 * np.random.default_rng(n).standard_normal(n) * np.std(output)
    drift = np.polynomial.polynomial.Polynomial.fit(t, output, 1)(t)
    line = (autoregression(output - drift + hiss, 2).description
            - autoregression(swing_out.residual + hiss,
                             4 + 2 * len(swing_out.harmonics)).description)
    values['line'] = float(np.arcsinh(line / 10.0))
    values['unevenness'] = float(np.log10(max(_unevenness(output, cycle), 1e-3)))
    for name, values_ in (('output', output), ('command', command)):
        second, third = _shape_harmonics(t, values_, swing_out.frequency_hz)
        values[f'{name}_second'] = second
        values[f'{name}_third_cos'], values[f'{name}_third_sin'] = third.real, third.imag
    angle = np.angle(_amplitude(t, output, swing_out.frequency_hz, 1)
                     / _amplitude(t, command, swing_out.frequency_hz, 1))
    # The sign of the process is not known: the angle counts twice.
    values['phase_cos'], values['phase_sin'] = float(np.cos(2 * angle)), float(np.sin(2 * angle))
    return np.array([values[name] for name in FEATURES])


def _amplitude(t: Array, values: Array, frequency: float, harmonic: int) -> complex:
    window = np.hanning(len(t))
    turn = np.exp(-2j * np.pi * harmonic * frequency * t)
    return complex(((values - values.mean()) * window) @ turn)


def _shape_harmonics(t: Array, values: Array, frequency: float) -> tuple[float, complex]:
    """
    Return the size of the second and the third harmonic against the first, cycle by cycle.

    Averaged over windows of three cycles, so that a frequency that wanders does not blur them;
    the third with its phase, as seen from the peak of the first: -1/3 a square, 1/9 a triangle.
    """
    width = 3.0 / frequency
    seconds, thirds = [], []
    for start in np.arange(t[0], t[-1] - width, 0.5 * width):
        part = slice(*np.searchsorted(t, [start, start + width]))
        if part.stop - part.start < 12:
            continue
        one, two, three = (_amplitude(t[part], values[part], frequency, h) for h in (1, 2, 3))
        if abs(one) == 0.0:
            continue
        direction = one / abs(one)
        seconds.append(two / abs(one) / direction**2)
        thirds.append(three / abs(one) / direction**3)
    if not thirds:
        return 0.0, 0j
    limit = 1.0
    second = min(float(abs(np.mean(seconds))), limit)
    third = complex(np.mean(thirds))
    return second, third / max(abs(third) / limit, 1.0)


def _unevenness(values: Array, cycle: float) -> float:
    """Return the variance of the squared envelope over its squared mean."""
    band = np.clip(2.0 / cycle * np.array([0.6, 1.6]), 1e-3, 0.98)
    sections = signal.butter(2, band, 'bandpass', output='sos')
    around = signal.sosfiltfilt(sections, values - values.mean())
    skip = min(int(0.5 * cycle), len(values) // 8)
    power = np.abs(signal.hilbert(around))[skip:len(values) - skip] ** 2
    return float(power.var() / power.mean() ** 2)
