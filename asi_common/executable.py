"""How a process warns, and ends: at once while it compiles, without unloading libraries."""

import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from typing import Final, NoReturn

# Held, until the end of the process, by the thread that ends it because of a signal.
_ending: Final = threading.RLock()


def warn_in_log() -> None:
    """
    Have Python's warnings be log lines, as all else that a node says.

    rclpy warns, with a place in its own source, if who asked is gone before the answer.
    """
    def log(message: Warning | str, *_: object, **__: object) -> None:
        from rclpy.logging import get_logger
        get_logger('asi').warning(' '.join(str(message).split()))

    warnings.showwarning = log


def end_at_once(status: int) -> NoReturn:
    """
    End this process with a status when all is said and written.

    To unload the libraries, as Python does at its end, takes a second on a busy machine.
    """
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(status)


def only_this_thread_ends() -> None:
    """Let no other thread end this process from now on; wait for ever if one already does."""
    _ending.acquire()


def end_by_signal(status: int, said: bytes = b'') -> NoReturn:
    """End this process with a status and one `said` on stderr, whichever threads want that."""
    only_this_thread_ends()
    os.write(2, said)
    os._exit(status)


def is_compiling() -> bool:
    """Return whether numba compiles in this process now."""
    # None while the module is not imported, or only in part.
    compiling = getattr(sys.modules.get('asi_common.jit'), 'compiling', None)
    return compiling is not None and compiling()


def end_while_compiling(numbers: Collection[int], status: int, said: bytes = b''
                        ) -> Callable[[], None]:
    """
    Let signals end this process while numba compiles, with a status and `said` on stderr.

    LLVM takes up to a minute, in which no handler of Python runs. Nothing is lost: numba writes
    its cache under a temporary name. At other times the handlers of Python are called as usual.
    Only for the main thread; the function that is returned ends it.
    """
    reading, writing = os.pipe()
    os.set_blocking(writing, False)

    def watch() -> None:
        while came := os.read(reading, 100):
            if set(came) & set(numbers) and is_compiling():
                end_by_signal(status, said)
        os.close(reading)

    def end() -> None:
        signal.set_wakeup_fd(-1)
        os.close(writing)

    signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    threading.Thread(target=watch, daemon=True).start()
    return end


@contextmanager
def interrupt_later() -> Iterator[None]:
    """
    Let SIGINT wait until the end of the context; for the start of a process.

    Python calls functions of modules beside a fork, such as those of logging, and ignores what
    they raise: a KeyboardInterrupt in them would be lost, and the command would run on.
    """
    if threading.current_thread() is not threading.main_thread():   # it gets no signals
        yield
        return
    came: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if came:
            signal.raise_signal(signal.SIGINT)
