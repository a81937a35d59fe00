"""Joints of another simulation: a PD controller with friction or two masses, a slow sensor."""

from dataclasses import replace

import numpy as np
import pytest

from asi_analysis.bags.run import Run
from asi_analysis.gap.answer.command import diagnose
from asi_analysis.gap.answer.joint_model import joint_model, node_parameters
from asi_analysis.gap.diagnose import diagnose as diagnosis_of
from asi_analysis.gap.document import document
from asi_analysis.gap.model import blocks
from asi_analysis.gap.model.joint import IDEAL
from asi_analysis.gap.model.predict import plant_record
from asi_analysis.gap.model.servo.identification import Servo, begins_moving, follow
from asi_analysis.gap.prepare import prepare
from asi_common.jit import FULL, jit

PERIOD_S = 0.005
TIME_S = PERIOD_S * np.arange(1200)
REFERENCE = 0.4 * sum(np.sin(2.0 * np.pi * f * TIME_S + 3.0 * f) for f in (0.4, 1.1, 2.3, 4.7))
STEPS = 400   # of the simulation, in a sample: with 50 it is off by ten times the noise


@jit
def simulated(reference, friction, breakaway, stiffness, fine, out):
    """Put into `out` the position of a servo of 4 Hz, of its load if `stiffness` > 0."""
    h = PERIOD_S / fine
    w, d = 2.0 * np.pi * 4.0, 0.7
    mass = 0.7 if stiffness > 0.0 else 1.0
    x, v, y, u = reference[0], 0.0, reference[0], 0.0
    for k in range(reference.size):
        out[k] = y if stiffness > 0.0 else x
        for _ in range(fine):
            torque = w * w * (reference[k] - x) - 2.0 * d * w * v
            spring = stiffness * (x - y) + 0.02 * stiffness ** 0.5 * (v - u)
            if stiffness > 0.0:
                torque -= spring
                u += h * spring / 0.3
                y += h * u
            if friction > 0.0 and v == 0.0 and abs(torque) <= friction * breakaway:
                continue
            way = np.sign(v) if v != 0.0 else np.sign(torque)
            rise = 1.0 + (breakaway - 1.0) * np.exp(-abs(v) / 0.2)
            after = v + h * (torque - way * friction * rise) / mass
            v = 0.0 if v * after < 0.0 else after
            x += h * v


def run_of(reference=REFERENCE, friction=0.0, breakaway=1.0, stiffness=0.0, late=0.0) -> Run:
    """Return the recording of a servo, 200 Hz; friction in N per kg; late: samples."""
    out = np.empty(reference.size)
    simulated(reference, friction, breakaway, stiffness, STEPS, out)
    time = PERIOD_S * np.arange(reference.size)
    out = np.interp(time - late * PERIOD_S, time, out)
    out += np.random.default_rng(5).normal(0.0, 1e-4, out.size)
    return Run(time, reference_n=reference, position_m=out, source='servo',
               information={'signals': {'reference': 'rad', 'position': 'rad'}})


def test_friction_within_the_block_is_that_of_a_fine_simulation():
    fine = np.empty(REFERENCE.size)
    simulated(REFERENCE, 0.03 * (8.0 * np.pi) ** 2, 1.5, 0.0, 400, fine)
    found = in_a_block(4.0, 0.7, friction=0.03, breakaway=0.5, stribeck=0.2)
    # With the rest of a sub-step lost in which the motion turns, it is ten times as much.
    assert np.abs(found - fine).max() < 2e-4 * np.ptp(fine)


@pytest.mark.parametrize(('fault', 'verdict'), [
    ({}, 'no_gap'), *(pytest.param(*each, marks=pytest.mark.slow) for each in (
            ({'friction': 25.0}, 'coulomb_friction'),   # in another unit below
            ({'friction': 40.0, 'breakaway': 2.5}, 'stiction'), ({'late': 0.3}, 'no_gap'))),
    pytest.param({'stiffness': 400.0}, 'load_compliance', marks=pytest.mark.slow)])
def test_what_disturbs_a_servo_is_found_within_its_loop(fault: dict[str, float], verdict: str):
    # A delay, a lag or a backlash, each for sure; a third of a sample was a delay.
    answer = diagnose([run_of(**fault)], plant='joint')
    assert answer.verdict == verdict


@pytest.mark.parametrize('scale', [0.001, pytest.param(100.0, marks=pytest.mark.slow)])
def test_friction_of_a_servo_is_found_in_any_unit(scale: float):
    run = run_of(friction=25.0)
    assert run.reference_n is not None and run.position_m is not None
    scaled = replace(run, reference_n=scale * run.reference_n, position_m=scale * run.position_m)
    assert diagnose([scaled], plant='joint').verdict == 'coulomb_friction'


def part_of(run: Run, first: int, last: int) -> Run:
    """Return samples of a recording."""
    assert run.reference_n is not None and run.position_m is not None
    return Run(run.time_s[first:last], reference_n=run.reference_n[first:last],
               position_m=run.position_m[first:last], source='servo', information=run.information)


@pytest.mark.parametrize(('cut', 'told'), [(0, False), (400, True)])
def test_a_servo_that_is_recorded_from_amid_a_motion_is_told(cut: int, told: bool):
    recording, = prepare([part_of(run_of(), cut, 1200)], 'position', [False])
    assert begins_moving(recording) == told


@pytest.mark.parametrize(('fault', 'verdict'), [
    ({}, ()),
    pytest.param({'stiffness': 400.0}, ('load_compliance',), marks=pytest.mark.slow),
    pytest.param({'late': 6.0}, ('transport_delay',), marks=pytest.mark.slow),
    pytest.param({'friction': 25.0}, ('coulomb_friction',), marks=pytest.mark.slow)])
def test_a_recording_that_begins_amid_a_motion_has_the_verdict_of_the_whole(
        fault: dict[str, float], verdict: tuple[str, ...]):
    # Simulated from rest, each was unknown; a compliance still rings when the recording ends.
    found = diagnosis_of([part_of(run_of(**fault), 400, 1200)], {}, 'joint')
    assert found.verdict == verdict
    assert found.joined[verdict] > 0.9


@pytest.mark.slow   # test_a_bias_is_found_where_a_recording_is_held_out has one of 5
@pytest.mark.parametrize('offset', [0.3, 5.0])
def test_an_offset_of_any_size_is_a_bias(offset: float):
    # Beyond 0.7 of the range of the reference it was a bias at its bound, and something unknown.
    run = run_of()
    assert run.position_m is not None
    found = diagnosis_of([replace(run, position_m=run.position_m + offset)], {}, 'joint')
    assert found.verdict == ('valve_bias',)
    assert found.best(found.groups[0]).fitted.values['command_bias'] == pytest.approx(
        offset, abs=1e-3)


def test_a_bias_is_found_where_a_recording_is_held_out():
    # The mean of the samples to fit on, of which that recording has none, was nan.
    run = run_of()
    assert run.position_m is not None
    biased = replace(run, position_m=run.position_m + 5.0)
    found = diagnosis_of([biased, biased], {}, 'joint', held_out=[False, True])
    assert found.verdict == ('valve_bias',)
    assert found.best(found.groups[0]).fitted.values['command_bias'] == pytest.approx(
        5.0, abs=1e-3)


@jit
def simulated_with_limits(reference, friction, rate, acceleration, out):
    """Put into `out` the position of a servo of 6 Hz; its motor has limits, and friction."""
    h = PERIOD_S / STEPS
    w, d, x, v = 2.0 * np.pi * 6.0, 0.8, reference[0], 0.0
    for k in range(reference.size):
        out[k] = x
        for _ in range(STEPS):
            push = w * w * (reference[k] - x) - 2.0 * d * w * v
            push = min(max(push, -acceleration), acceleration)
            if v == 0.0 and abs(push) <= friction:
                continue
            after = v + h * (push - friction * np.sign(v if v != 0.0 else push))
            v = 0.0 if v * after < 0.0 else min(max(after, -rate), rate)
            x += h * v


def in_a_block(frequency: float, damping: float, **servo: float) -> np.ndarray:
    """Return the position of a servo by the block of the fit, with the sub-steps of a fit."""
    p = plant_record(IDEAL)
    p['valve_characteristic_full_opening'] = 1.0
    p['valve_flexure_model'] = FULL
    p['valve_flexure_coil_frequency'], p['valve_flexure_delay'] = 1e9, 0.0
    p['valve_flexure_natural_frequency'], p['valve_flexure_damping_ratio'] = frequency, damping
    for name, value in servo.items():
        p[f'servo_{name}'] = value
    found = np.empty(REFERENCE.size)
    blocks.valve(REFERENCE, *blocks.parts(p), PERIOD_S, 7, found, blocks.AT_REST)
    return found


@pytest.mark.parametrize('friction', [20.0, 55.0])
def test_friction_beside_a_limited_acceleration_is_that_of_a_fine_simulation(friction: float):
    fine = np.empty(REFERENCE.size)
    simulated_with_limits(REFERENCE, friction, 4.0, 60.0, fine)
    found = in_a_block(6.0, 0.8, friction=friction / (12.0 * np.pi) ** 2, rate=4.0,
                       acceleration=60.0)
    # With the friction divided as in a loop without limits it was 0.0014, and 0.12.
    assert np.abs(found - fine).max() < 2e-4 * np.ptp(fine)


def test_a_servo_that_is_weaker_than_its_friction_rests():
    # It crept away from its reference: a limited push was less than the friction against it.
    assert np.ptp(in_a_block(6.0, 0.8, friction=0.2, acceleration=60.0)) == 0.0


@pytest.mark.parametrize('friction', [pytest.param(0.0, marks=pytest.mark.slow), 20.0])
def test_friction_of_a_servo_with_limits_is_found(friction: float):
    # The limits had a law of their own, without friction: unknown, 0.80.
    rng = np.random.default_rng(1)
    reference = np.repeat(rng.uniform(-1.0, 1.0, 20), 60)
    position = np.empty(reference.size)
    simulated_with_limits(reference, friction, 4.0, 60.0, position)
    position += rng.normal(0.0, 1e-4, position.size)
    run = Run(TIME_S, reference_n=reference, position_m=position, source='servo',
              information={'signals': {'reference': 'rad', 'position': 'rad'}})
    found = diagnosis_of([run], {}, 'joint')
    assert found.verdict == (('coulomb_friction',) if friction else ())
    values = found.best(found.groups[0]).fitted.values
    assert (values['servo_rate'], values['servo_acceleration']) == pytest.approx(
        (4.0, 60.0), rel=0.01)
    if friction:   # over the stiffness of the loop; for another simulator a force per inertia
        assert values['servo_friction'] == pytest.approx(20.0 / (12.0 * np.pi) ** 2, rel=0.03)
        assert joint_model(found).friction == pytest.approx(20.0, rel=0.03)
        exported, *_ = node_parameters(found, {})
        assert exported['friction.coulomb'] == pytest.approx(20.0, rel=0.03)
        assert exported['servo.acceleration_limit'] == pytest.approx(60.0, rel=0.01)


@pytest.mark.parametrize(('limits', 'names'), [
    ((3.0, 1e9), ['servo_rate']),
    pytest.param((1e9, 400.0), ['servo_acceleration'], marks=pytest.mark.slow)])
def test_a_limit_that_is_not_reached_is_not_told(limits: tuple[float, float], names: list[str]):
    # An acceleration of at most 2300, and a speed of 21.6 (19.3 to 23.8), were initial guesses.
    rng = np.random.default_rng(1)
    reference = np.repeat(rng.uniform(-1.0, 1.0, 20), 60)
    position = np.empty(reference.size)
    simulated_with_limits(reference, 0.0, *limits, position)
    position += rng.normal(0.0, 1e-4, position.size)
    found = diagnosis_of([Run(TIME_S, reference_n=reference, position_m=position, information={
        'signals': {'reference': 'rad', 'position': 'rad'}})], {}, 'joint')
    assert found.verdict == ()
    values = found.best(found.groups[0]).fitted.record
    assert [name for name in ('servo_rate', 'servo_acceleration') if values[name]] == names
    assert values[names[0]] == pytest.approx(min(limits), rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(('seed', 'first', 'last'), [(1, 35, 1000), (9, 0, 1200)])
def test_friction_of_a_servo_with_limits_is_no_other_effect(seed: int, first: int, last: int):
    # Beside a compliance of 400 Hz, 0.64: friction was not fitted alone; and a servo that shows
    # beside its friction only lost its limits, so that the answer was a lag.
    rng = np.random.default_rng(seed)
    reference = np.repeat(rng.uniform(-1.0, 1.0, 20), 60)
    position = np.empty(reference.size)
    simulated_with_limits(reference, 20.0, 4.0, 60.0, position)
    position += np.random.default_rng(7).normal(0.0, 1e-4, position.size)
    run = Run(TIME_S, reference_n=reference, position_m=position, source='servo',
              information={'signals': {'reference': 'rad', 'position': 'rad'}})
    assert diagnosis_of([part_of(run, first, last)], {}, 'joint').verdict == ('coulomb_friction',)


@pytest.mark.slow
def test_fine_steps_of_a_reference_are_found():
    # Fifty steps over its range, less than 1 % of the motion: they were not looked for.
    rng = np.random.default_rng(4)
    stepped = 0.056 * np.round(REFERENCE / 0.056)
    position = follow(Servo(60.0, 0.8), stepped, float(stepped[0]), PERIOD_S)
    run = Run(TIME_S, reference_n=REFERENCE, position_m=position + rng.normal(
        0.0, 1e-4, position.size), source='servo', information={
            'signals': {'reference': 'rad', 'position': 'rad'}})
    found = diagnosis_of([run], {}, 'joint')
    assert found.verdict == ('command_quantisation',)
    assert found.best(found.groups[0]).fitted.values['command_quantum'] == pytest.approx(
        0.056, rel=1e-3)


@pytest.mark.slow
def test_friction_in_a_slow_motion_is_no_sure_backlash():
    # It makes the motion late as a slow servo does; of few initial guesses only one was followed.
    slow = 0.4 * 2.0 / np.pi * np.arcsin(np.sin(2.0 * np.pi * 0.1 * PERIOD_S * np.arange(3000)))
    found = diagnosis_of([run_of(slow, friction=25.0)], {}, 'joint')
    assert sum(p for names, p in found.joined.items()
               if {'coulomb_friction', 'stiction'} & {*names}) > 0.2
    # Over the stiffness of the loop, 632 N/m per kg.
    rubbing = found.groups[0].candidates['coulomb_friction',].fitted.values
    assert rubbing['servo_friction'] == pytest.approx(0.0396, rel=0.02)


def test_a_lag_of_the_force_sensor_is_not_one_of_the_drive_too():
    # The drive showed it as well, and was told beside the sensor: 0.97.
    rng, period = np.random.default_rng(2), 0.002
    time = period * np.arange(4000)
    command = sum(np.sin(2.0 * np.pi * f * time + f) for f in (0.5, 1.3, 3.1, 7.7, 15.0))
    keep, (v, q, read) = np.exp(-0.0001 / 0.008), np.zeros(3)
    force, position = np.empty((2, time.size))
    for k in range(time.size):
        force[k], position[k] = read, q
        for _ in range(20):
            v += 0.0001 * (command[k] - 0.6 * v) / 0.1
            q += 0.0001 * v
            read = command[k] + (read - command[k]) * keep
    run = Run(time, command_n=command, force_n=force + rng.normal(0.0, 0.01, time.size),
              position_m=position + rng.normal(0.0, 1e-4, time.size), source='arm',
              information={'signals': {'command': 'N', 'force': 'N', 'position': 'm'}})
    found = diagnosis_of([run], {}, 'joint')
    assert found.verdict == ('sensor_lag',)
    assert document(found)['which'][0]['parameters']['sensor_lag'] == pytest.approx(0.008, rel=0.1)
    # For another simulator it is the sensor's alone, and the drive keeps its gain.
    values, *_ = node_parameters(found, {})
    assert values['force_sensor.lag_time'] == pytest.approx(0.008, rel=0.1)
    assert 'drive.lag_time' not in values
    assert joint_model(found).gain == pytest.approx(1.0, rel=0.01)


@pytest.mark.slow   # test_what_disturbs_a_servo_is_found_within_its_loop has no gap
@pytest.mark.parametrize(('late', 'verdict'), [(0, 'no_gap'), (8, 'transport_delay')])
def test_the_integral_action_of_a_servo_is_no_lag(late: int, verdict: str):
    # A position loop around a velocity loop with integral action: "lag and delay", for sure.
    q, v, integral, out = REFERENCE[0], 0.0, 0.0, []
    for wanted in np.append(np.full(late, REFERENCE[0]), REFERENCE)[:REFERENCE.size]:
        out.append(q)
        for _ in range(STEPS):
            error = 10.0 * (wanted - q) - v
            integral += PERIOD_S / STEPS * error
            v += PERIOD_S / STEPS * 50.0 * (error + 5.0 * integral)
            q += PERIOD_S / STEPS * v
    noise = np.random.default_rng(5).normal(0.0, 1e-4, len(out))
    run = Run(TIME_S, reference_n=REFERENCE, position_m=np.array(out) + noise, source='servo',
              information={'signals': {'reference': 'rad', 'position': 'rad'}})
    answer = diagnose([run], plant='joint')
    assert answer.verdict == verdict
    if late:
        assert answer.which[0]['parameters']['command_delay'] == pytest.approx(0.04, abs=0.003)
