"""A recording in several files, as commands and states, each with its own times of one clock."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from asi_analysis.arrays import Array
from asi_analysis.bags.exchange.column_mapping import (
    Assignment,
    column_of,
    evaluate,
    listed,
    parse_mapping,
)
from asi_analysis.bags.exchange.dates import holds_moments
from asi_analysis.bags.exchange.table_file import Table
from asi_analysis.errors import InputError, InputWarning

# Times that differ by less than this share of a step are equal.
CLOSE: Final = 1e-3
# Least ratio of a step between samples to the usual one at which it is a gap.
GAP: Final = 1.5
Signals = dict[str, tuple[Array, str]]


class _File(NamedTuple):
    path: Path
    table: Table
    mappings: list[Assignment]


def read_several(tables: dict[Path, Table], mapping: Sequence[str]) -> Signals:
    """
    Return the signals of several files at the times of the first, and `time`.

    A value of another file is held until its next. A column of one file only is called by its
    name, any other FILE/COLUMN, FILE without its suffix. Raises InputError.
    """
    files = [_File(path, table, []) for path, table in tables.items()]
    if len({file.path.stem for file in files}) < len(files):
        raise InputError('the files have the same name: ' + ', '.join(str(f.path) for f in files))
    for text in mapping:
        _assign(text, files)
    times = _times(files)
    base, signals = times[0], {'time': (times[0], 's')}
    for file, time_s in zip(files, times, strict=True):
        own = [each for each in file.mappings if each.signal != 'time']
        if not own:
            raise InputError(f'{file.path}: no signal of it is mapped; it has the columns '
                             + listed(file.table))
        for each in own:
            if each.signal in signals:
                raise InputError(f'a signal is mapped twice: {each.text}')
            values, unit = evaluate(each, file.table, file.path)
            signals[each.signal] = (_held(file, time_s, values, base), unit)
    return signals


def _assign(text: str, files: list[_File]) -> None:
    """Assign a mapping to the file that has its column; the mapping of time to every such file."""
    found = []
    for file in files:
        signal, _, term = text.partition('=')
        named = term.strip().startswith(f'{file.path.stem}/')
        own = f'{signal}={term.strip().removeprefix(f"{file.path.stem}/")}'
        assignment = parse_mapping(own)
        if column_of(assignment, file.table) is not None:
            found.append((file, assignment, named))
    chosen = [each for each in found if each[2]] or found
    if not chosen:
        raise InputError(f'{text!r} names no column; there are ' + '; '.join(
            f'{file.path.stem}/: {listed(file.table)}' for file in files))
    if len(chosen) > 1 and chosen[0][1].signal != 'time':
        raise InputError(f'{text!r} is a column of ' + ' and of '.join(
            str(file.path) for file, *_ in chosen)
            + f': write {chosen[0][1].signal}={chosen[0][0].path.stem}/...')
    for file, assignment, _ in chosen:
        file.mappings.append(assignment)


def _times(files: list[_File]) -> list[Array]:
    """Return the times of each file (s), on one clock."""
    mapped = []
    for file in files:
        own = [each for each in file.mappings if each.signal == 'time']
        if len(own) != 1:
            raise InputError(f'{file.path}: {len(own)} columns are mapped to time, expected one: '
                             f'time=COLUMN, or time={file.path.stem}/COLUMN for this file alone')
        mapped.append(own[0])
    names = [column_of(each, file.table) or '' for file, each in zip(files, mapped, strict=True)]
    columns = [file.table[name] for file, name in zip(files, names, strict=True)]
    dated = [holds_moments(column) for column in columns]
    if any(dated) and not all(dated):
        raise InputError(f'{files[dated.index(False)].path}: its time is a number, that of '
                         f'{files[dated.index(True)].path} a date: they are not of one clock')
    if any(dated):      # dates are read together: their seconds are since the first of all
        together, path = _together(columns), Path(' and '.join(str(file.path) for file in files))
        ends = np.cumsum([len(column) for column in columns])
        times = [evaluate(each, {name: together}, path)[0][end - len(column):end]
                 for each, name, column, end in zip(mapped, names, columns, ends, strict=True)]
    else:
        times = [evaluate(each, file.table, file.path)[0]
                 for file, each in zip(files, mapped, strict=True)]
    for file, time_s in zip(files, times, strict=True):
        known = time_s[np.isfinite(time_s)]
        if len(known) < 2 or (np.diff(known) < 0.0).any():
            raise InputError(f'{file.path}: time does not rise')
        first = times[0][np.isfinite(times[0])]
        if known[-1] < first[0] or known[0] > first[-1]:
            raise InputError(
                f'{file.path}: its times, {known[0]:.6g} to {known[-1]:.6g} s, do not overlap '
                f'those of {files[0].path}, {first[0]:.6g} to {first[-1]:.6g} s: are they of one '
                'clock? An offset is part of the mapping, as time=t+3.2')
    return times


def _together(columns: list[npt.NDArray]) -> npt.NDArray:
    """Return columns of dates as one; of texts and dates of a Parquet file as texts."""
    kinds = {column.dtype.kind for column in columns}
    if kinds in ({'m'}, {'M'}):
        return np.concatenate(columns)
    return np.concatenate([
        (np.datetime_as_string(column) if column.dtype.kind == 'M' else column).astype(object)
        for column in columns])


def _held(file: _File, time_s: Array, values: Array, base: Array) -> Array:
    """Return values at the times `base`, each held until the next; NaN before the first."""
    if time_s is base:
        return values
    known = np.isfinite(time_s)
    times, values = time_s[known], values[known]
    # A difference far below the step of the first file is a rounding error.
    close = CLOSE * float(np.nanmedian(np.diff(base)))
    last = np.searchsorted(times, base + close, side='right') - 1
    steps = np.diff(times)
    step, longest = float(np.median(steps)), float(steps.max())
    held = np.where((last >= 0) & (base <= times[-1] + step), values[np.maximum(last, 0)], np.nan)
    lost = float(np.mean(~np.isfinite(held[np.isfinite(base)])))
    warnings.warn(
        f'{file.path}: begins {times[0] - np.nanmin(base):+.6g} s after the first file; a value '
        f'is held until the next, {step:.4g} s later'
        + (f', up to {longest:.4g} s across a gap' if longest > GAP * step else '')
        + (f'; {100.0 * lost:.3g} % of the samples have none' if lost else ''),
        InputWarning, stacklevel=2)
    return held
