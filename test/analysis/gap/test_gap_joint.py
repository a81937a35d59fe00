"""Joints that turn, simulated by other equations than the diagnosis: LuGre friction, a hold."""

import contextlib
import dataclasses
import math
import re
import warnings

import numba
import numpy as np
import pytest
from scipy.signal import lfilter

from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError, InputWarning
from asi_analysis.gap.answer import report
from asi_analysis.gap.answer.command import diagnose as asked
from asi_analysis.gap.diagnose import diagnose
from asi_analysis.gap.document import document
from asi_analysis.gap.experiment.next_motion import CATALOGUE, choose_motion, simulated
from asi_analysis.gap.inference.initial_guesses import _pulse
from asi_analysis.gap.model.blocks import PLANT_DTYPE, swing
from asi_analysis.gap.model.gravity import ByPosition, by_position
from asi_analysis.gap.prepare import prepare

RATE_HZ, SUB_STEPS = 500.0, 40
INERTIA, DAMPING = 0.02, 0.05       # kg m2, N m s/rad
PENDULUM = {'signals': {'position': 'rad', 'command': 'Nm'}}


@numba.njit(cache=True)
def _joint(reference, friction, breakaway, uneven, late, gravity, teeth, load, bristle_rad,
           out):
    """
    Put command (N m) and position (rad) of a joint under a PD loop into out (2 x n).

    load: N m, n samples.
    """
    step = 1.0 / RATE_HZ / SUB_STEPS
    angle, speed, bristle, before, rate = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(reference.size):
        rate += 0.5 * ((angle - before) * RATE_HZ - rate)
        before = angle
        out[0, k] = 20.0 * (reference[k] - angle) - 0.9 * rate
        out[1, k] = angle
        for j in range(SUB_STEPS):
            # Held, and `late` sub-steps late.
            torque = out[0, max(k + (j - late) // SUB_STEPS, 0)]
            slope = 0.0
            if friction > 0.0:
                level = friction * (1.0 + (breakaway - 1.0) * np.exp(-(speed / 0.1) ** 2))
                level *= 1.0 + uneven * np.sign(speed)
                slope = speed - friction / bristle_rad * abs(speed) / level * bristle
                bristle += step * slope
            friction_torque = friction / bristle_rad * bristle + 0.02 * slope * (friction > 0.0)
            speed += step / INERTIA * (torque - DAMPING * speed - friction_torque
                                       - gravity * np.sin(teeth * angle) - load[k])
            angle += step * speed


TIME_S = np.arange(int(16.0 * RATE_HZ)) / RATE_HZ
WITH_RESTS = (0.8 * np.sin(2.0 * np.pi * 0.3 * TIME_S) ** 3
              + 0.2 * np.sin(2.0 * np.pi * 1.7 * TIME_S))
TWO_WAVES = 0.6 * np.sin(2.0 * np.pi * 0.4 * TIME_S) + 0.2 * np.sin(2.0 * np.pi * 2.3 * TIME_S)


def joint(friction: float = 0.0, breakaway: float = 1.0, late_s: float = 0.0,
          gravity: float = 0.0, teeth: float = 1.0, uneven: float = 0.0,
          offset: float | np.ndarray = 0.0, course: np.ndarray = WITH_RESTS,
          bristle_rad: float = 1e-3) -> Run:
    """Return 16 s of the joint on a smooth course, read by a 14 bit encoder."""
    out = np.empty((2, course.size))
    _joint(course, friction, breakaway, uneven, round(late_s * RATE_HZ * SUB_STEPS), gravity,
           teeth, offset + np.zeros(course.size), bristle_rad, out)
    count = 2.0 * np.pi / 2 ** 14
    return Run(TIME_S, command_n=out[0], position_m=count * np.round(out[1] / count),
               source='joint', information=PENDULUM)


def test_rigid_joint_has_no_gap():
    answer = document(diagnose([joint()], {}, 'joint'))
    assert answer['verdict'] == 'no_gap'
    assert answer['nuisance']['load']['load_mass'] == pytest.approx(INERTIA, rel=0.02)
    assert answer['nuisance']['load']['load_damping'] == pytest.approx(DAMPING, rel=0.05)


def test_friction_of_a_joint_that_turns(monkeypatch, tmp_path):
    run = joint(friction=0.15)
    diagnosis = diagnose([run], {}, 'joint')
    answer = document(diagnosis)
    # The report's pictures are in its units.
    drawn = {}
    monkeypatch.setattr(report, 'write_report',
                        lambda out, template, pictures, **_: drawn.update(pictures))
    report.write_gap_report(diagnosis, answer, tmp_path)
    above, below = drawn['overlay'][0].axes
    assert above.get_ylabel() == 'command' and below.get_ylabel() == 'difference'
    assert [each.yaxis.get_major_formatter().unit for each in (above, below)] == ['Nm', 'Nm']
    assert answer['which'][0]['units']['friction_level'] == 'Nm'
    assert answer['which'][0]['effect'] == 'coulomb_friction'
    assert 'coulomb_friction' in answer['ambiguity_set']
    assert answer['where'][0]['block'] == 'mechanics'
    assert answer['which'][0]['parameters']['friction_level'] == pytest.approx(0.15, rel=0.05)
    # What to record next is a motion that the joint can do.
    separations = choose_motion(diagnosis.groups, [('coulomb_friction',), ('stiction',)])[
        'separations']
    assert max(separations.values()) > 5.0 * min(separations.values())
    group = diagnosis.groups[0].group
    known = group.recordings[0].motion
    for name in CATALOGUE:
        moved = simulated(group, name)[0].motion
        for here, there in ((moved.position, known.position), (moved.velocity, known.velocity)):
            assert np.ptp(here[moved.pad:-moved.pad]) < 1.1 * np.ptp(there), name


def test_late_command_of_a_joint():
    answer = document(diagnose([joint(late_s=0.012)], {}, 'joint'))
    assert answer['verdict'] == 'transport_delay'
    # A hold adds half a sample, which is the nominal model's.
    assert answer['which'][0]['parameters']['drive_delay'] == pytest.approx(0.012, abs=0.0015)


@pytest.mark.slow
def test_what_no_effect_explains_is_described():
    """Teeth are in no effect of the vocabulary: what is left is a function of the position."""
    answer = document(diagnose([joint(gravity=0.3, teeth=9.0)], {}, 'joint'))
    assert answer['unknown_probability'] > 0.5
    period, = re.findall(r'function of the position, a ripple with a period of (\S+) rad',
                         answer['unexplained'])
    assert float(period) == pytest.approx(2.0 * np.pi / 9.0, rel=0.03)


@pytest.mark.parametrize(('friction', 'turned'), [
    (0.15, 0.6), pytest.param(0.0, 0.0, marks=pytest.mark.slow)])
def test_gravity_is_of_the_nominal_joint_and_friction_is_found_beside_it(friction, turned):
    run = joint(gravity=1.0, friction=friction)
    if turned:    # the encoder's zero is anywhere
        run = dataclasses.replace(run, position_m=run.position_m + turned)
    with pytest.warns(InputWarning, match='the joint has gravity'):
        answer = asked([run], plant='joint').to_dict()
    text = next(note for note in answer['notes'] if 'nominal joint' in note)
    size, zero = (float(each) for each in re.findall(
        r'gravity (\S+) Nm .* less (\S+) deg', text)[0])
    assert size == pytest.approx(1.0, rel=0.01)
    assert zero == pytest.approx(math.degrees(turned), abs=1.0)
    assert answer['verdict'] == ('coulomb_friction' if friction else 'no_gap')
    assert answer['nuisance']['load']['load_mass'] == pytest.approx(INERTIA, rel=0.02)
    if friction:
        assert answer['which'][0]['parameters']['friction_level'] == pytest.approx(0.15, rel=0.05)


def at_steps(seed: int) -> np.ndarray:
    """Return a course of 16 levels, one a second."""
    levels = np.repeat(np.random.default_rng(seed).uniform(-0.8, 0.8, 16), TIME_S.size // 16)
    return lfilter([0.03], [1.0, -0.97], lfilter([0.03], [1.0, -0.97], levels))


@pytest.mark.slow   # test_pulse_is_found_beside_a_worse_start has its end
@pytest.mark.parametrize(('start', 'end'), [(4.1, 9.0), (5.3, 8.0)])
def test_a_pulse_begins_and_ends_when_it_does(start, end):
    """Wherever that is: also among the samples that are kept for the report."""
    pulse = np.where((start <= TIME_S) & (end > TIME_S), 0.4, 0.0)
    answer = document(diagnose([joint(offset=pulse, course=TWO_WAVES)], {}, 'joint'))
    found = answer['which'][0]
    assert answer['verdict'] == 'disturbance_force'
    assert found['parameters']['disturbance_start'] == pytest.approx(start, abs=0.02)
    assert found['parameters']['disturbance_end'] == pytest.approx(end, abs=0.02)


@pytest.mark.slow
def test_a_pulse_at_steps_is_no_gravity():
    pulse = np.where((5.0 <= TIME_S) & (TIME_S < 10.0), 0.4, 0.0)
    answer = asked([joint(offset=pulse, course=at_steps(5))], plant='joint').to_dict()
    assert answer['verdict'] == 'disturbance_force'
    assert answer['which'][0]['parameters']['disturbance_pulse'] == pytest.approx(-0.4, rel=0.05)


@numba.njit(cache=True)
def _soft_joint(reference, gravity, spring, gap, out):
    """
    Put command (N m) and position (rad) of a motor that drives an arm by a spring into out.

    gap: half of that within which it does not touch, rad; it hardly rebounds then.
    """
    damper = 0.03 if gap == 0.0 else 3.0
    step = 1.0 / RATE_HZ / SUB_STEPS
    angle, speed, arm, arm_speed, before, rate = reference[0], 0.0, reference[0], 0.0, 0.0, 0.0
    before = reference[0]
    for k in range(reference.size):
        rate += 0.5 * ((angle - before) * RATE_HZ - rate)
        before = angle
        out[0, k] = 6.0 * (reference[k] - angle) - 0.3 * rate
        out[1, k] = angle
        for _ in range(SUB_STEPS):
            bent = angle - arm - min(max(angle - arm, -gap), gap)
            between = spring * bent + damper * (speed - arm_speed) * (gap == 0.0 or bent != 0.0)
            speed += step / (0.25 * INERTIA) * (out[0, k] - DAMPING * speed - between)
            arm_speed += step / (0.75 * INERTIA) * (between - gravity * np.sin(arm))
            angle += step * speed
            arm += step * arm_speed


@pytest.mark.parametrize('gravity', [0.0, pytest.param(1.0, marks=pytest.mark.slow)])
def test_an_arm_behind_a_spring_is_told_while_it_still_swings(gravity):
    """It hangs off its spring at first; gravity is the arm's, most damping the motor's."""
    out = np.empty((2, TIME_S.size))
    _soft_joint(at_steps(3) + 0.5, gravity, 15.0, 0.0, out)
    count = 2.0 * np.pi / 2 ** 18
    run = Run(TIME_S, command_n=out[0], position_m=count * np.round(out[1] / count),
              source='arm', information=PENDULUM)
    answer = asked([run], plant='joint').to_dict()
    assert answer['verdict'] == 'load_compliance'
    found = answer['which'][0]['parameters']
    assert 1.0 / found['compliance'] == pytest.approx(15.0, rel=0.02)
    assert found['piston_share'] == pytest.approx(0.25, rel=0.1)
    assert answer['nuisance']['load']['load_mass'] == pytest.approx(INERTIA, rel=0.02)


@pytest.mark.slow
def test_a_load_that_rattles_is_judged_below_its_impacts():
    """Above, small errors of its motion decide when it touches, and no fit explains the force."""
    course = WITH_RESTS[:TIME_S.size // 2]
    out = np.empty((2, course.size))
    _soft_joint(course, 0.0, 2000.0, 0.03, out)
    count = 2.0 * np.pi / 2 ** 16
    run = Run(TIME_S[:course.size], command_n=out[0], position_m=count * np.round(out[1] / count),
              source='arm', information=PENDULUM)
    answer = asked([run], plant='joint').to_dict()
    assert 'backlash' in answer['verdict']
    assert any('rattles' in note for note in answer['notes'])
    found = answer['which'][0]['parameters']
    assert found['backlash'] == pytest.approx(0.03, rel=0.1)
    assert found['piston_share'] == pytest.approx(0.25, rel=0.3)


@pytest.mark.parametrize('damping', [0.1, 2.0])   # it swings; it creeps
def test_a_load_swings_freely_as_its_equation_says(damping):
    p = np.zeros(1, PLANT_DTYPE)[0]
    for name, value in {'load_mass': 0.02, 'piston_share': 0.25, 'load_damping': damping,
                        'load_type': 1, 'compliance': 1.0 / 15.0, 'swing_cosine': 1.0,
                        'swing_sine': 0.5}.items():
        p[name] = value
    time = np.linspace(0.0, 0.5, 5001)
    force = swing(time, p)
    rate = np.gradient(force, time)
    left = (0.015 * np.gradient(rate, time) + damping * rate + 15.0 * force)[5:-5]
    assert np.abs(left).max() < 2e-3 * 15.0 and force[0] == pytest.approx(1.0)


def test_slow_motion_on_a_coarse_encoder_is_no_standstill():
    run = joint(course=0.3 * TWO_WAVES)
    coarse = 2.0 * np.pi / 2 ** 11
    run = dataclasses.replace(run, position_m=coarse * np.round(run.position_m / coarse))
    assert prepare([run], 'force')[0].valid.mean() > 0.75


@pytest.mark.parametrize('every', [50, pytest.param(100, marks=pytest.mark.slow)])
def test_a_slow_recording_of_a_joint_is_answered_or_refused_in_words(every):
    run = joint()
    rows = slice(None, None, every)
    slow = Run(run.time_s[rows], command_n=run.command_n[rows], position_m=run.position_m[rows],
               source='slow', information=PENDULUM)
    with contextlib.suppress(InputError):
        diagnose([slow], {}, 'joint')


def test_force_at_a_standstill_is_not_judged():
    """Friction holds whatever it is: an encoder that does not turn tells nothing of it."""
    run = joint(friction=0.15, course=at_steps(4))
    recording, = prepare([run], 'force')
    turned = np.diff(run.position_m) != 0.0
    still = np.convolve(turned, np.ones(21), 'same') == 0.0
    assert still.sum() > 100 and not recording.valid[1:][still].any()
    answer = document(diagnose([run], {}, 'joint'))
    assert answer['which'][0]['parameters']['friction_level'] == pytest.approx(0.15, rel=0.05)


@pytest.mark.parametrize('changed', [{}, {'friction': 0.15, 'uneven': 0.3}, {'late_s': 0.012}])
@pytest.mark.parametrize('course', [WITH_RESTS, TWO_WAVES])
def test_no_gravity_is_found_where_there_is_none(changed, course):
    run = joint(**changed, course=course)
    recordings = prepare([run], 'force')
    assert by_position(recordings, [run])[:3] == ByPosition()[:3]


def sprung(middle: float = 0.0, seed: int = 0, friction: float = 0.1, unit: str = 'rad') -> Run:
    """Return a joint on a spring of 2 N m/rad that moves about a position, in four waves."""
    rng = np.random.default_rng(seed)
    phase = rng.random(4)[:, None]
    pulsation = 2.0 * np.pi * np.array([0.4, 1.1, 2.3, 4.9])[:, None]
    wave = 0.2 * np.exp(1j * (pulsation * TIME_S + 2.0 * np.pi * phase))
    angle, speed, change = ((wave * (1j * pulsation) ** n).sum(axis=0).real for n in range(3))
    angle += middle
    torque = (INERTIA * change + DAMPING * speed + 2.0 * angle + friction * np.tanh(100.0 * speed)
              + 0.005 * rng.standard_normal(TIME_S.size))
    return Run(TIME_S, command_n=torque, source='sprung',
               position_m=angle + 1e-5 * rng.standard_normal(TIME_S.size), information={
                   'signals': {'position': unit, 'command': 'Nm' if unit == 'rad' else 'N'}})


@pytest.mark.parametrize(('unit', 'middles', 'given'), [
    ('rad', (0.0,), {}), *(pytest.param(*each, marks=pytest.mark.slow) for each in (
        ('m', (0.3,), {}), ('rad', (0.7, -0.5), {}), ('m', (0.0, 1.0), {}),
        ('rad', (0.0, 1.0), {'load.stiffness': 2.2})))])
@pytest.mark.filterwarnings('ignore:.*constant force is subtracted')
def test_a_spring_is_of_the_nominal_joint_and_friction_is_found_beside_it(unit, middles, given):
    runs = [sprung(middle, seed, 0.2, unit).between(0.0, 8.0)
            for seed, middle in enumerate(middles)]
    with pytest.warns(InputWarning, match='spring') if not given else contextlib.nullcontext():
        answer = document(diagnose(runs, given, 'joint'))
    assert 'coulomb_friction' in answer['ambiguity_set'] and answer['unknown_probability'] < 0.1
    assert answer['which'][0]['parameters']['friction_level'] == pytest.approx(0.2, rel=0.05)
    found = answer['nuisance']['load']
    assert found['load_stiffness'] == pytest.approx(2.0, rel=0.01)
    assert found['load_mass'] == pytest.approx(INERTIA, rel=0.01)
    assert answer['gap']['before_nrmse'] < (0.2 if given else 0.1)


@pytest.mark.slow   # test_no_gravity_is_found_where_there_is_none has the two waves
@pytest.mark.parametrize(('changed', 'perhaps'), [
    ({'gravity': 0.3}, {'unknown'}), ({'late_s': 0.012}, {'transport_delay', 'valve_lag'})])
def test_what_two_waves_cannot_tell(changed, perhaps):
    """A wave of the course is no disturbance; a gain and a phase at two waves fit any lag."""
    run = joint(**changed, course=TWO_WAVES)
    run = dataclasses.replace(run, position_m=None, velocity_m_s=np.gradient(
        run.position_m, 1.0 / RATE_HZ), information={'signals': {
            'velocity': 'rad/s', 'command': 'Nm'}})
    answer = document(diagnose([run], {}, 'joint'))
    assert 'disturbance_force' not in answer['verdict']
    assert perhaps <= set(answer['ambiguity_set'])


def test_joint_with_a_reversed_sign_is_refused():
    run = joint(friction=0.15)
    with pytest.raises(InputError, match='joint: .*sign is reversed'):
        diagnose([dataclasses.replace(run, command_n=-run.command_n)], {}, 'joint')


@pytest.mark.slow
@pytest.mark.filterwarnings('ignore:the joint moves one way', 'ignore:a constant force')
def test_friction_that_falls_with_the_speed_is_no_reversed_sign_and_no_disturbance():
    """The mean power is positive; and the wave is that of the motion, which turns on."""
    torque = (0.05 - 0.004 * np.sin(3.0 * TIME_S)
              + 0.001 * np.random.default_rng(0).standard_normal(TIME_S.size))
    turning = Run(TIME_S, force_n=torque, source='motor', information={
        'signals': {'position': 'rad', 'force': 'Nm'}},
        position_m=20.0 * TIME_S - 2.0 / 3.0 * np.cos(3.0 * TIME_S))
    answer = document(diagnose([turning], {}, 'joint'))
    assert answer['verdict'] == 'unknown'
    with pytest.raises(InputError, match='motor: .*sign is reversed'):
        diagnose([dataclasses.replace(turning, force_n=torque - 0.1)], {}, 'joint')


def test_pulse_is_found_beside_a_worse_start():
    run = joint()
    time, size = run.time_s, float(np.std(run.command_n))
    command = run.command_n + 0.5 * size * ((time >= 5.0) & (time < 6.5))
    command[time < 0.05] += 30.0 * size   # nothing is judged there
    answer = document(diagnose([dataclasses.replace(run, command_n=command)], {}, 'joint'))
    assert answer['verdict'] == 'disturbance_force'
    push = answer['which'][0]['parameters']
    assert push['disturbance_pulse'] == pytest.approx(-0.5 * size, rel=0.1)
    assert push['disturbance_end'] == pytest.approx(6.5, abs=0.05)


def test_slow_position_loop():
    time = np.arange(0.0, 30.0, 0.01)
    course = np.interp(time, np.arange(0.0, 31.0, 2.5), np.arange(13) * 5 % 7 / 7.0)
    late = np.interp(time - 0.2, time, course)
    followed = lfilter([1.0 - np.exp(-0.01 / 0.3)], [1.0, -np.exp(-0.01 / 0.3)], late)
    noise = np.random.default_rng(1).normal(0.0, 1e-3, time.size)
    answer = document(diagnose([Run(time, reference_n=course, position_m=followed + noise,
                                    source='loop',
                                    information={'signals': {'reference': 'm'}})], {}, 'joint'))
    assert {entry['effect'] for entry in answer['which'][:2]} == {'transport_delay', 'valve_lag'}
    assert answer['gap']['before_nrmse'] > 0.15
    assert answer['gap']['after_nrmse'] < 0.03


STAIRS = np.repeat(np.random.default_rng(1).uniform(-1.0, 1.0, 16), 200)


@numba.njit(cache=True)
def _servo(reference, pulsation, damping, rate, acceleration, out):
    """Put the position of a servo with limits, sampled at 200 Hz, into out."""
    position, speed, step = 0.0, 0.0, 1e-5
    for k in range(reference.size):
        out[k] = position
        for _ in range(500):
            change = pulsation ** 2 * (reference[k] - position) - 2.0 * damping * pulsation * speed
            speed += step * min(max(change, -acceleration), acceleration)
            speed = min(max(speed, -rate), rate)
            position += step * speed


def servo(late: int = 0, rate: float = 1e9, acceleration: float = 1e9,
          pulsation: float = 40.0) -> Run:
    """Return 16 s of a servo with a damping ratio of 0.6, `late` samples of 5 ms late."""
    position = np.empty(STAIRS.size)
    _servo(STAIRS, pulsation, 0.6, rate, acceleration, position)
    noise = np.random.default_rng(2).normal(0.0, 1e-3, STAIRS.size)
    return Run(0.005 * np.arange(STAIRS.size), reference_n=STAIRS,
               position_m=np.roll(position, late) + noise, source='servo',
               information={'signals': {'reference': 'rad', 'position': 'rad'}})


@pytest.mark.parametrize('missing', [False, True])
def test_what_one_way_and_no_position_cannot_tell_is_said(missing):
    run = joint(course=0.4 * TIME_S + 0.05 * np.sin(2.0 * np.pi * 0.7 * TIME_S), friction=0.15)
    run = run.between(1.0, 8.0)
    if missing:
        run = dataclasses.replace(joint(), position_m=None, velocity_m_s=np.gradient(
            joint().position_m, TIME_S), information={'signals': {
                'velocity': 'rad/s', 'command': 'Nm'}})
    with pytest.warns(InputWarning) as remarks:
        diagnose([run], {}, 'joint')
    said = ' '.join(str(each.message) for each in remarks)
    assert ('neither gravity nor a spring is looked for' in said) == missing
    assert ('cannot be distinguished from a constant load' in said) != missing


@pytest.mark.slow   # test_a_servo_of_second_order_with_its_limits has a gain of 1
@pytest.mark.parametrize(('gain', 'offset', 'verdict'), [
    (1.01, 0.0, 'no_gap'), (1.0, 0.05, 'valve_bias')])
def test_a_gain_or_an_offset_does_not_hide_the_second_order(gain, offset, verdict):
    run = servo()
    run = dataclasses.replace(run, position_m=gain * run.position_m + offset)
    answer = document(diagnose([run], {}, 'joint'))
    assert answer['verdict'] == verdict
    found = answer['nuisance']['valve']
    assert found['valve_flexure_natural_frequency'] == pytest.approx(20.0 / math.pi, rel=0.01)
    assert found['valve_characteristic_gain'] == pytest.approx(gain, rel=1e-3)


@pytest.mark.parametrize(('rate', 'acceleration', 'late', 'verdict'), [
    (3.0, 60.0, 0, 'no_gap'), pytest.param(1e9, 1e9, 0, 'no_gap', marks=pytest.mark.slow),
    pytest.param(1e9, 1e9, 8, 'transport_delay', marks=pytest.mark.slow)])
def test_a_servo_of_second_order_with_its_limits(rate, acceleration, late, verdict):
    run = servo(late, rate, acceleration)
    with warnings.catch_warnings(record=True) as warned:
        answer = asked([run], plant='joint')
    told = [*answer.notes, *(str(each.message) for each in warned)]
    text, = (each for each in told if 'second order' in each)   # once: as it was fitted
    found = [float(each) for each in re.findall(r'(?<=[ ])\d+\.?\d*(?:e[+-]\d+)?', text)]
    expected = [40.0 / (2.0 * math.pi), 0.6] + [rate, acceleration] * (rate < 1e9)
    assert found == pytest.approx(expected, rel=0.03)
    assert answer.verdict == verdict
    if late:
        assert answer.which[0]['parameters']['command_delay'] == pytest.approx(
            0.04, abs=0.0025)   # half a sample
    else:
        assert answer.gap['before_nrmse'] < 0.005


def test_lag_of_a_slowly_sampled_drive():
    """Its command is held for half a time constant, and its gain is not known without the lag."""
    run = joint(course=TWO_WAVES)
    held = run.command_n[::4]
    force = lfilter([0.0, 1.0 - math.exp(-0.8)], [1.0, -math.exp(-0.8)], held)
    slow = Run(TIME_S[::4], command_n=held, force_n=force, source='drive')
    answer = document(diagnose([slow], {}, 'joint', drive='drive'))
    assert answer['verdict'] == 'valve_lag'
    assert answer['which'][0]['parameters']['valve_lag'] == pytest.approx(0.01, rel=0.02)


def test_model_that_is_far_too_heavy_is_refused():
    with pytest.raises(InputError, match='a factor of 0.01.*load.mass'):
        diagnose([joint()], {'load.mass': 100.0 * INERTIA, 'load.damping': 0.0}, 'joint')


def test_step_of_a_disturbance_is_found_from_its_start():
    push = np.where(np.arange(4000) < 1000, 0.0, 30.0)
    constant = np.full((push.size, 1), push.size ** -0.5)   # as if it were free
    left = push - constant @ (constant.T @ push)
    assert _pulse(left, np.ones(4000), constant, push, 1e-3) == pytest.approx(
        {'residual_start': 1.0, 'residual_end': 4.0})


def test_lost_motion_of_a_position_loop_is_backlash():
    course = WITH_RESTS[::4]
    followed = course.copy()
    for k in range(1, course.size):
        followed[k] = np.clip(followed[k - 1], course[k - 1] - 0.03, course[k - 1] + 0.03)
    noise = np.random.default_rng(1).normal(0.0, 1e-3, course.size)
    answer = document(diagnose([Run(TIME_S[::4], reference_n=course, position_m=followed + noise,
                                    source='loop',
                                    information={'signals': {'reference': 'rad'}})], {}, 'joint',
                               drive='position'))
    # Dry friction in a loop without inertia is the same play.
    found = {each['effect']: each for each in answer['which'][:2]}
    assert found.keys() == {'backlash', 'coulomb_friction'}
    assert found['backlash']['probability'] > 0.4
    assert found['backlash']['parameters']['loop_width'] == pytest.approx(0.03, rel=0.05)


@pytest.mark.slow
def test_uneven_friction_is_not_an_offset_for_sure():
    answer = document(diagnose([joint(friction=0.15, uneven=0.5)], {}, 'joint'))
    assert 'friction_asymmetry' in answer['ambiguity_set']
    # As much friction either way, and more of an offset than it: no asymmetry does that.
    answer = document(diagnose([joint(friction=0.15, offset=0.3)], {}, 'joint'))
    assert answer['verdict'] == 'coulomb_friction'
    assert {row['effect']: row['probability'] for row in answer['which']}.get(
        'friction_asymmetry', 0.0) < 0.1


def test_force_that_is_read_a_sample_late_is_no_slow_sensor():
    speed = np.gradient(WITH_RESTS, 1.0 / RATE_HZ)
    torque = INERTIA * np.gradient(speed, 1.0 / RATE_HZ) + DAMPING * speed
    torque += np.random.default_rng(2).normal(0.0, 1e-3, torque.size)
    late = np.append(0.0, torque[:-5:5])
    answer = document(diagnose([Run(TIME_S[::5], force_n=late, position_m=WITH_RESTS[::5],
                                    source='joint', information={'signals': {
                                        'position': 'rad', 'force': 'Nm'}})], {}, 'joint'))
    assert answer['verdict'] == 'no_gap'
