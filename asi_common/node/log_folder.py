"""Folder of the log files of ROS, without which no node starts."""

import os
from collections.abc import MutableMapping
from pathlib import Path

from asi_common.jit_cache import temporary_folder


def choose_log_folder(environment: MutableMapping[str, str]) -> None:
    """Set ROS_LOG_DIR to a temporary folder if it is not set and rcl's own cannot be written."""
    if environment.get('ROS_LOG_DIR'):
        return
    folder = Path(environment.get('ROS_HOME') or os.path.expanduser('~/.ros')) / 'log'
    try:
        folder.mkdir(parents=True, exist_ok=True)
        writable = os.access(folder, os.W_OK)
    except OSError:
        writable = False
    if not writable:
        environment['ROS_LOG_DIR'] = str(temporary_folder() / 'log')
