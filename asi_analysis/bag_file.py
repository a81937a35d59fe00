"""The messages of a bag: whatever rosbag2 has written, also if it was killed or cut off."""

import json
import sqlite3
import struct
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any, Final, NamedTuple

import yaml
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata, Schema, Statistics
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from rosbags.interfaces import ConnectionExtRosbag2
from rosbags.rosbag2 import Reader, ReaderError
from rosbags.rosbag2.metadata import dump_qos_v9

from asi_analysis.bag_writer import INFORMATION
from asi_analysis.errors import InputError

# What broken bytes make the libraries raise.
BROKEN: Final = (McapError, ReaderError, ValueError, struct.error, zstandard.ZstdError,
                 RuntimeError, KeyError, IndexError, TypeError, AssertionError, MemoryError,
                 OverflowError, EOFError, sqlite3.Error)
_RECORD: Final = struct.Struct('<BQ')
_MESSAGE: Final = struct.Struct('<HIQQ')


class _Records(StreamReader):
    """The records of a file; the indices of messages, which take as long as all else, skipped."""

    def _read_record(self, opcode: int, length: int) -> McapRecord | None:
        return None if opcode == Opcode.MESSAGE_INDEX else super()._read_record(opcode, length)


class Topic:
    """The messages of one topic in the order of the file: times (ns) and CDR bytes."""

    def __init__(self, name: str, type_: str) -> None:
        self.name = name
        self.type = type_
        self.offered: list[dict[str, Any]] = []
        self.log_ns: list[int] = []
        self.publish_ns: list[int] = []
        self.data: list[bytes] = []

    def add(self, log_ns: int, publish_ns: int, data: bytes) -> None:
        self.log_ns.append(log_ns)
        self.publish_ns.append(publish_ns)
        self.data.append(data)


class Contents(NamedTuple):
    """What a bag holds; `problems` says in words what could not be read."""

    topics: dict[str, Topic]
    information: dict[str, Any]
    problems: list[str]


def read_contents(path: Path, wanted: Callable[[str], bool]) -> Contents:
    """
    Return the messages of the topics whose name is `wanted`, and what the bag says of its run.

    path: rosbag2 directory (MCAP or sqlite3, with or without metadata.yaml), .mcap or .db3 file.
    Reads as far as a damaged file can be read. Raises InputError if `path` is no bag.
    """
    contents = Contents({}, {}, [])
    for file in _files(path, contents.problems):
        read = _read_mcap if file.suffix == '.mcap' else _read_by_rosbags
        try:
            read(file, wanted, contents)
        except OSError as error:
            raise InputError(f'{file} cannot be read: {error.strerror or error}') from None
        except BROKEN as error:
            what = 'it ends too early' if isinstance(error, EndOfFile) else str(error)
            contents.problems.append(f'{file} is damaged or was cut off ({what})')
    return contents


def _files(path: Path, problems: list[str]) -> list[Path]:
    """Return what has to be read one after the other."""
    if not path.exists():
        raise InputError(f'{path} does not exist: expected a bag')
    if path.is_file():
        if path.suffix not in ('.mcap', '.db3'):
            raise InputError(f'{path} is not a bag: expected a rosbag2 directory, a .mcap or a '
                             '.db3 file')
        if path.stat().st_size == 0:
            raise InputError(f'{path} is empty: expected a .mcap or .db3 file')
        return [path]
    try:
        described = yaml.safe_load((path / 'metadata.yaml').read_text())
        described = described['rosbag2_bagfile_information']
        if described['storage_identifier'] != 'mcap' or described.get('compression_mode'):
            return [path]
        files = [path / Path(name).name for name in described['relative_file_paths']]
    except FileNotFoundError:
        problems.append(f'{path} has no metadata.yaml: its recording was not ended properly')
        files = sorted([*path.glob('*.mcap'), *path.glob('*.db3')], key=_number)
    except (OSError, yaml.YAMLError, *BROKEN):
        problems.append(f'{path / "metadata.yaml"} cannot be read')
        files = sorted([*path.glob('*.mcap'), *path.glob('*.db3')], key=_number)
    present = [file for file in files if file.is_file() and file.stat().st_size]
    problems += [f'{file} is missing or empty' for file in files if file not in present]
    if not present:
        raise InputError(f'{path} is not a bag: expected a rosbag2 directory with a .mcap or .db3 '
                         'file that is not empty')
    return present


def _number(file: Path) -> tuple[int, str]:
    """Sort name_2 before name_10."""
    digits = file.stem.rpartition('_')[2]
    return (int(digits) if digits.isdigit() else 0), file.name


def _read_mcap(file: Path, wanted: Callable[[str], bool], contents: Contents) -> None:
    channels: dict[int, Topic] = {}
    schemas: dict[int, str] = {}
    count, announced = 0, None
    with file.open('rb') as stream:
        for record in _Records(stream, emit_chunks=True,
                               record_size_limit=file.stat().st_size).records:
            if isinstance(record, Chunk):
                count += _read_chunk(record, schemas, channels, wanted, contents.topics)
            elif isinstance(record, Message):
                count += 1
                if record.channel_id in channels:
                    channels[record.channel_id].add(record.log_time, record.publish_time,
                                                    record.data)
            elif isinstance(record, Schema):
                schemas[record.id] = record.name
            elif isinstance(record, Channel):
                _add_channel(record, schemas, channels, wanted, contents.topics)
            elif isinstance(record, Metadata) and record.name == INFORMATION:
                contents.information.update(
                    {name: json.loads(value) for name, value in record.metadata.items()})
            elif isinstance(record, Statistics):
                announced = record.message_count
    if announced not in (None, count):
        contents.problems.append(f'{file} is damaged: {count} of its {announced} messages are '
                                 'there')


def _read_chunk(chunk: Chunk, schemas: dict[int, str], channels: dict[int, Topic],
                wanted: Callable[[str], bool], topics: dict[str, Topic]) -> int:
    """Take the messages of a chunk; return how many it had."""
    stream, size = get_chunk_data_stream(chunk, validate_crc=True)
    data = stream.read(size)
    count = start = 0
    while start < size:
        opcode, length = _RECORD.unpack_from(data, start)
        start += _RECORD.size
        end = start + length
        if end > size:
            raise EndOfFile
        if opcode == Opcode.MESSAGE:
            channel, _, log_ns, publish_ns = _MESSAGE.unpack_from(data, start)
            count += 1
            if channel in channels:
                channels[channel].add(log_ns, publish_ns, data[start + _MESSAGE.size:end])
        elif opcode == Opcode.SCHEMA:
            schema = Schema.read(ReadDataStream(BytesIO(data[start:end])))
            schemas[schema.id] = schema.name
        elif opcode == Opcode.CHANNEL:
            _add_channel(Channel.read(ReadDataStream(BytesIO(data[start:end]))), schemas,
                         channels, wanted, topics)
        start = end
    return count


def _add_channel(channel: Channel, schemas: dict[int, str], channels: dict[int, Topic],
                 wanted: Callable[[str], bool], topics: dict[str, Topic]) -> None:
    if not wanted(channel.topic):
        return
    topic = topics.setdefault(channel.topic, Topic(channel.topic, schemas[channel.schema_id]))
    topic.offered = yaml.safe_load(channel.metadata.get('offered_qos_profiles', '')) or []
    channels[channel.id] = topic


def _read_by_rosbags(path: Path, wanted: Callable[[str], bool], contents: Contents) -> None:
    """Read sqlite3, and compressed files; they tell no time of publication."""
    with Reader(path) as reader:
        connections = [c for c in reader.connections if wanted(c.topic)]
        for connection in connections:
            topic = contents.topics.setdefault(connection.topic,
                                               Topic(connection.topic, connection.msgtype))
            assert isinstance(connection.ext, ConnectionExtRosbag2)
            topic.offered = [dict(qos) for qos in dump_qos_v9(connection.ext.offered_qos_profiles)]
        if connections:
            for connection, time_ns, data in reader.messages(connections):
                contents.topics[connection.topic].add(time_ns, time_ns, bytes(data))
