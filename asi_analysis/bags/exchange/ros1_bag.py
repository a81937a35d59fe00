"""A ROS 1 bag of any robot as columns by name, named as those of a rosbag2 (`bag_table.py`)."""

import bz2
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.rosbag1 import ReaderError, reader
from rosbags.typesys import Stores, TypesysError, get_typestore

from asi_analysis.bags.bag import Series, align, time_base
from asi_analysis.bags.bag_file import BROKEN, TOO_MUCH, limited, most_unpacked
from asi_analysis.bags.exchange.table_file import Table
from asi_analysis.errors import InputError, InputWarning


@contextmanager
def opened(path: Path) -> Iterator[AnyReader]:
    """Open a bag of ROS 1 or 2. Raises InputError, also for what is found damaged later."""
    unlimited = dict(reader.decompressors)
    reader.decompressors |= {name: partial(_unpacked, new, most_unpacked(path))
                             for name, new in _DECOMPRESSORS.items()}
    try:
        with limited(path) as limited_path, AnyReader(
                [limited_path],
                default_typestore=get_typestore(Stores.ROS2_JAZZY)) as bag:
            yield bag
    except InputError:
        raise
    except (AnyReaderError, ReaderError, TypesysError, OSError, SyntaxError, *BROKEN) as error:
        raise InputError(f'{path} cannot be read: {str(error) or type(error).__name__}') from None
    finally:
        reader.decompressors.update(unlimited)


# Decompressors of a chunk, by the name of its compression: those of rosbags have no limit.
_DECOMPRESSORS = {'bz2': bz2.BZ2Decompressor, 'lz4': lz4.frame.LZ4FrameDecompressor}


def _unpacked(new: Callable[[], Any], most_bytes: int, packed: bytes) -> bytes:
    """Return an unpacked chunk. Raises ValueError if it is too large, or incomplete."""
    decompressor = new()
    found: bytes = decompressor.decompress(packed, max_length=most_bytes)
    if not decompressor.eof:
        raise ValueError(TOO_MUCH if len(found) >= most_bytes else 'a chunk is cut off')
    return found


def read_ros1_table(path: Path, columns: Sequence[str]) -> Table:
    """
    Return all numbers of the topics to which `columns` belong, and `time`, s.

    As `read_bag_table`: the time base is the topic of the first column; numbers of other topics
    are held until their next message. Raises InputError.
    """
    with opened(path) as reader:
        names = sorted(reader.topics, key=len, reverse=True)
        wanted = list(dict.fromkeys(next((name for name in names
                                          if column.startswith(f'{name}/')), '')
                                    for column in columns))
        if '' in wanted or not wanted:
            raise InputError(f'{path}: no message of a topic is mapped, as SIGNAL=TOPIC/FIELD '
                             'or SIGNAL=TOPIC/JOINT/FIELD; it has ' + ', '.join(sorted(names)))
        series = {name: _series(reader, name) for name in wanted}
    for name, one in series.items():
        if not len(one.publish_ns):
            raise InputError(f'{path}: {name} has no message')
        if not one.stamp_ns.any():
            warnings.warn(f'{path}: {name} has no stamps: its time is that at which it was '
                          'recorded', InputWarning, stacklevel=3)
    base = time_base(series[wanted[0]], str(path))
    table: Table = {'time': (base.stamp_ns - base.stamp_ns[0]) / 1e9}
    for name, one in series.items():
        for field, values in align(base, one, hold=name != wanted[0]).items():
            table[f'{name}/{field}'] = values
    return table


def _series(reader: AnyReader, topic: str) -> Series:
    """Return the messages of a topic; a number that is missing in one of them is NaN there."""
    stamps: list[int] = []
    published: list[int] = []
    rows: list[dict[str, float]] = []
    chosen = [each for each in reader.connections if each.topic == topic]
    for connection, published_ns, data in reader.messages(connections=chosen):
        message = reader.deserialize(data, connection.msgtype)
        stamp = getattr(getattr(message, 'header', None), 'stamp', None)
        stamps.append(0 if stamp is None else stamp.sec * 10**9 + stamp.nanosec)
        published.append(published_ns)
        rows.append(dict(_numbers(message)))
    names = dict.fromkeys(name for row in rows for name in row)
    return Series(np.array(stamps, np.int64), np.array(published, np.int64),
                  {name: np.array([row.get(name, np.nan) for row in rows]) for name in names})


def _numbers(message: Any, prefix: str = '') -> Iterator[tuple[str, float]]:
    """Yield the numbers of a message, named JOINT/FIELD or FIELD; indices start at 0."""
    joints = getattr(message, 'name', None)
    for field in message.__dataclass_fields__:
        value = getattr(message, field)
        if field in ('header', '__msgtype__'):
            continue
        if isinstance(value, bool | int | float | np.number):
            yield prefix + field, float(value)
        elif isinstance(value, np.ndarray | list):
            for number, element in enumerate(value):
                if isinstance(element, int | float | np.number):
                    joint = isinstance(joints, list) and len(joints) == len(value)
                    yield (f'{prefix}{joints[number]}/{field}' if joint and joints
                           else f'{prefix}{field}/{number}'), float(element)
                elif hasattr(element, '__dataclass_fields__'):
                    yield from _numbers(element, f'{prefix}{field}/{number}/')
        elif hasattr(value, '__dataclass_fields__'):
            yield from _numbers(value, f'{prefix}{field}/')
