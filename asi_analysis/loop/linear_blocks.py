"""Frequency responses of the model's linear blocks, as the model's records choose them."""

import numpy as np
import numpy.typing as npt

from asi_actuator.model.fluid_dynamics import fluid_gain
from asi_actuator.model.force_sensor import CARD_DAMPING
from asi_actuator.model.load import load_spring
from asi_actuator.model.valve_flexure import flexure_gain
from asi_common.jit import FULL

Array = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]


def _second_order(s: Complex, frequency_hz: float, damping: float) -> Complex:
    x = s / (2.0 * np.pi * frequency_hz)
    return 1.0 / (x * x + 2.0 * damping * x + 1.0)


def flexure(frequency_hz: npt.ArrayLike, p: np.void) -> Complex:
    """Return drive (N) to deflection (N of valve command)."""
    s: Complex = 2j * np.pi * np.asarray(frequency_hz, float)
    if p['valve_flexure_model'] != FULL:
        return np.full_like(s, flexure_gain(p))
    return (_second_order(s, p['valve_flexure_natural_frequency'],
                          p['valve_flexure_damping_ratio'])
            / (1.0 + s / (2.0 * np.pi * p['valve_flexure_coil_frequency']))
            * np.exp(-s * p['valve_flexure_delay']))


def fluid(frequency_hz: npt.ArrayLike, p: np.void) -> Complex:
    """Return static less damping force (N) to hydraulic force (N)."""
    s: Complex = 2j * np.pi * np.asarray(frequency_hz, float)
    if p['fluid_dynamics_model'] != FULL:
        return np.full_like(s, fluid_gain(p))
    return 1.0 / (1.0 + s / (2.0 * np.pi * p['fluid_dynamics_frequency']))


def sensor(frequency_hz: npt.ArrayLike, p: np.void) -> Complex:
    """Return felt (N) to measured force (N), gain of the sensor included."""
    s: Complex = 2j * np.pi * np.asarray(frequency_hz, float)
    if p['force_sensor_model'] != FULL:
        gain = p['force_sensor_linear_gain'] if p['force_sensor_model'] == 1 else 1.0
        return np.full_like(s, gain * p['force_sensor_gain'])
    return (p['force_sensor_gain'] * np.exp(-s * p['force_sensor_delay'])
            * _second_order(s, p['force_sensor_natural_frequency'],
                            p['force_sensor_damping_ratio'])
            * _second_order(s, p['force_sensor_card_frequency'], CARD_DAMPING))


def impedance(frequency_hz: npt.ArrayLike, p: np.void) -> Complex:
    """Return velocity (m/s) of the load to the force (N) that it takes; no frequency may be 0."""
    s: Complex = 2j * np.pi * np.asarray(frequency_hz, float)
    stiffness, damper = load_spring(p)
    needed: Complex = p['load_mass'] * s
    needed += damper
    needed += stiffness / s
    return needed


def inertia(frequency_hz: npt.ArrayLike, p: np.void) -> Complex:
    """Return velocity (m/s) of the mass to the part of its inertia (N) that no sensor feels."""
    s: Complex = 2j * np.pi * np.asarray(frequency_hz, float)
    return p['force_sensor_mass_share'] * p['load_mass'] * s


def felt(frequency_hz: npt.ArrayLike, p: np.void) -> Complex:
    """Return transmitted (N) to felt force (N) while the load moves freely; no frequency of 0."""
    return 1.0 - inertia(frequency_hz, p) / impedance(frequency_hz, p)


def hold(frequency_hz: npt.ArrayLike, period_s: float) -> Complex:
    """Return the response of a zero-order hold of `period_s` s (its fundamental, no images)."""
    f = np.asarray(frequency_hz, float)
    turn: Complex = np.exp(-1j * np.pi * f * period_s)
    return turn * np.sinc(f * period_s)
