"""Where a record changes its ways: steps of the reference, and bends of the envelope."""

from typing import Final

import numpy as np
import numpy.typing as npt

from asi_analysis.limit_cycle.detection.envelope import Envelope

Array = npt.NDArray[np.float64]

# Windows of the envelope that a piece of its own must have, and the price of one more piece.
SHORTEST_PIECE: Final = 3
PRICE: Final = 6.0
# The first window is cut off if no sine fits it by so many times the usual: a loop that settles.
UNLIKE: Final = 5.0


def reference_cuts(time_s: Array, reference: Array | None, cycle_s: float) -> list[float]:
    """
    Return the times (s) at which the reference begins or ceases to move, or steps.

    Steps that follow each other within four cycles belong to one moving reference.
    """
    if reference is None:
        return []
    there = np.isfinite(reference)
    t, r = time_s[there], reference[there]
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


def envelope_cuts(found: Envelope) -> list[float]:
    """
    Return the times (s) at which the growth of the envelope changes.

    Each piece is a straight line in the logarithm of the amplitude; dynamic programming finds the
    pieces of least squared error plus PRICE a piece in units of description length (Jackson et
    al., IEEE Signal Processing Letters 12, 2005).
    """
    count = len(found.amplitude)
    if count < 2 * SHORTEST_PIECE:
        return []
    noise_floor = np.maximum(found.deviation, 1e-3 * found.amplitude.max())
    level = np.log(np.maximum(found.amplitude, noise_floor))
    # What the eye sees from window to window counts as noise too: neighbours share half their
    # samples, so second differences of white noise have 2.5 instead of 6 times its variance.
    rough = np.diff(level, 2)
    scatter = (np.median(np.abs(rough)) / 0.6745) ** 2 / 2.5 if count > 6 else 0.0
    weight = 1.0 / ((noise_floor / np.maximum(found.amplitude, noise_floor)) ** 2 + scatter + 1e-6)
    cost = _line_costs(level, weight)

    price = 2.0 * PRICE * np.log(count)   # twice: neighbouring windows are not independent
    best = np.full(count + 1, np.inf)
    best[0] = -price
    origin = np.zeros(count + 1, int)
    for end in range(SHORTEST_PIECE, count + 1):
        starts = np.arange(0, end - SHORTEST_PIECE + 1)
        totals = best[starts] + cost[starts, end - 1] + price
        origin[end] = starts[np.argmin(totals)]
        best[end] = totals.min()
    cuts, end = set(), count
    while origin[end] > 0:
        end = int(origin[end])
        cuts.add(0.5 * float(found.time_s[end - 1] + found.time_s[end]))
    settled = float(found.time_s[0]) + 0.5 * found.window_s
    if (found.deviation[0] > UNLIKE * np.median(found.deviation)
            and all(cut > settled + found.window_s for cut in cuts)):
        cuts.add(settled)
    return sorted(cuts)


def _line_costs(level: Array, weight: Array) -> Array:
    """Return [i, j]: the weighted squared error of the best straight line from i to j."""
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
