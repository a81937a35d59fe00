"""Joints of the examiner: the same seed gives the same case; one thing is there or nothing."""

import json

import numpy as np
import pytest

from asi_analysis.gap.check.check import examine, is_truth, run_cases, score, unseal
from asi_analysis.gap.diagnose import diagnose
from asi_analysis.gap.document import document
from asi_examiner.bags import write_cases
from asi_examiner.joint import FOLLOWING, FORCED, OF_A_SERVO, OUTSIDE, VISIBLE, draw_joint

DYNAMICS = {'inertia', 'damping', 'gravity', 'gravity_zero', 'spring', 'offset', 'stribeck',
            'bristle', 'pulsation', 'ratio'}


@pytest.mark.parametrize('seed', range(60000, 60012))
def test_joint_is_what_its_answer_says(seed):
    case, again = draw_joint(seed), draw_joint(seed)
    run = case.runs[0]
    np.testing.assert_array_equal(run.position_m, again.runs[0].position_m)
    assert run.rate_hz == pytest.approx(case.rate_hz) and np.isfinite(run.position_m).all()
    there = {name for name in case.plant.dtype.names if case.plant[name]} - DYNAMICS
    assert bool(there) == (case.kind != 'none') == bool(case.effects)
    effects = FOLLOWING if case.also else FORCED
    assert case.blocks == tuple(effects[name] for name in case.effects if name in effects)
    assert set(case.also) <= set(OF_A_SERVO)


def test_a_mixed_joint_has_an_effect_and_something_else():
    case = draw_joint(60000, mixed=True)
    effect, other = case.effects
    assert effect in FORCED and other in OUTSIDE['forced'] and case.blocks == (FORCED[effect],)
    assert case.visibility > VISIBLE   # of each alone


def test_cases_of_joints_are_written_and_judged(tmp_path):
    assert list(write_cases(tmp_path / 'cases', 1, 60002, 'joint')) == [1]
    entry, = json.loads((tmp_path / 'cases' / 'cases.json').read_text())
    assert entry == {'bag': 'case_0000', 'more': [], 'plant': 'joint'}
    rows, answers = run_cases(tmp_path / 'cases', lambda *_: None), unseal(
        tmp_path / 'cases' / 'answers.sealed')
    assert is_truth(rows[0]['verdict'], answers['case_0000'])
    assert score(rows, answers)['cases'] == 1


@pytest.mark.parametrize(('entry', 'why'), [
    ({'baseline': 'healthy'}, "baseline = 'healthy' is no list of bags"),   # read by its letters
    ({'fresh': 'again'}, 'fresh takes an actuator'),   # "nothing to compare", after the diagnosis
])
def test_a_case_that_cannot_be_checked_is_refused_in_words(entry, why, tmp_path):
    row = examine(tmp_path, {'bag': 'case', 'plant': 'joint', **entry})
    assert row['verdict'] == 'refused' and why in row['why']


@pytest.mark.parametrize(('seed', 'effect', 'field', 'truth'), [
    pytest.param(300113, 'backlash', 'backlash', 'gap',
                 marks=pytest.mark.slow),                             # it rattles
    pytest.param(300174, 'command_quantisation', 'command_quantum', 'quantum',
                 marks=pytest.mark.slow),                             # its steps have any origin
    pytest.param(310027, 'command_quantisation', 'command_quantum', 'quantum',
                 marks=pytest.mark.slow),                             # coarse, of a quick servo
    pytest.param(340012, 'command_quantisation', 'command_quantum', 'quantum',
                 marks=pytest.mark.slow),                             # it rests at few levels
    (310020, 'disturbance_force', 'disturbance_frequency', 'push_frequency'),  # beside a line
    pytest.param(310067, 'disturbance_force', 'disturbance_pulse', 'push_burst',
                 marks=pytest.mark.slow),                             # it hides the gravity
    pytest.param(310030, 'valve_lag', 'drive_lag', 'lag',
                 marks=pytest.mark.slow),                             # it has two poles
    pytest.param(330031, 'valve_lag', 'valve_lag', 'lag',
                 marks=pytest.mark.slow)])                            # before a servo
def test_size_of_what_a_fit_finds_only_from_nearby(seed, effect, field, truth):
    case = draw_joint(seed)
    answer = document(diagnose(case.runs, {}, 'joint'))
    assert answer['verdict'] == effect
    size, = (row['parameters'][field] for row in answer['which'] if row['effect'] == effect)
    assert size == pytest.approx(case.plant[truth], rel=0.05)


@pytest.mark.slow
def test_delay_of_a_servo_that_reaches_the_noise():
    case = draw_joint(300222)
    answer = document(diagnose(case.runs, {}, 'joint'))
    assert answer['verdict'] == 'transport_delay'
    assert answer['which'][0]['parameters']['command_delay'] == pytest.approx(
        case.plant['delay'], abs=1e-3)
