"""Implausible samples of a signal: unpredicted ones, spikes, jumps and frozen samples."""

from typing import Final

import numpy as np
from scipy import ndimage, signal

from asi_analysis.arrays import Array, Mask
from asi_analysis.measures.checks.dead_time import repeated

# Past changes of a signal, and of its input, in the linear prediction of its next change; least
# and most samples to which that is fitted.
LAGS: Final = 20
FEWEST: Final = 200
MOST: Final = 20_000
# Smallest change of an input to which the signal may respond, as a share of its range; samples
# that count as the beginning of the response.
STEP: Final = 0.01
RESPONSE_SAMPLES: Final = 4
# Smallest implausible deviation: as a share of the range of the signal, and as a multiple of the
# 90 % quantile of all deviations. A signal is at rest if it moves by less than this share of its
# next change.
SHARE: Final = 0.2
USUAL: Final = 10.0
# Least share of distinct values in a signal that is not quantised: repeated values are suspect.
CONTINUOUS: Final = 0.9
# Least number of equal samples that are frozen. The signal must move before and after them: one of
# as many changes is larger than this share of the median change.
FROZEN: Final = 4
MOVING: Final = 0.1
# A signal of few digits comes to rest: one whose least change is a larger share of its range, or
# in changes of fewer times the least one within LAGS.
COARSE: Final = 1e-4
QUANTA: Final = 5.0
# A straight line: least number of samples without a bend; largest bend that counts as none, as a
# share of the usual one.
ON_A_LINE: Final = 8
STRAIGHT: Final = 0.03
# A signal with noise that is cut off: it moves in so many samples, does not become slower than
# this share of its speed, and then hardly moves for at least so many samples, within a range of at
# most this share of each movement before. Of less than this share of its range it has no noise.
MOTION: Final = 5
UNBRAKED: Final = 0.5
CUT_OFF: Final = 8
STILL: Final = 0.2
LEAST_NOISE: Final = 1e-4
OFTEN: Final = 0.1      # share of other samples without a bend, or least bend, that is usual
# A signal whose sign is lost: the samples below the first share of its rms are LINEAR of those
# below twice as much, in so many places between which it exceeds the last share.
NEAR_0: Final = 0.25
LINEAR: Final = (0.35, 0.65)
FEWEST_TURNS: Final = 2
MANY_TURNS: Final = 10
AWAY: Final = 0.6
# A change of sign: largest error of the mirrored value, and largest change before and after the
# jump, as a share of the jump.
MIRRORED: Final = 0.4
# Least median change around a deviation, as a share of it, for one that is usual there.
CHANGING: Final = 0.25
# Least deviation of one of many spikes, as a multiple of the range of the signal without them.
BEYOND: Final = 2.0
# Least ratio of such a jump to the changes of the last samples.
RECENT: Final = 1.5


def unexplained(inputs: Array, values: Array) -> Mask:
    """
    Return which of n samples a linear model of the signal does not predict.

    The model predicts the change to a sample from the last LAGS changes of signal and input, and
    is fitted to the samples themselves (ARX; L. Ljung, System Identification, section 4.2). The
    first LAGS samples are taken as predicted; of fewer than FEWEST samples none is.
    """
    if len(values) < FEWEST:
        return np.ones(len(values), bool)
    mirrored = _mirrored(values)
    values, inputs = (np.diff(each, prepend=each[0]) / max(float(np.ptp(each)), 1e-300)
                      for each in (values, inputs))
    rows = np.arange(LAGS, len(values), 1 + len(values) // MOST)
    past = np.stack([*(values[rows - lag] for lag in range(1, LAGS + 1)),
                     *(inputs[rows - lag] for lag in range(LAGS + 1))], axis=1)
    factors = np.linalg.lstsq(past, values[rows], rcond=1e-10)[0]
    alone = signal.lfilter([1.0, *-factors[:LAGS]], 1.0, values)
    answer = 2.0 * signal.lfilter(factors[LAGS:], 1.0, inputs)
    # A response to the input that is missing, or twice as large as predicted, is no break.
    deviation = np.abs(alone - np.clip(alone, np.minimum(answer, 0.0), np.maximum(answer, 0.0)))
    # After a single step any response is possible; an input that always steps has shown it.
    stepped = ndimage.maximum_filter1d(np.abs(inputs), LAGS + 1, origin=LAGS // 2) > SHARE
    mirrored &= stepped & (np.mean(stepped) < 0.5)
    deviation[mirrored] = np.abs(values[mirrored])
    deviation[:LAGS] = 0.0
    return _large(deviation, 1.0)


def _mirrored(values: Array) -> Mask:
    """Return where a signal changes its sign: it jumps to the mirror image of its course."""
    found = np.zeros(len(values), bool)
    before, change, after = np.diff(values)[:-2], np.diff(values)[1:-1], np.diff(values)[2:]
    other = -values[1:-2] - before      # the mirror image, extrapolated by a sample
    # A signal with few samples a period has as large changes regularly.
    recent = ndimage.maximum_filter1d(np.abs(before), LAGS // 2, origin=(LAGS // 2 - 1) // 2)
    found[2:-1] = (np.abs(values[2:-1] - other) < MIRRORED * np.abs(change)) & (
        np.maximum(np.abs(before), np.abs(after)) < MIRRORED * np.abs(change)) & (
        RECENT * recent < np.abs(change))
    return found


def spikes(values: Array, inputs: Array | None = None, same_unit: bool = False,
           fewest: int = FEWEST) -> Mask:
    """
    Return which of n samples are spikes: one or two that differ from their neighbours.

    A deviation that the input explains is no spike. inputs: such as the reference. same_unit: the
    input has the unit of the signal; it then explains only deviations within its own range, at the
    beginning of the response to a change of it. fewest: of fewer samples only the beginning of a
    response is explained.
    """
    smooth = ndimage.median_filter(values, 5, mode='mirror')
    deviation = np.abs(values - smooth)
    deviation[0] = 0.0      # the signal may have been at rest before
    if len(values) > 2:     # or move on at its end
        deviation[-1] = min(deviation[-1], abs(values[-1] - 2.0 * values[-2] + values[-3]))
    span = float(np.ptp(inputs)) if inputs is not None and same_unit else np.inf
    large = _large(deviation, max(float(np.ptp(smooth)), span if same_unit else 0.0))
    if large.sum() > max(2, 0.01 * len(values)):
        fillers, beyond = _fillers(values, large), deviation > BEYOND * float(np.ptp(smooth))
        if fillers.any():
            return fillers | large & beyond
        large &= beyond
    if not large.any():
        return large
    if inputs is None:
        return large & ~_usual_around(values, deviation)
    unknown = unexplained(inputs, values) if len(values) >= fewest else ~_begun(inputs, values)
    odd = large & (unknown | (deviation > span))
    if same_unit:
        odd |= large & ~_ringing(deviation, large & ~odd & _begun(inputs, values), large & ~odd)
    return ndimage.binary_propagation(odd, mask=large)


def _usual_around(values: Array, deviation: Array) -> Mask:
    """Return where others change as much to such values: a chirp of few samples a period."""
    change = np.abs(np.diff(values, prepend=values[0]))
    beside = np.abs(np.arange(-LAGS // 2, LAGS // 2 + 1)) > 1
    low, high = (extreme(values, footprint=beside) for extreme in (
        ndimage.minimum_filter, ndimage.maximum_filter))
    margin = CHANGING * (high - low)
    return (values >= low - margin) & (values <= high + margin) & (
        ndimage.median_filter(change, LAGS + 1) > CHANGING * deviation)


def _fillers(values: Array, large: Mask) -> Mask:
    """Return which of many large deviations are one filler value in a continuous signal."""
    found, counts = np.unique(values[large], return_counts=True)
    filler = large & (values == found[np.argmax(counts)])
    if 2 * counts.max() > large.sum() and is_continuous(values[~large]):
        return filler
    return np.zeros(len(values), bool)


def _ringing(deviation: Array, begun: Mask, large: Mask) -> Mask:
    """Return which large deviations are a decaying oscillation that begins at samples `begun`."""
    found = begun.copy()
    for k in np.flatnonzero(large & ~begun):
        last = slice(max(k - RESPONSE_SAMPLES, 0), k)
        found[k] = (found[last] & (deviation[last] > deviation[k])).any()
    return found


def jumps(time: Array, reference: Array, values: Array) -> list[tuple[int, int]]:
    """
    Return the first and the last sample of each part between two jumps, out of n samples.

    A jump is a change that neither the past of the signal nor its reference predicts; a reference
    explains a change of at most twice its own range, and any that repeats its jumps late. Two
    successive jumps enclose a part. With an odd number of jumps it is unknown which side is right,
    and all samples are one part. A change after a gap in time is no jump.
    """
    if len(values) < FEWEST:
        return []
    steps = np.diff(time)
    after = np.flatnonzero(steps > 1.5 * np.median(steps))[:, None] + np.arange(1, LAGS + 2)
    change = np.abs(np.diff(values, prepend=values[0]))
    large = unexplained(reference, values) | _large(change, float(np.ptp(values))) & (
        change > 2.0 * float(np.ptp(reference)))
    large[:LAGS] = False    # it may begin far from its reference
    large[np.minimum(after, len(values) - 1)] = False
    places = np.flatnonzero(large)
    places = places[np.diff(places, prepend=-LAGS) > LAGS]
    places = places[~repeated(reference, values, places)]
    if len(places) % 2:
        return [(0, len(values) - 1)]
    return [(int(first), int(end) - 1) for first, end in places.reshape(-1, 2)]


def frozen(values: Array) -> list[tuple[int, int]]:
    """
    Return the first and last sample of parts, out of n samples, that are constant within a motion.

    Only in a signal whose values are hardly ever repeated.
    """
    begins = np.flatnonzero(np.diff(values, prepend=np.nan) != 0.0)
    # The end may be constant for most of the run: a sensor that failed.
    until = begins[-1] + min(FROZEN, len(values) - begins[-1])
    if 2 * len(begins) < until or not is_continuous(values[begins]):
        return []
    lengths = np.diff(begins, append=len(values))
    changes = np.abs(np.diff(values[begins]))
    if not len(changes) or changes.min() > COARSE * float(np.ptp(values)):
        return []
    # Numbers of few digits have a finer resolution where they are small.
    finest = ndimage.minimum_filter1d(changes, 2 * LAGS + 1)
    moving = changes > np.maximum(MOVING * float(np.median(changes)), QUANTA * finest)
    # One with noise never rests, at its beginning neither.
    awake = lengths[0] >= CUT_OFF and _has_noise(values[begins[1]:])
    return [(int(begins[k]), int(begins[k] + lengths[k]) - 1)
            for k in np.flatnonzero(lengths >= FROZEN)
            if k == 0 and awake or moving[max(k - FROZEN, 0):k].any()
            and (moving[k:k + FROZEN].any() or k == len(changes))]


def straight(values: Array) -> list[tuple[int, int]]:
    """
    Return the first and last sample of parts, out of n samples, on a straight line within noise.

    Only in a signal with noise, whose bend changes its sign from sample to sample.
    """
    if not _has_noise(values):
        return []
    bend = np.abs(np.diff(values, 2))
    usual = float(np.median(bend))
    on_line = bend < STRAIGHT * usual
    edges = np.flatnonzero(np.diff(on_line.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
    long = edges[np.diff(edges)[:, 0] >= ON_A_LINE]
    # Where others have no bend either, that is the resolution; at the begin it may be off.
    if bend[bend > 1e-6 * usual].min(initial=usual) > OFTEN * usual or (
            on_line.sum() - np.diff(long).sum() > OFTEN * len(bend)):
        return []
    return [(int(first), int(end) + 1) for first, end in long
            if first > 0 and values[first] != values[end + 1]]


def without_sign(values: Array, reference: Array | None) -> bool:
    """
    Return whether the sign of n samples is lost: each time they go to 0 they turn there at once.

    A signal that goes through 0 has twice as many samples within twice a distance from it. What
    rests at 0 has as many, what turns there smoothly 1.4 times, and what has noise is negative.
    Its reference must have both signs, or rest while the signal turns many times.
    """
    size = np.abs(values) / max(float(np.sqrt(np.mean(values ** 2))), 1e-300)
    away = np.flatnonzero(size > AWAY)
    wanted = np.zeros(1) if reference is None else reference
    moves = float(np.ptp(wanted)) > 0.0
    if not len(away) or values.min() < 0.0 < values.max() or moves and float(
            np.ptp(wanted)) < (1.0 + NEAR_0) * float(np.abs(wanted).max()):
        return False
    size = size[away[0]:away[-1]]
    near, twice = (np.count_nonzero(size < share) for share in (NEAR_0, 2.0 * NEAR_0))
    far = size[(size < NEAR_0) | (size > AWAY)] > AWAY
    return bool(np.count_nonzero(far[:-1] & ~far[1:]) >= (FEWEST_TURNS if moves else MANY_TURNS)
                and LINEAR[0] * twice < near < LINEAR[1] * twice)


def cut_off(values: Array, reference: Array | None) -> Mask:
    """
    Return which of n samples are, but for noise, at the largest value, which cuts a motion off.

    What settles brakes before: its changes become smaller from sample to sample. What follows a
    reference that moves may stop with it.
    """
    found = np.zeros(len(values), bool)
    if len(values) <= MOTION + CUT_OFF:
        return found
    parts = np.lib.stride_tricks.sliding_window_view(values, CUT_OFF)[MOTION + 1:]
    motions = np.lib.stride_tricks.sliding_window_view(
        np.diff(values)[:-CUT_OFF], MOTION)[:len(parts)]
    width = np.ptp(parts, axis=1)
    stops = (width > LEAST_NOISE * float(np.ptp(values))) & (
        parts.max(axis=1) + width > values.max()) & (
        motions.min(axis=1) > width / STILL) & (
        motions[:, -1] > UNBRAKED * motions.max(axis=1))
    if reference is not None:
        stops &= np.ptp(np.lib.stride_tricks.sliding_window_view(
            reference[:-CUT_OFF], MOTION + 1), axis=1)[:len(parts)] == 0.0
    for k in np.flatnonzero(stops) + MOTION + 1:
        if is_noisy(values[k:k + CUT_OFF]):
            low = values[k:k + CUT_OFF].min() - width[k - MOTION - 1]
            found[k:k + int(np.argmax(np.append(values[k:] < low, True)))] = True
    return found


def _has_noise(values: Array) -> bool:
    """Return whether n samples, at least FEWEST, have noise that is not their resolution."""
    return len(values) >= FEWEST and is_noisy(values) and bool(
        np.median(np.abs(np.diff(values, 2)))
        >= QUANTA * np.diff(np.unique(values)).min(initial=np.inf))


def is_noisy(values: Array) -> bool:
    """Return whether the bend of n samples, at least 4, mostly changes its sign at the next."""
    bend = np.diff(values, 2)
    return bool(np.mean(bend[1:] * bend[:-1] < 0.0) > 0.5)


def _begun(inputs: Array, values: Array) -> Mask:
    """Return where a signal at rest begins to respond to a change of its input."""
    begun = np.zeros(len(values), bool)
    change = np.abs(np.diff(values, prepend=values[0]))
    steps = np.abs(np.diff(inputs, prepend=inputs[0])) > STEP * float(np.ptp(inputs))
    for lag in range(min(LAGS, len(values) - 1) + 1):
        begun[lag + 1:] |= steps[1:len(values) - lag] & (
            np.abs(values[lag:-1] - values[:len(values) - lag - 1]) < SHARE * change[lag + 1:])
    return np.convolve(begun, np.ones(RESPONSE_SAMPLES))[:len(begun)] > 0.0


def is_continuous(values: Array) -> bool:
    """Return whether hardly any of n values is repeated, as in a signal that is not quantised."""
    return len(np.unique(values)) > CONTINUOUS * len(values)


def _large(deviation: Array, span: float) -> Mask:
    """Return which deviations are far larger than usual, and a large share of the range `span`."""
    return deviation > max(USUAL * float(np.quantile(deviation, 0.9)), SHARE * span)
