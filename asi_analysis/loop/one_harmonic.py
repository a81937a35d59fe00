"""
The paper's method: one harmonic, the hysteresis alone, everything else linear (section 4.1).

A cycle of the command of amplitude A at frequency f is predicted where K L(f) N(A, f) = -1: static
characteristic a gain, damping and friction left out. The limit of the command is kept with the
hysteresis, since without it nothing bounds the amplitude. It is stable by Loeb's criterion (Gelb
and Vander Velde 1968, section 3.5).
"""

from collections.abc import Callable
from functools import partial
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq

from asi_analysis.loop import describing_functions as describing
from asi_analysis.loop import linear_blocks as linear
from asi_analysis.loop.harmonic_balance import Loop
from asi_controller.compensator import frequency_response

Array = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]

FREQUENCIES_HZ: Final = np.geomspace(5.0, 600.0, 60)
# Amplitudes of the piston at which damping and friction are tried.
VELOCITIES_M_S: Final = np.geomspace(1e-4, 2.0, 12)


class Locus(NamedTuple):
    """Predicted cycles: amplitude of the command (N), gain, frequency, amplitude of force (N)."""

    command_n: Array
    gain: Array
    frequency_hz: Array
    amplitude_n: Array
    stable: npt.NDArray[np.bool_]


def plant_without_damping(frequency_hz: npt.ArrayLike, loop: Loop) -> Complex:
    """Return command to measured force, sampled and held; hysteresis, damping, friction out."""
    p = loop.plant
    return (linear.hold(frequency_hz, loop.period_s) * linear.flexure(frequency_hz, p)
            * p['valve_characteristic_gain'] * linear.fluid(frequency_hz, p)
            * linear.felt(frequency_hz, p) * linear.sensor(frequency_hz, p))


def per_gain(frequency_hz: npt.ArrayLike, loop: Loop) -> Complex:
    """Return L: the loop without its gain, its sign and its hysteresis."""
    return (plant_without_damping(frequency_hz, loop)
            * frequency_response(loop.compensator, frequency_hz, 1.0 / loop.period_s)
            / loop.compensator['gain'])


def _least_gain(needed: Callable[[float], complex]) -> tuple[float, float] | None:
    """Return (gain, frequency) of the least gain above 0 that is real where it is needed."""
    values = np.array([needed(f) for f in FREQUENCIES_HZ])
    best = None
    turned = np.flatnonzero((values.imag[:-1] < 0.0) != (values.imag[1:] < 0.0))
    for k in turned:
        if values[k].real < 0.0 and values[k + 1].real < 0.0:
            continue
        f = brentq(lambda f: needed(f).imag, FREQUENCIES_HZ[k], FREQUENCIES_HZ[k + 1],
                   xtol=1e-4)
        gain = needed(f).real
        if gain > 0.0 and (best is None or gain < best[0]):
            best = (gain, f)
    return best


def _in_series(loop: Loop, passed: Callable[[float], complex]) -> Callable[[float], complex]:
    """Return the gain that a cycle needs with a nonlinearity between command and force."""
    return lambda f: complex(-1.0 / (per_gain([f], loop)[0] * (passed(f) or 1e-12)))


def _on_the_piston(loop: Loop, opposed: Callable[[float], complex], friction: bool
                   ) -> Callable[[float], complex]:
    """Return the gain that a cycle needs with a nonlinear force (N s/m) against the velocity."""
    def needed(f: float) -> complex:
        at = [f]
        direct = 1.0 if friction else linear.fluid(at, loop.plant)[0]
        held = opposed(f) * direct / linear.impedance(at, loop.plant)[0]
        return complex(-(1.0 + held) / per_gain(at, loop)[0])
    return needed


def _passed(loop: Loop, amplitude_n: float, frequency_hz: float) -> complex:
    limit = min(float(loop.plant['command_limit']), float(loop.compensator['saturation']))
    return describing.hysteresis(amplitude_n, frequency_hz, 0.0, loop.plant, limit)


def hysteresis_alone(loop: Loop, amplitudes_n: Array) -> Locus:
    """Return the predicted cycles; amplitudes of the command without any are left out."""
    rows, stable = [], []
    for amplitude in amplitudes_n:
        found = _least_gain(_in_series(loop, partial(_passed, loop, amplitude)))
        if found is not None:
            gain, f = found
            compensated = abs(frequency_response(loop.compensator, [f], 1.0 / loop.period_s)[0])
            # The command is the compensated force.
            rows.append((amplitude, gain, f,
                         amplitude / compensated * loop.compensator['gain'] / gain))
            stable.append(_loeb(loop, gain, amplitude, f))
    command, gains, frequencies, forces = np.array(rows).reshape(-1, 4).T
    return Locus(command, gains, frequencies, forces, np.array(stable, bool))


def _loeb(loop: Loop, gain: float, amplitude_n: float, frequency_hz: float) -> bool:
    """Return whether a cycle is stable: more amplitude moves the roots into the left half."""
    def response(amplitude: float, f: float) -> complex:
        return complex(gain * per_gain([f], loop)[0] * _passed(loop, amplitude, f))

    with_amplitude = (response(1.02 * amplitude_n, frequency_hz)
                      - response(0.98 * amplitude_n, frequency_hz))
    with_frequency = (response(amplitude_n, 1.01 * frequency_hz)
                      - response(amplitude_n, 0.99 * frequency_hz))
    return (with_amplitude * with_frequency.conjugate()).imag < 0.0


def linear_limit(loop: Loop) -> tuple[float, float] | None:
    """Return (gain, frequency) at which the loop is unstable with no nonlinearity at all."""
    return _least_gain(_in_series(loop, _always(1.0)))


def _always(value: complex) -> Callable[[float], complex]:
    return lambda _: value


def _rubbed(velocity_m_s: float, p: np.void, frequency_hz: float) -> complex:
    return describing.seal_friction(velocity_m_s, frequency_hz, p)


def each_alone(loop: Loop) -> dict[str, tuple[float, float] | None]:
    """
    Return (gain, frequency) of the first cycle that each nonlinearity makes alone.

    Others linear, damping and friction left out. A saturation passes less the larger the sine,
    so it makes none below the linear limit; damping and friction make one only if, at some
    amplitude, they turn the force far enough.
    """
    p = loop.plant
    limit = min(float(p['command_limit']), float(loop.compensator['saturation']))
    slope = describing.characteristic(1e-3 * p['valve_characteristic_full_opening'], 0.0, p).real
    openings = p['valve_characteristic_full_opening'] * np.geomspace(0.01, 4.0, 12)
    candidates = {
        'valve_hysteresis': [_in_series(loop, partial(_passed, loop, a))
                             for a in np.geomspace(60.0, 1.6e4, 36)],
        'valve_characteristic': [_in_series(
            loop, _always(describing.characteristic(a, 0.0, p) / slope)) for a in openings],
        'hydraulic_damping': [_on_the_piston(
            loop, _always(describing.damping(v, 0.0, p)), False) for v in VELOCITIES_M_S],
        'friction': [_on_the_piston(
            loop, partial(_rubbed, v, p), True) for v in VELOCITIES_M_S],
        'command_limit': [_in_series(
            loop, _always(describing.saturation_closed_form(a, limit)))
            for a in limit * np.geomspace(1.0, 8.0, 8)]}
    first = {name: [found for found in map(_least_gain, rows) if found]
             for name, rows in candidates.items()}
    return {name: min(found) if found else None for name, found in first.items()}


def seen_by_damping(frequency_hz: npt.ArrayLike, loop: Loop, friction: bool) -> Complex:
    """
    Return W of Fig. 8: a cycle by damping (or friction) alone needs -1/D(A) = W.

    From the force against the piston to its velocity, the loop closed around, hysteresis a gain.
    """
    f = np.asarray(frequency_hz, float)
    direct = 1.0 if friction else linear.fluid(f, loop.plant)
    return direct / (linear.impedance(f, loop.plant)
                     * (1.0 + loop.compensator['gain'] * per_gain(f, loop)))
