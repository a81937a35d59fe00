"""Delay of one signal behind another, by their correlation."""

from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy import signal

from asi_analysis.arrays import Array

# Least correlation for a delay; largest difference of two correlations that count as equal.
LEAST_CORRELATION: Final = 0.3
EQUAL_CORRELATION: Final = 0.01
# A delay is clear if all correlations that speak against it are below this share of its own.
CLEARLY: Final = 0.8
# Correlation of an input with itself from which on it repeats, and from which on one lag may be
# taken for another.
REPEATS: Final = 0.9
SIMILAR: Final = 0.5


def correlation_delay(input_: Array, output: Array, period_s: float) -> float | None:
    """
    Return the lag (s) of the output behind the input by their correlation; None if they have none.

    The lag with the largest correlation coefficient of the samples that overlap, up to half of the
    run, interpolated between samples; of equal ones, as those of a periodic input, the shortest in
    which the output follows. Where the input repeats nearly, a lag counts as equal if its
    correlation is nearer to the largest one than such a repetition would make it. The differences
    are correlated where that is clearer than of the signals, as for a staircase.
    """
    if input_.size < 3:
        return None
    found = [largest_correlation(a, b) for a, b in (
        (input_, output), (np.diff(input_), np.diff(output)))]
    coefficient, lag = max(found)
    return lag * period_s if coefficient > LEAST_CORRELATION else None


def clear_delay(input_: Array, output: Array) -> int:
    """
    Return the lag (samples) of the output if it clearly follows the input, and not its inverse.

    0 if that is not clear: the output may come before the input, at once, or be its negative.
    """
    for a, b in ((np.diff(input_), np.diff(output)), (input_, output)):
        lags, coefficient = _correlations(a, b)
        best = float(coefficient.max(initial=-1.0))
        against = max(float(coefficient[lags <= 0].max(initial=-1.0)),
                      -float(coefficient[coefficient > -1.0].min(initial=0.0)))
        if best > LEAST_CORRELATION and against < CLEARLY * best:
            return int(lags[np.argmax(coefficient)])
    return 0


def repetition(input_: Array) -> int:
    """Return after how many samples an input repeats, up to half of them; 0 if it does not."""
    lags, coefficient = _correlations(input_, input_)
    own = coefficient[lags >= 0]
    other = int(np.argmax(own < 0.5 * REPEATS))     # beyond what is still the same peak
    again = np.flatnonzero(own[other:] > REPEATS) + other
    if not (other and again.size):
        return 0
    first = again[:int(np.argmax(np.append(np.diff(again), 2) > 1)) + 1]    # of its first peak
    return int(first[np.argmax(own[first])])


def largest_correlation(a: Array, b: Array, longest: float = 0.5) -> tuple[float, float]:
    """
    Return the largest correlation coefficient over the lags of `b`, and its lag in samples.

    longest: lag, as a share of the samples.
    """
    lags, coefficient = _correlations(a, b)
    coefficient = np.where(np.abs(lags) <= longest * len(a), coefficient, -1.0)
    top = int(np.argmax(coefficient))
    best = float(coefficient[top])
    own = np.interp(np.abs(lags - lags[top]), *_correlations(a, a), right=0.0)
    near = np.flatnonzero((coefficient > best - EQUAL_CORRELATION) | (
        (own > SIMILAR) & (coefficient > 0.5 * (1.0 + own) * best)))
    following = near[lags[near] >= 0]
    near = following if following.size else near
    k = int(near[np.argmin(np.abs(lags[near]))])
    while 0 < k < coefficient.size - 1 and coefficient[k] < max(coefficient[k - 1],
                                                                coefficient[k + 1]):
        k += 1 if coefficient[k + 1] > coefficient[k - 1] else -1   # to the top of that peak
    lag = float(lags[k])
    if 0 < k < coefficient.size - 1:
        left, middle, right = coefficient[k - 1:k + 2]
        bend = left - 2.0 * middle + right
        lag += float(0.5 * (left - right) / bend) if bend < 0.0 else 0.0
    return best, lag


def _correlations(a: Array, b: Array) -> tuple[npt.NDArray[np.intp], Array]:
    """Return the lags of `b` up to half of the samples, and the correlation at each."""
    most = a.size // 2
    lags = np.arange(-most, most + 1)
    products = signal.correlate(b, a, method='fft')[a.size - 1 - most:a.size + most]

    def over(values: Array, first: Any, last: Any) -> Array:
        sums = np.concatenate([[0.0], np.cumsum(values)])
        return np.asarray(sums[last] - sums[first])

    begin_a, end_a = np.maximum(-lags, 0), a.size - np.maximum(lags, 0)
    begin_b, end_b = begin_a + lags, end_a + lags
    count = end_a - begin_a
    sum_a, sum_b = over(a, begin_a, end_a), over(b, begin_b, end_b)
    spread = [np.maximum(over(each ** 2, first, last) - total ** 2 / count, 0.0)
              for each, first, last, total in ((a, begin_a, end_a, sum_a),
                                               (b, begin_b, end_b, sum_b))]
    # While one of the signals is constant there is no correlation.
    least = [1e-3 * count / a.size * float(np.sum((each - each.mean()) ** 2)) for each in (a, b)]
    known = (spread[0] > least[0]) & (spread[1] > least[1])
    return lags, np.where(known, (products - sum_a * sum_b / count)
                          / np.sqrt(np.maximum(spread[0] * spread[1], 1e-300)), -1.0)
