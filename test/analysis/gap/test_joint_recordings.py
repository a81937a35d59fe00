"""Recordings of a joint that are not what they seem: wrapped, without a unit, twice, swapped."""

from dataclasses import replace

import numpy as np
import pytest
from test_gap_joint import joint

from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.gap.answer.command import diagnose
from asi_analysis.gap.answer.joint_files import isaac
from asi_analysis.gap.answer.joint_model import JointModel, moved_by
from asi_analysis.gap.diagnose import diagnose as diagnosis_of
from asi_analysis.gap.inference.plausibility import check_joint
from asi_analysis.gap.model.joint import drive_of, joint_groups
from asi_analysis.gap.recordings import (
    against_healthy,
    units_not_given,
    unwrapped,
    without_repeats,
)

TIME_S = 0.004 * np.arange(2000)
ANGLE = 8.0 * np.sin(2.0 * np.pi * 0.3 * TIME_S)


def turning(angle: np.ndarray, **more: np.ndarray) -> Run:
    return Run(TIME_S, position_m=angle, command_n=np.cos(TIME_S), source='arm',
               information={'signals': {'position': 'rad', 'reference': 'rad', 'command': 'Nm'}},
               **more)


def test_an_angle_that_wraps_is_unwrapped_with_its_reference_and_told():
    wrapped, ahead = np.mod(ANGLE, 2.0 * np.pi), np.mod(ANGLE + 0.1, 2.0 * np.pi)
    wrapped[300:305] = np.nan
    run, notes = unwrapped(turning(wrapped, reference_n=ahead))
    shift = run.position_m - ANGLE
    assert np.nanmax(np.abs(shift - np.nanmedian(shift))) < 1e-9
    known = np.isfinite(run.position_m)
    assert (run.reference_n - run.position_m)[known] == pytest.approx(0.1 * np.ones(known.sum()))
    assert 'whole turns' in notes[0]


def test_a_reference_that_steps_across_the_wrap_stays_with_its_position():
    wave = np.sin(2.0 * np.pi * 0.5 * TIME_S)
    angle, asked = 3.15 + 0.65 * wave, np.where(wave > 0.0, 3.8, 2.5)   # 3.8 rad is read as -2.5
    read = [np.arctan2(np.sin(each), np.cos(each)) for each in (angle, asked)]
    run, notes = unwrapped(turning(read[0], reference_n=read[1]))
    assert notes and run.reference_n - run.position_m == pytest.approx(asked - angle)


@pytest.mark.parametrize('angle', [
    ANGLE, np.where(TIME_S > 4.0, 4.0, 0.0), np.where(TIME_S > 4.0, 13.0, 0.0) + ANGLE])
def test_other_jumps_are_left(angle):
    run, notes = unwrapped(turning(angle))
    assert run.position_m is angle and notes == []


def test_a_motion_without_a_unit_is_told():
    imported = {'imported': {'mapping': ['time=t', 'position=q', 'command=u']}}
    run = replace(turning(ANGLE), information=imported)
    note, = units_not_given(run)
    assert 'taken in m' in note and 'position=q[rad]' in note
    given = {'imported': {'mapping': ['position=q[mm]', 'command=u[N]']}}
    assert units_not_given(replace(run, information=given)) == []
    assert units_not_given(turning(ANGLE)) == []


def test_what_is_given_twice_counts_once():
    run, other = turning(ANGLE), turning(2.0 * ANGLE)
    kept, notes = without_repeats([run, replace(run, source='copy'), other])
    assert kept == [run, other] and 'copy: holds the same samples as arm' in notes[0]
    assert 'compared with itself' in against_healthy([run], [run], None)[0]
    assert against_healthy([run], [other], None) == []


def test_healthy_recordings_of_another_kind_are_refused_by_their_signals():
    servo = turning(ANGLE, reference_n=ANGLE)
    with pytest.raises(InputError, match='other signals: here command and position'):
        against_healthy([turning(ANGLE)], [replace(servo, command_n=None)], None)
    measured = replace(turning(ANGLE), force_n=np.cos(TIME_S))
    with pytest.raises(InputError, match='other signals'):
        against_healthy([turning(ANGLE)], [measured], None)


def test_a_machine_that_follows_worse_than_its_healthy_self_is_compared_with_it():
    good, bad = (turning(ANGLE, reference_n=ahead * ANGLE, force_n=np.cos(TIME_S))
                 for ahead in (1.05, 1.2))
    good, bad = (replace(run, command_n=None) for run in (good, bad))
    assert drive_of([good]) != drive_of([bad])
    assert against_healthy([bad], [good], None) == []


def test_a_slow_joint_on_a_spring_is_no_swap_of_columns():
    run = joint(friction=0.1).between(0.0, 6.0)
    time = run.time_s - run.time_s[0]
    angle = np.interp(time, [0.0, 1.5, 4.5, 6.0], [0.0, 0.5, -0.5, 0.0])
    slow = replace(run, position_m=angle, command_n=5.0 * angle + 0.01 * np.sin(30.0 * time))
    check_joint(joint_groups([slow], {}, 0.2, [False], 'force')[0][-1])


def test_a_force_of_another_motion_and_swapped_columns_are_refused():
    run = joint(friction=0.1).between(0.0, 6.0)
    other = replace(run, command_n=np.sin(2.0 * np.pi * 1.13 * run.time_s))
    swapped = replace(run, command_n=run.position_m, position_m=run.command_n)
    for each, said in ((other, 'do not belong together'), (swapped, 'are swapped')):
        with pytest.raises(InputError, match=said):
            check_joint(joint_groups([each], {}, 0.2, [False], 'force')[0][-1])


def test_the_armature_of_isaac_is_said_to_be_the_whole_inertia():
    text = isaac({'knee': JointModel(True, 0.05, 0.1)}, 'made here')
    assert 'armature is the whole inertia, less that of your link' in text
    assert 'whole inertia' not in isaac({'slide': JointModel(False, 5.0, 1.0)}, 'made here')


@pytest.mark.filterwarnings('ignore')
def test_the_delay_of_a_file_is_said_where_it_is_not_that_of_the_answer():
    diagnosis = diagnose([joint(late_s=0.012).between(0.0, 6.0)], plant='joint').diagnosis
    weighed = diagnosis.groups[-1]
    record = diagnosis.best(weighed).fitted.record
    model = moved_by(weighed, record, diagnosis.runs)
    assert model.delay_s != pytest.approx(record['drive_delay'], abs=1e-4)
    assert f'{model.delay_s:#.3g}' in model.notes['delay']


@pytest.mark.filterwarnings('ignore')
def test_a_joint_with_a_wrapped_angle_is_diagnosed_as_without():
    run = joint().between(0.0, 6.0)
    # The course is within a turn: it wraps where it passes 0.
    answer = diagnose([replace(run, position_m=np.mod(run.position_m, 2.0 * np.pi))],
                      plant='joint')
    assert answer.verdict == 'no_gap'
    assert any('unwrapped' in note for note in answer.notes)


@pytest.mark.parametrize(('units', 'commanded', 'refusal'), [
    # The first was a KeyError; the second was answered, without gravity.
    ({'reference': 'deg', 'position': 'deg'}, False, "reference is in 'deg'; it takes N, Nm, m"),
    ({'position': 'deg', 'command': 'Nm'}, True, "position is in 'deg'; of a joint .* m or rad"),
    ({'reference': 'rad', 'position': 'deg'}, False, "position is in 'deg'; of a joint .* rad")])
def test_a_motion_in_another_unit_is_refused(units, commanded, refusal):
    run = replace(turning(ANGLE), information={'signals': units})
    run = run if commanded else replace(run, command_n=None, reference_n=1.01 * ANGLE)
    with pytest.raises(InputError, match=f'^arm: {refusal}'):
        diagnosis_of([run], {}, 'joint')
