"""What has changed since healthy recordings: the machine has friction and gravity all along."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from documented import problems
from test_gap_joint import PENDULUM, TIME_S, TWO_WAVES, joint, servo
from test_gap_real import cut, emps, needs_data
from test_gap_simulator import recorded

from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.gap import baseline
from asi_analysis.gap.answer.command import diagnose
from asi_analysis.gap.answer.result import Gap
from asi_analysis.gap.baseline import healthy_of
from asi_analysis.gap.diagnose import diagnose as diagnosis_of
from asi_analysis.gap.diagnosis import improved_of
from asi_analysis.gap.inference.hypotheses import Weighed
from asi_analysis.gap.model.effects import UNKNOWN

MACHINE = {'friction': 0.1, 'gravity': 0.5}
HEALTHY = (joint(**MACHINE), joint(**MACHINE, course=TWO_WAVES))
pytestmark = pytest.mark.filterwarnings('ignore:.*the joint has gravity')


def asked(new: Run, *healthy: Run) -> Gap:
    return diagnose([new], plant='joint', baseline=healthy)


@pytest.mark.slow
def test_more_friction_is_named_with_its_size_before_and_now():
    answer = asked(joint(**MACHINE | {'friction': 0.13}), *HEALTHY)
    assert answer.verdict == 'coulomb_friction' and answer.baseline['change'] == 'changed'
    assert answer.baseline['verdict'] == 'coulomb_friction'
    row, = (row for row in answer.baseline['parameters'] if row['changed'])
    assert (row['parameter'], row['effect'], row['unit']) == (
        'friction_level', 'coulomb_friction', 'Nm')
    assert row['healthy'] == pytest.approx(0.1, rel=0.03)
    assert row['now'] == pytest.approx(0.13, rel=0.03)
    assert 'Changed: Coulomb friction: sliding friction from 0.' in str(answer)
    assert 'Within the spread of the 2 healthy recordings: load.mass, load.damping' in str(answer)
    assert problems(json.loads(json.dumps(answer.to_dict(), allow_nan=False)), 'asi gap') == []


@pytest.mark.slow
def test_a_machine_that_was_worse_has_less_friction_now():
    answer = asked(HEALTHY[0], joint(**MACHINE | {'friction': 0.13}))
    assert answer.verdict == 'coulomb_friction'
    row, = (row for row in answer.baseline['parameters'] if row['changed'])
    assert row['now'] == pytest.approx(0.1, rel=0.03) and row['now'] < row['healthy_low']


@pytest.mark.slow
def test_more_weight_on_a_joint_is_named_beside_the_friction_that_it_always_had():
    answer = asked(joint(**MACHINE | {'gravity': 0.55}), *HEALTHY)
    assert answer.verdict == 'gravity' and answer.where[0]['block'] == 'mechanics'
    row, = (row for row in answer.baseline['parameters'] if row['changed'])
    assert row['parameter'] == 'gravity_sine' and row['unit'] == 'Nm'
    assert row['now'] == pytest.approx(0.05, abs=0.003)
    assert 'Changed: gravity: sin q term from 0.00 to 0.0' in str(answer)


def rigid(inertia: float, seed: int) -> Run:
    """Return a joint of this inertia (kg m2) and no friction, on a course of four waves."""
    rng = np.random.default_rng(seed)
    phase = rng.random(4)[:, None]
    pulsation = 2.0 * np.pi * np.array([0.4, 1.1, 2.3, 4.9])[:, None]
    wave = 0.2 * np.exp(1j * (pulsation * TIME_S + 2.0 * np.pi * phase))
    angle, speed, change = ((wave * (1j * pulsation) ** n).sum(axis=0).real for n in range(3))
    torque = inertia * change + 0.05 * speed + 0.02 * rng.standard_normal(TIME_S.size)
    run = Run(TIME_S, command_n=torque, position_m=angle, source='rigid', information=PENDULUM)
    return run.between(0.0, 6.0)


@pytest.mark.slow
def test_a_heavier_load_is_named_but_not_a_little_more():
    heavier = asked(rigid(0.024, 3), rigid(0.02, 1), rigid(0.02, 2))
    assert heavier.verdict == 'parameter:load.mass'
    assert heavier.which[0]['parameters']['load_mass'] == pytest.approx(0.024, rel=0.02)
    assert heavier.baseline['change'] == 'changed'
    # Between those of two healthy recordings.
    assert asked(rigid(0.0203, 3), rigid(0.02, 1), rigid(0.0208, 2)).verdict == 'no_gap'


def turning(gain: float, seed: int) -> Run:
    """Return a motor at a nearly constant speed, against friction; gain: of its torque sensor."""
    rng = np.random.default_rng(seed)
    speed = 20.0 + 2.0 * np.sin(3.0 * TIME_S)
    torque = gain * (0.05 + 1e-4 * speed + 0.005 * rng.standard_normal(TIME_S.size))
    angle = 20.0 * TIME_S - 2.0 / 3.0 * np.cos(3.0 * TIME_S)
    return Run(TIME_S, force_n=torque, position_m=angle, source='motor', information=PENDULUM)


ONE_WAY = pytest.mark.filterwarnings('ignore:the joint moves one way', 'ignore:a constant force')


@ONE_WAY
@pytest.mark.parametrize(('gain', 'seed'), [
    pytest.param(1.4, 1, marks=pytest.mark.slow),
    (0.7, 4)])   # (0.7, 4): its disturbance is as large in a healthy recording
def test_another_mean_torque_of_a_joint_that_turns_one_way_is_undecided(gain: float, seed: int):
    """Friction, load and the sensor's gain are alike there."""
    answer = asked(turning(gain, seed + 2), turning(1.0, seed), turning(1.0, seed + 1))
    note, = (note for note in answer.notes if note.startswith('a constant force of'))
    now, before, also = map(float, re.findall(r'\d\.\d+', note))
    assert now == pytest.approx(gain * 0.05, rel=0.05)
    assert [before, also] == pytest.approx([0.05, 0.05], rel=0.05)
    assert answer.baseline['change'] == 'cannot_tell'
    assert answer.probability < 0.6


def rectified(seed: int) -> Run:
    """Return an axis whose current was recorded without its sign, so that no model explains it."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 12.0, 0.02)
    speed = np.sin(1.9 * t + seed) + 0.6 * np.sin(3.1 * t)
    current = 1.0 + np.sqrt(np.abs(speed)) + 0.01 * rng.standard_normal(t.size)
    return Run(t, command_n=current, position_m=np.cumsum(speed) * 0.02, source='axis',
               information={'signals': {'command': 'A', 'position': 'm'}})


@pytest.mark.slow
def test_a_model_that_explains_nothing_of_the_healthy_machine_finds_no_change_for_sure():
    """The lead screws of the public recordings: whatever changed was "no gap", 1.00."""
    answer = asked(rectified(3), rectified(1), rectified(2))
    assert any('unexplained, beside their noise' in note for note in answer.notes)
    assert answer.no_gap_probability < 0.6
    assert answer.baseline['change'] != 'none'


@ONE_WAY
def test_two_doubts_are_one_doubt(monkeypatch):
    for name, note in (('_doubt_of_constant', 'load'), ('_doubt_of_rest', 'model')):
        monkeypatch.setattr(baseline, name, lambda *_, note=note: (0.5, [note]))
    weighed, notes = baseline.doubted(Weighed(None, {}, {(): 0.8, ('backlash',): 0.2}), None, 0.2)
    assert weighed.probability == {(): 0.4, ('backlash',): 0.2, (UNKNOWN,): 0.4}
    assert notes == ['load', 'model']


@pytest.mark.slow
def test_a_torque_within_the_tolerance_but_beyond_the_healthy_ones_is_no_sure_answer():
    answer = asked(turning(1.17, 3), turning(1.0, 1), turning(1.0, 2))
    assert answer.verdict == 'no_gap' and answer.probability < 0.85
    note, = (note for note in answer.notes if note.startswith('a constant force of 0.0'))
    assert note.endswith('less than the tolerance of 20% (--tolerance)')


@pytest.mark.filterwarnings('ignore:.*position')
@pytest.mark.parametrize('velocity', [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize('offset', [pytest.param(0.3, marks=pytest.mark.slow), 5.0])
def test_an_offset_of_the_torque_is_undecided_and_a_small_one_is_none(offset: float,
                                                                      velocity: bool):
    runs = [rigid(0.02, seed) for seed in (3, 1, 2)]    # 2.8 Nm (rms), healthy without an offset
    if velocity:
        runs = [replace(run, position_m=None, velocity_m_s=np.gradient(run.position_m, run.time_s))
                for run in runs]
    new, *healthy = runs
    answer = asked(replace(new, command_n=new.command_n + offset), *healthy)
    assert answer.baseline['change'] == ('none' if offset < 0.5 else 'cannot_tell')
    assert any('offset of the force sensor' in note for note in answer.notes) == (offset > 0.5)


@pytest.mark.slow   # test_a_healthy_recording_has_not_changed is of a joint that turns back
@ONE_WAY
def test_the_same_mean_torque_has_not_changed():
    assert asked(turning(1.0, 3), turning(1.0, 1), turning(1.0, 2)).verdict == 'no_gap'


def test_a_quicker_servo_is_named():
    healthy, faster = (servo(pulsation=each).between(0.0, 6.0) for each in (40.0, 60.0))
    quicker = asked(faster, healthy)
    assert quicker.verdict == 'parameter:valve_flexure.natural_frequency'
    assert quicker.which[0]['parameters']['valve_flexure_natural_frequency'] == pytest.approx(
        30.0 / np.pi, rel=0.01)


@pytest.mark.slow
def test_the_same_servo_has_not_changed():
    healthy = servo().between(0.0, 6.0)
    same = asked(healthy, healthy)
    assert same.verdict == 'no_gap' and same.baseline['change'] == 'none'


@pytest.mark.parametrize('healthy', [
    (HEALTHY[0].between(0.0, 8.0),), pytest.param((HEALTHY[0],), marks=pytest.mark.slow),
    pytest.param((
        HEALTHY[0].between(0.0, 8.0), HEALTHY[0], HEALTHY[0].between(8.0, 16.0)),
        marks=pytest.mark.slow)])
def test_a_healthy_recording_has_not_changed(healthy):
    """In any order of the others, one twice, or one cut in two."""
    answer = asked(healthy[0] if len(healthy) == 1 else HEALTHY[0], *healthy)
    assert answer.verdict == 'no_gap' and answer.baseline['change'] == 'none'
    assert not any(row['changed'] for row in answer.baseline['parameters'])
    assert str(answer).startswith('Nothing has changed beyond the spread')


@pytest.mark.slow
def test_what_no_effect_explains_is_no_change_if_the_healthy_machine_has_it():
    teeth = {'friction': 0.1, 'gravity': 0.15, 'teeth': 9.0}
    healthy, more = (joint(**each).between(0.0, 5.0) for each in (teeth, teeth | {'gravity': 0.6}))
    assert asked(healthy, healthy).baseline['change'] == 'none'
    answer = asked(more, healthy)
    assert answer.baseline['change'] != 'none' and answer.verdict == 'unknown'
    left, = answer.baseline['left']
    assert left['now_nrmse'] > 2.0 * left['healthy_nrmse']


@pytest.mark.slow
@pytest.mark.filterwarnings('ignore:without')
def test_the_actuator_is_compared_by_the_simulator():
    def forces(lag_s: float) -> Run:
        run = recorded(nominal | {'valve_flexure.lag_time': lag_s}, duration_s=1.2)
        return replace(run, position_m=None, valve_position_m=None, velocity_m_s=None)

    nominal = {'load.type': 'spring'}
    healthy = diagnosis_of([forces(0.0)], nominal)
    slower = diagnosis_of([forces(0.003)], nominal, healthy=healthy)
    assert healthy.verdict == () and slower.verdict == ('valve_lag',)
    spread = slower.machine[('force',)].spread['valve_characteristic_maximum_force']
    assert 0.8 < spread.low / spread.value < 1.0 < spread.high / spread.value <= 1.2 * (1 + 1e-9)
    assert improved_of(slower, nominal)['valve_flexure.lag_time'] == pytest.approx(0.003, rel=0.1)


@pytest.mark.slow
def test_a_spread_holds_each_recording_alone_and_at_most_the_tolerance():
    diagnosis = diagnosis_of([rigid(0.02, 1), rigid(0.021, 2)], {}, 'joint')
    fitted = diagnosis.best(diagnosis.groups[0]).fitted
    for tolerance in (0.002, 0.2):
        value, low, high, _ = healthy_of(fitted, tolerance, {}).spread['load_mass']
        assert value * (1.0 - 1.001 * tolerance) <= low < value < high <= value * (
            1.0 + 1.001 * tolerance)


def test_other_signals_than_those_of_the_healthy_recordings_are_refused():
    short = HEALTHY[0].between(0.0, 3.0)
    alone = replace(short, command_n=None, reference_n=short.position_m * 1.1,
                    information={'signals': {'position': 'rad', 'reference': 'rad'}})
    with pytest.raises(InputError, match='healthy recordings hold other|nothing to compare'):
        asked(HEALTHY[0], alone)


@pytest.mark.slow
@needs_data
def test_parts_of_one_measured_recording_have_not_changed():
    run = emps('DATA_EMPS.mat')
    answer = asked(cut(run, 0.5, 0.6), cut(run, 0.3, 0.4))
    assert answer.baseline['change'] == 'none'


def test_another_unit_than_that_of_the_healthy_recordings_is_refused():
    amperes = replace(HEALTHY[0], information={'signals': PENDULUM['signals'] | {'command': 'A'}})
    with pytest.raises(InputError, match='command is in A, in joint in Nm'):
        asked(amperes, HEALTHY[0])


@pytest.mark.slow
def test_a_healthy_recording_may_begin_in_motion():
    """Then the fit of its valve has more parameters, and so more errors."""
    nominal = {'load.type': 'spring'}
    healthy = recorded(nominal, duration_s=3.0)[1337:]
    now = recorded(nominal | {'friction.coulomb': 14.0}, duration_s=3.0)
    answer = diagnose([now], nominal, baseline=[healthy])
    assert answer.verdict == 'coulomb_friction' and answer.baseline['change'] == 'changed'
