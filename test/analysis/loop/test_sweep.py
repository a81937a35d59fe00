"""`asi sweep`: its grid, and figures that are those of single runs."""

import csv
import json
import sys
from pathlib import Path

import pytest
from documented import problems

import asi_analysis as asi
from asi_analysis import cli
from asi_analysis.errors import InputError
from asi_analysis.loop.sweep import MOST_RUNS, grid


def test_grid_takes_lists_and_spaced_numbers_of_each_type() -> None:
    assert grid(['controller.gain=1,2.5', 'actuator.load.mass=0.5:1:3',
                 'actuator.load.type=locked,free', 'actuator.force_sensor.noise_seed=1:3:3']) == {
        'controller.gain': [1.0, 2.5], 'actuator.load.mass': [0.5, 0.75, 1.0],
        'actuator.load.type': ['locked', 'free'], 'actuator.force_sensor.noise_seed': [1, 2, 3]}


@pytest.mark.parametrize('over, said', [
    ([], '--over'), (['gain=1'], '--over gain=1'), (['controller.gains=1'], 'gain'),
    (['controller.gain=1,inf'], '--over controller.gain=1,inf: gain = inf'),
    (['controller.gain=1:2:nan'], 'START:STOP:COUNT'),
    (['controller.gain=1', 'controller.gain=2'], 'twice'),
    (['controller.gain=1:2:1000', 'actuator.load.mass=1:2:1000'], str(MOST_RUNS))])
def test_grid_that_is_none_is_refused(over: list[str], said: str) -> None:
    with pytest.raises(InputError, match=said):
        grid(over)


def test_runs_are_those_of_single_experiments_with_their_bags(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
        ) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, 'argv', [
        'asi', 'sweep', '--over', 'controller.gain=1,3', '--over',
        'actuator.load.type=locked,free', '--step', '150', '--duration', '0.2',
        '--csv', 'table.csv', '--bags', 'bags', '--json'])
    assert cli.main() == 0
    document = json.loads(capsys.readouterr().out)
    assert problems(document, 'asi sweep') == []
    assert [run['values'] for run in document['runs']] == [
        {'controller.gain': gain, 'actuator.load.type': load}
        for gain in (1.0, 3.0) for load in ('locked', 'free')]
    for run in document['runs']:
        alone = asi.simulate({'load.type': run['values']['actuator.load.type']},
                             {'gain': run['values']['controller.gain'],
                              'reference.amplitude': 150.0}, 0.2)
        step = asi.step_response(alone)
        assert run['overshoot_percent'] == step.overshoot_percent
        assert run['steady_state_error_n'] == step.steady_state_error_n
        assert (asi.read_bag(run['bag']).force_n == alone.force_n).all()
    with open('table.csv') as file:
        rows = list(csv.DictReader(file))
    assert [float(row['steady_state_error_n']) for row in rows] == [
        run['steady_state_error_n'] for run in document['runs']]


def test_a_fault_is_told_and_the_other_runs_go_on(tmp_path: Path) -> None:
    found, alone = (asi.sweep({'actuator.force_sensor.offset': [3000.0, 0.0]}, {}, {}, 0.05,
                              bags=bags) for bags in (tmp_path, None))
    assert 'limit.force' in found.runs[0]['fault'] and found.runs[1]['fault'] is None
    assert 'limit.force' in str(found)
    # Also without its bag a run has no figures that the actuator would not give.
    for with_bag, without in zip(found.runs, alone.runs, strict=True):
        assert {**with_bag, 'bag': None} == without
    assert alone.runs[0]['ripple_n'] is None and alone.runs[1]['ripple_n'] is not None
    assert [state.state for state in asi.read_bag(found.runs[0]['bag']).states] == ['fault']


def test_a_gain_of_0_is_told_to_be_the_compensators_own() -> None:
    found = asi.sweep({'controller.gain': [0.0, 1.0]}, {}, {}, 0.05)
    assert "controller.gain = 0 is the compensator's own gain" in str(found)
