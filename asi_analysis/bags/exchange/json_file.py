"""
Read JSON as columns by name: records, an object of arrays, or JSON lines.

A field of a field is called `joint.position`, an element of a list `position#1`.
"""

import gzip
import io
import json
import warnings
from array import array
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from asi_analysis.bags.exchange.text_file import MOST_COLUMNS, lines_of, unpacked
from asi_analysis.errors import InputError, InputWarning

LINES: Final = ('.jsonl', '.ndjson')
# A document is read as a whole, into about ten times its size; lines are read one by one.
MOST_BYTES: Final = 50_000_000
MOST_ELEMENTS: Final = 64   # of a list in a record: a longer one is no row of numbers
Columns = dict[str, npt.NDArray]


class _Column:
    """Values of one field, row by row: numbers, and texts by their row."""

    def __init__(self) -> None:
        self.numbers = array('d')
        self.texts: dict[int, str] = {}

    def put(self, row: int, value: Any) -> None:
        """Set the value of a row; rows without one are NaN."""
        self.fill(row)
        if isinstance(value, str):
            self.texts[row] = value
        self.numbers.append(np.nan if value is None or isinstance(value, str) else float(value))

    def fill(self, rows: int) -> None:
        if len(self.numbers) < rows:
            self.numbers.extend([np.nan] * (rows - len(self.numbers)))

    def values(self) -> npt.NDArray:
        numbers = np.frombuffer(self.numbers) if len(self.numbers) else np.empty(0)
        if not self.texts:
            return numbers
        return np.array([self.texts.get(row, '' if np.isnan(value) else repr(value))
                         for row, value in enumerate(numbers.tolist())], object)


def read_json(path: Path) -> Columns:
    """
    Return the columns of a JSON file by name: floats, or texts if a value is a text.

    Raises InputError, OSError, ValueError and what json raises.
    """
    kind = Path(path.stem).suffix if path.suffix == '.gz' else path.suffix
    if kind in LINES:
        return _read_lines(path)
    with gzip.open(path) if path.suffix == '.gz' else path.open('rb') as file:
        data = file.read(MOST_BYTES + 1)
    if len(data) > MOST_BYTES:
        raise InputError(f'{path} holds more than {MOST_BYTES / 1e6:.0f} MB: save it as JSON '
                         'lines (.jsonl), a record in each line, which are read one by one')
    try:
        document = json.loads(data, object_pairs_hook=_object)
    except json.JSONDecodeError as error:
        if error.msg != 'Extra data':   # several documents: lines
            raise
        return _read_lines(path)
    if isinstance(document, list):
        return _records(enumerate(document), path)
    if not isinstance(document, dict):
        raise InputError(f'{path} holds no table: expected an array of records, an object of '
                         'arrays, or JSON lines')
    columns: Columns = {}
    for name, values in _arrays(document, '', path):
        if name in columns:
            raise InputError(f'{path}: two fields are called {name}')
        columns[name] = values
    return _checked(columns, path)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return an object of a document; raises ValueError for a name that it has twice."""
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError('two fields are called '
                         + next(name for name in names if names.count(name) > 1))
    return found


def _read_lines(path: Path) -> Columns:
    # Opened here, not by the generator: that is closed late when a record is refused.
    with unpacked(path) as raw:
        return _records(enumerate(_lines(raw, path)), path)


def _lines(raw: gzip.GzipFile | io.BufferedReader, path: Path) -> Iterator[Any]:
    """Yield the documents of JSON lines; raises InputError with the number of a damaged line."""
    for number, line in enumerate(lines_of(raw, path), 1):
        if line.strip():
            try:
                yield json.loads(line, object_pairs_hook=_object)
            except json.JSONDecodeError as error:
                raise InputError(f'{path}, line {number}: {error.msg} at column '
                                 f'{error.colno}') from None


def _records(records: Iterable[tuple[int, Any]], path: Path, prefix: str = '') -> Columns:
    """Return the columns of records, each with its row; a field that one lacks is NaN there."""
    columns: dict[str, _Column] = {}
    long: dict[str, int] = {}
    rows = 0
    for row, record in records:
        rows = row + 1
        if not prefix and isinstance(record, str):
            raise InputError(f'{path}, record {rows}: {record[:60]!r} is no record')
        for name, value in _flat(record, prefix, long):
            column = columns.get(name)
            if column is None:
                if len(columns) == MOST_COLUMNS:
                    raise InputError(f'{path} has more than {MOST_COLUMNS} fields')
                column = columns[name] = _Column()
            if len(column.numbers) > row:
                raise InputError(f'{path}, record {rows}: two fields are called {name}')
            column.put(row, value)
    for column in columns.values():
        column.fill(rows)
    for name, length in long.items():
        warnings.warn(f'{path}: {name} is left out: a list of {length} in a record, more than '
                      f'{MOST_ELEMENTS}', InputWarning, stacklevel=2)
    return _checked({name: column.values() for name, column in columns.items()}, path)


def _flat(value: Any, name: str, long: dict[str, int]) -> Iterator[tuple[str, Any]]:
    """
    Yield the numbers and texts of a record with their names.

    long: gets the name and the length of lists that are left out.
    """
    if isinstance(value, dict):
        for key, each in value.items():
            yield from _flat(each, f'{name}.{key}' if name else key, long)
    elif isinstance(value, list):
        if len(value) > MOST_ELEMENTS:
            long[name] = max(long.get(name, 0), len(value))
            return
        for number, each in enumerate(value, 1):
            yield from _flat(each, f'{name}#{number}', long)
    else:
        yield name or '#1', value


def _arrays(value: dict[str, Any], name: str, path: Path) -> Iterator[tuple[str, npt.NDArray]]:
    """Yield the arrays of an object, and of objects in it; a single number is one of length 1."""
    for key, each in value.items():
        own = f'{name}.{key}' if name else key
        if isinstance(each, dict) and len(each) > 1 and all(
                index == str(number) for number, index in enumerate(each)):
            each = list(each.values())     # by row, as pandas writes it
        if isinstance(each, dict):
            yield from _arrays(each, own, path)
        elif isinstance(each, list):
            yield from _records(enumerate(each), path, own).items() if each else ()
        elif isinstance(each, int | float):
            yield own, np.array([float(each)])


def _checked(columns: Columns, path: Path) -> Columns:
    if not columns:
        raise InputError(f'{path} holds no field with a number')
    return columns
