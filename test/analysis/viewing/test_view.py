"""`asi view`: the file for Rerun holds every view, and Rerun's own command reads it."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import asi_analysis as asi
from asi_analysis.bags.run import Run
from asi_analysis.cli import main
from asi_analysis.viewing import window

RUN = asi.simulate({}, {'gain': 10.0, 'reference.amplitude': 100.0}, 0.4)


def entities(file: Path) -> set[str]:
    """Return what a .rrd file holds, as Rerun lists it, without the layout."""
    said = subprocess.run([Path(sys.executable).with_name('rerun'), 'rrd', 'stats', file],
                          capture_output=True, text=True, check=True).stdout
    return set(re.findall(r'^/([\w/]+): \d', said, re.M)) - {'__properties', 'blueprint_panel'}


def test_every_signal_and_loop_is_in_the_file(tmp_path: Path, monkeypatch: Any) -> None:
    pytest.importorskip('rerun')
    asi.write_bag(RUN, tmp_path / 'bag')
    out = tmp_path / 'run.rrd'
    monkeypatch.setattr('sys.argv', ['asi', 'view', str(tmp_path / 'bag'), '--out', str(out)])
    assert main() == 0
    assert entities(out) >= {
        'force', 'reference', 'command', 'valve_position', 'velocity', 'plane/0/curve',
        'plane/0/now', 'plane/1/curve', 'plane/1/now', 'spectrum', 'summary'}
    # The links of the URDF, each below the one that moves it.
    assert {'actuator/shape', 'actuator/piston', 'actuator/piston/shape', 'actuator/piston/force',
            'actuator/piston/load/shape', 'actuator/valve', 'actuator/valve/shape'} <= {
                name.removeprefix('scene/') for name in entities(out)}


def test_a_recording_of_a_force_alone_is_shown(tmp_path: Path) -> None:
    pytest.importorskip('rerun')
    from asi_analysis.viewing.rerun_view import view
    force = replace(RUN, reference_n=None, command_n=None, valve_position_m=None,
                    velocity_m_s=None, position_m=None)
    view(force, tmp_path / 'run.rrd')
    found = entities(tmp_path / 'run.rrd')
    assert {'force', 'plane/0/now', 'spectrum'} <= found and 'command' not in found
    assert not any(name.startswith('scene') for name in found)   # whose motion is not known
    with pytest.raises(asi.InputError, match='none of its signals'):
        view(replace(force, force_n=None), tmp_path / 'none.rrd')


def test_a_recording_of_another_joint_is_shown_in_its_units(tmp_path: Path) -> None:
    pytest.importorskip('rerun')
    from asi_analysis.viewing import rerun_view
    turned = Run(RUN.time_s, RUN.reference_n, RUN.command_n, position_m=RUN.force_n,
                 information={'signals': {'reference': 'rad', 'position': 'rad', 'command': 'V'}})
    assert rerun_view._views(turned, {'reference', 'command', 'position'}) == {
        'command (V)': ['command'], 'position (rad)': ['position', 'reference']}
    rerun_view.view(turned, tmp_path / 'run.rrd')
    assert {'position', 'reference', 'command', 'spectrum'} <= entities(tmp_path / 'run.rrd')


def test_signals_that_are_never_there_together_have_no_loop(tmp_path: Path) -> None:
    pytest.importorskip('rerun')
    from asi_analysis.viewing.rerun_view import view
    early = RUN.time_s < 0.2
    view(replace(RUN, command_n=np.where(early, RUN.command_n, np.nan),
                 valve_position_m=np.where(early, np.nan, RUN.valve_position_m)),
         tmp_path / 'run.rrd')
    assert 'plane/1/curve' not in entities(tmp_path / 'run.rrd')
    with pytest.raises(asi.InputError, match='none of its signals'):
        view(Run(RUN.time_s, force_n=np.full(len(RUN), np.nan)), tmp_path / 'none.rrd')


@pytest.fixture
def viewer(tmp_path: Path, monkeypatch: Any) -> Iterator[Path]:
    """Have a viewer that opens no window; yield the file that gets what it is started with."""
    started = tmp_path / 'started'
    (tmp_path / 'rerun_cli').mkdir()
    (tmp_path / 'rerun_cli/__init__.py').touch()   # before the real one, which is a package
    (tmp_path / 'rerun_cli/__main__.py').write_text(f"""import os, socket, sys, time
open({str(started)!r}, 'w').write(' '.join([str(os.getpid()), *sys.argv[1:]]))
server = socket.create_server(('127.0.0.1', int(sys.argv[-1])))
if 'ends' in os.environ['DISPLAY']:
    sys.exit('no graphics')
time.sleep(60.0)
""")
    monkeypatch.setenv('PYTHONPATH', str(tmp_path), prepend=':')
    monkeypatch.setenv('DISPLAY', ':0')
    yield started
    with suppress(FileNotFoundError, ProcessLookupError):
        os.kill(int(started.read_text().split()[0]), signal.SIGKILL)


def test_the_viewer_listens_on_this_machine_alone(viewer: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(window, 'SOON_S', 0.1)
    with window.window() as address:
        _, _, bind, option, port = viewer.read_text().split()
    assert (bind, option) == ('127.0.0.1', '--port')
    assert address == f'rerun+http://127.0.0.1:{port}/proxy'


def test_a_viewer_that_cannot_show_anything_is_said(viewer: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(window, 'SOON_S', 100.0)
    monkeypatch.setenv('DISPLAY', 'ends')
    with pytest.raises(asi.InputError, match="does not run: 'no graphics'. asi view BAG --out"), \
            window.window():
        pass
    viewer.unlink()
    for name in ('DISPLAY', 'WAYLAND_DISPLAY'):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr('sys.platform', 'linux')
    with pytest.raises(asi.InputError, match='no display'), window.window():
        pass
    assert not viewer.exists()


def test_a_missing_library_is_said(monkeypatch: Any, capsys: Any) -> None:
    monkeypatch.setitem(sys.modules, 'rerun', None)
    monkeypatch.setattr('sys.argv', ['asi', 'view', 'bag'])
    assert main() == 2
    assert 'pip install "asi_actuator[view]"' in capsys.readouterr().err
