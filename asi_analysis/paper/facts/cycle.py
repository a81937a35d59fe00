"""
Sustained oscillations, measured fast enough for searches: frequency, amplitude, distortion, onset.

`asi_analysis.measures.oscillation` measures the same on recordings with noise; a test compares
them.
"""

import math
from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np

from asi_analysis.loop.bench import RATE_HZ, Array, Bench, Values
from asi_common.jit import jit

HARMONICS: Final = 9
# A loop is watched in pieces of this length, about ten periods, for at most so many pieces.
PIECE_S: Final = 0.12
MOST_PIECES: Final = 8
# From piece to piece a cycle keeps its amplitude to this share; below the least it has died.
STEADY: Final = 0.01
LEAST_N: Final = 1.0
# No gain below this is tried.
LEAST_GAIN: Final = 1.0


class Cycle(NamedTuple):
    """An oscillation: frequency Hz, amplitude of the fundamental N, distortion (share)."""

    frequency_hz: float
    amplitude_n: float
    thd: float


@jit
def _cycle(force, rate, harmonics):
    mean = force.mean()
    first, last, count = -1.0, -1.0, 0
    for k in range(1, force.size):
        before, after = force[k - 1] - mean, force[k] - mean
        if before < 0.0 <= after:
            last = k - 1 - before / (after - before)
            if count == 0:
                first = last
            count += 1
    if count < 3:
        return 0.0, 0.0, 0.0
    period = (last - first) / (count - 1)
    # Whole periods, to the sample: what is left over weighs as it should.
    begin, end = first, last
    base, other = 0.0, 0.0
    for n in range(1, harmonics + 1):
        real, imaginary, weights = 0.0, 0.0, 0.0
        for k in range(math.ceil(begin), math.floor(end) + 1):
            weight = min(1.0, k - begin + 0.5) * min(1.0, end - k + 0.5)
            angle = 2.0 * math.pi * n * (k - begin) / period
            real += weight * (force[k] - mean) * math.cos(angle)
            imaginary += weight * (force[k] - mean) * math.sin(angle)
            weights += weight
        power = 4.0 * (real * real + imaginary * imaginary) / (weights * weights)
        if n == 1:
            base = power
        else:
            other += power
    return rate / period, math.sqrt(base), math.sqrt(other / base)


def cycle(force: Array) -> Cycle:
    """Return the oscillation of a force (N, at the bench's rate); zeros if there is none."""
    return Cycle(*_cycle(force, RATE_HZ, HARMONICS))


def sustained(bench: Bench, amplitude_n: float) -> Cycle | None:
    """Return the cycle that a loop settles to when held at a force; None if it comes to rest."""
    previous = math.inf
    for piece in range(MOST_PIECES):
        force = bench.run(PIECE_S, amplitude_n).force_n
        size = 0.5 * float(np.ptp(force))
        if not math.isfinite(size) or (piece and size < LEAST_N):
            return None
        if piece > 1 and abs(size - previous) < STEADY * size:
            break
        if piece == MOST_PIECES - 1 and size < (1.0 - 2.0 * STEADY) * previous:
            return None
        previous = size
    return cycle(force)


def onset(loop: Callable[[float], Bench], amplitude_n: float, low: float, high: float,
          accuracy: float = 0.003, limit: float = 80.0) -> float:
    """
    Return the least gain at which a step leaves a sustained cycle; infinite if above `limit`.

    loop: makes a loop at rest with a gain; low, high: where to look first.
    """
    while low > LEAST_GAIN and sustained(loop(low), amplitude_n) is not None:
        low, high = 0.7 * low, low
    while sustained(loop(high), amplitude_n) is None:
        low, high = high, 1.5 * high
        if low >= limit:
            return math.inf
    while high / low > 1.0 + accuracy:
        middle = math.sqrt(low * high)
        if sustained(loop(middle), amplitude_n) is None:
            low = middle
        else:
            high = middle
    return high


def proportional(gain: float) -> Values:
    return {'compensator': 'proportional', 'gain': gain}
