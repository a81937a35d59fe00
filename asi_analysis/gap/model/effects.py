"""
The forms of each effect of the vocabulary in the block-wise model: parameters, bounds, starts.

A parameter changes one field of the plant's record (blocks.py): it sets it, or scales its nominal
value. Bounds and starts are in units of a `scale` of the recording ('command', 'force' ...), so
that they fit any actuator. An effect may have several variants: where it acts (friction before or
behind the force sensor) or how (an own term, or a change of a nominal parameter).
"""

import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from asi_actuator.model.effects import (
    COMMAND_PATH,
    EFFECT,
    HYDRAULICS,
    MECHANICS,
    SENSOR,
    VALVE,
)
from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_common.record import field_name

NO_GAP, UNKNOWN = 'no_gap', 'unknown'


class Free(NamedTuple):
    """
    A free parameter: a field of the plant's record, its relative bounds and start values.

    scale: unit of low, high and starts: '' for the plain unit, the name of a signal (its range in
    the recording), an initial guess from the residual ('residual_...'), 'nominal' (the field's
    nominal value), or another nominal parameter, so that the ratio to it is free. In a fit it
    becomes a `FreeParameter` (fit.py): its bounds depend on the recording and on that parameter.
    """

    field: str
    low: float
    high: float
    starts: tuple[float, ...]
    scale: str = ''
    unit: str = ''
    prior: float = math.inf   # standard deviation about the nominal value, in units of `scale`
    anew: bool = False        # fits with effects also begin at each of its starts


# Channels of a measured motion that the simulator predicts.
MOTIONS = ('velocity', 'position')

# Of a load's free oscillation: the force on its piston is linear in them.
OSCILLATION = frozenset(('swing_cosine', 'swing_sine'))
# Fields that have a value for each recording.
OF_A_RECORDING = (
    'load_offset', 'disturbance', 'disturbance_wave', 'disturbance_frequency', 'disturbance_phase',
    'disturbance_pulse', 'disturbance_start', 'disturbance_end', 'sensor_offset', 'sensor_drift',
    'sensor_drift_curve', 'sensor_drift_bend', 'load_external_force',
    'load_external_force_frequency', 'load_external_force_phase', 'load_external_force_start',
    'load_external_force_end', 'backlash_centre', 'force_sensor_offset', 'force_sensor_drift',
    'force_sensor_drift_curve', 'start_flux', 'start_seal', 'start_supply', 'start_position',
    'start_velocity', 'loop_start', 'swing_cosine', 'swing_sine', 'servo_ahead', 'servo_faster')


def of_recording(field: str, number: int) -> str:
    """Return the name of a field in the recording `number`: `disturbance@2` in the second."""
    return field if number == 0 else f'{field}@{number + 1}'


def in_each(frees: tuple[Free, ...], count: int) -> tuple[Free, ...]:
    """Return free parameters for `count` recordings: one for each, of `OF_A_RECORDING`."""
    return tuple(each for free in frees for each in (
        (free._replace(field=of_recording(free.field, number), scale=of_recording(
            free.scale, number) if free.scale.startswith('residual_') else free.scale)
         for number in range(count)) if free.field in OF_A_RECORDING else (free,)))


class Variant(NamedTuple):
    """
    One form of an effect.

    channels: those that it acts on, block by block: 'valve', 'force', 'load'; fixed: fields that
    it sets; needs: fields of the nominal record that must not be zero; where: fields of the
    nominal record, and the value that each must have; joined: only combined with another effect.
    """

    free: tuple[Free, ...]
    channels: tuple[str, ...] = ()
    fixed: tuple[tuple[str, float], ...] = ()
    needs: tuple[str, ...] = ()
    joined: bool = False
    where: tuple[tuple[str, float], ...] = ()

    @property
    def fields(self) -> set[str]:
        """Return the fields that are free in this form."""
        return {free.field for free in self.free}

    def applies(self, nominal: np.void) -> bool:
        """Return whether this form is one of a plant with these nominal parameters."""
        return (all(nominal[name] != 0.0 for name in self.needs)
                and all(nominal[name] == value for name, value in self.where))


# The forms of each effect, by its name.
Effects = dict[str, tuple[Variant, ...]]


def fields_of(variants: Iterable[Variant]) -> set[str]:
    """Return the fields that are free in forms of effects."""
    return {free.field for variant in variants for free in variant.free}


def freed(effects: Effects, change: Callable[[tuple[Free, ...]], tuple[Free, ...]]) -> Effects:
    """Return effects whose variants have changed free parameters."""
    return {name: tuple(each._replace(free=change(each.free)) for each in variants)
            for name, variants in effects.items()}


def without_prior(free: Iterable[Free], variants: Iterable[Variant]) -> tuple[Free, ...]:
    """Return free parameters; those of these forms of effects have no prior any more."""
    fields = fields_of(variants)
    return tuple(each._replace(prior=math.inf) if each.field in fields else each for each in free)


FORCE_SIDE = ('force',)
LOAD_SIDE = ('load',)
BOTH = ('force', 'load')
VALVE_SIDE = ('valve',)


def _scaled(field: str, low: float = 0.0, high: float = 5.0,
            starts: tuple[float, ...] = (0.3, 2.5)) -> Free:
    """Return a nominal parameter that is free far beyond its tolerance."""
    return Free(field, low, high, starts, 'nominal')


def _friction(*more: Free, joined: bool = False) -> tuple[Variant, ...]:
    """Return the forms of a friction effect: behind the force sensor and before it."""
    level = Free('friction_level', 0.0, 0.7, (0.02, 0.1, 0.3), 'force', 'N')
    # The breakaway distance of seals and bearings: from microns to half a millimetre.
    bristle = Free('friction_bristle', 2e-6, 5e-4, (5e-5, 1e-5), '', 'm')
    rounding = Free('friction_rounding', 0.0, 1.0, (0.4, 0.8))
    return tuple(Variant((level, bristle, rounding, *more), channels,
                         (('friction_inside', inside),), joined=joined)
                 for inside, channels in ((0.0, LOAD_SIDE), (1.0, FORCE_SIDE)))


# Lower and upper bound and initial guess of a friction's asymmetry, of either sign.
ASYMMETRIES = (0.15, 1.0, 0.4), (-1.0, -0.15, -0.4)
_ASYMMETRY = tuple(Free('friction_asymmetry', low, high, (start,))
                   for low, high, start in ASYMMETRIES)
_OF_VISCOUS = Free('viscous_asymmetry', -0.5, 0.5, (0.02, -0.02))
_ASYMMETRIC = (*(form for each in _ASYMMETRY for form in _friction(each)),
               # Behind the force sensor also of the viscous friction.
               *(_friction(each, _OF_VISCOUS)[0] for each in _ASYMMETRY))
_ASYMMETRIC_TOO = _friction(Free('friction_asymmetry', -1.0, 1.0, (0.1, -0.1)), _OF_VISCOUS,
                            joined=True)
_STICKING = _friction(Free('friction_breakaway', 0.25, 6.0, (1.0,)),
                      Free('friction_stribeck', 0.005, 0.6, (0.1, 0.3, 0.02), 'velocity', 'm/s'),
                      Free('friction_falling', 1.0, 2.0, (1.5,)))


# The form of a backlash with two masses: one of them moves freely within it.
FLOATING = ('backlash_floating', 1.0)

EFFECTS: Effects = {
    'transport_delay': (
        Variant((Free('command_delay', 0.0, 0.1, (0.001, 0.003, 0.01, 0.03), '', 's'),),
                VALVE_SIDE),
        Variant((_scaled('valve_flexure_delay', 0.0, 1.0, (0.3,)),), VALVE_SIDE,
                needs=('valve_flexure_model', 'valve_flexure_delay')),
    ),
    'command_quantisation': (
        *(Variant((Free('command_quantum', 0.997, 1.003, (1.0,), guess, 'N'),), VALVE_SIDE, fixed)
          for guess, fixed in (('residual_step', (('command_phase', 0.0),)),
                              ('residual_step_edge', (('command_phase', 0.5),)),
                              ('residual_step_edge', (('command_truncated', 1.0),)))),
    ),
    'valve_hysteresis': (
        Variant((Free('loop_width', 0.0, 0.8, (0.007, 0.02, 0.06, 0.15), 'command', 'N'),
                 Free('loop_share', 0.0, 2.0, (0.95,)), Free('loop_spread', 0.0, 1.0, (0.3, 0.9))),
                VALVE_SIDE),
        Variant((_scaled('valve_hysteresis_radius', 0.0, 10.0),
                 _scaled('valve_hysteresis_lag_time')), VALVE_SIDE,
                needs=('valve_hysteresis_model', 'valve_hysteresis_radius')),
    ),
    'valve_deadband': (
        Variant((Free('command_deadband', 0.0, 0.5, (0.005, 0.02, 0.06, 0.15), 'command',
                      'N'),), VALVE_SIDE),
        Variant((Free('orifice_deadband', 0.0, 0.5, (0.005, 0.02, 0.06, 0.15), 'valve_position',
                      'm'),), FORCE_SIDE),
    ),
    'valve_saturation': (
        Variant((Free('valve_limit', 0.2, 1.3, (0.5, 0.7, 0.85, 0.95), 'valve_position', 'm'),
                 Free('corner', 0.0, 0.25, (0.05,))), VALVE_SIDE),
        Variant((Free('force_limit', 0.2, 3.0, (0.5, 0.7, 0.85, 0.95), 'force', 'N'),
                 Free('corner', 0.0, 0.25, (0.05,))), FORCE_SIDE),
    ),
    'valve_bias': (
        Variant((Free('command_bias', -0.7, 0.7, (0.02, -0.02), 'command', 'N'),), VALVE_SIDE),
        Variant((Free('orifice_bias', -0.7, 0.7, (0.02, -0.02), 'valve_position', 'm'),),
                FORCE_SIDE),
    ),
    'valve_lag': (
        Variant((Free('valve_lag', 0.0, 0.1, (0.001, 0.004, 0.015), '', 's'),), VALVE_SIDE),
        Variant((Free('valve_lag', 0.0, 0.1, (0.001, 0.004, 0.015), '', 's'),
                 Free('valve_lag_split', 0.0, 0.5, (0.1,))), VALVE_SIDE),
        Variant((_scaled('valve_flexure_coil_frequency', 0.1, 8.0, (0.5, 2.0)),), VALVE_SIDE,
                needs=('valve_flexure_model',)),
    ),
    'hydraulic_damping': (
        Variant((Free('damping_viscous', -2.0, 2.0, (0.02, 0.1, 0.5), 'damping', 'N s/m'),
                 Free('damping_quadratic', -2.0, 2.0, (0.02,), 'damping_quadratic', 'N s2/m2'),
                 Free('damping_opening', -2.0, 2.0, (0.02,), 'damping', 'N s/m')), FORCE_SIDE),
        Variant((_scaled('hydraulic_damping_viscous', starts=(0.3, 1.7)),
                 _scaled('hydraulic_damping_maximum_force', starts=(0.4, 1.5)),
                 _scaled('hydraulic_damping_saturation_velocity', 0.3, 3.0, (1.0,))),
                FORCE_SIDE, needs=('hydraulic_damping_model',)),
    ),
    'supply_pressure': (
        Variant((Free('supply_drop', -0.6, 0.9, (0.1,)),
                 Free('supply_sag', 0.0, 3.0, (0.05, 0.5)),   # at full opening
                 Free('supply_time', 0.02, 1.5, (0.1, 0.5), '', 's')), FORCE_SIDE),
    ),
    'internal_leakage': (
        Variant((Free('leakage_linear', 0.0, 3.0, (0.1,)),
                 Free('leakage_quadratic', 0.0, 3.0, (0.1,))), FORCE_SIDE),
    ),
    'entrained_air': (
        Variant((Free('air_time', 0.0, 0.05, (0.0005, 0.002, 0.008), '', 's'),
                 Free('air_stiffening', 0.0, 20.0, (1.0,))), FORCE_SIDE),
    ),
    'coulomb_friction': (
        *_friction(),
        Variant((_scaled('friction_coulomb', 0.0, 8.0),), FORCE_SIDE, needs=('friction_model',)),
    ),
    'stiction': (
        *_STICKING,
        Variant((_scaled('friction_stiction_push'), _scaled('friction_stiction_pull')),
                FORCE_SIDE, needs=('friction_model',)),
    ),
    'friction_asymmetry': (
        *_ASYMMETRIC, *_ASYMMETRIC_TOO,
        Variant((Free('friction_coulomb_asymmetry', -1.0, 1.0, (0.5, -0.5)),), FORCE_SIDE,
                needs=('friction_model', 'friction_coulomb')),
    ),
    'viscous_friction': (
        Variant((Free('viscous', 0.0, 2.0, (0.02, 0.1), 'damping', 'N s/m'),
                 Free('viscous_exponent', 0.8, 1.2, (1.0,))), LOAD_SIDE),
        Variant((Free('viscous', 0.0, 2.0, (0.02, 0.1), 'damping', 'N s/m'),
                 Free('viscous_exponent', 0.8, 1.2, (1.0,))), FORCE_SIDE,
                (('friction_inside', 1.0),)),
    ),
    'backlash': (
        *(Variant((Free('backlash', 0.001, 0.7, (0.02, 0.06, 0.15), 'position', 'm'),), LOAD_SIDE,
                  (('backlash_memory', memory), ('piston_share', 1.0))) for memory in (0.0, 1.0)),
        # Within the backlash its mass moves freely; the contact is compliant.
        Variant((Free('backlash', 0.001, 0.7, (0.004, 0.02, 0.06, 0.15), 'position', 'm'),
                 Free('compliance', 1e-4, 0.1, (0.02, 0.002), 'compliance', 'm/N'),
                 Free('compliance_damping', 0.0, 0.005, (0.0002,), '', 's'),
                 Free('piston_share', 0.01, 0.99, (0.4,))), LOAD_SIDE,
                (FLOATING,)),
    ),
    'load_compliance': (
        Variant((Free('compliance', 0.0, 6.0, (0.05, 0.2, 0.6, 1.5, 3.0), 'compliance', 'm/N'),
                 Free('compliance_damping', 0.0, 0.02, (0.001,), '', 's'),
                 Free('piston_share', 0.0, 0.8, (0.1, 0.5))), LOAD_SIDE),
    ),
    'disturbance_force': (
        Variant((Free('disturbance', -1.0, 1.0, (0.02, -0.02), 'force', 'N'),), LOAD_SIDE),
        Variant((Free('disturbance_wave', 0.0, 1.0, (0.1,), 'force', 'N'),
                 Free('disturbance_phase', 0.5, 1.5, (1.0,), 'residual_phase', 'turns'),
                 Free('disturbance_frequency', 0.98, 1.02, (1.0,), 'residual_frequency', 'Hz')),
                LOAD_SIDE),
        Variant((Free('disturbance_pulse', -1.0, 1.0, (0.1, -0.1), 'force', 'N'),
                 Free('disturbance_start', 0.997, 1.003, (1.0,), 'residual_start', 's'),
                 Free('disturbance_end', 0.997, 1.003, (1.0,), 'residual_end', 's')), LOAD_SIDE),
    ),
    'sensor_offset': (
        Variant((Free('sensor_offset', -1.0, 1.0, (0.02, -0.02), 'force', 'N'),), BOTH),
    ),
    'sensor_gain': (
        Variant((Free('sensor_gain_error', -0.7, 1.0, (0.05, -0.05)),), BOTH),
    ),
    'sensor_lag': (
        Variant((Free('sensor_lag', 0.0, 0.05, (0.0005, 0.002, 0.008), '', 's'),
                 Free('sensor_lag_split', 0.0, 0.5, (0.1,))), BOTH),
    ),
    'sensor_drift': (
        Variant((Free('sensor_drift', -3.0, 3.0, (0.02, -0.02), 'drift', 'N/s'),
                 Free('sensor_drift_curve', -3.0, 3.0, (0.0,), 'drift_curve', 'N/s2'),
                 Free('sensor_drift_bend', -3.0, 3.0, (0.0,), 'drift_bend', 'N/s3')), BOTH),
    ),
}
# Of a joint that turns, if compared with healthy recordings: else gravity is in its nominal model.
GRAVITY: Effects = {'gravity': (
    Variant(tuple(Free(f'gravity_{part}', -10.0, 10.0, (0.05, -0.05), 'force', 'N')
                  for part in ('sine', 'cosine')), LOAD_SIDE),)}
# Of a joint whose force is not measured, if its mass is known: less force for the same command.
DRIVE_GAIN: Effects = {'drive_gain': (
    Variant((Free('drive_loss', -2.0, 0.8, (0.1, -0.1)),), LOAD_SIDE),)}
# The same of any joint: its motion is read too large or too small.
POSITION_GAIN: Effects = {'position_gain': (
    Variant((Free('position_gain_error', -0.7, 2.0, (0.1, -0.1)),), LOAD_SIDE),)}
# The last two are of a static characteristic only (static.py).
BLOCK_OF = {name: EFFECT[name].block for name in EFFECTS} | {
    'gravity': MECHANICS, 'drive_gain': VALVE, 'position_gain': SENSOR, 'gain_asymmetry': VALVE,
    'curvature': VALVE}
# Effects that textbooks formulate in one way only (a gain, a corner, a linear lag), unlike those
# with memory, contact, randomness or fluid flow.
ONE_LAW = frozenset((
    'valve_deadband', 'valve_saturation', 'valve_bias', 'valve_lag', 'load_compliance',
    'disturbance_force', 'sensor_offset', 'sensor_gain', 'sensor_lag', 'gravity', 'drive_gain',
    'position_gain', 'gain_asymmetry'))

# Names of the actuator's parameters by their fields.
DOTTED = {field_name(parameter.name): parameter.name for parameter in ACTUATOR_PARAMETERS}
# A nominal parameter beyond its tolerance is a hypothesis too: `parameter:load.mass`.
PARAMETER = 'parameter:'
BLOCK_OF_PARAMETER = {
    'valve_flexure.delay': COMMAND_PATH, 'valve_characteristic.maximum_force': HYDRAULICS,
    'valve_characteristic.full_opening': HYDRAULICS, 'valve': VALVE, 'hydraulic': HYDRAULICS,
    'fluid': HYDRAULICS, 'friction': MECHANICS, 'load': MECHANICS, 'force_sensor': SENSOR}
BEYOND = 5.0   # largest factor, up or down, of a parameter beyond its tolerance


def block_of(name: str) -> str | None:
    """Return the block of an effect, or of a parameter beyond its tolerance; None: neither."""
    if not name.startswith(PARAMETER):
        return BLOCK_OF.get(name)
    parameter = name.removeprefix(PARAMETER)
    return next((block for start, block in BLOCK_OF_PARAMETER.items()
                 if parameter.startswith(start)), None)


def has_one_law(name: str) -> bool:
    """Return whether an effect, or a parameter beyond its tolerance, has one law."""
    return name in ONE_LAW or name.startswith(PARAMETER)


def parameter_error(field: str, limit: str, bounds: tuple[float, float],
                    channels: tuple[str, ...]) -> Effects:
    """
    Return the hypothesis that a nominal parameter is beyond a limit of its tolerance.

    limit: 'low' or 'high'; field: of the plant's record; bounds: of its tolerance, in multiples of
    the nominal value; channels: where it shows.
    """
    low, high = bounds
    free = (Free(field, 1.0, BEYOND, (2.0 * high - 1.0, 2.0), 'nominal') if limit == 'high'
            else Free(field, 1.0 / BEYOND, 1.0, (1.5 * low - 0.5, 0.5), 'nominal'))
    return {PARAMETER + DOTTED[field]: (Variant((free,), channels),)}
