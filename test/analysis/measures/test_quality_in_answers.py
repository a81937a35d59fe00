"""Every command that answers from a recording says what is wrong with it: text, JSON, report."""

import json
import sys
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asi_analysis import cli
from asi_analysis.bags.bag import read_bag, write_bag
from asi_analysis.bags.exchange.exporting import export
from asi_analysis.bags.exchange.importing import import_recording
from asi_analysis.bags.run import Run, StateChange
from asi_analysis.errors import InputWarning
from asi_analysis.loop.in_process import simulate
from asi_analysis.measures.analysis import analyze
from asi_analysis.measures.quality import findings

# Of each command: its words, and the part of its answer that is not reliable.
COMMANDS = {
    'analyze': (['analyze', '{cycle}'], lambda answer: answer['reliable']['oscillation']),
    'limit-cycle': (['limit-cycle', '{cycle}'], lambda answer: answer['segments'][-1]['reliable']),
    'attribute': (['attribute', '{cycle}'], lambda answer: answer['reliable']),
    'compare': (['compare', '{cycle}', '--plants', '0', '--conditions', '0'],
                lambda answer: answer['recordings'][0]['reliable']['oscillation']),
    'gap': (['gap', 'of', '{servo}', '--plant', 'joint'],
            lambda answer: answer['reliable']),
}
WITHOUT_REPORT = ('analyze',)


def said(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
         words: Sequence[str]) -> str:
    monkeypatch.setattr(sys, 'argv', ['asi', *words])
    assert cli.main() == 0
    return capsys.readouterr().out


@pytest.fixture(scope='module')
def bags(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return bags of a limit cycle and of a servo whose measured signal is clipped."""
    run = simulate({'load.type': 'spring'}, {'gain': 12.0, 'reference.amplitude': 100.0}, 1.2,
                   1000.0)
    force = run.signal('force')
    cycle = replace(run, information={}, force_n=np.minimum(force, 0.7 * force.max()))
    time_s = np.arange(90) / 30.0
    x = np.sin(3.0 * time_s)
    servo = Run(time_s, reference_n=x + 0.1, position_m=np.minimum(x, 0.6), information={
        'signals': {'position': 'rad', 'reference': 'rad'}})
    folder = tmp_path_factory.mktemp('clipped')
    for name, each in (('cycle', cycle), ('servo', servo)):
        write_bag(each, folder / name, each.information)
    return {'cycle': folder / 'cycle', 'servo': folder / 'servo'}


@pytest.mark.parametrize('command', COMMANDS)
def test_every_answer_and_report_says_what_is_wrong_with_the_samples(
        command: str, bags: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str]) -> None:
    words, reliable = COMMANDS[command]
    words = [word.format(**bags) for word in words]
    report = [] if command in WITHOUT_REPORT else ['--report', str(tmp_path / 'report')]
    answer = json.loads(said(monkeypatch, capsys, [*words, *report, '--json']))
    clipped = next(each for each in answer['quality'] if each['kind'] == 'clipping')
    assert clipped['severity'] == 'doubtful' and not reliable(answer)
    assert f'data: {clipped["text"]}' in said(monkeypatch, capsys, words)
    if report:
        assert f'data: {clipped["text"]}' in (tmp_path / 'report/report.html').read_text()


def test_a_bag_keeps_what_its_import_left_out(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
        ) -> None:
    """Of 1.3 kHz in whole ms a quarter has the time of the one before; the rest is even."""
    t = np.arange(2600) / 1300.0
    force = 80.0 * np.sin(2.0 * np.pi * 330.0 * t) + 0.1 * np.sin(37.0 * t)
    text = ''.join(f'{round(1e3 * a)},{b}\n' for a, b in zip(t, force, strict=True))
    (tmp_path / 'log.csv').write_text('t,f\n' + text)
    with pytest.warns(InputWarning, match='are left out'):
        run = import_recording(tmp_path / 'log.csv', ['time=t[ms]', 'force=f'],
                               out=tmp_path / 'bag')
    assert any('are left out' in each for each in run.problems)
    with pytest.warns(InputWarning, match='at its import: .* are left out'):
        assert len(read_bag(tmp_path / 'bag').problems) == 1
    for command, name in (('analyze', 'oscillation'), ('limit-cycle', 'segments')):
        answer = json.loads(said(monkeypatch, capsys, [command, str(tmp_path / 'bag'), '--json']))
        kinds = {each['kind']: each['severity'] for each in answer['quality']}
        assert kinds == {'missing': 'doubtful', 'reading': 'note'}
        assert not (answer['reliable'][name] if command == 'analyze' else
                    answer[name][-1]['reliable'])


def test_a_bag_that_is_imported_again_hands_on_what_its_import_left_out(tmp_path: Path) -> None:
    rows = '0,1.5\n0.001,2.5\n0.001,3.5\n0.002,2.0\n0.003,2.25\n'
    (tmp_path / 'log.csv').write_text('t,f\n' + rows)
    with pytest.warns(InputWarning, match='are left out'):
        import_recording(tmp_path / 'log.csv', ['time=t', 'force=f'], out=tmp_path / 'bag')
    with pytest.warns(InputWarning, match='at its import: .* are left out'):
        again = import_recording(tmp_path / 'bag', ['force=/force/wrench/force/x'],
                                 out=tmp_path / 'again')
    assert again.information['imported']['repeated_times_s'] == [0.001]
    with pytest.warns(InputWarning, match='at its import: .*at its import: .* are left out'):
        found = read_bag(tmp_path / 'again')
    assert 'missing' in {each.kind for each in findings(found)}


def test_a_parquet_file_hands_on_what_an_import_left_out(tmp_path: Path) -> None:
    rows = '0,1.5\n0.001,2.5\n0.001,3.5\n0.002,2.0\n0.003,2.25\n'
    (tmp_path / 'log.csv').write_text('t,f\n' + rows)
    with pytest.warns(InputWarning, match='are left out'):
        export(import_recording(tmp_path / 'log.csv', ['time=t', 'force=f']),
               tmp_path / 'log.parquet')
    imported = import_recording(tmp_path / 'log.parquet', []).information['imported']
    assert imported['repeated_times_s'] == [0.001]
    assert len(imported['problems']) == 1


@pytest.mark.parametrize('part', [slice(400), slice(65), slice(20, None), slice(None)])
def test_figures_of_the_samples_that_a_cut_bag_lacks_are_doubtful(
        part: slice, tmp_path: Path) -> None:
    run = simulate({'force_sensor.noise': 0.1}, {
        'compensator': 'lead4', 'reference.shape': 'step', 'reference.amplitude': 100.0},
        0.6, 1000.0)
    write_bag(run[part], tmp_path / 'cut')
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', InputWarning)
        answer = analyze(read_bag(tmp_path / 'cut'))
    whole = part == slice(None)
    assert [each['kind'] for each in answer.quality] == ([] if whole else ['cut'])
    for figure in ('rise_time_s', 'steady_state_error_n', 'bandwidth_hz', 'tracking_error_rms_n',
                   'command_rms_n', 'oscillation'):
        assert answer.reliable[figure] is whole
        assert answer[figure] is not None   # it is marked, as that of a shorter run
    if part.start is None:
        assert all(each['intervals'][0]['start_s'] > run.time_s[part][-1]
                   for each in answer.quality)


def test_a_step_before_the_last_one_of_a_bag_that_was_cut_is_reliable(tmp_path: Path) -> None:
    run = simulate({'force_sensor.noise': 0.1}, {
        'compensator': 'lead4', 'reference.shape': 'step', 'reference.amplitude': 100.0,
        'reference.end': 0.3}, 0.8, 1000.0)
    write_bag(run[:600], tmp_path / 'cut')
    with pytest.warns(InputWarning, match='200 of the 800'):
        answer = analyze(read_bag(tmp_path / 'cut'))
    assert answer.reliable['rise_time_s'] and answer.reliable['steady_state_error_n']
    assert not answer.reliable['tracking_error_rms_n']


@pytest.mark.parametrize(('part', 'reliable'), [
    (slice(1200), True), (slice(300, None), False), (slice(None), True)])
def test_the_largest_step_of_a_prbs_that_was_cut(
        part: slice, reliable: bool, tmp_path: Path) -> None:
    """The first of equal ones: it may lie before a cut, but not behind it."""
    run = simulate({'force_sensor.noise': 0.1}, {
        'compensator': 'lead4', 'reference.shape': 'prbs', 'reference.amplitude': 100.0,
        'reference.frequency': 10.0}, 1.5, 1000.0)
    write_bag(run[part], tmp_path / 'cut')
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', InputWarning)
        answer = analyze(read_bag(tmp_path / 'cut'))
    assert len(answer.steps) > 2
    assert answer.reliable['rise_time_s'] is reliable
    assert any('may hold a larger one' in note for note in answer.notes) is not reliable


def test_an_overshoot_within_the_noise_is_doubtful() -> None:
    """Each step has how much of its overshoot the noise alone may give."""
    quiet, noisy = (analyze(simulate(
        {'load.type': 'locked', 'force_sensor.noise': noise}, {
            'compensator': 'lead2', 'reference.shape': 'step', 'reference.amplitude': 100.0},
        0.6, 1000.0)) for noise in (0.0, 2.0))
    within = noisy.steps[0]['overshoot_noise_percent']
    assert 0.0 < abs(noisy.overshoot_percent - quiet.overshoot_percent) < within
    assert noisy.overshoot_percent < within
    assert quiet.reliable['overshoot_percent'] and not noisy.reliable['overshoot_percent']
    assert noisy.reliable['rise_time_s']
    assert any(note.startswith('overshoot: doubtful') for note in noisy.notes)


def test_a_force_altered_while_the_command_is_saturated_is_doubtful_to_its_end() -> None:
    run = simulate({'load.type': 'spring', 'force_sensor.noise': 0.3}, {
        'compensator': 'lead4', 'reference.shape': 'step', 'reference.amplitude': 100.0,
        'saturation': 110.0}, 0.6, 1000.0)
    hum = 10.0 * np.sin(2.0 * np.pi * 50.0 * run.time_s)
    answer = analyze(replace(run, force_n=run.signal('force') + hum))
    assert not answer.reliable['oscillation']
    assert answer.quality[0]['intervals'][0]['end_s'] > 0.59


def test_a_bag_without_its_reference_marks_the_oscillation() -> None:
    """With a reference the oscillation that it forces is taken out."""
    run = simulate({'load.type': 'spring'}, {
        'reference.shape': 'sine', 'reference.frequency': 10.0}, 1.0, 1000.0)
    answer = analyze(replace(run, reference_n=None))
    assert answer.oscillation['sustained'] and not answer.reliable['oscillation']
    assert not analyze(run).oscillation['sustained'] and analyze(run).reliable['oscillation']


def test_a_delay_is_doubtful_if_the_signal_is_held_between_its_samples() -> None:
    run = replace(simulate({'load.type': 'spring', 'force_sensor.noise': 0.3}, {
        'reference.shape': 'multisine'}, 1.0, 1000.0), information={}, command_n=None)
    held = replace(run, force_n=np.repeat(run.signal('force')[::4], 4))
    for each, reliable in ((run, True), (held, False)):
        answer = analyze(each)
        assert answer.correlation_delay_s and answer.delay_s
        assert answer.reliable['correlation_delay_s'] is answer.reliable['delay_s'] is reliable


def test_a_delay_of_more_than_half_a_repetition_of_the_reference_is_doubtful() -> None:
    """The force of a free piston leads: it was said to be almost 2 periods of a triangle late."""
    free = analyze(simulate({'load.type': 'free'}, {
        'compensator': 'lead_lag', 'reference.shape': 'triangle', 'reference.amplitude': 60.0,
        'reference.frequency': 4.0}, 1.5, 1000.0))
    assert free.correlation_delay_s > 0.125 and not free.reliable['correlation_delay_s']
    answer = analyze(simulate({'load.type': 'spring'}, {
        'reference.shape': 'triangle', 'reference.frequency': 4.0}, 1.5, 1000.0))
    assert answer.correlation_delay_s < 0.05 and answer.reliable['correlation_delay_s']


def test_a_fault_is_told_until_it_is_reset() -> None:
    """The valve command was said to be 0 from the fault on, also after a reset."""
    time_s = 0.001 * np.arange(3000)
    run = Run(time_s, reference_n=np.sin(time_s), force_n=np.sin(time_s), states=(
        StateChange(0.0, 'enabled', ''), StateChange(0.5, 'fault', 'too much'),
        StateChange(1.25, 'enabled', ''), StateChange(2.0, 'fault', 'again')))
    assert [note for note in analyze(run).notes if 'fault' in note] == [
        'fault at 0.5 s, the valve command is 0 until 1.25 s: too much',
        'fault at 2 s, the valve command is 0 from there on: again']
