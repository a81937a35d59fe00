"""Replacements for folders of other packages in HOME, if that is not writable."""

import os
from contextlib import suppress
from pathlib import Path

from asi_common.jit_cache import temporary_folder


def choose_folder(variable: str, usual: str | Path) -> None:
    """
    Set an environment variable to a temporary folder if unset and `usual` is not writable.

    So too without HOME, which others take from the environment alone.
    """
    if os.environ.get(variable):
        return
    writable = False
    if os.environ.get('HOME') or not str(usual).startswith('~'):
        folder = Path(os.path.expanduser(usual))
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            writable = os.access(folder, os.W_OK)
    if not writable:
        os.environ[variable] = str(temporary_folder() / variable.lower())


def choose_log_folder() -> None:
    """Choose the folder of the log files of ROS, without which no node starts."""
    choose_folder('ROS_LOG_DIR', Path(os.environ.get('ROS_HOME') or '~/.ros') / 'log')
