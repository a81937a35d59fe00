"""Limit cycles quenched: the margin, the attack, and dither."""

import json
import subprocess
import sys

import numpy as np
import pytest
from documented import problems
from study import STUDY, STUDY_CONTROLLER

from asi_analysis.limit_cycle.quench.attack import (
    EXCITED_S,
    FREE_S,
    NAMES,
    WATCHED_S,
    Condition,
    run_trials,
    search,
)
from asi_analysis.limit_cycle.quench.dither import dither
from asi_analysis.limit_cycle.quench.margin import encircles, margin
from asi_analysis.loop.closed_loop import simulate_loop
from asi_analysis.loop.onset import onset

RATE_HZ = 5000.0


def test_margin_falls_with_the_gain_and_is_gone_where_the_loop_cycles():
    gains = (2.0, 4.0, 6.0, 10.0)
    found = [margin({}, {'gain': gain}, RATE_HZ).distance for gain in gains]
    assert found[0] > found[1] > found[2] > found[3] == 0.0


def test_lead_has_more_margin_than_the_gain_alone_that_is_as_fast():
    assert margin({}, {'compensator': 'lead4'}, RATE_HZ).distance > 2.0 * margin(
        {}, {'gain': 6.0}, RATE_HZ).distance


@pytest.mark.parametrize('gain, unstable', [(7.9, False), (8.1, True)])
def test_encirclement_is_the_stability_limit_of_a_known_loop(gain, unstable):
    # K / (s + 1)^3 is stable up to K = 8.
    s = 1j * np.geomspace(1e-3, 1e3, 4000)
    assert encircles(gain / (s + 1.0) ** 3) is unstable


def test_attack_finds_the_cycle_of_a_high_gain_and_none_of_a_low_one():
    wild = search({}, {'gain': 10.0}, (RATE_HZ,), 20, seed=1)
    assert wild[0].sustained and wild[0].amplitude_n > 100.0
    tame = search({}, {'gain': 2.0}, (RATE_HZ,), 20, seed=1)
    assert not any(trial.sustained for trial in tame)


def test_condition_does_the_same_alone_and_beside_another():
    condition = Condition(dict.fromkeys(NAMES, 0.37))
    other = Condition(dict.fromkeys(NAMES, 0.6))
    alone = run_trials([condition], {}, {'gain': 9.0}, (RATE_HZ,))
    assert run_trials([other, condition], {}, {'gain': 9.0}, (RATE_HZ,))[1:] == alone


def test_condition_is_nothing_but_parameters_so_that_it_can_be_replayed_over_ros():
    trial = search({}, {'gain': 10.0}, (RATE_HZ,), 4, seed=3)[0]
    settings = trial.condition.settings((RATE_HZ,), {})
    run = simulate_loop(settings['actuator'], {'gain': 10.0, **settings['reference']},
                        EXCITED_S + FREE_S, RATE_HZ)
    # Until it ends something pushes and pulls, then nothing does.
    ended = run.time_s >= EXCITED_S
    assert np.ptp(run.reference_n[ended]) == 0.0 and np.ptp(run.reference_n[~ended]) > 0.0
    left = run.force_n[-2 * int(WATCHED_S * RATE_HZ):]
    if trial.sustained:
        assert 0.5 * np.ptp(left) == pytest.approx(trial.amplitude_n, rel=0.1)


def test_the_attack_is_on_the_actuator_that_was_given():
    condition = Condition({**dict.fromkeys(NAMES, 0.6), 'load': 0.4})   # a spring
    own, usual = (run_trials([condition], actuator, {'gain': 9.0}, (RATE_HZ,))[0].amplitude_n
                  for actuator in ({'valve_characteristic.gain': 0.3}, {}))
    assert usual > 10.0 and own == 0.0


def test_the_attack_moves_the_piston_where_a_loop_that_is_quiet_at_rest_cycles():
    rest, moved = (Condition({**dict.fromkeys(NAMES, 0.5), 'load': load, 'motion': 0.75})
                   for load in (0.0, 0.99))
    at_rest, in_motion = run_trials([rest, moved], {}, {'gain': 4.5}, (RATE_HZ,))
    assert not at_rest.sustained and in_motion.sustained
    actuator = moved.settings((RATE_HZ,), {})['actuator']
    assert actuator['load.type'] == 'prescribed' and actuator['load.velocity'] == 0.3


def test_push_lets_go_when_it_should():
    pushed = simulate_loop({'load.external_force': 200.0, 'load.external_force_end': 0.1},
                           {'gain': 1.0, 'reference.shape': 'step',
                            'reference.amplitude': 0.0}, 0.3)
    held = pushed.position_m[pushed.time_s < 0.1][-1]
    assert abs(held) > 1e-6 and abs(pushed.position_m[-1]) < 0.2 * abs(held)


def test_dither_quenches_a_cycle_that_is_barely_there_and_costs_valve_travel():
    settings = STUDY_CONTROLLER | {'reference.amplitude': 100.0}
    gain = onset(STUDY, settings, RATE_HZ, 8.0).gain
    rows = dither(STUDY, {**settings, 'gain': 1.01 * gain}, RATE_HZ, (500.0,))
    assert rows[0]['amplitude_n'] is not None
    assert rows[0]['valve_travel_m_s'] > 0.0 and rows[0]['force_ripple_n'] > 0.1


def test_command_prints_what_is_documented_and_fails_when_it_finds_a_cycle(tmp_path):
    result = subprocess.run(
        [sys.executable, '-m', 'asi_analysis.cli', 'quench', '--gain', '10', '--conditions', '4',
         '--report', str(tmp_path), '--json'],
        capture_output=True, text=True)
    document = json.loads(result.stdout)
    assert problems(document, 'asi quench') == []
    assert document['sustained_found'] and result.returncode == 1
    assert (tmp_path / 'quench.png').read_bytes().startswith(b'\x89PNG')
