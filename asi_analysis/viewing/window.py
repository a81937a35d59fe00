"""The window of Rerun: a process of its own, which no other machine can reach."""

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import IO, Final

from asi_analysis.errors import InputError
from asi_common.executable import interrupt_later

HERE: Final = '127.0.0.1'
# Longest time until the viewer listens, s: it has 300 MB. Without graphics it ends soon after.
PATIENCE_S: Final = 60.0
SOON_S: Final = 1.0
INSTEAD: Final = 'asi view BAG --out FILE.rrd writes a file that Rerun shows on another machine'


@contextmanager
def window() -> Iterator[str]:
    """
    Open the viewer, and yield the address to send a recording to; leave it open.

    Rerun's own `spawn` would have it listen on all interfaces. Raises InputError if there is no
    display, or the viewer ends at once.
    """
    if sys.platform == 'linux' and not (
            os.environ.get('DISPLAY') or os.environ.get('WAYLAND_DISPLAY')):
        raise InputError('there is no display (neither DISPLAY nor WAYLAND_DISPLAY is set): '
                         + INSTEAD)
    with socket.create_server((HERE, 0)) as free:
        port = free.getsockname()[1]
    with tempfile.TemporaryFile() as said:
        with interrupt_later():
            process = subprocess.Popen(
                [sys.executable, '-m', 'rerun_cli', '--bind', HERE, '--port', str(port)],
                stdin=subprocess.DEVNULL, stdout=said, stderr=said, start_new_session=True)
        try:
            _await(process, port, said)
            yield f'rerun+http://{HERE}:{port}/proxy'
        except BaseException:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGTERM)
            raise
        with suppress(subprocess.TimeoutExpired):
            process.wait(SOON_S)
            raise _ended(said)


def _await(process: subprocess.Popen[bytes], port: int, said: IO[bytes]) -> None:
    """Wait until the viewer listens. Raises InputError if it ends, or does not in time."""
    end_s = time.monotonic() + PATIENCE_S
    while process.poll() is None and time.monotonic() < end_s:
        with suppress(OSError), socket.create_connection((HERE, port), timeout=1.0):
            return
        time.sleep(0.05)
    raise _ended(said)


def _ended(said: IO[bytes]) -> InputError:
    """Return the error of a viewer that has ended, with the last line that it has said."""
    said.seek(0)
    *_, last = ['', *said.read().decode(errors='replace').split('\n')[:-1]]
    return InputError(f'the viewer of Rerun does not run: {last[:200]!r}. {INSTEAD}')
