"""`asi compare`: figures that are those of `asi tune` and of `asi analyze`, and its page."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from documented import problems

import asi_analysis as asi
from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_analysis import cli
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.limit_cycle.quench.attack import VARIED, search, with_errors
from asi_analysis.tuning import figures as module
from asi_analysis.tuning.compare import Comparison, compare_controllers, read_compared
from asi_analysis.tuning.figures import ROWS, figures
from asi_common.parameter import defaults

CONTROLLERS = {'P': {'gain': 3.0}, 'lead4': {'compensator': 'lead4'}}
SHORT = {'rates_hz': [2000.0], 'springs_n_m': [1e5], 'plants': 2, 'noise_n': 0.0,
         'attacks': 16}


@pytest.fixture(scope='module')
def compared() -> Comparison:
    run = asi.simulate({}, {'compensator': 'lead4', 'reference.amplitude': 100.0}, 0.4)
    return compare_controllers(CONTROLLERS, {'bag': run}, {'load.mass': 2.0}, **SHORT)


def values(compared: Comparison, condition: str, controller: str) -> dict[str, float]:
    return {each['name']: each['value'] for each in compared.figures
            if (each['condition'], each['controller']) == (condition, controller)}


def test_figures_are_those_of_the_search(compared: Comparison) -> None:
    for name, controller in CONTROLLERS.items():
        assert values(compared, 'at 2000 Hz', name) == figures(
            {'load.mass': 2.0}, controller, 2000.0)


def test_the_reference_of_a_controller_is_not_part_of_its_figures() -> None:
    own = {'compensator': 'lead4', 'reference.shape': 'sine', 'reference.offset': 50.0,
           'reference.end': 0.1}
    assert figures({}, own, 2000.0) == figures({}, CONTROLLERS['lead4'], 2000.0)


def test_of_several_plants_the_middle_and_the_worst(compared: Comparison) -> None:
    middle = values(compared, '2 plants within 20 %, median', 'lead4')
    worst = values(compared, '2 plants within 20 %, worst', 'lead4')
    for row in ROWS:
        assert (worst[row.name] <= middle[row.name] if row.more
                else worst[row.name] >= middle[row.name]), row.name
    assert worst['felt_force_slow_n'] != middle['felt_force_slow_n']


def test_errors_of_a_plant_are_about_its_own_parameters() -> None:
    table = defaults(ACTUATOR_PARAMETERS)
    mine = {'friction.coulomb': 30.0}
    least = with_errors(mine, dict.fromkeys(VARIED, 0.0))
    assert set(least) == set(VARIED) and least['friction.coulomb'] == pytest.approx(24.0)
    assert least['force_sensor.delay'] == pytest.approx(0.8 * table['force_sensor.delay'])


def test_attack_is_that_of_quench(compared: Comparison) -> None:
    for name, controller in CONTROLLERS.items():
        trials = search({'load.mass': 2.0}, controller, (2000.0,), 16, 1)
        assert values(compared, '16 attacks at 2000 Hz', name) == {
            'sustained_found': sum(trial.sustained for trial in trials)}


def test_loads_that_give_way_have_no_value_to_reach(compared: Comparison) -> None:
    for each in compared.figures:
        locked = not each['condition'].startswith(('on a spring', 'with a free'))
        assert (each['goal'] is not None) == (each['met'] is not None) == locked


def test_recordings_are_analysed_as_by_analyze(compared: Comparison) -> None:
    recording, = compared.recordings
    analysis = asi.analyze(compared.runs['bag'])
    assert recording['settling_time_2_s'] == analysis.settling_time_2_s
    assert recording['oscillation'] == analysis.oscillation


def test_a_recording_of_a_position_is_in_its_own_unit() -> None:
    time_s = np.arange(1000) * 1e-3
    lag = np.where(time_s < 0.1, 0.0, 0.5 - 0.5 * np.exp(-(time_s - 0.1) / 0.02))
    run = Run(time_s, np.where(time_s < 0.1, 0.0, 0.5), position_m=lag,
              information={'signals': {'reference': 'rad', 'position': 'rad'}})
    found = compare_controllers({}, {'arm': run})
    assert '0.5 rad' in str(found) and ' N ' not in str(found).replace(' N s/m', '')
    figure, _ = found.pictures()['recordings']
    assert figure.axes[0].get_ylabel() == 'position (rad)' and len(figure.axes[0].lines) == 1


def test_a_condition_that_is_named_twice_is_there_once() -> None:
    found = compare_controllers(
        {'P': {}}, rates_hz=[1000.0, 1000.0], springs_n_m=[1e5, 1e5], plants=0, noise_n=0.0,
        attacks=0)
    rows = [(each['condition'], each['name']) for each in found.figures]
    assert len(set(rows)) == len(rows)


def test_what_is_doubtful_about_a_recording_is_said() -> None:
    run = asi.simulate({}, {'reference.amplitude': 100.0}, 0.4)
    force = run.force_n.copy()
    force[260:275] = np.nan
    found = compare_controllers({}, {'holes': replace(run, force_n=force)})
    recording, = found.recordings
    assert recording['settling_time_2_s'] is None and recording['notes']
    assert f'note: holes: {recording["notes"][0]}' in str(found)
    assert f'data: {found.quality[0]["text"]}' in str(found)


def test_it_prints_draws_and_writes_what_it_found(compared: Comparison, tmp_path: Path) -> None:
    assert problems(compared.to_dict(), 'asi compare') == []
    text = str(compared)
    assert 'lead4' in text and 'recordings' in text and '* target' in text
    assert 'about the reference in simulations, about the level reached in recordings' in text
    page = compared.write_report(tmp_path / 'report').read_text()
    assert page.count('<svg') == len(compared.pictures()) == 6
    compared.write_markdown(tmp_path / 'page.md', 'asi compare P')
    written = (tmp_path / 'page.md').read_text()
    assert '`asi compare P`' in written and '## At 2000 Hz' in written
    widths = {line.count('|') for line in written.splitlines() if line.startswith('|')}
    assert widths == {6, 4}


def test_command_reads_names_files_and_bags(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
        ) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(module, 'SIZES_N', (20.0, 100.0, 300.0, 700.0))
    Path('mine.yaml').write_text('/**/asi_controller:\n  ros__parameters:\n    gain: 2.0\n')
    asi.simulate({}, {}, 0.1, out='run')
    monkeypatch.setattr(sys, 'argv', [
        'asi', 'compare', 'mine.yaml', 'run/bag', '--rates', '2000', '--plants', '0',
        '--springs', '', '--noise', '0', '--conditions', '0', '--json', '--markdown', 'page.md'])
    assert cli.main() == 0
    document = json.loads(capsys.readouterr().out)
    assert document['controllers'] == ['mine']
    assert [each['source'] for each in document['recordings']] == ['run/bag']
    assert len(document['figures']) == len(ROWS)
    assert np.isfinite([each['value'] for each in document['figures']]).all()
    assert '`asi compare mine.yaml run/bag --rates 2000' in Path('page.md').read_text()


@pytest.mark.parametrize('changed, said', [
    ({'rates_hz': []}, 'rates'), ({'rates_hz': [0.0]}, 'rate'), ({'rates_hz': [200.0]}, 'rates'),
    ({'springs_n_m': [-1.0]}, 'springs')])
def test_conditions_that_are_not_allowed_are_named(changed: dict, said: str) -> None:
    with pytest.raises(InputError, match=said):
        compare_controllers(CONTROLLERS, **{**SHORT, **changed})


@pytest.mark.parametrize('texts, said', [
    (['nowhere'], 'nowhere is neither'), (['lead4', 'lead4'], 'twice'),
    (['nowhere.yaml'], 'nowhere.yaml')])
def test_what_cannot_be_compared_is_named(texts: list[str], said: str) -> None:
    with pytest.raises(InputError, match=said):
        read_compared(texts)
