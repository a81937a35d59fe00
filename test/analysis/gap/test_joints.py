"""Several joints of a robot, in a table and in one answer."""

import importlib.util
import json
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import yaml
from documented import problems
from test_gap_joint import INERTIA, RATE_HZ, TIME_S, joint

from asi_analysis.bags.exchange.importing import import_joints, read_joint, read_joints
from asi_analysis.bags.exchange.summary import ImportedJoints
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.gap.answer.command import diagnose
from asi_analysis.gap.answer.joints import Rest, _coupled, diagnose_joints
from asi_analysis.gap.motion import motion_of
from asi_analysis.gap.sampling import clipped, noise_of
from asi_analysis.parallel import workers

MAPPING = ('time=t', 'position=q_{joint}[rad]', 'command=tau_{joint}*2[Nm]')
SHORT = slice(0.0, 8.0)


def table(path: Path, **joints: Run) -> Path:
    """Write joints as a table; `temperature` and the angle of a camera are no joints of it."""
    time_s = next(iter(joints.values())).time_s
    columns = {'t': time_s, 'temperature': 20.0 + 0.0 * time_s, 'q_camera': 0.0 * time_s}
    for name, run in joints.items():
        columns |= {f'q_{name}': run.position_m, f'tau_{name}': 0.5 * run.command_n}
    np.savetxt(path, np.column_stack(list(columns.values())), delimiter=',',
               header=','.join(columns), comments='')
    return path


def test_joints_of_a_table_become_bags_with_one_clock(tmp_path):
    hip, knee = joint()[SHORT], joint(friction=0.15)[SHORT]
    found = import_joints(table(tmp_path / 'log.csv', hip=hip, knee=knee), MAPPING,
                          out=tmp_path / 'robot')
    again = read_joints([tmp_path / 'robot'])
    for name, run in (('hip', hip), ('knee', knee)):
        for other in (found[name], *again[name]):
            np.testing.assert_allclose(other.signal('command'), run.command_n)
            np.testing.assert_allclose(other.time_s, run.time_s)
            assert other.unit('position') == 'rad'
    assert problems(ImportedJoints.of(found, tmp_path / 'robot').to_dict(),
                    'asi import {joint}') == []
    with pytest.raises(InputError, match=r'no joint has a column of each signal: .*_hip|has none'):
        import_joints(tmp_path / 'log.csv', (*MAPPING, 'velocity=dq_{joint}[rad/s]'))
    with pytest.raises(InputError, match='expected a bag with joint states, or a folder'):
        read_joints([tmp_path])


def test_each_joint_is_diagnosed_and_one_that_cannot_be_says_why():
    robot = {'hip': [joint(late_s=0.012)[SHORT]], 'knee': [joint(friction=0.15)[SHORT]]}
    robot['wheel'] = [replace(robot['hip'][0], position_m=np.zeros(robot['hip'][0].time_s.size))]
    with workers(2):
        answer = diagnose_joints(robot)
    hip, knee, wheel = answer.joints
    assert [each['joint'] for each in answer.joints] == list(robot)
    assert 'transport_delay' in hip['answer']['ambiguity_set']
    assert knee['answer']['which'][0]['effect'] == 'coulomb_friction'
    assert wheel['answer'] is None and 'nothing to compare' in wheel['error']
    assert problems(json.loads(json.dumps(answer.to_dict(), allow_nan=False)),
                    'asi gap --joint all') == []
    assert 'sliding friction 0.15' in str(answer) and 'one clock' in str(answer)
    with pytest.raises(InputError, match='wheel: .*nothing to compare'):
        diagnose_joints({'wheel': robot['wheel']})
    with pytest.raises(InputError, match='knee: no healthy recording of this joint'):
        diagnose_joints({'knee': robot['knee']}, {'hip': robot['hip']})


def test_what_was_found_of_each_joint_is_written_together_or_apart(tmp_path):
    robot = {'left/hip': [joint(late_s=0.012)[SHORT]], 'knee': [joint(friction=0.15)[SHORT]]}
    paths = [tmp_path / name for name in (
        'each', '{joint}.xml', 'robot.yaml', 'robot.xml', 'robot.urdf', 'robot.isaac.yaml')]
    with workers(2):
        answer = diagnose_joints(robot, exports=paths)
    assert problems(json.loads(json.dumps(answer.to_dict(), allow_nan=False)),
                    'asi gap --joint all') == []
    assert [Path(row['file']).name for row in answer.exports] == [
        'left_hip.yaml', 'knee.yaml', 'left_hip.xml', 'knee.xml', *(p.name for p in paths[2:])]
    # One file of all nodes has a namespace for each; each of the others is for a node anywhere.
    together = yaml.safe_load(paths[2].read_text())
    assert list(together) == ['/left_hip/asi_actuator', '/knee/asi_actuator']
    for name in ('left_hip', 'knee'):
        values = together[f'/{name}/asi_actuator']['ros__parameters']
        alone = yaml.safe_load((tmp_path / 'each' / f'{name}.yaml').read_text())
        assert alone['/**/asi_actuator']['ros__parameters'] == values
        assert values['plant'] == 'joint'
    assert together['/left_hip/asi_actuator']['ros__parameters']['command_path'][
        'delay'] == pytest.approx(0.012, rel=0.1)
    for path in paths[3:5]:
        names = {each.get('name') for each in ET.parse(path).iter('joint')}
        assert {'left/hip', 'knee'} <= names
    if importlib.util.find_spec('mujoco') is not None:
        import mujoco
        for path in paths[3:5]:
            assert mujoco.MjModel.from_xml_path(str(path)).njnt == 2
    knee = yaml.safe_load(paths[5].read_text())['actuators']['knee']
    assert knee['friction'] == pytest.approx(0.15, rel=0.05)
    assert knee['armature'] == pytest.approx(INERTIA, rel=0.05)
    assert knee['stiffness'] == knee['damping'] == knee['min_delay'] == 0
    assert yaml.safe_load(paths[5].read_text())['actuators']['left/hip']['max_delay'] == round(
        0.012 * RATE_HZ)


def test_what_another_joint_does_to_one_is_told():
    hip, knee = joint(), joint(gravity=1.0)
    shaken = np.gradient(np.gradient(hip.position_m)) * RATE_HZ ** 2
    rng = np.random.default_rng(1)
    runs = {'hip': [hip], 'knee': [replace(knee, position_m=np.sin(TIME_S))]}
    noise = rng.standard_normal(TIME_S.size)
    rests = {'hip': [Rest(TIME_S, noise)], 'knee': [Rest(TIME_S, shaken + 0.1 * noise)]}
    assert _coupled('hip', rests, runs) == (None, None)
    other, share = _coupled('knee', rests, runs)
    assert other == 'hip' and share > 0.5


def test_a_name_with_a_slash_and_names_that_have_one_folder(tmp_path):
    hip = joint()[SHORT]
    log = table(tmp_path / 'log.csv', **{'left/hip': hip, 'left/knee': hip})
    assert list(import_joints(log, MAPPING, out=tmp_path / 'robot')) == ['left/hip', 'left/knee']
    run, = read_joint([tmp_path / 'robot'], 'left/hip')
    assert len(run) == len(hip)
    log = table(tmp_path / 'log.csv', **{'left/hip': hip, 'left_hip': hip})
    with pytest.raises(InputError, match='left/hip, left_hip would have one folder'):
        import_joints(log, MAPPING)


@pytest.mark.parametrize(('second', 'refusal'), [
    ({'information': {'signals': {'position': 'm', 'command': 'V'}}}, 'is in (V|m), in joint in'),
    ({'information': {'signals': {'position': 'deg', 'command': 'Nm'}}}, 'in deg, in joint in r'),
    ({'position_m': None}, 'nothing to compare: .*signals that move here: command$')])
def test_recordings_that_do_not_go_together_are_refused(second, refusal):
    hip = joint()[SHORT]
    with pytest.raises(InputError, match=refusal):
        diagnose([hip, replace(hip, source='other', **second)], plant='joint')


def test_a_position_at_rest_at_its_ends_is_not_cut_off_and_a_clipped_one_is():
    x = np.repeat([0.0, 0.5, 1.0], [40, 400, 60])
    x[40:440] = 0.5 - 0.5 * np.cos(np.pi * np.arange(400) / 400)
    assert not clipped(x).any()
    cut = np.clip(x, 0.0, 0.7)
    assert clipped(cut).sum() == (cut == 0.7).sum() > 100


def test_three_seconds_of_a_servo_at_30_hz_are_answered():
    time_s = np.arange(90) / 30.0
    x = np.sin(time_s).astype(np.float32).astype(float)
    gap = diagnose([Run(time_s, reference_n=x + 0.1, position_m=x, source='arm', information={
        'signals': {'position': 'rad', 'reference': 'rad'}})], plant='joint')
    assert 0.0 <= gap.gap['after_nrmse'] <= gap.gap['before_nrmse'] < 1.0
    assert 'The gap' in str(gap) and 'cut off' not in str(gap)


@pytest.mark.parametrize('period_s', [2.0, 2000.0])
def test_a_joint_whose_time_is_in_a_wrong_unit_is_answered_or_refused(period_s):
    hip = joint()[SHORT]
    slow = motion_of(hip.position_m, None, {'position': noise_of(hip.position_m)}, 0.1 / period_s,
                     period_s)[0]
    assert np.isfinite(slow.velocity).all()
