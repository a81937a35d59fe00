"""Read a text file (CSV, TSV, ...) as columns by name, in blocks of rows."""

import codecs
import csv
import gzip
import io
import re
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain, count, islice
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from asi_analysis.bags.exchange.dates import is_moment
from asi_analysis.bags.exchange.units import (
    BRACKETS,
    MISSING,
    UNITS,
    WITH_COMMA,
    conversion,
    elements_in,
    is_number,
    numbers_in,
)
from asi_analysis.bags.limits import IF_INTENDED, unpack_limit
from asi_analysis.errors import InputError, InputWarning

COMMENT: Final = ('#', '%')
# Lines at the start of a file in which delimiter, header and first row of data are looked for, and
# how many of them show what is usual.
HEAD_LINES: Final = 1000
SAMPLED: Final = 50
LABVIEW_HEADER: Final = '***End_of_Header***'
BLOCK_ROWS: Final = 20_000
# Limits: characters of a line, columns, unpacked bytes, and their ratio to the compressed ones.
MOST_LINE: Final = 2**20
MOST_COLUMNS: Final = 4096
MOST_UNPACKED: Final = 100_000_000
MOST_RATIO: Final = 20
# Cells that are no numbers; numpy 1.26, of Ubuntu 24.04, has no type for texts of any length.
TEXT: Final = getattr(np.dtypes, 'StringDType', lambda: np.dtype(object))()
# A number whose comma may separate thousands.
_THOUSANDS: Final = re.compile(r'[+-]?[1-9]\d{0,2},\d{3}')

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
        # A row of empty cells between tabs is no blank line.
        lines = (line for line in islice(lines_of(raw, path), skip_lines, None)
                 if line.strip(' \r\n'))
        head = list(islice(lines, HEAD_LINES))
        if not head:
            raise InputError(f'{path} is empty'
                             + (f' after {skip_lines} lines' if skip_lines else ''))
        head = _after_labview(head)
        form = _form(head, delimiter)
        start = _first_of_data([_cells(line, form.delimiter) for line in head], form)
        names = _header(head[:start], form, path) if columns is None else list(columns)
        if len(names) > MOST_COLUMNS:
            raise InputError(f'{path} has {len(names)} columns: at most {MOST_COLUMNS} are '
                             'allowed')
        if start == len(head):
            raise InputError(f'{path} has no rows of numbers: they end with '
                             f'{head[-1].strip()[:60]!r}')
        found = _columns(_Rows(chain(head[start:], lines), names, form, path))
    table: dict[str, npt.NDArray] = {}
    for name, column in chain.from_iterable(map(_of_lists, _different(names), found)):
        if name in table:
            raise InputError(f'{path}: two columns are called {name}')
        table[name] = column
    return table


def _different(names: Sequence[str]) -> list[str]:
    """Return names, with #2, #3 ... behind those that are there before."""
    found: list[str] = []
    for name in names:
        numbered = (f'{name}#{number}' for number in count(2))
        found.append(name if name not in found else next(
            each for each in numbered if each not in names and each not in found))
    return found


def _of_lists(name: str, column: npt.NDArray) -> Iterator[tuple[str, npt.NDArray]]:
    """Yield a column, or the columns name#1, name#2 ... of one of lists."""
    if column.ndim == 1:
        yield name, column
    else:
        yield from ((f'{name}#{number}', each) for number, each in enumerate(column.T, 1))


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


class _Form(NamedTuple):
    """What is usual in the lines of a file."""

    delimiter: str
    width: int                  # cells of a row
    numeric: frozenset[int]     # columns of numbers or dates
    row_names: bool             # the first cell may be the name of the row, not in the header


class _Rows:
    """The rows of data, with one cell for each name. Iterating raises InputError."""

    def __init__(self, lines: Iterable[str], names: list[str], form: _Form, path: Path) -> None:
        self.lines, self.names, self.form, self.path = lines, names, form, path
        self.padded: tuple[int, int] | None = None      # number and cells of the shortest row

    def __iter__(self) -> Iterator[list[str]]:
        width, number = len(self.names), 0
        for line in self.lines:
            row = _cells(line, self.form.delimiter)
            if _is_comment(row, self.form) or not (line.strip() or self.form.delimiter == '\t'):
                continue
            number += 1
            if len(row) < width and number > 1 and not (
                    line.endswith('\n') or self._lacks_remarks(row)):
                warnings.warn(f'{self.path}: its last row, {line[:60]!r}, is cut off and left out',
                              InputWarning, stacklevel=2)
                return
            if len(row) != width:
                self._fit(row, number, width)
            yield row

    def _fit(self, row: list[str], number: int, width: int) -> None:
        """
        Give a row one cell for each column, or raise InputError.

        Of remarks in the last column, some may be missing or contain the delimiter. Nothing tells
        which number is missing, nor which comma is a decimal one.
        """
        if len(row) < width:
            fits = self._lacks_remarks(row)
            if fits and (self.padded is None or len(row) < self.padded[1]):
                self.padded = number, len(row)
        elif self.form.width > width:
            fits = not any(row[width:])
        else:
            fits = not any(row) or (
                width - 1 not in self.form.numeric and not is_number(row[width - 1]))
        if not fits:
            raise self._of_other_width(number, len(row))
        row[:] = [*row, *[''] * (width - len(row))][:width]

    def _lacks_remarks(self, row: list[str]) -> bool:
        """Return whether a short row has its numbers where the other rows have them."""
        return self.form.delimiter != ' ' and all(
            column < len(row) and row[column] and _are_numbers([row[column]])
            for column in self.form.numeric)

    def check_padded(self, columns: Sequence[npt.NDArray]) -> None:
        """Raise InputError if a cell was added to a row in a column that is not of remarks."""
        if self.padded is None:
            return
        number, width = self.padded
        if any(name and not _is_of_remarks(column) for name, column in
               zip(self.names[width:], columns[width:], strict=True)):
            raise self._of_other_width(number, width)

    def _of_other_width(self, number: int, width: int) -> InputError:
        why = (': if these are decimal commas, save it with semicolons or tabs between the cells'
               if width > len(self.names) and self.form.delimiter == ',' else '')
        return InputError(f'{self.path}: row {number} has {width} cells, expected '
                          f'{len(self.names)}, one for each name{why}')


def _is_of_remarks(column: npt.NDArray) -> bool:
    """Return whether most cells of a column that are not empty are texts."""
    if column.dtype == float:
        return False
    known = [cell for cell in map(str, column) if cell.lower() not in MISSING]
    return sum(map(is_number, known)) < 0.5 * len(known)


def _is_comment(row: list[str], form: _Form) -> bool:
    """Return whether a row is a comment: `#N/A,30` is none, nor is `#3,30`."""
    if not row or not row[0].startswith(COMMENT):
        return not row
    if row[0].lower() in MISSING:
        return False
    one_word = len(row) == form.width > 1 and ' ' not in row[0]
    return not (one_word and _are_numbers(row[1:]))


def _are_numbers(cells: Sequence[str]) -> bool:
    """Return whether cells are numbers, dates, lists or missing, and not all empty or a dash."""
    return any(cell not in ('', '-') for cell in cells) and all(
        cell.lower() in MISSING or is_moment(cell) or is_number(cell)
        or elements_in(cell) is not None for cell in cells)


def _columns(rows: _Rows) -> list[npt.NDArray]:
    names, path = rows.names, rows.path
    parts: list[list[npt.NDArray]] = [[] for _ in names]
    before, all_rows = 0, iter(rows)
    while block := list(islice(all_rows, BLOCK_ROWS)):
        for name, part, cells in zip(names, parts, zip(*block, strict=True), strict=True):
            part.append(_as_array(cells, f'{path}: column {name}', before))
        before += len(block)
    if not before:
        raise InputError(f'{path} has no rows')
    if rows.form.delimiter != ',':
        for name, part in zip(names, parts, strict=True):
            _read_commas(part, f'{path}: column {name}')
    columns = [_joined(part, f'{path}: column {name}')
               for name, part in zip(names, parts, strict=True)]
    rows.check_padded(columns)
    return columns


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
        first = next(cell for cell in known if cell != 'nan')
        lists = [None] if elements_in(first) is None else [
            [] if cell == 'nan' else elements_in(cell) for cell in known]
    width = len(next(filter(None, lists), []))
    if not width or any(each is None for each in lists):
        return np.array(cells, TEXT)
    for row, each in enumerate(lists, before + 1):
        if each and len(each) != width:
            raise InputError(f'{what}, row {row}: the list has {len(each)} numbers, the first has '
                             f'{width}')
    return np.array([each or [np.nan] * width for each in lists])


def _read_commas(parts: list[npt.NDArray], what: str) -> None:
    """
    Read the decimal commas in the blocks of a column as points.

    Cells stay as they are written, to be refused, if commas may as well separate thousands:
    beside cells with a point, or 1,000 beside 999. Warns of 1,000 alone.
    """
    texts = [cell for part in parts if part.dtype != float for cell in map(str, part)]
    with_comma = [cell for cell in texts if ',' in cell and WITH_COMMA.fullmatch(cell)]
    if not with_comma:
        return
    numbers = [part[np.isfinite(part)] for part in parts if part.dtype == float]
    others = [cell for cell in texts if ',' not in cell and cell.lower() not in MISSING
              and is_number(cell)]
    pointed = any('.' in cell for cell in others) or any(
        bool((part % 1.0).any()) for part in numbers)
    decimal = not all(map(_THOUSANDS.fullmatch, with_comma))
    if pointed or (not decimal and (others or any(part.size for part in numbers))):
        return
    if not decimal:
        cell = with_comma[0]
        warnings.warn(f'{what}: {cell} is read as {cell.replace(",", ".")}, with a decimal comma; '
                      'if commas separate thousands, write the numbers without them', InputWarning,
                      stacklevel=2)
    parts[:] = [part if part.dtype == float else _as_array(
        [cell.replace(',', '.') if WITH_COMMA.fullmatch(cell) else cell
         for cell in map(str, part)], what, 0) for part in parts]


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


def _after_labview(head: list[str]) -> list[str]:
    """Return the lines after the header of LabVIEW, whose rows are those of a table, too."""
    last = max((number for number, line in enumerate(head, 1)
                if line.startswith(LABVIEW_HEADER)), default=0)
    return head[last:] or head


def _form(head: list[str], delimiter: str | None) -> _Form:
    """Return what is usual in the second half of some lines, which hardly is the header."""
    known = [line for line in head if not line.startswith(COMMENT)] or head
    half = known[len(known) // 2:]
    lines = half[::len(half) // SAMPLED + 1]
    delimiter = delimiter or _delimiter(lines)
    rows = [row for line in lines if (row := _cells(line, delimiter))]
    counted = Counter(map(len, rows))
    width = max(counted, key=lambda each: (counted[each], each), default=0)
    columns = list(zip(*(row for row in rows if len(row) == width), strict=True))
    numeric = frozenset(number for number, cells in enumerate(columns) if _mostly_numbers(cells))
    quoted = all(line.lstrip().startswith('"') for line in lines)
    return _Form(delimiter, width, numeric,
                 bool(columns) and _may_be_row_names(columns[0], quoted, delimiter))


def _delimiter(lines: list[str]) -> str:
    """Return the delimiter that splits most lines into most numbers, and fewest other cells."""
    best: Counter[str] = Counter()
    for line in lines:
        ranks = {}
        for mark in '\t;, ':
            numbers = [numbers_in(cell) for cell in _cells(line, mark) if cell]
            ranks[mark] = sum(numbers), -numbers.count(0)
        mark = max(ranks, key=lambda each: ranks[each])
        best[mark] += len(set(ranks.values())) > 1
    return max('\t;, ', key=lambda mark: best[mark])


def _mostly_numbers(cells: Sequence[str]) -> bool:
    known = [cell for cell in cells if cell.lower() not in MISSING]
    return bool(known) and sum(_are_numbers([cell]) for cell in known) >= 0.5 * len(known)


def _may_be_row_names(cells: Sequence[str], quoted: bool, delimiter: str) -> bool:
    """
    Return whether cells may be the names of rows, as R writes them: counted, or texts.

    In `0,0,5` the first cell is a time with a comma: between commas they must be quoted.
    """
    try:
        first = int(cells[0])
    except ValueError:
        return quoted and not any(map(is_number, cells))
    steps = [int(cell) - first if cell.isdigit() else -1 for cell in cells]
    return (quoted or delimiter != ',') and len(steps) > 1 and steps[1] > 0 and all(
        np.diff(steps) == steps[1])


def _first_of_data(rows: list[list[str]], form: _Form) -> int:
    """
    Return the index of the first row of data, of any length, or the number of rows.

    A missing value is data. A row of another length above the data is refused later, for it is no
    header.
    """
    def is_data(row: list[str]) -> bool:
        return _are_numbers([row[number] for number in form.numeric if number < len(row)])
    first = next((number for number, row in enumerate(rows)
                  if form.numeric and len(row) >= form.width - 1 and is_data(row)), len(rows))

    def is_below_names(number: int) -> bool:    # a bad value in the first row makes no header
        above = rows[number - 1] if number else []
        return len(above) == form.width and all(above) and not any(map(is_number, above)) and any(
            cell and is_number(cell) for cell in rows[number])
    while 0 < first < len(rows) and (is_data(rows[first - 1]) or is_below_names(first - 1)):
        first -= 1
    return first


def _whole(lines: list[str]) -> list[str]:
    """Return lines, those as one in which a quoted name has several lines."""
    found = ['']
    for line in lines:
        if found[-1].count('"') % 2:
            found[-1] = f'{found[-1].rstrip()} {line}'
        else:
            found.append(line)
    return lines if found[-1].count('"') % 2 else found[1:]


def _fits(names: list[str], form: _Form) -> bool:
    """Return whether names may be those of the columns."""
    lacking = form.width - len(names)
    return not all(name.strip('-=').lower() in MISSING for name in names) and (
        lacking in (0, int(form.row_names)) or (form.delimiter != ' ' and abs(lacking) == 1))


def _are_units(names: list[str], least: float) -> bool:
    """Return whether names are units, at least this share of them known ones."""
    named = [name for name in names if name not in ('', '-')]
    known = [name[0] in '[(' or name in UNITS or (least < 1.0 and conversion(name) is not None)
             for name in named]
    return sum(known) >= least * len(known)


def _header(before: list[str], form: _Form, path: Path) -> list[str]:
    """
    Return the names of the columns: the last line before the data that can be a header.

    The units of a line below it are added, as in `pos [mm]`. With blanks as delimiter, names may
    not contain blanks.
    """
    lines = [_cells(line.lstrip('#% '), form.delimiter) for line in reversed(_whole(before))]
    lines = [line for line in lines if _fits(line, form)]
    units: list[str] = []
    if lines and (_are_units(lines[0], 1.0) or (
            len(lines) > 1 and all(lines[1]) and not any(map(is_number, lines[1]))
            and _are_units(lines[0], 0.5))):
        units = lines.pop(0)
    names = next((line for line in lines if not _are_units(line, 1.0)), [])
    if names and form.row_names and len(names) == form.width - 1:
        warnings.warn(f'{path}: its header has {len(names)} names, its rows have {form.width} '
                      'cells: the first cells are read as names of the rows, in column #1',
                      InputWarning, stacklevel=2)
        names, units = ['#1', *names], ['', *units]
    names = names or [f'#{number}' for number in range(1, form.width + 1)]
    stated = [unit.strip('[]() ') for unit in units[:len(names)]]
    stated += [''] * (len(names) - len(stated))
    return [name if unit.lower() in MISSING or BRACKETS.search(name) else f'{name} [{unit}]'
            for name, unit in zip(names, stated, strict=True)]


def _cells(line: str, delimiter: str) -> list[str]:
    """Return the cells of a line; a quote that is not closed on it ends with it."""
    if delimiter in ' ,':   # Matlab ends rows with a semicolon
        line = line.rstrip(' ;\r\n')
    if delimiter == ' ':
        line = ' '.join(line.split())
        if not line:
            return []
    cells = line.split(delimiter) if '"' not in line else next(
        csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    return [cell.strip() for cell in cells]
