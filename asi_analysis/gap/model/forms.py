"""
The forms of each effect of the vocabulary in the simulator: the parameters that are free in a fit.

Bounds and starts are in units of the recording; see `Free`. The block and the description of each
effect are with the physics, in asi_actuator/model/effects.py.
"""

from itertools import chain

from asi_actuator.model.backlash import MASS, SPRING_ALONE, SPRING_AND_DAMPER
from asi_actuator.model.command_path import EDGE, NEAREST, ZERO
from asi_actuator.model.friction import BEHIND_SENSOR, CYLINDER
from asi_actuator.model.load import LOCKED, SPRING
from asi_actuator.parameters import ACTUATOR_DTYPE
from asi_analysis.gap.model.effects import Effects, Free, Variant, fields_of
from asi_common.jit import FULL, LINEAR, OFF

SMALL = (0.005, 0.02, 0.06, 0.15)
LARGE = (0.5, 0.7, 0.85, 0.95)
TIMES = (0.0005, 0.002, 0.008)


def _scaled(field: str, low: float = 0.0, high: float = 20.0,
            starts: tuple[float, ...] = (1.7, 0.4)) -> Free:
    """Return a free nominal parameter; bounds and starts are multiples of its nominal value."""
    return Free(field, low, high, starts, 'nominal')


def _form(*free: Free, fixed: dict[str, float] | None = None, needs: tuple[str, ...] = (),
          where: dict[str, float] | None = None) -> Variant:
    scaled = tuple(each.field for each in free if each.scale == 'nominal')
    return Variant(free, fixed=tuple((fixed or {}).items()), needs=(*scaled, *needs),
                   where=tuple((where or {}).items()))


_PUSH = Free('load_external_force', -1.0, 1.0, (0.02, -0.02), 'force')
_HYDRAULIC = tuple(f'hydraulic_damping_{name}' for name in (
    'maximum_force', 'viscous', 'saturation_velocity', 'velocity_width', 'centre_share'))
_DAMPING = (Free('hydraulic_damping_quadratic', 0.0, 2.0, (0.02, 0.2), 'damping_quadratic'),
            Free('hydraulic_damping_opening_viscous', 0.0, 2.0, (0.02, 0.2), 'damping'))
_BREAKAWAY = tuple(_scaled(f'friction_stiction_{way}', 0.0, 20.0, (1.5,))
                   for way in ('push', 'pull'))


# How friction begins to slide: all at once, by Dahl's law; or element after element.
_DAHL = ((Free('friction_presliding_exponent', 0.5, 3.0, (1.0,)),),
         {'friction_presliding_slip': 1.0})
_MAXWELL = ((Free('friction_presliding_slip', 0.0, 1.0, (0.5,)),
             Free('friction_element_ratio', 1.0, 6.0, (1.5,))), dict[str, float]())


def _first_friction(*more: Free, sharp: bool = True,
                    laws: tuple[tuple[tuple[Free, ...], dict[str, float]], ...] = (
                        _DAHL, _MAXWELL)) -> tuple[Variant, ...]:
    """Return forms of friction in a plant that has none: on either side of the force sensor."""
    without_stiction = {'friction_stribeck_velocity': 1e-6} if sharp else {}   # its least
    return tuple(_form(
        Free('friction_coulomb', 0.0, 0.7, (0.02, 0.1, 0.3), 'force'),
        _scaled('friction_presliding_stiffness', 0.05, 300.0, (1.0, 20.0)), *sliding,
        _scaled('friction_presliding_damping', 0.0, 4.0, (1.0,)), *more,
        fixed={'friction_model': FULL, 'friction_location': place} | without_stiction | fixed,
        where={'friction_model': OFF})
        for sliding, fixed in laws for place in (CYLINDER, BEHIND_SENSOR))


_ASYMMETRIES = tuple(Free('friction_coulomb_asymmetry', low, high, (start,))
                     for low, high, start in ((0.15, 1.0, 0.35), (-1.0, -0.15, -0.35)))
_GAP = Free('backlash_gap', 0.002, 1.4, (0.008, 0.02, 0.04, 0.07, 0.12, 0.3), 'position')
_CENTRE = Free('backlash_centre', -0.5, 0.5, (0.0,), 'position')

# In the order of the signal path.
EFFECTS: Effects = {
    'transport_delay': (
        _form(Free('command_path_delay', 0.0, 0.1, (0.001, 0.003, 0.01, 0.03))),
        _form(_scaled('valve_flexure_delay', 0.0, 20.0, (2.0, 0.4, 5.0)),
              needs=('valve_flexure_model',)),
    ),
    'command_quantisation': tuple(
        _form(Free('command_path_quantum', 0.997, 1.003, (1.0,), guess),
              fixed={'command_path_rounding': kind})
        for guess, kind in (('residual_step', NEAREST), ('residual_step_edge', EDGE),
                            ('residual_step_edge', ZERO))),
    'valve_hysteresis': (
        _form(_scaled('valve_hysteresis_radius', 0.0, 10.0), needs=('valve_hysteresis_model',)),
        _form(_scaled('valve_hysteresis_radius', 0.0, 10.0),
              _scaled('valve_hysteresis_lag_time'), needs=('valve_hysteresis_model',)),
        _form(Free('valve_hysteresis_radius', 0.0, 0.8, SMALL, 'command'),
              fixed={'valve_hysteresis_model': FULL, 'valve_hysteresis_lag_time': 0.0,
                     'valve_hysteresis_saturation': 1e6}),
        _form(Free('valve_hysteresis_radius', 0.0, 0.8, SMALL, 'command'),
              Free('valve_hysteresis_rounding', 0.0, 1.0, (0.5,)),
              fixed={'valve_hysteresis_model': FULL, 'valve_hysteresis_lag_time': 0.0,
                     'valve_hysteresis_saturation': 1e6}, where={'valve_hysteresis_model': OFF}),
    ),
    'valve_deadband': (
        _form(Free('valve_flexure_deadband', 0.0, 1.0, (*SMALL, 0.4), 'command')),
        _form(Free('valve_characteristic_deadband', 0.0, 1.0, (*SMALL, 0.4), 'valve_position')),
    ),
    'valve_saturation': (
        _form(Free('valve_flexure_travel_limit', 0.2, 1.3, LARGE, 'valve_position')),
        _form(Free('command_limit', 0.2, 1.2, LARGE, 'command')),
        _form(Free('valve_characteristic_flow_limit', 0.2, 3.0, LARGE, 'force')),
    ),
    'valve_bias': (
        _form(Free('valve_flexure_bias', -0.7, 0.7, (0.02, -0.02), 'command')),
        _form(Free('valve_characteristic_bias', -0.7, 0.7, (0.02, -0.02), 'valve_position')),
    ),
    'valve_lag': (
        _form(Free('valve_flexure_lag_time', 0.0, 0.1, (0.001, 0.004, 0.015))),
        _form(Free('valve_flexure_lag_time', 0.0, 0.1, (0.001, 0.004, 0.015)),
              Free('valve_flexure_second_lag_time', 0.0, 0.05, (0.0003, 0.001, 0.004))),
        _form(_scaled('valve_flexure_coil_frequency', 0.1, 8.0, (0.5, 2.0)),
              needs=('valve_flexure_model',)),
    ),
    'hydraulic_damping': (
        *(_form(_scaled(name), needs=('hydraulic_damping_model',)) for name in _HYDRAULIC[:3]),
        _form(*map(_scaled, _HYDRAULIC), needs=('hydraulic_damping_model',)),
        _form(*_DAMPING),
        _form(_scaled('hydraulic_damping_linear_gain'), *_DAMPING,
              where={'hydraulic_damping_model': LINEAR}),
    ),
    'supply_pressure': (
        _form(Free('valve_characteristic_supply_drop', -0.6, 0.9, (0.1, -0.1))),
        _form(Free('valve_characteristic_supply_drop', -0.6, 0.9, (0.1,)),
              Free('valve_characteristic_supply_sag', 0.0, 3.0, (0.05, 0.5)),
              Free('valve_characteristic_supply_time', 0.02, 1.5, (0.1, 0.5))),
    ),
    'internal_leakage': (
        _form(Free('fluid_dynamics_leakage', 0.0, 3.0, (0.1, 0.5))),
        _form(Free('fluid_dynamics_leakage', 0.0, 3.0, (0.1,)),
              Free('fluid_dynamics_leakage_growth', 0.0, 3.0, (0.1,), 'inverse_force')),
    ),
    'entrained_air': (
        _form(Free('fluid_dynamics_air_time', 0.0, 0.05, TIMES),
              Free('fluid_dynamics_air_force', 0.03, 30.0, (0.5,), 'force')),
    ),
    'coulomb_friction': (
        _form(_scaled('friction_coulomb', 0.0, 20.0, (2.0, 0.4, 6.0)), needs=('friction_model',)),
        # In some formulations the breakaway force grows with Coulomb friction.
        _form(_scaled('friction_coulomb', 0.0, 20.0, (3.0, 0.4)), *_BREAKAWAY,
              needs=('friction_model',)),
        *_first_friction(),
    ),
    'stiction': (
        _form(_scaled('friction_stiction_push', 0.0, 8.0), needs=('friction_model',)),
        _form(_scaled('friction_stiction_push', 0.0, 8.0),
              _scaled('friction_stiction_pull', 0.0, 8.0), needs=('friction_model',)),
        _form(_scaled('friction_stiction_push', 0.0, 8.0),
              _scaled('friction_stiction_pull', 0.0, 8.0),
              _scaled('friction_stribeck_velocity', 0.1, 30.0, (5.0, 1.0)),
              needs=('friction_model',)),
        *_first_friction(*(Free(f'friction_stiction_{way}', 0.0, 1.5, (0.1, 0.3), 'force')
                           for way in ('push', 'pull')),
                         Free('friction_stribeck_velocity', 0.003, 0.6, (0.1, 0.3), 'velocity'),
                         Free('friction_softening', 0.0, 1.0, (0.5,)), sharp=False,
                         laws=(_MAXWELL,)),
    ),
    'friction_asymmetry': (
        _form(Free('friction_coulomb_asymmetry', -1.0, 1.0, (0.3, -0.3)),
              needs=('friction_model', 'friction_coulomb')),
        # Beside other free friction: with less asymmetry it is one of the other effects.
        *(_form(asymmetry, _scaled('friction_coulomb', 0.0, 20.0, (1.0, 4.0)), *more,
                needs=('friction_model',))
          for more in ((), _BREAKAWAY) for asymmetry in _ASYMMETRIES),
        *(form for asymmetry in _ASYMMETRIES
          for form in _first_friction(asymmetry, Free('friction_softening', 0.0, 1.0, (0.5,)))),
    ),
    'viscous_friction': (
        _form(Free('friction_viscous', 0.0, 2.0, (0.02, 0.1), 'damping')),
        # Behind the force sensor.
        *(_form(Free(damping, 0.0, 2.0, (0.02, 0.1, 0.5), 'damping'), where={'load_type': load})
          for damping, load in (('load_damping', SPRING), ('load_locked_damping', LOCKED))),
    ),
    'backlash': (
        _form(_GAP, _CENTRE, fixed={'backlash_location': SPRING_AND_DAMPER}),
        _form(_GAP, _CENTRE, fixed={'backlash_location': SPRING_ALONE}),
        _form(_GAP, _CENTRE, Free('coupling_piston_share', 0.05, 0.95, (0.3, 0.7)),
              fixed={'backlash_location': MASS}),
    ),
    'load_compliance': (
        _form(Free('coupling_stiffness', 1e-3, 1000.0, (15.0, 3.0, 0.6, 0.1), 'stiffness'),
              Free('coupling_damping', 0.0, 2.0, (0.02,), 'coupling'),
              Free('coupling_piston_share', 0.02, 0.98, (0.3, 0.7))),
    ),
    'disturbance_force': (
        _form(_PUSH),
        _form(_PUSH._replace(low=0.0, starts=(0.1,)),
              Free('load_external_force_phase', 0.5, 1.5, (1.0,), 'residual_phase'),
              Free('load_external_force_frequency', 0.98, 1.02, (1.0,), 'residual_frequency')),
        _form(_PUSH._replace(starts=(0.1, -0.1)),
              Free('load_external_force_start', 0.997, 1.003, (1.0,), 'residual_start'),
              Free('load_external_force_end', 0.997, 1.003, (1.0,), 'residual_end')),
    ),
    'sensor_offset': (
        _form(Free('force_sensor_offset', -1.0, 1.0, (0.02, -0.02), 'force')),),
    'sensor_gain': (_form(_scaled('force_sensor_gain', 0.3, 2.5, (0.8, 1.25))),),
    'sensor_lag': (
        _form(Free('force_sensor_lag_time', 0.0, 0.05, TIMES)),
        _form(Free('force_sensor_lag_time', 0.0, 0.05, TIMES),
              Free('force_sensor_second_lag_time', 0.0, 0.02, (0.0002, 0.001))),),
    'sensor_drift': (
        _form(Free('force_sensor_drift', -3.0, 3.0, (0.02, -0.02), 'drift'),
              Free('force_sensor_drift_curve', -3.0, 3.0, (0.0,), 'drift_curve')),),
}

# Nominal parameters that are uncertain, by the channel that they act on first.
UNCERTAIN = {
    'valve': ('valve_characteristic_gain', 'valve_flexure_coil_frequency',
              'valve_flexure_natural_frequency', 'valve_flexure_damping_ratio',
              'valve_flexure_delay', 'valve_hysteresis_radius', 'valve_hysteresis_lag_time',
              'valve_hysteresis_saturation', 'valve_hysteresis_linear_gain',
              'valve_flexure_linear_gain'),
    'force': ('valve_characteristic_full_opening', 'valve_characteristic_maximum_force',
              *_HYDRAULIC, *(f'hydraulic_damping_{name}' for name in (
                  'linear_gain', 'width_growth', 'saturation_shift', 'saturation_narrowing')),
              'fluid_dynamics_frequency', 'friction_linear_gain', 'friction_coulomb',
              'friction_stiction_push', 'friction_stiction_pull',
              'friction_stribeck_velocity', 'friction_presliding_stiffness',
              'force_sensor_natural_frequency', 'force_sensor_delay',
              'load_mass', 'load_stiffness', 'load_damping', 'load_locked_stiffness',
              'load_locked_damping', 'force_sensor_gain', 'force_sensor_mass_share'),
}
# Shape parameters of the nominal laws, by channel: free in every fit, since textbooks formulate
# these laws differently. Of the hysteresis: how round the corners of its loop are, and whether
# the loop widens with the rate or the flux lags. Of damping: how slowly it saturates with the
# velocity. Of friction: how sliding begins (from Dupont's elasto-plastic bristle to Dahl's and
# LuGre's), the damping of the pre-sliding displacement, and the Stribeck velocity.
SHAPES = {
    'valve': (Free('valve_hysteresis_rounding', 0.0, 1.0, (0.0,)),
              Free('valve_hysteresis_lagged', 0.0, 1.0, (0.0,))),
    'force': (Free('hydraulic_damping_tail', -1.0, 2.0, (0.0,)),
              Free('friction_presliding_slip', 0.0, 1.0, (0.0,)),
              Free('friction_presliding_damping', 0.0, 4.0, (1.0,), 'nominal'),
              Free('friction_stribeck_velocity', 0.2, 5.0, (1.0,), 'nominal')),
}
# Further shapes of friction, free once no hypothesis explains a machine by the laws above: they
# take twice the time.
OTHER_SHAPES = {
    'force': (Free('friction_element_ratio', 1.0, 6.0, (1.0, 1.6)),
              Free('friction_softening', 0.0, 1.0, (0.0, 1.0))),
}
assert fields_of(chain(*EFFECTS.values())) <= set(ACTUATOR_DTYPE.names or ())
