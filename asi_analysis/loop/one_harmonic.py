"""
Describing-function prediction of the paper: one nonlinearity, all else linear (section 4.1).

A cycle with a command of amplitude A at frequency f is predicted where K L(f) N(A, f) = -1, with
the static characteristic as a gain and without damping and friction. Its stability follows from
Loeb's criterion (Gelb and Vander Velde 1968, section 3.5).
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numpy.polynomial import Polynomial
from scipy.optimize import brentq, minimize_scalar

from asi_analysis.arrays import Array, Complex
from asi_analysis.loop import describing_functions as describing
from asi_analysis.loop import linear_model as linear
from asi_analysis.loop.harmonic_balance import Loop

# Gain for a cycle as a function of frequency (Hz); it exists where this is real and positive.
NeededGain = Callable[[float], complex]

FREQUENCIES_HZ: Final = np.geomspace(5.0, 600.0, 60)
# Factor by which the bracket about a known frequency grows, and the number of attempts.
BRACKET: Final = 1.02
BRACKETS: Final = 20
# Amplitudes at which the gain about the least one is computed.
SMOOTHED: Final = 9
COMMANDS_N: Final = np.geomspace(60.0, 1.6e4, 36)
# Velocity amplitudes of the piston for damping and friction.
VELOCITIES_M_S: Final = np.geomspace(1e-4, 2.0, 12)


@dataclass(frozen=True)
class OneHarmonic:
    """
    A loop and the options of its one-harmonic prediction.

    held: with a zero-order hold in series, as in the simulation; False: continuous time, as in the
    paper. limited: the command limit clips the sine before the hysteresis. samples: a period, of
    the describing function.
    """

    loop: Loop
    held: bool
    limited: bool = True
    samples: int = describing.SAMPLES

    @cached_property
    def plant(self) -> linear.Series:
        """Valve command to measured force, without the hysteresis."""
        return linear.plant(self.loop.plant, self.loop.period_s if self.held else 0.0)

    def per_gain(self, frequency_hz: npt.ArrayLike) -> Complex:
        """Return L: the loop without gain, sign and hysteresis."""
        return (self.plant(frequency_hz) * self.loop.compensated(frequency_hz)
                / self.loop.compensator['gain'])

    @property
    def limit_n(self) -> float:
        """Limit of the command (N), infinite without one."""
        return self.loop.limit_n if self.limited else math.inf

    def hysteresis(self, amplitude_n: float, frequency_hz: float) -> complex:
        """Return N of the hysteresis for a command of an amplitude."""
        return describing.hysteresis(amplitude_n, frequency_hz, self.loop.plant, self.limit_n,
                                     self.samples)


class Intersection(NamedTuple):
    """A predicted cycle: amplitudes of command and force (N), gain, frequency (Hz)."""

    command_n: float
    gain: float
    frequency_hz: float
    amplitude_n: float


def _crossings(needed: NeededGain, near_hz: float | None) -> list[tuple[float, float]]:
    """Return brackets (Hz) of the frequencies at which the gain is real and positive."""
    tried: Iterable[Array] = [FREQUENCIES_HZ]
    if near_hz is not None:
        tried = [near_hz * np.array([BRACKET ** -k, BRACKET ** k]) for k in range(1, BRACKETS)]
    found: list[tuple[float, float]] = []
    for frequencies in tried:
        values = np.array([needed(f) for f in frequencies])
        turned = np.flatnonzero((values.imag[:-1] < 0.0) != (values.imag[1:] < 0.0))
        found = [(frequencies[k], frequencies[k + 1]) for k in turned
                 if values[k].real >= 0.0 or values[k + 1].real >= 0.0]
        if found:
            break
    return found


def least_gain(needed: NeededGain, near_hz: float | None = None) -> tuple[float, float] | None:
    """
    Return (gain, frequency) of the cycle with the least positive gain; None if there is none.

    near_hz: search only about this frequency, which is faster.
    """
    best = None
    needed_once = cache(needed)   # brentq evaluates the ends of the bracket again
    for low, high in _crossings(needed_once, near_hz):
        f = float(brentq(lambda f: needed_once(f).imag, low, high, xtol=1e-4))
        gain = needed_once(f).real
        if gain > 0.0 and (best is None or gain < best[0]):
            best = (gain, f)
    return best


def in_series(of: OneHarmonic, describing_function: NeededGain) -> NeededGain:
    """Return the gain for a cycle with a nonlinearity between command and force."""
    return lambda f: complex(-1.0 / (of.per_gain([f])[0] * (describing_function(f) or 1e-12)))


def _on_the_piston(of: OneHarmonic, resistance: NeededGain, friction: bool) -> NeededGain:
    """Return the gain for a cycle with a nonlinear resistance (N s/m) to the velocity."""
    p = of.loop.plant

    def needed(f: float) -> complex:
        direct = 1.0 if friction else complex(linear.fluid(p)(f))
        ratio = resistance(f) * direct / linear.impedance([f], p)[0]
        return complex(-(1.0 + ratio) / of.per_gain([f])[0])
    return needed


def intersection(of: OneHarmonic, amplitude_n: float, near_hz: float | None = None
                 ) -> Intersection | None:
    """Return the cycle by hysteresis alone with a command amplitude (N); None if none exists."""
    found = least_gain(in_series(of, partial(of.hysteresis, amplitude_n)), near_hz)
    if found is None:
        return None
    gain, f = found
    # The command is the compensated force.
    compensated = abs(of.loop.compensated([f])[0])
    return Intersection(float(amplitude_n), gain, f,
                        float(amplitude_n / compensated * of.loop.compensator['gain'] / gain))


def locus(of: OneHarmonic, amplitudes_n: Array = COMMANDS_N) -> list[Intersection]:
    """Return the cycles by hysteresis alone at those command amplitudes (N) that have one."""
    rows: list[Intersection] = []
    for amplitude in amplitudes_n:
        found = (intersection(of, amplitude, rows[-1].frequency_hz) if rows else None
                 ) or intersection(of, amplitude)
        if found is not None:
            rows.append(found)
    return rows


def first_intersection(of: OneHarmonic, rows: list[Intersection]) -> Intersection:
    """
    Return the cycle with the least gain, between the rows of a locus.

    Its amplitude is that of a smooth curve through the gains: the gains themselves are so flat
    there that the samples of a period would decide where the least one is.
    """
    k = int(np.argmin([row.gain for row in rows]))
    if not 0 < k < len(rows) - 1:
        return rows[k]

    def at(logarithm: float) -> Intersection:
        return intersection(of, math.exp(logarithm), rows[k].frequency_hz) or rows[k]

    low, high = math.log(rows[k - 1].command_n), math.log(rows[k + 1].command_n)
    logarithms = np.linspace(low, high, SMOOTHED)
    curve = Polynomial.fit(logarithms, [at(x).gain for x in logarithms], 4)
    return at(float(minimize_scalar(curve, method='bounded', bounds=(low, high),
                                    options={'xatol': 1e-7}).x))


def at_gain(of: OneHarmonic, rows: list[Intersection], gain: float) -> Intersection | None:
    """Return the large cycle of a locus at a gain; None where the locus does not reach it."""
    first = int(np.argmin([row.gain for row in rows]))
    above = next((k for k in range(first + 1, len(rows)) if rows[k].gain >= gain), None)
    if above is None or gain < rows[first].gain:
        return None
    near = rows[above].frequency_hz

    def at(logarithm: float) -> Intersection:
        return intersection(of, math.exp(logarithm), near) or rows[above]

    return at(float(brentq(lambda x: at(x).gain - gain, math.log(rows[above - 1].command_n),
                           math.log(rows[above].command_n), xtol=1e-5)))


def stable(of: OneHarmonic, cycle: Intersection) -> bool:
    """Return whether a cycle is stable by Loeb's criterion."""
    def response(amplitude: float, f: float) -> complex:
        return complex(cycle.gain * of.per_gain([f])[0] * of.hysteresis(amplitude, f))

    a, f = cycle.command_n, cycle.frequency_hz
    with_amplitude = response(1.02 * a, f) - response(0.98 * a, f)
    with_frequency = response(a, 1.01 * f) - response(a, 0.99 * f)
    return (with_amplitude * with_frequency.conjugate()).imag < 0.0


def linear_limit(of: OneHarmonic) -> tuple[float, float] | None:
    """Return (gain, frequency) of the stability limit without any nonlinearity."""
    return least_gain(in_series(of, _always(1.0)))


def _always(value: complex) -> NeededGain:
    return lambda _: value


def each_alone(of: OneHarmonic) -> dict[str, tuple[float, float] | None]:
    """
    Return (gain, frequency) of the first cycle by each nonlinearity alone; None if there is none.

    The others are linear, damping and friction zero. A saturation, whose gain decreases with
    amplitude, causes none below the linear stability limit; damping and friction cause one only if
    their phase shift is large enough at some amplitude.
    """
    p = of.loop.plant
    slope = describing.characteristic(1e-3 * p['valve_characteristic_full_opening'], 0.0, p)
    openings = p['valve_characteristic_full_opening'] * np.geomspace(0.01, 4.0, 12)
    candidates = {
        'valve_characteristic': [in_series(
            of, _always(describing.characteristic(a, 0.0, p) / slope)) for a in openings],
        'hydraulic_damping': [_on_the_piston(
            of, _always(describing.damping(v, 0.0, p)), False) for v in VELOCITIES_M_S],
        'friction': [_on_the_piston(
            of, partial(lambda v, f: describing.seal_friction(v, f, p), v), True)
            for v in VELOCITIES_M_S],
        'command_limit': [in_series(
            of, _always(describing.saturation_closed_form(a, of.limit_n)))
            for a in of.limit_n * np.geomspace(1.0, 8.0, 8)]}
    rows = locus(of)
    first = first_intersection(of, rows) if rows else None
    alone: dict[str, tuple[float, float] | None] = {
        'valve_hysteresis': (first.gain, first.frequency_hz) if first else None}
    for name, needed in candidates.items():
        found = [each for each in map(least_gain, needed) if each]
        alone[name] = min(found) if found else None
    return alone


def piston_response(of: OneHarmonic, frequency_hz: npt.ArrayLike, friction: bool) -> Complex:
    """
    Return W of Fig. 8: a cycle by damping (or friction) alone exists where -1/D(A) = W.

    From force on the piston to its velocity, in the closed loop, with the hysteresis as a gain.
    """
    f = np.asarray(frequency_hz, float)
    direct = 1.0 if friction else linear.fluid(of.loop.plant)(f)
    return direct / (linear.impedance(f, of.loop.plant)
                     * (1.0 + of.loop.compensator['gain'] * of.per_gain(f)))
