"""A file of someone else's (CSV, TSV, MAT, NPZ, Parquet) as columns by name."""

import codecs
import csv
import gzip
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from asi_analysis.bags.exchange.units import UNITS
from asi_analysis.errors import InputError

MOST_COLUMNS: Final = 64   # of a matrix in a MAT file
COMMENT: Final = ('#', '%')
_DECIMAL_COMMA: Final = re.compile(r'(?<=\d),(?=\d)')

# column name → its values; a scalar of a MAT file is a column of one value
Table = dict[str, npt.NDArray]


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
    return max('\t;, ', key=lambda mark: sum(map(is_number, next(_cells([line], mark)))))


def _first_of_data(rows: list[list[str]]) -> int:
    """Return the first row that is like one in the middle; before it stand remarks and header."""
    usual = rows[len(rows) // 2]
    enough = 0.5 * sum(map(is_number, usual))
    return next((number for number, row in enumerate(rows) if len(row) >= len(usual) - 1
                 and sum(map(is_number, row)) > enough), len(rows))


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


def is_number(cell: str) -> bool:
    """Tell whether a cell holds a number, or nothing."""
    try:
        float(cell or 'nan')
    except ValueError:
        return False
    return True
