"""The linear part of the actuator: poles, zeros and delays of what the paper identified."""

import math
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from asi_actuator.model.force_sensor import CARD_DAMPING
from asi_actuator.model.hydraulic_damping import damping_curve, damping_force
from asi_actuator.parameters import as_record
from asi_analysis.loop.bench import Values
from asi_analysis.paper.facts.conditions import LOCKED

NAMES: Final = ('coil', 'flexure', 'fluid, piston and structure', 'sensor', 'card')


class LinearModel(NamedTuple):
    """
    Valve command to measured force, locked piston, small motion about rest.

    numerator, denominator: polynomials in s (highest power first), without the delays.
    """

    numerator: npt.NDArray[np.float64]
    denominator: npt.NDArray[np.float64]
    delays_s: tuple[float, float]
    poles: dict[str, npt.NDArray[np.complex128]]     # rad/s, by block
    zeros: npt.NDArray[np.complex128]                # rad/s

    def response(self, frequency_hz: npt.ArrayLike) -> npt.NDArray[np.complex128]:
        """Return the response at frequencies (Hz), with the delays."""
        s = 2j * np.pi * np.asarray(frequency_hz, float)
        return np.polyval(self.numerator, s) / np.polyval(self.denominator, s) * np.exp(
            -s * sum(self.delays_s))


def _second_order(frequency_hz: float, damping: float) -> npt.NDArray[np.float64]:
    w = 2.0 * math.pi * frequency_hz
    return np.array([1.0 / w**2, 2.0 * damping / w, 1.0])


def linear_model(actuator: Values) -> LinearModel:
    """Return the linear model: hysteresis as a gain, seals stuck, damping by its slope at rest."""
    p = as_record({**actuator, **LOCKED})
    slope = damping_force(0.0, damping_curve(0.0, p), p)[1]
    mass, damper, stiffness = (p['load_mass'], p['load_locked_damping'],
                               p['load_locked_stiffness'])
    seals = np.array([p['friction_presliding_damping'], p['friction_presliding_stiffness']])
    structure = np.array([mass, damper, stiffness])
    stuck = structure + np.append(0.0, seals)
    fluid = np.array([1.0 / (2.0 * math.pi * p['fluid_dynamics_frequency']), 1.0])
    piston = np.polyadd(np.polymul(fluid, stuck), np.array([slope, 0.0]))
    blocks = (np.array([1.0 / (2.0 * math.pi * p['valve_flexure_coil_frequency']), 1.0]),
              _second_order(p['valve_flexure_natural_frequency'],
                            p['valve_flexure_damping_ratio']),
              piston,
              _second_order(p['force_sensor_natural_frequency'],
                            p['force_sensor_damping_ratio']),
              _second_order(p['force_sensor_card_frequency'], CARD_DAMPING))
    denominator = np.array([1.0])
    for block in blocks:
        denominator = np.polymul(denominator, block)
    felt = structure * np.array([1.0 - p['force_sensor_mass_share'], 1.0, 1.0])
    numerator = p['valve_characteristic_gain'] * felt
    return LinearModel(numerator, denominator,
                       (float(p['valve_flexure_delay']), float(p['force_sensor_delay'])),
                       {name: np.roots(block).astype(complex)
                        for name, block in zip(NAMES, blocks, strict=True)},
                       np.roots(numerator).astype(complex))


def fluid_phase_deg(actuator: Values, frequency_hz: float) -> float:
    """Return the phase lag (degrees) of the fluid dynamics at a frequency (Hz)."""
    p = as_record(actuator)
    return math.degrees(math.atan(frequency_hz / p['fluid_dynamics_frequency']))
