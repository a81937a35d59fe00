"""
Consistency of the signals of a run with each other: units, signs, timing, altered samples.

The controlled signal is compared with its reference, the command with both, and the position with
the velocity.
"""

import math
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from asi_analysis.arrays import Array, Mask
from asi_analysis.bags.run import CONTROLLED, Run
from asi_analysis.measures.checks.breaks import frozen, jumps, spikes, straight
from asi_analysis.measures.checks.causality import (
    SOON,
    begins_against,
    in_time,
    moves_against_steps,
    of_exchange,
    of_noise,
    of_order,
    of_rows,
)
from asi_analysis.measures.checks.control_law import ControlLaw, control_law, delayed_signal
from asi_analysis.measures.checks.dead_time import only_repeats
from asi_analysis.measures.checks.lost_rows import kept_between_lost, skipped_in_motion
from asi_analysis.measures.correlation import CLEARLY, largest_correlation
from asi_analysis.measures.finding import (
    DOUBTFUL,
    NOTE,
    Finding,
    Interval,
    name_of,
    place_of,
    whole_run,
)

# Ratio of the standard deviations of a controlled signal and its reference above which (or below
# the inverse) a unit is probably wrong, if their correlation exceeds CORRELATED; above the square
# in any case. Below SAME_SIZE the signal does not follow, and is not compared further.
UNIT_FACTOR: Final = 100.0
DECADE: Final = 0.1     # largest distance of log10 of a ratio of units from a whole number
SAME_SIZE: Final = 0.3
CORRELATED: Final = 0.7
# The same ratio to a command of the same unit.
COMMAND_FACTOR: Final = 30.0
# Ratio of the position to the integral of the velocity above which a unit is wrong; least
# correlation of the two; the same for another signal than the velocity; largest change of the
# velocity in a period (rms, as a share of it) for an integral.
MOTION_FACTOR: Final = 1.5
AGREE: Final = 0.98
AGREE_OTHER: Final = 0.995
RESOLVED: Final = 0.5
# Parts of a run that are compared, and least number of samples in each.
MOTION_PARTS: Final = 8
MOTION_SAMPLES: Final = 20
# A jump of the position is larger than each of these: a multiple of the motion by the largest
# velocity within so many samples, a multiple of the noise, and a share of the range.
JUMP_FACTOR: Final = 5.0
JUMP_SAMPLES: Final = 10
JUMP_NOISE: Final = 20.0
JUMP_SHARE: Final = 1e-3
EQUAL: Final = 0.1      # largest difference of several jumps that are the resolution, as a share
# Gain from a signal to a command of the same unit outside which a unit is probably wrong; within
# the usual range it is probably right.
MOST_GAIN: Final = 1000.0
LEAST_GAIN: Final = 0.01
USUAL_GAIN: Final = (0.05, 100.0)
COPIED: Final = 10      # samples equal to the reference: a measured signal is never a copy
FAR: Final = 30.0       # distance from the reference, in ranges of both, that is a wrong offset
STEADY_ERROR: Final = 0.1   # of a loop that has settled, as a share of the reference
FEWEST_CHANGES: Final = 4   # of a measured signal that follows a reference
BROKEN: Final = {'jump': 'jumps from one sample to the next',
                 'interpolated': 'is on a straight line, without its noise,',
                 'frozen': 'is constant while it should move'}
# Signals whose derivative a controller has too, of a sensor of its own: a command that does not
# follow from the recorded samples of these shows nothing.
DIFFERENTIATED: Final = ('position', 'velocity')
# Findings that concern the whole run, after which it is not compared further.
WHOLE: Final = frozenset(('unit', 'sign', 'order', 'time_order'))


def of_reference(run: Run, as_recorded: bool = False) -> Iterator[Finding]:
    """
    Compare the controlled signal with its reference: unit, sign and timing.

    as_recorded: the command is known to be the controller's response to both.
    """
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
    whole = whole_run(time)
    for other in ('reference', 'command'):
        if len(values) >= COPIED and np.ptp(values) > 0.0 and other in run.signals() and (
                values == run.signal(other)[both]).all():
            yield Finding('copy', name, DOUBTFUL, whole,
                          f'the {name_of(name)} equals its {other} in every sample: '
                          'is it measured?')
            return
    if len(values) >= COPIED and 0 < np.count_nonzero(np.diff(values)) <= FEWEST_CHANGES and (
            not only_repeats(reference, values)):
        yield Finding('clipping', name, DOUBTFUL, whole,
                      f'the {name_of(name)} only jumps, and is constant in between: it is cut off')
        return
    if wrong := _rests(run, name, reference, values):
        yield wrong
        return
    ratio, strange = _ratio(run, reference, values, both)
    by_command = (_ByCommand([], True, True, True, True) if as_recorded else
                  _of_command(run, name, ratio, _correlation(reference, values)))
    yield from by_command.findings
    yield from _of_command_unit(run, name, ratio, both)
    yield from of_exchange(run, name)
    if any(each.kind in WHOLE for each in by_command.findings):
        return
    if strange and not by_command.same_unit:
        yield Finding('unit', name, DOUBTFUL, whole,
                      f'the {name_of(name)} moves {ratio:.3g} times as far as its '
                      'reference: is its unit right?')
        return
    if ratio < SAME_SIZE:
        if failed := [part for part in frozen(values) if part[1] == len(values) - 1]:
            yield _of_parts('frozen', name, time, failed)
        return
    if not by_command.same_sign and _moves_against(reference, values) and _moves_against(
            *in_time(reference, values)):
        yield Finding('sign', name, DOUBTFUL, whole,
                      f'the {name_of(name)} moves against its reference: is its sign right?')
        return
    for each in _of_continuity(name, time, reference, values):
        if each.kind != 'jump' or not by_command.same_samples:
            yield each
    if not as_recorded:
        yield from of_rows(run, name, time, reference, values)
    if not by_command.same_time:
        yield from of_order(run, name, time, reference, values)
    if not as_recorded and not by_command.same_samples:
        yield from of_noise(run, name)


def _moves_against(reference: Array, values: Array) -> bool:
    """Return whether a signal moves against its reference: at its steps, or by correlation."""
    if moves_against_steps(reference, values, SAME_SIZE):
        return True
    against, lag = largest_correlation(reference, -values)
    return against > CORRELATED and 0.0 <= lag < SOON * len(values) and (
        begins_against(reference, values, SAME_SIZE)
        or largest_correlation(reference, values, SOON)[0] < CLEARLY * against)


def _rests(run: Run, name: str, reference: Array, values: Array) -> Finding | None:
    """Return a finding on a signal that is constant, or far from its reference."""
    whole = whole_run(run.time_s)
    span, moved = float(np.ptp(reference)), float(np.ptp(values))
    command = reference if run.command_n is None else run.command_n[np.isfinite(run.command_n)]
    commanded = len(command) > 0 and np.ptp(command) > 0.0 and all(
        each.state == 'enabled' for each in run.states)
    others = any(_changes(each) for signal, each in run.signals().items()
                 if signal not in (name, 'reference', 'command'))
    if len(values) >= COPIED and span > 0.0 and moved == 0.0 and (commanded or others):
        return Finding('still', name, DOUBTFUL, whole,
                       f'the {name_of(name)} does not change at all: is it measured?')
    away = float(np.median(np.abs(values - reference)))
    wanted = float(np.median(reference))
    # Without an integrator it settles below its reference; at a tenth the unit would be wrong.
    settled = away < STEADY_ERROR * abs(wanted) or 10.0 ** -0.5 <= float(np.median(values)) / (
        wanted or np.inf) <= 1.0
    if away > FAR * max(span, moved) > 0.0 and not settled:
        return Finding('unit', name, DOUBTFUL, whole,
                       f'the {name_of(name)} is {away:.4g} {run.unit(name)} from its reference, '
                       f'{away / max(span, moved):.3g} times as far as either moves: is its zero '
                       'right?')
    return None


def _changes(values: Array) -> bool:
    known = values[np.isfinite(values)]
    return len(known) > 0 and float(np.ptp(known)) > 0.0


def _correlation(a: Array, b: Array) -> float:
    """Return the correlation coefficient, 0 if one of the signals is constant."""
    return float(np.corrcoef(a, b)[0, 1]) if np.ptp(a) > 0.0 and np.ptp(b) > 0.0 else 0.0


def _ratio(run: Run, reference: Array, values: Array, both: npt.NDArray[np.bool_]
           ) -> tuple[float, bool]:
    """Return the ratio of the standard deviations, and whether the unit is probably wrong."""
    # A constant has a standard deviation of rounding errors.
    reference_sd, output_sd = (float(np.std(each)) if np.ptp(each) > 0.0 else 0.0
                               for each in (reference, values))
    ratio = output_sd / reference_sd if reference_sd > 0.0 and output_sd > 0.0 else 1.0
    if 1.0 / UNIT_FACTOR < ratio < UNIT_FACTOR:
        return ratio, False
    if ratio < UNIT_FACTOR ** -3:
        return ratio, True
    strange = ratio > UNIT_FACTOR ** 2 or abs(_correlation(reference, values)) > CORRELATED
    if not strange and run.command_n is not None and run.unit('command') == run.unit('reference'):
        strange = output_sd > COMMAND_FACTOR * float(np.nanstd(run.command_n[both]))
    if ratio < 1.0:
        # A freely moving piston has a small force too, but the ratio is no power of ten.
        strange = strange and abs(math.log10(ratio) - round(math.log10(ratio))) < DECADE
    return ratio, strange


def _of_continuity(name: str, time: Array, reference: Array, values: Array
                   ) -> Iterator[Finding]:
    """Yield the findings on jumps and frozen samples of a signal, apart from its spikes."""
    kept = ~spikes(values, reference, same_unit=True)
    time, reference, values = time[kept], reference[kept], values[kept]
    jumped = jumps(time, reference, values)
    # What a reference explains late is none, though it is later than the model remembers. Of one
    # that only steps, the delay may be that of the jump itself.
    if jumped and np.mean(np.diff(reference) != 0.0) > 0.5:
        delayed = in_time(reference, values)
        jumped = jumped if jumps(time[len(time) - len(delayed[1]):], *delayed) else []
    for kind, parts in (('jump', jumped), ('frozen', frozen(values)),
                        ('interpolated', straight(values))):
        if parts:
            yield _of_parts(kind, name, time, parts)


def _of_parts(kind: str, name: str, time: Array, parts: list[tuple[int, int]]) -> Finding:
    """Return one finding for parts, each given by its first and last sample."""
    where = tuple((float(time[first]), float(time[last])) for first, last in parts)
    return Finding(kind, name, DOUBTFUL, where,
                   f'the {name_of(name)} {BROKEN[kind]} {place_of(where)}')


def _of_command_unit(run: Run, name: str, moved: float, both: npt.NDArray[np.bool_]
                     ) -> Iterator[Finding]:
    """Yield a finding if a signal moves as far as its reference (by `moved`), not its command."""
    if run.command_n is None or run.unit('command') != run.unit(name) or not (
            SAME_SIZE < moved < 1.0 / SAME_SIZE):
        return
    command = run.command_n[both & np.isfinite(run.command_n)]
    if len(command) and 0.0 < UNIT_FACTOR * float(np.std(command)) < float(
            np.std(run.signal(name)[both])):
        yield Finding('unit', 'command', DOUBTFUL, whole_run(run.time_s),
                      f'the {name_of(name)} moves more than {UNIT_FACTOR:g} times as far as its '
                      'command: is the unit of the command right?')


class _ByCommand(NamedTuple):
    """What the command shows: findings, and what of signal and reference is certainly right."""

    findings: list[Finding]
    same_unit: bool = False
    same_sign: bool = False
    same_time: bool = False
    same_samples: bool = False      # those that the controller had, so that jumps are genuine


def _of_command(run: Run, name: str, moved: float, correlation: float) -> _ByCommand:
    """
    Compare the command with the response of a controller to reference and controlled signal.

    moved: standard deviation of the signal over that of its reference; correlation: of both.
    """
    if run.command_n is None or run.reference_n is None:
        return _ByCommand([])
    time, signals = run.time_s, (run.command_n, run.reference_n, run.signal(name))
    whole, words = whole_run(time), name_of(name)
    found = control_law(time, *signals)
    if found is not None and found.exact and found.is_stable is False:
        return _ByCommand([Finding(
            'time_order', 'time', DOUBTFUL, whole,
            'each command follows from later samples: the recording runs backwards')])
    if found is None or not found.everywhere:
        if found_late := list(_of_delay(run, name)):
            return _ByCommand(found_late)
    if found is None:
        return _ByCommand(list(_of_lost_rows(run, name)))
    if name in DIFFERENTIATED:
        found = found.of_servo()
    problems = []
    alike = run.unit('command') == run.unit(name)
    if wrong := _wrong_unit(found, words, moved if alike else 1.0, correlation):
        problems.append(Finding(wrong[0], name, DOUBTFUL, whole, wrong[1]))
    for part in found.breaks:
        # After lost rows all later samples have wrong times.
        where = ((float(time[part.first]), float(time[-1 if part.lost else part.last])),)
        what = ('the command does not respond to reference and {} as in the rest of the run {}: '
                'samples were lost, repeated or altered' if part.factor is None else
                f'the command responds to {part.factor:.4g} times the {{}} {part.offset:+.4g} '
                f'{run.unit(name)} {{}}: it was altered after the controller had it')
        if part.backwards:
            what = 'each command follows from later samples {1}: this part runs backwards'
        problems.append(Finding('time_order' if part.backwards else 'answer',
                                'time' if part.backwards or part.factor is None else name,
                                DOUBTFUL, where, what.format(words, place_of(where))))
    usual = alike and USUAL_GAIN[0] < abs(found.signal) < USUAL_GAIN[1]
    return _ByCommand(problems, usual or found.factor == 1.0,
                      found.everywhere and found.signal < 0.0 and not found.reference < 0.0,
                      # It responds to the sample of the same time; later ones any signal may fit.
                      found.everywhere and not np.isnan(found.signal) and bool(found.is_stable),
                      found.everywhere and found.of_all and found.has_memory)


def _wrong_unit(found: ControlLaw, words: str, moved: float, correlation: float
                ) -> tuple[str, str] | None:
    """Return kind and text of a finding on unit or sign; None if there is nothing wrong."""
    factor, size = found.factor, abs(found.signal)
    if np.isnan(size):
        return None
    if factor not in (None, 1.0, -1.0):
        return 'unit', (f'the command responds to 1/{factor:.4g} of the {words} as to the '
                        'reference: is the unit of each right?')
    sure = factor is None and found.exact and (found.is_stable or not found.has_memory)
    if factor == -1.0 or sure and found.signal > 0.0 and (
            found.reference > 0.0 or correlation < 0.0):
        return 'sign', f'the command rises with the {words}: is its sign right?'
    if sure and found.reference < 0.0 and correlation < 0.0:
        return 'sign', (f'the command falls with the reference and with the {words}, which moves '
                        'against its reference: is its sign right?')
    ratio = abs(found.reference / found.signal)
    if factor is None and (ratio > UNIT_FACTOR or ratio < 1.0 / UNIT_FACTOR or (
            np.isnan(ratio) and (size > MOST_GAIN and moved < SAME_SIZE
                                or size < LEAST_GAIN and moved > 1.0 / SAME_SIZE))):
        return 'unit', (f'the command changes by {size:.3g} times the change of the {words}'
                        + ('' if np.isnan(ratio) else
                           f', and by {ratio:.3g} times as much with the reference')
                        + ': is its unit right?')
    return None


def _of_delay(run: Run, name: str) -> Iterator[Finding]:
    """Yield a finding if the control law shows that one of its signals was recorded late."""
    signals = (run.signal('command'), run.signal('reference'), run.signal(name))
    whole, words = whole_run(run.time_s), name_of(name)
    which, samples = delayed_signal(run.time_s, *signals)
    if which:
        signal, word = (name, words) if which == 'signal' else (which, which)
        if which == 'command' and np.count_nonzero(np.diff(run.signal('reference'))) <= 1:
            signal = 'time'     # it is as if the other two were early
        late = f'{1e3 * samples * run.period_s:.4g} ms'
        yield Finding('order', signal, DOUBTFUL, whole, (
            f'the command is recorded {late} after it responds to the {words}'
            if which == 'command' else
            f'the command responds to the {word} {late} before it is recorded'
            ) + ': they are not synchronised')


def _of_lost_rows(run: Run, name: str) -> Iterator[Finding]:
    """Yield a note if the command follows from the rows before it except at each n-th."""
    kept = kept_between_lost(run.time_s, run.signal('command'), run.signal('reference'),
                             run.signal(name))
    if kept:
        yield Finding('missing', 'time', NOTE, whole_run(run.time_s),
                      f'the command follows from the rows before it, but not after each {kept}: '
                      'rows were lost there, or a part of the controller has a lower rate')


def of_motion(run: Run) -> Iterator[Finding]:
    """Compare the position with the integral of the velocity: their units, and that of time."""
    if run.position_m is None or run.velocity_m_s is None or (
            run.unit('velocity') != f'{run.unit("position")}/s'):
        return
    known = np.flatnonzero(np.isfinite(run.position_m) & np.isfinite(run.velocity_m_s))
    if len(known) < MOTION_PARTS * MOTION_SAMPLES:
        return
    if jumped := _position_jumps(run, known):
        yield Finding('motion', 'time', DOUBTFUL, jumped,
                      f'the position jumps {place_of(jumped)} without a velocity that explains '
                      'it: samples were lost, or altered')
    if skipped := skipped_in_motion(*(each[known] for each in (
            run.time_s, run.position_m, run.velocity_m_s))):
        yield Finding('missing', 'time', DOUBTFUL, skipped,
                      f'the position moves on as after more samples {place_of(skipped)}, '
                      f'{len(skipped)} times: rows were lost there')
    whole = _position_ratio(run, known, run.velocity_m_s)
    if whole is None and (other := _exchanged(run, known)):
        time = ((float(run.time_s[known[0]]), float(run.time_s[known[-1]])),)
        yield Finding('motion', 'time', DOUBTFUL, time,
                      f'the position is the integral of the {name_of(other)}, not of the '
                      'velocity: are they exchanged?')
        return
    parts = [known] if whole and not _near_one(whole) else np.array_split(known, MOTION_PARTS)
    ratios = [_position_ratio(run, part, run.velocity_m_s) for part in parts]
    wrong = [(ratio, part) for ratio, part in zip(ratios, parts, strict=True)
             if ratio and not _near_one(ratio)]
    if wrong:
        where = tuple((float(run.time_s[part[0]]), float(run.time_s[part[-1]]))
                      for _, part in wrong)
        yield Finding('motion', 'time', DOUBTFUL, where,
                      f'the position changes by {wrong[0][0]:.3g} times the integral of the '
                      f'velocity {place_of(where)}: is the time right, and both units and signs?')


def _position_jumps(run: Run, known: npt.NDArray[np.intp]) -> tuple[Interval, ...]:
    """Return where the position jumps in one period, much farther than its velocity explains."""
    assert run.position_m is not None
    assert run.velocity_m_s is not None
    time, position, velocity = run.time_s[known], run.position_m[known], run.velocity_m_s[known]
    periods, moved = np.diff(time), np.abs(np.diff(position))
    beside = ndimage.maximum_filter1d(np.abs(velocity), 2 * JUMP_SAMPLES + 1)
    longest = np.maximum(periods, run.period_s)     # stamps may be late
    # A velocity may be filtered, or late; a jump is larger than other changes around it too.
    others = ndimage.maximum_filter(moved, footprint=np.abs(
        np.arange(-JUMP_SAMPLES, JUMP_SAMPLES + 1)) > 1)
    expected = JUMP_FACTOR * np.maximum(longest * np.maximum(beside[1:], beside[:-1]), others)
    # The usual unexplained motion: noise, or the resolution.
    usual = max(float(np.quantile(moved - np.minimum(moved, expected / JUMP_FACTOR), 0.9)),
                float(moved[moved > 0.0].min(initial=np.inf)))
    jumped = (moved > expected) & (moved > JUMP_NOISE * usual) & (
        moved > JUMP_SHARE * float(np.ptp(position))) & (periods < 1.5 * run.period_s)
    if jumped.sum() > 2 and np.ptp(moved[jumped]) < EQUAL * moved[jumped].min():
        return ()       # its resolution
    return tuple((float(time[k]), float(time[k + 1])) for k in np.flatnonzero(jumped))


def moved_by(run: Run, present: npt.NDArray[np.intp]) -> Mask:
    """Return at which of these samples the position confirms a peak of the velocity."""
    moved = np.zeros(len(present), bool)
    if run.position_m is None or run.velocity_m_s is None or len(present) < 5 or (
            run.unit('velocity') != f'{run.unit("position")}/s'):
        return moved
    time, position, velocity = (each[present] for each in (
        run.time_s, run.position_m, run.velocity_m_s))
    way = np.append(0.0, np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * np.diff(time)))
    around = 2      # a peak takes up to two samples
    step, expected = (each[2 * around:] - each[:-2 * around] for each in (position, way))
    without = 0.5 * (velocity[2 * around:] + velocity[:-2 * around]) * (
        time[2 * around:] - time[:-2 * around])
    moved[around:-around] = np.abs(step - expected) < 0.5 * np.abs(expected - without)
    return moved


def _near_one(ratio: float) -> bool:
    return 1.0 / MOTION_FACTOR < ratio < MOTION_FACTOR


def _exchanged(run: Run, known: npt.NDArray[np.intp]) -> str:
    """Return the name of the signal that the position is the integral of; '' if there is none."""
    return next((name for name, values in run.signals().items()
                 if name not in ('position', 'velocity', 'reference')
                 and np.isfinite(values[known]).all() and run.velocity_m_s is not None
                 and np.ptp(run.velocity_m_s[known]) > 0.0
                 and _position_ratio(run, known, values, AGREE_OTHER) is not None), '')


def _position_ratio(run: Run, part: npt.NDArray[np.intp], values: Array, agree: float = AGREE
                    ) -> float | None:
    """
    Return the ratio of the position to the integral of a velocity of n samples.

    None if their correlation is below `agree`, or the samples are too far apart for an integral.
    """
    assert run.position_m is not None
    time, position, velocity = run.time_s[part], run.position_m[part], values[part]
    if np.mean(np.diff(velocity) ** 2) > RESOLVED ** 2 * np.mean(velocity ** 2):
        return None
    way = np.append(0.0, np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * np.diff(time)))
    for apart in (1, len(part) // 20):
        moved, expected = (each[apart:] - each[:-apart] for each in (position, way))
        sizes = np.sqrt(np.mean(moved ** 2)), np.sqrt(np.mean(expected ** 2))
        if min(sizes) > 0.0 and abs(alike := np.mean(moved * expected) / np.prod(sizes)) > agree:
            return float(np.copysign(sizes[0] / sizes[1], alike))
    return None
