"""Bags: ours and others' are read alike, damaged ones as far as they go, the rest is refused."""

import shutil
import struct
import warnings
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.writer import Writer as McapWriter
from rosbags.highlevel import AnyReader
from rosbags.interfaces import MessageDefinitionFormat
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from asi_analysis.bags.bag import read_bag, write_bag
from asi_analysis.bags.bag_file import Contents
from asi_analysis.bags.bag_writer import BagWriter
from asi_analysis.bags.exchange import bag_table
from asi_analysis.bags.exchange.importing import import_recording, read_joint, read_joints
from asi_analysis.bags.run import Run
from asi_analysis.bags.topic_messages import Topic
from asi_analysis.errors import InputError, InputWarning
from asi_analysis.measures.analysis import analyze
from asi_common.node import messages as wire

STORE = get_typestore(Stores.ROS2_JAZZY)
TIME = STORE.types['builtin_interfaces/msg/Time']
HEADER = STORE.types['std_msgs/msg/Header']
VECTOR = STORE.types['geometry_msgs/msg/Vector3']
WRENCH = STORE.types['geometry_msgs/msg/Wrench']
STAMPED = 'geometry_msgs/msg/WrenchStamped'


def a_run(count: int = 500) -> Run:
    rng = np.random.default_rng(1)
    columns: dict[str, Any] = {field: rng.normal(size=count) for field in (
        'reference_n', 'command_n', 'force_n', 'valve_position_m', 'position_m', 'velocity_m_s')}
    return Run(np.arange(count) / 5000.0, **columns, information={'seed': 7, 'name': 'a run'})


def assert_same(run: Run, expected: Run) -> None:
    np.testing.assert_array_equal(run.time_s, expected.time_s)
    assert run.signals().keys() == expected.signals().keys()
    for name, values in expected.signals().items():
        np.testing.assert_array_equal(run.signals()[name], values, err_msg=name)


def wrench(stamp_ns: int, force: float, frame: str = 'piston') -> bytes:
    message = STORE.types[STAMPED](
        HEADER(TIME(stamp_ns // 10**9, stamp_ns % 10**9), frame),
        WRENCH(VECTOR(force, 0.0, 0.0), VECTOR(0.0, 0.0, 0.0)))
    return bytes(STORE.serialize_cdr(message, STAMPED))


def test_the_writer_of_mcap_keeps_what_ours_uses_where_it_was() -> None:
    assert hasattr(McapWriter(BytesIO()), '_Writer__chunk_indices'), (
        f'mcap {version("mcap")} has it elsewhere (1.6.0 had it here): see '
        'asi_analysis/bags/bag_writer.py')


@pytest.mark.parametrize('rate_hz', [5000.0, 2.0])
def test_many_messages_are_written_as_one_by_one(rate_hz: float, tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    stamps = np.round(np.arange(1, 1001) * 1e9 / rate_hz).astype(np.int64)
    topics = {'one': rng.integers(0, 255, (1000, 84), np.uint8),
              'two': rng.integers(0, 255, (1000, 12), np.uint8)}
    often = rng.random(1000) < 0.7
    for name in ('single', 'many'):
        writer = BagWriter(tmp_path / name / 'bag')
        one, two = (writer.add_topic(f'/{topic}', STAMPED) for topic in topics)
        for block in (slice(0, 1), slice(1, 700), slice(700, 1000)):
            rows = [(one, stamps[block], topics['one'][block]),
                    (two, stamps[block][often[block]], topics['two'][block][often[block]])]
            if name == 'many':
                writer.write_many({channel: (times, table) for channel, times, table in rows})
                continue
            single = sorted((int(time), channel, bytes(data)) for channel, times, table in rows
                            for time, data in zip(times, table, strict=True))
            for time, channel, data in single:
                writer.write(channel, time, time, 1 + writer.counts()[
                    '/one' if channel == one else '/two'], data)
        writer.close()
    for file in ('bag_0.mcap', 'metadata.yaml'):
        assert (tmp_path / 'single/bag' / file).read_bytes() == (
            tmp_path / 'many/bag' / file).read_bytes()


def foreign_bag(path: Path, messages: dict[str, list[tuple[int, bytes]]],
                plugin: StoragePlugin = StoragePlugin.MCAP,
                types: dict[str, str] | None = None,
                compression: CompressionMode = CompressionMode.NONE) -> Path:
    """Write messages (log time ns, bytes) by topic as rosbag2 does, without our writer."""
    writer = Writer(path, version=9, storage_plugin=plugin)
    writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        rows = []
        for topic, entries in messages.items():
            connection = writer.add_connection(
                topic, (types or {}).get(topic, STAMPED), typestore=STORE)
            rows += [(time, connection, data) for time, data in entries]
        for time, connection, data in sorted(rows, key=lambda row: row[0]):
            writer.write(connection, time, data)
    return path


@pytest.mark.parametrize('order', [
    [*range(60, 100), *range(40)],                        # a simulation that began again
    [*range(50), *range(30, 80)], 2 * [*range(50)],       # a clock set back, a bag played twice
    [*range(100), *range(20)]])                           # begun again, and soon stopped
def test_a_time_that_goes_back_is_refused_not_mixed(order: list[int], tmp_path: Path) -> None:
    rows = [(k * 10**7, wrench(10**9 + stamp * 10**7, float(k))) for k, stamp in enumerate(order)]
    bag = foreign_bag(tmp_path / 'bag', {'/force': rows})
    with pytest.raises(InputError, match='the stamps go back by'):
        read_bag(bag)
    with pytest.raises(InputError, match='the stamps go back by'):
        import_recording(bag, ['force=/force/wrench/force/x'])


@pytest.mark.parametrize('order', [
    [*range(10), 11, 10, *range(12, 50)], [*range(10), 10**6, *range(10, 50)],
    [*range(10), *range(30, 50), *range(10, 30)]])
def test_a_late_message_and_a_wrong_stamp_are_put_in_order(order: list[int], tmp_path: Path
                                                           ) -> None:
    rows = [(k * 10**7, wrench(10**9 + stamp * 10**7, float(stamp)))
            for k, stamp in enumerate(order)]
    run = read_bag(foreign_bag(tmp_path / 'bag', {'/force': rows}))
    assert run.force_n.tolist() == sorted(map(float, order))


@pytest.mark.parametrize('again', [0, 3])
def test_messages_that_repeat_a_stamp_are_left_out_with_a_note(again: int, tmp_path: Path) -> None:
    order = [*range(20), *range(20 - again, 20)]
    rows = [(k * 10**7, wrench(10**9 + stamp * 10**7, float(stamp)))
            for k, stamp in enumerate(order)]
    bag = foreign_bag(tmp_path / 'bag', {'/force': rows})
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter('always')
        assert read_bag(bag).force_n.tolist() == [*range(20)]
    assert [str(each.message).split(': ')[1] for each in said] == [
        '3 of 23 messages repeat the stamp of another one, and are left out'][:again]


def test_round_trip_is_exact(tmp_path: Path) -> None:
    run = a_run()
    write_bag(run, tmp_path / 'bag')
    again = read_bag(tmp_path / 'bag')
    assert_same(again, run)
    assert again.information == {'seed': 7, 'name': 'a run'}
    assert_same(read_bag(tmp_path / 'bag' / 'bag_0.mcap'), run)


def test_an_infinite_sample_is_a_missing_one(tmp_path: Path) -> None:
    run = a_run()
    assert run.force_n is not None
    run.force_n[[7, 30]] = np.inf, -np.inf
    write_bag(run, tmp_path / 'bag')
    back = read_bag(tmp_path / 'bag')
    assert np.flatnonzero(np.isnan(back.signal('force'))).tolist() == [7, 30]
    assert 'missing' in {each['kind'] for each in analyze(back)['quality']}


def test_missing_samples_and_absent_signals_stay_so(tmp_path: Path) -> None:
    command = np.arange(50.0)
    command[[3, 30]] = np.nan
    run = Run(np.arange(50) / 1000.0, force_n=np.arange(50.0), command_n=command)
    write_bag(run, tmp_path / 'bag')
    assert_same(read_bag(tmp_path / 'bag'), run)


def test_other_readers_find_what_was_written(tmp_path: Path) -> None:
    run = a_run(50)
    write_bag(run, tmp_path / 'bag')
    metadata = yaml.safe_load((tmp_path / 'bag/metadata.yaml').read_text())
    assert metadata['rosbag2_bagfile_information']['version'] == 9
    with AnyReader([tmp_path / 'bag']) as reader:
        assert reader.message_count == 6 * 50
        topics: dict[str, Any] = {c.topic: c for c in reader.connections}
        assert topics['/joint_states'].digest == STORE.hash_rihs01('sensor_msgs/msg/JointState')
        assert topics['/force'].ext.offered_qos_profiles[0].reliability.name == 'RELIABLE'
        forces: list[Any] = [reader.deserialize(data, connection.msgtype)
                  for connection, _, data in reader.messages([topics['/force']])]
    np.testing.assert_array_equal([m.wrench.force.x for m in forces], run.force_n)
    assert forces[4].header.stamp.nanosec == 1_000_000      # the first stamp is one period


@pytest.mark.parametrize(('plugin', 'compression'), [
    (StoragePlugin.MCAP, CompressionMode.NONE), (StoragePlugin.SQLITE3, CompressionMode.NONE),
    (StoragePlugin.SQLITE3, CompressionMode.FILE), (StoragePlugin.MCAP, CompressionMode.MESSAGE)])
def test_reads_what_others_recorded(tmp_path: Path, plugin: StoragePlugin,
                                    compression: CompressionMode) -> None:
    """Two topics, wall-clock stamps, times of receipt that jitter, frames of two lengths."""
    start, period = 1_790_000_000 * 10**9, 1_000_000
    stamps = [start + k * period for k in range(40)]
    bag = foreign_bag(tmp_path / 'bag', {
        '/arm/force': [(t + 300_000 * (k % 3), wrench(t, float(k), 'piston' if k % 2 else 'p'))
                       for k, t in enumerate(stamps)],
        '/arm/valve_command': [(t + 900_000, wrench(t, 10.0 * k))
                               for k, t in enumerate(stamps) if k != 5]},
        plugin, compression=compression)
    run = read_bag(bag)
    np.testing.assert_array_equal(run.time_s, np.arange(40) / 1000.0)
    np.testing.assert_array_equal(run.force_n, np.arange(40.0))
    expected = 10.0 * np.arange(40)
    expected[5] = expected[4]       # state 5 has no answer: the valve stays as it was
    np.testing.assert_array_equal(run.command_n, expected)
    assert set(run.signals()) == {'force', 'command'}


def test_holds_a_reference_that_comes_seldom(tmp_path: Path) -> None:
    """A user's publisher: wrong clock or no stamp at all, once in a while."""
    ticks = [200_000 * k for k in range(1, 31)]
    bag = foreign_bag(tmp_path / 'bag', {
        '/force': [(t, wrench(t, 1.0)) for t in ticks],
        '/force_reference': [(ticks[4], wrench(0, 100.0)), (ticks[20] - 1, wrench(0, 200.0))]})
    reference = read_bag(bag).reference_n
    assert reference is not None
    assert np.isnan(reference[:4]).all()
    assert (reference[4:20] == 100.0).all()
    assert (reference[20:] == 200.0).all()


def test_stamps_that_stand_still_are_told(tmp_path: Path) -> None:
    ticks = [10**6 * k for k in range(1, 31)]
    bag = foreign_bag(tmp_path / 'bag', {
        '/force': [(t, wrench(t, 1.0)) for t in ticks],
        '/force_reference': [(t, wrench(ticks[0], 100.0)) for t in ticks]})
    with pytest.warns(InputWarning, match='30 messages of force_reference have 1 different'):
        read_bag(bag)


@pytest.mark.parametrize('published, stamped, told', [
    (range(1, 101), [k + 30 for k in range(1, 101)], 'of force_reference are up to 0.03 s off'),
    (range(1, 101), [k - 30 * (k > 50) for k in range(1, 101)], 'are up to 0.03 s off those of'),
    (range(1, 141), [], 'the messages of force end 0.04 s before those of force_reference'),
    ([1, 2, 4, 7, 8, 9, 11, 15, 16, 20, 90], [], 'force_reference are missing: 11 came, at no')])
def test_stamps_of_another_time_and_lost_messages_are_told(
        published: Sequence[int], stamped: list[int], told: str, tmp_path: Path) -> None:
    ticks = [10**6 * k for k in range(1, 101)]
    bag = foreign_bag(tmp_path / 'bag', {
        '/force': [(t, wrench(t, 1.0)) for t in ticks],
        '/force_reference': [(10**6 * k, wrench(10**6 * stamp, 1.0)) for k, stamp in zip(
            published, stamped or published, strict=True)]})
    with pytest.warns(InputWarning, match=told):
        read_bag(bag)


def test_messages_that_the_metadata_counts_and_the_bag_lacks_are_told(tmp_path: Path) -> None:
    ticks = [10**6 * k for k in range(1, 101)]
    bag = foreign_bag(tmp_path / 'bag', {'/force': [(t, wrench(t, 1.0)) for t in ticks]})
    assert read_bag(bag).problems == ()
    metadata = bag / 'metadata.yaml'
    metadata.write_text(metadata.read_text().replace('message_count: 100', 'message_count: 130'))
    with pytest.warns(InputWarning, match='30 of the 130 messages of /force that its metadata'):
        read_bag(bag)
    metadata.write_text(metadata.read_text().replace('message_count: 130', 'message_count: many'))
    assert read_bag(bag).problems == ()


def numbered_bag(path: Path, numbers: Sequence[int], other: Sequence[int]) -> Path:
    """Write forces with these numbers, and as many references."""
    writer = BagWriter(path)
    for topic, series in (('/force', numbers), ('/force_reference', other)):
        channel = writer.add_topic(topic, STAMPED)
        for number, tick in enumerate(series):
            stamp_ns = 10**6 * (number + 1)
            writer.write(channel, stamp_ns, stamp_ns, tick, wrench(stamp_ns, 1.0))
    writer.close()
    return path


@pytest.mark.parametrize('numbers, other, lost', [
    ([3, 4, 7, 8, 9], range(1, 6), '2 messages of /force were lost on their way'),
    ([3, 4, 7, 8, 9], [1, 2, 5, 6, 9], ''),         # one counter for all topics
    ([3, 4, 1, 2, 9], range(1, 6), ''),             # two publishers
    (5 * [0], 5 * [0], '')])                        # none
def test_messages_lost_before_they_were_recorded_are_told(
        numbers: Sequence[int], other: Sequence[int], lost: str, tmp_path: Path) -> None:
    bag = numbered_bag(tmp_path / 'bag', numbers, other)
    with pytest.warns(InputWarning, match=lost) if lost else nullcontext():
        run = read_bag(bag)
    assert len(run.problems) == (1 if lost else 0)
    assert [each['kind'] for each in analyze(run)['quality']] == (['reading'] if lost else [])


@pytest.mark.parametrize('first, answered, told', [
    (2501, range(100), ['2500 states were published before the recording began']),
    (1, range(20, 100), ['the first 0.02 s have no valve_command']),
    (1, range(60), ['the last 0.04 s have no valve_command']),
    (1, range(1, 99), []), (0, range(100), [])])
def test_a_recorder_that_began_late_and_a_controller_that_ended_are_told(
        first: int, answered: Sequence[int], told: list[str], tmp_path: Path) -> None:
    writer = BagWriter(tmp_path / 'bag')
    states = writer.add_topic('/joint_states', 'sensor_msgs/msg/JointState')
    commands = writer.add_topic('/valve_command', STAMPED)
    for k in range(100):
        stamp_ns = 10**9 + 10**6 * k
        data = wire.state(stamp_ns, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)[0]
        writer.write(states, stamp_ns, stamp_ns, first and first + k, data)
        if k in answered:
            writer.write(commands, stamp_ns, stamp_ns, 0, wrench(stamp_ns, 1.0))
    writer.close()
    with pytest.warns(InputWarning) if told else nullcontext():
        run = read_bag(tmp_path / 'bag')
    assert [text.partition(': ')[2] for text in run.problems] == told


def test_samples_that_a_node_says_it_has_lost_are_told(tmp_path: Path) -> None:
    array = 'diagnostic_msgs/msg/DiagnosticArray'
    status, pair = (STORE.types[f'diagnostic_msgs/msg/{name}'] for name in (
        'DiagnosticStatus', 'KeyValue'))
    diagnostics = [(10**6 * k, bytes(STORE.serialize_cdr(STORE.types[array](
        HEADER(TIME(0, 10**6 * k), ''), [status(0, 'asi_actuator: loop', '', '', [
            pair('ticks', '9'), pair('lost samples', str(k))])]), array))) for k in (1, 3)]
    bag = foreign_bag(tmp_path / 'bag', {
        '/force': [(10**6 * k, wrench(10**6 * k, 1.0)) for k in range(1, 6)],
        '/diagnostics': diagnostics}, types={'/diagnostics': array})
    with pytest.warns(InputWarning, match='asi_actuator lost 3 samples'):
        run = read_bag(bag)
    finding, = analyze(run)['quality']
    assert (finding['kind'], finding['severity']) == ('reading', 'note')
    assert finding['text'].endswith('bag: asi_actuator lost 3 samples')


def test_a_command_stamped_as_it_is_sent_belongs_to_the_state_before(tmp_path: Path) -> None:
    ticks = [1_000_000 * k for k in range(1, 31)]
    bag = foreign_bag(tmp_path / 'bag', {
        '/force': [(t, wrench(t, 1.0)) for t in ticks],
        '/valve_command': [(t + 200_000, wrench(t + 200_000, float(k)))
                           for k, t in enumerate(ticks)]})
    np.testing.assert_array_equal(read_bag(bag).signal('command'), np.arange(30.0))


def test_command_out_of_joint_states_is_the_answer_to_the_state_before(tmp_path: Path) -> None:
    joints, gap = 'sensor_msgs/msg/JointState', np.full(2, np.nan)
    ticks = [1_000_000 * k for k in range(1, 11)]
    bag = foreign_bag(tmp_path / 'bag', {'/joint_states': [
        (t, bytes(STORE.serialize_cdr(STORE.types[joints](
            HEADER(TIME(0, t), ''), ['piston', 'valve'], gap, gap, np.array([1.0, k])), joints)))
        for k, t in enumerate(ticks)]}, types={'/joint_states': joints})
    np.testing.assert_array_equal(read_bag(bag).signal('command'), [*range(1, 10), np.nan])


def test_reads_a_bag_of_several_files(tmp_path: Path) -> None:
    run = a_run(300)
    bag = tmp_path / 'bag'
    bag.mkdir()
    names = []
    for i in range(3):
        write_bag(run[100 * i:100 * (i + 1)], tmp_path / f'part{i}')
    # write_bag starts every bag at one period; only the first one's times are used here.
    for i in range(3):
        names.append(f'bag_{i}.mcap')
        shutil.copy(tmp_path / f'part{i}/part{i}_0.mcap', bag / names[-1])
    (bag / 'metadata.yaml').write_text(yaml.safe_dump({'rosbag2_bagfile_information': {
        'storage_identifier': 'mcap', 'relative_file_paths': names[:1]}}))
    assert_same(read_bag(bag), run[:100])
    (bag / 'metadata.yaml').unlink()
    with (pytest.warns(InputWarning, match='has no metadata.yaml'),
          pytest.raises(InputError, match='go back')):
        read_bag(bag)    # the same stamps three times
    for i in range(3):
        part = foreign_bag(tmp_path / f'next{i}', {'/force': [
            (k * 10**7, wrench(10**9 + k * 10**7, float(k))) for k in range(50 * i, 50 * i + 50)]})
        shutil.copy(next(part.glob('*.mcap')), bag / names[i])
    with pytest.warns(InputWarning, match='has no metadata.yaml'):
        assert read_bag(bag).force_n.tolist() == list(range(150))


def damaged(path: Path) -> Run | None:
    """Return what can be read; None if it is refused, which must be said in one line."""
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', InputWarning)
        try:
            return read_bag(path)
        except InputError as error:
            assert '\n' not in str(error)
            assert path.name in str(error)
            return None


@pytest.fixture(scope='module')
def whole(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Run, bytes, Path]]:
    folder = tmp_path_factory.mktemp('whole')
    run = a_run(1500)
    write_bag(run, folder / 'bag')
    yield run, (folder / 'bag/bag_0.mcap').read_bytes(), folder / 'cut.mcap'


def test_a_truncated_bag_gives_a_prefix_or_is_refused(whole: tuple[Run, bytes, Path]) -> None:
    run, data, path = whole
    lengths = []
    for size in (*range(1, 400, 13), *np.linspace(400, len(data) - 1, 100).astype(int)):
        path.write_bytes(data[:size])
        part = damaged(path)
        if part is not None:
            lengths.append(len(part))
            assert_prefix(part, run)
    # Nearly all of the file's chunks can be read from nearly all of the file.
    assert max(lengths) == len(run)
    assert len(set(lengths)) > 5


def assert_prefix(part: Run, run: Run) -> None:
    """Check that the samples are right; only the last tick may miss some topics."""
    np.testing.assert_array_equal(part.time_s, run.time_s[:len(part)])
    for name, values in part.signals().items():
        known = ~np.isnan(values)
        assert known[:-1].all()
        np.testing.assert_array_equal(values[known], run.signals()[name][:len(part)][known])


def test_a_flipped_bit_gives_no_wrong_number(whole: tuple[Run, bytes, Path]) -> None:
    run, data, path = whole
    rng = np.random.default_rng(2)
    for place in rng.integers(0, len(data), 60):
        broken = bytearray(data)
        broken[place] ^= 1 << rng.integers(8)
        path.write_bytes(broken)
        part = damaged(path)
        if part is not None:
            # A lost chunk leaves a gap; what is there is at its time after the first sample.
            known = np.flatnonzero(~np.isnan(part.signals()['force']))
            start = int(np.flatnonzero(run.force_n == part.signals()['force'][known[0]])[0])
            ticks = np.round((part.time_s - part.time_s[known[0]]) * 5000).astype(int) + start
            for name, values in part.signals().items():
                there = ~np.isnan(values)
                np.testing.assert_array_equal(values[there], run.signals()[name][ticks[there]])


def test_a_wrong_index_changes_nothing(whole: tuple[Run, bytes, Path]) -> None:
    """The messages are cut out at the places that it tells, and no checksum covers it."""
    run, data, path = whole
    indices = [(start + 9, length) for start, opcode, length in records(data) if opcode == 7]
    assert len(indices) > 20
    rng = np.random.default_rng(3)
    for start, length in indices[::3]:
        broken = bytearray(data)
        broken[start + rng.integers(length)] ^= 1 << rng.integers(8)
        path.write_bytes(broken)
        assert_same(read_bag(path), run)


def records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield where the records of an MCAP file begin, their opcode and length."""
    start = 8
    while start < len(data) - 8:
        opcode, length = struct.unpack_from('<BQ', data, start)
        yield start, opcode, length
        start += 9 + length


@pytest.mark.parametrize(('name', 'content'), [
    ('empty.mcap', b''), ('text.mcap', b'time,force\n0,1\n'), ('garbage.db3', bytes(range(256))),
    ('force.csv', b'time,force\n0,1\n'), ('magic.mcap', b'\x89MCAP0\r\n')])
def test_refuses_what_is_no_bag(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=name):
        read_bag(tmp_path / name)


def test_refuses_a_folder_without_bag_and_an_absent_path(tmp_path: Path) -> None:
    with pytest.raises(InputError, match='is not a bag: expected a rosbag2 directory'):
        read_bag(tmp_path)
    (tmp_path / 'bag').mkdir()   # the folder of a run
    with pytest.raises(InputError, match='/bag meant'):
        read_bag(tmp_path)
    with pytest.raises(InputError, match='absent does not exist'):
        read_bag(tmp_path / 'absent')
    (tmp_path / 'metadata.yaml').write_text('}{')
    with pytest.raises(InputError, match='is not a bag'):
        read_bag(tmp_path)


def test_refuses_a_foreign_bag_naming_the_topics(tmp_path: Path) -> None:
    bag = foreign_bag(tmp_path / 'bag', {'/wheel': [(1, wrench(1, 2.0))]})
    with pytest.raises(InputError, match='holds no message of the topics joint_states, force'):
        read_bag(bag)


def test_refuses_the_joints_of_another_robot(tmp_path: Path) -> None:
    joints, one = 'sensor_msgs/msg/JointState', np.ones(2)
    message = STORE.types[joints](HEADER(TIME(0, 1), ''), ['shoulder', 'elbow'], one, one, one)
    bag = foreign_bag(tmp_path / 'bag', {
        '/joint_states': [(k, bytes(STORE.serialize_cdr(message, joints))) for k in range(1, 5)]},
        types={'/joint_states': joints})
    with pytest.raises(InputError, match='joints elbow, shoulder, expected piston and valve'):
        read_bag(bag)


def test_refuses_known_names_with_other_types(tmp_path: Path) -> None:
    types = {'/force': 'geometry_msgs/msg/Vector3'}
    data = bytes(STORE.serialize_cdr(VECTOR(1.0, 2.0, 3.0), types['/force']))
    bag = foreign_bag(tmp_path / 'bag', {'/force': [(1, data)]}, types=types)
    with pytest.raises(InputError, match='geometry_msgs/msg/Vector3, expected '):
        read_bag(bag)


def test_refuses_messages_that_are_too_short(tmp_path: Path) -> None:
    bag = foreign_bag(tmp_path / 'bag', {'/force': [(1, b'\0\1\0\0abcdefgh')]})
    with pytest.raises(InputError, match='ends too early'):
        read_bag(bag)


def test_never_writes_over_a_bag(tmp_path: Path) -> None:
    write_bag(a_run(5), tmp_path / 'bag')
    before = (tmp_path / 'bag/bag_0.mcap').read_bytes()
    with pytest.raises(InputError, match='exists already'):
        write_bag(a_run(6), tmp_path / 'bag')
    assert (tmp_path / 'bag/bag_0.mcap').read_bytes() == before
    with Reader(tmp_path / 'bag') as reader:
        assert reader.message_count == 30


@pytest.mark.parametrize('plugin', [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_bag_of_another_robot_is_imported_by_topic_joint_and_field(
        tmp_path: Path, plugin: StoragePlugin) -> None:
    """Two joints in two orders, commands half as often without stamps, a type of the robot's."""
    states, commands = 'sensor_msgs/msg/JointState', 'std_msgs/msg/Float64MultiArray'
    goal = f'robot_msgs/msg/{plugin.name.title()}Goal'
    STORE.register(get_types_from_msg('std_msgs/Header header\nfloat64[2] at', goal))
    start, period = 1_790_000_000 * 10**9, 2_000_000
    stamps = [start + k * period for k in range(40)]

    def state(k: int) -> bytes:
        order = [0, 1] if k % 2 else [1, 0]
        message = STORE.types[states](
            HEADER(TIME(stamps[k] // 10**9, stamps[k] % 10**9), ''),
            [('hip-1', 'knee')[i] for i in order], np.array([90.0 + k, -k])[order],
            np.array([0.1 * k, 0.2 * k])[order], np.array([5.0 * k, 7.0 * k])[order])
        return bytes(STORE.serialize_cdr(message, states))

    def command(k: int) -> bytes:
        layout = STORE.types['std_msgs/msg/MultiArrayLayout']([], 0)
        message = STORE.types[commands](layout, np.array([-1.0 * k, 3.0 * k]))
        return bytes(STORE.serialize_cdr(message, commands))

    def wanted(k: int) -> bytes:
        header = HEADER(TIME(stamps[k] // 10**9, stamps[k] % 10**9), '')
        return bytes(STORE.serialize_cdr(STORE.types[goal](header, np.array([k, 0.5 * k])), goal))

    bag = foreign_bag(tmp_path / 'robot', {
        '/leg/states': [(t, state(k)) for k, t in enumerate(stamps)],
        '/leg/effort/commands': [(t + 100_000, command(k)) for k, t in enumerate(stamps)
                                 if k % 2 == 0],
        '/leg/goal': [(t, wanted(k)) for k, t in enumerate(stamps)],
        '/camera/note': [(start, wrench(start, 0.0))],
    }, plugin, {'/leg/states': states, '/leg/effort/commands': commands, '/leg/goal': goal})
    imported = import_recording(bag, [
        'position=/leg/states/hip-1/position[deg]', 'force=/leg/states/hip-1/effort*-1[Nm]',
        'velocity=/leg/states/knee/velocity[rad/s]',
        'command=/leg/effort/commands/data/1[Nm]', 'reference=/leg/goal/at/1[rad]'],
        out=tmp_path / 'ours')
    for run in (imported, read_bag(tmp_path / 'ours')):
        count = np.arange(40.0)
        np.testing.assert_allclose(run.time_s, 0.002 * count)
        assert run.unit('position') == 'rad' and run.unit('command') == 'Nm'
        found = run.signals()
        np.testing.assert_allclose(found['position'], np.radians(90.0 + count))
        np.testing.assert_array_equal(found['force'], -5.0 * count)
        np.testing.assert_array_equal(found['velocity'], 0.2 * count)
        np.testing.assert_array_equal(found['command'], 3.0 * (count - count % 2))
        np.testing.assert_array_equal(found['reference'], 0.5 * count)
    with pytest.raises(InputError, match='names no column.*time, /leg/states/knee/position'):
        import_recording(bag, ['position=/leg/states/ankle/position[rad]'])
    with pytest.raises(InputError, match='it has /leg/states, /leg/effort/commands, /leg/goal'):
        import_recording(bag, ['position=hip-1[rad]'])
    joints = read_joints([bag])
    assert set(joints) == {'hip-1', 'knee'}
    run, = joints['knee']
    assert run.unit('position') == 'rad' and run.unit('force') == 'Nm'
    np.testing.assert_array_equal(run.signal('force'), 7.0 * np.arange(40.0))
    with pytest.raises(InputError, match='no joint ankle; it has'):
        read_joint([bag], 'ankle')


def test_messages_longer_than_their_type_are_left_out(tmp_path: Path) -> None:
    bag = foreign_bag(tmp_path / 'bag', {
        '/force': [(t, wrench(t, 1.0) + bytes(8)) for t in range(1, 20)],
        '/valve_command': [(t, wrench(t, 2.0)) for t in range(1, 20)]})
    with pytest.warns(InputWarning, match='/force is left out: not a geometry_msgs'):
        assert read_bag(bag).signals().keys() == {'command'}


@pytest.mark.parametrize(('kind', 'definition'), [
    ("robot_msgs/msg/A: pass\nopen('{0}', 'w')#", 'float64 x'),
    ("robot_msgs/msg/B'] = open('{0}', 'w') #", 'float64 x'),
    ('robot_msgs/msg/C', "float64 x = open('{0}', 'w')"),
    ('robot_msgs/msg/D', "float64 x: open('{0}', 'w')"),
    ('robot_msgs/msg/E', "string X='\nopen('{0}', 'w')"),
    ('robot_msgs/msg/F', "float64 x\n===\nMSG: robot_msgs/G: open('{0}', 'w')"),
    ('robot_msgs/msg/9', 'float64 x'), ('robot_msgs/msg/H', 'robot_msgs/Absent x'),
    ('robot_msgs/msg/I', 'I x'), ('robot_msgs/msg/J', 'float64[1000000000] x')])
def test_message_types_of_a_bag_run_nothing(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, definition: str) -> None:
    ran = tmp_path / 'ran'
    kind, definition = kind.replace('{0}', str(ran)), definition.replace('{0}', str(ran))
    monkeypatch.setattr(bag_table, 'read_contents', lambda path, named: Contents(
        {'/a': topic} if named('/a') else {}, {}, []))
    topic = Topic('/a', kind)
    topic.add(1, 1, wrench(1, 2.0))
    connection = SimpleNamespace(msgtype=kind, msgdef=SimpleNamespace(
        format=MessageDefinitionFormat.MSG, data=definition))
    monkeypatch.setattr(bag_table, 'opened_by_rosbags', lambda path: nullcontext(
        SimpleNamespace(connections=[connection])))
    with pytest.raises(InputError, match='/a'):
        import_recording(tmp_path, ['force=/a/x'])
    assert not ran.exists()
