"""A bag across a restart or a pause of the actuator: divided into bags that can be read."""

from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from asi_analysis.bags import splitting
from asi_analysis.bags.bag import read_bag
from asi_analysis.bags.bag_writer import BagWriter
from asi_analysis.bags.encoding import encode
from asi_analysis.bags.splitting import split_bag
from asi_analysis.errors import InputError, InputWarning
from asi_common.topics import TOPICS

PERIOD_NS = 2_000_000


def stamps(*runs: tuple[int, int]) -> np.ndarray:
    """Return the stamps (ns) of runs, each of so many periods from a first one on."""
    return PERIOD_NS * np.concatenate([np.arange(first, first + count) for first, count in runs])


def written(bag: Path, stamp_ns: np.ndarray, log_ns: np.ndarray, *,
            late: tuple[int, ...] = ()) -> Path:
    """
    Write a bag of states, commands and a sparse topic, as a recorder does.

    The force is the number of the message; late: commands that are written after the next one.
    """
    order = np.arange(len(stamp_ns))
    for k in late:
        order[[k, k + 1]] = order[[k + 1, k]]
    sparse = np.flatnonzero(np.diff(stamp_ns, prepend=stamp_ns[0] + 1) < 0)
    writer = BagWriter(bag)
    writer.add_information({'controller': {'gain': 2.0}})
    for name, value, rows in (('joint_states', 'piston effort', np.arange(len(stamp_ns))),
                              ('valve_command', 'value', order), ('reference', 'value', sparse)):
        channel = writer.add_topic(f'/bench/{name}', TOPICS[name].type)
        table = encode(TOPICS[name].type, stamp_ns[rows], {value: rows.astype(float)})
        for number, (row, data) in enumerate(zip(rows, table, strict=True), 1):
            writer.write(channel, int(log_ns[row]), int(log_ns[row]), number, bytes(data))
    writer.close()
    return bag


RESTARTED = stamps((1, 300), (1, 80), (1, 200))


@pytest.mark.parametrize(('stamp_ns', 'log_ns'), [
    (RESTARTED, RESTARTED),                                 # in lock-step, by our recorder
    (RESTARTED, stamps((5000, 300), (7000, 80), (9000, 200))),   # by another one
    (RESTARTED, stamps((5000, 580))),                       # soon started again
    (2 * (stamps((1, 300), (1000, 80), (2000, 200)),))])    # in real time
def test_each_run_of_a_bag_becomes_a_bag(stamp_ns: np.ndarray, log_ns: np.ndarray, tmp_path: Path
                                         ) -> None:
    bag = written(tmp_path / 'bag', stamp_ns, log_ns, late=(100, 330))
    bags = split_bag(bag, tmp_path / 'parts')
    assert list(bags) == [tmp_path / 'parts' / str(k) for k in (1, 2, 3)]
    assert sum(bags.values()) == 2 * 580 + (3 if stamp_ns is RESTARTED else 1)
    first = 0
    for each, count in zip(bags, (300, 80, 200), strict=True):
        run = read_bag(each)
        for signal in (run.force_n, run.command_n):
            assert signal.tolist() == list(range(first, first + count))
        assert run.information['controller'] == {'gain': 2.0}
        first += count


def test_the_refusal_of_a_bag_of_two_runs_says_how_to_divide_it(tmp_path: Path) -> None:
    bag = written(tmp_path / 'bag', RESTARTED, RESTARTED)
    with pytest.raises(InputError, match=f'asi split {bag} --out DIR makes a bag of each'):
        read_bag(bag)


def test_one_run_is_not_divided_by_late_messages(tmp_path: Path) -> None:
    run = np.delete(stamps((1, 300)), np.s_[100:150])
    run[[20, 21]] = run[[21, 20]]
    run[40] += 10**12
    bag = written(tmp_path / 'bag', run, stamps((1, 250)))
    with pytest.raises(InputError, match='is in one piece'):
        split_bag(bag, tmp_path / 'parts')
    assert not (tmp_path / 'parts').exists()


def test_a_part_that_exists_is_kept(tmp_path: Path) -> None:
    bag = written(tmp_path / 'bag', RESTARTED, RESTARTED)
    split_bag(bag, tmp_path / 'parts')
    with pytest.raises(InputError, match='exists already'):
        split_bag(bag, tmp_path / 'parts')


def test_a_part_that_cannot_be_written_leaves_none_of_the_others(tmp_path: Path) -> None:
    bag = written(tmp_path / 'bag', RESTARTED, RESTARTED)
    kept = tmp_path / 'parts' / '3' / 'kept'
    kept.parent.mkdir(parents=True)
    kept.touch()
    with pytest.raises(InputError, match='3 exists already'):
        split_bag(bag, tmp_path / 'parts')
    assert [each.name for each in (tmp_path / 'parts').iterdir()] == ['3'] and kept.exists()


def test_a_topic_of_which_the_parts_are_not_known_is_told(tmp_path: Path) -> None:
    writer = BagWriter(tmp_path / 'other')
    for name, times in (('force', RESTARTED), ('velocity', np.arange(10, 20))):
        channel = writer.add_topic(f'/{name}', TOPICS[name].type)
        for number, data in enumerate(encode(TOPICS[name].type, times,
                                             {'value': np.ones(len(times))})):
            writer.write(channel, int(times[number]), int(times[number]), number + 1, bytes(data))
    writer.close()
    with pytest.warns(InputWarning, match='/velocity is left out: its times do not go back'):
        split_bag(tmp_path / 'other', tmp_path / 'others')


def test_a_bag_without_a_type_that_is_known_is_refused(tmp_path: Path,
                                                       monkeypatch: pytest.MonkeyPatch) -> None:
    # It ended in a traceback: no topic had a part.
    bag = written(tmp_path / 'bag', RESTARTED, RESTARTED)
    monkeypatch.setattr(splitting, 'typestore', lambda: get_typestore(Stores.EMPTY))
    with pytest.raises(InputError, match='/bench/reference is left out: ROS 2 Jazzy does not'):
        split_bag(bag, tmp_path / 'parts')


def test_a_pause_of_a_topic_is_no_restart(tmp_path: Path) -> None:
    # Its messages after the pause went into the second part, in which the times are others.
    writer = BagWriter(tmp_path / 'other')
    for name, times in (('force', stamps((1, 3000), (1, 200))),
                        ('velocity', stamps((1, 40), (2000, 40)))):
        channel = writer.add_topic(f'/{name}', TOPICS[name].type)
        for number, data in enumerate(encode(TOPICS[name].type, times,
                                             {'value': np.ones(len(times))})):
            writer.write(channel, int(times[number]), int(times[number]), number + 1, bytes(data))
    writer.close()
    with pytest.warns(InputWarning, match='/velocity is left out'):
        assert list(split_bag(tmp_path / 'other', tmp_path / 'others').values()) == [3000, 200]
