"""Forms of a joint's effects, alone: lost motion, a servo with a lag."""

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asi_analysis.bags.bag import write_bag
from asi_analysis.bags.run import Run
from asi_analysis.gap.answer.command import diagnose
from asi_analysis.gap.check.check import examine
from asi_analysis.gap.diagnose import diagnose as diagnosis_of
from asi_analysis.gap.model import blocks
from asi_analysis.gap.model.blocks import parts, seized, slide
from asi_analysis.gap.model.joint import IDEAL, joint_groups
from asi_analysis.gap.model.predict import plant_record, unexplained
from asi_analysis.gap.model.servo.identification import Servo, follow, servo_of, slow_servo
from asi_analysis.gap.model.servo.nominal import late_by
from asi_analysis.gap.prepare import Recording, prepare
from asi_common.jit import jit
from asi_common.parameter import Value

PERIOD_S = 0.004
TIME_S = PERIOD_S * np.arange(1500)
REFERENCE = sum(np.sin(2.0 * np.pi * f * TIME_S + f) for f in (0.3, 0.9, 1.7, 3.1))


def test_lost_motion_is_behind_the_servo():
    p = plant_record(IDEAL)
    p['valve_characteristic_full_opening'] = 1.0
    p['valve_lag'] = 0.05
    lagged, lost = np.empty((2, TIME_S.size))
    blocks.valve(REFERENCE, *blocks.parts(p), PERIOD_S, 1, lagged, blocks.AT_REST)
    p['loop_width'], p['loop_behind'] = 0.2, 1.0
    blocks.valve(REFERENCE, *blocks.parts(p), PERIOD_S, 1, lost, blocks.AT_REST)
    play = lagged.copy()
    for k in range(1, play.size):
        play[k] = min(max(play[k - 1], lagged[k] - 0.2), lagged[k] + 0.2)
    np.testing.assert_allclose(lost, play, atol=1e-12)


@pytest.mark.parametrize('true', [Servo(80.0, 0.7, lag=0.03), Servo(80.0, 0.7, delay=0.014)])
def test_servo_is_identified_with_what_makes_it_late(true):
    moved = follow(true, REFERENCE, REFERENCE[0], PERIOD_S)
    moved += np.random.default_rng(1).normal(0.0, 1e-4, moved.size)
    run = Run(TIME_S, reference_n=REFERENCE, position_m=moved, source='servo',
              information={'signals': {'reference': 'rad', 'position': 'rad'}})
    recordings = prepare([run], 'position', [False])
    found = servo_of(recordings, slow_servo(recordings))
    same = min(found, key=lambda each: abs(each.lag - true.lag) + abs(each.delay - true.delay))
    assert (same.lag, same.delay) == pytest.approx((true.lag, true.delay), abs=1e-3)
    assert same.pulsation == pytest.approx(80.0, rel=0.05)


@pytest.mark.slow
def test_a_slowly_sampled_servo_has_its_limits_and_its_delay():
    # A hobby servo at 50 Hz: between whole samples of delay the fit stayed, 6.9 % were left, and
    # the answer was unknown.
    rng = np.random.default_rng(3)
    time = 0.02 * np.arange(2500)
    reference = np.repeat(rng.uniform(-1.0, 1.0, 167), 15)[:2500]
    moved, position, speed, wanted = [], 0.0, 0.0, 0.0
    for k in range(2500):
        moved.append(position)
        for _ in range(40):
            push = 625.0 * (wanted - position) - 35.0 * speed
            speed = np.clip(speed + 0.0005 * np.clip(push, -52.0, 52.0), -5.2, 5.2)
            position += 0.0005 * speed
        wanted = reference[max(k - 1, 0)]
    run = Run(time, reference_n=reference, position_m=np.round(np.array(moved) / 0.0015) * 0.0015,
              source='servo', information={'signals': {'reference': 'rad', 'position': 'rad'}})
    answer = diagnose([run], plant='joint')
    assert answer.verdict == 'transport_delay'
    assert answer.which[0]['parameters']['command_delay'] == pytest.approx(0.04, abs=0.006)
    assert answer.gap['after_nrmse'] < 0.01
    limits = 'largest speed 5[.][12].* largest acceleration 5[12]'
    assert any(re.search(limits, note) for note in answer.notes)


@pytest.mark.slow   # test_an_arm_behind_a_spring_is_told_while_it_still_swings has a softer one
def test_a_stiff_coupling_is_found():
    # The load swings at 7 Hz; of the whole motion the coupling yields 0.3 %. "A disturbance and
    # something unknown", 0.86: the range of the compliance was far too wide for its size.
    rng, period, fine = np.random.default_rng(8), 0.002, 20
    time = period * np.arange(6000)
    command = sum(size * np.sin(2.0 * np.pi * f * time + 5.0 * f) for f, size in (
        (0.31, 3.0), (0.83, 2.0), (1.9, 1.5), (4.3, 1.0), (6.6, 0.5)))
    q, v, y, w, position = 0.0, 0.0, 0.0, 0.0, []
    for k in range(time.size):
        position.append(q)
        for _ in range(fine):
            coupling = 720.0 * (q - y) + 1.2 * (v - w)
            v += period / fine * (command[k] - 0.8 * v - coupling) / 0.4
            w += period / fine * (coupling - 0.7 * w) / 0.6
            q += period / fine * v
            y += period / fine * w
    run = Run(time, command_n=command, position_m=np.array(position) + rng.normal(
        0.0, 2e-5, time.size), source='table', information={
            'signals': {'command': 'Nm', 'position': 'rad'}})
    answer = diagnose([run], plant='joint')
    assert answer.verdict == 'load_compliance'
    assert answer.which[0]['parameters']['compliance'] == pytest.approx(1.0 / 720.0, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize(('share', 'verdict'), [
    (1.1, 'no_gap'), (0.5, 'coulomb_friction')])
def test_a_friction_that_is_given_has_a_tolerance(share: float, verdict: str):
    # A nominal friction off by 10 % was Coulomb friction, 0.84: it alone was taken as exact.
    rng, period, fine = np.random.default_rng(6), 0.004, 40
    time = period * np.arange(4000)
    command = 20.0 * np.sign(np.sin(2.0 * np.pi * 0.45 * time)) + 8.0 * np.sin(
        2.0 * np.pi * 1.3 * time)
    q, v, position = 0.0, 0.0, []
    for k in range(time.size):
        position.append(q)
        for _ in range(fine):
            after = v + period / fine * (command[k] - 30.0 * v - 6.0 * np.sign(
                v if v else command[k])) / 8.0
            v = 0.0 if v * after < 0.0 else after
            q += period / fine * v
    run = Run(time, command_n=command, position_m=np.array(position) + rng.normal(
        0.0, 1e-5, time.size), source='belt', information={
            'signals': {'command': 'N', 'position': 'm'}})
    model = {'plant': 'joint', 'load.mass': 8.0, 'load.damping': 30.0,
             'friction.coulomb': 6.0 * share}
    assert diagnose([run], model, 'joint').verdict == verdict


def elbow() -> Run:
    """Return the recording of an arm: inertia 0.5, damping 4, gravity 9 sin q."""
    rng, period, fine = np.random.default_rng(6), 0.004, 10
    time = period * np.arange(4000)
    command = 9.0 * np.sin(0.5) + 2.0 * np.sin(2.0 * np.pi * 0.3 * time) + np.sin(
        2.0 * np.pi * 1.7 * time)
    q, v, position = 0.5, 0.0, []
    for k in range(time.size):
        position.append(q)
        for _ in range(fine):
            v += period / fine * (command[k] - 4.0 * v - 9.0 * np.sin(q)) / 0.5
            q += period / fine * v
    return Run(time, command_n=command, position_m=np.array(position) + rng.normal(
        0.0, 1e-5, time.size), source='elbow', information={
            'signals': {'command': 'Nm', 'position': 'rad'}})


@pytest.mark.parametrize(('share', 'verdict'), [
    (1.1, 'no_gap'), pytest.param(0.6, 'gravity', marks=pytest.mark.slow)])
def test_gravity_that_is_given_has_a_tolerance(share: float, verdict: str):
    model = {'plant': 'joint', 'load.mass': 0.5, 'load.damping': 4.0, 'gravity.sine': 9.0 * share}
    assert diagnose([elbow()], model, 'joint').verdict == verdict


def test_a_check_reads_the_model_of_a_joint(tmp_path: Path):
    # It was read as an actuator's, and its gravity was ignored: "no gap", 0.91.
    write_bag(elbow(), tmp_path / 'elbow')
    (tmp_path / 'elbow.yaml').write_text(
        '/**:\n  ros__parameters:\n    plant: joint\n    load: {mass: 0.5, damping: 4.0}\n'
        '    gravity: {sine: 5.4}\n')
    row = examine(tmp_path, {'bag': 'elbow', 'plant': 'joint', 'model': 'elbow.yaml'})
    assert row['verdict'] == 'gravity'


@pytest.mark.parametrize('samples', [1, 5, 40])
def test_first_guess_of_a_drives_delay(samples: int):
    # With a noisy command each mean of two samples may be a local minimum of the fit: a delay was
    # a lag, 0.99.
    rng, period = np.random.default_rng(2), 0.002
    time = period * np.arange(3000)
    command = np.sin(2.0 * np.pi * 0.7 * time) + rng.normal(0.0, 0.3, time.size)
    force = np.append(np.full(samples, command[0]), command[:-samples])
    run = Run(time, command_n=command, force_n=force, source='drive', information={
        'signals': {'command': 'Nm', 'force': 'Nm'}})
    # The output of a sample answers the command of the one before.
    assert late_by(prepare([run], 'drive', [False])) == pytest.approx((samples - 1) * period)


@jit
def _sliding(force, friction, breakaway, stribeck, sub_steps, period, out):
    """Put into `out` the position (m) of a mass of 90 kg with stiction (Karnopp), N, m/s."""
    h, x, v = period / sub_steps, 0.0, 0.0
    for k in range(force.size):
        out[k] = x
        for _ in range(sub_steps):
            most = friction * (1.0 + breakaway * math.exp(-(v / stribeck) ** 2))
            if v == 0.0 and abs(force[k]) <= most:
                continue
            way = math.copysign(1.0, force[k] if v == 0.0 else v)
            after = v + h / 90.0 * (force[k] - 250.0 * v - way * most)
            v = 0.0 if v * after < 0.0 else after
            x += h * v


def test_friction_of_a_load_that_halts_for_a_moment_balances_the_force():
    # It halts for 30 ms at each turn; the residual of the true parameters was four times as large.
    period = 1e-3
    time, position = period * np.arange(12_000), np.empty(12_000)
    force = 70.0 * np.sin(2.0 * np.pi * 0.83 * time) + 40.0 * np.sin(2.0 * np.pi * 0.25 * time)
    _sliding(force, 20.0, 0.9, 0.005, 50, period, position)
    rng = np.random.default_rng(3)
    run = Run(time, command_n=force + rng.normal(0.0, 0.6, time.size),
              position_m=position + rng.normal(0.0, 5e-7, time.size), source='slide')
    groups, _ = joint_groups([run], {}, 0.2, [False], 'force')
    recording, p = groups[-1].recordings[0], groups[-1].nominal.copy()
    for name, value in (('load_mass', 90.0), ('load_damping', 250.0), ('drive_hold', 5e-4),
                        ('friction_level', 20.0), ('friction_breakaway', 0.9),
                        ('friction_stribeck', 0.005), ('friction_falling', 2.0),
                        ('friction_bristle', 1e-7), ('friction_rounding', 1.0)):
        p[name] = value

    def left(each: Recording) -> float:
        return float(np.std(unexplained(each, 'load', p)[each.valid]))

    motion = recording.moved
    moving = replace(recording, motion=motion.without_halts(), cache={})
    assert 0.02 < motion.halts.mean() < 0.2
    assert left(recording) < 0.4 * left(moving)


@pytest.mark.parametrize(('gain', 'verdict'), [(0.62, ('drive_gain',)), (0.9, ())])
def test_a_drive_that_makes_another_force_of_its_command(gain: float, verdict: tuple[str, ...]):
    # Its gain was identified, whatever it was; with a known mass the units are to be trusted.
    rng = np.random.default_rng(2)
    command = 3.0 * REFERENCE
    force, position = gain * command, np.empty(command.size)
    place, speed = 0.0, 0.0
    for k, push in enumerate(force):   # 0.5 kg, 2 Ns/m, a spring of 20 N/m
        position[k] = place
        for _ in range(20):
            speed += 0.05 * PERIOD_S / 0.5 * (push - 2.0 * speed - 20.0 * place)
            place += 0.05 * PERIOD_S * speed
    run = Run(TIME_S, command_n=command, force_n=force + rng.normal(0.0, 0.02, force.size),
              position_m=position + rng.normal(0.0, 1e-5, force.size), source='drive')
    known = {'load.mass': 0.5, 'load.damping': 2.0, 'load.stiffness': 20.0}
    found = diagnosis_of([run], known, 'joint')
    assert found.verdict == verdict
    if verdict:
        assert found.best(found.groups[0]).fitted.values[
            'valve_characteristic_gain'] == pytest.approx(gain, rel=0.01)


def test_a_gear_between_command_and_force_is_no_gain_of_the_drive():
    command = 3.0 * REFERENCE
    rng = np.random.default_rng(2)
    position = np.cumsum(np.cumsum(command)) * PERIOD_S ** 2
    run = Run(TIME_S, command_n=command, source='gear', position_m=position - position.mean(),
              force_n=10.0 * command + rng.normal(0.0, 0.2, command.size))
    groups, _ = joint_groups([run], {'load.mass': 10.0}, 0.2, [False], 'force')
    assert 'drive_gain' not in groups[0].effects
    assert groups[0].nominal['valve_characteristic_gain'] == pytest.approx(10.0, rel=0.01)


def test_a_small_saturation_of_a_clean_drive_is_found():
    # It leaves less of the force than the assumed model error of a drive, 3 %.
    rng = np.random.default_rng(4)
    command = 3.0 * REFERENCE
    answered = np.concatenate([command[:1], command[:-1]])   # in the sample after it
    force = np.clip(answered, -9.6, 9.6)
    run = Run(TIME_S, command_n=command, source='drive',
              force_n=force + rng.normal(0.0, 0.004, force.size))
    assert 0.005 < np.std(force - answered) / np.std(command) < 0.03
    found = diagnosis_of([run], {}, 'joint')
    assert found.verdict == ('valve_saturation',)
    assert found.joined[found.verdict] > 0.9


def test_a_rough_command_is_no_noise():
    # Friction of 2 % of a command that a noisy velocity makes rough was no gap, 0.5.
    rng = np.random.default_rng(5)
    command = 20.0 * REFERENCE + rng.normal(0.0, 1.0, TIME_S.size)
    position, place, speed = np.empty(command.size), 0.0, 0.0
    for k, push in enumerate(command):   # 2 kg, 30 Ns/m, 0.6 N of friction
        position[k] = place
        for _ in range(40):
            speed += 0.025 * PERIOD_S / 2.0 * (
                push - 30.0 * speed - 0.6 * math.tanh(speed / 1e-3))
            place += 0.025 * PERIOD_S * speed
    run = Run(TIME_S, command_n=command, source='slide',
              position_m=position + rng.normal(0.0, 1e-6, command.size))
    found = diagnosis_of([run], {}, 'joint')
    assert found.verdict == ('coulomb_friction',)


@pytest.mark.parametrize('rounding', [0.0, 0.5, 1.0])
def test_asymmetric_friction_is_as_stiff_one_way_as_the_other(rounding: float):
    # As that of the simulator: it slides at other forces, hence at other deflections.
    p = plant_record({})
    for name, value in (('friction_level', 10.0), ('friction_bristle', 1e-3),
                        ('friction_rounding', rounding), ('friction_asymmetry', 0.5)):
        p[name] = value
    e = parts(p)[1]

    def forces(moved: float) -> list[float]:
        elements, reach = seized(e)
        return [slide(elements, reach, moved, 0.0, e) for _ in range(3000)]

    up, down = forces(1e-5), forces(-1e-5)
    assert up[0] == pytest.approx(-down[0], rel=0.03)
    assert (up[-1], down[-1]) == (pytest.approx(15.0), pytest.approx(-5.0))


def test_creeping_friction_rises_with_the_velocity_and_has_no_memory():
    p = plant_record({})
    for name, value in (('friction_level', 10.0), ('friction_creep', 0.05)):
        p[name] = value

    def force(velocity: float) -> float:
        e = parts(p)[1]
        return float(slide(*seized(e), 1e-3, velocity, e))

    assert force(0.0) == 0.0 and force(0.05) == -force(-0.05) == pytest.approx(
        10.0 * math.tanh(1.0))
    p['friction_asymmetry'] = 0.5
    assert (force(1.0), force(-1.0)) == (pytest.approx(15.0), pytest.approx(-5.0))
    p['friction_asymmetry'], p['friction_breakaway'], p['friction_stribeck'] = 0.0, 1.0, 0.3
    assert force(0.15) > 15.0 and force(3.0) == pytest.approx(10.0, 1e-3)


@pytest.mark.parametrize('given', [{}, {'friction.model': 'full', 'friction.coulomb': 1.0}])
def test_how_a_given_friction_begins_to_slide_is_no_effect(given: dict[str, Value]):
    run = Run(TIME_S, command_n=REFERENCE, position_m=0.1 * REFERENCE, source='joint',
              information={'signals': {'command': 'N', 'position': 'm'}})
    groups, _ = joint_groups([run], given, 0.2, [False], 'force')
    creeping = [form for forms in groups[-1].effects.values() for form in forms
                if 'friction_creep' in form.fields]
    assert bool(creeping) == (not given)
