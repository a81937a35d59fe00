"""
The paper's prediction: harmonic balance with the describing function of the hysteresis alone.

Section 4: every other nonlinearity is left out, the static characteristic is a gain, the fluid is
a gain below 200 Hz; a cycle is predicted where Kp G(jw) N(A, w) = -1.
"""

import cmath
import math
from typing import Final, NamedTuple

import numpy as np

from asi_actuator.model.force_sensor import CARD_DAMPING
from asi_actuator.model.jit import jit
from asi_actuator.model.valve_hysteresis import saturated, valve_hysteresis
from asi_analysis.facts.bench import Array

# Samples a period, and periods until the memory of the hysteresis has settled.
SAMPLES: Final = 180
SETTLING: Final = 2
AMPLITUDES_N: Final = np.geomspace(60.0, 8e3, 30)


class Prediction(NamedTuple):
    """
    Predicted cycles along one locus: n gains that rise, with what belongs to each.

    amplitude_n is that of the force, not of the command.
    """

    gain: Array
    frequency_hz: Array
    amplitude_n: Array


@jit
def describing_function(amplitude, frequency, p):
    """Return N(A, w) of the hysteresis for a command A sin(wt): N, Hz, record -> complex."""
    step = 1.0 / (frequency * SAMPLES)
    decay = math.exp(-2.0 * math.pi * p.valve_hysteresis_rate_filter * step)
    flux, filtered = 0.0, 0.0
    total = 0.0 + 0.0j
    for k in range((SETTLING + 1) * SAMPLES):
        angle = 2.0 * math.pi * k / SAMPLES
        command = amplitude * math.sin(angle)
        filtered = command + (filtered - command) * decay
        flux = valve_hysteresis(flux, command, filtered, p)
        if k >= SETTLING * SAMPLES:
            total += saturated(flux, p) * complex(math.sin(angle), math.cos(angle))
    return total * 2.0 / (SAMPLES * amplitude)


@jit
def _lag(s, natural_hz, damping):
    """Return ln of 1 / ((s/w)^2 + 2 z s/w + 1), the phase between 0 and -180 degrees."""
    x = s / (2.0 * math.pi * natural_hz)
    return -cmath.log(x * x + 2.0 * damping * x + 1.0)


@jit
def log_response(frequency, p):
    """
    Return ln of H S at a frequency (Hz): valve, static gain and sensor with both delays.

    Its imaginary part is the phase in radians, which does not jump at -180 degrees.
    """
    s = 2j * math.pi * frequency
    return (math.log(p.valve_characteristic_gain)
            - cmath.log(1.0 + 1j * frequency / p.valve_flexure_coil_frequency)
            + _lag(s, p.valve_flexure_natural_frequency, p.valve_flexure_damping_ratio)
            + _lag(s, p.force_sensor_natural_frequency, p.force_sensor_damping_ratio)
            + _lag(s, p.force_sensor_card_frequency, CARD_DAMPING)
            - s * (p.valve_flexure_delay + p.force_sensor_delay))


@jit
def _critical(amplitude, hysteresis, p):
    """Return the first frequency (Hz) at a phase of -180 degrees, and the gain there."""
    low, high = 5.0, 1000.0
    gain = 0.0
    while high / low > 1.0 + 1e-5:
        middle = math.sqrt(low * high)
        value = log_response(middle, p)
        if hysteresis:
            passed = describing_function(amplitude, middle, p)
            if passed == 0.0:
                high = middle
                continue
            value += cmath.log(passed)
        gain = math.exp(value.real)
        if value.imag > -math.pi:
            low = middle
        else:
            high = middle
    return low, gain


@jit
def _locus(amplitudes, p, out):
    for k in range(amplitudes.size):
        frequency, gain = _critical(amplitudes[k], True, p)
        out[0, k] = 1.0 / gain
        out[1, k] = frequency
        # The force that the sensor shows when the command swings by A.
        out[2, k] = amplitudes[k] * gain


def predict(plant: np.void) -> Prediction:
    """
    Return the predicted stable cycles, from the first intersection upward.

    On the branch beyond the least gain: there the amplitude grows with the gain (Loeb).
    """
    out = np.empty((3, AMPLITUDES_N.size))
    _locus(AMPLITUDES_N, plant, out)
    first = int(np.argmin(out[0]))
    rising = first + np.concatenate([[True], np.diff(out[0, first:]) > 0.0]).nonzero()[0]
    return Prediction(*out[:, rising])


def linear_critical_gain(plant: np.void) -> tuple[float, float]:
    """Return gain and frequency (Hz) at which the loop without any hysteresis becomes unstable."""
    frequency, gain = _critical(1.0, False, plant)
    return 1.0 / gain, frequency
