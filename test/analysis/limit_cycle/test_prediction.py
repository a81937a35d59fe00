"""Predicted cycles: describing functions against closed forms, the balance against simulation."""

import control
import numpy as np
import pytest
from study import STUDY, STUDY_CONTROLLER

from asi_actuator.model.actuator import simulate
from asi_actuator.parameters import as_record
from asi_analysis.loop import describing_functions as describing
from asi_analysis.loop import harmonic_balance as hb
from asi_analysis.loop.floquet import multipliers
from asi_analysis.loop.one_harmonic import OneHarmonic, first_intersection, locus, stable
from asi_analysis.loop.onset import branch, onset
from asi_analysis.loop.simulation import (
    as_balance,
    loop_of,
    step_run,
    sustained,
    with_mean_friction,
)

RATE_HZ = 5000.0


@pytest.mark.parametrize('amplitude', [15.0, 20.0, 100.0, 1000.0])
def test_play_is_python_controls(amplitude):
    p = as_record(STUDY | {'valve_hysteresis.lag_time': 0.0})
    # Its backlash: b is the whole width. One amplitude at a time: it forgets.
    closed = control.friction_backlash_nonlinearity(28.0).describing_function(amplitude)
    assert describing.hysteresis(amplitude, 50.0, p) == pytest.approx(closed, abs=2e-3)


@pytest.mark.parametrize('share', [0.0, 1.0])
@pytest.mark.parametrize('lagged', [0.0, 0.3, 1.0])
def test_hysteresis_is_the_simulated_response_to_a_sine(lagged, share):
    """With every choice of the loop: rounded corners, a flux that lags."""
    samples, frequency = 2000, 40.0
    p = as_record({'valve_hysteresis.lagged': lagged, 'valve_hysteresis.rounding': share,
                   'valve_flexure.model': 'off'})
    angle = 2.0 * np.pi * np.arange(5 * samples) / samples
    valve = simulate(p, 300.0 * np.sin(angle), 1.0 / (frequency * samples)).valve_position_m
    of_command = float(p['valve_characteristic_gain'] * p['valve_characteristic_full_opening']
                       / p['valve_characteristic_maximum_force'])
    # A held command is late by half a sample.
    wave = np.exp(-1j * (angle[-samples:] - np.pi / samples))
    simulated = 2j * np.mean(valve[-samples:] * wave) / (300.0 * of_command)
    assert describing.hysteresis(300.0, frequency, p) == pytest.approx(simulated, abs=1.5e-3)


def test_play_passes_nothing_of_a_sine_within_it():
    p = as_record(STUDY | {'valve_hysteresis.lag_time': 0.0})
    assert abs(describing.hysteresis(10.0, 50.0, p)) < 1e-12


@pytest.mark.parametrize('amplitude, bias', [
    (5e-6, 0.0), (4e-5, 0.0), (4e-5, 1e-5), (3e-5, -2e-5)])
def test_characteristic_is_its_closed_form(amplitude, bias):
    p = as_record({})
    slope = p['valve_characteristic_maximum_force'] / p['valve_characteristic_full_opening']
    closed = slope * describing.saturation_closed_form(
        amplitude, p['valve_characteristic_full_opening'], bias)
    assert describing.characteristic(amplitude, bias, p).real == pytest.approx(closed, rel=1e-3)


@pytest.mark.parametrize('friction', [{}, {'friction.element_ratio': 2.0},
                                      {'friction.softening': 1.0}])
def test_fast_sliding_is_coulomb_friction(friction):
    p = as_record({'friction.presliding_stiffness': 1e8, 'friction.presliding_damping': 0.0}
                  | friction)
    assert describing.seal_friction(5.0, 10.0, p).real == pytest.approx(
        4.0 * 7.0 / (np.pi * 5.0), rel=0.02)   # 4 F / (pi A)


@pytest.mark.parametrize('ratio', [1.0, 2.0])
def test_seals_that_do_not_slide_are_a_spring(ratio):
    p = as_record({'friction.element_ratio': ratio})
    assert describing.seal_friction(1e-4, 10.0, p) == pytest.approx(
        p['friction_presliding_damping']
        + p['friction_presliding_stiffness'] / (2j * np.pi * 10.0), rel=0.01)


def test_damping_of_a_small_motion_is_its_slope():
    p = as_record(STUDY)
    assert describing.damping(1e-4, 0.0, p).real == pytest.approx(
        p['hydraulic_damping_viscous'], rel=0.03)


def test_linear_loop_is_what_the_simulator_passes():
    actuator = {'valve_hysteresis.model': 'off', 'hydraulic_damping.model': 'off',
                'friction.model': 'off', 'load.locked_damping': 500.0}
    from asi_analysis.loop.closed_loop import simulate_loop
    run = simulate_loop(actuator, {'gain': 0.0, 'feedforward': 1.0, 'reference.shape': 'sine',
                                   'reference.amplitude': 100.0, 'reference.frequency': 100.0,
                                   'reference.start': 0.0}, 0.5)
    last = run.time_s > 0.3
    turn = np.exp(-2j * np.pi * 100.0 * run.time_s[last])
    passed = (run.force_n[last] @ turn) / (run.command_n[last] @ turn)
    loop = loop_of(actuator, {'gain': 1.0}, RATE_HZ)
    assert OneHarmonic(loop, held=True).per_gain([100.0])[0] == pytest.approx(passed, rel=2e-3)


def test_describing_function_first_meets_the_loop_where_the_paper_says():
    of = OneHarmonic(loop_of(STUDY, {'gain': 1.0}, RATE_HZ), held=True)
    rows = locus(of, np.geomspace(500.0, 1.6e4, 12))
    first = first_intersection(of, rows)
    assert first.gain == pytest.approx(8.0, rel=0.15)            # paper: 8
    assert first.frequency_hz == pytest.approx(130.0, rel=0.15)  # paper: 130 Hz
    assert stable(of, rows[-1]) and not stable(of, rows[0])


# The last is a small cycle near its fold: slow to settle, and its seals remember the step.
@pytest.mark.parametrize('step, gain, actuator', [
    (100.0, 10.0, {'friction.element_ratio': 1.6, 'friction.softening': 1.0}),
    (100.0, 10.0, {}), (300.0, 11.0, {}), (600.0, 10.0, {})])
def test_balance_is_the_simulated_cycle(step, gain, actuator):
    settings = {'gain': gain, 'reference.amplitude': step}
    run = step_run(actuator, settings, RATE_HZ)
    swing = sustained(run)
    loop = with_mean_friction(loop_of(actuator, settings, RATE_HZ), run, swing.frequency_hz)
    # A guess that is well off, so that the balance has to find the cycle by itself.
    guess = as_balance(run, swing, gain, 7)
    guess = guess._replace(frequency_hz=1.03 * guess.frequency_hz, command=0.93 * guess.command)
    found = hb.balance(loop, guess)
    assert found.frequency_hz == pytest.approx(swing.frequency_hz, rel=0.002)
    assert found.amplitude_n == pytest.approx(swing.amplitude_n, rel=0.01)
    assert found.thd == pytest.approx(swing.thd, rel=0.1)


@pytest.mark.slow
def test_branch_folds_where_the_simulated_cycle_is_born():
    settings = STUDY_CONTROLLER | {'reference.amplitude': 300.0}
    gain, frequency, *_ = onset(STUDY, settings, RATE_HZ, 8.0)
    points = branch(STUDY, settings, RATE_HZ, 1.02 * gain, onset_only=True)
    least, at_hz, _ = hb.fold(points)
    assert points[-1].gain > 1.02 * least, 'the branch goes round the fold'
    # The step may be too weak a kick just above the fold, never strong enough below it.
    assert 0.995 * gain < least * 1.03 and least < 1.005 * gain
    assert at_hz == pytest.approx(frequency, rel=0.01)


def test_cycle_attracts_by_its_multipliers_and_ever_less_towards_the_fold():
    near, far = (multipliers(
        STUDY, STUDY_CONTROLLER | {'gain': gain, 'reference.amplitude': 100.0}, RATE_HZ, hz)
                 for gain, hz in ((9.4, 92.5), (10.5, 90.0)))
    for found in (near, far):
        assert found[0] == pytest.approx(1.0, abs=0.02)
    assert far[1] < near[1] < 0.95


def test_the_search_from_a_gain_that_no_factor_raises_ends() -> None:
    assert onset({}, {'reference.amplitude': 1.0}, 1000.0, 5e-324, watched_s=0.1) is None
