"""What the defaults of the compensators claim: fast, settled, and far from a cycle."""

import pytest

from asi_analysis.bags.run import Run
from asi_analysis.loop.closed_loop import simulate_loop
from asi_analysis.measures.analysis import analyze
from asi_controller.compensator import OWN_GAIN
from asi_controller.compensators import COMPENSATORS

WITH_LAG = [name for name, each in COMPENSATORS.items()
            if 'lag_time' in {parameter.name for parameter in each.parameters}]
SPRING = {'load.type': 'spring', 'load.mass': 0.3}
CASES = [({}, 500.0), (SPRING, 150.0),
         pytest.param({}, 100.0, marks=pytest.mark.slow)]
# At 1 kHz over ROS the command answers the state of a period before.
RATES = [(5000.0, {}, 2.5), (1000.0, {'force_sensor.delay': 1.1e-3}, 1.5)]


def step(compensator, actuator, size, rate_hz=5000.0, gain=1.0):
    """Return the analysis of a step; gain: times the compensator's own."""
    controller = {'compensator': compensator, 'gain': gain * OWN_GAIN[compensator],
                  'reference.shape': 'step', 'reference.amplitude': size}
    return analyze(Run(*simulate_loop(actuator, controller, 0.8, rate_hz)))


@pytest.mark.parametrize('compensator', WITH_LAG)
@pytest.mark.parametrize('rate_hz, delay, times', RATES)
@pytest.mark.parametrize('actuator, size', CASES)
def test_no_cycle_at_a_higher_gain(compensator, rate_hz, delay, times, actuator, size):
    answer = step(compensator, {**actuator, **delay}, size, rate_hz, times)
    assert answer['oscillation']['sustained'] is False
    assert answer['settling_time_5_s'] < 0.3


@pytest.mark.parametrize('compensator', ['lead2', 'lead4'])
@pytest.mark.parametrize('size', [100.0, 500.0])
def test_leads_have_the_fourth_order_row_of_table_1(compensator, size):
    """Published, on the locked piston: 7 ms, 0 %, 40 ms, well below 2 N."""
    answer = step(compensator, {}, size)
    assert answer['monotone_rise']
    assert answer['rise_time_s'] == pytest.approx(0.007, abs=0.0015)
    assert answer['overshoot_percent'] < 2.0
    assert answer['settling_time_2_s'] < 0.04
    assert abs(answer['steady_state_error_n']) < 2.0


@pytest.mark.parametrize('size', [150.0, 500.0])
def test_lead_lag_has_rise_overshoot_and_error_of_table_1_on_the_locked_piston(size):
    """Published: 10 ms, 14 %, below 2 N."""
    answer = step('lead_lag', {}, size)
    assert answer['rise_time_s'] == pytest.approx(0.010, abs=0.0015)
    assert answer['overshoot_percent'] == pytest.approx(14.0, abs=2.8)
    assert abs(answer['steady_state_error_n']) < 2.0
