"""A real Dask cluster on this machine: a scheduler and workers, each a process of its own."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path


@contextmanager
def cluster(workers: int, folder: Path) -> Iterator[str]:
    """Give the address of a scheduler with so many workers; all end with the context."""
    file = folder / 'scheduler.json'
    common = ['--scheduler-file', str(file)]
    # So that the workers find what the caller does, installed or not.
    environment = os.environ | {'PYTHONPATH': os.pathsep.join(filter(None, sys.path))}
    commands = [['scheduler', '--host', '127.0.0.1', '--port', '0', '--no-dashboard',
                 '--no-show', *common]]
    commands += [['worker', '--nthreads', '1', '--no-nanny', '--no-dashboard',
                  '--local-directory', str(folder), *common]] * workers
    with ExitStack() as stack:
        for number, command in enumerate(commands):
            log = stack.enter_context((folder / f'dask_{number}.log').open('w'))
            process = stack.enter_context(subprocess.Popen(
                [sys.executable, '-m', 'dask', *command], env=environment, stdout=log,
                stderr=log))
            stack.callback(process.terminate)
        from distributed import Client
        with Client(scheduler_file=str(file), timeout=120.0, set_as_default=False) as client:
            client.wait_for_workers(workers, timeout=120.0)
            address = client.scheduler.address
        yield address
