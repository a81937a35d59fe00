"""What `make torture` shows while it runs."""

import io
import math
import subprocess
import sys
from collections.abc import Callable

import pytest
from rich.console import Console

from torture import __main__ as torture
from torture.endings import handles_ctrl_c
from torture.rig import Rig, Tally, until


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


@pytest.mark.parametrize('minutes', [None, '0.001'])
def test_inputs_are_not_cut_short_unless_a_time_is_given(
        minutes: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    ends: dict[str, float] = {}

    def scenario(name: str) -> Callable[[Rig, Tally, float], None]:
        def tried(_: Rig, tally: Tally, end: float) -> None:
            ends[tally.name] = end
        tried.__name__ = name
        return tried

    inputs, clocks = scenario('inputs'), scenario('clocks')
    monkeypatch.setattr(torture, 'SCENARIOS', {inputs: 0.1, clocks: 0.1})
    monkeypatch.setattr(torture, 'WHOLE', (inputs,))
    monkeypatch.setattr(sys, 'argv', ['torture'])
    monkeypatch.delenv('TORTURE_MINUTES', raising=False)
    if minutes:
        monkeypatch.setenv('TORTURE_MINUTES', minutes)
    assert torture.main() == 0
    assert math.isinf(ends['inputs']) == (minutes is None) and ends['clocks'] < math.inf


@pytest.mark.parametrize(('program', 'handled'), [
    (['cat'], False), ([sys.executable, '-c', 'print(input(), flush=True); input()'], True)])
def test_ctrl_c_is_handled_once_python_has_its_handler(program: list[str], handled: bool) -> None:
    with subprocess.Popen(program, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None and process.stdout is not None
        process.stdin.write(b'it runs\n')
        process.stdin.flush()
        assert process.stdout.readline() == b'it runs\n'
        assert handles_ctrl_c(process.pid) == handled
        process.kill()
    assert not handles_ctrl_c(process.pid)
