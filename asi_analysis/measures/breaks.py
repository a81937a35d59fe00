"""Breaks of a controlled signal: jumps that its reference does not explain, and frozen samples."""

from typing import Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

# Smallest jump: of the range of the signal; of the 90 % quantile of its changes; of the changes
# before and after it.
RANGE_SHARE: Final = 0.2
USUAL: Final = 20.0
NEXT: Final = 10.0
# A change of the reference explains a jump in its direction, up to so many samples later, if it is
# at least this share of its range, and if the signal has waited for it: moved no more than this
# share of the jump.
ANSWER_SAMPLES: Final = 50
REFERENCE_SHARE: Final = 0.01
WAITED: Final = 0.2
# Equal samples that count as frozen: at least, and of the 90 % quantile of those in a row. Of a
# signal with noise (this share of the other samples differs from the one before), if the changes
# before and after are of this multiple of the median; of any, if they are of these shares of the
# range, and the last of this multiple of the change that follows.
FROZEN_SAMPLES: Final = 4
FROZEN_USUAL: Final = 3.0
NOISY: Final = 0.9
STIRRED: Final = 0.5
MOVED: Final = 0.01
CAUGHT_UP: Final = 0.02
THAW: Final = 5.0


def jumps(reference: Array, values: Array) -> list[tuple[int, int]]:
    """
    Return the first and the last sample of each part that jumps lead to, out of n samples.

    A jump is a change from one sample to the next, while the signal hardly changes before and
    after, that does not follow a change of the reference. Two jumps enclose a part. Of an odd
    number it cannot be told which side is right: then all samples are one part.
    """
    begins, _ = _held(values)
    changes = np.diff(values[begins])
    if len(changes) < 20:
        return []
    size = np.abs(changes)
    around = np.maximum(np.append(0.0, size[:-1]), np.append(size[1:], 0.0))
    least = max(RANGE_SHARE * float(np.ptp(values)), USUAL * float(np.quantile(size, 0.9)))
    places = [int(begins[k + 1]) for k in np.flatnonzero((size > least) & (size > NEXT * around))
              if not _explained(reference, values, int(begins[k + 1]))]
    if len(places) % 2:
        return [(0, len(values) - 1)]
    return list(zip(places[::2], (place - 1 for place in places[1::2]), strict=True))


def frozen(values: Array) -> list[tuple[int, int]]:
    """Return the first and last sample of parts, out of n samples, that stand still in motion."""
    begins, lengths = _held(values)
    least = max(FROZEN_SAMPLES, FROZEN_USUAL * float(np.quantile(lengths, 0.9)))
    still = lengths >= least
    noisy = int(np.sum(~still)) > NOISY * int(lengths[~still].sum())
    changes = np.abs(np.diff(values[begins]))
    stirred = STIRRED * float(np.median(changes)) if len(changes) else 0.0
    span = float(np.ptp(values))
    found = []
    for k in np.flatnonzero(still[1:]) + 1:
        before, after, later = (*changes[k - 1:k + 2], np.inf, np.inf)[:3]
        moved = before > MOVED * span and after > max(CAUGHT_UP * span, THAW * later)
        if moved or (noisy and min(before, after) > stirred):
            found.append((int(begins[k]), int(begins[k] + lengths[k]) - 1))
    return found


def _held(values: Array) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Return where each group of equal samples begins, and its length."""
    begins = np.flatnonzero(np.diff(values, prepend=np.nan) != 0.0)
    return begins, np.diff(begins, append=len(values))


def _explained(reference: Array, values: Array, place: int) -> bool:
    """Return whether the jump to a sample answers a change of the reference."""
    change = float(values[place] - values[place - 1])
    first = max(place - ANSWER_SAMPLES - 1, 0)
    stepped = np.diff(reference[first:place + 1]) * np.sign(change) > REFERENCE_SHARE * float(
        np.ptp(reference))
    waited = np.abs(values[first:place] - values[place - 1]) < WAITED * abs(change)
    return bool((stepped & waited).any())
