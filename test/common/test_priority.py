"""The priority of a node in real time: of all its threads."""

import os
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest

from asi_common.node import priority


def test_a_thread_that_is_made_while_the_others_are_raised_is_raised_too(
        monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernel's part is played here: to give a priority needs a permission."""
    threads, raised = [11, 12], []

    def raise_(thread: int, policy: int, parameter: Any) -> None:
        assert (policy, parameter.sched_priority) == (os.SCHED_FIFO, 7)
        if not raised:
            threads.append(13)   # by thread 12, which has no priority yet
        if thread == 12:
            raise ProcessLookupError
        raised.append(thread)

    monkeypatch.setattr(os, 'listdir', lambda folder: [str(thread) for thread in threads])
    monkeypatch.setattr(os, 'sched_setscheduler', raise_)
    values = {'mode': 'realtime', 'thread_priority': 7}
    node = MagicMock(get_parameter=lambda name: SimpleNamespace(value=values[name]))
    priority.prefer(node)
    assert raised == [11, 13]
    node.get_logger().info.assert_called_once_with('real-time priority 7')
