"""The course of a static characteristic's input: its passes to and fro, their rate, its cycle."""

import itertools
import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.gap.prepare import Recording

TURN: Final = 0.05    # of the range: a smaller reversal of the input is noise
REPEATS: Final = 0.05   # of the range (rms): how well an input must repeat its cycle
# A wave so near a harmonic of the input's cycle is one; in units of 1 / duration of the recording.
IN_STEP, IN_STEP_SLOW = 0.2, 0.5
SAME_RATE: Final = 1.4   # ratio of the rates of two passes that cannot be told apart
REST: Final = 0.05    # share of the time at rest that lets the response of a lag decay
SLOW: Final = 0.1     # share of the median rate below which the input is at rest
# The share of the time in which a sine is at rest by that definition.
SLOW_OF_SINE: Final = 2.0 / math.pi * math.asin(SLOW * 2.0 / math.pi)


def turning_points(values: Array, least: float = TURN) -> list[int]:
    """Return the samples at which a signal turns by more than a share of its range."""
    threshold = least * float(np.ptp(values))
    turns, extreme, way = [0], 0, 0
    for k in range(1, values.size):
        ahead = values[k] - values[extreme]
        if way == 0:
            if abs(ahead) > threshold:
                way, extreme = 1 if ahead > 0.0 else -1, k
        elif ahead * way >= 0.0:
            extreme = k
        elif abs(ahead) > threshold:
            turns.append(extreme)
            way, extreme = -way, k
    return [*turns, extreme] if way else turns


def passes(recording: Recording) -> list[tuple[int, int]]:
    """Return the stretches of samples over which the input moves one way."""
    return list(itertools.pairwise(turning_points(recording.input)))


def rates(recording: Recording) -> Array:
    """Return the mean speed of the input (units/s) in each of its passes."""
    return np.array([abs(recording.input[end] - recording.input[start])
                     / ((end - start) * recording.period_s)
                     for start, end in passes(recording)])


def one_rate(recordings: Sequence[Recording]) -> bool:
    """Return whether the input moves at one speed only, and never rests: see `SAME_RATE`."""
    found = np.concatenate([rates(r) for r in recordings])
    if found.size == 0:
        return True
    if any(at_rest(r) > REST + SLOW_OF_SINE for r in recordings):
        return False
    return bool(found.max() < SAME_RATE * float(np.quantile(found, 0.1)))


def at_rest(recording: Recording) -> float:
    """Return the share of the time in which the input is at rest, relative to its passes."""
    usual = float(np.median(rates(recording))) if len(passes(recording)) else 0.0
    return float(np.mean(np.abs(np.gradient(recording.input, recording.period_s))
                         <= SLOW * usual))


def _to_and_fro(given: Array) -> float:
    """Return the period of an input that goes to and fro, in samples; 0: it does not."""
    turns = np.array(turning_points(given)[1:-1])
    if turns.size < 2:
        return 0.0
    return float(np.median(turns[2:] - turns[:-2]) if turns.size > 2 else 2 * np.diff(turns)[0])


def cycle(given: Array) -> int:
    """Return the period of an input, in samples; 0: it is not periodic, or shorter than two."""
    guess = int(_to_and_fro(given))
    if not guess:
        return 0
    span = float(np.ptp(given))

    def missed(lag: int) -> float:
        return float(np.sqrt(np.mean((given[lag:] - given[:-lag]) ** 2))) / span

    near = range(max(int(0.97 * guess), 1), min(int(1.03 * guess) + 2, given.size // 2 + 1))
    best = min(near, key=missed, default=0)
    return best if best and missed(best) < REPEATS else 0


def in_step(recording: Recording, frequency: float) -> bool:
    """
    Return whether a wave (Hz) is a harmonic of an input that goes to and fro.

    Such a wave belongs to the characteristic; it is not a disturbance. A slow drift from cycle to
    cycle shifts the lowest harmonics, hence their wider limit.
    """
    lag = cycle(recording.input) or _to_and_fro(recording.input)
    if not lag:
        return False
    times = frequency * lag * recording.period_s
    off = abs(times - round(times)) / lag * recording.input.size   # in 1 / duration
    return off < (IN_STEP_SLOW if times < 3.5 else IN_STEP)
