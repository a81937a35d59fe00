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
from asi_actuator.model.valve_hysteresis import saturated, valve_hysteresis
from asi_analysis.loop.bench import Array
from asi_common.jit import jit

# Samples a period, and periods until the memory of the hysteresis has settled.
SAMPLES: Final = 180
SETTLING: Final = 2
# Where -180 degrees are looked for first, in steps of this logarithm, and no further than this.
START_HZ: Final = 120.0
BRACKET: Final = 0.1
LOWEST_HZ: Final = 5.0
HIGHEST_HZ: Final = 1000.0
MOST_ROUNDS: Final = 40
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
def _side(s, p):
    """Return ln of what the sensor feels of the force on the locked piston, without oil."""
    if p.force_sensor_mass_share == 0.0:
        return 0.0j
    held = p.load_locked_stiffness + p.load_locked_damping * s
    mass = p.load_mass * s * s
    return cmath.log(held + (1.0 - p.force_sensor_mass_share) * mass) - cmath.log(held + mass)


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
            + _side(s, p) - s * (p.valve_flexure_delay + p.force_sensor_delay))


@jit
def _log_loop(amplitude, hysteresis, frequency, p):
    """Return ln of the loop's response at a gain of 1; where nothing passes, a phase of -360."""
    value = log_response(frequency, p)
    if hysteresis:
        passed = describing_function(amplitude, frequency, p)
        if passed == 0.0:
            return complex(-100.0, -2.0 * math.pi)
        value += cmath.log(passed)
    return value


@jit
def _critical(amplitude, hysteresis, near, p):
    """
    Return the frequency (Hz) at a phase of -180 degrees, and the gain there.

    near: a frequency (Hz) to begin at. By a bracket about it, and the Illinois rule within.
    """
    low, high = math.log(near), math.log(near)
    below = _log_loop(amplitude, hysteresis, near, p)
    above = below
    while below.imag <= -math.pi and low > math.log(LOWEST_HZ):
        low, high, above = low - BRACKET, low, below
        below = _log_loop(amplitude, hysteresis, math.exp(low), p)
    while above.imag > -math.pi and high < math.log(HIGHEST_HZ):
        low, high, below = high, high + BRACKET, above
        above = _log_loop(amplitude, hysteresis, math.exp(high), p)
    down, up = below.imag + math.pi, above.imag + math.pi
    middle, value = low, below
    side = 0
    for _ in range(MOST_ROUNDS):
        if high - low < 1e-9 or down == up:
            break
        middle = min(max((low * up - high * down) / (up - down), low), high)
        value = _log_loop(amplitude, hysteresis, math.exp(middle), p)
        phase = value.imag + math.pi
        if abs(phase) < 1e-6:
            break
        if phase > 0.0:
            low, down = middle, phase
            up = 0.5 * up if side == 1 else up
            side = 1
        else:
            high, up = middle, phase
            down = 0.5 * down if side == -1 else down
            side = -1
    return math.exp(middle), math.exp(value.real)


@jit
def _locus(amplitudes, p, out):
    frequency = START_HZ
    for k in range(amplitudes.size):
        frequency, gain = _critical(amplitudes[k], True, frequency, p)
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
    frequency, gain = _critical(1.0, False, START_HZ, plant)
    return 1.0 / gain, frequency
