"""What `make torture` shows while it runs."""

import io

import pytest
from rich.console import Console

from torture import __main__ as torture
from torture.rig import Tally, until


@pytest.mark.parametrize('terminal', [True, False])
def test_progress_is_shown_until_the_end_of_a_scenario(terminal, monkeypatch):
    monkeypatch.setattr(torture, 'LINE_S', 0.01)
    monkeypatch.setattr(torture, 'BAR_S', 0.01)
    written = io.StringIO()
    tally = Tally('inputs')
    with torture._shown(Console(file=written, force_terminal=terminal, width=80), tally, 60.0):
        tally.count('a file', times=3)
        tally.count('a file', 'a traceback')
        until(lambda: 'inputs: 4 tried, 1 not survived' in written.getvalue(), 'a line')
