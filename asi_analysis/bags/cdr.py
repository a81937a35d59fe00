"""
Read and write the numbers of many serialised messages (CDR) at once.

Messages of one type with equal strings and sequence lengths have every number at the same offset.
One message is parsed; numpy then reads the numbers of all from a table of bytes, about fifty times
faster than decoding each message (bench/recording.py).
"""

from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError

from asi_analysis.arrays import Array, Mask
from asi_analysis.bags.bag_writer import typestore

_HEADER: Final = 4      # bytes before the data; alignment counts from their end
_NUMPY: Final = {'bool': 'u1', 'byte': 'u1', 'char': 'u1', 'octet': 'u1',
                 'int8': 'i1', 'uint8': 'u1', 'int16': 'i2', 'uint16': 'u2', 'int32': 'i4',
                 'uint32': 'u4', 'int64': 'i8', 'uint64': 'u8', 'float32': 'f4', 'float64': 'f8'}

Path = tuple[str | int, ...]


class LayoutError(ValueError):
    """These bytes are not a message of that type."""


class Layout(NamedTuple):
    """Offsets of a message: numbers (offset, numpy type), strings, lengths of sequences."""

    numbers: dict[Path, tuple[int, np.dtype]]
    strings: dict[Path, str]
    structure: list[tuple[int, int]]    # byte ranges that are equal in every message


def layout_of(type_: str, data: bytes) -> Layout:
    """Return the layout of a message of a type of Jazzy. Raises LayoutError if it is none."""
    parser = _LayoutParser(data)
    try:
        parser.visit((Nodetype.NAME, type_), ())
    except (IndexError, UnicodeDecodeError) as error:
        raise LayoutError(f'not a {type_}: {error}') from None
    return Layout(parser.numbers, parser.strings, parser.structure)


def columns(type_: str, table: npt.NDArray[np.uint8], paths: Sequence[Path],
            layout: Layout) -> list[Array]:
    """
    Return the numbers at some paths of n messages of one layout: arrays n.

    table: n x length. Compared with what rosbags decodes of the first and the last message; raises
    LayoutError if that differs.
    """
    found = []
    for path in paths:
        offset, kind = layout.numbers[path]
        cut = np.ascontiguousarray(table[:, offset:offset + kind.itemsize])
        found.append(cut.view(kind)[:, 0])
    for i in (0, -1):
        try:
            message = typestore().deserialize_cdr(table[i].tobytes(), type_)
        except SerdeError as error:
            raise LayoutError(f'not a {type_}: {error}') from None
        for path, values in zip(paths, found, strict=True):
            if not np.array_equal(_at(message, path), values[i], equal_nan=True):
                raise LayoutError(f'{type_}: {path} is not at its offset')
    return found


def same_layout(table: npt.NDArray[np.uint8], template: bytes, layout: Layout
                ) -> Mask:
    """Tell which messages (n x length) have the layout of the template, which is as long."""
    same = np.ones(len(table), bool)
    for start, end in layout.structure:
        for offset in range(start, end):
            same &= table[:, offset] == template[offset]
    return same


def filled(template: bytes, layout: Layout, values: Mapping[Path, npt.NDArray]
           ) -> npt.NDArray[np.uint8]:
    """Return n copies of a message, n x length, with the numbers at some paths replaced."""
    count = len(next(iter(values.values())))
    table = np.tile(np.frombuffer(template, np.uint8), (count, 1))
    for path, column in values.items():
        offset, kind = layout.numbers[path]
        table[:, offset:offset + kind.itemsize] = np.ascontiguousarray(
            column, kind).view(np.uint8).reshape(count, -1)
    return table


def _at(message: Any, path: Path) -> Any:
    for step in path:
        message = message[step] if isinstance(step, int) else getattr(message, step)
    return message


class _LayoutParser:
    """Parses one message by the definition of its type (XCDR 1)."""

    def __init__(self, data: bytes) -> None:
        if len(data) < _HEADER or data[0] != 0 or data[1] > 1:
            raise LayoutError('not plain CDR')
        self.data = data
        self.order = '<' if data[1] else '>'
        self.offset = _HEADER
        self.numbers: dict[Path, tuple[int, np.dtype]] = {}
        self.strings: dict[Path, str] = {}
        self.structure: list[tuple[int, int]] = [(0, _HEADER)]

    def visit(self, definition: Any, path: Path) -> None:
        kind, what = definition
        if kind == Nodetype.NAME:
            for name, field in typestore().fielddefs[what][1]:
                self.visit(field, (*path, name))
        elif kind == Nodetype.BASE and what[0] in _NUMPY:
            self.numbers[path] = self._number(_NUMPY[what[0]])
        elif kind == Nodetype.BASE:
            length = self._length()
            end = self.offset + length
            self.strings[path] = self.data[self.offset:end].rstrip(b'\0').decode()
            self.structure.append((self.offset, end))
            self.offset = end
        else:
            count = what[1] if kind == Nodetype.ARRAY else self._length()
            for i in range(count):
                self.visit(what[0], (*path, i))

    def _number(self, kind: str) -> tuple[int, np.dtype]:
        dtype = np.dtype(self.order + kind)
        size = dtype.itemsize
        start = _HEADER + -(-(self.offset - _HEADER) // size) * size
        self.offset = start + size
        if self.offset > len(self.data):
            raise IndexError('it ends too early')
        return start, dtype

    def _length(self) -> int:
        start, kind = self._number('u4')
        self.structure.append((start, start + 4))
        length = int(np.frombuffer(self.data, kind, 1, start)[0])
        if self.offset + length > len(self.data):
            raise IndexError('it ends too early')
        return length
