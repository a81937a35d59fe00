"""What every executable does first."""

import os
import signal


def end_quietly_while_importing() -> None:
    """
    Have SIGINT and SIGTERM end this process with status 0, not with a traceback.

    What a node imports takes a second or more; once it runs it handles the signals itself.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(0))
