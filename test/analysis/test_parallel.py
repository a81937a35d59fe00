"""Work that is spread: the same results from processes, from a cluster, and after a loss."""

import os
import signal
import time
from pathlib import Path

import pytest

from asi_analysis.errors import InputError
from asi_analysis.loop.closed_loop import simulate_loop
from asi_analysis.parallel import each, in_threads, workers


def peak(gain: float, folder: Path) -> tuple[float, int]:
    """Return a loop's largest force, and who found it; the first to try gain 3 dies of it."""
    died = folder / 'died'
    if gain == 3.0 and not died.exists():
        died.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    run = simulate_loop({}, {'gain': gain, 'reference.shape': 'step'}, 0.05)
    return float(run.force_n.max()), os.getpid()


def press_ctrl_c() -> int:
    """Interrupt this process; return who it is if it goes on."""
    os.kill(os.getpid(), signal.SIGINT)
    return os.getpid()


def test_a_task_in_a_thread_may_be_shared_out_in_turn() -> None:
    """No thread waits for one that waits: each computes itself what no other one has begun."""
    def leaves(depth: int) -> int:
        return sum(in_threads(leaves, [depth - 1] * 5)) if depth else 1

    assert leaves(4) == 625
    assert list(in_threads(str, range(50))) == [str(number) for number in range(50)]


def test_after_an_error_in_a_thread_what_has_not_begun_is_left() -> None:
    begun: list[int] = []

    def inverse(number: int) -> float:
        begun.append(number)
        time.sleep(0.001)
        return 1.0 / number

    with pytest.raises(ZeroDivisionError):
        list(in_threads(inverse, [2, 1, 0, *range(1, 1000)]))
    assert len(begun) < 1000


def test_ctrl_c_is_left_to_the_process_that_shares_out_the_work() -> None:
    with workers(jobs=2):
        assert os.getpid() not in list(each(press_ctrl_c, [()] * 4))
    with pytest.raises(KeyboardInterrupt):
        list(each(press_ctrl_c, [()]))


def test_processes_and_a_cluster_that_loses_a_worker_return_the_same(tmp_path: Path) -> None:
    pytest.importorskip('distributed', reason='the extra `cluster` is not installed')
    from bench.local_cluster import cluster
    calm = tmp_path / 'calm'
    calm.mkdir()
    (calm / 'died').touch()
    work = [(float(gain), calm) for gain in range(1, 7)]
    alone = list(each(peak, work))
    assert {pid for _, pid in alone} == {os.getpid()}
    with workers(jobs=2):
        assert [force for force, _ in each(peak, work)] == [force for force, _ in alone]
    with cluster(2, tmp_path) as address, workers(dask=address):
        found = list(each(peak, [(gain, tmp_path) for gain, _ in work]))
    assert (tmp_path / 'died').exists() and os.getpid() not in {pid for _, pid in found}
    assert [force for force, _ in found] == [force for force, _ in alone]


def test_address_where_no_scheduler_answers_is_bad_input(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip('distributed', reason='the extra `cluster` is not installed')
    monkeypatch.setattr('asi_analysis.parallel.PATIENCE_S', 0.5)
    with pytest.raises(InputError, match='127.0.0.1:9: no scheduler answers'), \
            workers(dask='tcp://127.0.0.1:9'):
        pass
