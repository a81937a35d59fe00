"""The table of the parameters of the actuator's physics: one row each, with unit and source."""

from collections.abc import Mapping
from typing import Final

import numpy as np

from asi_common.parameter import Parameter, ParameterError, Table, Value
from asi_common.record import record_dtype, record_of

# Sub-steps that the model's delays remember; a power of two, so that the index wraps by a mask.
RING: Final = 1024

# What the paper leaves open, fitted to its facts together: doc/explanation/reproduction.md.
FITTED = 'asi calibrate'

ROUNDING = ('nearest', 'edge', 'zero')
MODEL = ('off', 'linear', 'full')
LOAD = ('locked', 'spring', 'free', 'prescribed')


def _model(block: str, linear: str, off: str) -> Parameter:
    return Parameter(
        f'{block}.model', 'full', '',
        f'full: the nonlinear or dynamic block; linear: {linear}; off: {off}', choices=MODEL)


class ActuatorTable(Table):
    """The actuator's parameters; its delays must fit into the ring that remembers."""

    def check(self, values: Mapping[str, Value]) -> None:
        """Raise ParameterError if a delay is longer than what the ring holds."""
        # A period is cut into equal sub-steps, each longer than half of the longest allowed.
        longest = (RING - 2) * float(values['maximum_substep']) / 2.0
        for name in ('valve_flexure.delay', 'force_sensor.delay'):
            if float(values[name]) > longest:
                raise ParameterError(
                    f'{name} = {values[name]!r} is not allowed with maximum_substep = '
                    f'{values["maximum_substep"]!r}: it takes at most {longest:g} s there')


ACTUATOR_PARAMETERS: Final = ActuatorTable((
    Parameter('command_limit', 4000.0, 'N', 'Largest valve command of the drive', 1.0, 1e5,
              source='assumed'),
    Parameter('maximum_substep', 25e-6, 's', 'Longest sub-step of the integration',
              1e-6, 1e-4, read_only=True,
              source='convergence: test/actuator/test_model_convergence.py'),

    Parameter('command_path.delay', 0.0, 's', 'Transport delay of the valve command', 0.0, 0.05),
    Parameter('command_path.delay_spread', 0.0, 's',
              'Half width of the range in which the delay lies, at random in each control period; '
              'at most the delay itself', 0.0, 0.05),
    Parameter('command_path.quantum', 0.0, 'N', 'Step of the quantised valve command; 0: none',
              0.0, 1e3),
    Parameter('command_path.rounding', 'nearest', '',
              'nearest: to the nearest multiple of the quantum; edge: to the middle between two; '
              'zero: towards zero', choices=ROUNDING),

    _model('valve_hysteresis', 'linear_gain times the command', 'the command itself'),
    Parameter('valve_hysteresis.linear_gain', 1.0, 'N/N', 'Gain when the model is linear',
              0.0, 10.0),
    Parameter('valve_hysteresis.radius', 27.82, 'N', 'Half width of the loop at rest',
              0.0, 1000.0, source=FITTED),
    Parameter('valve_hysteresis.lag_time', 1.266e-3, 's',
              'Growth of the half width with the rate of the command', 0.0, 0.1,
              source=FITTED),
    Parameter('valve_hysteresis.rate_exponent', 0.1745, '',
              'How much faster than linearly the half width grows with the rate', 0.0, 2.0,
              source=FITTED),
    Parameter('valve_hysteresis.reference_rate', 1.9e5, 'N/s',
              'Rate of the command at which lag_time holds', 1.0, 1e8, source='fit S10'),
    Parameter('valve_hysteresis.rate_filter', 164.4, 'Hz',
              'Corner of the filter that measures the rate of the command', 1.0, 1e5,
              source=FITTED),
    Parameter('valve_hysteresis.saturation', 1212.0, 'N',
              'Drive S at which the iron saturates, sharply: flux / (1 + (flux / S)^4)^(1/4)',
              100.0, 1e6, source=FITTED),
    Parameter('valve_hysteresis.rounding', 0.0, '',
              'Share of the loop that moves in plays of half widths from 0 to twice the '
              'half width, which rounds its corners; 0: one play', 0.0, 1.0),
    Parameter('valve_hysteresis.lagged', 0.0, '',
              'Share of lag_time that is a first-order lag of the flux instead of a growth of '
              'the half width', 0.0, 1.0),
    Parameter('valve_hysteresis.widening', 0.0, 'N/N',
              'Slope that further plays add for large commands: the loop widens with the '
              'amplitude; 0: none', 0.0, 100.0),
    Parameter('valve_hysteresis.widening_from', 0.0, 'N',
              'Half width at which those of the further plays begin', 0.0, 1e4),
    Parameter('valve_hysteresis.widening_range', 1500.0, 'N',
              'Range of their half widths, evenly spread', 0.0, 1e5),

    _model('valve_flexure', 'linear_gain, no dynamics', 'no dynamics'),
    Parameter('valve_flexure.linear_gain', 1.0, 'N/N', 'Gain when the model is linear',
              0.0, 10.0),
    Parameter('valve_flexure.coil_frequency', 18.79, 'Hz', 'Corner of the coil and its drive',
              0.1, 1e4, source=FITTED),
    Parameter('valve_flexure.natural_frequency', 1546.0, 'Hz',
              'Natural frequency of the flexure pipe', 1.0, 5e3, source=FITTED),
    Parameter('valve_flexure.damping_ratio', 0.5825, '', 'Damping ratio of the flexure pipe',
              0.0, 10.0, source=FITTED),
    Parameter('valve_flexure.bias', 0.0, 'N',
              'Deflection at no command, as the command that would give it', -1e4, 1e4),
    Parameter('valve_flexure.deadband', 0.0, 'N',
              'Half width of the dead band of the drive', 0.0, 1e4),
    Parameter('valve_flexure.lag_time', 0.0, 's', 'Time constant of a further first-order lag',
              0.0, 0.1),
    Parameter('valve_flexure.second_lag_time', 0.0, 's', 'Time constant of one more after it',
              0.0, 0.1),
    Parameter('valve_flexure.travel_limit', 0.0, 'm', 'Largest deflection; 0: no limit',
              0.0, 1e-2),
    Parameter('valve_flexure.delay', 2.084e-4, 's', 'First of the two delays', 0.0, 0.01,
              source=FITTED),

    _model('valve_characteristic', 'linear_gain times the slope, without saturation',
           'the slope, without saturation'),
    Parameter('valve_characteristic.linear_gain', 1.0, '',
              'Share of the slope when the model is linear', 0.0, 10.0),
    Parameter('valve_characteristic.gain', 1.0, 'N/N',
              'Force per valve command, open loop and at rest: it scales the valve position at a '
              'command, not the force at a valve position, nor maximum_force', 1e-3, 100.0,
              source=FITTED),
    Parameter('valve_characteristic.maximum_force', 1000.0, 'N', 'Thrust at full opening',
              1.0, 1e5, source='paper, section 2.1 and Fig. 4'),
    Parameter('valve_characteristic.full_opening', 2e-5, 'm',
              'Valve position at which the thrust saturates', 1e-7, 1e-2,
              source='assumed, from the axis of Fig. 4'),
    Parameter('valve_characteristic.deadband', 0.0, 'm',
              'Half width of the overlap in which the valve passes no oil', 0.0, 1e-2),
    Parameter('valve_characteristic.bias', 0.0, 'm',
              "Distance from the position sensor's zero to the centre of the orifices",
              -1e-2, 1e-2),
    Parameter('valve_characteristic.flow_limit', 0.0, 'N',
              'Largest static force; 0: that of the full opening', 0.0, 1e5),
    Parameter('valve_characteristic.supply_drop', 0.0, '',
              'Share of the thrust that is missing for lack of supply pressure', -1.0, 0.99),
    Parameter('valve_characteristic.supply_sag', 0.0, '',
              'Share of the thrust that is lost in steady state with the valve fully open; '
              'above 1: all of it is lost at less', 0.0, 3.0),
    Parameter('valve_characteristic.supply_time', 0.3, 's', 'Time constant of that loss',
              1e-3, 10.0),

    _model('hydraulic_damping', 'linear_gain times the velocity', 'none'),
    Parameter('hydraulic_damping.linear_gain', 1000.0, 'N s/m', 'Gain when the model is linear',
              0.0, 1e6),
    Parameter('hydraulic_damping.maximum_force', 1200.0, 'N', 'Bound of the damping force',
              0.0, 1e5, source='paper, section 4.1'),
    Parameter('hydraulic_damping.centre_share', 0.3321, '',
              'Magnitude with the valve closed, as a share of that with the valve open',
              0.0, 1.0, source=FITTED),
    Parameter('hydraulic_damping.saturation_velocity', 0.08368, 'm/s',
              'Velocity about which the damping rises, valve closed', 0.0, 10.0,
              source=FITTED),
    Parameter('hydraulic_damping.saturation_shift', 0.35, 'm/s',
              'Shift of that velocity with the signed valve opening', -10.0, 10.0,
              source=FITTED),
    Parameter('hydraulic_damping.saturation_narrowing', -0.213, 'm/s',
              'Fall of that velocity with the size of the valve opening', -10.0, 10.0,
              source=FITTED),
    Parameter('hydraulic_damping.velocity_width', 0.0722, 'm/s', 'Scale of the tanh in velocity',
              1e-3, 10.0, source=FITTED),
    Parameter('hydraulic_damping.width_growth', 0.2201, '',
              'Growth of that scale with the size of the valve opening', 0.0, 10.0,
              source=FITTED),
    Parameter('hydraulic_damping.tail', 0.0, '',
              'How slowly it saturates; -1: error function, 0: tanh, 1: x / sqrt(1 + x^2), '
              '2: arc tangent', -1.0, 2.0),
    Parameter('hydraulic_damping.viscous', 78.03, 'N s/m', 'Damping that is linear in velocity',
              0.0, 1e6, source=FITTED),
    Parameter('hydraulic_damping.quadratic', 0.0, 'N s2/m2',
              'Damping with the square of the velocity, beyond that bound', 0.0, 1e6),
    Parameter('hydraulic_damping.opening_viscous', 0.0, 'N s/m',
              'Viscous damping at full opening, in proportion to it, beyond that bound',
              0.0, 1e6),

    _model('fluid_dynamics', 'linear_gain, no dynamics', 'no dynamics'),
    Parameter('fluid_dynamics.linear_gain', 1.0, 'N/N', 'Gain when the model is linear',
              0.0, 10.0),
    Parameter('fluid_dynamics.frequency', 1000.0, 'Hz', 'Corner of the lumped fluid dynamics',
              1.0, 1e5, source='paper, section 4.1'),
    Parameter('fluid_dynamics.leakage', 0.0, 'N/N',
              'Leakage past the piston: static force without it over that with it, minus 1',
              0.0, 10.0),
    Parameter('fluid_dynamics.leakage_growth', 0.0, '1/N', 'Growth of that share with the force',
              0.0, 1.0),
    Parameter('fluid_dynamics.air_time', 0.0, 's',
              'Lag of entrained air at no force', 0.0, 0.1),
    Parameter('fluid_dynamics.air_force', 200.0, 'N',
              'Force at which the air is compressed so far that this lag has halved', 1.0, 1e5),

    _model('friction', 'linear_gain times the velocity', 'none'),
    Parameter('friction.linear_gain', 0.0, 'N s/m', 'Gain when the model is linear', 0.0, 1e6),
    Parameter('friction.coulomb', 7.0, 'N', 'Friction when sliding', 0.0, 1e4,
              source='paper, section 2.2'),
    Parameter('friction.coulomb_asymmetry', 0.0, '',
              'Coulomb friction is larger by this share when extending, smaller when retracting',
              -1.0, 1.0),
    Parameter('friction.viscous', 0.0, 'N s/m', 'Viscous friction', 0.0, 1e6),
    Parameter('friction.location', 'cylinder', '',
              'cylinder: between oil and force sensor; load: behind the force sensor',
              choices=('cylinder', 'load')),
    Parameter('friction.softening', 0.0, '',
              'How friction depends on velocity and direction; 0: seals are deflected less where '
              'it is lower (LuGre); 1: they are softer (a Stribeck curve times Maxwell slip)',
              0.0, 1.0),
    Parameter('friction.element_ratio', 1.0, '',
              'The seals are four elements in parallel, and each slides after so many times the '
              'way of the one before (Maxwell slip); 1: all at once', 1.0, 10.0),
    Parameter('friction.presliding_slip', 0.0, '',
              'How gradually sliding sets in; 0: purely elastic below 70 % of breakaway (Dupont '
              'et al. 2002); 1: it slides from the first deflection (Dahl 1968, LuGre)',
              0.0, 1.0),
    Parameter('friction.presliding_exponent', 1.0, '',
              "Exponent of Dahl's law: above 1 sliding sets in earlier and is complete later",
              0.5, 5.0),
    Parameter('friction.stiction_push', 27.0, 'N', 'Breakaway force when the piston extends',
              0.0, 1e4, source='paper, section 2.2'),
    Parameter('friction.stiction_pull', 15.0, 'N', 'Breakaway force when the piston retracts',
              0.0, 1e4, source='paper, section 2.2'),
    Parameter('friction.stribeck_velocity', 0.005, 'm/s',
              'Velocity over which stiction falls to Coulomb friction', 1e-6, 10.0,
              source='assumed'),
    Parameter('friction.presliding_stiffness', 70330.0, 'N/m',
              'Stiffness of the seals before they slide', 1e2, 1e9, source=FITTED),
    Parameter('friction.presliding_damping', 375.7, 'N s/m',
              'Damping of the seals before they slide', 0.0, 1e6, source=FITTED),

    Parameter('load.type', 'locked', '',
              'locked: held by the stiffness of the structure; spring: mass, spring and damper; '
              'free: the mass alone; prescribed: moved at a given velocity', choices=LOAD),
    Parameter('load.mass', 0.4522, 'kg',
              'Moving mass; when locked, including the moving part of the structure',
              1e-3, 1e4, source=FITTED),
    Parameter('load.locked_stiffness', 2.742e6, 'N/m', 'Stiffness of the locked structure',
              1.0, 1e9, source=FITTED),
    Parameter('load.locked_damping', 1272.0, 'N s/m', 'Damping of the locked structure',
              0.0, 1e6, source=FITTED),
    Parameter('load.stiffness', 2e5, 'N/m', 'Spring of the spring load', 0.0, 1e9,
              source='study, Table 1 rows'),
    Parameter('load.damping', 20.0, 'N s/m', 'Damper of the spring load', 0.0, 1e6,
              source='study, Table 1 rows'),
    Parameter('load.velocity', 0.0, 'm/s',
              'Velocity of the prescribed motion (amplitude, if load.frequency is not 0)',
              -10.0, 10.0),
    Parameter('load.frequency', 0.0, 'Hz', 'Frequency of the prescribed motion; 0: constant',
              0.0, 1000.0),
    Parameter('load.external_force', 0.0, 'N', 'Push from outside on the piston', -1e5, 1e5),
    Parameter('load.external_force_start', 0.0, 's', 'Time at which the push begins', 0.0, 1e5),
    Parameter('load.external_force_end', 0.0, 's', 'Time at which the push ends; 0: never',
              0.0, 1e5),
    Parameter('load.external_force_frequency', 0.0, 'Hz',
              'Frequency of the push, then a sine of this amplitude; 0: constant', 0.0, 1000.0),
    Parameter('load.external_force_phase', 0.0, 'turns', 'Phase of that sine at time 0',
              -1.0, 1.0),

    Parameter('coupling.stiffness', 0.0, 'N/m',
              'Stiffness between piston and load: a compliance; 0: rigid', 0.0, 1e9),
    Parameter('coupling.damping', 0.0, 'N s/m', 'Damping between piston and load', 0.0, 1e6),
    Parameter('coupling.piston_share', 0.3, '',
              'Share of load.mass on the side of the piston, if a compliance or backlash divides '
              'it; of that side the sensor does not measure force_sensor.mass_share', 0.01, 0.99),
    Parameter('backlash.gap', 0.0, 'm', 'Width of the gap; 0: no backlash', 0.0, 0.1),
    Parameter('backlash.centre', 0.0, 'm', 'Position of the piston in the middle of the gap',
              -1.0, 1.0),
    Parameter('backlash.location', 'mass', '',
              'mass: between piston and load mass, which floats in the gap; spring: between mass '
              'and spring; spring_damper: between mass and spring with damper',
              choices=('mass', 'spring', 'spring_damper')),
    Parameter('backlash.contact_stiffness', 1e7, 'N/m',
              'Stiffness of the contact, where the coupling is rigid', 1e3, 1e9),

    _model('force_sensor', 'linear_gain, no dynamics', 'no dynamics'),
    Parameter('force_sensor.linear_gain', 1.0, 'N/N', 'Gain when the model is linear',
              0.0, 10.0),
    Parameter('force_sensor.natural_frequency', 1558.0, 'Hz', 'Natural frequency of the sensor',
              1.0, 5e3, source=FITTED),
    Parameter('force_sensor.damping_ratio', 0.7, '', 'Damping ratio of the sensor', 0.0, 10.0,
              source='assumed'),
    Parameter('force_sensor.card_frequency', 2885.0, 'Hz',
              'Corner of the card that conditions the signal (second order, Butterworth)',
              10.0, 1e5, source=FITTED),
    Parameter('force_sensor.delay', 1.831e-4, 's', 'Second of the two delays', 0.0, 0.01,
              source=FITTED),
    Parameter('force_sensor.mass_share', 0.8004, '',
              'Share of the moving mass before the sensor, whose inertia it does not measure: 0, '
              'it is between cylinder and piston; 1, between the mass and its support. Of a mass '
              'that is divided, the share of the side of the piston: see coupling.piston_share',
              0.0, 1.0, source=FITTED),
    Parameter('force_sensor.gain', 1.0, 'N/N', 'Scale of the measured force', 0.1, 10.0),
    Parameter('force_sensor.offset', 0.0, 'N', 'Offset of the measured force', -1e4, 1e4),
    Parameter('force_sensor.lag_time', 0.0, 's', 'Time constant of a further first-order lag',
              0.0, 0.1),
    Parameter('force_sensor.second_lag_time', 0.0, 's', 'Time constant of one more after it',
              0.0, 0.1),
    Parameter('force_sensor.drift', 0.0, 'N/s', 'Drift of the offset', -1e4, 1e4),
    Parameter('force_sensor.drift_curve', 0.0, 'N/s2', 'Change of that drift', -1e4, 1e4),
    Parameter('force_sensor.drop_rate', 0.0, '',
              'Share of the readings that are lost; the last one is held', 0.0, 0.99),
    Parameter('force_sensor.noise', 0.0, 'N', 'Standard deviation of the measured force',
              0.0, 1e3),
    Parameter('force_sensor.noise_seed', 1, '', 'Seed of that noise', 0, 2**31 - 1),
))

ACTUATOR_DTYPE = record_dtype(ACTUATOR_PARAMETERS)


def as_record(values: Mapping[str, Value] | None = None) -> np.void:
    """
    Return the record that the compiled physics reads: the defaults, changed by `values`.

    Raises ParameterError for an unknown name, or a value or combination that is not allowed.
    """
    return record_of(values or {}, ACTUATOR_PARAMETERS)
