"""A signal that follows its reference late: which jumps repeat those of the reference."""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import ndimage, signal

from asi_analysis.arrays import Array, Mask

Places = npt.NDArray[np.intp]

# A jump is so many times larger than the changes of as many samples before and after it.
JUMP: Final = 10.0
BESIDE: Final = 5
# Largest difference of a jump from that of the reference times the gain, as a share; a signal is
# at rest if it moves by less than this share of its next jump.
ALIKE: Final = 0.3
REST: Final = 0.2
# Least gain of a single jump, and inverse of the largest.
SIMILAR: Final = 0.3
# Least share of the jumps of the reference that the signal repeats.
REPEATED: Final = 0.75


class _Pairs(NamedTuple):
    """Jumps of a signal at samples `later`, `delay` or so after those of its reference."""

    delay: int
    sources: Places
    later: Places
    gain: float


def jumps_alone(values: Array) -> Mask:
    """Return which changes of a signal to its next sample are far larger than those beside."""
    changes = np.abs(np.diff(values))
    beside = np.abs(np.arange(-BESIDE, BESIDE + 1)) > 0
    return np.asarray(changes > JUMP * ndimage.maximum_filter(changes, footprint=beside))


def repeated(reference: Array, values: Array, places: Places) -> Mask:
    """
    Return which jumps of a signal of n samples, to the samples `places`, repeat its reference.

    Each then has a jump of the reference of proportionate size before it, all by one delay, and
    nearly all jumps of the reference are repeated. A single one must have about the size of that
    of the reference, and the signal must rest between the two. With several, the jumps within the
    delay after the first sample are repeated too: of what, was not recorded.
    """
    none = np.zeros(len(places), bool)
    sources = np.flatnonzero(jumps_alone(reference)) + 1
    if not len(places) or not len(sources):
        return none
    pairs = _pairs(reference, values, places, sources)
    if pairs is None:
        return none
    found = _beside(places, pairs.later)
    return np.asarray(found | (places < pairs.delay)) if len(pairs.later) > 1 else found


def only_repeats(reference: Array, values: Array) -> bool:
    """Return whether a signal rests but for jumps that repeat those of its reference."""
    places = np.flatnonzero(np.diff(values)) + 1
    return 0 < len(places) == np.count_nonzero(jumps_alone(values)) and bool(
        repeated(reference, values, places).all())


def _beside(places: Places, others: Places) -> Mask:
    """Return which samples are one of the others, or next to it."""
    return np.asarray(np.isin(places[:, None] + np.arange(-1, 2), others).any(axis=1))


def _pairs(reference: Array, values: Array, places: Places, sources: Places) -> _Pairs | None:
    """Return the jumps that a signal repeats at the likeliest delay; None if it does not."""
    delay = _likeliest(reference, values, places, sources)
    sources = sources[sources + delay < len(values)]
    wanted, got = _around(reference, sources), _around(values, sources + delay)
    known = _beside(sources + delay, places)
    if not known.any():
        return None
    gain = float(np.median(got[known] / wanted[known]))
    alike = np.abs(got - gain * wanted) < ALIKE * np.abs(gain * wanted)
    large = np.abs(wanted) >= np.abs(wanted[known & alike]).min(initial=np.inf)
    if not gain > 0.0 or not large.any() or np.mean(alike[large]) < REPEATED:
        return None
    pairs = _Pairs(delay, sources[alike & large], (sources + delay)[alike & large], gain)
    return pairs if len(pairs.later) > 1 or _after_rest(values, pairs) else None


def _likeliest(reference: Array, values: Array, places: Places, sources: Places) -> int:
    """Return the delay (samples) by which the jumps of a signal best repeat the reference's."""
    causes, effects = np.zeros(len(values)), np.zeros(len(values))
    causes[sources] = np.diff(reference)[sources - 1]
    effects[places] = np.diff(values)[places - 1]
    # Between two samples a delay is the one or the other.
    near = np.convolve(causes, [0.5, 1.0, 0.5], 'same')
    score = signal.correlate(effects, near, method='fft')[len(values) - 1:]
    return int(np.argmax(score > (1.0 - 1e-9) * score.max()))


def _around(values: Array, places: Places) -> Array:
    """Return the changes from the second sample before to the first one after `places`."""
    return np.asarray(values[np.minimum(places + 1, len(values) - 1)]
                      - values[np.maximum(places - 2, 0)])


def _after_rest(values: Array, pairs: _Pairs) -> bool:
    """Return whether a single jump is about that of the reference, and comes after a rest."""
    between = values[pairs.sources[0]:pairs.later[0] - 1]
    jump = abs(float(_around(values, pairs.later)[0]))
    return SIMILAR < pairs.gain < 1.0 / SIMILAR and float(
        np.ptp(between) if len(between) else 0.0) < REST * jump
