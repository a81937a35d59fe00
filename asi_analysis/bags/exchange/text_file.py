"""Read a text file (CSV, TSV, ...) as columns by name, in blocks of rows."""

import codecs
import csv
import gzip
import io
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain, islice
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from asi_analysis.bags.exchange.units import UNITS
from asi_analysis.bags.limits import IF_INTENDED, unpack_limit
from asi_analysis.errors import InputError

COMMENT: Final = ('#', '%')
MISSING: Final = frozenset(('', 'na', 'n/a', '#n/a', 'null', 'none', '-', 'nan'))
# Lines at the start of a file in which delimiter, header and first row of data are looked for.
HEAD_LINES: Final = 1000
BLOCK_ROWS: Final = 20_000
# Limits: characters of a line, columns, unpacked bytes, and their ratio to the compressed ones.
MOST_LINE: Final = 2**20
MOST_COLUMNS: Final = 4096
MOST_UNPACKED: Final = 100_000_000
MOST_RATIO: Final = 20
# Cells that are no numbers; numpy 1.26, of Ubuntu 24.04, has no type for texts of any length.
TEXT: Final = getattr(np.dtypes, 'StringDType', lambda: np.dtype(object))()
# LabVIEW writes -19m for -0.019.
SI_NUMBER: Final = re.compile(r'([+-]?(?:\d+\.?\d*|\.\d+))([pnuµmkMG])')
SI_PREFIX: Final = {'p': 1e-12, 'n': 1e-9, 'u': 1e-6, 'µ': 1e-6, 'm': 1e-3, 'k': 1e3, 'M': 1e6,
                    'G': 1e9}
# A list in a cell: [1, 2], (1; 2), [1 2] of numpy, or array('d', [1, 2]) of a ROS message.
_LIST: Final = re.compile(r"(?:\w+\((?:'\w', *)?)?[\[(]([^\[\]()]*)[\])](?:, *\w+=[\w.]+)?\)?")
_DECIMAL_COMMA: Final = re.compile(r'(?<=\d),(?=\d)')

codecs.register_error('windows-1252', lambda error: (   # the encoding of older programs
    error.object[error.start:error.end].decode('cp1252', 'replace'), error.end)
    if isinstance(error, UnicodeDecodeError) else ('?', 0))


def unpacked_limit(path: Path) -> int:
    """Return the largest number of bytes to which the compressed data of a file may unpack."""
    return unpack_limit(path.stat().st_size, MOST_UNPACKED, MOST_RATIO)


@contextmanager
def unpacked(path: Path) -> Iterator[gzip.GzipFile | io.BufferedReader]:
    """
    Yield the content of a file, unpacked if its name says so.

    Raises InputError if that is too much, before it is read: its cells take minutes.
    """
    if path.suffix != '.gz':
        with path.open('rb') as raw:
            yield raw
        return
    limit = unpacked_limit(path)
    with gzip.open(path) as packed:
        while packed.read(MOST_LINE):
            if packed.tell() > limit:
                raise InputError(f'{path} unpacks to more than {limit / 1e6:.0f} MB: '
                                 + IF_INTENDED)
        packed.seek(0)
        yield packed


def read_text(path: Path, skip_lines: int, delimiter: str | None,
              columns: Sequence[str] | None) -> dict[str, npt.NDArray]:
    """
    Return the columns of a text file by name: floats, or texts if a cell is no number.

    A missing cell of a column of floats is NaN. The elements of lists are columns name#1, name#2.
    Raises InputError, csv.Error, OSError, EOFError.
    """
    if delimiter is not None and len(delimiter) != 1:
        raise InputError(f'delimiter = {delimiter!r} is not allowed: it takes one character')
    with unpacked(path) as raw:
        lines = (line for line in islice(lines_of(raw, path), skip_lines, None) if line.strip())
        head = list(islice(lines, HEAD_LINES))
        if not head:
            raise InputError(f'{path} is empty'
                             + (f' after {skip_lines} lines' if skip_lines else ''))
        delimiter = delimiter or _delimiter(head[len(head) // 2])
        rows = list(_cells(head, delimiter))
        start = _first_of_data(rows)
        width = len(rows[len(rows) // 2])
        if columns is None:
            columns = _header(head[:start], delimiter, width)
        if len(columns) > MOST_COLUMNS:
            raise InputError(f'{path} has {len(columns)} columns: at most {MOST_COLUMNS} are '
                             'allowed')
        if start == len(rows):
            raise InputError(f'{path} has no rows of numbers: they end with '
                             f'{head[-1].strip()[:60]!r}')
        data = _cells(chain(head[start:], lines), delimiter)
        found = _columns(data, list(columns), path)
    names = [name if name not in columns[:number] else f'{name}#{columns[:number].count(name) + 1}'
             for number, name in enumerate(columns)]
    return dict(chain.from_iterable(map(_of_lists, names, found)))


def _of_lists(name: str, column: npt.NDArray) -> Iterator[tuple[str, npt.NDArray]]:
    """Yield a column, or the columns name#1, name#2 ... of one of lists."""
    if column.ndim == 1:
        yield name, column
    else:
        yield from ((f'{name}#{number}', each) for number, each in enumerate(column.T, 1))


def is_number(cell: str) -> bool:
    """Return whether a cell is a number or empty."""
    try:
        float(cell or 'nan')
    except ValueError:
        return SI_NUMBER.fullmatch(cell) is not None
    return True


def numbers_in(cell: str) -> int:
    """Return how many numbers a cell holds: of a list its elements."""
    elements = _elements(cell)
    return int(is_number(cell)) if elements is None else len(elements)


def _elements(cell: str) -> list[float] | None:
    """Return the numbers of a list in a cell; None if it holds no list of numbers."""
    found = _LIST.fullmatch(cell) if cell[-1:] in tuple('])') else None
    if found is None:
        return None
    try:
        return [float('nan' if each.lower() in MISSING else each)
                for each in re.split(r'\s*[,;]\s*|\s+', found[1].strip()) if found[1].strip()]
    except ValueError:
        return None


def lines_of(raw: gzip.GzipFile | io.BufferedReader, path: Path) -> Iterator[str]:
    """Yield the lines of a text in UTF-8, UTF-16 or, as older programs write it, Windows-1252."""
    marks = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    wide = raw.read(2) in marks
    raw.seek(0)
    text = io.TextIOWrapper(raw, 'utf-16' if wide else 'utf-8-sig',
                            'strict' if wide else 'windows-1252')
    while line := text.readline(MOST_LINE):
        if len(line) == MOST_LINE:
            raise InputError(f'{path} has a line of more than {MOST_LINE} characters: it is no '
                             'table')
        yield line


def _columns(rows: Iterable[list[str]], names: list[str], path: Path) -> list[npt.NDArray]:
    parts: list[list[npt.NDArray]] = [[] for _ in names]
    rows = (row for row in rows if row and not row[0].startswith(COMMENT))
    count = 0
    while block := list(islice(rows, BLOCK_ROWS)):
        for number, row in enumerate(block, count + 1):
            if len(row) != len(names):
                _fit(row, number, len(names), path)
        for name, part, cells in zip(names, parts, zip(*block, strict=True), strict=True):
            part.append(_as_array(cells, f'{path}: column {name}', count))
        count += len(block)
    if not count:
        raise InputError(f'{path} has no rows')
    return [_joined(part, f'{path}: column {name}')
            for name, part in zip(names, parts, strict=True)]


def _fit(row: list[str], number: int, width: int, path: Path) -> None:
    """
    Give a row one cell for each column, or raise InputError.

    A last column of remarks may be missing or contain the delimiter; one of numbers may not.
    """
    if len(row) < width - 1:
        raise InputError(f'{path}: row {number} has {len(row)} cells, expected {width}')
    if any(row[width:]) and all(map(is_number, row[width - 1:])):
        raise InputError(f'{path}: row {number} has {len(row)} cells, the header names {width}: '
                         'if these are decimal commas, save it with semicolons or tabs between '
                         'the cells')
    row[:] = [*row, ''][:width]


def _as_array(cells: Sequence[str], what: str, before: int) -> npt.NDArray:
    """
    Return cells as floats, NaN for a missing one, of lists a row each; as texts if one is neither.

    what: the column, before: its rows before these cells, for the message of an InputError.
    """
    try:
        return np.array(cells, float)
    except ValueError:
        pass
    known = ['nan' if cell.lower() in MISSING else cell for cell in cells]
    try:
        return np.array(known, float)
    except ValueError:
        lists = [[] if cell == 'nan' else _elements(cell) for cell in known]
    width = len(next(filter(None, lists), []))
    if not width or any(each is None for each in lists):
        return np.array(cells, TEXT)
    for row, each in enumerate(lists, before + 1):
        if each and len(each) != width:
            raise InputError(f'{what}, row {row}: the list has {len(each)} numbers, the first has '
                             f'{width}')
    return np.array([each or [np.nan] * width for each in lists])


def _joined(parts: list[npt.NDArray], what: str) -> npt.NDArray:
    """Return the blocks of a column as one array; empties `parts` to free their memory."""
    listed = {part.shape[1:] for part in parts if part.dtype == float and (
        part.ndim == 2 or not np.isnan(part).all())}
    if len(listed) > 1 or (listed and listed != {()} and any(part.dtype != float
                                                            for part in parts)):
        raise InputError(f'{what} has lists in some rows, and other cells or lists of another '
                         'length in others')
    if listed and listed != {()}:
        shape = next(iter(listed))
        parts[:] = [part if part.ndim == 2 else np.full((len(part), *shape), np.nan)
                    for part in parts]
    elif any(part.dtype != float for part in parts):
        parts[:] = [part.astype(TEXT) for part in parts]
    column = np.concatenate(parts)
    parts.clear()
    return column


def _delimiter(line: str) -> str:
    """Return the delimiter that splits a row of data into most numbers."""
    return max('\t;, ', key=lambda mark: sum(map(numbers_in, next(_cells([line], mark), []))))


def _first_of_data(rows: list[list[str]]) -> int:
    """Return the index of the first row with the form of a row in the middle of the file."""
    usual = rows[len(rows) // 2]
    fewest = 0.5 * sum(map(bool, map(numbers_in, usual)))
    return next((number for number, row in enumerate(rows) if len(row) >= len(usual) - 1
                 and sum(map(bool, map(numbers_in, row))) > fewest), len(rows))


def _header(before: list[str], delimiter: str, width: int) -> list[str]:
    """
    Return the names of `width` columns: the last line before the data that can be a header.

    A line of units is no header. With blanks as delimiter, names may not contain blanks.
    """
    for line in reversed(before):
        names = next(_cells([line.lstrip('#% ')], delimiter), [])
        units = all(name in UNITS or name[:1] in ('', '[', '(') for name in names)
        if not units and abs(len(names) - width) <= (delimiter != ' '):
            return names
    return [f'#{number}' for number in range(1, width + 1)]


def _cells(lines: Iterable[str], delimiter: str) -> Iterator[list[str]]:
    if delimiter in ' ,':   # Matlab ends rows with a semicolon
        lines = (line.rstrip(' ;\r\n') for line in lines)
    if delimiter != ',':
        lines = (_DECIMAL_COMMA.sub('.', line) if ',' in line and '[' not in line else line
                 for line in lines)     # not in lists
    if delimiter == ' ':
        return (line.split() for line in lines)
    reader = csv.reader(lines, delimiter=delimiter, skipinitialspace=True)
    return ([cell.strip() for cell in row] for row in reader)
