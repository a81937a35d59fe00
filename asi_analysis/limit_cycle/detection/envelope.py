"""Amplitude of an oscillation from cycle to cycle, and its Poincaré return map."""

from typing import Final, NamedTuple

import numpy as np
from scipy import stats

from asi_analysis.arrays import Array
from asi_analysis.measures.sinusoids.sinusoid import least_squares

MOST_WINDOWS: Final = 250
# Windows for the decay of the swing; with more of them noise has more influence.
SWINGS: Final = 10


class Envelope(NamedTuple):
    """For each window: centre (s), amplitude, its standard deviation by noise, mean."""

    time_s: Array
    amplitude: Array
    deviation: Array
    mean: Array
    window_s: float


def envelope(time_s: Array, values: Array, frequency_hz: float) -> Envelope:
    """
    Return the amplitude at `frequency_hz` in windows of two cycles, one cycle apart.

    Windows are longer in records of more than MOST_WINDOWS cycles. Values must not be NaN.
    """
    cycles = (time_s[-1] - time_s[0]) * frequency_hz
    hop = max(1.0, cycles / MOST_WINDOWS) / frequency_hz
    window = 2.0 * hop
    starts = np.arange(time_s[0], time_s[-1] - window + 0.3 * hop, hop)
    rows = []
    for start in starts:
        part = slice(*np.searchsorted(time_s, [start - 1e-9, start + window + 1e-9]))
        t = time_s[part] - start - 0.5 * window
        if len(t) < 7:
            continue
        phase = 2.0 * np.pi * frequency_hz * t
        columns = np.column_stack([np.cos(phase), np.sin(phase), np.ones(len(t)), t])
        coefficients = least_squares(columns, values[part])
        residual = values[part] - columns @ coefficients
        deviation = np.sqrt(2.0 / len(t) * (residual @ residual) / (len(t) - 4))
        rows.append((start + 0.5 * window, np.hypot(*coefficients[:2]), deviation,
                     coefficients[2]))
    table = np.array(rows).reshape(-1, 4)
    return Envelope(table[:, 0], table[:, 1], table[:, 2], table[:, 3], window)


def swings(time_s: Array, values: Array, frequency_hz: float) -> Array:
    """Return half the peak-to-peak value of each cycle; cycles are counted back from the end."""
    cycle = np.ceil((time_s - time_s[-1]) * frequency_hz).astype(int)
    edges = np.searchsorted(cycle, np.arange(cycle[0] + 1, 1))
    if not len(edges):
        return np.array([])
    high, low = (rule.reduceat(values, edges) for rule in (np.maximum, np.minimum))
    return 0.5 * (high - low)


def decay_of_swing(time_s: Array, values: Array, frequency_hz: float) -> tuple[float, float]:
    """
    Return how much the logarithm of the swing decreases over a record, and the p-value.

    Of the record or one of its halves, whichever has the least p-value: a decaying oscillation
    may reach the noise floor. Null hypothesis: a random walk, by a t test of the steps between
    windows; noise, which returns to its mean level, is even less likely to decrease steadily. The
    frequency may vary. (0, 1) for a record that is too short.
    """
    half = len(values) // 2
    tests = [_decay(time_s[part], values[part], frequency_hz)
             for part in (slice(None), slice(half), slice(half, None))]
    decay, p_value = min(tests, key=lambda test: test[1])
    return decay, min(len(tests) * p_value, 1.0)


def _decay(time_s: Array, values: Array, frequency_hz: float) -> tuple[float, float]:
    cycles = (time_s[-1] - time_s[0]) * frequency_hz
    level = swings(time_s, values, frequency_hz / max(cycles / SWINGS, 1.0))
    if len(level) < SWINGS // 2 or not level.min() > 0.0:
        return 0.0, 1.0
    steps = np.diff(np.log(level))
    score = steps.mean() / max(float(steps.std(ddof=1)), 1e-12) * np.sqrt(len(steps))
    return -float(steps.sum()), float(2.0 * stats.t.sf(abs(score), len(steps) - 1))


def peaks_by_cycle(time_s: Array, values: Array, frequency_hz: float) -> Array:
    """Return the maximum of each complete cycle: points of a Poincaré section."""
    cycle = np.floor((time_s - time_s[0]) * frequency_hz).astype(int)
    edges = np.searchsorted(cycle, np.arange(cycle[-1] + 1))
    return np.maximum.reduceat(values, edges)[:-1] if len(edges) > 1 else np.array([])


def return_map_slope(peaks: Array) -> float:
    """
    Return the slope of each peak over the one before, about their mean; NaN for fewer than 5.

    Below 1 the cycle attracts. It estimates the Floquet multiplier if the peaks scatter by process
    noise; measurement noise biases it towards 0 (errors in variables).
    """
    if len(peaks) < 5:
        return float('nan')
    before, after = peaks[:-1] - peaks.mean(), peaks[1:] - peaks.mean()
    size = before @ before
    return float(before @ after / size) if size > 0.0 else 0.0


def orbit_closure(time_s: Array, values: Array, frequency_hz: float) -> float:
    """
    Return the rms difference of a signal to itself one cycle earlier, over its rms.

    About 0 for a closed orbit, 1.4 for noise.
    """
    earlier = np.interp(time_s - 1.0 / frequency_hz, time_s, values, left=np.nan)
    difference = (values - earlier)[np.isfinite(earlier)]
    spread = float(np.std(values))
    return float(np.sqrt(np.mean(difference**2)) / spread) if spread and len(difference) else 1.4
