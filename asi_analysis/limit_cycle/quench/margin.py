"""
The limit-cycle margin of a compensator: least distance between its loop and -1/N.

In the Nyquist plane, over amplitudes at the input of the hysteresis, biases (steady-state forces,
which open the valve and so change the damping) and loads. The margin is 0 if the loop encircles a
point of -1/N: a cycle is predicted. The feed-forward of the velocity is not in it.
"""

from itertools import product
from typing import Any, Final, NamedTuple

import numpy as np

from asi_actuator.parameters import as_record
from asi_analysis.arrays import Complex
from asi_analysis.loop import describing_functions as describing
from asi_analysis.loop import linear_model as linear
from asi_analysis.loop.harmonic_balance import Loop
from asi_analysis.loop.simulation import Values, loop_of

FREQUENCIES_HZ: Final = np.geomspace(0.5, 2000.0, 700)
# N is computed on this coarser grid and interpolated, as it varies slowly with frequency.
N_FREQUENCIES_HZ: Final = np.geomspace(0.5, 2000.0, 14)
AMPLITUDES_N: Final = np.geomspace(20.0, 4000.0, 9)
BIASES_N: Final = (0.0, 300.0, 600.0, 900.0)
LOADS: Final[dict[str, dict[str, Any]]] = {
    'locked': {'load.type': 'locked'},
    'spring 2e5 N/m': {'load.type': 'spring', 'load.stiffness': 2e5, 'load.mass': 0.5},
    'spring 2e4 N/m, 5 kg': {'load.type': 'spring', 'load.stiffness': 2e4, 'load.mass': 5.0},
    'free, 2 kg': {'load.type': 'free', 'load.mass': 2.0},
}


class Margin(NamedTuple):
    """The least distance, and its amplitude and bias (N), frequency (Hz) and load."""

    distance: float
    amplitude_n: float
    bias_n: float
    frequency_hz: float
    load: str


def hysteresis_table(loop: Loop) -> Complex:
    """Return N of hysteresis and its inverse, if any: AMPLITUDES_N x FREQUENCIES_HZ."""
    inverse = (loop.compensator['hysteresis_inverse_size'],
               loop.compensator['hysteresis_inverse_dead_zone'])
    table = np.array([[describing.hysteresis(a, f, loop.plant, inverse=inverse)
                       for f in N_FREQUENCIES_HZ] for a in AMPLITUDES_N])
    fine, coarse = np.log(FREQUENCIES_HZ), np.log(N_FREQUENCIES_HZ)
    return np.array([np.interp(fine, coarse, row.real) + 1j * np.interp(fine, coarse, row.imag)
                     for row in table])


def plant(p: np.void, bias_n: float, period_s: float) -> Complex:
    """Return command to measured force at FREQUENCIES_HZ: no hysteresis, sliding seals."""
    opening = float(np.clip(bias_n / p['valve_characteristic_maximum_force'], -1.0, 1.0))
    return linear.plant(p, period_s, linear.damping_slope(p, opening))(FREQUENCIES_HZ)


def encircles(response: Complex) -> bool:
    """Return whether a loop L (negative feedback) encircles -1: winding of 1 + L about 0."""
    angle = np.unwrap(np.angle(1.0 + response))
    return bool(abs(angle[-1] - angle[0]) > np.pi)


def margin(actuator: Values, controller: Values, rate_hz: float) -> Margin:
    """Return the limit-cycle margin of a controller's loop, over LOADS, biases and N."""
    loop = loop_of(actuator, controller, rate_hz)
    compensated, table = loop.compensated(FREQUENCIES_HZ), hysteresis_table(loop)
    worst = Margin(np.inf, 0.0, 0.0, 0.0, '')
    for (name, load), bias in product(LOADS.items(), BIASES_N):
        response = compensated * plant(as_record({**actuator, **load}), bias, loop.period_s)
        for amplitude, gain in zip(AMPLITUDES_N, table, strict=True):
            # Below the width of the play N is 0: the loop is open.
            size = np.where(np.abs(gain) > 1e-6, np.abs(gain), np.inf)
            distance = np.abs(1.0 + response * gain) / size
            distance = np.where(np.isfinite(size), distance, np.inf)
            k = int(np.argmin(distance))
            least = 0.0 if encircles(response * gain) else float(distance[k])
            if least < worst.distance:
                worst = Margin(least, float(amplitude), bias, float(FREQUENCIES_HZ[k]), name)
    return worst
