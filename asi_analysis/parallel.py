"""
Many independent pieces of work: in turn, in processes of this machine, or on a cluster.

All through joblib; results come in the order of the work, so they do not depend on who did it.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
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


def each(function: Callable[..., Any], work: Iterable[tuple[Any, ...]]) -> Iterator[Any]:
    """Yield function(*arguments) of each arguments in `work`, in their order, as they are done."""
    yield from joblib.Parallel(return_as='generator')(
        joblib.delayed(function)(*arguments) for arguments in work)
