"""What oscillates by itself, what dies out, and what the reference forces."""

import numpy as np
import pytest
from scipy.signal import butter, savgol_filter, sosfiltfilt

from asi_analysis.bags.run import Run
from asi_analysis.loop.closed_loop import simulate_loop
from asi_analysis.loop.simulation import step_run
from asi_analysis.measures.analysis import analyze
from asi_analysis.measures.oscillation import is_sustained, of_samples, oscillation

T = np.arange(5000) / 5000.0
STEP = np.where(T >= 0.05, 100.0, 0.0)


def swing(force, reference=STEP):
    noise = np.random.default_rng(3).normal(0.0, 0.5, T.size)
    return oscillation(Run(T, reference_n=reference, force_n=force + noise))


def nothing(found):
    return found.to_dict() == {'sustained': False, 'frequency_hz': None, 'amplitude_n': None}


def test_sine_is_found_exactly():
    found = swing(STEP + 40.0 * np.sin(2 * np.pi * 91.37 * T + 0.4))
    assert found.sustained is True
    assert found.frequency_hz == pytest.approx(91.37, abs=0.02)
    assert found.amplitude_n == pytest.approx(40.0, rel=0.01)


def test_a_torque_is_told_in_its_own_unit():
    torque = STEP + 40.0 * np.sin(2 * np.pi * 91.37 * T)
    units = {'signals': {'force': 'Nm', 'reference': 'Nm'}}
    text = str(analyze(Run(T, reference_n=STEP, force_n=torque, information=units)))
    assert '91.4 Hz, 40 Nm, sustained' in text and ' N\n' not in text


def test_lost_samples_at_the_end_are_no_change_of_the_reference():
    """The last answer of a run may be missing from its bag."""
    reference, force = STEP.copy(), STEP + 40.0 * np.sin(2 * np.pi * 91.37 * T)
    reference[-1] = force[-3] = np.nan
    assert swing(force, reference).sustained is True


def test_decaying_sine_is_not_sustained():
    found = swing(STEP + 100.0 * np.exp(-T / 0.5) * np.sin(2 * np.pi * 91.37 * T))
    assert found.sustained is False
    assert found.frequency_hz == pytest.approx(91.37, abs=0.3)


@pytest.mark.parametrize('force_n', [0.0, 42.1])
def test_force_that_does_not_move_is_no_oscillation(force_n):
    still = Run(T, reference_n=np.zeros(T.size), force_n=np.full(T.size, force_n))
    assert nothing(oscillation(still))


def test_noise_alone_is_no_oscillation():
    assert nothing(swing(STEP))


@pytest.mark.parametrize('frequency', [2.3, 17.0, 90.0])
def test_forced_sine_with_harmonics_is_not_self_sustained(frequency):
    angle = 2 * np.pi * frequency * T
    found = swing(90.0 * np.sin(angle - 0.7) + 9.0 * np.sin(3 * angle), 100.0 * np.sin(angle))
    assert found.sustained is False


@pytest.mark.parametrize('frequency', [2.0, 7.0])
def test_a_high_harmonic_of_the_reference_is_no_oscillation_of_its_own(frequency):
    corners = sum(30.0 / k * np.sin(2 * np.pi * k * frequency * T) for k in range(1, 40, 2))
    assert nothing(swing(corners, 100.0 * np.sin(2 * np.pi * frequency * T)))


def test_an_oscillation_at_a_harmonic_may_be_locked_to_the_reference():
    found = swing(90.0 * np.sin(14.0 * np.pi * T) + 30.0 * np.sin(182.0 * np.pi * T),
                  100.0 * np.sin(14.0 * np.pi * T))
    assert found.sustained is None and 'locked' in found.reason


def test_own_oscillation_on_top_of_a_forced_one():
    found = swing(90.0 * np.sin(2 * np.pi * 7.0 * T - 0.2) + 30.0 * np.sin(2 * np.pi * 88.0 * T),
                  100.0 * np.sin(2 * np.pi * 7.0 * T))
    assert found.sustained is True
    assert found.frequency_hz == pytest.approx(88.0, abs=0.1)
    assert found.amplitude_n == pytest.approx(30.0, rel=0.02)


def test_many_frequencies_in_the_reference_leave_it_open():
    chirp = 100.0 * np.sin(2 * np.pi * (5.0 + 40.0 * T) * T)
    found = swing(chirp, chirp)
    assert found.sustained is None
    assert 'reference' in found.reason


@pytest.mark.parametrize('gain, sustained', [(3.0, False), (10.5, True)])
def test_the_loop_itself(gain, sustained):
    run = simulate_loop({}, {'gain': gain, 'reference.shape': 'step'}, 1.0)
    assert oscillation(Run(*run)).sustained is sustained


def test_reference_of_two_sines_forces_what_cannot_be_told():
    reference = 50.0 * np.sin(2 * np.pi * 10.0 * T) + 25.0 * np.sin(2 * np.pi * 27.0 * T)
    found = swing(0.9 * reference, reference)
    assert found.sustained is None and 'many frequencies' in found.reason


@pytest.mark.parametrize('decay, sustained', [(0.0, True), (0.001, True), (0.004, False)])
def test_the_fast_measure_of_samples_is_that_of_recordings(decay, sustained):
    """Decay a period; both estimate the growth rate, and both decide by one bound."""
    frequency = 91.37
    force = 70.0 + np.exp(-decay * frequency * T) * (
        40.0 * np.sin(2 * np.pi * frequency * T + 1.0)
        + 2.0 * np.sin(6 * np.pi * frequency * T))
    fast = of_samples(force, 5000.0)
    slow = oscillation(Run(T, reference_n=np.zeros(T.size), force_n=force))
    assert fast.sustained is slow.sustained is sustained
    assert fast.growth_1_s == pytest.approx(-decay * frequency, abs=2e-3)
    assert slow.growth_1_s == pytest.approx(-decay * frequency, abs=2e-3)
    assert fast.frequency_hz == pytest.approx(frequency, rel=1e-5)
    assert slow.frequency_hz == pytest.approx(frequency, rel=1e-5)
    assert fast.thd == pytest.approx(0.05, rel=0.02)
    assert slow.thd == pytest.approx(0.05, rel=0.02)


def test_both_measures_agree_on_a_simulated_cycle():
    run = step_run({}, {'gain': 9.0, 'reference.amplitude': 100.0}, 5000.0)
    # The second half, which is what the other one measures: a cycle of 5 kHz over nearly a whole
    # number of samples beats with them, and its frequency swings by 3e-5.
    fast = of_samples(run.force_n[run.force_n.size // 2:], 5000.0)
    slow = oscillation(Run(*run))
    assert fast.sustained and slow.sustained
    assert fast.frequency_hz == pytest.approx(slow.frequency_hz, rel=1e-5)
    assert fast.amplitude_n == pytest.approx(slow.amplitude_n, rel=1e-3)
    assert fast.thd == pytest.approx(slow.thd, rel=0.01)


@pytest.mark.parametrize('growth, deviation, amplitude, expected', [
    (0.0, 0.0, 2.0, True), (-0.19, 0.0, 2.0, True), (-0.21, 0.0, 2.0, False),
    (-0.5, 0.2, 2.0, True), (0.0, 0.0, 0.9, False)])
def test_definition_of_sustained(growth, deviation, amplitude, expected):
    """At 100 Hz the bound is -0.2 1/s; an interval that reaches it is no decay."""
    assert is_sustained(growth, deviation, 50, 100.0, amplitude, 1.0) is expected


def test_what_creeps_is_no_oscillation_and_what_runs_away_is_sustained():
    assert nothing(of_samples(100.0 * (1.0 - np.exp(-T / 0.3)), 5000.0))
    assert of_samples(np.append(np.exp(700.0 * T), np.inf), 5000.0).sustained


def moved(gain, load, duration_s=3.0):
    """Return a run without a desired force whose piston is moved, or pushed, from outside."""
    information = {'actuator': load}
    return Run(*simulate_loop(load, {'gain': gain, 'reference.amplitude': 0.0}, duration_s),
               information=information)


MOTION = {'load.type': 'prescribed', 'load.velocity': 0.5, 'load.frequency': 2.0}


def test_what_a_prescribed_motion_drives_is_no_oscillation():
    assert nothing(oscillation(moved(3.0, MOTION)))


def test_a_loop_that_oscillates_only_while_it_is_moved_does_so_in_bursts():
    run = moved(5.5, MOTION)
    found = oscillation(run)
    assert found.sustained is None and '2 Hz' in found.reason
    slow = run.force_n[7500:] - savgol_filter(run.force_n[7500:], 167, 2)
    assert found.amplitude_n == pytest.approx(np.abs(slow).max(), rel=0.2)
    assert 'Hz, 24.2 N, in bursts' in str(analyze(run))
    short = oscillation(run[:5000])
    assert short.sustained is None and 'shorter than 2 periods' in short.reason


def test_a_nonlinear_response_to_two_drives_is_no_oscillation_for_sure():
    load = MOTION | {'load.velocity': 0.3}
    run = Run(*simulate_loop(load, {
        'gain': 0.5, 'reference.shape': 'sine', 'reference.amplitude': 200.0,
        'reference.frequency': 5.0}, 6.0), information={'actuator': load})
    found = oscillation(run)
    assert found.sustained is not True and (
        found.sustained is False or 'response to both' in found.reason)


def test_noise_that_rings_is_not_in_bursts():
    random = np.random.default_rng(5)
    ringing = sosfiltfilt(butter(1, [0.034, 0.04], 'bandpass', output='sos'),
                          random.standard_normal(T.size))
    assert oscillation(Run(T, reference_n=100.0 * np.sin(20.0 * np.pi * T), force_n=(
        90.0 * np.sin(20.0 * np.pi * T - 0.2) + 300.0 * ringing))).sustained is not None
