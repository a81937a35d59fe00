"""
Someone else's recording (CSV, TSV, MAT, Parquet) → `Run` and bag.

What stands where is told by mappings such as `force=CHANNEL1*9806.65[N]`; see doc/importing.md.
"""

import codecs
import csv
import gzip
import math
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from asi_analysis.bag import write_bag
from asi_analysis.errors import InputError, InputWarning
from asi_analysis.run import SIGNALS, Array, Run

# unit → SI unit, factor
UNITS: Final = {
    's': ('s', 1.0), 'ms': ('s', 1e-3), 'us': ('s', 1e-6), 'ns': ('s', 1e-9),
    'N': ('N', 1.0), 'kN': ('N', 1e3), 'kgf': ('N', 9.80665), 'tf': ('N', 9806.65),
    'lbf': ('N', 4.4482216152605),
    'm': ('m', 1.0), 'cm': ('m', 1e-2), 'mm': ('m', 1e-3), 'um': ('m', 1e-6), 'in': ('m', 0.0254),
    'm/s': ('m/s', 1.0), 'cm/s': ('m/s', 1e-2), 'mm/s': ('m/s', 1e-3),
    'Nm': ('Nm', 1.0), 'mNm': ('Nm', 1e-3), 'Ncm': ('Nm', 1e-2), 'kgfcm': ('Nm', 0.0980665),
    'rad': ('rad', 1.0), 'mrad': ('rad', 1e-3), 'deg': ('rad', math.pi / 180.0),
    'rev': ('rad', 2.0 * math.pi),
    'rad/s': ('rad/s', 1.0), 'deg/s': ('rad/s', math.pi / 180.0),
    'rev/s': ('rad/s', 2.0 * math.pi), 'rpm': ('rad/s', math.pi / 30.0),
    'V': ('V', 1.0), 'mV': ('V', 1e-3), 'A': ('A', 1.0), 'mA': ('A', 1e-3),
    '1': ('1', 1.0), '%': ('1', 1e-2)}
# A joint may turn; a servo's reference is in the unit of what it controls; a drive may be
# commanded by a voltage, a current or a share of what it has (PWM).
TAKES: Final = {'time': ('s',), **{signal.name: (signal.unit,) for signal in SIGNALS},
                'position': ('m', 'rad'), 'velocity': ('m/s', 'rad/s'), 'force': ('N', 'Nm'),
                'command': ('N', 'Nm', 'V', 'A', '1'),
                'reference': ('N', 'm', 'm/s', 'Nm', 'rad', 'rad/s')}
MOST_COLUMNS: Final = 64   # of a matrix in a MAT file
MISSING: Final = frozenset(('', 'na', 'n/a', '#n/a', 'null', 'none', '-'))
COMMENT: Final = ('#', '%')
_NUMBER: Final = r'[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?'
_DECIMAL_COMMA: Final = re.compile(r'(?<=\d),(?=\d)')
_TERM: Final = re.compile(
    rf'(?P<column>.+?)(?:\*(?P<scale>{_NUMBER}|[A-Za-z_]\w*))?(?P<offset>[+-]{_NUMBER})?$')

# column name → its values; a scalar of a MAT file is a column of one value
Table = dict[str, npt.NDArray]


class Assignment(NamedTuple):
    """One mapping: signal = (column * scale + offset) in a unit."""

    text: str
    signal: str
    term: str
    unit: str


def import_recording(path: str | Path, mapping: Sequence[str], rate_hz: float | None = None, *,
                     skip_lines: int = 0, delimiter: str | None = None,
                     columns: Sequence[str] | None = None, zero_s: float = 0.0,
                     out: str | Path | None = None) -> Run:
    """
    Return someone else's recording as a run; written as the bag `out` too, if that is given.

    path: .csv, .tsv, .txt, .dat (also .gz), .mat, .npz or .parquet; mapping: texts
    SIGNAL=COLUMN[*SCALE][+OFFSET][[UNIT]], none for the columns that `asi export` writes; rate_hz:
    samples a second, where no column is mapped to time; skip_lines: lines before the header;
    columns: names for a file without a header; zero_s: take off each signal its mean over so many
    seconds from the start. Raises InputError.
    """
    path = Path(path)
    if not zero_s >= 0.0:
        raise InputError(f'zero = {zero_s:g} s is not allowed: it takes 0 or more')
    table = read_table(path, skip_lines, delimiter, columns)
    mappings = [parse_mapping(text) for text in mapping or own_mapping(table)]
    signals = {each.signal: evaluate(each, table, path) for each in mappings}
    if not signals.keys() - {'time'}:
        raise InputError(f'{path}: no signal is mapped; it has the columns {", ".join(table)}')
    if len(signals) < len(mappings):
        raise InputError('a signal is mapped twice: ' + ', '.join(mapping))
    lengths = {name: len(values) for name, (values, _) in signals.items()}
    if len(set(lengths.values())) > 1:
        raise InputError(f'{path}: the columns differ in length: {lengths}')
    length = next(iter(lengths.values()))
    if length < 2:
        raise InputError(f'{path} has a single sample: at least 2 are needed')
    time_s = _time(signals.pop('time', None), length, rate_hz, path)
    new = np.isfinite(time_s)
    new[new] = np.diff(time_s[new], prepend=-1.0) > 0.0
    if not new.all():
        warnings.warn(f'{path}: {np.sum(~new)} of {length} samples have no time, or that of the '
                      'one before, and are left out', InputWarning, stacklevel=2)
    time_s = time_s[new]
    units = {name: unit for name, (_, unit) in signals.items()}
    values = {name: column[new] - _start(column[new], time_s, zero_s, name, path)
              for name, (column, _) in signals.items()}
    information: dict[str, Any] = {'imported': {
        'file': path.name, 'mapping': [each.text for each in mappings], 'zero_s': zero_s}}
    usual = {signal.name: signal.unit for signal in SIGNALS}
    unusual = {name: unit for name, unit in units.items() if unit != usual[name]}
    if unusual:
        information['signals'] = unusual
    arrays: dict[str, Any] = {signal.field: values.get(signal.name) for signal in SIGNALS}
    run = Run(time_s, **arrays, source=str(path), information=information)
    if out is not None:
        write_bag(run, out)
    return run


def parse_mapping(text: str) -> Assignment:
    """Return the parts of a mapping. Raises InputError if it is none."""
    signal, equals, term = text.partition('=')
    signal, term, unit = signal.strip(), term.strip(), ''
    if not equals or not term:
        raise InputError(f'{text!r} is not a mapping: expected '
                         'SIGNAL=COLUMN[*SCALE][+OFFSET][UNIT]')
    if signal not in TAKES:
        raise InputError(f'{text!r}: there is no signal {signal}; there are {", ".join(TAKES)}')
    if found := re.fullmatch(r'(.*?)\s*\[([^\[\]]*)\]', term):
        term, unit = found[1], found[2].strip()
        allowed = [name for name, (si, _) in UNITS.items() if si in TAKES[signal]]
        if unit not in allowed:
            hint = ('a commanded motion is a reference' if signal == 'command' and UNITS.get(
                unit, ('',))[0] in ('m', 'rad', 'm/s', 'rad/s') else
                'scale other quantities, as in force=volts*250[N] or position=counts*0.088[deg]')
            raise InputError(f'{text!r}: {signal} takes {", ".join(allowed)}, not {unit!r}; '
                             + hint)
    return Assignment(text, signal, term, unit or TAKES[signal][0])


def own_mapping(table: Table) -> list[str]:
    """Return the mappings of the columns that `asi export` writes."""
    names = {f'{signal}_{unit.replace("/", "_").lower()}': f'{signal}={{}}[{unit}]'
             for signal, units in TAKES.items() for unit in units}
    return [names[column].format(column) for column in table if column in names]


def evaluate(mapping: Assignment, table: Table, path: Path) -> tuple[Array, str]:
    """Return the values of a mapping in SI units, and the unit. Raises InputError."""
    whole = mapping.text.partition('=')[2].strip()
    # The unit may stand in the header: `torque [Nm]`.
    term, scale, offset = whole if whole in table else mapping.term, 1.0, 0.0
    if term not in table:
        found = _TERM.fullmatch(term)
        if found is None or found['column'].strip() not in table:
            raise InputError(f'{path}: {mapping.text!r} names no column; there are '
                             + ', '.join(table))
        term = found['column'].strip()
        scale = _scale(found['scale'], table, mapping, path)
        offset = float(found['offset'] or 0.0)
    unit, factor = UNITS[mapping.unit]
    if mapping.signal == 'time' and (seconds := _since_first(table[term])) is not None:
        return seconds, 's'
    values = _numbers(term, table[term], path)
    if scale != 1.0 or offset != 0.0:
        values = values * scale + offset
    return (values if factor == 1.0 else values * factor), unit


def _scale(text: str | None, table: Table, mapping: Assignment, path: Path) -> float:
    if text is None:
        return 1.0
    if text in table:
        if np.size(table[text]) != 1:
            raise InputError(f'{path}: {mapping.text!r}: {text} holds {np.size(table[text])} '
                             'values, a scale is one')
        return float(_numbers(text, table[text], path)[0])
    try:
        return float(text)
    except ValueError:
        raise InputError(f'{path}: {mapping.text!r}: the scale {text!r} is neither a number nor '
                         'one of ' + ', '.join(table)) from None


def _since_first(column: npt.NDArray) -> Array | None:
    """Return the seconds since the first of a column of dates with time; None if it is none."""
    try:
        if not np.issubdtype(column.dtype, np.datetime64):
            if _is_number(str(column[0])):
                return None
            # Of a time of day any date will do.
            day = '' if '-' in str(column[0]) else '1970-01-01T'
            column = np.array([day + str(cell).removesuffix('Z') for cell in column],
                              'datetime64[ns]')
        return (column - column[0]) / np.timedelta64(1, 's')
    except (ValueError, IndexError):
        return None


def _numbers(name: str, column: npt.NDArray, path: Path) -> Array:
    """Return a column as numbers, NaN where a cell is empty."""
    if np.issubdtype(column.dtype, np.number):
        values = np.ravel(column).astype(float)
    else:
        values = np.full(len(column), np.nan)
        for row, cell in enumerate(column):
            if str(cell).strip().lower() not in MISSING:
                try:
                    values[row] = float(cell)
                except ValueError:
                    raise InputError(f'{path}: column {name}, row {row + 1}: {cell!r} is not a '
                                     'number') from None
    if np.isinf(values).any():
        raise InputError(f'{path}: column {name}, row {int(np.argmax(np.isinf(values))) + 1}: '
                         'infinite')
    return values


def _time(mapped: tuple[Array, str] | None, count: int, rate_hz: float | None, path: Path
          ) -> Array:
    if (mapped is None) == (rate_hz is None):
        raise InputError(f'{path}: expected either a mapping time=COLUMN or a rate in Hz')
    if mapped is None:
        if rate_hz is None or not 0.0 < rate_hz < np.inf:
            raise InputError(f'rate = {rate_hz} Hz is not allowed: it must be above 0')
        return np.arange(count) / rate_hz
    known = np.flatnonzero(np.isfinite(mapped[0]))
    steps = np.diff(mapped[0][known])
    if not (steps > 0.0).any() or (steps < 0.0).any():
        row = known[int(np.argmax(steps < 0.0)) + 1] + 1 if len(steps) else 1
        raise InputError(f'{path}: time does not rise at row {row}')
    return mapped[0] - mapped[0][known[0]]


def _start(values: Array, time_s: Array, zero_s: float, name: str, path: Path) -> float:
    """Return the mean of the first `zero_s` seconds; 0 for none."""
    if not zero_s:
        return 0.0
    first = values[time_s < zero_s]
    if np.isnan(first).all():
        raise InputError(f'{path}: {name} has no value in the first {zero_s:g} s')
    return float(np.nanmean(first))


def read_table(path: Path, skip_lines: int = 0, delimiter: str | None = None,
               columns: Sequence[str] | None = None) -> Table:
    """Return the columns of a file by name. Raises InputError."""
    kind = Path(path.stem).suffix if path.suffix == '.gz' else path.suffix
    try:
        if kind == '.mat':
            return _read_mat(path)
        if kind == '.npz':
            with np.load(path) as arrays:
                return _columns(arrays)
        if kind == '.parquet':
            return _read_parquet(path)
        if kind in ('.csv', '.tsv', '.txt', '.dat'):
            return _read_text(path, skip_lines, delimiter, columns)
    except OSError as error:
        raise InputError(f'{path} cannot be read: {error.strerror or error}') from None
    except (ValueError, EOFError, NotImplementedError, TypeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f'{path} cannot be read: {" ".join(str(error).split())}') from None
    raise InputError(f'{path}: expected a .csv, .tsv, .txt, .dat (also .gz), .mat, .npz or '
                     '.parquet file')


def _read_mat(path: Path) -> Table:
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError
    try:
        variables = loadmat(path)
    except MatReadError as error:
        raise ValueError(error) from None
    return _columns({variable: values for variable, values in variables.items()
                     if not variable.startswith('__')})


def _columns(variables: Mapping[str, npt.NDArray]) -> Table:
    return {name: column for variable, values in variables.items()
            for name, column in _columns_of(variable, values)}


def _columns_of(name: str, values: npt.NDArray) -> Iterator[tuple[str, npt.NDArray]]:
    """
    Yield what a variable holds: a vector, columns name#1 ..., fields name.x.

    Of a cell array, or an array of structures, each element: name#1, name#1.x ...
    """
    if values.dtype.names or values.dtype == object:
        for number, element in enumerate(np.ravel(values)[:MOST_COLUMNS], 1):
            one = name if values.size == 1 else f'{name}#{number}'
            if values.dtype.names:
                for field in values.dtype.names:
                    yield from _columns_of(f'{one}.{field}', np.asarray(element[field]))
            else:
                yield from _columns_of(one, np.asarray(element))
    elif not np.issubdtype(values.dtype, np.number):
        return
    elif values.size == max(values.shape, default=0):
        yield name, np.ravel(values)
    elif values.ndim == 2 and min(values.shape) <= MOST_COLUMNS:
        by_column = values if values.shape[0] > values.shape[1] else values.T
        for number, column in enumerate(by_column.T, 1):
            yield f'{name}#{number}', column


def _read_parquet(path: Path) -> Table:
    from pyarrow.parquet import read_table as read_parquet
    table = read_parquet(path)
    found: Table = {}
    for name in table.column_names:
        column = table[name].to_numpy()
        if len(column) and isinstance(column[0], np.ndarray):   # a list in each row
            found |= _columns({name: np.stack(column)})
        else:
            found[name] = column
    return found


def _read_text(path: Path, skip_lines: int, delimiter: str | None,
               columns: Sequence[str] | None) -> Table:
    raw = gzip.decompress(path.read_bytes()) if path.suffix == '.gz' else path.read_bytes()
    lines = [line for line in _decoded(raw).splitlines(keepends=True)[skip_lines:]
             if line.strip()]
    if not lines:
        raise InputError(f'{path} is empty' + (f' after {skip_lines} lines' if skip_lines else ''))
    if delimiter is not None and len(delimiter) != 1:
        raise InputError(f'delimiter = {delimiter!r} is not allowed: it takes one character')
    delimiter = delimiter or _delimiter(lines[len(lines) // 2])
    rows = list(_cells(lines, delimiter))
    start = _first_of_data(rows)
    if columns is None:
        columns = _header(lines[:start], delimiter, len(rows[len(rows) // 2]))
    rows = [row for row in rows[start:] if not row[0].startswith(COMMENT)]
    if not rows:
        raise InputError(f'{path} has no rows')
    short = next((i for i, row in enumerate(rows) if len(row) < len(columns) - 1), None)
    if short is not None:
        raise InputError(f'{path}: row {short + 1} has {len(rows[short])} cells, expected '
                         f'{len(columns)}')
    # A last column of remarks may be left out, or hold the delimiter.
    padded: Iterable[tuple[str, ...]] = zip(*[[*row, ''][:len(columns)] for row in rows],
                                            strict=True)
    names = [name if name not in columns[:number] else f'{name}#{columns[:number].count(name) + 1}'
             for number, name in enumerate(columns)]
    return {name: np.array(cells, object) for name, cells in zip(names, padded, strict=True)}


def _decoded(raw: bytes) -> str:
    """Return a text in UTF-8, UTF-16 or, as older programs write it, Windows-1252."""
    if raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return raw.decode('utf-16')
    try:
        return raw.decode('utf-8-sig')
    except UnicodeDecodeError:
        return raw.decode('cp1252')


def _delimiter(line: str) -> str:
    """Return what separates the cells of a row of data: that which makes most numbers of it."""
    return max('\t;, ', key=lambda mark: sum(map(_is_number, next(_cells([line], mark)))))


def _first_of_data(rows: list[list[str]]) -> int:
    """Return the first row that is like one in the middle; before it stand remarks and header."""
    usual = rows[len(rows) // 2]
    enough = 0.5 * sum(map(_is_number, usual))
    return next((number for number, row in enumerate(rows) if len(row) >= len(usual) - 1
                 and sum(map(_is_number, row)) > enough), len(rows))


def _header(before: list[str], delimiter: str, width: int) -> list[str]:
    """
    Return the names of `width` columns: the last line before the data that may hold them.

    It is not one of units; and where blanks part the cells, none of the names may hold one.
    """
    for line in reversed(before):
        names = next(_cells([line.lstrip('#% ')], delimiter))
        units = all(name in UNITS or name[:1] in ('', '[', '(') for name in names)
        if not units and abs(len(names) - width) <= (delimiter != ' '):
            return names
    return [f'#{number}' for number in range(1, width + 1)]


def _cells(lines: Iterable[str], delimiter: str) -> Iterator[list[str]]:
    if delimiter in ' ,':   # a row of Matlab's
        lines = (line.rstrip(' ;\r\n') for line in lines)
    if delimiter != ',':
        lines = (_DECIMAL_COMMA.sub('.', line) if ',' in line else line for line in lines)
    if delimiter == ' ':
        return (line.split() for line in lines)
    reader = csv.reader(lines, delimiter=delimiter, skipinitialspace=True)
    return ([cell.strip() for cell in row] for row in reader)


def _is_number(cell: str) -> bool:
    try:
        float(cell or 'nan')
    except ValueError:
        return False
    return True
