"""How the input of a characteristic moves: its passes to and fro, their rate, and its cycle."""

import itertools
import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.gap.prepare import Recording

TURN: Final = 0.05    # of the range: a smaller reversal of the input is noise
REPEATS: Final = 0.05   # of the range (rms): how well an input must repeat its cycle
IN_STEP, IN_STEP_SLOW = 0.2, 0.5   # of 1 / duration: a wave so near a harmonic is one
SAME_RATE: Final = 1.4   # ratio of the rates of two passes that cannot be told apart
REST: Final = 0.05    # of the time: an input that rests for so long lets a lag end
SLOW: Final = 0.1     # of the usual rate: what is slower is at rest
SLOW_OF_SINE: Final = 2.0 / math.pi * math.asin(SLOW * 2.0 / math.pi)   # share of a sine


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
    assert recording.command is not None
    return list(itertools.pairwise(turning_points(recording.command)))


def rates(recording: Recording) -> Array:
    """Return the mean speed of the input (units/s) in each of its passes."""
    assert recording.command is not None
    return np.array([abs(recording.command[end] - recording.command[start])
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
    """Return the share of the time in which the input hardly moves, for its passes."""
    assert recording.command is not None
    usual = float(np.median(rates(recording))) if len(passes(recording)) else 0.0
    return float(np.mean(np.abs(np.gradient(recording.command, recording.period_s))
                         <= SLOW * usual))


def _to_and_fro(given: Array) -> float:
    """Return how many samples an input takes to and fro; 0: it does not come back."""
    turns = np.array(turning_points(given)[1:-1])
    if turns.size < 2:
        return 0.0
    return float(np.median(turns[2:] - turns[:-2]) if turns.size > 2 else 2 * np.diff(turns)[0])


def cycle(given: Array) -> int:
    """Return after how many samples an input repeats; 0: it does not, or less than twice."""
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
    Return whether a wave (Hz) keeps step with an input that goes to and fro.

    Such a wave is of the characteristic, not of something else. What changes slowly from cycle to
    cycle shifts the slowest waves.
    """
    assert recording.command is not None
    lag = cycle(recording.command) or _to_and_fro(recording.command)
    if not lag:
        return False
    times = frequency * lag * recording.period_s
    off = abs(times - round(times)) / lag * recording.command.size   # in 1 / duration
    return off < (IN_STEP_SLOW if times < 3.5 else IN_STEP)
