"""
Effects: deviations that the simulator can have from the nominal actuator, by name.

The words are those of the diagnosis. Each effect is a set of parameters of its block; `example` is
a clearly visible size. Null: the nominal parameters.
"""

from collections.abc import Mapping
from typing import Final, NamedTuple

from asi_common.parameter import Value

COMMAND_PATH, VALVE, HYDRAULICS, MECHANICS, SENSOR = BLOCKS = (
    'command_path', 'valve', 'hydraulics', 'mechanics', 'sensor')


class Effect(NamedTuple):
    """An effect: its word, its block in the signal path, what it is, parameters that show it."""

    name: str
    block: str
    description: str
    example: Mapping[str, Value]


EFFECTS: Final = (
    Effect('transport_delay', COMMAND_PATH, 'the valve command arrives late',
           {'command_path.delay': 0.002}),
    Effect('command_quantisation', COMMAND_PATH, 'the valve command comes in steps',
           {'command_path.quantum': 50.0}),
    Effect('valve_hysteresis', VALVE, 'the valve lags behind a command that turns',
           {'valve_hysteresis.radius': 80.0}),
    Effect('valve_deadband', VALVE, 'a small command moves no oil',
           {'valve_characteristic.deadband': 1e-6}),
    Effect('valve_saturation', VALVE, 'the valve opens only so far',
           {'valve_flexure.travel_limit': 4e-6}),
    Effect('valve_bias', VALVE, 'the valve is off its centre at no command',
           {'valve_characteristic.bias': 6e-7}),
    Effect('valve_lag', VALVE, 'the valve follows late',
           {'valve_flexure.lag_time': 0.002}),
    Effect('hydraulic_damping', HYDRAULICS, 'force is lost to the oil that a motion drives',
           {'hydraulic_damping.viscous': 400.0}),
    Effect('supply_pressure', HYDRAULICS, 'the supply pressure is low, or falls under load',
           {'valve_characteristic.supply_drop': 0.25}),
    Effect('internal_leakage', HYDRAULICS, 'oil leaks past the piston',
           {'fluid_dynamics.leakage': 0.2}),
    Effect('entrained_air', HYDRAULICS, 'air in the oil lets the force build up late',
           {'fluid_dynamics.air_time': 0.003}),
    Effect('coulomb_friction', MECHANICS, 'a constant force against the motion',
           {'friction.coulomb': 25.0}),
    Effect('stiction', MECHANICS, 'more force to break away than to slide',
           {'friction.stiction_push': 60.0, 'friction.stiction_pull': 50.0,
            'friction.stribeck_velocity': 0.05}),
    Effect('friction_asymmetry', MECHANICS, 'more friction one way than the other',
           {'friction.coulomb_asymmetry': 0.8}),
    Effect('viscous_friction', MECHANICS, 'a force against the motion, in proportion to it',
           {'friction.viscous': 200.0}),
    Effect('backlash', MECHANICS, 'the piston moves a little before the load does',
           {'backlash.gap': 2e-4}),
    Effect('load_compliance', MECHANICS, 'the load gives way between piston and mass',
           {'coupling.stiffness': 3e5, 'coupling.damping': 20.0}),
    Effect('disturbance_force', MECHANICS, 'something else pushes the load',
           {'load.external_force': 40.0}),
    Effect('sensor_offset', SENSOR, 'the force sensor does not read zero at no force',
           {'force_sensor.offset': 15.0}),
    Effect('sensor_gain', SENSOR, 'the force sensor reads too much or too little',
           {'force_sensor.gain': 1.5}),   # beyond what its tolerance may hide
    Effect('sensor_lag', SENSOR, 'the force sensor follows late',
           {'force_sensor.lag_time': 0.002}),
    Effect('sensor_drift', SENSOR, 'the zero of the force sensor drifts',
           {'force_sensor.drift': 20.0}),
    Effect('sensor_dropout', SENSOR, 'readings of the force sensor are lost',
           {'force_sensor.drop_rate': 0.3}),
)
EFFECT: Final = {effect.name: effect for effect in EFFECTS}
