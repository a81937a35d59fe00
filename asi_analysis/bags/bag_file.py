"""Read the messages of a bag of rosbag2 or of this package, also a damaged or truncated one."""

import json
import os
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import IO, Any, Final, NamedTuple

import apsw
import lz4.frame
import numpy as np
import numpy.typing as npt
import yaml
import zstandard
from backports.zstd import ZstdError  # that of rosbags
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Metadata, Schema, Statistics
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from numpy.lib.stride_tricks import sliding_window_view
from rosbags.interfaces import Connection, ConnectionExtRosbag2
from rosbags.rosbag2 import Reader, ReaderError, storage_mcap
from rosbags.rosbag2.metadata import dump_qos_v9

from asi_analysis.bags.bag_writer import INFORMATION
from asi_analysis.bags.limits import IF_INTENDED, unpack_limit
from asi_analysis.bags.topic_messages import Messages, Topic
from asi_analysis.errors import InputError
from asi_common.jit import jit

# What the libraries raise for damaged files.
BROKEN: Final = (McapError, ReaderError, ValueError, struct.error, zstandard.ZstdError, ZstdError,
                 RuntimeError, KeyError, IndexError, TypeError, AssertionError, MemoryError,
                 OverflowError, EOFError, AttributeError, RecursionError, yaml.YAMLError,
                 apsw.Error)
# What precedes the contents of a record in MCAP, and the bytes of a message.
_RECORD_BYTES: Final = 9
_HEAD: Final = np.dtype([('opcode', 'u1'), ('length', '<u8'), ('channel', '<u2'),
                           ('sequence', '<u4'), ('log_ns', '<u8'), ('publish_ns', '<u8')])
_MESSAGE_OPCODE: Final = int(Opcode.MESSAGE)
_HEAD_BYTES: Final = _HEAD.itemsize
# Chunks are decoded in batches of about this size, which fits a processor's cache.
BATCH_BYTES: Final = 2**20
# Limits: of the unpacked chunks of a file (bytes; times its size), and of metadata.yaml (bytes).
MOST_UNPACKED: Final = 256_000_000
MOST_RATIO: Final = 30
MOST_METADATA: Final = 2**20
TOO_MUCH: Final = f'it unpacks to more than is allowed for a file of this size; {IF_INTENDED}'


class _Records(StreamReader):
    """The records of a file but the message indices, whose decoding doubles the time."""

    def _read_record(self, opcode: int, length: int) -> Any:
        if opcode == Opcode.MESSAGE_INDEX:
            return self._stream.read(length)
        return super()._read_record(opcode, length)


class Contents(NamedTuple):
    """The contents of a bag; `problems`: a sentence for each part that could not be read."""

    topics: dict[str, Topic]
    information: dict[str, Any]
    problems: list[str]


def read_contents(path: Path, select: Callable[[str], bool]) -> Contents:
    """
    Return the messages of the topics whose name passes `select`, and the metadata `asi.run`.

    path: rosbag2 directory (MCAP or sqlite3, with or without metadata.yaml), .mcap or .db3 file.
    Reads as far as a damaged file can be read. Raises InputError if `path` is no bag.
    """
    contents = Contents({}, {}, [])
    for file in _files(path, contents.problems):
        read = _read_mcap if file.suffix == '.mcap' else _read_by_rosbags
        try:
            read(file, select, contents)
        except OSError as error:
            raise InputError(f'{file} cannot be read: {error.strerror or error}') from None
        except BROKEN as error:
            what = ('it ends too early' if isinstance(error, EndOfFile) else
                    ' '.join(str(error).split()))
            contents.problems.append(f'{file} is damaged or was cut off ({what})')
    if path.is_dir() and not contents.problems:
        contents.problems.extend(_missing_messages(path, contents.topics))
    return contents


def _missing_messages(path: Path, topics: Mapping[str, Topic]) -> Iterator[str]:
    """Yield a sentence for each topic with fewer messages than its metadata.yaml counts."""
    with suppress(OSError, *BROKEN):    # the last for an unexpected form
        for each in _described(path)['topics_with_message_count']:
            name, count = each['topic_metadata']['name'], int(each['message_count'])
            if name in topics and len(topics[name]) < count:
                yield (f'{path}: {count - len(topics[name])} of the {count} messages of {name} '
                       'that its metadata.yaml counts are missing')


def _described(path: Path) -> dict[str, Any]:
    """Return the contents of a bag's metadata.yaml. Raises one of BROKEN or OSError."""
    metadata = with_a_file_as_metadata(path) / 'metadata.yaml'
    return dict(yaml.safe_load(metadata.read_text(encoding='utf-8'))[
        'rosbag2_bagfile_information'])


def _files(path: Path, problems: list[str]) -> list[Path]:
    """Return the files to read, in order."""
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
        described = _described(path)
        if described['storage_identifier'] != 'mcap' or described.get('compression_mode'):
            return [path]
        files = [path / Path(os.fsdecode(name.encode())).name
                 for name in described['relative_file_paths']]
    except FileNotFoundError:
        problems.append(f'{path} has no metadata.yaml: its recording was not ended properly')
        files = sorted([*path.glob('*.mcap'), *path.glob('*.db3')], key=_number)
    except (OSError, *BROKEN):
        problems.append(f'{path / "metadata.yaml"} cannot be read')
        files = sorted([*path.glob('*.mcap'), *path.glob('*.db3')], key=_number)
    present = [file for file in files if file.is_file() and file.stat().st_size]
    problems += [f'{file} is missing or empty' for file in files if file not in present]
    if not present:
        meant = f'; is {path / "bag"} meant?' if (path / 'bag').is_dir() else ''
        raise InputError(f'{path} is not a bag: expected a rosbag2 directory with a .mcap or .db3 '
                         f'file that is not empty{meant}')
    return present


def is_empty(path: Path) -> bool:
    """
    Return whether a bag has no message, by its metadata.yaml and its files.

    A recorder that was ended while it wrote has not counted its messages.
    """
    with suppress(OSError, *BROKEN):
        return bool(_described(path)['message_count'] == 0) and not any(
            map(_holds_a_message, path.glob('*.mcap')))
    return False


def _holds_a_message(file: Path) -> bool:
    """Return whether there is a message in an MCAP file, which may be cut off."""
    with file.open('rb') as data, suppress(*BROKEN):
        return any(isinstance(record, Message) for record in StreamReader(data).records)
    return False


def with_a_file_as_metadata(path: Path) -> Path:
    """Return the path of a bag, if its metadata.yaml is no pipe nor too large; else ValueError."""
    metadata = path / 'metadata.yaml'
    if metadata.exists() and not (metadata.is_file()
                                  and metadata.stat().st_size <= MOST_METADATA):
        raise ValueError(f'{metadata} is not a file of at most {MOST_METADATA} bytes')
    return path


def with_files_only(path: Path) -> Path:
    """Return the path of a bag, if it has no pipes nor devices for files; else ValueError."""
    for each in (path, *(path.iterdir() if path.is_dir() else ())):
        if each.exists() and not (each.is_file() or each.is_dir()):
            raise ValueError(f'{each} is not a file')
    return with_a_file_as_metadata(path)


def _number(file: Path) -> tuple[int, str]:
    """Return a sort key that puts name_2 before name_10."""
    digits = file.stem.rpartition('_')[2]
    return (int(digits) if digits.isdigit() else 0), file.name


def _read_mcap(file: Path, select: Callable[[str], bool], contents: Contents) -> None:
    size = file.stat().st_size
    decoder = _McapDecoder(select, contents, most_unpacked(file))
    expected = None
    with file.open('rb') as stream:
        try:
            for record in _Records(stream, emit_chunks=True, record_size_limit=size).records:
                if isinstance(record, Chunk):
                    decoder.add_chunk(record)
                elif isinstance(record, Message):
                    decoder.add(record.channel_id, record.sequence, record.log_time,
                                record.publish_time, record.data)
                elif isinstance(record, Schema):
                    decoder.schemas[record.id] = record.name
                elif isinstance(record, Channel):
                    decoder.add_channel(record)
                elif isinstance(record, Metadata) and record.name == INFORMATION:
                    contents.information.update(
                        {name: json.loads(value) for name, value in record.metadata.items()})
                elif isinstance(record, Statistics):
                    expected = record.message_count
        finally:
            decoder.finish()
    if expected not in (None, decoder.count):
        contents.problems.append(f'{file} is damaged: {decoder.count} of its {expected} messages '
                                 'can be read')


class _McapDecoder:
    """
    Decodes the records of an MCAP file into `contents`.

    Chunks are buffered; numpy extracts the messages of a batch by channel.
    """

    def __init__(self, select: Callable[[str], bool], contents: Contents,
                 most_bytes: int) -> None:
        self.select = select
        self.most_bytes = most_bytes        # limit for the remaining chunks, unpacked
        self.contents = contents
        self.schemas: dict[int, str] = {}
        self.channels: dict[int, Topic | None] = {}     # None: not selected
        self.count = 0
        self._buffered: list[bytes] = []
        self._starts: list[npt.NDArray[np.int64]] = []      # of their records
        self._size = 0

    def add(self, channel: int, number: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Add a message."""
        self.count += 1
        topic = self.channels.get(channel)
        if topic is not None:
            topic.count([number])
            topic.add(log_ns, publish_ns, data)

    def add_channel(self, channel: Channel) -> None:
        """Add a channel, to its topic if that is selected."""
        self.channels[channel.id] = None
        if self.select(channel.topic):
            topic = self.contents.topics.setdefault(
                channel.topic, Topic(channel.topic, self.schemas[channel.schema_id]))
            topic.offered = _offered(channel, self.contents.problems)
            self.channels[channel.id] = topic

    def add_chunk(self, chunk: Chunk) -> None:
        """Unpack a chunk. Raises ValueError for a wrong checksum, EndOfFile for a cut record."""
        plain = replace(chunk, compression='', data=_unpacked(
            chunk.compression, self.most_bytes, chunk.data, chunk.uncompressed_size))
        stream, size = get_chunk_data_stream(plain, validate_crc=True)
        self.most_bytes -= size
        data = stream.read(size)
        starts, end = _records_of(np.frombuffer(data, np.uint8))
        self._buffered.append(data)
        self._starts.append(starts + self._size)
        self._size += size
        if end < size:
            raise EndOfFile
        if self._size > BATCH_BYTES:
            self.finish()

    def finish(self) -> None:
        """Decode the buffered chunks."""
        data, starts = b''.join(self._buffered), np.concatenate([np.array([], int), *self._starts])
        self._buffered, self._starts, self._size = [], [], 0
        opcodes, ends = np.frombuffer(data, np.uint8)[starts], np.append(starts[1:], len(data))
        for k in np.flatnonzero((opcodes == Opcode.SCHEMA) | (opcodes == Opcode.CHANNEL)):
            stream = ReadDataStream(BytesIO(data[starts[k] + _RECORD_BYTES:ends[k]]))
            if opcodes[k] == Opcode.SCHEMA:
                schema = Schema.read(stream)
                self.schemas[schema.id] = schema.name
            else:
                self.add_channel(Channel.read(stream))
        starts = starts[opcodes == Opcode.MESSAGE]
        if not len(starts):
            return
        headers = _headers(data, starts)
        self.count += len(starts)
        for channel in np.unique(headers['channel']).tolist():
            topic = self.channels.get(channel)
            if topic is not None:
                own = headers['channel'] == channel
                topic.count(headers['sequence'][own])
                topic.add_many(_extract(data, starts[own], headers[own]))


@jit
def _records_of(data):
    """Return the starts of the whole records of a chunk, n, and where the last of them ends."""
    starts = np.empty(data.size // _RECORD_BYTES, np.int64)
    count = place = 0
    while place + _RECORD_BYTES <= data.size:
        length = 0
        for k in range(_RECORD_BYTES - 1, 0, -1):
            length = 256 * length + data[place + k]
        least = _HEAD_BYTES - _RECORD_BYTES if data[place] == _MESSAGE_OPCODE else 0
        if not least <= length <= data.size - place - _RECORD_BYTES:    # or beyond 64 bits
            break
        starts[count] = place
        count += 1
        place += _RECORD_BYTES + length
    return starts[:count].copy(), place


def _unpacked(compression: str, most_bytes: int, packed: bytes, size: int) -> bytes:
    """Return the unpacked bytes of a chunk. Raises ValueError for a wrong or too large size."""
    if not compression:
        return packed
    if size > most_bytes:
        raise ValueError(TOO_MUCH)
    if compression == 'zstd':
        with zstandard.ZstdDecompressor().stream_reader(packed) as stream:
            data = stream.read(size + 1)
    elif compression == 'lz4':
        data = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
    else:
        raise ValueError(f'a chunk is compressed by {compression!r}')
    if len(data) != size:
        raise ValueError('a chunk does not unpack to the size in its header')
    return data


@contextmanager
def opened_by_rosbags(path: Path) -> Iterator[Reader]:
    """Open a bag by rosbags, as `limited`."""
    with limited(path) as limited_path, Reader(limited_path) as reader:
        yield reader


@contextmanager
def limited(path: Path) -> Iterator[Path]:
    """
    Limit what rosbags does with a bag, which has no limits; yield the path to give to it.

    The files together, and each chunk, unpack to `most_unpacked` at most; nothing is a pipe or a
    device; sqlite3 computes nothing. Raises one of BROKEN.
    """
    most_bytes = remaining = most_unpacked(with_files_only(path))
    for file in path.glob('*.zstd'):    # rosbags unpacks them to the disk
        with file.open('rb') as packed:
            remaining -= len(_unzipped(packed, remaining))
    unlimited = dict(storage_mcap.DECOMPRESSORS)
    storage_mcap.DECOMPRESSORS.update({
        name: partial(_unpacked, name, most_bytes) for name in unlimited})
    apsw.connection_hooks.append(_refuse_computed)
    try:
        yield _InAddress(path)
    finally:
        apsw.connection_hooks.remove(_refuse_computed)
        storage_mcap.DECOMPRESSORS.update(unlimited)


class _InAddress(type(Path())):     # type: ignore[misc]
    """A path that rosbags puts into the address of a database, where % ? # have a meaning."""

    def __format__(self, _: str) -> str:
        return str(self).replace('%', '%25').replace('?', '%3f').replace('#', '%23')


def _refuse_computed(database: apsw.Connection) -> None:
    """
    Raise ValueError for a database with views, or with columns that are expressions.

    They may take for ever and any memory.
    """
    for kind, name in list(database.execute('SELECT type, name FROM sqlite_master')):
        columns = database.execute('SELECT hidden FROM pragma_table_xinfo(?)', (name,))
        if kind == 'view' or kind == 'table' and any(hidden for hidden, in columns):
            raise ValueError(f'{name} of the database is computed by SQL, not stored')


def _offered(channel: Channel, problems: list[str]) -> list[dict[str, Any]]:
    """Return the QoS offered by the publishers of a channel, [] if it cannot be read."""
    try:
        offered = yaml.safe_load(channel.metadata.get('offered_qos_profiles', '')) or []
    except BROKEN:
        offered = None
    if not isinstance(offered, list) or not all(isinstance(one, dict) for one in offered):
        problems.append(f'{channel.topic}: its quality of service cannot be read')
        return []
    return offered


def _headers(data: bytes, starts: npt.NDArray[np.int64]) -> npt.NDArray[np.void]:
    """Return the record and message headers at these offsets."""
    rows = sliding_window_view(np.frombuffer(data, np.uint8), _HEAD.itemsize)[starts]
    return rows.view(_HEAD)[:, 0]


def _extract(data: bytes, starts: npt.NDArray[np.int64], headers: npt.NDArray[np.void]
             ) -> Messages:
    """Return the messages of one channel at these offsets."""
    log_ns, publish_ns = headers['log_ns'].astype(np.int64), headers['publish_ns'].astype(np.int64)
    lengths = headers['length'].astype(np.int64) - (_HEAD.itemsize - _RECORD_BYTES)
    begins = starts + _HEAD.itemsize
    if (lengths == lengths[0]).all() and lengths[0]:
        windows = sliding_window_view(np.frombuffer(data, np.uint8), lengths[0])
        return Messages(log_ns, publish_ns, windows[begins])
    return Messages(log_ns, publish_ns, [
        data[begin:end] for begin, end in zip(begins, begins + lengths, strict=True)])


def _read_by_rosbags(path: Path, select: Callable[[str], bool], contents: Contents) -> None:
    """Read sqlite3 and compressed files, which have no times of publication."""
    remaining = most_unpacked(with_files_only(path))
    with opened_by_rosbags(path) as reader:
        connections = [c for c in reader.connections if select(c.topic)]
        for connection in connections:
            topic = contents.topics.setdefault(connection.topic,
                                               Topic(connection.topic, connection.msgtype))
            assert isinstance(connection.ext, ConnectionExtRosbag2)
            topic.offered = [dict(qos) for qos in dump_qos_v9(connection.ext.offered_qos_profiles)]
        if not connections:
            return
        by_message = reader.compression_mode == 'message'
        for connection, time_ns, data in (_packed(reader, select) if by_message else
                                          reader.messages(connections)):
            plain = _unzipped(BytesIO(data), remaining) if by_message else bytes(data)
            remaining -= len(plain)
            unsigned_ns = time_ns % 2**64    # as in MCAP
            contents.topics[connection.topic].add(unsigned_ns, unsigned_ns, plain)


def _packed(reader: Reader, select: Callable[[str], bool]
            ) -> Iterator[tuple[Connection, int, bytes]]:
    """Yield messages that rosbags would unpack without a limit, with their times (ns)."""
    for storage in reader.storage.storages:     # type: ignore[attr-defined]
        selected = [each for each in storage.connections if select(each.topic)]
        if selected:
            yield from storage.messages(selected)


def most_unpacked(path: Path) -> int:
    """Return the limit of what a file, or the files of a bag, may unpack to, bytes."""
    files = path.iterdir() if path.is_dir() else [path]
    return unpack_limit(sum(file.stat().st_size for file in files), MOST_UNPACKED, MOST_RATIO)


def _unzipped(packed: IO[bytes], most_bytes: int) -> bytes:
    """Return unpacked zstd data. Raises ValueError if they are too large."""
    with zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True) as stream:
        found = stream.read(most_bytes + 1)
    if len(found) > most_bytes:
        raise ValueError(TOO_MUCH)
    return found
