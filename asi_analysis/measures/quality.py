"""
How far the samples of a run can be trusted: gaps, missing samples, clipping, spikes and the like.

`findings` lists what is wrong with a run; `trust` says whether a figure that is computed from a
stretch of it is reliable, doubtful or withheld.
"""

from collections.abc import Iterator, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from asi_analysis.bags.run import CONTROLLED, Run

Array = npt.NDArray[np.float64]
Interval = tuple[float, float]

DOUBTFUL: Final = 'doubtful'
NOTE: Final = 'note'
# Two samples further apart than this many periods have one missing between them.
GAP_PERIODS: Final = 1.5
# Share of a period by which nine tenths of the samples may be early or late.
JITTER: Final = 0.1
# A pause of so many periods, and of so many seconds, is a step of the clock or a second recording.
CLOCK_PERIODS: Final = 1000
CLOCK_S: Final = 10.0
# Samples at the largest or smallest value, one after the other, that are clipped.
CLIPPED_SAMPLES: Final = 4
# A spike is so many times what nine tenths of the samples differ from the median of their five
# neighbours, and this share of the range without it.
SPIKE: Final = 20.0
SPIKE_SHARE: Final = 0.2
# Fewer levels than this are told; fewer than that leave no figure of 2 % of a step.
TOLD_LEVELS: Final = 100
FEWEST_LEVELS: Final = 25
# A controlled signal moves less than this many times as far as its reference, and more than the
# inverse, unless a unit is wrong; told if both move alike.
UNIT_FACTOR: Final = 100.0
ALIKE: Final = 0.7
# Share of its change that an output may make before its reference changes.
BEFORE: Final = 0.3
LOSSES: Final = frozenset(('gap', 'missing'))
# Intervals that are listed of one finding.
LISTED: Final = 20


class Finding(NamedTuple):
    """One thing that is wrong with the samples of a signal."""

    kind: str       # gap, clock_step, time_order, jitter, missing, clipping, spike, ...
    signal: str     # of the run, or 'time'
    severity: str   # doubtful: figures that rest on it are; note: none is
    intervals_s: tuple[Interval, ...]
    text: str

    def to_dict(self) -> dict[str, Any]:
        """Return the finding for JSON: the first intervals, and how many there are."""
        return {'kind': self.kind, 'signal': self.signal, 'severity': self.severity,
                'text': self.text, 'count': len(self.intervals_s),
                'intervals': [{'start_s': start, 'end_s': end}
                              for start, end in self.intervals_s[:LISTED]]}


def findings(run: Run) -> list[Finding]:
    """Return what is wrong with the samples of a run (at least 2), the worst first."""
    found = [*_of_time(run)]
    for name, values in run.signals().items():
        found += _of_signal(run, name, values)
    found += _of_reference(run)
    return sorted(found, key=lambda each: each.severity != DOUBTFUL)


def quality_of(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Return the findings of several runs for JSON, each with its source if there are several."""
    return [finding.to_dict() | (
                {'text': f'{run.source}: {finding.text}'} if len(runs) > 1 else {})
            for run in runs if len(run) > 1 for finding in findings(run)]


class Trust(NamedTuple):
    """Whether a figure is reliable; if not, whether it is withheld, and the reason."""

    reliable: bool
    withheld: bool
    reason: str

    def note(self, figure: str) -> list[str]:
        """Return what is to be said of a figure; nothing if it is reliable."""
        return [] if self.reliable else [
            f'{figure}: {"withheld" if self.withheld else "doubtful"}, because {self.reason}']


def trust(found: Sequence[Finding], run: Run, signals: Sequence[str], start_s: float,
          end_s: float, lost_share: float = 0.0) -> Trust:
    """
    Return how far a figure can be trusted that is computed from these signals, start to end (s).

    It is doubtful where samples of that stretch are; it is withheld if more than a share of the
    stretch is missing, or for any other finding.
    """
    those = [each for each in found
             if each.severity == DOUBTFUL and each.signal in ('time', *signals)
             and any(start <= end_s and end >= start_s for start, end in each.intervals_s)]
    lost_s = sum(min(end, end_s) - max(start, start_s) + run.period_s
                 for each in those if each.kind in LOSSES
                 for start, end in each.intervals_s if start <= end_s and end >= start_s)
    withheld = (any(each.kind not in LOSSES for each in those)
                or lost_s > lost_share * (end_s - start_s))
    return Trust(not those, bool(those) and withheld, '; '.join(each.text for each in those))


def _of_time(run: Run) -> Iterator[Finding]:
    time = run.time_s
    steps = np.diff(time)
    period = float(np.median(steps))
    if (wrong := _intervals(time, steps <= 0.0)):
        yield Finding('time_order', 'time', DOUBTFUL, wrong,
                      f'the time stands still or falls {_times(wrong)}')
    if not period > 0.0:
        return
    late = np.abs(steps - period)
    gaps = steps - period > max((GAP_PERIODS - 1.0) * period, 5.0 * float(np.median(late)))
    usual = float(np.quantile(late[~gaps], 0.9))
    clock = gaps & (steps > max(CLOCK_PERIODS * period, CLOCK_S))
    if (pauses := _intervals(time, clock)):
        yield Finding('clock_step', 'time', DOUBTFUL, pauses,
                      f'the time jumps ahead {_times(pauses)}, by {steps[clock].max():.4g} s at '
                      'most: a step of the clock, or two recordings in one')
    if (missing := _intervals(time, gaps & ~clock)):
        lost = int(np.sum(np.round(steps[gaps & ~clock] / period) - 1.0))
        yield Finding('gap', 'time', DOUBTFUL, missing,
                      f'about {lost} samples are missing in {len(missing)} gaps, '
                      f'{1e3 * steps[gaps & ~clock].max():.4g} ms at most {_where(missing)}')
    if usual > JITTER * period:
        yield Finding('jitter', 'time', NOTE, ((float(time[0]), float(time[-1])),),
                      f'the samples are unevenly spaced: a tenth of them more than '
                      f'{100.0 * usual / period:.0f} % of a period early or late')


def _of_signal(run: Run, name: str, values: Array) -> Iterator[Finding]:
    known = np.isfinite(values)
    if not known.any():
        return
    places = np.flatnonzero(known)
    inside = ~known
    if name in ('reference', 'command'):    # begin with their first message, end with the last
        inside[:places[0]] = False
        inside[places[-1]:] = False
    if inside.any():
        missing = _stretches(run.time_s, inside)
        yield Finding('missing', name, DOUBTFUL, missing,
                      f'{int(inside.sum())} of {len(values)} samples of the {_words(name)} are '
                      f'missing {_where(missing)}')
    if name in ('reference', 'command') or len(places) < 10:
        return
    time, values = run.time_s[places], values[places]
    unit = run.unit(name)
    spikes = _spikes(values)
    if spikes.any():
        where = _stretches(time, spikes)
        yield Finding('spike', name, DOUBTFUL, where,
                      f'the {_words(name)} has {len(where)} spikes of one or two samples, up to '
                      f'{np.abs(values[spikes]).max():.4g} {unit} {_where(where)}')
    for part, limit, word in zip(_clipped(values[~spikes]), _ends(values[~spikes]),
                                 ('smallest', 'largest'), strict=True):
        if part.any():
            where = _stretches(time[~spikes], part)
            yield Finding('clipping', name, DOUBTFUL, where,
                          f'the {_words(name)} stays at its {word} value {limit:.4g} {unit} '
                          f'{_where(where)}: it is clipped, or against a stop')
    level = np.unique(values)
    levels = len(level)
    step = float(np.diff(level).min(initial=np.inf))
    # A signal that comes to rest repeats itself too, but its values are no even grid.
    if 1 < levels < TOLD_LEVELS and len(values) > 10 * levels and (
            step > 1e-3 * (level[-1] - level[0])):
        yield Finding('quantisation', name, DOUBTFUL if levels < FEWEST_LEVELS else NOTE,
                      ((float(time[0]), float(time[-1])),),
                      f'the {_words(name)} has only {levels} different values, {step:.4g} {unit} '
                      'apart')


def _of_reference(run: Run) -> Iterator[Finding]:
    """Compare the signal that the reference asks for with it: unit, and which comes first."""
    if run.reference_n is None or run.unit('reference') not in CONTROLLED:
        return
    name = run.controlled()
    output = run.signals().get(name)
    if output is None:
        return
    both = np.isfinite(run.reference_n) & np.isfinite(output)
    if not both.any():
        return
    time, reference, values = run.time_s[both], run.reference_n[both], output[both]
    whole = ((float(time[0]), float(time[-1])),)
    asked, got = float(np.std(reference)), float(np.std(values))
    if asked > 0.0 and got > 0.0 and not 1.0 / UNIT_FACTOR < got / asked < UNIT_FACTOR:
        alike = np.mean((reference - reference.mean()) * (values - values.mean())) / (asked * got)
        if abs(alike) > ALIKE:
            yield Finding('unit', name, DOUBTFUL, whole,
                          f'the {_words(name)} moves {got / asked:.3g} times as far as its '
                          'reference: is its unit right?')
            return
    early = _answered_before(time, reference, values)
    if early:
        yield Finding('order', name, DOUBTFUL, early,
                      f'the {_words(name)} changes before its reference does {_where(early)}: '
                      'their times do not belong together')


def _answered_before(time: Array, reference: Array, values: Array) -> tuple[Interval, ...]:
    """Return the jumps of a reference whose answer is there before the jump."""
    changes = np.abs(np.diff(reference))
    jumps = np.flatnonzero(changes > 0.2 * max(float(np.ptp(reference)), 1e-300))
    if not 0 < len(jumps) <= 20:
        return ()
    edges = [0, *(int(jump) + 1 for jump in jumps), len(time)]
    found = []
    for begin, jump, end in zip(edges[:-2], edges[1:-1], edges[2:], strict=True):
        if min(jump - begin, end - jump) < 20:
            continue
        before = values[begin:begin + max(1, (jump - begin) // 2)]
        after = values[jump + (end - jump) // 2:end]
        low, high = float(np.median(before)), float(np.median(after))
        change = high - low
        restless = max(float(np.ptp(np.quantile(each, [0.05, 0.95]))) for each in (before, after))
        share = (values[jump - 1] - low) / change if change else 0.0
        if abs(change) > 3.0 * restless and share > BEFORE:
            first = int(np.argmax((values[begin:jump] - low) / change > 0.1)) + begin
            found.append((float(time[first]), float(time[jump])))
    return tuple(found)


def _spikes(values: Array) -> npt.NDArray[np.bool_]:
    """Tell which samples are spikes: one or two that leave their neighbours and come back."""
    smooth = ndimage.median_filter(values, 5, mode='nearest')
    off = np.abs(values - smooth)
    large = off > max(SPIKE * float(np.quantile(off, 0.9)), SPIKE_SHARE * float(np.ptp(smooth)))
    return large if large.sum() <= max(2, 0.01 * len(values)) else np.zeros(len(values), bool)


def _ends(values: Array) -> tuple[float, float]:
    return float(values.min()), float(values.max())


def _clipped(values: Array) -> list[npt.NDArray[np.bool_]]:
    """
    Tell which samples are clipped at the smallest, and at the largest value.

    Clipped is what stays at that value though it reached it at speed: a signal that settles, or is
    only quantised or held, reaches it in steps as small as its smallest.
    """
    begins = np.flatnonzero(np.diff(values, prepend=np.nan) != 0.0)
    lengths = np.diff(begins, append=len(values))
    jumps = np.abs(np.diff(values))
    moving = jumps[jumps > 0.0]
    found = []
    for limit in _ends(values):
        clipped = np.zeros(len(values), bool)
        if len(moving):
            least = max(10.0 * float(np.quantile(moving, 0.02)), 1e-3 * float(np.ptp(values)))
            usual = float(np.quantile(lengths, 0.9))
            for begin, length in zip(begins, lengths, strict=True):
                if (values[begin] == limit and begin > 0
                        and length >= max(CLIPPED_SAMPLES, 3.0 * usual)
                        and jumps[max(begin - 2, 0):begin].max() > least):
                    clipped[begin:begin + length] = True
        found.append(clipped)
    return found


def _intervals(time: Array, steps: npt.NDArray[np.bool_]) -> tuple[Interval, ...]:
    """Return the times before and after the steps from one sample to the next that are marked."""
    return tuple((float(time[k]), float(time[k + 1])) for k in np.flatnonzero(steps))


def _stretches(time: Array, samples: npt.NDArray[np.bool_]) -> tuple[Interval, ...]:
    """Return the stretches of samples that are marked."""
    edges = np.flatnonzero(np.diff(samples.astype(np.int8), prepend=0, append=0))
    return tuple((float(time[a]), float(time[b - 1]))
                 for a, b in zip(edges[::2], edges[1::2], strict=True))


def _words(name: str) -> str:
    return name.replace('_', ' ')


def _times(intervals: Sequence[Interval]) -> str:
    return f'{len(intervals)} times, ' + _where(intervals) if len(intervals) > 1 else _where(
        intervals)


def _where(intervals: Sequence[Interval]) -> str:
    start, end = intervals[0][0], intervals[-1][1]
    return f'at {start:.6g} s' if end - start < 1e-9 else f'between {start:.6g} and {end:.6g} s'
