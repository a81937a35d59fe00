"""What was found in MuJoCo and URDF, and the recordings replayed there."""

import importlib.util
import sys
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from documented import problems
from test_gap_joint import (
    DAMPING,
    INERTIA,
    RATE_HZ,
    TIME_S,
    joint,
    servo,
    sprung,
)

from asi_analysis import cli
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError, InputWarning
from asi_analysis.gap.answer import export
from asi_analysis.gap.answer.command import diagnose, nominal_model
from asi_analysis.gap.answer.joint_files import mjcf
from asi_analysis.gap.answer.joint_model import JointModel

needs_mujoco = pytest.mark.skipif(importlib.util.find_spec('mujoco') is None,
                                  reason="no MuJoCo: pip install -e '.[mujoco]'")
pytestmark = pytest.mark.filterwarnings('ignore::asi_analysis.errors.InputWarning')
FRICTION, GRAVITY = 0.15, 1.0      # N m


@pytest.fixture(scope='module')
def arm():
    """Return the diagnosis of a joint with gravity whose friction slides almost at once."""
    return diagnose([joint(friction=FRICTION, gravity=GRAVITY, bristle_rad=1e-4)], plant='joint')


def exported(gap, tmp_path):
    """Return the row of `exports` and the text of an MJCF of a diagnosis."""
    path = gap.write_export(tmp_path / 'joint.xml')
    return gap['exports'][-1], path.read_text()


@needs_mujoco
def test_mujoco_has_the_joint_that_was_recorded(arm, tmp_path):
    import mujoco
    row, text = exported(arm, tmp_path)
    assert problems(arm.to_dict(), 'asi gap') == []
    model = mujoco.MjModel.from_xml_string(text)
    data, inertia = mujoco.MjData(model), np.empty(1)
    assert model.dof_damping[0] == pytest.approx(DAMPING, rel=0.05)
    assert model.dof_frictionloss[0] == pytest.approx(FRICTION, rel=0.02)
    for angle in (-0.7, 0.0, 0.7):
        data.qpos[0] = angle
        mujoco.mj_forward(model, data)
        assert data.qfrc_bias[0] == pytest.approx(GRAVITY * np.sin(angle), abs=0.01)
        mujoco.mj_mulM(model, data, inertia, np.ones(1))
        assert inertia[0] == pytest.approx(INERTIA, rel=0.01)
    # Our own promise is for the force: from 22 % to 1.3 % of it.
    assert row['before_nrmse'] > 0.06
    assert row['after_nrmse'] < 0.01
    assert 'In MuJoCo' in str(arm)


@needs_mujoco
def test_friction_that_gives_way_before_it_slides_leaves_more(tmp_path):
    gap = diagnose([joint(friction=FRICTION, gravity=GRAVITY, bristle_rad=1e-3)], plant='joint')
    row, _ = exported(gap, tmp_path)
    assert 0.015 < row['after_nrmse'] < 0.025 < 0.06 < row['before_nrmse']


@needs_mujoco
def test_a_delay_and_a_drive_between_command_and_force(tmp_path):
    row, text = exported(diagnose([joint(late_s=0.012)], plant='joint'), tmp_path)
    assert row['before_nrmse'] > 0.2
    assert row['after_nrmse'] < 0.003
    assert 'delay="0.01' in text
    run = joint(friction=FRICTION, bristle_rad=1e-4)
    keep = np.exp(-1.0 / RATE_HZ / 0.01)
    volts = np.append(run.command_n[1:] - keep * run.command_n[:-1], 0.0) / (1.0 - keep) / 2.0
    driven = Run(TIME_S, command_n=volts, force_n=run.command_n, position_m=run.position_m,
                 source='driven', information={'signals': {
                     'position': 'rad', 'command': 'V', 'force': 'Nm'}})
    row, text = exported(diagnose([driven], plant='joint'), tmp_path)
    assert row['after_nrmse'] < 0.015 < 0.1 < row['before_nrmse']
    drive = ET.fromstring(text).find('actuator/general')
    assert float(drive.get('gainprm')) == pytest.approx(2.0, rel=0.01)
    assert float(drive.get('dynprm')) == pytest.approx(0.01, rel=0.05)


@needs_mujoco
def test_one_spring_holds_the_joint_in_recordings_about_other_positions(tmp_path):
    runs = [sprung(middle, seed) for seed, middle in enumerate((0.7, -0.5))]
    row, text = exported(diagnose(runs, plant='joint'), tmp_path)
    assert row['before_nrmse'] < 0.05 and row['after_nrmse'] < 0.05
    assert float(ET.fromstring(text).find('worldbody/body/joint').get('stiffness')) == (
        pytest.approx(2.0, rel=0.01))
    assert row['unsaid'] == []


@needs_mujoco
def test_servos_follow_in_mujoco_as_they_did(tmp_path):
    row, text = exported(diagnose([servo(late=8)], plant='joint'), tmp_path)
    assert row['after_nrmse'] < 0.005 < 0.2 < row['before_nrmse']
    kp, kv = (-float(each) for each in
              ET.fromstring(text).find('actuator/general').get('biasprm').split()[1:])
    assert kp == pytest.approx(40.0 ** 2, rel=0.03)
    assert kv == pytest.approx(2.0 * 0.6 * 40.0, rel=0.03)
    # A largest speed is a largest push against a damping, which no acceleration limits.
    row, _ = exported(diagnose([servo(rate=3.0, acceleration=60.0)], plant='joint'), tmp_path)
    assert row['after_nrmse'] < 0.02
    assert 'acceleration of the servo, at most 59' in row['unsaid'][0]


@needs_mujoco
def test_friction_in_mujoco_is_coulomb_friction():
    """A joint that slides to rest, and stays there under less than its friction."""
    import mujoco
    stop = 0.5 * INERTIA / FRICTION     # rad, from 1 rad/s
    file = mjcf({'joint': JointModel(True, INERTIA, friction=FRICTION, period_s=0.002)}, '')
    usual = file.replace('solreffriction', 'solreflimit').replace('solimpfriction', 'solimplimit')
    errors = []
    for text in (file, usual):
        model = mujoco.MjModel.from_xml_string(text)
        data = mujoco.MjData(model)
        data.qvel[0] = 1.0
        while data.time < 1.0:
            data.ctrl[0] = 0.5 * FRICTION * (data.time > 0.5)
            mujoco.mj_step(model, data)
        errors.append(abs(data.qpos[0] / stop - 1.0))
    assert errors[0] < 0.005 < 0.03 < errors[1]


@needs_mujoco
def test_mujoco_reads_the_urdf(arm, tmp_path):
    import mujoco
    model = mujoco.MjModel.from_xml_path(str(arm.write_export(tmp_path / 'joint.urdf')))
    data, inertia = mujoco.MjData(model), np.empty(1)
    mujoco.mj_forward(model, data)
    mujoco.mj_mulM(model, data, inertia, np.ones(1))
    assert inertia[0] == pytest.approx(INERTIA, rel=0.01)
    assert model.dof_damping[0] == pytest.approx(DAMPING, rel=0.05)
    assert model.dof_frictionloss[0] == pytest.approx(FRICTION, rel=0.02)


def test_urdf_has_what_it_has_words_for(arm, tmp_path):
    root = ET.parse(arm.write_export(tmp_path / 'joint.urdf')).getroot()
    dynamics = root.find('joint/dynamics')
    assert float(dynamics.get('damping')) == pytest.approx(DAMPING, rel=0.05)
    assert float(dynamics.get('friction')) == pytest.approx(FRICTION, rel=0.02)
    assert root.find('joint').get('type') == 'continuous'
    place = [float(each) for each in root.find('link/inertial/origin').get('xyz').split()]
    mass = float(root.find('link/inertial/mass').get('value'))
    assert [9.81 * mass * each for each in place] == pytest.approx([0.0, 0.0, -GRAVITY], abs=0.01)
    inertia = float(root.find('link/inertial/inertia').get('iyy'))
    assert inertia + mass * np.dot(place, place) == pytest.approx(INERTIA, rel=0.01)


def test_parameters_are_read_again_as_the_nominal_joint(arm, tmp_path):
    values = nominal_model(arm.write_export(tmp_path / 'joint.yaml'), 'joint')
    known = {'load.mass': INERTIA, 'load.damping': DAMPING, 'gravity.sine': GRAVITY,
             'friction.coulomb': FRICTION, 'friction.stiction_push': FRICTION}
    assert {name: values[name] for name in known} == pytest.approx(known, rel=0.05)
    assert values['joint.type'] == 'revolute'
    again = diagnose(arm.runs, values, plant='joint')
    assert again.verdict == 'no_gap'


def test_without_mujoco_the_answer_says_how_to_get_it(arm, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, 'mujoco', None)
    row, _ = exported(arm, tmp_path)
    assert row['simulator'] is None
    assert row['shrink'] is None
    assert 'pip install mujoco' in str(arm)


@needs_mujoco
def test_what_mujoco_does_not_load_is_said(arm, tmp_path, monkeypatch):
    import mujoco
    monkeypatch.setattr(export, 'mjcf', lambda *_: '<mujoco><joint late="1"/></mujoco>')
    with pytest.warns(InputWarning, match=f'MuJoCo {mujoco.__version__} does not load'):
        row, _ = exported(arm, tmp_path)
    assert row['shrink'] is None
    assert 'could not replay' in str(arm)


@pytest.mark.parametrize(('file', 'message'), [
    ('joint.xml', 'MJCF has no words for a valve'), ('joint.sdf', "'.sdf' is not allowed"),
    ('joint', "ending '' is not allowed"), ('nowhere/a.yaml', 'nowhere is not a directory')])
def test_what_cannot_be_exported_is_refused_at_once(file, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, 'argv', ['asi', 'gap', 'no_bag', '--export', file])
    assert cli.main() == 2
    assert message in capsys.readouterr().err


@pytest.mark.slow
def test_a_loop_of_velocity_is_no_servo_of_these_formats(tmp_path):
    time = np.arange(0.0, 20.0, 0.01)
    reference = np.sin(2.0 * np.pi * 0.3 * time) + 0.3 * np.sin(2.0 * np.pi * 1.1 * time)
    run = Run(time, reference_n=reference, velocity_m_s=np.roll(reference, 10), source='loop',
              information={'signals': {'reference': 'm/s', 'velocity': 'm/s'}})
    gap = diagnose([run], plant='joint')
    with pytest.raises(InputError, match='loop: --export takes a joint that is moved by a force'):
        gap.write_export(tmp_path / 'joint.xml')
