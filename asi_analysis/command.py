"""
The `asi` command as it is installed: Ctrl-C at any time, from its first import to its end.

Until the first handler is installed, Ctrl-C prints a traceback; so what takes time to import is
imported after it.
"""

from __future__ import annotations

import os
import sys

TYPE_CHECKING = False   # as in typing, which takes time to import
if TYPE_CHECKING:
    import signal
    from types import FrameType
    from typing import Any, NoReturn
else:
    import _signal as signal  # built in; `signal` first makes enumerations of its numbers

INTERRUPTED = 130
SAID = b'asi: interrupted\n'
AGAIN_S = 0.05


def asi() -> int:
    """Run the command; return the exit status, 130 after Ctrl-C."""
    before = signal.getsignal(signal.SIGINT)
    # In the background of a script SIGINT is ignored; leave it so.
    if before is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupted)
    sys.unraisablehook = _repeat_signal
    import importlib

    from asi_common.executable import end_at_once
    main = importlib.import_module('asi_analysis.cli').main
    try:
        signal.signal(signal.SIGINT, _raise if before is signal.default_int_handler else before)
        status: int = main()
        if status == INTERRUPTED:
            end_at_once(status)
        return status
    except KeyboardInterrupt:
        return _interrupted()
    finally:
        # Python removes its handlers at its end; another Ctrl-C would then kill it.
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _raise(_: int, frame: FrameType | None) -> None:
    """
    Raise KeyboardInterrupt; of a process that imports or compiles, end it.

    Modules of others lose it at their import, or make another error of it: pybind11 makes an
    ImportError, a class with descriptors a RuntimeError. In llvmlite it leaves objects that are
    incomplete, whose end is a traceback or a crash.
    """
    from asi_common.executable import end_by_signal, is_compiling
    if is_compiling():
        end_by_signal(INTERRUPTED, SAID)
    while frame is not None:
        if frame.f_code.co_filename.startswith('<frozen importlib'):
            end_by_signal(INTERRUPTED, SAID)
        frame = frame.f_back
    raise KeyboardInterrupt


def _repeat_signal(ignored: Any) -> None:
    """Send a SIGINT again whose KeyboardInterrupt Python ignored, as in callbacks of imports."""
    if ignored.exc_type is not KeyboardInterrupt:
        sys.__unraisablehook__(ignored)
        return
    import threading
    main = threading.main_thread().ident
    assert main is not None
    # Later, so that it is not ignored in here.
    threading.Timer(AGAIN_S, signal.pthread_kill, (main, signal.SIGINT)).start()


def _interrupted(*_: Any) -> NoReturn:
    os.write(2, SAID)
    os._exit(INTERRUPTED)
