"""The nominal model with what was found put in, as a ROS parameter file for the actuator node."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_analysis.gap.model.blocks import EFFECT_FIELDS
from asi_common.jit import FULL
from asi_common.parameter import Value
from asi_common.record import as_number, field_name

# Fields of an effect that the actuator's parameters can hold, with what holds them.
HELD = ('command_delay', 'loop_width', 'valve_lag', 'damping_viscous', 'supply_drop', 'air_time',
        'friction_level', 'friction_asymmetry', 'friction_breakaway', 'friction_stribeck',
        'viscous', 'disturbance', 'sensor_offset', 'sensor_gain_error', 'sensor_lag')
SHAPE = ('loop_share', 'loop_spread', 'friction_bristle', 'friction_inside', 'force_scale',
         'supply_time', 'corner', 'air_stiffening', 'damping_opening', 'damping_quadratic',
         'supply_sag', 'valve_lag_split', 'sensor_lag_split', 'piston_share', 'viscous_exponent',
         'velocity_scale', 'backlash_floating', 'friction_falling')


def slower(corner_hz: float, lag_s: float) -> float:
    """Return the corner (Hz) of a lag that is `lag_s` s later than one with `corner_hz`."""
    return 1.0 / (1.0 / corner_hz + 2.0 * math.pi * lag_s)


def improved(p: np.void, kind: str) -> dict[str, Value]:
    """Return what changes in the actuator's parameters (dotted names); kind: type of load."""
    changed: dict[str, Value] = {}
    if p['command_delay'] > 0.0:
        changed['valve_flexure.delay'] = float(p['valve_flexure_delay'] + p['command_delay'])
    if p['loop_width'] > 0.0:
        full = p['valve_hysteresis_model'] == FULL
        radius = float(p['loop_width'] * p['loop_share'] * (1.0 - 0.5 * p['loop_spread']))
        changed['valve_hysteresis.model'] = 'full'
        changed['valve_hysteresis.radius'] = radius + full * float(p['valve_hysteresis_radius'])
        if not full:
            changed['valve_hysteresis.lag_time'] = 0.0
    if p['valve_lag'] > 0.0:
        changed['valve_flexure.coil_frequency'] = slower(
            float(p['valve_flexure_coil_frequency']), float(p['valve_lag']))
    if p['air_time'] > 0.0:
        changed['fluid_dynamics.frequency'] = slower(
            float(p['fluid_dynamics_frequency']), float(p['air_time']))
    if p['damping_viscous'] != 0.0:
        name = 'viscous' if p['hydraulic_damping_model'] == FULL else 'linear_gain'
        changed[f'hydraulic_damping.{name}'] = max(0.0, float(
            p[f'hydraulic_damping_{name}'] + p['damping_viscous']))
    if p['supply_drop'] != 0.0:
        changed['valve_characteristic.maximum_force'] = float(
            p['valve_characteristic_maximum_force'] * (1.0 - p['supply_drop']))
    if p['friction_level'] > 0.0:
        level, high = float(p['friction_level']), 1.0 + float(p['friction_breakaway'])
        uneven = float(p['friction_asymmetry'])
        changed |= {'friction.model': 'full', 'friction.coulomb': level,
                    'friction.stiction_push': level * high * (1.0 + uneven),
                    'friction.stiction_pull': level * high * (1.0 - uneven)}
        if p['friction_stribeck'] > 0.0:
            changed['friction.stribeck_velocity'] = float(p['friction_stribeck'])
    if p['viscous'] > 0.0 and kind in ('spring', 'locked'):
        name = 'load.damping' if kind == 'spring' else 'load.locked_damping'
        changed[name] = float(p[field_name(name)] + p['viscous'])
    if p['disturbance'] != 0.0:
        changed['load.external_force'] = float(p['disturbance'])
    if p['sensor_offset'] != 0.0:
        changed['force_sensor.offset'] = float(p['force_sensor_offset'] + p['sensor_offset'])
    if p['sensor_gain_error'] != 0.0:
        changed['force_sensor.gain'] = float(
            p['force_sensor_gain'] * (1.0 + p['sensor_gain_error']))
    if p['sensor_lag'] > 0.0:   # a second-order filter that is as late
        changed['force_sensor.model'] = 'full'
        changed['force_sensor.card_frequency'] = math.sqrt(2.0) / (
            2.0 * math.pi * float(p['sensor_lag']))
    return changed


def left_out(p: np.void) -> list[str]:
    """Return the fields of effects at work that the actuator has no parameter for."""
    return [name for name in EFFECT_FIELDS
            if p[name] != 0.0 and name not in (*HELD, *SHAPE)]


def improved_model(model: Mapping[str, Value], records: Sequence[np.void]
                   ) -> tuple[dict[str, Value], list[str]]:
    """
    Return the improved parameters, and what of the effects they cannot hold.

    model: nominal parameters by dotted name; records: the verdict's, one a group of channels.
    """
    kind = str(model.get('load.type', 'locked'))
    values = dict(model)
    missing = []
    for p in records:
        for parameter in ACTUATOR_PARAMETERS:
            field = field_name(parameter.name)
            given = model.get(parameter.name, parameter.default)
            if (isinstance(parameter.default, float) and not parameter.read_only
                    and p[field] != as_number(parameter, given)):
                values[parameter.name] = float(min(max(p[field], parameter.low), parameter.high))
    for p in records:
        values |= improved(p, kind)
        missing += left_out(p)
    return values, missing
