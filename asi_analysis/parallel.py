"""
Many independent pieces of work: in turn, in processes of this machine, or on a cluster.

All through joblib; results come in the order of the work, so they do not depend on who did it.
"""

import signal
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from typing import Any, Final

import joblib

from asi_analysis.errors import InputError

# So long a scheduler may take to answer, s.
PATIENCE_S: Final = 10.0


@contextmanager
def workers(jobs: int = 1, dask: str | None = None) -> Iterator[None]:
    """
    Let `each` use so many processes meanwhile, or the workers of an existing Dask cluster.

    dask: address of its scheduler; jobs is then not looked at. The workers need this package in
    the same version; what a worker had in hand when it died is done again by another.
    Raises InputError if no scheduler answers there, or without the extra `cluster`.
    """
    if dask is None:
        if jobs > 1:
            resource_tracker.ensure_running()   # as it starts, it lets Ctrl-C through (see `each`)
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
def _interrupts_wait() -> Iterator[None]:
    """Hold Ctrl-C back meanwhile; processes started now inherit that, and keep it for good."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def each(function: Callable[..., Any], work: Iterable[tuple[Any, ...]]) -> Iterator[Any]:
    """
    Yield function(*arguments) of each arguments in `work`, in their order, as they are done.

    A terminal sends Ctrl-C to every process: here this one alone acts on it, and ends the others.
    """
    with _interrupts_wait():   # the call below starts the processes
        results = joblib.Parallel(return_as='generator')(
            joblib.delayed(function)(*arguments) for arguments in work)
    yield from results
