"""The facts of the paper: the measures are right where the truth is known."""

import json
import math
import subprocess
import sys

import pytest
from documented import problems

from asi_actuator.parameters import as_record
from asi_analysis.loop.bench import RATE_HZ, in_process, step_experiment
from asi_analysis.loop.linear_model import linear_model
from asi_analysis.loop.one_harmonic import OneHarmonic, linear_limit
from asi_analysis.loop.onset import onset
from asi_analysis.loop.simulation import loop_of
from asi_analysis.measures.oscillation import of_samples
from asi_analysis.paper.facts.bandwidth import bandwidth_hz, open_loop_gain
from asi_analysis.paper.facts.conditions import Conditions

LINEAR = {'valve_hysteresis.model': 'linear', 'valve_characteristic.model': 'linear',
          'hydraulic_damping.model': 'off', 'friction.model': 'off', 'load.type': 'locked'}


def test_linear_model_is_the_simulator_for_small_motion():
    values = {**LINEAR, 'hydraulic_damping.model': 'full', 'friction.model': 'full'}
    plant, model = as_record(values), linear_model(values)
    for frequency in (5.0, 60.0, 130.0):
        assert open_loop_gain(plant, 5.0, frequency) == pytest.approx(
            abs(model.response(frequency)), rel=5e-3)


def test_onset_of_a_linear_loop_is_its_critical_gain():
    actuator = {**LINEAR, 'command_limit': 1e5, 'fluid_dynamics.model': 'off'}
    settings = {'compensator': 'proportional', 'reference.amplitude': 50.0, 'saturation': 1e5}
    found = onset(actuator, settings, RATE_HZ, 8.0)
    held, continuous = (linear_limit(OneHarmonic(loop_of(actuator, {'gain': 1.0}, RATE_HZ), held))
                        for held in (True, False))
    assert found.gain == pytest.approx(held[0], rel=0.005) and held[0] < continuous[0]
    assert found.frequency_hz == pytest.approx(held[1], rel=0.005)


def test_bandwidth_of_a_first_order_lag():
    assert bandwidth_hz(lambda f: 1.0 / math.hypot(1.0, f / 20.0), 0.5,
                        (10.0, 16.0, 19.0, 21.0, 30.0)) == pytest.approx(20.0, rel=2e-3)
    assert math.isinf(bandwidth_hz(lambda f: 1.0, 1.0, (10.0, 100.0)))


@pytest.mark.parametrize('name', ['lead_lag', 'lead4'])
def test_the_leads_of_table_1_leave_no_cycle_at_any_step(name):
    """As section 5 says; settings that settle in Table 1's time can cycle after small steps."""
    test = getattr(Conditions(), name)
    for step_n in (20.0, 50.0, 100.0, 200.0, 400.0, 800.0):
        run = in_process(step_experiment(test.load, test.controller, step_n, 2.0))
        assert not of_samples(run.force_n[-2500:], RATE_HZ).sustained, step_n


@pytest.mark.slow
def test_reproduce_prints_the_documented_json():
    answer = subprocess.run([sys.executable, '-m', 'asi_analysis.cli', 'reproduce', '--json'],
                            capture_output=True, text=True, check=True)
    document = json.loads(answer.stdout)
    assert problems(document, 'asi reproduce') == []
    assert {fact['id'] for fact in document['facts']} == {f'F{k}' for k in range(1, 20)}
    assert document['met'] == sum(fact['met'] for fact in document['facts'])
    # What the model misses is known: a fact that is lost, or won, is to be looked at.
    assert [fact['quantity'] for fact in document['facts'] if not fact['met']] == [
        'P, Kp = 3: rise time 10 to 90 %', 'P, Kp = 3: settling time 2 %',
        'lead-lag: settling time 2 %', 'fourth-order lead: settling time 2 %',
        'rise time of P over that of the fourth-order lead']
    # In the spring that suits P alone, most of the mass is hidden from the sensor.
    first = document['alone'][0]
    assert first['met'] == first['total'] and len(first['not_plausible']) == 3
