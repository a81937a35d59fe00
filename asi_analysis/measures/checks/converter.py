"""A bit that an analogue-to-digital converter lacks: values that never occur, regularly."""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from asi_analysis.arrays import Array

# Largest distance of a value from the grid of the codes, in steps: a file rounds its numbers.
ON_GRID: Final = 0.2
# Bits of a converter, at most: more are the digits of a computed number.
MOST_BITS: Final = 24
# Least evidence, in bits: of 60 000 signals with gaps by chance, one has it.
EVIDENCE: Final = 16
# Least number of gaps: one alone may be a jump of the signal.
FEWEST_GAPS: Final = 2


class MissingBit(NamedTuple):
    """A bit that is always 0, or always 1: its number from 0, and the width of a gap."""

    bit: int
    width: float    # of each gap in the values, in the unit of the signal


def missing_bit(values: Array) -> MissingBit | None:
    """
    Return the bit that n samples of a converter lack; None if all are there.

    Without bit k, 2^k codes in a row occur, and the next 2^k do not, over the whole range. A gap
    of exactly this width, at exactly this place, is one of 2^k chances.

    >>> codes = np.arange(1000)
    >>> missing_bit(0.5 * (codes & ~32))
    MissingBit(bit=5, width=16.0)
    >>> missing_bit(0.5 * codes) is None
    True
    """
    grid = _codes(np.unique(values))
    if grid is None:
        return None
    codes, quantum = grid
    gaps = np.diff(codes)
    for bit in range(1, min(int(codes[-1]).bit_length(), MOST_BITS)):
        size = 1 << bit
        after = codes[1:][gaps == size + 1] % (2 * size)    # first codes after a gap
        if len(after) < FEWEST_GAPS:
            continue
        places, counts = np.unique(after, return_counts=True)
        first, count = places[np.argmax(counts)], int(counts.max())
        # The first gap may be anywhere.
        evidence = count * bit + (count - 1) * (bit + 1)
        if count >= FEWEST_GAPS and evidence >= EVIDENCE and (
                (codes - first) % (2 * size) < size).all():
            return MissingBit(bit, size * quantum)
    return None


def _codes(levels: Array) -> tuple[npt.NDArray[np.intp], float] | None:
    """Return the codes of different values, from 0, and their step; None if no grid has them."""
    steps = np.diff(levels)
    if len(steps) < FEWEST_GAPS or not np.isfinite(steps).all():
        return None
    quantum = float(np.median(steps[steps < 1.5 * steps.min()]))
    if steps.sum() > quantum * 2 ** MOST_BITS:
        return None
    codes = np.append(0, np.cumsum(np.round(steps / quantum))).astype(np.intp)
    quantum, first = np.polyfit(codes, levels, 1)
    if np.abs(levels - first - quantum * codes).max() > ON_GRID * quantum:
        return None
    return codes, float(quantum)
