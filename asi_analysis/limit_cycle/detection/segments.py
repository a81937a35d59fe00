"""Segmentation of a record: at rests, steps of the reference, changes of the growth rate."""

from typing import Final

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.limit_cycle.detection.envelope import Envelope
from asi_analysis.measures.quality import without_spikes
from asi_analysis.measures.sinusoids.noise import autoregression

# Least number of windows in a piece, and penalty of one more piece.
SHORTEST_PIECE: Final = 3
PENALTY: Final = 6.0
# The first window is cut off, as a transient, if its residual is this multiple of the median.
TRANSIENT: Final = 5.0
# Least samples of a rest, least ratio of the deviations of the motion and of the rest, and of the
# longest constant run at the edge over the others: a rounded signal rests at each peak.
SHORTEST_REST: Final = 16
MOVES: Final = 4.0
LONGER_RUN: Final = 4.0
# Cycles of a quiet stretch in the middle that is divided off although it is no rest.
SHORTEST_QUIET: Final = 3.0


def reference_cuts(time_s: Array, reference: Array | None, cycle_s: float) -> list[float]:
    """
    Return the times (s) at which the reference steps, starts moving or stops moving.

    Steps less than four cycles apart belong to one moving reference. A spike is no change.
    """
    if reference is None:
        return []
    valid = np.flatnonzero(np.isfinite(reference))
    if len(valid) > 1:
        valid = valid[np.isfinite(without_spikes(reference[valid]))]
    t, r = time_s[valid], reference[valid]
    if len(r) < 2 or np.ptp(r) == 0.0:
        return []
    moves = t[1:][np.abs(np.diff(r)) > 1e-6 * np.ptp(r)]
    if not len(moves):
        return []
    apart = np.flatnonzero(np.diff(moves) > 4.0 * cycle_s)
    first = np.concatenate([[0], apart + 1])
    last = np.concatenate([apart, [len(moves) - 1]])
    period = float(np.median(np.diff(t)))
    cuts = set()
    for begin, end in zip(moves[first], moves[last], strict=True):
        cuts |= {float(begin)} if end == begin else {float(begin - period), float(end)}
    return sorted(cuts)


def active_part(values: Array) -> slice:
    """
    Return the samples between a rest at the beginning and one at the end, if there are any.

    At rest there is only the noise of the sensor, or nothing: white noise of much less variance
    than the rest of the record, or a constant for much longer than anywhere else.
    """
    first, end = 0, len(values)
    for _ in range(2):   # a rest at one end may hide that at the other one
        first += _rest(values[first:end])
        end -= _rest(values[first:end][::-1])
    return slice(first, end)


def middle_cuts(values: Array, cycle: float) -> list[int]:
    """
    Return the samples at which a record is divided between two motions; cycle: in samples.

    The middle of each rest: of a stretch in which each cycle hardly moves, and which seen from its
    middle is a rest on either side, up to the next such stretch. A stretch of SHORTEST_QUIET
    cycles that is no rest, since its noise is coloured, is divided off if it begins and ends at
    once: the trough of a beat does not.
    """
    part = active_part(values)
    values, size = values[part], int(max(cycle, 2 * SHORTEST_REST))
    if len(values) < 3 * size:
        return []
    spread = _spread(values, size)
    # The size of the motion: of a tenth of the record, or of three cycles.
    largest = min(3 * size, max(len(spread) // 10, 1))
    moving = np.partition(spread, -largest)[-largest]
    quiet = np.concatenate([[False], spread < moving / MOVES, [False]])
    first, last = np.flatnonzero(np.diff(quiet.astype(int))).reshape(-1, 2).T
    ends = np.concatenate([[0], last + size - 1])
    found = []
    for k, (begin, end) in enumerate(zip(first, ends[1:], strict=True)):
        middle = int(begin + end) // 2
        following = first[k + 1] if k + 1 < len(first) else len(values)
        halves = values[ends[k]:middle][::-1], values[middle:following]
        if all(_rest(half) for half in halves):
            found.append(middle)
        elif end - begin >= SHORTEST_QUIET * size and _steep(spread, begin, last[k], size):
            before, after = (_change(half)[0] for half in halves)
            found += [middle - before, middle + after]
    return [part.start + each for each in found]


def _spread(values: Array, size: int) -> Array:
    """Return the standard deviation of each `size` neighbours."""
    centred = values - values.mean()
    total, power = (np.concatenate([[0.0], np.cumsum(each)]) for each in (centred, centred**2))
    mean = (total[size:] - total[:-size]) / size
    return np.sqrt(np.maximum((power[size:] - power[:-size]) / size - mean**2, 0.0))


def _steep(spread: Array, first: int, last: int, size: int) -> bool:
    """Return whether the spread doubles within half a window before and after a stretch."""
    before, after = first - 1 - size // 2, last + size // 2
    return bool(before >= 0 and after < len(spread) and min(spread[before], spread[after])
                > 2.0 * max(spread[first], spread[last - 1]))


def _rest(values: Array) -> int:
    """Return the number of samples at rest at the beginning: of white noise, or constant."""
    count = len(values)
    changes = np.flatnonzero(np.diff(values))
    if count < 2 * SHORTEST_REST or not len(changes):
        return 0
    runs = np.diff(np.concatenate([changes, [count - 1]]))
    constant = int(changes[0]) + 1
    if constant >= max(SHORTEST_REST, LONGER_RUN * runs[:-1].max(initial=0)):
        return constant
    length, moves = _change(values)
    rest = values[:length]
    return length if moves and not len(autoregression(rest - rest.mean()).coefficients) else 0


def _change(values: Array) -> tuple[int, bool]:
    """
    Return the sample at which a motion begins, and whether it is MOVES times as large.

    The change is where two normal distributions describe the values best.
    """
    count = len(values)
    if count < 2 * SHORTEST_REST:
        return 0, False
    split = np.arange(SHORTEST_REST, count - SHORTEST_REST + 1).astype(float)
    centred = values - values.mean()
    sums, squares = np.cumsum(centred), np.cumsum(centred**2)

    def variance(n: Array, total: Array, power: Array) -> Array:
        return np.maximum(power / n - (total / n) ** 2, 1e-12 * squares[-1] / count)

    total, power = (each[SHORTEST_REST - 1:count - SHORTEST_REST] for each in (sums, squares))
    before = variance(split, total, power)
    after = variance(count - split, sums[-1] - total, squares[-1] - power)
    best = int(np.argmin(split * np.log(before) + (count - split) * np.log(after)))
    return int(split[best]), bool(after[best] > MOVES**2 * before[best])


def envelope_cuts(found: Envelope) -> list[float]:
    """
    Return the times (s) at which the growth rate of the envelope changes.

    Each piece is a straight line in the logarithm of the amplitude. Dynamic programming minimises
    the squared error plus PENALTY for each piece, in units of description length (Jackson et al.,
    IEEE Signal Processing Letters 12, 2005).
    """
    count = len(found.amplitude)
    if count < 2 * SHORTEST_PIECE:
        return []
    noise_floor = np.maximum(found.deviation, 1e-3 * found.amplitude.max())
    level = np.log(np.maximum(found.amplitude, noise_floor))
    # Scatter from window to window counts as noise. Neighbours share half their samples, so second
    # differences of white noise have 2.5 instead of 6 times its variance.
    second = np.diff(level, 2)
    scatter = (np.median(np.abs(second)) / 0.6745) ** 2 / 2.5 if count > 6 else 0.0
    weight = 1.0 / ((noise_floor / np.maximum(found.amplitude, noise_floor)) ** 2 + scatter + 1e-6)
    cost = _line_costs(level, weight)

    penalty = 2.0 * PENALTY * np.log(count)   # twice: neighbouring windows are correlated
    best = np.full(count + 1, np.inf)
    best[0] = -penalty
    origin = np.zeros(count + 1, int)
    for end in range(SHORTEST_PIECE, count + 1):
        starts = np.arange(0, end - SHORTEST_PIECE + 1)
        totals = best[starts] + cost[starts, end - 1] + penalty
        origin[end] = starts[np.argmin(totals)]
        best[end] = totals.min()
    cuts, end = set(), count
    while origin[end] > 0:
        end = int(origin[end])
        cuts.add(0.5 * float(found.time_s[end - 1] + found.time_s[end]))
    settled = float(found.time_s[0]) + 0.5 * found.window_s
    if (found.deviation[0] > TRANSIENT * np.median(found.deviation)
            and all(cut > settled + found.window_s for cut in cuts)):
        cuts.add(settled)
    return sorted(cuts)


def _line_costs(level: Array, weight: Array) -> Array:
    """Return the weighted squared error of the best straight line from i to j, at [i, j]."""
    x = np.arange(len(level), dtype=float)

    def sums(values: Array) -> Array:
        total = np.concatenate([[0.0], np.cumsum(values)])
        return total[None, 1:] - total[:-1, None]

    w, wx, wy = sums(weight), sums(weight * x), sums(weight * level)
    wxx, wxy, wyy = sums(weight * x * x), sums(weight * x * level), sums(weight * level**2)
    with np.errstate(divide='ignore', invalid='ignore'):
        sxx, sxy, syy = wxx - wx * wx / w, wxy - wx * wy / w, wyy - wy * wy / w
        cost = syy - np.where(sxx > 1e-9, sxy**2 / sxx, 0.0)
    return np.where(np.isfinite(cost), np.maximum(cost, 0.0), 0.0)
