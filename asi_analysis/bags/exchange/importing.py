"""Import a recording of another system as `Run` and bag; see doc/how_to/importing.md."""

import json
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from asi_analysis.arrays import Array, Mask
from asi_analysis.bags.bag import read_bag, write_bag
from asi_analysis.bags.bag_writer import INFORMATION
from asi_analysis.bags.exchange.bag_table import is_bag, read_bag_table
from asi_analysis.bags.exchange.column_mapping import (
    DATE,
    SIGNED,
    Assignment,
    evaluate,
    listed,
    own_mapping,
    parse_mapping,
    with_stated_unit,
)
from asi_analysis.bags.exchange.joints import JOINT, bags_in, folder_name, joints_of
from asi_analysis.bags.exchange.lerobot import is_dataset, refuse_episode, refuse_visual
from asi_analysis.bags.exchange.preview import message_types
from asi_analysis.bags.exchange.several_files import Signals, read_several
from asi_analysis.bags.exchange.table_file import Table, read_table
from asi_analysis.bags.information import checked, missing_ticks
from asi_analysis.bags.run import SIGNALS, Run
from asi_analysis.errors import InputError, InputWarning, input_warnings
from asi_common.topics import PISTON

LEAST_RATE_HZ: Final = 1e-6
MOST_RATE_HZ: Final = 1e8
LONGEST_S: Final = 1e9
# Share of samples that may have the time of the one before; of 2 ms at 1 kHz it is a half, in a
# log of ROS by others 0.14.
MOST_ROUNDED: Final = 1 / 3


def import_recording(path: str | Path | Sequence[str | Path], mapping: Sequence[str],
                     rate_hz: float | None = None, *,
                     skip_lines: int = 0, delimiter: str | None = None,
                     columns: Sequence[str] | None = None, zero_s: float = 0.0,
                     episode: int | None = None, out: str | Path | None = None) -> Run:
    r"""
    Return a recording of another system as a run; also written as the bag `out`, if given.

    path: a table (TEXTS and READERS of `table_file.py`), the folder of a LeRobot dataset, a
    rosbag2, or a .bag of ROS 1; or several tables, each with its time, of which the first gives
    the samples; mapping: texts `SIGNAL=COLUMN[*SCALE][+OFFSET][[UNIT]]`, none for
    a file of `asi export`; rate_hz: sampling rate, if no column is mapped to time (a bag has its
    own times); skip_lines: lines before the header; columns: names for a file without a header;
    zero_s: subtract from each signal its mean over this time from the start, s; episode: of a
    LeRobot dataset with several. Raises InputError.

    >>> import pathlib, tempfile
    >>> import asi_analysis as asi
    >>> file = pathlib.Path(tempfile.mkdtemp(), 'log.csv')
    >>> _ = file.write_text('t,load\n0,0.0\n1,0.5\n2,1.0\n')
    >>> run = asi.import_recording(file, ['time=t[ms]', 'force=load[kN]'])
    >>> run.force_n.tolist()
    [0.0, 500.0, 1000.0]
    """
    paths = [Path(path)] if isinstance(path, str | Path) else [Path(each) for each in path]
    with input_warnings() as warned:
        run = _imported(paths, list(mapping), rate_hz, skip_lines, delimiter, columns, zero_s,
                        episode)
    run = _with_problems(run, warned)
    if out is not None:
        write_bag(run, out)
    return run


def _imported(paths: list[Path], texts: list[str], rate_hz: float | None, skip_lines: int,
              delimiter: str | None, columns: Sequence[str] | None, zero_s: float,
              episode: int | None) -> Run:
    """Return the run of `import_recording`; what it leaves out is told by warnings."""
    exported = not texts and zero_s == 0.0
    earlier: dict[str, Any] = {}
    if len(paths) > 1:
        if rate_hz is not None or any(is_bag(each) or is_dataset(each) for each in paths):
            raise InputError('several files are tables with a time each: import bags, datasets, '
                             'and files with a rate, one by one')
        signals = read_several({each: read_table(each, skip_lines, delimiter, columns, episode)
                                for each in paths}, texts)
    else:
        texts, table, earlier = _read(paths[0], texts, rate_hz, skip_lines, delimiter, columns,
                                      episode)
        signals = _evaluated([parse_mapping(text) for text in texts], table, paths[0])
        texts = [with_stated_unit(text, table) for text in texts]
    run = _run(signals, texts, paths, rate_hz, zero_s, earlier)
    return _with_exported(run, paths[0]) if exported else run


def _with_problems(run: Run, texts: Sequence[str]) -> Run:
    """Return a run that keeps, also in its bag, the warnings of its import."""
    problems = (*run.problems, *texts)
    if not problems:
        return run
    imported = run.information['imported'] | {'problems': list(problems)}
    return replace(run, information=run.information | {'imported': imported}, problems=problems)


def _with_exported(run: Run, path: Path) -> Run:
    """Return a run with the information that `asi export` has put in its Parquet file, if any."""
    if path.suffix != '.parquet':
        return run
    from pyarrow.parquet import read_schema
    problems: list[str] = []
    text = (read_schema(path).metadata or {}).get(INFORMATION.encode(), b'{}')
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict):
        problems.append(f'{path}: its metadata {INFORMATION} cannot be read, and is left out')
        found = {}
    found.pop('signals', None)      # the columns tell the units
    earlier = checked(found, problems, str(path))
    imported = earlier.get('imported', {}) | run.information['imported']
    information = earlier | run.information | {'imported': imported}
    if count := missing_ticks(information, len(run)):
        problems.append(f'{path}: {count} of the {len(run) + count} samples of this run are not '
                        'in the file')
    for problem in problems:
        warnings.warn(problem, InputWarning, stacklevel=3)
    return replace(run, information=information, lacking=count,
                   problems=tuple(imported.get('problems', ())))


def import_joints(path: str | Path, mapping: Sequence[str], rate_hz: float | None = None, *,
                  skip_lines: int = 0, delimiter: str | None = None,
                  columns: Sequence[str] | None = None, zero_s: float = 0.0,
                  episode: int | None = None, out: str | Path | None = None) -> dict[str, Run]:
    """
    Return a recording of several joints, by the name of the joint; their times are the same.

    mapping: `{joint}` stands for the name, as in `position=/joint_states/{joint}/position[rad]`;
    out: a folder for a bag of each joint. The rest is as of `import_recording`.
    """
    path = Path(path)
    with input_warnings() as warned:
        texts, table, earlier = _read(path, list(mapping), rate_hz, skip_lines, delimiter,
                                      columns, episode)
        runs = {joint: _run(_evaluated([parse_mapping(text) for text in own], table, path), own,
                            [path], rate_hz, zero_s, earlier)
                for joint, own in joints_of(texts, table, path).items()}
    runs = {joint: _with_problems(run, warned) for joint, run in runs.items()}
    for joint, run in runs.items() if out is not None else ():
        write_bag(run, Path(str(out), folder_name(joint)))
    return runs


def read_joints(paths: Sequence[Path]) -> dict[str, list[Run]]:
    """
    Return the runs of each joint of the first recording, by its name.

    paths: bags with joint states, or folders of `import_joints`. Of joint states the effort is
    the force; they have no units: those of joints that turn are assumed. Raises InputError.
    """
    found = [_joints_in(path) for path in paths]
    for path, each in zip(paths, found, strict=True):
        if missing := found[0].keys() - each.keys():
            raise InputError(f'{path}: no joint {", ".join(sorted(missing))}; it has '
                             + ', '.join(each))
    return {joint: [each[joint] for each in found] for joint in (found[0] if found else ())}


def read_joint(paths: Sequence[Path], joint: str) -> list[Run]:
    """Return the runs of one joint; as `read_joints`."""
    found = read_joints(paths)
    if joint not in found:      # a folder has other names
        joint = folder_name(joint)
    if paths and joint not in found:
        raise InputError(f'{paths[0]}: ' + (
            'it is of one joint, which has no name: leave out --joint' if PISTON in found else
            f'no joint {joint}; it has {", ".join(found)}'))
    return found.get(joint, [])


def _joints_in(path: Path) -> dict[str, Run]:
    if not is_bag(path) or (path.is_dir() and not (path / 'metadata.yaml').exists()):
        return {joint: read_bag(bag) for joint, bag in bags_in(path).items()}
    topics = [name for name, type_ in message_types(path).items()
              if type_.endswith('/JointState')]
    if len(topics) != 1:
        raise InputError(f'{path}: joint states in {" and ".join(topics) or "no topic"}: import '
                         f'one topic with {JOINT} in the mapping')
    topic = topics[0]
    table, _ = read_bag_table(path, [f'{topic}/'])
    return import_joints(path, [
        f'{signal}={topic}/{JOINT}/{field}[{unit}]' for signal, field, unit in (
            ('position', 'position', 'rad'), ('velocity', 'velocity', 'rad/s'),
            ('force', 'effort', 'Nm'))
        if any(name.endswith(f'/{field}') and _varies(values)
               for name, values in table.items())])


def _varies(values: Array) -> bool:
    """Return whether a column holds at least two different values."""
    known = values[np.isfinite(values)]
    return bool(known.size) and float(np.ptp(known)) > 0.0


def _read(path: Path, texts: list[str], rate_hz: float | None, skip_lines: int,
          delimiter: str | None, columns: Sequence[str] | None, episode: int | None
          ) -> tuple[list[str], Table, dict[str, Any]]:
    """Return the mapping, completed by the file or bag, its columns, and its own import."""
    if not is_bag(path):
        if is_dataset(path):
            refuse_visual(path, [parse_mapping(text).term for text in texts])
        table = read_table(path, skip_lines, delimiter, columns, episode)
        return texts or own_mapping(table), table, {}
    refuse_episode(path, episode)
    texts = texts + ['time=time'] * (rate_hz is None and not any(
        parse_mapping(text).signal == 'time' for text in texts))
    terms = [each.term for each in map(parse_mapping, texts) if each.signal != 'time']
    return texts, *read_bag_table(path, terms)


def _run(signals: Signals, texts: Sequence[str], paths: Sequence[Path], rate_hz: float | None,
         zero_s: float, earlier: Mapping[str, Any]) -> Run:
    """
    Return the run of signals with their units. Raises InputError.

    earlier: the import by which a bag was written that is imported again.
    """
    if not zero_s >= 0.0:
        raise InputError(f'zero = {zero_s:g} s is not allowed: it takes 0 or more')
    path = paths[0]
    _check_reference(signals, texts, path)
    _check_turning(signals, texts, path)
    length = len(next(iter(signals.values()))[0])
    mapped = signals.pop('time', None)
    time_s = _time(mapped, length, rate_hz, path)
    repeated = _repeated(time_s, [column for column, _ in signals.values()], path)
    valid = _usable(time_s, path)
    time_s = time_s[valid]
    units = {name: unit for name, (_, unit) in signals.items()}
    values = {name: column[valid] - _start_mean(column[valid], time_s, zero_s, name, path)
              for name, (column, _) in signals.items()}
    information: dict[str, Any] = {'imported': {
        'file': ', '.join(each.name for each in paths), 'mapping': texts, 'zero_s': zero_s}}
    if mapped is not None and mapped[1] == DATE:
        information['imported']['dates'] = True
    if left_out := sorted({*repeated.tolist(), *earlier.get('repeated_times_s', ())}):
        information['imported']['repeated_times_s'] = left_out
    usual = {signal.name: signal.unit for signal in SIGNALS}
    unusual = {name: unit for name, unit in units.items() if unit != usual[name]}
    if unusual:
        information['signals'] = unusual
    arrays: dict[str, Any] = {signal.field: values.get(signal.name) for signal in SIGNALS}
    return Run(time_s, **arrays, source=str(path), information=information)


def _check_reference(signals: Signals, texts: Sequence[str], path: Path) -> None:
    """Raise InputError for a reference without a unit that need not be a force."""
    text = next((each for each in texts if each.partition('=')[0].strip() == 'reference'), '')
    others = [name for name in ('position', 'velocity', 'pressure') if name in signals]
    if text and not text.rstrip().endswith(']') and others and 'force' not in signals and (
            signals['reference'][1] == 'N'):    # the column states no other unit
        unit = signals[others[0]][1]
        raise InputError(f'{path}: {text!r} has no unit, and would be a force in N, which is not '
                         f'mapped: write {text}[{unit}] if it is that of the {others[0]}')


def _check_turning(signals: Signals, texts: Sequence[str], path: Path) -> None:
    """Warn of a motion without a unit, which is taken in m, beside a torque or an angle."""
    turning = [name for name, (_, unit) in signals.items() if unit in ('Nm', 'rad', 'rad/s')]
    for text in texts:
        name = text.partition('=')[0].strip()
        if turning and name in ('position', 'velocity') and name in signals and (
                signals[name][1] in ('m', 'm/s') and not text.rstrip().endswith(']')):
            unit = {'m': 'rad', 'm/s': 'rad/s'}[signals[name][1]]
            warnings.warn(f'{path}: {text!r} has no unit and is taken in {signals[name][1]}, '
                          f'beside {signals[turning[0]][1]} of the {turning[0]}: write '
                          f'{text}[{unit}] if the joint turns', InputWarning, stacklevel=2)


def _evaluated(mappings: Sequence[Assignment], table: Table, path: Path
               ) -> Signals:
    """Return values and unit of each signal, all of one length. Raises InputError."""
    signals = {each.signal: evaluate(each, table, path) for each in mappings}
    if not signals.keys() - {'time'}:
        raise InputError(f'{path}: no signal is mapped; it has the columns {listed(table)}')
    if len(signals) < len(mappings):
        raise InputError('a signal is mapped twice: ' + ', '.join(each.text for each in mappings))
    lengths = {name: len(values) for name, (values, _) in signals.items()}
    if len(set(lengths.values())) > 1:
        raise InputError(f'{path}: the columns differ in length: {lengths}')
    if max(lengths.values()) < 2:
        raise InputError(f'{path} has a single sample: at least 2 are needed')
    return signals


def _time(mapped: tuple[Array, str] | None, count: int, rate_hz: float | None, path: Path
          ) -> Array:
    if (mapped is None) == (rate_hz is None):
        raise InputError(f'{path}: expected either a mapping time=COLUMN or a rate in Hz')
    if mapped is None:
        if rate_hz is None or not LEAST_RATE_HZ <= rate_hz <= MOST_RATE_HZ:
            raise InputError(f'rate = {rate_hz} Hz is not allowed: it must be above 0, from '
                             f'{LEAST_RATE_HZ:g} to {MOST_RATE_HZ:g}')
        return np.arange(count) / rate_hz
    known = np.flatnonzero(np.isfinite(mapped[0]))
    steps = np.diff(mapped[0][known])
    if not (steps > 0.0).any() or (steps < 0.0).any():
        row = known[int(np.argmax(steps < 0.0)) + 1] + 1 if len(steps) else 1
        raise InputError(f'{path}: time does not rise at row {row}{_wrap_of(steps)}')
    return mapped[0] - mapped[0][known[0]]


def _wrap_of(steps: Array) -> str:
    """Return how to read a time whose counter of 16 or 32 bits began again, if it seems to."""
    fall_s = -float(steps.min(initial=0.0))
    kind = next((kind for kind, span in SIGNED.items() for unit_s in (1.0, 1e-3, 1e-6, 1e-9)
                 if 0.9 * span < fall_s / unit_s <= span), '')
    return (f': if its counter began again, map it with the scale {kind}, as in time=t*{kind}[ms]'
            if kind else '')


def _repeated(time_s: Array, columns: Sequence[Array], path: Path) -> Array:
    """
    Return the times, s, of samples that have the time of the one before, but other values.

    Raises InputError if these are many.
    """
    changes = np.any([(column[1:] != column[:-1]) & np.isfinite(column[1:])
                      & np.isfinite(column[:-1]) for column in columns], axis=0)
    repeated = (np.diff(time_s) == 0.0) & changes
    rounded = int(np.sum(repeated))
    if rounded > MOST_ROUNDED * len(time_s) and rounded > 1:
        raise InputError(f'{path}: {rounded} of {len(time_s)} samples have the time of the one '
                         'before, but other values: the time is rounded; leave it out of the '
                         'mapping and give the rate (--rate)')
    return time_s[1:][repeated]


def _usable(time_s: Array, path: Path) -> Mask:
    """Return which samples have a time after that of the one before. Raises InputError."""
    valid = np.isfinite(time_s)
    valid[valid] = np.diff(time_s[valid], prepend=-1.0) > 0.0
    if not valid.all():
        warnings.warn(f'{path}: {np.sum(~valid)} of {len(valid)} samples have no time, or that of '
                      'the one before, and are left out', InputWarning, stacklevel=3)
    time_s = time_s[valid]
    # Stamps are whole nanoseconds in 64 bits.
    if len(time_s) < 2 or time_s[-1] > LONGEST_S or np.diff(time_s).min() < 1e-9:
        raise InputError(f'{path}: its {len(time_s)} samples last {time_s[-1]:g} s: expected '
                         f'samples at least 1 ns apart, {LONGEST_S:g} s at most; is the unit of '
                         'time, or the rate, right?')
    return valid


def _start_mean(values: Array, time_s: Array, zero_s: float, name: str, path: Path) -> float:
    """Return the mean over the first `zero_s` seconds; 0 for zero_s = 0."""
    if not zero_s:
        return 0.0
    first = values[time_s < zero_s]
    if np.isnan(first).all():
        raise InputError(f'{path}: {name} has no value in the first {zero_s:g} s')
    return float(np.nanmean(first))
