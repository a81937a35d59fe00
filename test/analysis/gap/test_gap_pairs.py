"""Two effects of one machine, found by the simulator as predictor."""

import pytest
from test_gap_simulator import recorded

from asi_analysis.gap.diagnose import diagnose
from asi_analysis.gap.document import document


@pytest.mark.slow
def test_an_effect_of_the_valve_and_one_behind_it_are_both_named():
    nominal = {'load.type': 'spring'}
    run = recorded({**nominal, 'valve_flexure.lag_time': 0.003, 'force_sensor.offset': 15.0})
    answer = document(diagnose([run], nominal))
    assert answer['verdict'] == 'sensor_offset+valve_lag' and answer['probability'] > 0.9
    assert answer['gap']['after_nrmse'] < 1.1 * answer['gap']['noise_floor_nrmse']


@pytest.mark.slow
def test_two_effects_behind_the_valve_are_both_named():
    nominal = {'load.type': 'spring'}
    run = recorded({**nominal, 'friction.coulomb': 30.0, 'force_sensor.gain': 0.7})
    answer = document(diagnose([run], nominal))
    assert answer['verdict'] == 'coulomb_friction+sensor_gain' and answer['probability'] > 0.9
