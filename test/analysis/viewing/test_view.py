"""`asi view`: the file for Rerun holds every view, and Rerun's own command reads it."""

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import asi_analysis as asi
from asi_analysis.bags.run import Run
from asi_analysis.cli import main

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


def test_a_missing_library_is_said(monkeypatch: Any, capsys: Any) -> None:
    monkeypatch.setitem(sys.modules, 'rerun', None)
    monkeypatch.setattr('sys.argv', ['asi', 'view', 'bag'])
    assert main() == 2
    assert 'pip install "asi_actuator[view]"' in capsys.readouterr().err
