"""Signals that end a process that serves; without imports that take time, as it comes first."""

import os

TYPE_CHECKING = False   # as in typing, which takes time to import
if TYPE_CHECKING:
    import signal
else:
    import _signal as signal  # built in; `signal` first makes enumerations of its numbers

SIGNALS = (signal.SIGINT, signal.SIGTERM)


def end_quietly() -> None:
    """
    Make SIGINT and SIGTERM end this process at once, with status 0 and without a traceback.

    For what serves until then: before its imports, which take a second or more and after which it
    installs its own handlers.
    """
    for number in SIGNALS:
        signal.signal(number, lambda *_: os._exit(0))
