"""The Python API: light to import, the same as the commands, results that print and draw."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
from documented import problems
from matplotlib.axes import Axes

import asi_analysis as asi
from asi_analysis import cli
from asi_analysis.reporting.result import Result, Table, table_of

matplotlib.use('Agg')
CYCLING = {'gain': 10.0, 'reference.amplitude': 100.0}
CHIRP = {'reference.shape': 'chirp', 'reference.frequency': 2.0,
         'reference.end_frequency': 200.0}


@pytest.fixture(scope='module')
def cycling() -> asi.Run:
    return asi.simulate({}, CYCLING, 1.0)


@pytest.fixture(scope='module')
def chirp() -> asi.Run:
    return asi.simulate({}, CHIRP, 2.0)


@pytest.fixture(scope='module')
def results(cycling: asi.Run, chirp: asi.Run) -> dict[str, Result]:
    """Return a result of each function that needs no search and no nodes."""
    return {'analyze': asi.analyze(cycling), 'analyze a chirp': asi.analyze(chirp),
            'step_response': asi.step_response(asi.simulate({}, {'compensator': 'lead4'}, 0.4)),
            'frequency_response': asi.frequency_response(chirp),
            'oscillation': asi.oscillation(cycling),
            'detect_limit_cycles': asi.detect_limit_cycles(cycling)}


def test_import_loads_nothing_heavy() -> None:
    code = ('import sys, asi_analysis\n'
            'heavy = {"rclpy", "numpy", "numba", "scipy", "matplotlib"} & set(sys.modules)\n'
            'sys.exit(f"loaded: {heavy}" if heavy else 0)')
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                          cwd=Path(__file__).parents[2])
    assert done.returncode == 0, done.stderr


def test_unknown_name_is_an_attribute_error() -> None:
    assert 'analyze' in dir(asi)
    with pytest.raises(AttributeError, match='no attribute'):
        asi.colour  # noqa: B018


def said(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
         *arguments: str) -> str:
    """Return what a command prints."""
    monkeypatch.setattr(sys, 'argv', ['asi', *arguments])
    assert cli.main() == 0
    return capsys.readouterr().out


@pytest.mark.parametrize('command, function', [
    ('analyze', asi.analyze), ('limit-cycle', asi.detect_limit_cycles)])
def test_command_prints_what_the_function_returns(
        command: str, function: Any, cycling: asi.Run, tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    bag = str(tmp_path / 'bag')
    asi.write_bag(cycling[:0.5], bag)
    result = function(asi.read_bag(bag))
    printed = said(monkeypatch, capsys, command, bag, '--json')
    assert json.loads(printed) == result.to_dict()
    assert problems(result.to_dict(), f'asi {command}') == []
    assert said(monkeypatch, capsys, command, bag) == f'{result}\n'


def test_attribution_of_a_simulated_recording_is_that_of_its_bag(tmp_path: Path) -> None:
    """The simulation has the parameters of the experiment, as a bag of `asi run` has."""
    run = asi.simulate({'load.type': 'locked'}, CYCLING, 0.5)
    asi.write_bag(run, tmp_path / 'bag')
    assert asi.read_bag(tmp_path / 'bag').information == json.loads(json.dumps(run.information))


@pytest.mark.parametrize('name', ['analyze', 'analyze a chirp', 'step_response',
                                  'frequency_response', 'oscillation', 'detect_limit_cycles'])
def test_result_prints_draws_and_is_json(name: str, results: dict[str, Result],
                                         tmp_path: Path) -> None:
    result = results[name]
    assert json.loads(json.dumps(result.to_dict(), allow_nan=False)) == result.to_dict()
    assert str(result) and '<' in result._repr_html_()
    for picture in result.pictures():
        axes = result.plot(picture)
        assert axes and all(isinstance(each, Axes) for each in axes)
        axes[0].figure.savefig(tmp_path / 'picture.png')
        matplotlib.pyplot.close('all')
    assert 'report.html' in str(result.write_report(tmp_path / 'report'))


def test_document_is_a_copy(results: dict[str, Result]) -> None:
    results['analyze'].to_dict()['steps'].clear()
    assert results['analyze'].steps


def test_unknown_picture_and_key_are_told(results: dict[str, Result]) -> None:
    with pytest.raises(asi.InputError, match='step'):
        results['analyze'].plot('colour')
    with pytest.raises(AttributeError, match='rise_time_s'):
        results['analyze'].colour  # noqa: B018


def test_tables_become_frames(results: dict[str, Result], cycling: asi.Run) -> None:
    pytest.importorskip('pandas')
    segments = results['detect_limit_cycles']
    assert list(segments.to_frame()['verdict']) == [s['verdict'] for s in segments.segments]
    assert len(results['frequency_response'].to_frame()) == len(
        results['frequency_response'].gain)
    assert list(cycling.to_frame().columns[:2]) == ['time_s', 'reference_n']
    with pytest.raises(asi.InputError, match='not a table'):
        results['oscillation'].to_frame()


def test_frame_without_pandas_names_the_extra(monkeypatch: pytest.MonkeyPatch,
                                              cycling: asi.Run) -> None:
    monkeypatch.setitem(sys.modules, 'pandas', None)
    with pytest.raises(asi.InputError, match=r'asi_actuator\[pandas\]'):
        cycling.to_frame()


class Small(Result):
    def parts(self) -> Any:
        yield self.text
        yield Table(('<b>', 'value'), [('<i>', '1')], '<u>', ('value',))


def test_html_is_escaped() -> None:
    page = Small({'text': '<script>'})._repr_html_()
    for tag in ('<script>', '<b>', '<i>', '<u>'):
        assert tag not in page
    assert '&lt;script&gt;' in page and 'text-align: right' in page


def test_text_keeps_brackets_and_rows_show_what_is_missing() -> None:
    assert '[green]' in str(Small({'text': '[green]'}))
    table = table_of([{'a': None, 'b': 0.25, 'c': True, 'd': '90 %'}],
                     {'A': '{a:.3g}', 'B': '{b:.0%}', 'C': '{c}', 'D': '{d}'})
    assert table.rows == [['-', '25 %', 'yes', '90 %']] and table.right == ['A', 'B']


def test_run_slices_prints_and_draws(cycling: asi.Run) -> None:
    part = cycling[0.1:0.5]
    assert (part.time_s[0], len(part)) == (0.1, 2000)
    np.testing.assert_array_equal(cycling[0.5:].force_n, cycling[2500:].force_n)
    assert len(cycling[:0.1]) == 500 and len(cycling[-10:]) == 10
    assert 'force' in str(cycling) and '<table>' in cycling._repr_html_()
    assert [each.get_ylabel() for each in cycling.plot()] == ['N', 'm', 'm/s']


@pytest.mark.parametrize('call, said', [
    (lambda run: asi.simulate({'load.mas': 1.0}, {}), 'load.mas'),
    (lambda run: asi.simulate({}, {}, -1.0), 'duration'),
    (lambda run: asi.frequency_response(run), 'too few frequencies'),
    (lambda run: asi.frequency_response(run, 'colour'), 'colour'),
    (lambda run: asi.detect_limit_cycles(run, 'colour'), 'colour'),
    (lambda run: asi.step_response(asi.simulate({}, CHIRP, 0.2)).plot(), 'reference has no step'),
    (lambda run: asi.predict_cycles({}, {}, first_gain=0.0), 'gain'),
    (lambda run: asi.predict_cycles({'load.mas': 1.0}, {}), 'load.mas'),
    (lambda run: asi.quench_cycles({}, {}, [0.0]), 'rate'),
    (lambda run: asi.attribute_model({}, {'gain': 'much'}), 'gain'),
    (lambda run: asi.diagnose([run], {'load.mass': -1.0}), 'model: load.mass'),
    (lambda run: asi.diagnose([run], plant='robot'), 'plant')])
def test_what_cannot_be_used_is_an_input_error(call: Any, said: str, cycling: asi.Run) -> None:
    with pytest.raises(asi.InputError, match=said):
        call(cycling[:2000] if said == 'too few frequencies' else cycling)
