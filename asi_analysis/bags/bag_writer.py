"""
Write a rosbag2 directory: metadata.yaml (version 9) and one MCAP file of profile ros2.

Based on the `mcap` library: the writer of rosbags writes chunks of a megabyte without flushing,
and has neither sequence numbers nor custom metadata; mcap-ros2-support leaves out the QoS.
"""

import copy
import functools
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import yaml
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import ChunkIndex
from mcap.writer import Writer
from numpy.lib.stride_tricks import sliding_window_view
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from asi_analysis.errors import InputError
from asi_common.files import write_text

# A killed recorder loses the open chunk: about a hundred ticks, or at low rates this time. Both
# limits depend on the messages only, so that the same messages give the same file.
CHUNK_BYTES: Final = 64 * 1024
CHUNK_NS: Final = 250_000_000
INFORMATION: Final = 'asi.run'
# What precedes the bytes of a message in MCAP.
MESSAGE: Final = np.dtype([('opcode', 'u1'), ('length', '<u8'), ('channel', '<u2'),
                           ('sequence', '<u4'), ('log_ns', '<u8'), ('publish_ns', '<u8')])

_NEVER: Final = {'sec': 9223372036, 'nsec': 854775807}
# QoS as a subscriber sees it: DDS does not transmit the history.
RELIABLE: Final[dict[str, Any]] = {
    'history': 'unknown', 'depth': 0, 'reliability': 'reliable', 'durability': 'volatile',
    'deadline': {**_NEVER}, 'lifespan': {**_NEVER}, 'liveliness': 'automatic',
    'liveliness_lease_duration': {**_NEVER}, 'avoid_ros_namespace_conventions': False}


class _Topic(NamedTuple):
    name: str
    type: str
    offered: Sequence[Mapping[str, Any]]


@functools.cache
def typestore() -> Typestore:
    """Return the message types of Jazzy."""
    return get_typestore(Stores.ROS2_JAZZY)


def _records(channel: int, log_ns: npt.NDArray[np.int64], count: int, data: npt.NDArray[np.uint8]
             ) -> npt.NDArray[np.uint8]:
    """Return the MCAP records of messages, n x length; count: of those before on the channel."""
    head = np.zeros(len(data), MESSAGE)
    head['opcode'], head['length'], head['channel'] = (
        Opcode.MESSAGE, MESSAGE.itemsize - 9 + data.shape[1], channel)
    head['sequence'] = np.arange(count + 1, count + 1 + len(data))
    head['log_ns'] = head['publish_ns'] = log_ns
    return np.hstack([head.view(np.uint8).reshape(len(data), -1), data])


class _ChunkIndices:
    """
    The chunk indices as bytes, which are written at the end of the file.

    The list of objects that mcap keeps takes eight times the memory: 40 MB an hour at 1 kHz.
    """

    def __init__(self) -> None:
        self._records = RecordBuilder()

    def append(self, index: ChunkIndex) -> None:
        index.write(self._records)

    def __iter__(self) -> Iterator['_ChunkIndices']:
        yield self

    def write(self, stream: RecordBuilder) -> None:
        stream.write(self._records.end())


class _MessageIndex:
    """Times and offsets of a channel's messages in a chunk; mcap writes each number by itself."""

    def __init__(self, channel: int) -> None:
        self.channel = channel
        # Pairs, as mcap appends them, and arrays n x 2.
        self.records: list[Any] = []

    def write(self, stream: RecordBuilder) -> None:
        data = np.vstack(self.records).astype('<u8').tobytes()
        stream.start_record(Opcode.MESSAGE_INDEX)
        stream.write2(self.channel)
        stream.write4(len(data))
        stream.write(data)
        stream.finish_record()


class BagWriter:
    """
    A bag being written.

    Raises InputError if the directory exists already or cannot be made; OSError from any method
    when the disk is full, after which only `abandon` may be called.
    """

    def __init__(self, directory: Path) -> None:
        try:
            directory.mkdir(parents=True)
        except FileExistsError:
            raise InputError(f'{directory} exists already: a bag is never written over, give '
                             'another directory') from None
        except OSError as error:
            raise InputError(f'{directory} cannot be made: {error.strerror}') from None
        self._directory = directory
        self._file = (directory / f'{directory.name}_0.mcap').open('xb')
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES)
        # A private name of mcap 1.6.0, guarded by a test. Under another name only memory grows.
        self._writer._Writer__chunk_indices = _ChunkIndices()  # type: ignore[attr-defined]
        self._writer.start(profile='ros2', library='asi_actuator')
        self._schemas: dict[str, int] = {}
        self._topics: dict[int, _Topic] = {}
        self._counts: dict[int, int] = {}
        self._start_ns, self._end_ns = 2**63 - 1, 0
        self._chunk_ns = 0

    def add_information(self, information: Mapping[str, Any]) -> None:
        """Add metadata to `asi.run`: plain data by name, each stored as JSON."""
        self._writer.add_metadata(INFORMATION, {
            name: json.dumps(value) for name, value in information.items()})

    def add_topic(self, name: str, type_: str,
                  offered: Sequence[Mapping[str, Any]] = (RELIABLE,)) -> int:
        """Add a topic with the QoS that its publishers offer; return its channel."""
        # A copy for each topic: YAML writes what is shared as a reference.
        offered = copy.deepcopy(list(offered))
        if type_ not in self._schemas:
            definition, _ = typestore().generate_msgdef(type_, ros_version=2)
            self._schemas[type_] = self._writer.register_schema(
                type_, 'ros2msg', definition.encode())
        channel = self._writer.register_channel(
            name, 'cdr', self._schemas[type_],
            {'offered_qos_profiles': yaml.safe_dump(offered).strip(),
             'topic_type_hash': typestore().hash_rihs01(type_)})
        self._topics[channel] = _Topic(name, type_, offered)
        self._counts[channel] = 0
        return channel

    def write(self, channel: int, log_ns: int, publish_ns: int, sequence: int,
              data: bytes) -> None:
        """Add a serialised message."""
        if log_ns - self._chunk_ns > CHUNK_NS:
            self._writer.flush()
            self._chunk_ns = log_ns
        self._writer.add_message(channel, log_ns, data, publish_ns, sequence & 0xFFFFFFFF)
        self._counts[channel] += 1
        if log_ns < self._start_ns:
            self._start_ns = log_ns
        if log_ns > self._end_ns:
            self._end_ns = log_ns

    def write_many(self, messages: Mapping[int, tuple[npt.NDArray[np.int64],
                                                      npt.NDArray[np.uint8]]]) -> None:
        """
        Add messages in the order of their times, those of one time in the order of the channels.

        messages: by channel, log times of n messages (ns), rising, and their bytes, n x length.
        Times of publication are equal to log times. The file is that of as many calls of `write`.
        """
        tables = {channel: _records(channel, log_ns, self._counts[channel], data)
                  for channel, (log_ns, data) in messages.items()}
        if not tables:
            return
        channels = np.concatenate([np.full(len(table), channel)
                                   for channel, table in tables.items()])
        log_ns = np.concatenate([times for times, _ in messages.values()])
        lengths = np.concatenate([np.full(len(table), table.shape[1])
                                  for table in tables.values()])
        order = np.lexsort((channels, log_ns))
        channels, log_ns = channels[order], log_ns[order]
        ends = np.cumsum(lengths[order])
        begins = ends - lengths[order]
        stream = np.empty(ends[-1], np.uint8)
        for channel, table in tables.items():
            self._counts[channel] += len(table)
            places = sliding_window_view(stream, table.shape[1], writeable=True)
            places[begins[channels == channel]] = table
        self._start_ns = min(self._start_ns, int(log_ns[0]))
        self._end_ns = max(self._end_ns, int(log_ns[-1]))
        # Private names of mcap 1.6.0, guarded by a test.
        chunk = self._writer._Writer__chunk_builder   # type: ignore[attr-defined]
        first, count = 0, len(channels)
        while first < count:
            if log_ns[first] - self._chunk_ns > CHUNK_NS:
                self._writer.flush()
                self._chunk_ns = int(log_ns[first])
            begin = int(begins[first])
            full = int(np.searchsorted(ends, begin + CHUNK_BYTES - chunk.count, 'right')) + 1
            late = int(np.searchsorted(log_ns, self._chunk_ns + CHUNK_NS, 'right'))
            last = min(full, late, count)
            part = slice(first, last)
            self._add_to_chunk(chunk, channels[part], log_ns[part],
                               begins[part] - begin + chunk.count)
            chunk.record_writer.write(stream[begin:ends[last - 1]])
            if last == full:
                self._writer.flush()
            first = last

    def _add_to_chunk(self, chunk: Any, channels: npt.NDArray[np.int64],
                      log_ns: npt.NDArray[np.int64], offsets: npt.NDArray[np.int64]) -> None:
        """Count messages, and add them to the indices of a chunk."""
        statistics = self._writer._Writer__statistics   # type: ignore[attr-defined]
        first_ns, last_ns = int(log_ns[0]), int(log_ns[-1])
        if not statistics.message_count:
            statistics.message_start_time = first_ns
        if not chunk.num_messages:
            chunk.message_start_time = first_ns
        for each in (statistics, chunk):
            each.message_start_time = min(each.message_start_time, first_ns)
            each.message_end_time = max(each.message_end_time, last_ns)
        statistics.message_count += len(channels)
        chunk.num_messages += len(channels)
        found, firsts = np.unique(channels, return_index=True)
        for channel in found[np.argsort(firsts)].tolist():
            own = channels == channel
            index = chunk.message_indices.get(channel)
            if not isinstance(index, _MessageIndex):
                chunk.message_indices[channel] = _MessageIndex(channel)
                chunk.message_indices[channel].records += index.records if index else []
            chunk.message_indices[channel].records.append(
                np.column_stack([log_ns[own], offsets[own]]))
            statistics.channel_message_counts[channel] += int(own.sum())

    def flush(self) -> None:
        """Hand the finished chunks to the operating system, so that a kill does not lose them."""
        self._file.flush()

    def counts(self) -> dict[str, int]:
        """Return the number of messages written, by topic."""
        return {self._topics[channel].name: count for channel, count in self._counts.items()}

    def close(self) -> None:
        """Finish the bag: write summary, index and metadata.yaml."""
        self._writer.finish()
        self._file.close()
        text = yaml.safe_dump({'rosbag2_bagfile_information': self._description()},
                              sort_keys=False)
        write_text(self._directory / 'metadata.yaml', text)

    def abandon(self, error: BaseException | None = None) -> None:
        """Close the file after an error, which gets its name if it has none; it can be read."""
        if isinstance(error, OSError) and error.filename is None:
            error.filename = str(self._directory)
        with suppress(OSError):
            self._file.close()

    def _description(self) -> dict[str, Any]:
        """Return the contents of metadata.yaml."""
        total = sum(self._counts.values())

        def span() -> dict[str, Any]:
            return {'starting_time': {'nanoseconds_since_epoch': self._start_ns if total else 0},
                    'duration': {'nanoseconds': self._end_ns - self._start_ns if total else 0},
                    'message_count': total}

        name = Path(self._file.name).name
        return {
            'version': 9,
            'storage_identifier': 'mcap',
            'relative_file_paths': [name],
            **span(),
            'topics_with_message_count': [
                {'topic_metadata': {
                    'name': topic.name, 'type': topic.type, 'serialization_format': 'cdr',
                    'offered_qos_profiles': [dict(offered) for offered in topic.offered],
                    'type_description_hash': typestore().hash_rihs01(topic.type)},
                 'message_count': self._counts[channel]}
                for channel, topic in self._topics.items()],
            'compression_format': '',
            'compression_mode': '',
            'files': [{'path': name, **span()}],
            'custom_data': None,
            'ros_distro': os.environ.get('ROS_DISTRO', 'jazzy'),
        }
