"""Folders of other packages in HOME, where that cannot be written."""

import os
from pathlib import Path

from asi_common.jit_cache import temporary_folder


def choose_folder(variable: str, usual: str | Path) -> None:
    """Set an environment variable to a temporary folder if unset and `usual` is not writable."""
    if os.environ.get(variable):
        return
    folder = Path(os.path.expanduser(usual))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        writable = os.access(folder, os.W_OK)
    except OSError:
        writable = False
    if not writable:
        os.environ[variable] = str(temporary_folder() / variable.lower())


def choose_log_folder() -> None:
    """Choose the folder of the log files of ROS, without which no node starts."""
    choose_folder('ROS_LOG_DIR', Path(os.environ.get('ROS_HOME') or '~/.ros') / 'log')
