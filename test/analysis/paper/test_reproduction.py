"""The facts of the paper: the measures are right where the truth is known."""

import json
import math
import subprocess
import sys

import numpy as np
import pytest
from documented import problems

from asi_actuator.parameters import as_record
from asi_analysis.bags.run import Run
from asi_analysis.loop.bench import RATE_HZ, Bench, in_process, step_experiment
from asi_analysis.loop.linear_model import linear_model
from asi_analysis.measures.oscillation import oscillation
from asi_analysis.paper.facts.bandwidth import bandwidth_hz, open_loop_gain
from asi_analysis.paper.facts.cycle import cycle, onset, proportional
from asi_analysis.paper.facts.describing import describing_function, linear_critical_gain

LINEAR = {'valve_hysteresis.model': 'linear', 'valve_characteristic.model': 'linear',
          'hydraulic_damping.model': 'off', 'friction.model': 'off', 'load.type': 'locked'}


def test_cycle_of_a_known_signal():
    time = np.arange(2000) / RATE_HZ
    force = 70.0 + 200.0 * np.sin(2 * np.pi * 87.3 * time + 1.0) + 10.0 * np.sin(
        2 * np.pi * 3 * 87.3 * time)
    found = cycle(force)
    assert found.frequency_hz == pytest.approx(87.3, rel=2e-4)
    assert found.amplitude_n == pytest.approx(200.0, rel=2e-3)
    assert found.thd == pytest.approx(0.05, abs=2e-3)


def test_fast_cycle_agrees_with_asi_analyze():
    run = in_process(step_experiment({}, proportional(14.0), 100.0, 1.0))
    slow, fast = oscillation(Run(*run)), cycle(run.force_n[-2000:])
    assert slow.sustained
    assert fast.frequency_hz == pytest.approx(slow.frequency_hz, rel=2e-3)
    assert fast.amplitude_n == pytest.approx(slow.amplitude_n, rel=1e-2)


def test_describing_function_of_a_plain_play():
    """Against the closed form, as in Gelb and Vander Velde (1968), appendix B."""
    radius, amplitude = 50.0, 130.0
    plant = as_record({'valve_hysteresis.radius': radius, 'valve_hysteresis.lag_time': 0.0,
                       'valve_hysteresis.saturation': 1e6})
    x = 1.0 - 2.0 * radius / amplitude
    real = 0.5 + (math.asin(x) + x * math.sqrt(1.0 - x * x)) / math.pi
    imaginary = -4.0 * radius / (math.pi * amplitude) * (1.0 - radius / amplitude)
    found = describing_function(amplitude, 5.0, plant)
    assert found.real == pytest.approx(real, abs=2e-3)
    assert found.imag == pytest.approx(imaginary, abs=2e-3)


def test_linear_model_is_the_simulator_for_small_motion():
    values = {**LINEAR, 'hydraulic_damping.model': 'full', 'friction.model': 'full'}
    plant, model = as_record(values), linear_model(values)
    for frequency in (5.0, 60.0, 130.0):
        assert open_loop_gain(plant, 5.0, frequency) == pytest.approx(
            abs(model.response(frequency)), rel=5e-3)


def test_onset_of_a_linear_loop_is_its_critical_gain():
    plant = as_record({**LINEAR, 'command_limit': 1e5, 'fluid_dynamics.model': 'off'})
    gain = onset(lambda gain: Bench(plant, proportional(gain)), 50.0, 6.0, 13.0)
    # The loop holds each command for a period: half a period of delay more than the prediction.
    predicted, _ = linear_critical_gain(plant)
    with_hold, _ = linear_critical_gain(as_record({
        **LINEAR, 'valve_flexure.delay': float(plant['valve_flexure_delay']) + 0.5 / RATE_HZ}))
    assert with_hold < gain * 1.01 < predicted * 1.03
    assert gain == pytest.approx(with_hold, rel=0.02)


def test_bandwidth_of_a_first_order_lag():
    assert bandwidth_hz(lambda f: 1.0 / math.hypot(1.0, f / 20.0), 0.5,
                        (10.0, 16.0, 19.0, 21.0, 30.0)) == pytest.approx(20.0, rel=2e-3)
    assert math.isinf(bandwidth_hz(lambda f: 1.0, 1.0, (10.0, 100.0)))


def test_reproduce_prints_the_documented_json():
    answer = subprocess.run([sys.executable, '-m', 'asi_analysis.cli', 'reproduce', '--json'],
                            capture_output=True, text=True, check=True)
    document = json.loads(answer.stdout)
    assert problems(document, 'asi reproduce') == []
    assert {fact['id'] for fact in document['facts']} == {f'F{k}' for k in range(1, 19)}
    assert document['met'] == sum(fact['met'] for fact in document['facts'])
    assert [fact['quantity'] for fact in document['facts'] if not fact['met']] == []
