"""
Quality of the samples of a run: gaps, missing samples, clipping, spikes, quantisation and others.

`findings` lists the defects of a run; `trust` says whether a figure that is computed from an
interval of it is reliable, doubtful or withheld.
"""

from collections.abc import Iterator, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from asi_analysis.arrays import Array
from asi_analysis.bags.run import CONTROLLED, Run
from asi_analysis.errors import InputError
from asi_analysis.measures.checks.breaks import (
    FEWEST,
    cut_off,
    is_continuous,
    spikes,
    without_sign,
)
from asi_analysis.measures.checks.converter import missing_bit
from asi_analysis.measures.checks.dead_time import only_repeats
from asi_analysis.measures.checks.recomputed import of_controller, unrecorded
from asi_analysis.measures.checks.relations import moved_by, of_motion, of_reference
from asi_analysis.measures.finding import (
    DOUBTFUL,
    NOTE,
    Finding,
    Interval,
    name_of,
    place_of,
    whole_run,
)

# Samples further apart than this many periods have at least one missing between them.
GAP_PERIODS: Final = 1.5
# Samples before and after a long step by which one that is late is told from one that is missing.
AROUND: Final = 5
# Largest jitter (90 % quantile) as a share of the period.
JITTER: Final = 0.1
# Least difference of the median from the mean period that makes the rate doubtful: as a share of
# it, and in terms of jitter / sqrt(samples), so that it is no chance.
UNEVEN: Final = 0.02
BY_CHANCE: Final = 4.0
# Least change of the period that lasts, as a share of it and in terms of the jitter beside it;
# fewest samples before and after it.
OTHER_PERIOD: Final = 0.01
ABOVE_JITTER: Final = 10.0
FEWEST_BESIDE: Final = 50
# A gap of more periods and more seconds is a step of the clock, or a second recording.
CLOCK_PERIODS: Final = 1000
CLOCK_S: Final = 10.0
# Rates outside which the unit of time, or the rate, of a control loop is probably wrong.
USUAL_HZ: Final = (2.0, 2e5)
# Consecutive samples at the largest or smallest value that count as clipped.
CLIPPED_SAMPLES: Final = 4
# Fewer levels of quantisation give a note; with fewer than FEWEST_LEVELS, 2 % of a step cannot
# be resolved, and figures are doubtful.
NOTED_LEVELS: Final = 100
FEWEST_LEVELS: Final = 25
LARGE: Final = 0.1    # share of the largest value above which the number of digits is judged
# A signal with fewer changes is piecewise constant, such as a prescribed velocity.
FEWEST_CHANGES: Final = 4
# Smaller values (m, m/s, N) are rounding errors of a simulation at rest.
REST: Final = 1e-15
# What may explain that a signal suddenly changes, the first that was recorded; without reference
# and command the motion that came with it. With the samples that are needed to explain all but the
# beginning of a response: a motion has more changes that are one by chance.
CAUSES: Final = {'reference': FEWEST, 'command': FEWEST, 'valve_position': 3 * FEWEST,
                 'velocity': 3 * FEWEST, 'position': 3 * FEWEST}
# Samples of an even grid per recorded sample, above which the samples come in bursts.
MOST_FILLED: Final = 10.0
# A signal is held between every n-th sample if this share of its changes, and at least so many,
# are a multiple of n samples apart.
HELD: Final = 0.99
FEWEST_HELD: Final = 50
LARGEST: Final = 1e100   # value of a signal: squares and sums of larger ones overflow
LOSSES: Final = frozenset(('gap', 'missing', 'cut'))
# Findings that mark a figure but do not withhold it: it is one of another, complete recording.
MARKING: Final = LOSSES | {'absent', 'slow', 'still', 'jitter'}
# Longest gap, in samples, over which a motion may be interpolated, and largest share of samples
# that may be.
BRIDGED: Final = 7
MOST_BRIDGED: Final = 0.01
# Findings that explain why the command is not that of the recorded controller.
EXPLAINED: Final = frozenset(('unit', 'sign', 'order', 'answer', 'motion', 'copy'))


def findings(run: Run) -> list[Finding]:
    """Return the defects of the samples of a run (at least 2), doubtful ones first."""
    whole = whole_run(run.time_s)
    found = [*_of_time(run.time_s)]
    found += [Finding('reading', 'time', NOTE, whole, text) for text in run.problems]
    found += _of_import(run)
    found += unrecorded(run)
    dates = run.information.get('imported', {}).get('dates') is True    # their unit is known
    if run.reference_n is not None and not dates and not USUAL_HZ[0] < run.rate_hz < USUAL_HZ[1]:
        found.append(Finding('slow', 'time', DOUBTFUL, whole,
                             f'the samples of this control loop are {run.period_s:.4g} s apart: '
                             'is the unit of time, or the rate, right?'))
    for name, values in run.signals().items():
        found += _of_signal(run, name, values)
    known = of_controller(run)
    found += of_reference(run, as_recorded=known.agrees)
    found += of_motion(run)
    if not EXPLAINED & {each.kind for each in found if each.severity == DOUBTFUL}:
        found += known.findings
    return sorted(found, key=lambda each: each.severity != DOUBTFUL)


def quality_of(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Return the findings of several runs for JSON, each with its source if there are several."""
    return [finding.to_dict() | (
                {'text': f'{run.source}: {finding.text}'} if len(runs) > 1 else {})
            for run in runs if len(run) > 1 for finding in findings(run)]


class Trust(NamedTuple):
    """Whether a figure is reliable; if not, whether it is withheld, and why."""

    reliable: bool
    withheld: bool
    reason: str

    def note(self, figure: str) -> list[str]:
        """Return the note on a figure; none if it is reliable."""
        return [] if self.reliable else [
            f'{figure}: {"withheld" if self.withheld else "doubtful"}, because {self.reason}']


def trust(found: Sequence[Finding], run: Run, signals: Sequence[str], start_s: float,
          end_s: float, lost_share: float = 0.0, whole: bool = False) -> Trust:
    """
    Return the trust in a figure that is computed from these signals, start to end (s).

    It is doubtful if samples of that interval are lost, and withheld if more than `lost_share` of
    the interval is lost, or for any other doubtful finding but those of MARKING. whole: it is a
    figure of the whole run, and so doubtful if the recording lacks its beginning or end.
    """
    relevant = [each for each in found
                if each.severity == DOUBTFUL and each.signal in ('time', *signals)
                and (whole and each.kind == 'cut' or any(
                    start <= end_s and end >= start_s for start, end in each.intervals_s))]
    lost_s = sum(min(end, end_s) - max(start, start_s) + run.period_s
                 for each in relevant if each.kind in LOSSES
                 for start, end in each.intervals_s if start <= end_s and end >= start_s)
    withheld = (any(each.kind not in MARKING for each in relevant)
                or lost_s > lost_share * (end_s - start_s))
    return Trust(not relevant, bool(relevant) and withheld,
                 '; '.join(each.text for each in relevant))


def check_rate(time_s: Array, source: str) -> None:
    """Raise InputError if samples (at least 2) come in bursts: no rate is that of all of them."""
    steps = np.diff(time_s)
    period_s = float(np.median(steps))
    without_pauses_s = float(np.sort(steps)[:-(len(steps) // 100) - 1].sum())
    if not period_s > 0.0 or without_pauses_s > MOST_FILLED * len(time_s) * period_s:
        raise InputError(f'{source or "the run"}: the samples come in bursts: half of them are no '
                         f'more than {period_s:.3g} s after the one before, {len(time_s)} in '
                         f'{time_s[-1] - time_s[0]:.6g} s')


def check_size(run: Run) -> None:
    """Raise InputError for numbers whose squares and sums overflow."""
    for name, values in run.signals().items():
        largest = float(np.abs(values[np.isfinite(values)]).max(initial=0.0))
        if largest > LARGEST:
            raise InputError(f'{run.source or "the run"}: the {name_of(name)} reaches '
                             f'{largest:.3g} {run.unit(name)}, above {LARGEST:g}: is it damaged?')


def check_time(time_s: Array, source: str) -> None:
    """Raise InputError if no even grid spans the samples: bursts, or a step of the clock."""
    check_rate(time_s, source)
    for each in _of_time(time_s):
        if each.kind == 'clock_step':
            raise InputError(f'{source or "the run"}: {each.text}; analyse the parts on their own')


def doubts(runs: Sequence[Run], in_time: bool = True) -> list[str]:
    """
    Return what makes answers from whole runs doubtful: all that is, but few samples lost singly.

    in_time: an answer follows a motion from sample to sample, and continues after lost ones where
    interpolation ends, which is wrong after many in a row, or of many; else no lost sample is
    doubtful.
    """
    return [f'{run.source}: {each.text}' for run in runs if len(run) > 1
            for each in findings(run) if each.severity == DOUBTFUL and each.kind != 'absent' and (
                each.kind not in LOSSES or in_time and _many_inside(run, each))]


def _many_inside(run: Run, lost: Finding) -> bool:
    """Return whether many samples, or many in a row, are lost, with others before and after."""
    periods = [(end - start) / run.period_s for start, end in lost.intervals_s
               if start > run.time_s[0] and end < run.time_s[-1]]
    each_more = -1.0 if lost.kind == 'gap' else 1.0     # a gap lies between two samples
    return max(periods, default=0.0) > BRIDGED or (
        sum(periods) + each_more * len(periods) > MOST_BRIDGED * len(run))


def _of_time(time: Array) -> Iterator[Finding]:
    """Yield the findings on the time: order, steps of the clock, gaps, jitter."""
    steps = np.diff(time)
    period = float(np.median(steps))
    if (wrong := _intervals(time, steps <= 0.0)):
        yield Finding('time_order', 'time', DOUBTFUL, wrong,
                      f'the time repeats or decreases {_times(wrong)}')
    if not period > 0.0:
        return
    deviations = np.abs(steps - period)
    gaps = steps - period > max((GAP_PERIODS - 1.0) * period, 5.0 * float(np.median(deviations)))
    gaps &= ~_late(time, period)
    jitter = float(np.quantile(deviations[~gaps], 0.9))
    clock = gaps & (steps > max(CLOCK_PERIODS * period, CLOCK_S))
    if (pauses := _intervals(time, clock)):
        yield Finding('clock_step', 'time', DOUBTFUL, pauses,
                      f'the time jumps ahead {_times(pauses)}, by {steps[clock].max():.4g} s at '
                      'most: a step of the clock, or two recordings in one')
    if (missing := _intervals(time, gaps & ~clock)):
        lost = int(np.sum(np.round(steps[gaps & ~clock] / period) - 1.0))
        yield Finding('gap', 'time', DOUBTFUL, missing,
                      f'about {lost} samples are missing in {len(missing)} gaps, '
                      f'{1e3 * steps[gaps & ~clock].max():.4g} ms at most {place_of(missing)}')
    change, mean = _of_period(steps[~gaps]), float(steps[~gaps].mean())
    rounded = not change and abs(mean - period) > max(
        UNEVEN * period, BY_CHANCE * jitter / np.sqrt(len(time)))
    if rounded or jitter > JITTER * period:
        yield Finding('jitter', 'time', DOUBTFUL if rounded else NOTE, whole_run(time),
                      f'the samples are unevenly spaced: a tenth of them more than '
                      f'{100.0 * jitter / period:.0f} % of a period early or late' + (
                          f', most {1e3 * period:.4g} ms apart, {1e3 * mean:.4g} ms on average: '
                          'is the time rounded?' if rounded else ''))
    if change:
        place, before, after = change
        moment = float(time[:-1][~gaps][place])
        yield Finding('jitter', 'time', NOTE, ((moment, float(time[-1])),),
                      f'the samples are {1e3 * before:.4g} ms apart up to {moment:.4g} s, '
                      f'{1e3 * after:.4g} ms from then on: has the rate changed, or the clock?')


def _of_period(steps: Array) -> tuple[int, float, float] | None:
    """Return where the time between samples changes for good, and what it is before and after."""
    if len(steps) < 2 * FEWEST_BESIDE:
        return None
    # The sum of the deviations from the mean is largest where the mean changes.
    place = int(np.argmax(np.abs(np.cumsum(steps - steps.mean())))) + 1
    parts = steps[:place], steps[place:]
    if min(map(len, parts)) < FEWEST_BESIDE:
        return None
    before, after = (float(np.median(part)) for part in parts)
    jitter = max(float(np.quantile(np.abs(part - np.median(part)), 0.9)) for part in parts)
    clear = abs(after - before) > max(ABOVE_JITTER * jitter, OTHER_PERIOD * before)
    return (place, before, after) if clear else None


def _of_import(run: Run) -> Iterator[Finding]:
    """Yield a finding if samples were left out at the import, as their times were repeated."""
    times = run.information.get('imported', {}).get('repeated_times_s', ())
    lost = tuple((each, each) for each in times if run.time_s[0] <= each <= run.time_s[-1])
    if lost:
        yield Finding('missing', 'time', DOUBTFUL, lost,
                      f'{len(lost)} samples had the time of the one before, but other values, '
                      f'and were left out {place_of(lost)}: is the time rounded?')


def _late(time: Array, period: float) -> npt.NDArray[np.bool_]:
    """Return which steps to the next of n samples are long as that one is late, not missing."""
    late = time - period * np.arange(len(time))
    around = np.lib.stride_tricks.sliding_window_view(
        np.pad(late, AROUND, 'reflect', reflect_type='odd'), AROUND)
    shifted = np.median(around[AROUND + 1:], axis=1) - np.median(around[1:-AROUND], axis=1)
    return (np.diff(time) < 2.0 * period) & (shifted[:len(time) - 1] < 0.5 * period)


def _of_signal(run: Run, name: str, values: Array) -> Iterator[Finding]:
    """Yield the findings on one signal: missing samples, spikes, clipping, resolution."""
    known = np.isfinite(values)
    if not known.any():
        return
    present = np.flatnonzero(known)
    inside = ~known
    if name in ('reference', 'command'):    # valid from the first to the last message
        inside[:present[0]] = False
        inside[present[-1]:] = False
    if inside.any():
        missing = _sample_intervals(run.time_s, inside)
        yield Finding('missing', name, DOUBTFUL, missing,
                      f'{int(inside.sum())} of {len(values)} samples of the {name_of(name)} are '
                      f'missing {place_of(missing)}')
    if name == 'command' or len(present) < 10:
        return
    time, values = run.time_s[present], values[present]
    unit = run.unit(name)
    wrong = _spikes(run, name, present)
    if wrong.any():
        where = _sample_intervals(time, wrong)
        yield Finding('spike', name, DOUBTFUL, where,
                      f'the {name_of(name)} has {len(where)} spikes of one or two samples, up to '
                      f'{np.abs(values[wrong]).max():.4g} {unit} {place_of(where)}')
    if name == 'reference':
        return
    clipped = _clipped(values[~wrong])
    if name == 'force':
        reference = None if run.reference_n is None else run.reference_n[present][~wrong]
        clipped = [part | cut_off(sign * values[~wrong], reference)
                   for part, sign in zip(clipped, (-1.0, 1.0), strict=True)]
        if without_sign(values[~wrong], reference):
            yield Finding('sign', name, DOUBTFUL, whole_run(time),
                          f'the {name_of(name)} is never of the other sign, and turns at 0 each '
                          'time: is its sign lost?')
    for part, limit, word in zip(clipped, _ends(values[~wrong]), ('smallest', 'largest'),
                                 strict=True):
        if part.any():
            where = _sample_intervals(time[~wrong], part)
            yield Finding('clipping', name, DOUBTFUL, where,
                          f'the {name_of(name)} stays at its {word} value {limit:.4g} {unit} '
                          f'{place_of(where)}: it is clipped, or against a stop')
    if (held := _held(values)) > 1:
        yield Finding('held', name, NOTE, whole_run(time),
                      f'the {name_of(name)} changes only every {held} samples: it was measured '
                      f'at {run.rate_hz / held:.4g} Hz')
    if run.reference_n is not None and name == CONTROLLED.get(run.unit('reference')) and (
            only_repeats(run.reference_n[present], values)):
        return      # its levels are those of the reference, whatever its resolution
    yield from _of_resolution(run, name, time, values)


def _of_resolution(run: Run, name: str, time: Array, values: Array) -> Iterator[Finding]:
    """Yield the findings on few levels, or on levels that a converter leaves out."""
    whole, unit = whole_run(time), run.unit(name)
    if lacking := missing_bit(values):
        yield Finding('bit', name,
                      DOUBTFUL if FEWEST_LEVELS * lacking.width > np.ptp(values) else NOTE, whole,
                      f'the {name_of(name)} lacks bit {lacking.bit} of its converter: values in '
                      f'gaps of {lacking.width:.4g} {unit}, as far apart, never occur')
    if coarse := _quantised(values):
        yield Finding('quantisation', name, DOUBTFUL if coarse[0] < FEWEST_LEVELS else NOTE, whole,
                      f'the {name_of(name)} has only {coarse[0]} different values, '
                      f'{coarse[1]:.4g} {unit} apart')
    elif coarse := _quantised(large := values[np.abs(values) > LARGE * np.abs(values).max()]):
        # Rounded to two significant digits, values are close together near 0.
        yield Finding('quantisation', name, DOUBTFUL if coarse[0] < FEWEST_LEVELS else NOTE, whole,
                      f'the {name_of(name)} has only {coarse[0]} different values beyond '
                      f'{np.abs(large).min():.4g} {unit}, at least {coarse[1]:.4g} {unit} apart')


def _quantised(values: Array) -> tuple[int, float] | None:
    """Return the number of quantisation levels and their distance; None if there are many."""
    level = np.unique(values)
    step = float(np.diff(level).min(initial=np.inf))
    # A signal at rest also repeats values, but these are not on an even grid.
    if 1 < len(level) < NOTED_LEVELS and len(values) > 10 * len(level) and (
            np.count_nonzero(np.diff(values)) > FEWEST_CHANGES
            and step > 1e-3 * (level[-1] - level[0]) and level[-1] - level[0] > REST):
        return len(level), step
    return None


def without_spikes(reference: Array) -> Array:
    """Return a reference of n samples, NaN where it has spikes; it may jump at its ends."""
    wrong = spikes(reference)
    wrong[[0, -1]] = False
    return np.where(wrong, np.nan, reference)


def _spikes(run: Run, name: str, present: npt.NDArray[np.intp]) -> npt.NDArray[np.bool_]:
    """Return which of the present samples are spikes without a cause in reference or command."""
    values = run.signals()[name][present]
    if name == 'reference':
        return np.isnan(without_spikes(values))
    cause, fewest = next(((each[present], fewest) for other, fewest in CAUSES.items()
                          if other != name and (each := run.signals().get(other)) is not None
                          and np.isfinite(each[present]).all()), (None, 0))
    controlled = run.reference_n is not None and name == CONTROLLED.get(run.unit('reference'))
    found = spikes(values, cause, controlled, fewest)
    if name == 'velocity' and found.any():
        found &= ~moved_by(run, present)
    if name == 'force' and found.any() and run.velocity_m_s is not None and np.isfinite(
            run.velocity_m_s[present]).all():
        found &= spikes(values, run.velocity_m_s[present], fewest=CAUSES['velocity'])   # an impact
    return found


def _ends(values: Array) -> tuple[float, float]:
    return float(values.min()), float(values.max())


def _clipped(values: Array) -> list[npt.NDArray[np.bool_]]:
    """
    Return which samples are clipped at the smallest, and at the largest value.

    A clipped signal reaches the limit in a large step and stays there; one that settles, or is
    quantised or held, reaches it in its smallest steps. If no other value is repeated, a few
    samples at exactly this one suffice.
    """
    begins = np.flatnonzero(np.diff(values, prepend=np.nan) != 0.0)
    lengths = np.diff(begins, append=len(values))
    jumps = np.abs(np.diff(values))
    moving = jumps[jumps > 0.0]
    others = values[(values > values.min()) & (values < values.max())]
    continuous = is_continuous(others)
    found = []
    for limit in _ends(values):
        clipped = np.zeros(len(values), bool)
        if len(moving):
            least = max(10.0 * float(np.quantile(moving, 0.02)), 1e-3 * float(np.ptp(values)))
            usual = float(np.quantile(lengths, 0.9))
            reached = [(begin, length) for begin, length in zip(begins, lengths, strict=True)
                       if values[begin] == limit and begin > 0
                       and jumps[max(begin - 2, 0):begin].max() > least]
            often = continuous and sum(length for _, length in reached) >= CLIPPED_SAMPLES
            for begin, length in reached:
                if often or length >= max(CLIPPED_SAMPLES, 3.0 * usual):
                    clipped[begin:begin + length] = True
        found.append(clipped)
    return found


def _held(values: Array) -> int:
    """Return the number of samples between the changes of a signal, 1 if it is not regular."""
    begins = np.flatnonzero(np.diff(values, prepend=np.nan) != 0.0)
    apart = np.diff(begins)
    if len(apart) < FEWEST_HELD or not is_continuous(values[begins]):
        return 1
    usual = int(np.median(apart))
    return usual if np.mean(apart % usual == 0) > HELD else 1


def _intervals(time: Array, steps: npt.NDArray[np.bool_]) -> tuple[Interval, ...]:
    """Return the intervals between consecutive samples where `steps` is true."""
    return tuple((float(time[k]), float(time[k + 1])) for k in np.flatnonzero(steps))


def _sample_intervals(time: Array, samples: npt.NDArray[np.bool_]) -> tuple[Interval, ...]:
    """Return the intervals of consecutive samples where `samples` is true."""
    edges = np.flatnonzero(np.diff(samples.astype(np.int8), prepend=0, append=0))
    return tuple((float(time[a]), float(time[b - 1]))
                 for a, b in zip(edges[::2], edges[1::2], strict=True))


def _times(intervals: Sequence[Interval]) -> str:
    return f'{len(intervals)} times, ' + place_of(intervals) if len(intervals) > 1 else place_of(
        intervals)
