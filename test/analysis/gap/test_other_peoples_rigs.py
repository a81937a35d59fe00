"""Faults that recordings by others showed (doc/explanation/public_recordings.md), on our own."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from test_gap_joint import TWO_WAVES, joint

from asi_analysis.bags.run import Run
from asi_analysis.errors import InputWarning
from asi_analysis.gap.answer.command import diagnose
from asi_analysis.gap.inference import hypotheses
from asi_analysis.gap.inference.fit import fit_null
from asi_analysis.gap.model import gravity
from asi_analysis.gap.model.joint import drive_of, joint_groups
from asi_analysis.gap.model.rattling import is_closed, rattling_in
from asi_analysis.gap.motion import stands
from asi_analysis.gap.parts import balanced_split, reported
from asi_analysis.gap.sampling import noise_of


def pulse(count: int = 857) -> np.ndarray:
    """Return one pulse: an edge in each of two parts that would be for validation only."""
    return np.where((np.arange(count) > 253) & (np.arange(count) < 503), 0.4, 0.0)


def test_the_only_steps_of_an_input_are_fitted_and_used_for_model_selection():
    driving = pulse()
    fit, held = balanced_split(driving, 0.008)
    edges = np.flatnonzero(np.diff(driving))
    for part in (fit, held & ~reported(held)):
        assert any(part[edge:edge + 5].any() for edge in edges)
    assert reported(held).any()


def test_nothing_is_judged_before_the_first_fitted_sample():
    """How a recording began is not known there: a load that swings then was extrapolated."""
    time = 0.004 * np.arange(3000)
    fit, held = balanced_split((1.0 + time) * np.sin(time ** 2), 0.004)
    assert held[:np.argmax(fit)].sum() == 0 < np.argmax(fit)


@pytest.mark.slow
def test_the_response_of_a_servo_is_identified_from_its_only_pulse():
    driving, output = pulse(), np.zeros(857)
    speed = 0.0
    for k in range(1, driving.size):     # 3 Hz, damping ratio 0.3, at 125 Hz
        for _ in range(8):
            speed += 0.001 * (18.8 ** 2 * (driving[k - 1] - output[k]) - 11.3 * speed)
            output[k] += 0.001 * speed
        output[k:] = output[k]
    output += np.random.default_rng(3).normal(0.0, 1e-4, output.size)
    run = Run(0.008 * np.arange(driving.size), reference_n=driving, velocity_m_s=output,
              source='arm', information={'signals': {'reference': 'rad/s', 'velocity': 'rad/s'}})
    assert 'as a servo of second order: 3.0' in ' '.join(diagnose([run], plant='joint').notes)


@pytest.mark.parametrize(('share', 'none'), [(0.0, True), (0.007, True), (0.05, False)])
def test_a_backlash_of_its_smallest_width_is_none(share: float, none: bool):
    variant = rattling_in(None)[0]
    assert is_closed((variant,), variant.free, np.array([share, 0.5, 0.5])) == none


@pytest.mark.slow
def test_a_backlash_that_closes_at_last_is_no_hypothesis(monkeypatch: pytest.MonkeyPatch):
    # The cylinder again: where a pair lost its friction, what was left was backlash, 0.94.
    variant = rattling_in(None)[0]
    closed = hypotheses.Candidate(('backlash',), (variant,), SimpleNamespace(
        cost=0.0, free=variant.free, theta=np.array([0.007, 0.5, 0.5])))
    monkeypatch.setattr(hypotheses, '_pruned', lambda *_: {closed.names: closed})
    monkeypatch.setattr(hypotheses, 'SUFFICIENT', 0.0)   # pairs are tried, too
    run = joint(friction=0.3)
    group = joint_groups([run], {}, 0.2, [False], drive_of([run]))[0][0]
    found = hypotheses.candidates_of(group, fit_null(group))
    assert closed not in found.values() and ('coulomb_friction',) in found


@pytest.mark.slow
@pytest.mark.filterwarnings('ignore:.*the joint has gravity')
def test_a_third_run_of_a_machine_that_varies_is_no_change():
    # The friction of the two healthy runs differs by 5 %, that of the third by 5 % more.
    first, second, third = (joint(gravity=0.5, friction=friction, course=TWO_WAVES)
                            for friction in (0.1, 0.105, 0.11))
    answer = diagnose([third], plant='joint', baseline=[first, second])
    assert answer.baseline['change'] != 'changed'


def test_only_a_spring_alone_stands_in_the_place_of_gravity(monkeypatch):
    # It was said where gravity with a spring explained as much, as it does in noise.
    monkeypatch.setattr(gravity, 'INDEPENDENT', 0.0)
    run = joint(gravity=1.0)
    noise = np.random.default_rng(4).normal(0.0, 0.05, len(run))
    with pytest.warns(InputWarning, match='with it the model leaves .* without$'):
        diagnose([replace(run, command_n=run.command_n + noise)], plant='joint')


@pytest.mark.parametrize('creep', [0.0, 2e-5])
def test_a_standstill_is_seen_with_an_analog_sensor(creep: float):
    # A cylinder on a spring with 3 um of noise: its standstills were not left out, and the answer
    # was backlash, 97 %, or a delay of 30 ms, 89 %.
    period, rng = 0.005, np.random.default_rng(5)
    speed = np.where(np.arange(4000) % 1000 < 400, creep, 0.03 * np.sin(np.arange(4000) / 30.0))
    position = period * np.cumsum(speed) + rng.normal(0.0, 3e-6, 4000)
    found = stands(position, noise_of(position), period, 20.0)
    resting = np.arange(4000) % 1000 < 400
    assert found[resting].mean() > 0.98
    assert found[~resting].mean() < 0.2      # beside them, and where it turns
    noisy = position + rng.normal(0.0, 2e-4, 4000)
    assert not stands(noisy, noise_of(noisy), period, 20.0).any()


@pytest.mark.slow
def test_a_cylinder_on_a_spring_has_friction_alone():
    period, force = 0.005, np.empty(6000)
    time = period * np.arange(6000)
    force = 4800.0 + np.where(time < 15.0, 1600.0 * (np.abs(4.0 * (0.2 * time % 1.0) - 2.0) - 1.0),
                              800.0 * np.sin(np.pi * time) + 640.0 * np.sin(4.0 * np.pi * time))
    position, x, v = np.empty(6000), 0.12, 0.0
    for k in range(6000):
        position[k] = x
        for _ in range(50):
            push = force[k] - 4e4 * x - 900.0 * v
            # Implicit in the damping and the spring of the friction at rest.
            v += 1e-4 / 12.0 * (push - 250.0 * np.tanh(v / 1e-4)) / (
                1.0 + 1e-4 / 12.0 * 250.0 / 1e-4 * (1.0 - np.tanh(v / 1e-4) ** 2))
            x += 1e-4 * v
    rng = np.random.default_rng(3)
    run = Run(time, force_n=force + rng.normal(0.0, 5.0, 6000),
              position_m=position + rng.normal(0.0, 3e-6, 6000), source='cylinder')
    with pytest.warns(InputWarning, match='a spring holds the joint'):
        answer = diagnose([run], plant='joint')
    assert answer.verdict in ('coulomb_friction', 'stiction')
    assert {each['effect'] for each in answer.which if each['probability'] > 0.2} <= {
        'coulomb_friction', 'stiction', 'friction_asymmetry'}
    assert answer.which[0]['parameters']['friction_level'] == pytest.approx(250.0, rel=0.03)
    assert any('spring 4.0' in note or 'spring 3.9' in note for note in answer.notes)
