"""What was found of a joint, as parameters of the node that simulates it (`plant: joint`)."""

import math
from collections.abc import Mapping
from typing import Final

import numpy as np

from asi_actuator.joint_parameters import JOINT_PARAMETERS
from asi_analysis.gap.answer.joint_model import (
    JointModel,
    followed_law,
    in_words_of,
    moved_by,
    poles,
)
from asi_analysis.gap.diagnose import Diagnosis
from asi_analysis.gap.model.model_file import (
    coupling_parameters,
    external_force,
    friction_parameters,
)
from asi_common.parameter import Value, defaults

# Damping of what rubs, as a share of critical, before it slides: the fit has none, and the
# simulated joint would ring.
RUBBING_DAMPING: Final = 0.2
# Fields that are written, by the channel that they are of.
WRITTEN: Final = {
    'load': frozenset((
        'load_mass', 'load_damping', 'load_stiffness', 'load_offset', 'gravity_sine',
        'gravity_cosine', 'viscous', 'friction_level', 'friction_asymmetry',
        'friction_breakaway', 'backlash', 'compliance', 'disturbance', 'disturbance_wave',
        'disturbance_frequency', 'disturbance_pulse', 'disturbance_start', 'disturbance_end',
        'drive_hold', 'drive_delay', 'drive_lag', 'drive_loss', 'sensor_offset',
        'sensor_gain_error', 'sensor_lag', 'sensor_drift')),
    'valve': frozenset((
        'valve_characteristic_gain', 'command_delay', 'command_bias', 'command_quantum',
        'command_deadband', 'valve_lag', 'valve_limit', 'valve_flexure_natural_frequency',
        'valve_flexure_damping_ratio'))}
# Written even where they have the default.
ALWAYS: Final = frozenset(('joint.type', 'load.mass', 'load.damping'))
NAMES: Final = frozenset(parameter.name for parameter in JOINT_PARAMETERS)


def node_parameters(diagnosis: Diagnosis, given: Mapping[str, Value]
                    ) -> tuple[dict[str, Value], list[str], list[str]]:
    """
    Return the joint with what was found, as parameters by name; values in words; what is left out.

    given: the nominal parameters, such as those of a servo in the metadata of the bag; what is
    identified takes their place. Raises InputError for a joint that a node cannot simulate.
    """
    groups = {weighed.group.channels[0]: weighed for weighed in diagnosis.groups}
    records = {channel: diagnosis.best(weighed).fitted.record
               for channel, weighed in groups.items()}
    run = diagnosis.runs[0]
    values: dict[str, Value] = {'plant': 'joint', **{
        name: value for name, value in given.items() if name in NAMES}}
    if 'load' in groups:
        found = moved_by(groups['load'], records['load'], diagnosis.runs)
        values |= _mechanics(found, records['load'], run.force_n is not None)
        if 'valve' in records:
            values |= _drive(records['valve'])
    else:
        values |= followed_law(groups['valve'], records['valve'], run)
        if records['valve']['command_quantum'] > 0.0:
            values['command_path.quantum'] = float(records['valve']['command_quantum'])
    turns = run.unit('position' if run.position_m is not None else 'velocity').startswith('rad')
    values['joint.type'] = 'revolute' if turns else 'prismatic'
    if run.position_m is not None:
        values['load.start'] = float(run.position_m[np.isfinite(run.position_m)][0])
    said, unsaid = in_words_of(diagnosis, groups, WRITTEN)
    null = {name: value for name, value in defaults(JOINT_PARAMETERS).items()
            if name not in ALWAYS}
    return {name: value for name, value in values.items()
            if name not in null or value != null[name]}, said, unsaid


def _mechanics(found: JointModel, p: np.void, force_measured: bool) -> dict[str, Value]:
    """Return what moves, and between command and motion the drive if no force is measured."""
    level = float(p['friction_level'])
    values: dict[str, Value] = {
        'load.mass': found.inertia, 'load.damping': float(p['load_damping']),
        'friction.viscous': float(p['viscous']), 'load.stiffness': found.stiffness,
        'load.rest': found.rest if found.stiffness else 0.0,
        'gravity.sine': found.sine, 'gravity.cosine': found.cosine,
        # Without the parts of it that have parameters of their own.
        'load.offset': -found.bias + float(p['disturbance'])
        - level * float(p['friction_asymmetry'])}
    off = defaults(JOINT_PARAMETERS) | {'friction.model': 'off'}
    values |= friction_parameters(p, off) | coupling_parameters(p) | external_force(p)
    if stiffness := float(values.get('friction.presliding_stiffness', 0.0)):
        values['friction.presliding_damping'] = RUBBING_DAMPING * math.sqrt(
            stiffness * found.inertia)
    if not force_measured:
        values |= {'command_path.delay': max(found.delay_s - poles(p, 'drive_lag')[1], 0.0),
                   'drive.gain': found.gain, **_lags(p, 'drive_lag')}
    values |= {'force_sensor.offset': float(p['sensor_offset']),
               'force_sensor.gain': 1.0 + float(p['sensor_gain_error']),
               'force_sensor.lag_time': float(p['sensor_lag']),
               'force_sensor.drift': float(p['sensor_drift']),
               'force_sensor.drift_curve': float(p['sensor_drift_curve'])}
    return {name: value for name, value in values.items() if name in NAMES}


def _drive(p: np.void) -> dict[str, Value]:
    """Return the drive between a command and the measured force."""
    gain = float(p['valve_characteristic_gain'])
    return {'drive.gain': gain, 'drive.bias': gain * float(p['command_bias']),
            'drive.deadband': float(p['command_deadband']),
            'drive.force_limit': float(p['valve_limit']),
            'command_path.quantum': float(p['command_quantum']),
            'command_path.delay': float(p['command_delay']), **_lags(p, 'valve_lag')}


def _lags(p: np.void, field: str) -> dict[str, Value]:
    """Return the two time constants of a lag."""
    return dict(zip(('drive.lag_time', 'drive.second_lag_time'), poles(p, field), strict=True))
