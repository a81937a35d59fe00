"""
Write a rosbag2 directory: metadata.yaml (version 9) and one MCAP file of profile ros2.

Based on the `mcap` library: the writer of rosbags writes chunks of a megabyte without flushing,
and has neither sequence numbers nor custom metadata; mcap-ros2-support leaves out the QoS.
"""

import copy
import functools
import heapq
import itertools
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
from mcap.records import ChunkIndex
from mcap.writer import Writer
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from asi_analysis.errors import InputError
from asi_common.files import write_text

# A killed recorder loses the open chunk: about a hundred ticks, or at low rates this time. Both
# limits depend on the messages only, so that the same messages give the same file.
CHUNK_BYTES: Final = 64 * 1024
CHUNK_NS: Final = 250_000_000
INFORMATION: Final = 'asi.run'
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


class _ChunkIndices:
    """
    The chunk indices as bytes, which are written at the end of the file.

    The list of objects in mcap takes eight times as much memory: 40 MB an hour at 1 kHz.
    """

    def __init__(self) -> None:
        self._records = RecordBuilder()

    def append(self, index: ChunkIndex) -> None:
        index.write(self._records)

    def __iter__(self) -> Iterator['_ChunkIndices']:
        yield self

    def write(self, stream: RecordBuilder) -> None:
        stream.write(self._records.end())


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
        # A copy for each topic: YAML writes a shared object as an alias.
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
        Times of publication are equal to log times.
        """
        for log_ns, channel, data in heapq.merge(*(
                zip(times.tolist(), itertools.repeat(channel), map(bytes, table))
                for channel, (times, table) in messages.items())):
            self.write(channel, log_ns, log_ns, self._counts[channel] + 1, data)

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
