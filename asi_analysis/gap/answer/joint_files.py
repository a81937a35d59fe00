"""Joints as a file for a simulator: MJCF of MuJoCo, URDF, actuators of Isaac Lab."""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, Final
from xml.etree import ElementTree as ET

from asi_analysis.gap.answer.joint_model import JointModel
from asi_analysis.gap.words import digits
from asi_common.parameter_file import scalar

GRAVITY: Final = 9.81           # m/s2
JOINT: Final = 'joint'          # the name of one alone
# MuJoCo's friction is a soft constraint. With a time constant of two steps, the least that it
# takes, and hardly any softness a joint slides to rest within 0.4 % of Coulomb's law at this step;
# with the usual values 3 % farther, at any step (test_export.py).
LONGEST_STEP_S: Final = 5e-4
STIFF: Final = '0.9999 0.9999 0.001'
# Steps: angle of a servo's natural frequency in each, rad, and most in a sample.
ANGLE: Final = 0.1
MOST_STEPS: Final = 64
# Shares of the inertia: of a mass that hangs where gravity acts; of a link beside its armature.
HANGING: Final = 0.5
TINY: Final = 1e-3


def steps(model: JointModel) -> int:
    """Return into how many steps a simulator cuts a sample."""
    longest = min(LONGEST_STEP_S, ANGLE / math.sqrt(model.kp) if model.kp else math.inf)
    return min(max(math.ceil(model.period_s / longest - 1e-9), 1), MOST_STEPS)


def mjcf(models: Mapping[str, JointModel], origin: str) -> str:
    """
    Return joints by name as one model of MuJoCo, each with a link of its own in the world.

    origin: what they were found from.
    """
    step = min(model.period_s / steps(model) for model in models.values())
    root = ET.Element('mujoco', model='robot' if len(models) > 1 else JOINT)
    root.append(_comment([origin, *(
        line for name, model in models.items()
        for line in _named(name, [*_about(model), *_hints(model)]))]))
    ET.SubElement(root, 'compiler', angle='radian', autolimits='true')
    ET.SubElement(root, 'option', timestep=_text(step), integrator='implicitfast',
                  gravity=f'0 0 {-GRAVITY}')
    world = ET.SubElement(root, 'worldbody')
    drives = ET.SubElement(root, 'actuator')
    for name, model in models.items():
        _add_joint(world, name, model, step)
        _add(drives, 'general', {'name': _of(name, 'drive'), 'joint': name,
                                 **_actuator(model, step)})
    return _document(root)


def _of(name: str, part: str) -> str:
    """Return the name of a part of a joint."""
    return part if name == JOINT else f'{name}_{part}'


def _named(name: str, lines: Sequence[str]) -> list[str]:
    """Return lines about a joint, with its name if it is one of several."""
    return [line if name == JOINT else f'{name}: {line}' for line in lines]


def _add_joint(world: ET.Element, name: str, model: JointModel, step: float) -> None:
    """Add a joint with its link to the world of a model of MuJoCo."""
    body = ET.SubElement(world, 'body', name=_of(name, 'link'))
    mass, place, inertia = _link(model)
    armature = 0.0
    if model.turns:   # gravity acts on a mass at its place; the rest is the rotor's or the link's
        inertia = min(inertia, TINY * model.inertia)
        armature = model.inertia - inertia - mass * (place[0] ** 2 + place[2] ** 2)
    joint: dict[str, str | float] = {
        'name': name, 'type': 'hinge' if model.turns else 'slide', 'axis': _axis(model),
        'armature': armature, 'damping': model.damping, 'frictionloss': model.friction,
        'stiffness': model.stiffness, 'springref': model.rest if model.stiffness else 0.0}
    if model.friction:
        joint |= {'solreffriction': f'{_text(2.0 * step)} 1', 'solimpfriction': STIFF}
    _add(body, 'joint', joint)
    _add(body, 'inertial', {'mass': mass, 'pos': _row(place),
                            'diaginertia': _row([inertia] * 3)})


def _actuator(model: JointModel, step: float) -> dict[str, str | float]:
    """Return the attributes of MuJoCo's actuator."""
    drive: dict[str, str | float] = {'gainprm': model.gain}
    if model.bias or model.kp:
        drive |= {'biastype': 'affine', 'biasprm': _row([model.bias, -model.kp, -model.kv])}
    if model.lag_s:
        drive |= {'dyntype': 'filterexact', 'dynprm': model.lag_s}
    if late := round(model.delay_s / step):
        drive |= {'delay': late * step, 'nsample': str(late)}
    if math.isfinite(model.most_command):
        drive['ctrlrange'] = _row([model.least_command, model.most_command])
    if math.isfinite(model.most_push):
        drive['forcerange'] = _row([-model.most_push, model.most_push])
    return drive


def _hints(model: JointModel) -> list[str]:
    """Return how to take the values of a MuJoCo model over into another."""
    hints = [f'The recording moved from {digits(model.travel[0])} to {digits(model.travel[1])}: '
             'the range of the joint is not known from it.']
    if model.friction:
        hints.append('solreffriction and solimpfriction make frictionloss Coulomb friction; the '
                     'first number is two time steps.')
    if model.turns and not model.kp:
        hints.append('Only the whole inertia shows. With a link of your own: armature = inertia '
                     'above, less that of your link about this axis.')
    if model.delay_s:
        hints.append('delay needs MuJoCo 3.5 or later, and an nsample of delay over time step.')
    return hints


def urdf(models: Mapping[str, JointModel], origin: str) -> str:
    """
    Return joints by name as a robot, each with a link of its own on the base.

    What URDF has no word for is in a comment.
    """
    root = ET.Element('robot', name='robot' if len(models) > 1 else JOINT)
    root.append(_comment([
        origin, *(line for name, model in models.items() for line in _named(name, [
            *_about(model), *(f'URDF has no word for {each}'
                              for each in unsaid_in_urdf(model))])),
        'limit: what was found, else the largest of the recording; the ends of the travel are not '
        'known from it.']))
    ET.SubElement(root, 'link', name='base')
    for name, model in models.items():
        _add_urdf_joint(root, name, model)
    return _document(root)


def _add_urdf_joint(root: ET.Element, name: str, model: JointModel) -> None:
    """Add a joint with its link to a robot."""
    inertial = ET.SubElement(ET.SubElement(root, 'link', name=_of(name, 'link')), 'inertial')
    mass, place, inertia = _link(model)
    ET.SubElement(inertial, 'origin', xyz=_row(place))
    ET.SubElement(inertial, 'mass', value=_text(mass))
    about = dict.fromkeys(('ixx', 'iyy', 'izz'), _text(inertia))
    ET.SubElement(inertial, 'inertia', about | {'ixy': '0', 'ixz': '0', 'iyz': '0'})
    joint = ET.SubElement(root, 'joint', name=name,
                          type='continuous' if model.turns else 'prismatic')
    ET.SubElement(joint, 'parent', link='base')
    ET.SubElement(joint, 'child', link=_of(name, 'link'))
    ET.SubElement(joint, 'axis', xyz=_axis(model))
    effort = model.most_push if math.isfinite(model.most_push) else model.seen_push
    speed = model.most_speed if math.isfinite(model.most_speed) else model.seen_speed
    limit = {'effort': _text(effort), 'velocity': _text(speed)}
    if not model.turns:
        limit |= {'lower': _text(model.travel[0]), 'upper': _text(model.travel[1])}
    ET.SubElement(joint, 'limit', limit)
    ET.SubElement(joint, 'dynamics', damping=_text(model.damping), friction=_text(model.friction))


def isaac(models: Mapping[str, JointModel], origin: str) -> str:
    """
    Return joints by name as the fields of Isaac Lab's `DelayedPDActuatorCfg`, in YAML.

    What it has no word for is in comments. Its delays count steps of the physics: samples here.
    """
    lines = [f'# {line}' for line in (
        origin, 'Fields of isaaclab.actuators.DelayedPDActuatorCfg, SI units. stiffness and '
        'damping are the gains of the drive; friction is an effort (Isaac Sim 5 or later; before, '
        'it was a coefficient).')] + ['actuators:']
    for name, model in models.items():
        late = round(model.delay_s / model.period_s)
        effort = model.most_push if math.isfinite(model.most_push) else model.seen_push
        speed = model.most_speed if math.isfinite(model.most_speed) else model.seen_speed
        values: dict[str, float | int] = {
            'stiffness': model.kp, 'damping': model.kv, 'armature': model.inertia,
            'friction': model.friction, 'viscous_friction': model.damping,
            'effort_limit': effort, 'velocity_limit': speed, 'min_delay': late,
            'max_delay': late}
        whole = ['armature is the whole inertia, less that of your link about this axis']
        said = [*_about(model), *whole * (model.turns and not model.kp),
                f'a step of the delays: {_text(model.period_s)} s', *(
            f'Isaac Lab has no word for {each}' for each in unsaid_in_isaac(model))]
        lines += [f'  {scalar(name)}:', *(f'    # {line}' for line in said),
                  f'    joint_names_expr: [{scalar(name)}]',
                  *(f'    {field}: {scalar(value)}' for field, value in values.items())]
    return '\n'.join(lines) + '\n'


def unsaid_in_isaac(model: JointModel) -> list[str]:
    """Return the values of a joint model that an actuator of Isaac Lab has no word for."""
    gain = model.gain / model.kp if model.kp else model.gain
    rest = {'gain': gain if abs(gain - 1.0) > 1e-9 else 0.0, 'constant push': model.bias,
            'lag (s)': model.lag_s, 'spring': model.stiffness, 'gravity times sin q': model.sine,
            'gravity times cos q': model.cosine}
    return [f'{name} {_text(value)}' for name, value in rest.items() if value]


def unsaid_in_urdf(model: JointModel) -> list[str]:
    """Return the values of a joint model that URDF has no word for."""
    drive = {'gain': model.gain if model.gain != 1.0 else 0.0, 'constant push': model.bias,
             'kp': model.kp, 'kv': model.kv, 'delay (s)': model.delay_s, 'lag (s)': model.lag_s,
             'stiffness': model.stiffness}
    return [f'{name} {_text(value)}' for name, value in drive.items() if value]


def _link(model: JointModel) -> tuple[float, tuple[float, float, float], float]:
    """
    Return mass, place of its centre (m) and inertia about that of the link.

    Of a joint that turns only inertia and gravity show: half of the inertia is a mass that hangs.
    """
    if not model.turns:
        return model.inertia, (0.0, 0.0, 0.0), TINY * model.inertia
    moment = math.hypot(model.sine, model.cosine) / GRAVITY    # mass times distance
    if moment == 0.0:
        return model.inertia, (0.0, 0.0, 0.0), model.inertia
    mass = moment ** 2 / (HANGING * model.inertia)
    # About y a mass at x, z takes the torque mass g (-x cos q - z sin q) to be held.
    place = (-model.cosine / GRAVITY / mass, 0.0, -model.sine / GRAVITY / mass)
    return mass, place, (1.0 - HANGING) * model.inertia


def _axis(model: JointModel) -> str:
    return '0 1 0' if model.turns else '1 0 0'


def _about(model: JointModel) -> list[str]:
    """Return what is said of a joint in any format."""
    force = 'N m' if model.turns else 'N'
    lines = []
    if model.unit not in ('', 'N', 'Nm', 'N m'):
        lines.append(f'The command was in {model.unit}: that stands in place of {force} in '
                     'inertia, damping, friction and gravity, and the motion is the same.')
    if model.kp:
        lines.append('The inertia behind the servo does not show. It is 1 here: with another, '
                     'gain, bias, kp, kv, damping and forcerange grow as it does.')
    return [*lines, *model.notes.values(),
            *(f'Not in this model: {each}' for each in model.unsaid)]


def _text(value: float) -> str:
    return f'{value + 0.0:.6g}'


def _row(values: Sequence[float]) -> str:
    return ' '.join(map(_text, values))


def _add(parent: ET.Element, tag: str, values: Mapping[str, str | float]) -> None:
    """Add an element with those of its attributes that are not zero."""
    ET.SubElement(parent, tag, {name: value if isinstance(value, str) else _text(value)
                                for name, value in values.items() if value})


def _comment(lines: Sequence[str]) -> Any:
    """Return lines as a comment, in which XML allows no two dashes."""
    return ET.Comment('\n    ' + re.sub('-(?=-)', '- ', '\n    '.join(lines)) + '\n  ')


def _document(root: ET.Element) -> str:
    ET.indent(root)
    return ET.tostring(root, encoding='unicode') + '\n'
