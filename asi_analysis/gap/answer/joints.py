"""`asi gap --joint all`: every joint of a robot, diagnosed by itself, in one table."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from asi_analysis import parallel
from asi_analysis.bags.run import Array, Run
from asi_analysis.errors import InputError, InputWarning
from asi_analysis.gap.answer.command import diagnose
from asi_analysis.gap.answer.export import (
    Exported,
    exported,
    file_of,
    for_each_joint,
    write_joints,
)
from asi_analysis.gap.answer.export import (
    in_words as exports_in_words,
)
from asi_analysis.gap.answer.joint_files import JOINT as ALONE
from asi_analysis.gap.answer.result import Gap
from asi_analysis.gap.model.predict import measured, predict
from asi_analysis.gap.words import chance, in_words, percent, sizes_in_words, together
from asi_analysis.reporting.result import Result, Table
from asi_analysis.terminal import Progress, silent

COUPLING_RATE_HZ: Final = 25.0   # at which the joints are compared with each other
COUPLED: Final = 0.2             # share of what is left of a joint that another explains
SHIFTS: Final = 20               # times at which a motion is tried that it was not at
CHANCE: Final = 1.1              # least of these times leave so many times the power


class Rest(NamedTuple):
    """The residual of a recording after the diagnosis: values at times, s."""

    time_s: Array
    left: Array


class JointGaps(Result):
    """The diagnoses of the joints of a robot: `diagnose_joints`."""

    title = 'The sim-to-real gap of each joint'
    rows = 'joints'

    def parts(self) -> Iterator[str | Table]:
        columns = ('joint', 'what was found', 'probability', 'size (95 % interval)', 'nominal',
                   'improved', 'noise')
        yield Table(columns, [_row(each) for each in self.joints],
                    'error (rms) as a share of the signal', (columns[2], *columns[4:]))
        for each in self.joints:
            if each['coupled']:
                yield (f'{each["joint"]}: {percent(each["coupling"])} of what is left of it '
                       f'moves with {each["coupled"]}')
        yield from (f'note: {note}' for note in self.notes)
        yield from exports_in_words(self.exports, several=True)


def _row(joint: Mapping[str, Any]) -> list[str]:
    answer = joint['answer']
    if answer is None:
        return [joint['joint'], 'not diagnosed: see the note', *5 * ['']]
    found = answer['verdict'].split('+')
    words = ' and '.join(in_words(name, 'joint') for name in found)
    others = [verdict for verdict in answer['ambiguity_set'] if verdict != answer['verdict']]
    if others:
        words += f' (or {", or ".join(together(each, "joint") for each in others)})'
    if answer['baseline']:
        change = answer['baseline']['change']
        words = {'none': 'no change', 'cannot_tell': f'uncertain: {words}'}.get(change, words)
    if not answer['reliable']:
        words += ' (doubtful samples)'
    sizes: list[str] = []
    known: list[str] = []   # told with another effect
    for row in answer['which']:
        if row['effect'] in found:
            sizes.append(sizes_in_words(row, known))
            known += row['parameters']
    gap = answer['gap']
    return [joint['joint'], words, chance(answer['probability']), '; '.join(filter(None, sizes)),
            *(percent(gap[f'{name}_nrmse']) for name in ('before', 'after', 'noise_floor'))]


def diagnose_joints(recordings: Mapping[str, Sequence[Run]],
                    baseline: Mapping[str, Sequence[Run]] | None = None,
                    held_out: Mapping[str, Sequence[Run]] | None = None,
                    report: Path | None = None, progress: Progress = silent,
                    exports: Sequence[Path] = (), **options: Any) -> JointGaps:
    """
    Return the diagnosis of each joint, by `diagnose` with these options, in parallel.

    recordings, baseline, held_out: by the name of the joint; report: directory for a report of
    each; exports: files for a simulator, of all joints or, with {joint} in their names, of each;
    a directory: a parameter file of each. A joint that cannot be diagnosed has its error instead.
    Raises InputError if none can.
    Use it in `parallel.workers`.
    """
    work = [(runs, options | {'baseline': (baseline or {}).get(joint, ()),
                              'held_out': (held_out or {}).get(joint, ())},
             report and report / joint, bool(exports)) for joint, runs in recordings.items()]
    for kind, others in (('healthy', baseline), ('held-out', held_out)):
        for joint in sorted(recordings.keys() - (others or recordings).keys()):
            raise InputError(f'{joint}: no {kind} recording of this joint')
    rows, rests = [], {}
    found: dict[str, Exported] = {}
    refused: list[str] = []
    for number, (joint, (answer, error, left, export)) in enumerate(zip(
            recordings, parallel.each(_diagnosed, work), strict=True)):
        rows.append({'joint': joint, 'error': error, 'answer': answer, 'coupled': None,
                     'coupling': None})
        rests[joint] = left
        if isinstance(export, Exported):
            found[joint] = export
        elif answer is None:
            refused.append(f'{joint} is not diagnosed{" or exported" if exports else ""}: {error}')
        elif exports:
            refused.append(f'not in the exports: {joint}: {export}')
        progress(f'{number + 1} of {len(recordings)} joints', (number + 1) / len(recordings))
    if all(row['answer'] is None for row in rows):
        raise InputError('; '.join(f'{row["joint"]}: {row["error"]}' for row in rows))
    one_clock = all(np.array_equal(run.time_s, other.time_s) for runs in recordings.values()
                    for run, other in zip(runs, next(iter(recordings.values())), strict=False))
    for row in rows if one_clock else ():
        row['coupled'], row['coupling'] = _coupled(row['joint'], rests, recordings)
    written = _written(exports, found, recordings)
    return JointGaps({'joints': rows, 'exports': written, 'notes': [
        *refused,
        'each joint is diagnosed by itself: what the others do to it is in what is left of it',
        'the joints have the same times: one clock' if one_clock else
        'the joints have times of their own, so that what is left of one is not compared with '
        'the motion of another']})


def _written(paths: Sequence[Path], found: Mapping[str, Exported],
             recordings: Mapping[str, Sequence[Run]]) -> list[dict[str, Any]]:
    """Write the joints into files; return the rows of `exports`."""
    rows = []
    for path in paths if found else ():
        each = for_each_joint(path)
        if each is None:
            rows.append(write_joints(found, path, [
                run.source for joint in found for run in recordings[joint]]))
            continue
        each.parent.mkdir(parents=True, exist_ok=True)
        rows += [write_joints({ALONE: export}, file_of(each, joint),
                              [run.source for run in recordings[joint]])
                 for joint, export in found.items()]
    return rows


def _diagnosed(runs: Sequence[Run], options: Mapping[str, Any], report: Path | None, export: bool
               ) -> tuple[dict[str, Any] | None, str | None, list[Rest], Exported | str | None]:
    """
    Return the document of a joint, or why there is none, and its residuals.

    Last, if it is to be written: what is, or why it cannot be.
    """
    with warnings.catch_warnings():   # they are among the notes
        warnings.simplefilter('ignore', InputWarning)
        try:
            gap = diagnose(runs, plant='joint', **options)
        except InputError as error:
            return None, str(error), [], str(error)
        if report:
            gap.write_report(report)
    ready: Exported | str | None = None
    if export:
        try:
            ready = exported(gap.diagnosis, gap.model or {})
        except InputError as error:
            ready = str(error)
    return gap.to_dict(), None, _rests(gap), ready


def _rests(gap: Gap) -> list[Rest]:
    """Return the residual of each recording, in the channel of the gap."""
    diagnosis, channel = gap.diagnosis, gap['gap']['channel']
    weighed = diagnosis.compared(channel)
    record = diagnosis.best(weighed).fitted.record
    return [Rest(run.time_s[0] + recording.time_s, np.where(
                recording.valid, measured(recording, channel)
                - predict(recording, channel, record), np.nan))
            for run, recording in zip(diagnosis.runs, weighed.group.recordings, strict=True)]


def _coupled(joint: str, rests: Mapping[str, Sequence[Rest]],
             recordings: Mapping[str, Sequence[Run]]) -> tuple[str | None, float | None]:
    """
    Return the other joint whose motion explains most of the residual of one, and its share.

    By linear least squares on position, velocity and acceleration, beyond what the joint's own
    motion explains. (None, None): none explains COUPLED.
    """
    shares = {other: float(np.mean([
        _explained(rest, own, run) for rest, own, run in zip(
            rests[joint], recordings[joint], recordings[other], strict=False)] or [0.0]))
        for other in recordings if other != joint}
    other = max(shares, key=lambda name: shares[name], default=None)
    if other is None or shares[other] < COUPLED:
        return None, None
    return other, shares[other]


def _explained(rest: Rest, own: Run, other: Run) -> float:
    """Return the share of the residual that another joint's motion explains beyond the own."""
    edges = np.arange(rest.time_s[0], rest.time_s[-1], 1.0 / COUPLING_RATE_HZ)
    left = _means(rest.time_s, rest.left, edges)
    mine, beside = _motion(own, edges), _motion(other, edges)
    if mine is None or beside is None:
        return 0.0
    alone = np.column_stack([np.ones(left.size), mine])
    known = np.isfinite(left) & np.isfinite(alone).all(axis=1) & np.isfinite(beside).all(axis=1)
    if known.sum() < 4 * (alone.shape[1] + beside.shape[1]):
        return 0.0
    alone, beside, left = alone[known], beside[known], left[known]

    def power(*columns: Array) -> float:
        shapes = np.column_stack(columns)
        shapes /= np.sqrt(np.mean(shapes ** 2, axis=0)) + 1e-300
        return float(np.mean((left - shapes @ np.linalg.lstsq(shapes, left)[0]) ** 2))

    # The same motion at another time explains as much as chance does.
    found = power(alone, beside)
    by_chance = min(power(alone, np.roll(beside, shift, axis=0))
                    for shift in np.arange(1, SHIFTS) * len(left) // SHIFTS)
    if by_chance < CHANCE * found:
        return 0.0
    return (power(alone) - found) / max(float(np.var(left)), 1e-300)


def _motion(run: Run, edges: Array) -> Array | None:
    """Return position, velocity and acceleration (n x 3) between edges; None: not recorded."""
    signals = run.signals()
    if 'position' in signals:
        position = _means(run.time_s, signals['position'], edges)
    elif 'velocity' in signals:
        position = np.cumsum(np.nan_to_num(_means(run.time_s, signals['velocity'], edges)))
    else:
        return None
    speed = np.gradient(position)
    return np.column_stack([position, speed, np.gradient(speed)])


def _means(time_s: Array, values: Array, edges: Array) -> Array:
    """Return the mean value between edges, NaN where there is none."""
    known = np.isfinite(values)
    place = np.digitize(time_s[known], edges) - 1
    inside = (place >= 0) & (place < edges.size - 1)
    count = np.bincount(place[inside], minlength=edges.size - 1)
    total = np.bincount(place[inside], values[known][inside], minlength=edges.size - 1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
