"""
Independent tasks in sequence, in processes of this machine, or on a Dask cluster, by joblib.

Results have the order of the tasks, whichever worker computed them.
"""

import signal
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from typing import Any, Final

import joblib

from asi_analysis.errors import InputError

# Longest wait for the answer of a scheduler, s.
PATIENCE_S: Final = 10.0


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

    A terminal sends Ctrl-C to every process; only this one reacts, and ends the others.
    """
    with _interrupts_blocked():   # the call below starts the processes
        results = joblib.Parallel(return_as='generator')(
            joblib.delayed(function)(*arguments) for arguments in work)
    yield from results
