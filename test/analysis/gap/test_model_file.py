"""The improved model holds every effect that was found, and is read again as what it holds."""

from typing import Any

import numpy as np
import pytest

from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_analysis.gap.model.model_file import improved_model
from asi_analysis.gap.model.predict import plant_record
from asi_analysis.loop.closed_loop import simulate_loop
from asi_common.parameter import completed

TEXTBOOK: dict[str, Any] = {
    'valve_hysteresis.model': 'off', 'friction.model': 'off', 'hydraulic_damping.model': 'off',
    'load.type': 'spring', 'load.mass': 2.0, 'load.stiffness': 5e4, 'load.damping': 60.0,
    'force_sensor.mass_share': 0.0}
MOVED = {'reference.shape': 'multisine', 'reference.amplitude': 300.0,
         'reference.frequency': 2.0, 'reference.end_frequency': 40.0}
# Of each effect, fields that make it.
FOUND: dict[str, dict[str, float]] = {
    'transport_delay': {'command_delay': 0.004},
    'command_quantisation': {'command_quantum': 100.0, 'command_phase': 0.5},
    'valve_hysteresis': {'loop_width': 40.0, 'loop_share': 1.0},
    'valve_deadband of the drive': {'command_deadband': 30.0},
    'valve_deadband of the orifice': {'orifice_deadband': 5e-7},
    'valve_saturation of the travel': {'valve_limit': 4e-6},
    'valve_saturation of the flow': {'force_limit': 150.0},
    'valve_bias of the flexure': {'command_bias': 30.0},
    'valve_bias of the orifice': {'orifice_bias': 6e-7},
    'valve_lag': {'valve_lag': 0.003},
    'valve_lag of two poles': {'valve_lag': 0.01, 'valve_lag_split': 0.3},
    'hydraulic_damping': {'damping_viscous': 200.0, 'damping_quadratic': 80.0,
                          'damping_opening': 100.0},
    'supply_pressure': {'supply_drop': 0.2, 'supply_sag': 0.3, 'supply_time': 0.1},
    'internal_leakage': {'leakage_linear': 0.2, 'leakage_quadratic': 0.0004},
    'entrained_air': {'air_time': 0.004, 'air_stiffening': 0.01},
    'coulomb_friction': {'friction_level': 25.0, 'friction_inside': 1.0},
    'stiction behind the sensor': {'friction_level': 15.0, 'friction_breakaway': 2.0,
                                   'friction_stribeck': 0.02},
    'friction_asymmetry': {'friction_level': 20.0, 'friction_asymmetry': 0.6},
    'viscous_friction': {'viscous': 150.0},
    'backlash of the spring': {'backlash': 2e-4, 'piston_share': 1.0},
    'backlash of a floating load': {'backlash': 2e-4, 'backlash_floating': 1.0,
                                    'compliance': 1e-6, 'compliance_damping': 1e-4,
                                    'piston_share': 0.4},
    'load_compliance': {'compliance': 2e-6, 'compliance_damping': 2e-4, 'piston_share': 0.3},
    'disturbance_force': {'disturbance': 40.0},
    'disturbance_force, a wave': {'disturbance_wave': 60.0, 'disturbance_frequency': 7.0,
                                  'disturbance_phase': 0.9},
    'disturbance_force, a pulse': {'disturbance_pulse': 60.0, 'disturbance_start': 0.1,
                                   'disturbance_end': 0.3},
    'sensor_offset': {'sensor_offset': 12.0},
    'sensor_gain': {'sensor_gain_error': 0.3},
    'sensor_lag': {'sensor_lag': 0.003},
    'sensor_lag of two poles': {'sensor_lag': 0.01, 'sensor_lag_split': 0.3},
    'sensor_drift': {'sensor_drift': 60.0, 'sensor_drift_curve': -5.0},
}
# What the nominal model has a parameter for is read again as that parameter, not as an effect.
NOMINAL_AGAIN = ('valve_hysteresis', 'hydraulic_damping', 'coulomb_friction', 'stiction',
                 'friction_asymmetry', 'disturbance_force', 'sensor_offset', 'sensor_gain')


def found(name: str) -> np.void:
    """Return the record of the textbook plant with an effect put in."""
    record = plant_record(TEXTBOOK)
    for field, value in FOUND[name].items():
        record[field] = value
    return record


@pytest.mark.parametrize('name', FOUND)
def test_improved_model_holds_the_effect_and_the_simulator_shows_it(name: str) -> None:
    values, missing = improved_model(TEXTBOOK, [found(name)])
    assert missing == []
    completed(values, ACTUATOR_PARAMETERS)  # every value is allowed
    nominal, improved = (simulate_loop(model, MOVED, 0.4) for model in (TEXTBOOK, values))
    measured = ('force_n', 'valve_position_m', 'position_m', 'velocity_m_s')
    assert max(np.abs(getattr(improved, name) - getattr(nominal, name)).max()
               / np.std(getattr(nominal, name)) for name in measured) > 0.05


@pytest.mark.parametrize('name', [name for name in FOUND if not name.startswith(NOMINAL_AGAIN)])
def test_improved_model_as_nominal_model_has_the_effect(name: str) -> None:
    values, _ = improved_model(TEXTBOOK, [found(name)])
    again = plant_record(values)
    for field, value in FOUND[name].items():
        assert again[field] == pytest.approx(value), field


def test_what_the_simulator_cannot_hold_is_said() -> None:
    record = found('disturbance_force, a wave')
    record['disturbance'] = 20.0
    record['sensor_drift_bend'] = 1.0
    _, missing = improved_model(TEXTBOOK, [record])
    assert missing == ['sensor_drift_bend', 'disturbance_wave']


def test_what_is_beyond_the_range_of_a_parameter_is_said() -> None:
    record = found('transport_delay')
    record['command_delay'] = 0.2
    values, missing = improved_model(TEXTBOOK, [record])
    assert values['command_path.delay'] == 0.05
    assert missing == ['command_path.delay 0.2, which is limited to 0.05']


def test_friction_adds_to_that_of_the_nominal_model() -> None:
    nominal = TEXTBOOK | {'friction.model': 'full'}
    record = plant_record(nominal)
    record['friction_level'], record['friction_inside'] = 20.0, 1.0
    values, missing = improved_model(nominal, [record])
    assert missing == []
    assert (values['friction.coulomb'], values['friction.stiction_push'],
            values['friction.stiction_pull']) == (27.0, 47.0, 35.0)
