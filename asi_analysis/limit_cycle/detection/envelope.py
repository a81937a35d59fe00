"""The size of an oscillation from cycle to cycle, and the Poincaré return map that it makes."""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import stats

from asi_analysis.measures.sinusoid import least_squares

Array = npt.NDArray[np.float64]

MOST_WINDOWS: Final = 250
# Windows in which the fall of the swing is looked at: more would see more of the noise.
SWINGS: Final = 10


class Envelope(NamedTuple):
    """Local amplitudes: centre of each window (s), amplitude, its deviation by noise, mean."""

    time_s: Array
    amplitude: Array
    deviation: Array
    mean: Array
    window_s: float


def envelope(time_s: Array, values: Array, frequency_hz: float) -> Envelope:
    """
    Return the amplitude at `frequency_hz` in windows of two cycles, one cycle apart.

    More cycles than MOST_WINDOWS: the windows grow. Samples may be missing (left out, not NaN).
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
    """Return half of what a signal moves in each cycle, counted back from its end."""
    cycle = np.ceil((time_s - time_s[-1]) * frequency_hz).astype(int)
    edges = np.searchsorted(cycle, np.arange(cycle[0] + 1, 1))
    if not len(edges):
        return np.array([])
    high, low = (rule.reduceat(values, edges) for rule in (np.maximum, np.minimum))
    return 0.5 * (high - low)


def fall_of_swing(time_s: Array, values: Array, frequency_hz: float) -> tuple[float, float]:
    """
    Return how much the logarithm of the swing falls over a record, and the chance of that.

    Or over that half of it where it is plainer: what falls may reach the noise. The chance that a
    random walk would, by a t test of the steps between windows; noise, whose level returns to its
    mean, falls evenly even less. The frequency need not be steady. (0, 1) if it is too short.
    """
    half = len(values) // 2
    tests = [_fall(time_s[part], values[part], frequency_hz)
             for part in (slice(None), slice(half), slice(half, None))]
    fall, chance = min(tests, key=lambda test: test[1])
    return fall, min(len(tests) * chance, 1.0)


def _fall(time_s: Array, values: Array, frequency_hz: float) -> tuple[float, float]:
    cycles = (time_s[-1] - time_s[0]) * frequency_hz
    level = swings(time_s, values, frequency_hz / max(cycles / SWINGS, 1.0))
    if len(level) < SWINGS // 2 or not level.min() > 0.0:
        return 0.0, 1.0
    steps = np.diff(np.log(level))
    score = steps.mean() / max(float(steps.std(ddof=1)), 1e-12) * np.sqrt(len(steps))
    return -float(steps.sum()), float(2.0 * stats.t.sf(abs(score), len(steps) - 1))


def peaks_by_cycle(time_s: Array, values: Array, frequency_hz: float) -> Array:
    """Return the largest departure from the mean in each cycle: points of a Poincaré section."""
    cycle = np.floor((time_s - time_s[0]) * frequency_hz).astype(int)
    edges = np.searchsorted(cycle, np.arange(cycle[-1] + 1))
    return np.maximum.reduceat(values, edges)[:-1] if len(edges) > 1 else np.array([])


def return_map_slope(peaks: Array) -> float:
    """
    Return the slope of each peak against the one before, about their mean; NaN if too few.

    Below 1 the cycle attracts. It is the Floquet multiplier if what moves the peaks is a real
    disturbance; measurement noise draws it to 0 (errors in variables).
    """
    if len(peaks) < 5:
        return float('nan')
    before, after = peaks[:-1] - peaks.mean(), peaks[1:] - peaks.mean()
    size = before @ before
    return float(before @ after / size) if size > 0.0 else 0.0


def orbit_closure(time_s: Array, values: Array, frequency_hz: float) -> float:
    """
    Return how far the orbit fails to close: rms distance of a sample to that one cycle earlier.

    As a share of the rms of the signal; about 0 for a closed orbit, 1.4 for noise.
    """
    earlier = np.interp(time_s - 1.0 / frequency_hz, time_s, values, left=np.nan)
    difference = (values - earlier)[np.isfinite(earlier)]
    spread = float(np.std(values))
    return float(np.sqrt(np.mean(difference**2)) / spread) if spread and len(difference) else 1.4
