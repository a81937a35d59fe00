"""
The table of the parameters of a simulated joint; every effect is null by default.

Blocks that the actuator has too have the same names there and here. A joint that turns has rad,
Nm, kg m2 where one that slides has m, N, kg.
"""

from collections.abc import Mapping
from typing import Final

import numpy as np

from asi_actuator.parameters import ACTUATOR_PARAMETERS, RING
from asi_common.parameter import Parameter, ParameterError, Table, Value
from asi_common.record import record_dtype, record_of

TYPES: Final = ('revolute', 'prismatic')
# Units of a joint that slides and, in the same place, of one that turns.
TURNING: Final = {
    'N': 'Nm', 'm': 'rad', 'kg': 'kg m2', 'm/s': 'rad/s', 'm/s2': 'rad/s2', 'N/m': 'Nm/rad',
    'N s/m': 'Nm s/rad', 'N/s': 'Nm/s', 'N/s2': 'Nm/s2'}
UNITS: Final = {unit: f'{unit} or {turning}' for unit, turning in TURNING.items()}
LARGE: Final = 1e9
_ACTUATOR: Final = {parameter.name: parameter for parameter in ACTUATOR_PARAMETERS}


def _row(name: str, default: float, unit: str, description: str, low: float = 0.0,
         high: float = LARGE) -> Parameter:
    return Parameter(name, default, UNITS.get(unit, unit), description, low, high)


def _size(name: str, default: float = 0.0, description: str = '', low: float = 0.0,
          high: float = LARGE) -> Parameter:
    """Return a parameter of the actuator as one of a joint, which may be of any size."""
    row = _ACTUATOR[name]
    return _row(name, default, row.unit, description or row.description, low, high)


def _same(name: str) -> Parameter:
    """Return a parameter of the actuator that a joint has unchanged, without its source."""
    return _ACTUATOR[name]._replace(source='', unit=UNITS.get(_ACTUATOR[name].unit,
                                                               _ACTUATOR[name].unit))


class JointTable(Table):
    """The joint's parameters; a servo without a stiffness has neither damping nor integral."""

    def check(self, values: Mapping[str, Value]) -> None:
        """Raise ParameterError for a part of a servo's law without its main one."""
        for name in ('servo.kv', 'servo.ki'):
            if values[name] and not values['servo.kp']:
                raise ParameterError(f'{name} = {values[name]!r} is not allowed with servo.kp = '
                                     '0.0: without servo.kp the command is a force')


JOINT_PARAMETERS: Final = JointTable((
    Parameter('joint.type', 'revolute', '', 'revolute: it turns; prismatic: it slides. Names the '
              'units of the recording', choices=TYPES, read_only=True),
    Parameter('maximum_substep', 1e-4, 's', 'Longest sub-step of the integration', 1e-6, 1e-3,
              read_only=True),

    _size('command_limit', 4000.0, 'Largest command: a force or torque or, with servo.kp, a '
          'position', 1e-6),
    _row('command_path.delay', 0.0, 's', 'Transport delay of the command', 0.0, 1.0),
    _size('command_path.quantum', description='Step of the quantised command; 0: none'),
    _same('command_path.rounding'),

    _row('drive.deadband', 0.0, 'N', 'Half width of the dead band of the command'),
    _row('drive.gain', 1.0, '', 'Force per command or, with servo.kp, position per command',
         -LARGE),
    _row('drive.bias', 0.0, 'N', 'Force at no command or, with servo.kp, position', -LARGE),
    _row('drive.lag_time', 0.0, 's', 'Time constant of the drive', 0.0, 10.0),
    _row('drive.second_lag_time', 0.0, 's', 'Time constant of a second lag', 0.0, 10.0),
    _row('drive.warm_loss', 0.0, '', 'Share of the force that the drive loses as it gets warm',
         -1.0, 1.0),
    _row('drive.warm_time', 100.0, 's', 'Time constant of getting warm', 1e-3),
    _row('drive.force_limit', 0.0, 'N', 'Largest force of the drive; 0: no limit'),
    _row('drive.force_rate_limit', 0.0, 'N/s', 'Fastest change of the force; 0: no limit'),
    _row('servo.kp', 0.0, 'N/m', 'Force per distance from the position that is asked for; 0: no '
         'servo, the command is a force'),
    _row('servo.kv', 0.0, 'N s/m', 'Force against the velocity'),
    _row('servo.ki', 0.0, 'N/(m s)', 'Force per distance and time, of the integral'),
    _row('servo.rate_limit', 0.0, 'm/s', 'Largest velocity that the servo lets happen; 0: no '
         'limit'),
    _row('servo.acceleration_limit', 0.0, 'm/s2', 'Largest force of the servo over load.mass; 0: '
         'no limit'),

    _size('load.mass', 1.0, 'Mass or inertia: all that moves', 1e-9),
    _size('load.damping', description='Viscous friction of the load'),
    _size('load.stiffness', description='Spring that holds the load'),
    _row('load.rest', 0.0, 'm', 'Position at which that spring is relaxed', -LARGE),
    _row('load.offset', 0.0, 'N', 'Constant force that the drive has to hold', -LARGE),
    _row('load.start', 0.0, 'm', 'Position at the start, where the joint rests', -LARGE),
    _size('load.external_force', low=-LARGE, description='Push from outside on the joint'),
    _same('load.external_force_start'),
    _same('load.external_force_end'),
    _same('load.external_force_frequency'),
    _same('load.external_force_phase'),
    _row('gravity.sine', 0.0, 'N', 'Gravity that the drive has to hold, times the sine of the '
         'position', -LARGE),
    _row('gravity.cosine', 0.0, 'N', 'The same, times its cosine', -LARGE),
    _row('ripple.force', 0.0, 'N', 'Force that goes up and down with the position, as cogging '
         'does: its amplitude'),
    _row('ripple.period', 0.1, 'm', 'Way from one ripple to the next', 1e-9),
    _row('ripple.phase', 0.0, 'turns', 'Phase of the ripple at position 0', -1.0, 1.0),

    Parameter('friction.model', 'full', '', 'full: with dry friction; linear: linear_gain times '
              'the velocity; off: viscous alone', choices=_ACTUATOR['friction.model'].choices),
    _size('friction.linear_gain'),
    _size('friction.coulomb'),
    _same('friction.coulomb_asymmetry'),
    _size('friction.viscous', description='Viscous friction of the motor'),
    _same('friction.softening'),
    _same('friction.element_ratio'),
    _same('friction.presliding_slip'),
    _same('friction.presliding_exponent'),
    _size('friction.stiction_push', description='Breakaway force upwards, if it is larger than '
          'the Coulomb friction'),
    _size('friction.stiction_pull', description='Breakaway force downwards, if it is larger than '
          'the Coulomb friction'),
    _size('friction.stribeck_velocity', 0.01, low=1e-9),
    _size('friction.presliding_stiffness', 1e4, 'Stiffness of what rubs before it slides', 1e-6,
          1e12),
    _size('friction.presliding_damping', 0.1, 'Damping of what rubs before it slides'),

    _size('coupling.stiffness', description='Stiffness between motor and load: a compliance; 0: '
          'rigid'),
    _size('coupling.damping', description='Damping between motor and load'),
    _row('coupling.piston_share', 0.3, '', 'Share of load.mass on the side of the motor, if a '
         'compliance or backlash divides it', 0.01, 0.99),
    _size('backlash.gap'),
    _size('backlash.centre', low=-LARGE, description='Position of the motor in the middle of the '
          'gap'),
    _same('backlash.location'),
    _size('backlash.contact_stiffness', 1e5, low=1e-3, high=1e12),

    _same('force_sensor.gain'),
    _size('force_sensor.offset', low=-LARGE),
    _row('force_sensor.lag_time', 0.0, 's', 'Time constant of the force sensor', 0.0, 1.0),
    _size('force_sensor.drift', low=-LARGE),
    _size('force_sensor.drift_curve', low=-LARGE),
    _size('force_sensor.noise'),
    Parameter('force_sensor.noise_seed', 1, '', 'Seed of the noise of all sensors', 0, 2**31 - 1),
    _row('position_sensor.gain', 1.0, 'm/m', 'Scale of the measured position', 0.1, 10.0),
    _row('position_sensor.offset', 0.0, 'm', 'Offset of the measured position', -LARGE),
    _row('position_sensor.drift', 0.0, 'm/s', 'Drift of that offset', -LARGE),
    _row('position_sensor.lag_time', 0.0, 's', 'Time constant of the position sensor', 0.0, 1.0),
    _row('position_sensor.resolution', 0.0, 'm', 'Step of the encoder; 0: none'),
    _row('position_sensor.noise', 0.0, 'm', 'Standard deviation of the measured position'),
    _row('velocity_sensor.noise', 0.0, 'm/s', 'Standard deviation of the measured velocity'),
))
JOINT_DTYPE = record_dtype(JOINT_PARAMETERS)


def as_record(values: Mapping[str, Value] | None = None) -> np.void:
    """
    Return the record that the compiled physics of the joint reads.

    Raises ParameterError for an unknown name, or a value or combination that is not allowed.
    """
    p = record_of(values or {}, JOINT_PARAMETERS)
    # Friction does not rise when the motion begins: breakaway is at least the sliding friction.
    for name, sign in (('push', 1.0), ('pull', -1.0)):
        field = f'friction_stiction_{name}'
        p[field] = max(p[field], p['friction_coulomb'] * (
            1.0 + sign * p['friction_coulomb_asymmetry']))
    return p


def check_delay(values: Mapping[str, Value], period_s: float) -> None:
    """Raise ParameterError if the delay is longer than what is remembered at a period (s)."""
    longest = (RING - 2) * period_s
    if float(values['command_path.delay']) > longest:
        raise ParameterError(
            f'command_path.delay = {values["command_path.delay"]!r} is not allowed at '
            f'{1.0 / period_s:g} Hz: it takes at most {longest:g} s there')


def units(values: Mapping[str, Value]) -> dict[str, str]:
    """Return the units of the signals of a joint's recording, where they are not N and m."""
    turns = values['joint.type'] == 'revolute'
    force, position = ('Nm', 'rad') if turns else ('N', 'm')
    given = position if values['servo.kp'] else force
    found = {'reference': given, 'command': given, 'force': force, 'position': position,
             'velocity': f'{position}/s'}
    return {name: unit for name, unit in found.items()
            if unit != {'position': 'm', 'velocity': 'm/s'}.get(name, 'N')}
