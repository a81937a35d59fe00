"""The commands and the facts say the same figure for the same thing, converged."""

import re
from pathlib import Path

import pytest

from asi_analysis.bags.run import Run
from asi_analysis.limit_cycle.detection.agreement import judge_run
from asi_analysis.limit_cycle.prediction.predict import onset_by_step
from asi_analysis.loop.bench import RATE_HZ, in_process, step_experiment
from asi_analysis.measures.oscillation import oscillation
from asi_analysis.paper.facts.conditions import LOCKED, Conditions
from asi_analysis.paper.facts.fact import Setup
from asi_analysis.paper.facts.measures import (
    onset_frequencies,
    onset_gains,
    onset_name,
    onset_notes,
    predict_cycle,
)

CONDITIONS = Conditions()
DOCUMENTS = Path(__file__).parents[3] / 'doc' / 'explanation'


@pytest.fixture(scope='module')
def facts():
    setup = Setup({}, CONDITIONS, {})
    return onset_gains(setup, CONDITIONS.onset_steps_n) | onset_frequencies(setup)


@pytest.mark.slow
@pytest.mark.parametrize('step_n', [300.0, 600.0])
def test_predict_says_what_the_facts_say(facts, step_n):
    controller = {'gain': 3.0, 'feedforward': CONDITIONS.feedforward}
    row, = onset_by_step({**LOCKED}, controller, RATE_HZ, 5.0, [step_n])
    assert facts[onset_name(step_n, 'gain')] == pytest.approx(row['simulated_gain'], rel=1e-3)
    # The frequency rises steeply with the gain at the onset.
    assert facts[onset_name(step_n, 'frequency_hz')] == pytest.approx(
        row['simulated_frequency_hz'], rel=0.015)
    assert row['predicted_gain'] == pytest.approx(row['simulated_gain'], rel=5e-3)
    assert onset_notes(Setup({}, CONDITIONS._replace(onset_steps_n=(step_n,)), facts)) == {}


@pytest.mark.parametrize('step_n', [pytest.param(100.0, marks=pytest.mark.slow), 600.0])
def test_recordings_at_the_onset_are_the_cycle_that_the_facts_tell(facts, step_n):
    gain, expected = (facts[onset_name(step_n, what)] for what in ('gain', 'frequency_hz'))
    run = in_process(step_experiment(
        {**LOCKED}, {'gain': gain, 'feedforward': CONDITIONS.feedforward}, step_n, 12.0))
    end = Run(*run).between(9.0, 12.0)
    judged = judge_run(end)[-1]
    assert judged.verdict == 'limit_cycle'
    assert judged.frequency_hz == pytest.approx(expected, rel=2e-3)
    found = oscillation(end)
    assert found.sustained and found.frequency_hz == pytest.approx(expected, rel=2e-3)


def test_just_below_the_onset_every_step_dies_out(facts):
    for step_n in (100.0, 600.0):
        gain = 0.99 * facts[onset_name(step_n, 'gain')]
        run = in_process(step_experiment(
            {**LOCKED}, {'gain': gain, 'feedforward': CONDITIONS.feedforward}, step_n, 12.0))
        assert not oscillation(Run(*run).between(8.0, 12.0)).sustained


def test_onset_and_prediction_do_not_move_at_twice_the_resolution(facts):
    setup = Setup({}, CONDITIONS, {})
    for name, gain in onset_gains(setup.refined(2), (300.0, 600.0)).items():
        assert gain == pytest.approx(facts[name], rel=1e-3)
    coarse, fine = predict_cycle(setup), predict_cycle(setup.refined(2))
    for name, value in fine.items():
        assert coarse[name] == pytest.approx(value, rel=1e-4)


def test_a_step_back_from_100_n_starts_the_cycle_lower_than_a_step_of_20_n(facts):
    gains = onset_gains(Setup({}, CONDITIONS, {}), (20.0,))
    assert facts[onset_name(0.0, 'gain')] == pytest.approx(7.228, rel=0.005)
    assert gains[onset_name(20.0, 'gain')] == pytest.approx(8.016, rel=0.005)


def _cells(page: str, columns: int, *begin: str) -> list[str]:
    """Return the cells of the row of so many columns in a document that begins with these."""
    rows = [[cell.strip() for cell in line.strip('|').split('|')]
            for line in (DOCUMENTS / page).read_text().splitlines() if line.startswith('| ')]
    row, = (row for row in rows if len(row) == columns and row[:len(begin)] == list(begin))
    return row


def _number(cell: str) -> float:
    return float(re.match(r'[-\d.e]+', cell).group())


def test_documents_tell_what_the_facts_tell(facts):
    for step_n in CONDITIONS.onset_steps_n:
        hz, gain = (facts[onset_name(step_n, what)] for what in ('frequency_hz', 'gain'))
        told = _cells('reproduction/table.md', 9, 'F8',
                      f'cycle frequency at onset, {step_n:.0f} N')
        assert _number(told[4]) == pytest.approx(hz, rel=2e-3)
        _, _, _, told_gain, told_hz = _cells(
            'limit_cycles.md', 5, 'back from 100 to 0' if step_n == 0.0 else f'{step_n:.0f}')
        assert float(told_gain) == pytest.approx(gain, rel=1e-3)
        assert float(told_hz) == pytest.approx(hz, rel=0.015)
    predicted = predict_cycle(Setup({}, CONDITIONS, {}))
    for quantity, name in (('first intersection of the Nyquist plot, gain',
                            'predicted_onset_gain'),
                           ('first intersection, frequency', 'predicted_onset_frequency_hz')):
        told = _cells('reproduction/table.md', 9, 'F9', quantity)
        assert _number(told[4]) == pytest.approx(predicted[name], rel=1e-3)
