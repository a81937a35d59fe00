"""Ctrl-C while numba compiles: LLVM takes up to a minute, in which no handler of Python runs."""

import functools
import os
import signal
import sys
import threading


@functools.cache
def end_while_compiling() -> None:
    """
    Let SIGINT end this process with status 130 while it compiles.

    Nothing is lost then: numba writes its cache under a temporary name. At other times SIGINT is
    KeyboardInterrupt as usual. Only for the process of a command, in its main thread.
    """
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    threading.Thread(target=_watch, args=(reading,), daemon=True).start()


def _watch(reading: int) -> None:
    while numbers := os.read(reading, 100):
        jit = sys.modules.get('asi_common.jit')
        if signal.SIGINT in numbers and jit is not None and jit.compiling():
            os.write(2, b'asi: interrupted\n')
            os._exit(130)
