"""
Independent tasks in sequence, in threads, in processes, or on a Dask cluster (by joblib).

Results have the order of the tasks, whichever worker computed them.
"""

import collections
import functools
import os
import signal
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing import resource_tracker
from typing import Any, Final, TypeVar

import joblib

from asi_analysis.errors import InputError

# Longest wait for the answer of a scheduler, s.
PATIENCE_S: Final = 10.0

Item = TypeVar('Item')
Made = TypeVar('Made')


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


@functools.cache
def _helpers() -> ThreadPoolExecutor:
    """Return the threads that help those which call `in_threads`."""
    return ThreadPoolExecutor(cores())


def in_threads(function: Callable[[Item], Made], items: Iterable[Item]) -> Iterator[Made]:
    """
    Yield function(item) for each item, in order; for functions that run compiled code.

    The caller computes too, and idle threads help it. So a function may call this itself: a
    caller waits only for items that a thread is computing.
    """
    todo = collections.deque((item, Future[Made]()) for item in items)
    futures = [future for _, future in todo]

    def compute() -> bool:
        """Compute an item, if one is left; return whether it was."""
        try:
            item, future = todo.popleft()
        except IndexError:
            return False
        try:
            future.set_result(function(item))
        except Exception as error:   # raised where the result is asked for
            future.set_exception(error)
        return True

    def help_on() -> None:
        while compute():
            pass

    helping = [_helpers().submit(help_on) for _ in range(min(len(futures), cores()) - 1)]
    try:
        for future in futures:
            while not future.done() and compute():
                pass
            yield future.result()
    finally:   # after Ctrl-C, what has not begun is not waited for
        todo.clear()
        for each in helping:
            each.cancel()


@contextmanager
def workers(jobs: int = 1, dask: str | None = None) -> Iterator[None]:
    """
    Context in which `each` uses `jobs` processes, or the workers of an existing Dask cluster.

    dask: address of its scheduler; jobs is then ignored. The workers need this package in the
    same version; the task of a worker that dies is repeated by another. Raises InputError if no
    scheduler answers, or without the extra `cluster`.
    """
    if dask is None:
        if jobs > 1:
            resource_tracker.ensure_running()   # now: its start would unblock SIGINT in `each`
        with joblib.parallel_config('loky', n_jobs=jobs):
            yield
        return
    try:
        from distributed import Client
    except ImportError:
        raise InputError("--dask takes the extra: pip install 'asi_actuator[cluster]'") from None
    try:
        client = Client(dask, timeout=PATIENCE_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(f'--dask {dask}: no scheduler answers ({error})') from None
    with client, joblib.parallel_config('dask', client=client):
        yield


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Block SIGINT; processes that are started now inherit that and stay blocked."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def each(function: Callable[..., Any], work: Iterable[tuple[Any, ...]]) -> Iterator[Any]:
    """
    Yield function(*arguments) for each tuple in `work`, in order, as soon as it is computed.

    A terminal sends Ctrl-C to every process; only this one reacts, and ends the others. Tasks
    are not batched: after a few quick ones, joblib would give sixteen slow ones to one process.
    joblib replaces a process that has grown by 300 MB, as compiled code may do. Its
    message is not shown.
    """
    warnings.filterwarnings('ignore', 'A worker stopped while some jobs', UserWarning, 'joblib')
    with _interrupts_blocked():   # the call below starts the processes
        results = joblib.Parallel(return_as='generator', batch_size=1)(
            joblib.delayed(function)(*arguments) for arguments in work)
    yield from results
