"""What cannot matter does not change the verdict: origin, rate, cut, order, signals left out."""

import dataclasses

import numpy as np
import pytest
from scipy.signal import lfilter
from test_gap import REAL, TEXTBOOK, recorded
from test_gap_joint import joint
from test_gap_simulator import recorded as simulated

from asi_actuator.model.actuator import simulate
from asi_actuator.parameters import as_record
from asi_analysis.bags.run import Run
from asi_analysis.gap.diagnose import diagnose
from asi_analysis.gap.document import document

SERVO = {'signals': {'reference': 'rad', 'position': 'rad'}}


def servo(period_s: float, duration_s: float, lag_s: float, middle: float = 0.0,
          slowest_hz: float = 0.3) -> Run:
    """Return a position servo (rad) that follows a multisine with a first-order lag, and noise."""
    rng = np.random.default_rng(7)
    time = period_s * np.arange(round(duration_s / period_s))
    reference = sum(0.1 * np.sin(2.0 * np.pi * slowest_hz * k * time + phase)
                    for k, phase in zip((1, 2.3, 5.1), rng.uniform(0.0, 6.0, 3), strict=True))
    decay = np.exp(-period_s / lag_s)
    position = lfilter([0.0, 1.0 - decay], [1.0, -decay], reference)
    return Run(time, reference_n=reference + middle,
               position_m=position + middle + rng.normal(0.0, 1e-4, time.size),
               source='servo', information=SERVO)


def test_verdict_does_not_depend_on_the_origin_of_the_coordinate():
    answers = [document(diagnose([servo(4e-3, 8.0, 0.03, middle)], {}, 'joint', drive='position'))
               for middle in (0.0, 1.5)]
    assert answers[0]['verdict'] == answers[1]['verdict'] == 'valve_lag'
    first, second = answers
    assert first['probability'] == pytest.approx(second['probability'], abs=0.02)
    for key in ('before_nrmse', 'after_nrmse', 'shrink'):
        assert first['gap'][key] == pytest.approx(second['gap'][key], rel=0.02, abs=1e-3), key


def test_slow_recording_of_an_hour_is_diagnosed():
    """At 0.5 Hz a valve has answered before the next sample."""
    answer = document(diagnose([servo(2.0, 3600.0, 10.0, slowest_hz=0.002)], {}, 'joint',
                               drive='position'))
    assert answer['verdict'] != 'no_gap'


def pushed(run: Run, phase: float) -> Run:
    """Return a joint's run with a sinusoidal disturbance, a tenth of what moves it."""
    push = 0.1 * np.std(run.command_n) * np.sin(2.0 * np.pi * (3.3 * run.time_s + phase))
    return dataclasses.replace(run, command_n=run.command_n + push)


@pytest.mark.parametrize('phases', [
    (0.45, 0.1), *(pytest.param(each, marks=pytest.mark.slow) for each in ((0.1,), (0.1, 0.45)))])
def test_second_recording_may_have_another_phase_of_a_disturbance(phases):
    answer = document(diagnose([pushed(joint(), phase) for phase in phases], {}, 'joint'))
    assert answer['verdict'] == 'disturbance_force'
    assert answer['probability'] > 0.9
    assert answer['gap']['shrink'] > 0.8
    found = answer['which'][0]['parameters']
    for number, phase in enumerate(phases[1:], 2):
        turns = found[f'disturbance_phase@{number}'] - found['disturbance_phase']
        assert turns == pytest.approx(phase - phases[0], abs=0.02)


@pytest.mark.slow
def test_second_recording_may_have_another_offset():
    runs = [recorded(seed=seed, force_sensor__offset=offset)[:1000]
            for seed, offset in ((5, 40.0), (6, -25.0))]
    answer = document(diagnose(runs, TEXTBOOK))
    assert answer['verdict'] == 'sensor_offset'
    found = answer['which'][0]['parameters']
    assert found['force_sensor_offset'] == pytest.approx(40.0, abs=2.0)
    assert found['force_sensor_offset@2'] == pytest.approx(-25.0, abs=2.0)


@pytest.mark.slow
@pytest.mark.parametrize('load', ['locked', 'free'])
def test_recording_may_begin_in_motion(load):
    """A machine without a gap has none in any part of its recording, whatever it did before."""
    nominal = {'load.type': load}
    run = simulated(nominal, duration_s=4.0)
    parts = run[:2000], run[1337:]
    for runs in (parts[1:], parts) if load == 'locked' else (parts[1:],):
        answer = document(diagnose(runs, nominal))
        assert answer['verdict'] == 'no_gap'
        assert answer['probability'] > 0.9
        assert all(channel['after_nrmse'] < 1.1 * channel['noise_floor_nrmse']
                   for channel in answer['channels'])


@pytest.mark.slow
def test_free_load_that_moves_without_force_does_not_begin_at_rest():
    nominal = {'load.type': 'free'}
    run = dataclasses.replace(simulated(nominal, duration_s=4.0), velocity_m_s=None,
                              valve_position_m=None)[2000:]
    answer = document(diagnose([run], nominal))
    assert (answer['verdict'], answer['probability'] > 0.9) == ('no_gap', True)


@pytest.mark.slow
def test_first_recording_may_be_held_out():
    nominal = {'load.type': 'spring'}
    run = simulated(nominal, duration_s=1.5)
    answer = document(diagnose([run, run], nominal, held_out=[True, False]))
    assert answer['verdict'] == 'no_gap'


@pytest.mark.slow
def test_effect_is_found_in_a_recording_that_begins_in_motion():
    nominal = {'load.type': 'spring'}
    run = simulated(nominal | {'valve_flexure.lag_time': 0.004}, duration_s=4.0)
    for runs in ([run[1337:]], [run[2000:], run[:2000]]):
        answer = document(diagnose(runs, nominal))
        assert answer['verdict'] == 'valve_lag'
        assert answer['which'][0]['parameters']['valve_flexure_lag_time'] == pytest.approx(
            0.004, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize('missing', [
    ('velocity_m_s',), ('valve_position_m',)])
def test_what_was_not_recorded_makes_no_gap(missing):
    nominal = {'load.type': 'spring'}
    run = dataclasses.replace(simulated(nominal, duration_s=1.5), **dict.fromkeys(missing))
    answer = document(diagnose([run], nominal))
    assert answer['verdict'] == 'no_gap'
    assert answer['probability'] > 0.9


@pytest.mark.slow
def test_effect_of_the_valve_is_found_without_its_position():
    nominal = {'load.type': 'spring'}
    machine = nominal | {'valve_flexure.lag_time': 0.004}
    run = dataclasses.replace(simulated(machine), valve_position_m=None)
    answer = document(diagnose([run], nominal))
    assert answer['verdict'] == 'valve_lag'
    assert answer['which'][0]['parameters']['valve_flexure_lag_time'] == pytest.approx(
        0.004, rel=0.05)


@pytest.mark.parametrize(('bias', 'seed', 'first'), [
    pytest.param(8e-8, 7, 900, marks=pytest.mark.slow),
    pytest.param(-6e-8, 1, 950, marks=pytest.mark.slow)])
def test_a_force_below_the_noise_that_held_the_load_before_is_no_origin_of_the_position(
        bias, seed, first):
    """The position is not counted from there: it tells a bias of the valve from a sensor's."""
    rng, rest = np.random.default_rng(seed), np.zeros(1000)
    command = np.concatenate([rest, 500.0 * np.repeat(rng.uniform(-1.0, 1.0, 20), 150)])
    run = simulate(as_record(REAL | {'valve_characteristic.bias': bias}), command, 1e-3)
    noise = {'force_n': 1.0, 'valve_position_m': 2e-8, 'position_m': 1e-6, 'velocity_m_s': 5e-4}
    settled = Run(run.time_s, command_n=command, **{
        name: getattr(run, name) + level * rng.standard_normal(command.size)
        for name, level in noise.items()})[first:]
    answer = document(diagnose([settled], TEXTBOOK))
    # The answer rests on the zero of the position sensor, and says so.
    assert any('a shifted zero looks like a constant force' in note for note in answer['notes'])
    assert answer['verdict'] == 'valve_bias'
    assert answer['probability'] > 0.9
