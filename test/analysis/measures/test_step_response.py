"""The step metrics against closed forms, and honest where there is nothing to measure."""

import math

import numpy as np
import pytest
from scipy import optimize

from asi_analysis.bags.run import Run
from asi_analysis.measures.analysis import analyze
from asi_analysis.measures.step_response import largest_step, step_responses

RATE_HZ = 5000.0


def second_order(t, zeta, w):
    """Return the unit step response of w^2/(s^2 + 2 zeta w s + w^2), zeta < 1, at times t (s)."""
    wd = w * math.sqrt(1.0 - zeta**2)
    y = 1.0 - np.exp(-zeta * w * t) * (np.cos(wd * t) + zeta * w / wd * np.sin(wd * t))
    return np.where(t < 0.0, 0.0, y)


def step_run(shape, start_s=0.05, duration_s=1.0, initial=0.0, final=100.0, noise=0.0):
    """Return a run whose reference steps at start_s and whose force answers with `shape`(t)."""
    t = np.arange(round(duration_s * RATE_HZ)) / RATE_HZ
    reference = np.where(t >= start_s, final, initial)
    force = initial + (final - initial) * shape(t - start_s)
    force = force + np.random.default_rng(7).normal(0.0, noise, t.size)
    return Run(t, reference_n=reference, force_n=force, source='synthetic')


def exact_rise(zeta, w):
    """Return the 10 to 90 % rise time of the closed form, by root finding."""
    peak = math.pi / (w * math.sqrt(1.0 - zeta**2))

    def crossing(level):
        return optimize.brentq(lambda t: float(second_order(t, zeta, w)) - level, 0.0, peak)

    return crossing(0.9) - crossing(0.1)


def exact_settling(zeta, w, band):
    """Return when the closed form enters the band for good, from a fine grid."""
    t = np.linspace(0.0, 20.0 / (zeta * w), 2_000_001)
    return t[np.flatnonzero(np.abs(second_order(t, zeta, w) - 1.0) > band)[-1]]


@pytest.mark.parametrize('zeta, w', [(0.2, 300.0), (0.456, 100.0), (0.7, 900.0)])
@pytest.mark.parametrize('initial, final', [(0.0, 100.0), (300.0, -250.0)])
def test_second_order_closed_form(zeta, w, initial, final):
    step = largest_step(step_responses(step_run(
        lambda t: second_order(t, zeta, w), initial=initial, final=final)))
    overshoot = 100.0 * math.exp(-math.pi * zeta / math.sqrt(1.0 - zeta**2))
    assert step.rise_time_s == pytest.approx(exact_rise(zeta, w), abs=0.05 / RATE_HZ)
    assert step.overshoot_percent == pytest.approx(overshoot, abs=0.15)
    for found, band in ((step.settling_time_2_s, 0.02), (step.settling_time_5_s, 0.05)):
        assert found == pytest.approx(exact_settling(zeta, w, band), abs=0.05 / RATE_HZ)
    assert step.steady_state_error_n == pytest.approx(0.0, abs=1e-6)
    assert step.monotone_rise


def test_steady_state_error_and_levels_of_what_is_reached():
    """A loop that ends 6 N short: the error is 6 N, the rise that of the force reached."""
    step = largest_step(step_responses(step_run(lambda t: 0.94 * second_order(t, 0.456, 100.0))))
    assert step.steady_state_error_n == pytest.approx(6.0, abs=1e-6)
    assert step.rise_time_s == pytest.approx(exact_rise(0.456, 100.0), rel=2e-3)


def test_noise_moves_the_metrics_little():
    clean, noisy = (largest_step(step_responses(step_run(
        lambda t: second_order(t, 0.456, 100.0), noise=noise))) for noise in (0.0, 1.0))
    assert noisy.rise_time_s == pytest.approx(clean.rise_time_s, rel=0.03)
    assert noisy.overshoot_percent == pytest.approx(clean.overshoot_percent, abs=1.0)
    assert noisy.settling_time_5_s == pytest.approx(clean.settling_time_5_s, rel=0.05)
    assert noisy.monotone_rise


def test_noise_wider_than_the_band_is_no_settling_time():
    step = largest_step(step_responses(step_run(lambda t: second_order(t, 0.456, 1000.0),
                                            noise=4.0)))
    assert step.settling_time_2_s is None
    assert any('2 %' in note and 'noise' in note for note in step.notes)


@pytest.mark.parametrize('shape, name', [
    # A jump to 85 % that creeps on; a spike that dips before the slow rise; one past the end.
    (lambda t: np.where(t < 0, 0.0, 1 - 0.15 * np.exp(-t / 0.05) - 0.85 * np.exp(-t / 0.0005)),
     'creep'),
    (lambda t: np.where(t < 0, 0.0, 1 - np.exp(-t / 0.05) + 0.8 * np.exp(-t / 0.008)
                        - 0.8 * np.exp(-t / 0.001)), 'dip'),
    (lambda t: np.where(t < 0, 0.0, 1 - np.exp(-t / 0.05) + 1.6 * np.exp(-t / 0.008)
                        - 1.6 * np.exp(-t / 0.001)), 'spike'),
])
def test_artefacts_are_not_called_a_rise(shape, name):
    step = largest_step(step_responses(step_run(shape)))
    assert step.rise_shape == name
    assert step.monotone_rise is False
    assert any(name in note for note in step.notes)


def test_every_step_is_measured_and_the_largest_leads():
    t = np.arange(10000) / RATE_HZ
    reference = np.select([t < 0.5, t < 1.0, t < 1.5], [0.0, 100.0, -50.0], 0.0)
    force = sum(size * second_order(t - start, 0.5, 300.0)
                for start, size in ((0.5, 100.0), (1.0, -150.0), (1.5, 50.0)))
    steps = step_responses(Run(t, reference_n=reference, force_n=force))
    assert [(step.time_s, step.initial_n, step.final_n) for step in steps] == [
        (0.5, 0.0, 100.0), (1.0, 100.0, -50.0), (1.5, -50.0, 0.0)]
    assert largest_step(steps) == steps[1]
    for step in steps:
        assert step.rise_time_s == pytest.approx(exact_rise(0.5, 300.0), rel=3e-3)


@pytest.mark.parametrize('reference', [
    lambda t: np.full_like(t, 5.0),
    lambda t: 100.0 * np.sin(2 * np.pi * 120.0 * t),
    lambda t: np.clip((t - 0.1) * 1000.0, 0.0, 100.0),
])
def test_no_step_no_figures(reference):
    t = np.arange(5000) / RATE_HZ
    answer = analyze(Run(t, reference_n=reference(t), force_n=0.9 * reference(t)))
    assert answer['rise_time_s'] is None
    assert answer['steps'] == []
    assert 'step: the reference has no step' in answer['notes']


def test_lost_samples_do_not_matter():
    whole = step_run(lambda t: second_order(t, 0.456, 100.0))
    force, reference = whole.force_n.copy(), whole.reference_n.copy()
    force[np.arange(13, force.size, 29)] = np.nan
    reference[np.arange(11, reference.size, 31)] = np.nan
    holes = largest_step(step_responses(Run(whole.time_s, reference_n=reference, force_n=force)))
    assert holes.rise_time_s == pytest.approx(exact_rise(0.456, 100.0), rel=5e-3)
    assert holes.settling_time_2_s == pytest.approx(exact_settling(0.456, 100.0, 0.02), rel=5e-3)


@pytest.mark.parametrize(('every', 'resolved'), [(20, True), (120, False)])
def test_a_rise_between_two_samples_is_doubtful(every, resolved):
    run = step_run(lambda t: second_order(t, 0.5, 100.0), start_s=0.12)
    found = analyze(Run(run.time_s[::every], reference_n=run.reference_n[::every],
                        force_n=run.force_n[::every]))
    assert found.reliable['rise_time_s'] is resolved
    assert found.reliable['overshoot_percent']
    assert [note for note in found.notes if 'samples are 24 ms apart' in note] == (
        [] if resolved else ['rise: doubtful, because the samples are 24 ms apart'])


def test_a_force_that_has_risen_when_its_reference_jumps_has_no_reliable_response():
    """Of a rise of 0 s, that is: 90 % are reached in the first sample, as rows are left out."""
    run = step_run(lambda t: second_order(t, 0.456, 100.0), noise=0.3)
    kept = np.ones(len(run), bool)
    kept[240:400] = False
    found = analyze(Run(np.arange(kept.sum()) / RATE_HZ, reference_n=run.reference_n[kept],
                        force_n=run.force_n[kept]))
    assert found.rise_time_s == 0.0 and found.bandwidth_hz is None
    assert not any(found.reliable[name] for name in (
        'rise_time_s', 'overshoot_percent', 'settling_time_2_s', 'bandwidth_hz'))
    assert 'has risen within the sample at which the reference jumps' in found.notes[0]


@pytest.mark.parametrize('lost', [slice(250, None), slice(250), slice(3000, None)])
def test_a_step_without_a_force_before_it_or_after_it_is_not_measured(lost):
    run = step_run(lambda t: second_order(t, 0.456, 100.0))
    force = run.force_n.copy()
    force[lost] = np.nan
    found = analyze(Run(run.time_s, reference_n=run.reference_n, force_n=force))
    assert found.rise_time_s is None
    assert any('missing before the step or at its end' in note for note in found.notes)
