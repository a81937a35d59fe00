"""
The linear plant: transfer functions in s of the blocks, with exact delays, and of the whole.

Not by python-control's TransferFunction, which has no delays, takes 0.3 s to import, and 0.17 ms
for a product instead of 0.01 ms; harmonic balance needs thousands of them. The tests compare with
it.
"""

import math
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from asi_actuator.model.fluid_dynamics import fluid_gain
from asi_actuator.model.force_sensor import CARD_DAMPING
from asi_actuator.model.hydraulic_damping import damping_curve, damping_force
from asi_actuator.model.load import load_spring
from asi_actuator.model.valve_flexure import flexure_gain
from asi_actuator.parameters import as_record
from asi_analysis.experiments.step_tests import LOCKED
from asi_analysis.loop.closed_loop import Values
from asi_common.jit import FULL, LINEAR, jit

Array = npt.NDArray[np.floating]
Complex = npt.NDArray[np.complex128]

ONE: Final = np.array([1.0])


class Transfer(NamedTuple):
    """A transfer function: polynomials in s, highest power first, and a delay (s)."""

    numerator: Array
    denominator: Array
    delay_s: float = 0.0

    def __call__(self, frequency_hz: npt.ArrayLike) -> Complex:
        """Return the response at frequencies (Hz), the delay exact."""
        s = 2j * np.pi * np.asarray(frequency_hz, float)
        return (np.polyval(self.numerator, s) / np.polyval(self.denominator, s)
                * np.exp(-s * self.delay_s))

    def then(self, other: 'Transfer') -> 'Transfer':
        """Return both in series."""
        numerator: Array = np.polymul(self.numerator, other.numerator)
        denominator: Array = np.polymul(self.denominator, other.denominator)
        return Transfer(numerator, denominator, self.delay_s + other.delay_s)


def _first_order(frequency_hz: float) -> Transfer:
    return Transfer(ONE, np.array([1.0 / (2.0 * math.pi * frequency_hz), 1.0]))


def _second_order(frequency_hz: float, damping: float, gain: float = 1.0, delay_s: float = 0.0
                  ) -> Transfer:
    w = 2.0 * math.pi * frequency_hz
    return Transfer(gain * ONE, np.array([1.0 / w**2, 2.0 * damping / w, 1.0]), float(delay_s))


def _gain(gain: float) -> Transfer:
    return Transfer(gain * ONE, ONE)


def _further_lags(p: np.void, block: str) -> Transfer:
    """Return the two further lags of a block, which are none by default."""
    lag, second = (Transfer(ONE, np.array([p[f'{block}_{name}'], 1.0]))
                   for name in ('lag_time', 'second_lag_time'))
    return lag.then(second)


def coil(p: np.void) -> Transfer:
    """Return drive (N) to force on the flexure (N)."""
    lags = _further_lags(p, 'valve_flexure')
    if p['valve_flexure_model'] != FULL:
        return lags.then(_gain(flexure_gain(p)))
    return lags.then(_first_order(p['valve_flexure_coil_frequency']))


def pipe(p: np.void) -> Transfer:
    """Return force on the flexure (N) to its deflection (N of valve command)."""
    if p['valve_flexure_model'] != FULL:
        return _gain(1.0)
    return _second_order(p['valve_flexure_natural_frequency'], p['valve_flexure_damping_ratio'],
                         delay_s=p['valve_flexure_delay'])


def flexure(p: np.void) -> Transfer:
    """Return drive (N) to deflection (N of valve command)."""
    return coil(p).then(pipe(p))


def fluid(p: np.void) -> Transfer:
    """Return static force less damping force (N) to hydraulic force (N)."""
    if p['fluid_dynamics_model'] != FULL:
        return _gain(fluid_gain(p))
    return _first_order(p['fluid_dynamics_frequency'])


def sensor(p: np.void) -> Transfer:
    """Return force on the sensor (N) to its output (N), with gain and delay."""
    if p['force_sensor_model'] != FULL:
        own = p['force_sensor_linear_gain'] if p['force_sensor_model'] == LINEAR else 1.0
        return _gain(own * p['force_sensor_gain'])
    return _second_order(p['force_sensor_natural_frequency'], p['force_sensor_damping_ratio'],
                         p['force_sensor_gain'], p['force_sensor_delay'])


def card(p: np.void) -> Transfer:
    """Return output of the sensor (N) to measured force (N)."""
    lags = _further_lags(p, 'force_sensor')
    if p['force_sensor_model'] != FULL:
        return lags
    return _second_order(p['force_sensor_card_frequency'], CARD_DAMPING).then(lags)


def structure(p: np.void) -> Transfer:
    """Return position (m) of the load to the force on it (N)."""
    stiffness, damper = load_spring(p)
    return Transfer(np.array([p['load_mass'], damper, stiffness]), ONE)


def impedance(frequency_hz: npt.ArrayLike, p: np.void) -> Complex:
    """Return velocity (m/s) of the load to the force on it (N), at frequencies above 0."""
    return structure(p)(frequency_hz) / (2j * np.pi * np.asarray(frequency_hz, float))


def inertia(frequency_hz: npt.ArrayLike, p: np.void) -> Complex:
    """Return velocity (m/s) to the inertial force (N) of the mass between piston and sensor."""
    return (2j * np.pi * np.asarray(frequency_hz, float) * p['force_sensor_mass_share']
            * p['load_mass'])


def piston(p: np.void, damping: float = 0.0, seals_stuck: bool = False) -> Transfer:
    """
    Return static valve force (N) to force on the sensor (N): fluid, piston, seals, structure.

    damping: slope of the hydraulic damping (N s/m); seals_stuck: the seals act with their
    pre-sliding stiffness and damping, otherwise they slide without either.
    """
    load, oil = structure(p).numerator, fluid(p)
    held = load + seals_stuck * np.array(
        [0.0, p['friction_presliding_damping'], p['friction_presliding_stiffness']])
    felt = load - np.array([p['force_sensor_mass_share'] * p['load_mass'], 0.0, 0.0])
    return Transfer(np.polymul(oil.numerator, felt), np.polyadd(
        np.polymul(oil.denominator, held), damping * np.append(oil.numerator, 0.0)))


def damping_slope(p: np.void, opening: float = 0.0) -> float:
    """Return the slope of the hydraulic damping at rest (N s/m) at a valve opening, -1 to 1."""
    return float(damping_force(0.0, damping_curve(opening, p), p)[1])


class Series(NamedTuple):
    """
    Blocks in series, as arrays for compiled code.

    numerators, denominators: m blocks x the coefficients of polynomials in s, highest power first
    after zeros; delay_s: of all blocks; hold_s: of a zero-order hold, 0 for none.
    """

    numerators: npt.NDArray[np.float64]
    denominators: npt.NDArray[np.float64]
    delay_s: float
    hold_s: float

    def __call__(self, frequency_hz: npt.ArrayLike) -> Complex:
        """Return the response at frequencies (Hz), delay and hold exact."""
        f = np.asarray(frequency_hz, float)
        response: Complex = _respond(f.ravel(), *self).reshape(f.shape)
        return response


@jit
def _respond(frequencies, numerators, denominators, delay, hold):
    out = np.empty(frequencies.size, np.complex128)
    for k in range(frequencies.size):
        s = 2j * math.pi * frequencies[k]
        turn = math.pi * frequencies[k] * hold
        # Half the hold is a delay; the rest of its fundamental has no phase.
        response = np.exp(-s * (delay + 0.5 * hold)) * (math.sin(turn) / turn if turn else 1.0)
        for block in range(len(numerators)):
            above = below = 0.0j
            for power in range(numerators.shape[1]):
                above = above * s + numerators[block, power]
                below = below * s + denominators[block, power]
            response *= above / below
        out[k] = response
    return out


def plant(p: np.void, period_s: float = 0.0, damping: float = 0.0, seals_stuck: bool = False
          ) -> Series:
    """
    Return valve command to measured force, without hysteresis and limits.

    period_s: of a zero-order hold on the command, 0 for continuous time; damping, seals_stuck: as
    for `piston`. Blocks are evaluated separately, because their product, of order 10, would lose
    digits.
    """
    blocks = (_gain(p['valve_characteristic_gain']), flexure(p), piston(p, damping, seals_stuck),
              sensor(p), card(p))
    above, below = ([block.numerator for block in blocks], [block.denominator for block in blocks])
    order = max(map(len, above + below))
    numerators, denominators = (
        np.array([np.pad(each, (order - len(each), 0)) for each in polynomials])
        for polynomials in (above, below))
    return Series(numerators, denominators, sum(block.delay_s for block in blocks), period_s)


class LinearModel(NamedTuple):
    """
    Valve command to measured force, locked piston, small motion about rest, seals stuck.

    numerator, denominator: polynomials in s (highest power first), without the delays.
    """

    numerator: Array
    denominator: Array
    delays_s: tuple[float, float]
    poles: dict[str, Complex]     # rad/s, by block
    zeros: Complex                # rad/s

    def response(self, frequency_hz: npt.ArrayLike) -> Complex:
        """Return the response at frequencies (Hz), with the delays."""
        return Transfer(self.numerator, self.denominator, sum(self.delays_s))(frequency_hz)


def linear_model(actuator: Values) -> LinearModel:
    """Return the linear model: hysteresis as a gain, seals stuck, damping by its slope at rest."""
    p = as_record({**actuator, **LOCKED})
    blocks = {'coil': coil(p), 'flexure': pipe(p),
              'fluid, piston and structure': piston(p, damping_slope(p), seals_stuck=True),
              'sensor': sensor(p), 'card': card(p)}
    whole = _gain(p['valve_characteristic_gain'])
    for block in blocks.values():
        whole = whole.then(block)
    return LinearModel(whole.numerator, whole.denominator,
                       (blocks['flexure'].delay_s, blocks['sensor'].delay_s),
                       {name: np.roots(block.denominator).astype(complex)
                        for name, block in blocks.items()},
                       np.roots(whole.numerator).astype(complex))


def fluid_phase_deg(actuator: Values, frequency_hz: float) -> float:
    """Return the phase lag (degrees) of the fluid dynamics at a frequency (Hz)."""
    return -float(np.angle(fluid(as_record(actuator))(frequency_hz), deg=True))
