"""Parts of a recording: for the fit, for model selection and for validation."""

import math
from collections.abc import Iterable

import numpy as np

from asi_analysis.arrays import Array, Mask

BURN_IN_S = 0.15        # left out at the start, where the inner states are not known
BURN_OUT_S = 0.1        # left out at the end, since the motion after it is not known
PARTS = 12              # of a recording, in turn: fit, model selection, fit, validation
MORE_PARTS = (*range(5, 48), 64, 96)   # if in none of the usual ones a few steps are seen
# Least share of the changes of the input in fit and model selection, and what is sought then.
SEEN, WELL_SEEN = 0.05, 0.2
RESPONSE = 0.02         # of the recording: as long as a change is followed, at least
OUTSIDE = 0.01          # share of the held-out samples outside the range of the fitted parts


def split(count: int, period: float, parts: int = PARTS) -> tuple[Mask, Mask]:
    """
    Return which samples to fit on and which to hold out, for model selection or validation.

    Alternating parts cover the whole run; short gaps between them keep neighbours independent.
    """
    part = np.arange(count) * parts // count
    edge = np.arange(count) - np.ceil(part * count / parts)
    gap = (edge < 0.02 / period) & (part > 0)
    end = (np.arange(count)[::-1] * period >= BURN_OUT_S)
    usable = (np.arange(count) * period >= BURN_IN_S) & end & ~gap
    return usable & (part % 2 == 0), usable & (part % 2 == 1)


def reported(held: Mask) -> Mask:
    """Return the validation samples: every other part of the held-out ones."""
    begins = held & ~np.append(False, held[:-1])
    return held & (np.cumsum(begins) % 2 == 0)


def balanced_split(driving: Array, period: float) -> tuple[Mask, Mask]:
    """
    Return a split in which both parts have a similar excitation.

    Held-out samples outside the fitted range are not used, so without balance a saturation at a
    few peaks, or an effect at a few reversals, would not show.
    """
    size = np.abs(driving)

    def imbalance(fit: Mask, held: Mask) -> float:
        if not fit.any() or not held.any():
            return math.inf
        beyond = float(np.mean(size[held] > size[fit].max())) / OUTSIDE
        ratio = np.mean(size[held] ** 2) / max(np.mean(size[fit] ** 2), 1e-300)
        return max(beyond, abs(math.log2(max(ratio, 1e-300))) / 2.0, 1.0)

    def both_ways(parts: Iterable[int]) -> list[tuple[Mask, Mask]]:
        splits = [split(driving.size, period, number) for number in parts]
        # How a recording began is not known before the first fitted sample.
        return [each for fit, held in splits
                for each in ((fit, held), (held, fit & (np.cumsum(held) > 0)))]

    best = min(both_ways((PARTS, 2 * PARTS, 4 * PARTS)), key=lambda each: imbalance(*each))
    follows = _responses(driving, period)   # the best is the first that is balanced
    if _seen(best, follows) >= SEEN:
        return best
    return max((best, *both_ways(MORE_PARTS)), key=lambda each: (
        min(_seen(each, follows), WELL_SEEN), -imbalance(*each)))


def _responses(driving: Array, period: float) -> Array:
    """
    Return how much of the changes of an input each sample follows, with the sum 1.

    The gap of a loop shows after its steps only: a part without one holds no evidence.
    """
    change = np.append(0.0, np.diff(driving) ** 2)
    change[:int(BURN_IN_S / period)] = 0.0
    length = max(int(RESPONSE * driving.size), 3)
    summed = np.cumsum(change)
    recent = summed - np.append(np.zeros(length), summed[:-length])[:driving.size]
    return recent / max(float(recent.sum()), 1e-300)


def _seen(parts: tuple[Mask, Mask], follows: Array) -> float:
    """Return the least share of the responses in the fitted parts, and for model selection."""
    fit, held = parts
    return min(float(follows[part].sum()) for part in (fit, held & ~reported(held)))
