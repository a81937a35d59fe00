"""What the answer says beside the verdict: shares of a pair, limits of tolerance, what next."""

from types import SimpleNamespace

import pytest
from documented import problems
from test_gap import TEXTBOOK, recorded

from asi_analysis.gap.diagnose import diagnose, document, plain, sentences
from asi_analysis.gap.experiment.next_experiment import suggestion
from asi_analysis.gap.inference.verdict import Candidate, explaining


def test_each_block_of_a_pair_has_the_share_that_its_effect_explains():
    run = recorded(load__external_force=80.0, force_sensor__offset=15.0)
    answer = plain(document(diagnose([run], TEXTBOOK)))
    assert answer['verdict'] == 'disturbance_force+sensor_offset'
    share = {row['block']: row['share'] for row in answer['where']}
    # The offset is in both channels, the disturbance only in that of the load.
    assert share['mechanics'] + share['sensor'] > 0.95
    assert 0.02 < share['sensor'] < 0.4 < share['mechanics']


def test_effect_of_size_zero_is_no_hypothesis():
    costs = {(): 100.0, ('valve_lag',): 50.0, ('valve_bias',): 99.95,
             ('valve_bias', 'valve_lag'): 49.99, ('transport_delay', 'valve_lag'): 40.0}
    found = {names: Candidate(names, (), SimpleNamespace(cost=cost))
             for names, cost in costs.items()}
    assert set(explaining(found)) == {(), ('valve_lag',), ('transport_delay', 'valve_lag')}


def test_parameter_at_the_limit_of_its_tolerance_is_said():
    stiff = {**TEXTBOOK, 'load.stiffness': 2e5 * 1.35}
    answer = plain(document(diagnose([recorded(real=stiff)], TEXTBOOK)))
    limit = next(row for row in answer['at_limit'] if row['parameter'] == 'load.stiffness')
    assert limit['limit'] == 'high'
    assert limit['value'] == pytest.approx(1.2 * limit['nominal'], rel=1e-3)
    assert 'At the limit of the tolerance: ' in ' '.join(sentences(answer))
    answer['report'] = None
    assert problems(answer, 'asi gap') == []


@pytest.mark.parametrize(('separation', 'missing', 'words', 'command'), [
    (8.0, [], 'asi run', True),
    (3e-6, [], 'no recording of these signals tells them apart: measure the pressure', False),
    (3e-6, ['position'], 'record the position too', False),
    (8.0, ['position'], 'record the position too; asi run', True)])
def test_next_experiment_is_only_suggested_if_it_separates(separation, missing, words, command):
    left = [('entrained_air',), ('sensor_lag',)]
    found = suggestion('chirp', 'asi run', separation, {'chirp': separation}, left, missing)
    assert found['advice'].startswith(words)
    assert (found['command'] is not None) == found['separates'] == command
