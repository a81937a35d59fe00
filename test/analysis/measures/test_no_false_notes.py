"""Recordings of healthy machines of others: nothing is noted that is not true."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import asi_analysis as asi
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.loop.in_process import simulate
from asi_analysis.measures.quality import findings

SERVO = {'signals': {'reference': 'rad', 'position': 'rad', 'velocity': 'rad/s', 'command': 'Nm'}}


def a_servo(reference: np.ndarray, rate_hz: float, bandwidth_hz: float = 2.0, *,
            resolution: float = 0.0, friction: float = 0.0, integral: float = 0.0,
            limit: float = np.inf, start: float = 0.0) -> Run:
    """Return a mass of 1 kg m2 whose controller has its velocity, from a sensor of its own."""
    w, substeps = 2.0 * np.pi * bandwidth_hz, 40
    x, v, summed, rows = start, 0.0, 0.0, []
    for wanted in reference:
        seen = round(x / resolution) * resolution if resolution else x
        summed += integral * w**3 * (wanted - seen) / rate_hz
        u = float(np.clip(w * w * (wanted - seen) - 1.4 * w * v + summed, -limit, limit))
        rows.append((seen, v, u))
        for _ in range(substeps):
            v += (u - friction * np.tanh(1e3 * v)) / rate_hz / substeps
            x += v / rate_hz / substeps
    x_, v_, u_ = np.array(rows).T
    return Run(np.arange(len(reference)) / rate_hz, reference, u_, None, None, x_, v_,
               information=SERVO)


def doubtful(run: Run) -> list[str]:
    return [each.text for each in findings(run) if each.severity == 'doubtful']


def of(rate_hz: float, seconds: float = 6.0) -> np.ndarray:
    return np.arange(int(rate_hz * seconds)) / rate_hz


CHIRP = np.sin(2.0 * np.pi * (0.2 * of(125.0, 3.0) + 1.3 * of(125.0, 3.0)**2))
STEPS = 0.5 * np.round(3.0 * np.sin(of(30.0)))


@pytest.mark.parametrize('run', [
    a_servo(CHIRP, 125.0), a_servo(CHIRP, 125.0, friction=0.1), a_servo(CHIRP, 125.0, limit=30.0),
    a_servo(CHIRP, 125.0, integral=0.1), a_servo(STEPS, 30.0), a_servo(STEPS, 30.0, integral=0.1),
    a_servo(STEPS, 30.0, integral=0.1, friction=2.0),
    a_servo(np.sin(of(500.0)), 500.0, friction=0.5, resolution=1e-6),
    a_servo(np.clip(of(500.0, 3.0) - 0.2, 0.0, 1.0), 500.0, resolution=5e-5)])
@pytest.mark.parametrize('with_velocity', [True, False])
def test_a_controller_that_differentiates_is_not_accused(run: Run, with_velocity: bool) -> None:
    """It was: of a wrong unit, of a position that is recorded late, of lost samples."""
    assert doubtful(run if with_velocity else replace(run, velocity_m_s=None)) == []


def test_a_signal_that_starts_late_has_no_spike_where_the_cause_is_not_recorded() -> None:
    t = of(500.0, 1.0)
    reference = np.where(t < 0.1, 0.0, 50.0)
    noise = 0.05 * np.random.default_rng(1).normal(size=len(t))
    force, rows = 0.0, []
    for k, wanted in enumerate(reference):     # a controller with a derivative of its reference
        u = wanted + 1.5 * (wanted - reference[max(k - 1, 0)])
        rows.append((force + noise[k], u))
        force += 0.3 * (u - force)
    force_n, command_n = np.array(rows).T
    known = np.where(t < 0.15, np.nan, reference)
    run = Run(t, known, command_n, force_n)
    assert doubtful(run) == []
    spoilt = run.signal('force').copy()
    spoilt[80] += 60.0
    assert any('spike' in text for text in doubtful(replace(run, force_n=spoilt)))


def test_a_reference_that_rests_has_no_size_to_compare_with() -> None:
    rest = np.full(1000, 0.1 + 0.2)     # its standard deviation is a rounding error
    assert doubtful(a_servo(rest, 500.0)) == []


def test_a_loop_that_settles_below_its_reference_is_not_in_another_unit() -> None:
    t = of(1000.0, 1.0)
    noise = 0.01 * np.random.default_rng(2).normal(size=len(t))
    droop = Run(t, np.full(len(t), 50.0), None, 25.0 + noise)
    assert doubtful(droop) == []
    assert doubtful(replace(droop, force_n=75.0 + noise)) != []
    assert doubtful(replace(droop, force_n=1e-3 * droop.force_n)) != []    # kN
    assert doubtful(replace(droop, force_n=0.1 * droop.force_n)) != []


def test_a_loop_that_begins_far_from_its_reference_does_not_jump() -> None:
    t = of(2000.0, 1.0)
    begun = 0.999 * (1.0 - np.exp(-t / 1.5e-3)) + 1e-4 * np.random.default_rng(3).normal(
        size=len(t))
    assert doubtful(Run(t, np.ones(len(t)), None, begun)) == []


def test_samples_that_are_late_are_not_missing() -> None:
    t = of(250.0)
    rng = np.random.default_rng(4)
    run = Run(t + 0.15 / 250.0 * np.abs(rng.normal(size=len(t))), np.sin(t), None, np.sin(t - 0.1))
    late = run.time_s.copy()
    late[700] += 0.9 / 250.0
    for each in (run, replace(run, time_s=late)):
        assert {found.kind for found in findings(each)} == {'jitter'}
    lost = np.arange(len(t)) != 700
    gone = Run(run.time_s[lost], np.sin(t[lost]), None, np.sin(t[lost] - 0.1))
    assert 'gap' in {found.kind for found in findings(gone)}


def test_uneven_samples_are_noted() -> None:
    t = of(250.0)
    rng = np.random.default_rng(5)
    found, = findings(Run(t + 0.2 / 250.0 * rng.normal(size=len(t)), None, None, np.sin(t)))
    assert (found.kind, found.severity) == ('jitter', 'note')
    assert 'unevenly spaced' in found.text


@pytest.mark.parametrize(('resolution_ms', 'severities'), [
    (0.1, set()), (0.5, set()), (0.12, {'doubtful'}), (0.3, {'doubtful'}), (0.7, {'doubtful'}),
    (1.1, {'doubtful'})])
def test_a_time_that_is_rounded_to_no_divisor_of_the_period_is_doubtful(
        resolution_ms: float, severities: set[str]) -> None:
    """Most samples are then 0.9 ms apart, or 0.7 ms, and the rate is another."""
    t = of(1000.0, 1.0)
    rounded = resolution_ms * np.round(1e3 * t / resolution_ms) / 1e3
    found = findings(Run(rounded, None, None, np.sin(20.0 * t)))
    assert {each.severity for each in found if each.signal == 'time'} == severities


@pytest.mark.parametrize('analysis', [
    asi.analyze, asi.step_response, asi.detect_limit_cycles])
def test_a_time_that_is_rounded_to_four_periods_has_no_rate(
        analysis: Callable[[Run], object]) -> None:
    t = of(1000.0, 1.5)
    run = Run(0.004 * np.round(t / 0.004), 0.0 * t, None, np.sin(500.0 * t))
    with pytest.raises(InputError, match='in bursts'):
        analysis(run)


@pytest.mark.parametrize(('share', 'jitter', 'noted'), [
    (1.1, 0.0, True), (0.8, 0.0, True), (1.1, 0.002, True), (1.005, 0.0, False),
    (1.1, 0.05, False)])
def test_a_period_that_changes_for_good_is_noted(share: float, jitter: float, noted: bool) -> None:
    steps = np.repeat([1.0, share], [400, 600]) / 250.0
    steps *= 1.0 + jitter * np.random.default_rng(6).normal(size=len(steps))
    t = np.cumsum(steps)
    told = [found.text for found in findings(Run(t, None, None, np.sin(3.0 * t)))
            if 'ms apart up to' in found.text]
    assert len(told) == noted
    assert not told or 'ms apart up to 1.6 s, ' in told[0]


@pytest.mark.parametrize('resolution', [2.0 * np.pi / 4096, 1e-5])
@pytest.mark.parametrize('filtered', [1, 5, 40])
def test_an_encoder_neither_jumps_nor_freezes_where_the_joint_rests(
        resolution: float, filtered: int) -> None:
    """Also with a velocity that is filtered, so that it comes late."""
    t = of(500.0, 3.0)
    wanted = np.where(t < 0.01, 0.0, np.clip((t - 0.01) * 20.0, 0.0, 1.0)) + np.where(
        t > 1.5, 0.05 * (t - 1.5), 0.0)
    run = a_servo(wanted, 500.0, 20.0, resolution=resolution)
    speed = np.diff(run.signal('position'), prepend=0.0) * 500.0
    smooth = np.convolve(speed, np.ones(filtered) / filtered)[:len(t)]
    kinds = {each.kind for each in findings(replace(run, velocity_m_s=smooth))}
    assert kinds <= {'quantisation'}    # true of the speed


def test_a_motion_that_goes_on_at_the_end_has_no_spike() -> None:
    t = of(100.0)
    swing = 0.05 * np.sin(2.0 * np.pi * 4.7 * t)
    for end in range(560, 600):
        run = Run(t[:end], 0.0 * t[:end], None, None, None, swing[:end], information={
            'signals': {'reference': 'm'}})
        assert doubtful(run) == []


@pytest.mark.parametrize('controller', [
    {'compensator': 'lead4', 'reference.amplitude': 30.0, 'gain': 0.5},
    {'compensator': 'lead2', 'reference.amplitude': 200.0, 'gain': 5.0}])
@pytest.mark.parametrize('rate_hz', [400.0, 800.0, 3000.0])
def test_a_free_piston_alone_has_no_spike_where_it_is_pushed(
        controller: dict[str, float], rate_hz: float) -> None:
    """Without reference and command the motion that was recorded with it explains the force."""
    run = simulate({'load.type': 'free'}, controller, 0.6, rate_hz)
    alone = replace(run, information={}, reference_n=None, command_n=None)
    assert doubtful(alone) == []
    longer = replace(simulate({'load.type': 'free'}, controller, 1.6, rate_hz), information={},
                     reference_n=None, command_n=None)
    force = longer.signal('force').copy()
    force[len(force) // 2] += 3.0 * np.ptp(force)
    assert any('spike' in text for text in doubtful(replace(longer, force_n=force)))


def test_a_free_piston_is_not_in_another_unit() -> None:
    run = simulate({'load.type': 'free', 'load.mass': 2.0}, {
        'compensator': 'lead4', 'reference.shape': 'ramp', 'reference.amplitude': 100.0,
        'feedforward': 1.0, 'notch.frequency': 90.0, 'notch.depth': 0.1}, 1.0, 3000.0)
    assert findings(Run(run.time_s, run.reference_n, None, run.force_n)) == []


def test_a_chirp_up_to_half_the_rate_has_no_spikes() -> None:
    run = simulate({'load.type': 'free'}, {
        'compensator': 'lead4', 'reference.shape': 'chirp', 'reference.amplitude': 100.0,
        'reference.offset': 50.0}, 1.0, 800.0)
    assert findings(run) == []
    reference = run.signal('reference').copy()
    for place in (100, 790):    # also where it is fast
        spoilt = reference.copy()
        spoilt[place] = 1e4
        assert any(each.kind == 'spike' for each in findings(replace(run, reference_n=spoilt)))


def test_a_step_among_late_states_is_not_a_late_reference() -> None:
    """In real time a state that comes late has the command of the one before; recorded here."""
    time, reference, command, force = np.loadtxt(
        Path(__file__).with_name('late_states.csv.gz'), delimiter=',', skiprows=1).T
    run = Run(time, reference, command, force)
    assert [each.kind for each in findings(run)] == ['gap']
