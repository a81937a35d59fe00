"""The parameter set of the first study (its fit S10), for tests that need known numbers."""

from asi_common.parameter import Value

STUDY: dict[str, Value] = {
    'valve_hysteresis.radius': 14.0,
    'valve_hysteresis.lag_time': 0.000654,
    'valve_hysteresis.rate_exponent': 0.05,
    'valve_hysteresis.rate_filter': 1500.0,
    'valve_hysteresis.saturation': 100000.0,
    'valve_flexure.coil_frequency': 26.1,
    'valve_flexure.natural_frequency': 890.0,
    'valve_flexure.damping_ratio': 0.359,
    'valve_flexure.delay': 0.001003,
    'valve_characteristic.gain': 0.535,
    'hydraulic_damping.centre_share': 0.021,
    'hydraulic_damping.saturation_velocity': 0.452,
    'hydraulic_damping.saturation_shift': 0.112,
    'hydraulic_damping.saturation_narrowing': 0.422,
    'hydraulic_damping.velocity_width': 0.198,
    'hydraulic_damping.width_growth': 0.217,
    'hydraulic_damping.viscous': 970.0,
    'friction.presliding_stiffness': 200000.0,
    'friction.presliding_damping': 50.0,
    'load.mass': 0.5,
    'load.locked_stiffness': 1120000.0,
    'load.locked_damping': 50.0,
    'force_sensor.natural_frequency': 800.0,
    'force_sensor.card_frequency': 10000.0,
    'force_sensor.delay': 0.0001,
    'force_sensor.mass_share': 0.0,
}
# The inverse of its static gain, as the compensators' feed-forward.
STUDY_CONTROLLER: dict[str, Value] = {'feedforward': 1.869}
