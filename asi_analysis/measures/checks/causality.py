"""Order of cause and effect: no signal responds before its reference, or before its command."""

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.bags.run import Run
from asi_analysis.measures.checks.breaks import is_noisy
from asi_analysis.measures.checks.dead_time import jumps_alone
from asi_analysis.measures.correlation import CLEARLY, clear_delay, correlation_delay
from asi_analysis.measures.finding import (
    DOUBTFUL,
    NOTE,
    Finding,
    Interval,
    name_of,
    place_of,
    whole_run,
)

# Least lead (samples) of an output over its reference that counts; the correlation without the
# shift must be below the share CLEARLY of that with it.
EARLY_SAMPLES: Final = 3
# Largest lead of an output, and longest delay of one of the wrong sign, as a share of the run.
SOON: Final = 0.1
# Largest share of its change that an output may complete before the reference changes.
BEFORE: Final = 0.3
# Least change that is a step, as a share of the range; most steps; samples beside one, at least;
# fewest samples with a command.
STEP: Final = 0.2
MOST_STEPS: Final = 20
SETTLED_SAMPLES: Final = 20
FEWEST_SAMPLES: Final = 100
# A corner is a change of slope of more than the share STEP of their range, in a reference whose
# other slopes change by less than this share of it. The slope of a signal is measured over as many
# samples, at least, as its noise allows, and is known to this share of the change.
STRAIGHT: Final = 0.01
SLOPE_SAMPLES: Final = 5
SLOPE_SHARE: Final = 0.1
TURNED: Final = 0.7     # share of its change of slope that a signal has completed
SAME_TURN: Final = 0.3  # least share of the turn, or jump, of the reference
# A reference that goes on as before, but for a whole number of samples: largest change of slope
# from sample to sample, as a share of it, of one that is smooth; largest differences of the slopes
# beside, and of the number of samples.
SMOOTH: Final = 0.1
REGULAR: Final = 0.05
# Windows in which the noise of command and signal is compared, samples; earlier samples that
# count; least share of the noise of the command that comes from the signal, in a quarter of
# them: chance gives less, a recording of each n-th sample more; least ratio of noise and
# resolution.
NOISE_WINDOW: Final = 200
NOISE_WINDOWS: Final = 200   # so many at most, spread over the recording
NOISE_LAGS: Final = 5
LEAST_OWN_NOISE: Final = 0.06
NOISE_RESOLVED: Final = 20.0
MOSTLY_NOISE: Final = 0.1    # least share of the bends of a signal in its changes


def of_order(run: Run, name: str, time: Array, reference: Array, values: Array
              ) -> Iterator[Finding]:
    """Yield a finding if a signal comes before its reference."""
    if (early := _answered_before(time, reference, values)) and _answered_before(
            time[:len(values) - clear_delay(reference, values)], *in_time(reference, values)):
        yield Finding('order', name, DOUBTFUL, early,
                      f'the {name_of(name)} changes before its reference does {place_of(early)}: '
                      'they are not synchronised')
    elif early := _turned_before(time, reference, values):
        yield Finding('order', name, DOUBTFUL, early,
                      f'the {name_of(name)} turns before its reference does {place_of(early)}: '
                      'they are not synchronised, or exchanged')
    elif lead := _lead(reference, values):
        yield Finding('order', name, DOUBTFUL, whole_run(time),
                      f'the {name_of(name)} fits its reference best if it is '
                      f'{1e3 * lead * run.period_s:.4g} ms later: they are not synchronised')


def in_time(reference: Array, values: Array) -> tuple[Array, Array]:
    """Return a reference and its signal without the delay between them, if that is clear."""
    delay = clear_delay(reference, values)
    return reference[:len(reference) - delay], values[delay:]


def _lead(reference: Array, values: Array) -> int:
    """Return the lead (samples) of a signal over its reference, 0 if there is no clear one."""
    lag = correlation_delay(reference, values, 1.0)
    lead = 0 if lag is None else round(-lag)
    if not EARLY_SAMPLES <= lead < SOON * len(values):
        return 0
    now = np.corrcoef(reference, values)[0, 1]
    shifted = np.corrcoef(reference[lead:], values[:-lead])[0, 1]
    return lead if now < CLEARLY * shifted else 0


class Step(NamedTuple):
    """A step of the reference: its samples, and the levels of the signal before and after it."""

    begin: int      # of the level before
    jump: int       # first sample after the step
    end: int        # of the level after, excluded
    low: float
    high: float
    spread: float   # of the samples about either level


def steps_of(reference: Array, values: Array) -> list[Step]:
    """Return the steps of the reference, MOST_STEPS at most, and the response of the signal."""
    changes = np.abs(np.diff(reference))
    jumps = np.flatnonzero(changes > STEP * max(float(np.ptp(reference)), 1e-300))
    if not 0 < len(jumps) <= MOST_STEPS:
        return []
    # A level ends at any jump, but only large ones are steps.
    edges = [0, *(np.union1d(jumps, np.flatnonzero(jumps_alone(reference))) + 1), len(values)]
    found = []
    for begin, jump, end in zip(edges[:-2], edges[1:-1], edges[2:], strict=True):
        if jump - 1 not in jumps or min(jump - begin, end - jump) < SETTLED_SAMPLES:
            continue
        before = values[begin:begin + max(1, (jump - begin) // 2)]
        after = values[jump + (end - jump) // 2:end]
        spread = max(float(np.ptp(np.quantile(each, [0.05, 0.95]))) for each in (before, after))
        found.append(Step(begin, jump, end, float(np.median(before)), float(np.median(after)),
                          spread))
    return found


def moves_against_steps(reference: Array, values: Array, least: float) -> bool:
    """Return whether a signal goes against each step, by more than the share `least` of it."""
    shares = [(step.high - step.low) / (reference[step.jump] - reference[step.jump - 1])
              for step in steps_of(reference, values)
              if abs(step.high - step.low) > 3.0 * step.spread]
    return bool(shares) and max(shares) < -least


def begins_against(reference: Array, values: Array, least: float) -> bool:
    """
    Return whether a signal at rest first goes against its reference, by `least` of its range.

    Before the reference returns: later a sine of the wrong sign looks like one that is late by
    half a period.
    """
    begin = int(np.argmax(reference != reference[0]))
    if begin < SETTLED_SAMPLES:
        return False
    wanted = (reference - reference[0]) * np.sign(reference[begin] - reference[0])
    moved = values - np.median(values[:begin])
    first = int(np.argmax(np.abs(moved) > least * np.abs(moved).max()))
    return begin < first and moved[first] < 0.0 and bool((wanted[begin:first] > 0.0).all())


def _answered_before(time: Array, reference: Array, values: Array) -> tuple[Interval, ...]:
    """
    Return intervals from a response to the later jump of the reference that causes it.

    Before it the signal has settled: else it may still follow the jump before, as one with a
    limited speed does.
    """
    found = []
    steps = steps_of(reference, values)
    settled = _as_usual(reference, values) if steps else values
    for begin, jump, end, low, high, spread in steps:
        change = high - low
        share = (values[jump - 1] - low) / change if change else 0.0
        # Between other changes of the reference it may be at the next level by chance.
        if max(np.ptp(reference[begin:jump]), np.ptp(reference[jump:end])) > BEFORE * abs(
                reference[jump] - reference[jump - 1]):
            continue
        if _there_before(reference, values, begin, jump, end):
            found.append((float(time[begin]), float(time[jump])))
        elif abs(change) > 3.0 * spread and share > BEFORE and abs(
                low - settled[jump - 1]) < BEFORE * abs(settled[jump] - settled[jump - 1]):
            first = int(np.argmax((values[begin:jump] - low) / change > 0.1)) + begin
            found.append((float(time[first]), float(time[jump])))
    return tuple(found)


def _as_usual(reference: Array, values: Array) -> Array:
    """Return where the signal settles at each sample of its reference: a line through all."""
    known = np.isfinite(values)
    slope, level = np.polyfit(reference[known], values[known], 1)
    return np.asarray(level + slope * reference)


def _there_before(reference: Array, values: Array, begin: int, jump: int, end: int) -> bool:
    """Return whether a signal has settled at the new reference before the jump to it."""
    old, new = float(reference[jump - 1]), float(reference[jump])
    share = (values[begin:end] - old) / (new - old)
    until = jump - begin
    low, high = np.quantile(share[until // 2:until], [0.05, 0.95])
    return bool(np.median(share[:5]) < BEFORE and low > 1.0 - BEFORE and high < 1.0 + BEFORE
                and abs(np.median(share[until:]) - 1.0) < BEFORE)


class Corner(NamedTuple):
    """A corner of the reference: how far a signal has turned before and after it, 0 to 1."""

    sample: int
    before: float
    after: float


def corners_of(reference: Array, values: Array) -> list[Corner]:
    """Return the corners of a piecewise linear reference where the turn of a signal is clear."""
    if len(reference) < FEWEST_SAMPLES:
        return []
    slopes = np.diff(reference)
    bends = np.abs(np.diff(slopes))
    range_ = float(np.ptp(slopes))
    if np.quantile(bends, 0.9) > STRAIGHT * range_:
        return []
    corners = np.flatnonzero(bends > STEP * range_) + 1
    # The two bends of a step, and those of noise, follow each other.
    if not 0 < len(corners) <= MOST_STEPS or np.diff(corners).min(initial=2) < 2:
        return []
    noise = float(np.median(np.abs(np.diff(values, 2)))) / 0.6745 / np.sqrt(6.0)
    edges = [0, *(int(corner) for corner in corners), len(values) - 1]
    found = []
    for begin, corner, end in zip(edges[:-2], edges[1:-1], edges[2:], strict=True):
        old, new = (_slope(values[a + (b - a) // 4:b - (b - a) // 4]) for a, b in (
            (begin, corner), (corner, end)))
        least = SLOPE_SHARE * max(abs(new - old), 1e-300)
        count = max(SLOPE_SAMPLES, int(np.ceil(min((12.0 * (noise / least) ** 2) ** (1.0 / 3.0),
                                                   len(values)))))
        wanted = abs(reference[corner + 1] - 2.0 * reference[corner] + reference[corner - 1])
        if abs(new - old) < SAME_TURN * wanted or min(corner - begin, end - corner) < 6 * count:
            continue
        found.append(Corner(corner, *((_slope(values[part]) - old) / (new - old) for part in (
            slice(corner - count, corner + 1), slice(corner, corner + count + 1)))))
    return found


def _slope(values: Array) -> float:
    """Return the slope, from sample to sample, of a straight line through n samples."""
    places = np.arange(len(values)) - 0.5 * (len(values) - 1)
    return float(places @ values / max(float(places @ places), 1e-300))


def _turned_before(time: Array, reference: Array, values: Array) -> tuple[Interval, ...]:
    """Return the intervals in which a signal turns before each corner of its reference."""
    found = corners_of(reference, values)
    if len(found) < 2 or np.quantile([each.before for each in found], 0.25) < BEFORE:
        return ()
    return tuple((float(time[each.sample - 1]), float(time[each.sample])) for each in found)


def of_rows(run: Run, name: str, time: Array, reference: Array, values: Array
            ) -> Iterator[Finding]:
    """Yield the findings on a reference that shows that rows were lost or exchanged."""
    if skipped := _skipped(time, reference):
        yield Finding('missing', 'time', DOUBTFUL, skipped,
                      f'the reference goes on as after more samples {place_of(skipped)}, '
                      f'{len(skipped)} times: rows were lost there')
    elif jumped := _jumps_together(time, reference, values):
        yield Finding('answer', 'time', DOUBTFUL, jumped,
                      f'the {name_of(name)} jumps in the same sample as its reference '
                      f'{place_of(jumped)}, though it follows later elsewhere: rows were lost, '
                      'repeated or exchanged')


def _skipped(time: Array, reference: Array) -> tuple[Interval, ...]:
    """Return where a smooth reference changes by a multiple of its slope before and after."""
    if len(reference) < FEWEST_SAMPLES:
        return ()
    periods = np.diff(time)
    period = float(np.median(periods))
    slopes = np.diff(reference)
    usual = float(np.median(np.abs(slopes)))
    if not usual > 0.0 or float(
            np.median(np.abs(np.diff(slopes)))) > SMOOTH * usual:
        return ()
    beside = np.stack([slopes[:-4], slopes[1:-3], slopes[3:-1], slopes[4:]])
    middle = beside.mean(axis=0)
    # A step of the time explains a step of the reference.
    ratio = (slopes[2:-2] / np.where(middle != 0.0, middle, np.inf)
             - (periods[2:-2] / period - 1.0))
    lost = (np.ptp(beside, axis=0) < REGULAR * np.abs(middle)) & (ratio > 1.5) & (
        np.abs(ratio - np.round(ratio)) < REGULAR) & (np.abs(middle) > SMOOTH * usual)
    return tuple((float(time[k + 2]), float(time[k + 3])) for k in np.flatnonzero(lost))


def _jumps_together(time: Array, reference: Array, values: Array) -> tuple[Interval, ...]:
    """Return where signal and reference jump in one sample, and elsewhere the signal is later."""
    if len(values) < FEWEST_SAMPLES:
        return ()
    jumped = np.ones(len(values) - 1, bool)
    for each in (reference, values):
        jumped &= jumps_alone(each)
        jumped &= np.abs(np.diff(each)) > STEP * STEP * float(np.ptp(each))
    share = np.diff(values)[jumped] / np.diff(reference)[jumped]
    if not len(share) or len(share) > MOST_STEPS or not (
            (share > SAME_TURN) & (share < 1.0 / SAME_TURN)).all():
        return ()
    # The delay of the longest part between the jumps: they would be one of 0.
    edges = np.array([0, *(np.flatnonzero(jumped) + 1), len(values)])
    longest = int(np.argmax(np.diff(edges)))
    part = slice(edges[longest], edges[longest + 1])
    if (correlation_delay(reference[part], values[part], 1.0) or 0.0) < 2.0:
        return ()
    return tuple((float(time[k]), float(time[k + 1])) for k in np.flatnonzero(jumped))


def of_noise(run: Run, name: str) -> Iterator[Finding]:
    """
    Yield a finding if the noise of the command is not that of the signal that it responds to.

    Whatever the controller and the plant do, noise of a signal is in the command that was computed
    from it: where it is not, the signal was altered or moved in time, or measured again.
    """
    if run.command_n is None or run.reference_n is None or name != 'force':
        return
    share = _noise_in_common(run.command_n, run.reference_n, run.signal(name))
    if share is not None and share < LEAST_OWN_NOISE:
        yield Finding('answer', name, NOTE, whole_run(run.time_s),
                      f'the noise of the {name_of(name)} is not in the command: the controller '
                      'does not use it or had other samples, or it was altered or moved in time')


def _noise_in_common(command: Array, reference: Array, values: Array) -> float | None:
    """Return the share of the noise of the command that is a signal's, in a quarter of windows."""
    if not all(np.isfinite(each).all() for each in (command, reference, values)) or not (
            len(values) > NOISE_WINDOW and is_noisy(command) and is_noisy(values)):
        return None
    bends = [np.diff(each, 2) for each in (command, reference, values)]
    for each, bend in ((command, bends[0]), (values, bends[2])):
        steps = np.diff(np.unique(each))
        if np.median(np.abs(bend)) < NOISE_RESOLVED * float(steps.min(initial=np.inf)):
            return None
    count, others, shares = len(bends[0]), 2 * NOISE_LAGS - 1, []
    begins = np.arange(0, count - NOISE_LAGS - NOISE_WINDOW + 1, NOISE_WINDOW)
    for begin in begins[::-(-len(begins) // NOISE_WINDOWS)] if len(begins) else ():
        part = slice(begin, begin + NOISE_WINDOW)
        known = np.stack([each[NOISE_LAGS - lag:][part] for each, lags in (
            (bends[0], range(1, NOISE_LAGS)), (bends[1], range(NOISE_LAGS)),
            (bends[2], range(NOISE_LAGS))) for lag in lags], axis=1)
        new = bends[0][NOISE_LAGS:][part]
        alone, with_signal = (_left(table, new) for table in (known[:, :others], known))
        if alone > 0.0:
            shares.append(1.0 - with_signal / alone)
    return float(np.quantile(shares, 0.75)) if shares else None


def _left(table: Array, values: Array) -> float:
    """Return the sum of squares that a linear combination of columns leaves."""
    sizes = np.abs(table).max(axis=0)
    table = table / np.where(sizes > 0.0, sizes, 1.0)
    return float(np.sum((values - table @ np.linalg.lstsq(table, values, rcond=1e-10)[0]) ** 2))


def of_exchange(run: Run, name: str) -> Iterator[Finding]:
    """Yield a finding if the command, in time, cannot be the cause of a signal."""
    if run.reference_n is None:
        return
    if _is_reference_of(run.reference_n, run.signal(name)):
        yield Finding('order', name, DOUBTFUL, whole_run(run.time_s),
                      f'the {name_of(name)} has no noise, and comes before its reference, which '
                      'has: are they exchanged?')
    if run.command_n is None:
        return
    reference, command, values = run.reference_n, run.command_n, run.signal(name)
    known = np.isfinite(command) & np.isfinite(reference) & np.isfinite(values)
    reference, command, values = (each[known] for each in (reference, command, values))
    if len(values) < FEWEST_SAMPLES or not np.ptp(command) > 0.0:
        return
    if is_noisy(reference) and np.count_nonzero(np.diff(command)) <= MOST_STEPS:
        yield Finding('order', 'time', DOUBTFUL, whole_run(run.time_s),
                      'the reference has noise, and the command only steps: are they exchanged?')
    elif _without_noise(command) and _has_noise(reference) and _has_noise(values):
        yield Finding('order', 'time', DOUBTFUL, whole_run(run.time_s),
                      f'the reference and the {name_of(name)} have noise, and the command has '
                      'none: are they exchanged?')
    elif _responds_at_once(reference, command, values) or _turns_at_once(
            reference, command, values):
        yield Finding('order', 'time', DOUBTFUL, whole_run(run.time_s),
                      f'the {name_of(name)} responds to the reference at once, and the '
                      'command later: are they exchanged?')


def _responds_at_once(reference: Array, command: Array, values: Array) -> bool:
    """Return whether a signal changes in the samples in which its reference steps."""
    changes = np.abs(np.diff(reference))
    steps = np.flatnonzero(changes > STEP * float(np.ptp(reference)))
    if not 0 < len(steps) <= MOST_STEPS:
        return False
    of_values, of_command = (np.median(np.abs(np.diff(each))[steps]) / float(np.ptp(each) or 1.0)
                             for each in (values, command))
    return bool(of_values > STEP > 10.0 * of_command)


def _is_reference_of(reference: Array, values: Array) -> bool:
    """Return whether a signal without noise comes before its reference, which has noise."""
    known = np.isfinite(reference) & np.isfinite(values)
    reference, values = reference[known], values[known]
    return len(values) > FEWEST_SAMPLES and _has_noise(reference) and _without_noise(values) and (
        correlation_delay(reference, values, 1.0) or 0.0) < -1.0


def _without_noise(values: Array) -> bool:
    """Return whether a signal mostly moves on straight lines or smooth curves."""
    bends, changes = (float(np.median(np.abs(np.diff(values, n)))) for n in (2, 1))
    return bends < STRAIGHT * changes


def _has_noise(values: Array) -> bool:
    """Return whether much of the changes of a signal is noise, and not its resolution."""
    bends, changes = (float(np.median(np.abs(np.diff(values, n)))) for n in (2, 1))
    resolution = float(np.diff(np.unique(values)).min(initial=np.inf))
    return is_noisy(values) and bends > max(MOSTLY_NOISE * changes, NOISE_RESOLVED * resolution)


def _turns_at_once(reference: Array, command: Array, values: Array) -> bool:
    """Return whether a signal turns at each corner of its reference, and its command later."""
    of_values, of_command = corners_of(reference, values), corners_of(reference, command)
    return len(of_values) > 1 and len(of_command) > 1 and (
        min(each.after for each in of_values) > TURNED
        and max(each.after for each in of_command) < BEFORE)
