"""The improved model: nominal parameters and found effects, as parameters of the actuator node."""

from collections.abc import Collection, Mapping, Sequence
from typing import Final

import numpy as np

from asi_actuator.joint_parameters import JOINT_PARAMETERS
from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_analysis.gap.model.blocks import EFFECT_FIELDS
from asi_analysis.gap.model.simulator import SPREAD, VALVE_FIELDS, metres_per_newton, of_simulator
from asi_common.jit import FULL
from asi_common.parameter import Value, completed, defaults
from asi_common.record import as_number, field_name

# Lags of two poles, and the blocks of the simulator that have them.
LAGS: Final = {'valve_lag': 'valve_flexure', 'sensor_lag': 'force_sensor'}
# Fields of the effects that equal a parameter of the simulator.
DIRECT: Final = {
    'command_delay': 'command_path.delay',
    'command_quantum': 'command_path.quantum',
    'command_bias': 'valve_flexure.bias',
    'command_deadband': 'valve_flexure.deadband',
    'valve_limit': 'valve_flexure.travel_limit',
    'orifice_deadband': 'valve_characteristic.deadband',
    'orifice_bias': 'valve_characteristic.bias',
    'force_limit': 'valve_characteristic.flow_limit',
    'damping_opening': 'hydraulic_damping.opening_viscous',
    'damping_quadratic': 'hydraulic_damping.quadratic',
    'supply_drop': 'valve_characteristic.supply_drop',
    'supply_sag': 'valve_characteristic.supply_sag',
    'supply_time': 'valve_characteristic.supply_time',
    'leakage_linear': 'fluid_dynamics.leakage',
    'air_time': 'fluid_dynamics.air_time',
    'viscous': 'friction.viscous',
    'sensor_drift': 'force_sensor.drift',
    'sensor_drift_curve': 'force_sensor.drift_curve',
}
# Fields that `improved` turns into parameters, and those of a shape only.
TURNED: Final = frozenset({
    *DIRECT, *LAGS, 'command_phase', 'command_truncated', 'loop_width', 'loop_share',
    'loop_spread', 'loop_behind', 'damping_viscous', 'leakage_quadratic', 'force_scale',
    'air_stiffening', 'friction_level', 'friction_asymmetry', 'friction_breakaway',
    'friction_stribeck', 'friction_bristle', 'friction_rounding', 'friction_inside',
    'friction_falling', 'viscous_exponent', 'velocity_scale', 'backlash', 'backlash_floating',
    'compliance', 'compliance_damping', 'piston_share', 'disturbance', 'disturbance_wave',
    'disturbance_frequency', 'disturbance_phase', 'disturbance_pulse', 'disturbance_start',
    'disturbance_end', 'sensor_offset', 'sensor_gain_error', 'corner', 'valve_lag_split',
    'sensor_lag_split'})
# Parameters that predictions set themselves.
NOT_IDENTIFIED: Final = ('maximum_substep', 'force_sensor.noise', 'force_sensor.drop_rate')
DAHL_ROUNDING: Final = 0.75   # friction_rounding above which friction is written as Dahl's
NO_STIFFENING_N: Final = 1e5
OPENING: Final = 'valve_characteristic_full_opening'
THRUST: Final = 'valve_characteristic_maximum_force'
OF_VALVE: Final = frozenset(VALVE_FIELDS) - {OPENING, THRUST}   # what its position alone shows


def effect_fields(values: Mapping[str, Value]) -> dict[str, float]:
    """Return the fields of effects that the parameters of a nominal model contain already."""
    fields = {field: float(values[name]) for field, name in DIRECT.items()}
    for field, block in LAGS.items():
        fields |= _lag_fields(values, block, field)
    rounding = values['command_path.rounding']
    fields['command_phase'] = 0.5 if rounding == 'edge' else 0.0
    fields['command_truncated'] = float(rounding == 'zero')
    fields['leakage_quadratic'] = float(values['fluid_dynamics.leakage_growth'])
    fields['force_scale'] = 1.0
    if fields['air_time'] > 0.0:
        fields['air_stiffening'] = 1.0 / float(values['fluid_dynamics.air_force'])
    if fields['viscous'] > 0.0:
        fields['friction_inside'] = float(values['friction.location'] == 'cylinder')
    return fields | _coupled(values)


def joint_fields(given: Mapping[str, Value], force_measured: bool) -> dict[str, float]:
    """
    Return the fields of effects that a joint's nominal parameters contain already.

    given: parameters of a simulated joint, the others null; force_measured: delay and lag are
    before the measured force, not between it and the motion.
    """
    values = defaults(JOINT_PARAMETERS) | {
        parameter.name: given[parameter.name] for parameter in JOINT_PARAMETERS
        if parameter.name in given}

    def number(name: str) -> float:
        return float(values[name])

    late = {} if force_measured else {
        'drive_delay': number('command_path.delay'), **_lag_fields(values, 'drive', 'drive_lag')}
    fields = {'viscous': number('friction.viscous'), **late, **_coupled(values)}
    if values['friction.model'] == 'linear':
        fields['viscous'] += number('friction.linear_gain')
    level = number('friction.coulomb')
    if values['friction.model'] != 'full' or level == 0.0:
        return fields
    breakaway = max(1.0, 0.5 * (number('friction.stiction_push')
                                + number('friction.stiction_pull')) / level)
    return fields | {
        'friction_level': level, 'friction_breakaway': breakaway - 1.0,
        'friction_asymmetry': number('friction.coulomb_asymmetry'),
        'friction_stribeck': number('friction.stribeck_velocity'), 'friction_falling': 2.0,
        'friction_bristle': level * breakaway / number('friction.presliding_stiffness'),
        'friction_rounding': number('friction.presliding_slip')}


def _lag_fields(values: Mapping[str, Value], block: str, field: str) -> dict[str, float]:
    """Return the two time constants of a block's lag as their sum, and the share of one."""
    times = [float(values[f'{block}.{name}']) for name in ('lag_time', 'second_lag_time')]
    return {field: sum(times), f'{field}_split': min(times) / sum(times) if any(times) else 0.0}


def _coupled(values: Mapping[str, Value]) -> dict[str, float]:
    """Return the fields of compliance and backlash, of the actuator's parameters or a joint's."""
    fields: dict[str, float] = {}
    stiffness = float(values['coupling.stiffness'])
    if gap := float(values['backlash.gap']):
        fields['backlash'] = 0.5 * gap
        fields['piston_share'] = 1.0
        if values['backlash.location'] == 'mass':
            fields['backlash_floating'] = 1.0
            stiffness = stiffness or float(values['backlash.contact_stiffness'])
    if stiffness > 0.0:
        fields['compliance'] = 1.0 / stiffness
        fields['compliance_damping'] = float(values['coupling.damping']) / stiffness
        fields['piston_share'] = float(values['coupling.piston_share'])
    return fields


def improved(p: np.void, values: Mapping[str, Value]) -> dict[str, Value]:
    """
    Return the actuator's parameters that the effects of a plant's record change.

    values: all parameters of the actuator by dotted name, with the record's nominal ones.
    """
    changed: dict[str, Value] = {name: float(p[field]) for field, name in DIRECT.items()
                                 if p[field] != 0.0 and field != 'supply_time'}
    for field, block in LAGS.items():
        fitted = {name: float(p[name]) for name in (field, f'{field}_split')}
        if fitted != _lag_fields(values, block, field):
            second = fitted[field] * fitted[f'{field}_split']
            changed |= {f'{block}.lag_time': fitted[field] - second,
                        f'{block}.second_lag_time': second}
    if p['supply_sag'] != 0.0:
        changed['valve_characteristic.supply_time'] = float(p['supply_time'])
    if p['command_quantum'] > 0.0:
        changed['command_path.rounding'] = (
            'zero' if p['command_truncated'] > 0.5 else
            'edge' if p['command_phase'] == 0.5 else 'nearest')
    if p['loop_width'] > 0.0:
        full = p['valve_hysteresis_model'] == FULL
        radius = float(p['loop_width'] * p['loop_share'] * (1.0 - 0.5 * p['loop_spread']))
        changed['valve_hysteresis.model'] = 'full'
        changed['valve_hysteresis.radius'] = radius + full * float(p['valve_hysteresis_radius'])
        if not full:
            changed['valve_hysteresis.lag_time'] = 0.0
    if p['damping_viscous'] != 0.0:
        name = 'viscous' if p['hydraulic_damping_model'] == FULL else 'linear_gain'
        changed[f'hydraulic_damping.{name}'] = max(0.0, float(
            p[f'hydraulic_damping_{name}'] + p['damping_viscous']))
        if p['hydraulic_damping_model'] != FULL:
            changed['hydraulic_damping.model'] = 'linear'
    if p['leakage_quadratic'] != 0.0:
        changed['fluid_dynamics.leakage_growth'] = float(
            p['leakage_quadratic'] / p['force_scale'])
    if p['air_time'] > 0.0:
        stiffening = float(p['air_stiffening'])
        changed['fluid_dynamics.air_force'] = (
            float(p['force_scale']) / stiffening if stiffening > 0.0 else NO_STIFFENING_N)
    changed |= friction_parameters(p, values) | coupling_parameters(p) | external_force(p)
    if p['sensor_offset'] != 0.0:
        changed['force_sensor.offset'] = float(p['force_sensor_offset'] + p['sensor_offset'])
    if p['sensor_gain_error'] != 0.0:
        changed['force_sensor.gain'] = float(
            p['force_sensor_gain'] * (1.0 + p['sensor_gain_error']))
    return changed


def friction_parameters(p: np.void, values: Mapping[str, Value]) -> dict[str, Value]:
    """Return nominal friction plus that of the effects, as parameters of the simulator."""
    changed: dict[str, Value] = {}
    full = values['friction.model'] == 'full'
    if (p['friction_level'] > 0.0 or p['viscous'] > 0.0) and not full:
        changed['friction.location'] = 'cylinder' if p['friction_inside'] > 0.5 else 'load'
    if p['friction_level'] > 0.0:
        level, high = float(p['friction_level']), 1.0 + float(p['friction_breakaway'])
        nominal = [float(values[f'friction.{name}']) if full else 0.0
                   for name in ('coulomb', 'stiction_push', 'stiction_pull')]
        uneven = float(p['friction_asymmetry'])
        changed |= {'friction.model': 'full', 'friction.coulomb': nominal[0] + level,
                    'friction.coulomb_asymmetry': uneven * level / (nominal[0] + level),
                    'friction.stiction_push': nominal[1] + level * high * (1.0 + uneven),
                    'friction.stiction_pull': nominal[2] + level * high * (1.0 - uneven)}
        if p['friction_breakaway'] > 0.0:
            changed['friction.stribeck_velocity'] = float(p['friction_stribeck'])
        if not full and p['friction_bristle'] > 0.0 and p['friction_creep'] == 0.0:
            changed['friction.presliding_stiffness'] = level * high / float(p['friction_bristle'])
            changed['friction.presliding_damping'] = 0.0
            changed['friction.presliding_slip'] = float(p['friction_rounding'] > DAHL_ROUNDING)
    return changed


def coupling_parameters(p: np.void) -> dict[str, Value]:
    """Return compliance and backlash as parameters of the simulator."""
    changed: dict[str, Value] = {}
    if p['backlash'] > 0.0:
        changed['backlash.gap'] = 2.0 * float(p['backlash'])
        changed['backlash.location'] = 'mass' if p['backlash_floating'] > 0.5 else 'spring_damper'
    if p['compliance'] > 0.0:
        stiffness = 1.0 / float(p['compliance'])
        changed |= {'coupling.stiffness': stiffness,
                    'coupling.damping': stiffness * float(p['compliance_damping']),
                    'coupling.piston_share': float(p['piston_share'])}
    return changed


def external_force(p: np.void) -> dict[str, Value]:
    """Return the largest disturbance as the simulator's external force: it has only one."""
    sizes = {name: abs(float(p[name]))
             for name in ('disturbance', 'disturbance_wave', 'disturbance_pulse')}
    name = max(sizes, key=lambda name: sizes[name])
    if sizes[name] == 0.0:
        return {}
    changed: dict[str, Value] = {'load.external_force': float(p[name])}
    if name == 'disturbance_wave':
        changed['load.external_force_frequency'] = float(p['disturbance_frequency'])
        changed['load.external_force_phase'] = float((p['disturbance_phase'] + 0.5) % 1.0 - 0.5)
    if name == 'disturbance_pulse':
        changed['load.external_force_start'] = max(0.0, float(p['disturbance_start']))
        changed['load.external_force_end'] = float(p['disturbance_end'])
    return changed


def left_out(p: np.void, values: Mapping[str, Value]) -> list[str]:
    """Return the fields of effects in a record for which the simulator has no parameter."""
    pushes = [name for name in ('disturbance', 'disturbance_wave', 'disturbance_pulse')
              if p[name] != 0.0]
    names = [name for name in EFFECT_FIELDS if p[name] != 0.0 and name not in TURNED]
    # All friction of the simulator is at one location: the cylinder, not behind the sensor.
    if (p['friction_level'] > 0.0 and p['friction_inside'] < 0.5
            and values['friction.model'] == 'full'):
        names.append('friction_inside')
    return names + pushes[1:]


def _of_simulator(p: np.void, model: Mapping[str, Value], but: Collection[str] = ()
                  ) -> dict[str, Value]:
    """Return the parameters that a record of the simulator changes, but for some fields."""
    changed: dict[str, Value] = {}
    for parameter in ACTUATOR_PARAMETERS:
        field = field_name(parameter.name)
        found = p[field]
        if parameter.name in NOT_IDENTIFIED or field in but or found == as_number(
                parameter, model.get(parameter.name, parameter.default)):
            continue
        if field == SPREAD and found == 0.0:   # a nominal one counts as even, and stays
            continue
        changed[parameter.name] = (parameter.choices[int(found)] if parameter.choices else
                                   float(found))
    return changed


def _limited(values: Mapping[str, Value]) -> tuple[dict[str, Value], list[str]]:
    """Return values, limited to the ranges of their parameters, and what that leaves out."""
    allowed, beyond = dict(values), []
    for parameter in ACTUATOR_PARAMETERS:
        value = values.get(parameter.name)
        if isinstance(parameter.default, float) and isinstance(value, float):
            allowed[parameter.name] = min(max(value, parameter.low), parameter.high)
            if allowed[parameter.name] != value:
                beyond.append(f'{parameter.name} {value:.3g}, which is limited to '
                              f'{allowed[parameter.name]:.3g}')
    return allowed, beyond


def improved_model(model: Mapping[str, Value], records: Sequence[np.void]
                   ) -> tuple[dict[str, Value], list[str]]:
    """
    Return the improved parameters, and what they leave out.

    That is: fields of effects for which there is no parameter, and values beyond its range.
    model: nominal parameters by dotted name; records: of the verdict, one for each group.
    """
    values = dict(model)
    if all(map(of_simulator, records)):
        return _limited(values | _of_simulator(records[-1], model))
    # Of the simulator, the record of what follows the valve holds the valve's parameters too.
    for p in filter(of_simulator, records):
        values |= _of_simulator(p, model, OF_VALVE if p is not records[0] else ())
    by_blocks = [p for p in records if not of_simulator(p)]
    for p in by_blocks:
        for parameter in ACTUATOR_PARAMETERS:
            given = model.get(parameter.name, parameter.default)
            fitted = p[field_name(parameter.name)]
            if (isinstance(parameter.default, float) and not parameter.read_only
                    and fitted != as_number(parameter, given)):
                values[parameter.name] = float(fitted)
    whole = completed(_limited(values)[0], ACTUATOR_PARAMETERS)
    missing: list[str] = []
    for p in by_blocks:
        values |= improved(p, whole)
        missing += left_out(p, whole)
    if len(records) > 1:   # the valve was fitted with the nominal opening and thrust
        valve, rest = records
        values['valve_characteristic.gain'] = float(
            metres_per_newton(valve) * rest[THRUST] / rest[OPENING])
    values, beyond = _limited(values)
    return values, missing + beyond
