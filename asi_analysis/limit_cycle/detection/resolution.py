"""
What a recording resolves: the step of its values, and the rate at which they were measured.

Rounding a pure sine, or holding its samples in a log of a higher rate, makes harmonics that are no
evidence of a nonlinear loop.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from asi_analysis.arrays import Array
from asi_analysis.measures.sinusoids.sinusoid import HarmonicFit

# Largest distance of a level from the lattice, in steps.
OFF_LATTICE: Final = 0.05
# Differences that are rounding errors of the numbers, as a share of the range.
ROUNDING: Final = 1e-9
# A knot of a slower sampling: its difference over the median one; the share of the squares of all
# differences that the knots have; least number of knots in a cycle (a square wave has 2 jumps, a
# relay with a dead zone 4).
KNOT: Final = 10.0
IN_KNOTS: Final = 0.95
FEWEST_KNOTS: Final = 5.0
# Highest harmonic that counts: those of a loop fall with the order, while images of a slower
# sampling are the highest.
LOW_HARMONICS: Final = 5
# By how much size and level of a rounded sine may be off, in steps.
UNSURE: Final = np.linspace(-0.4, 0.4, 5)


def quantisation(values: Array) -> float:
    """Return the step of the lattice on which all values lie; 0 if there is none."""
    levels = np.unique(values)
    span = float(np.ptp(levels)) if len(levels) else 0.0
    least = max(ROUNDING * span,
                8.0 * np.finfo(float).eps * float(np.abs(levels).max(initial=0.0)))
    apart = np.diff(levels)
    if not (apart > least).any():
        return 0.0
    smallest = float(apart[apart > least].min())
    for divisor in (1, 2, 3):
        number = (levels - levels[0]) / smallest * divisor
        number *= np.round(number[-1]) / number[-1]
        if np.abs(number - np.round(number)).max() < OFF_LATTICE:
            return span / float(np.round(number[-1]))
    return 0.0


def exceeds_rounding(found: HarmonicFit, time_s: Array, values: Array) -> bool:
    """Return whether a low harmonic is larger than rounding of the fundamental makes it."""
    step = quantisation(values)
    order = np.arange(2, min(len(found.harmonics), LOW_HARMONICS) + 1)
    sizes = np.abs(found.harmonics[order - 1])
    least = max(4.0 * found.noise * np.sqrt(2.0 / len(values)), ROUNDING * found.amplitude)
    if step:
        turn = np.exp(2j * np.pi * found.frequency_hz * (time_s - found.origin_s))
        wave = (found.harmonics[0] * turn).real
        drift = found._replace(harmonics=found.harmonics[:1]).at(time_s) - wave - values[0]
        # The level and the size are known to a fraction of the step only.
        rounded = [np.abs(_rounding(scale * wave + drift + shift, step) @ turn[:, None] ** -order)
                   for scale in 1.0 + UNSURE * step / found.amplitude for shift in UNSURE * step]
        least = np.maximum(least, 4.0 / len(values) * np.max(rounded, axis=0))
    return bool(found.thd > 0.0 and (sizes > least).any())


def _rounding(values: Array, step: float) -> Array:
    return np.round(values / step) * step - values


def one_of_each(time_s: Array, values: Array, frequency_hz: float) -> tuple[Array, Array]:
    """Return one sample of each that was measured, if they are held or joined by lines."""
    for order in (1, 2):
        changes = np.abs(np.diff(values, order))
        knots = np.flatnonzero(changes > max(KNOT * float(np.median(changes)),
                                             ROUNDING * float(np.ptp(values))))
        gap = _even_gap(knots)
        if gap < 2.0 or np.sum(changes[knots] ** 2) < IN_KNOTS * np.sum(changes ** 2):
            continue
        if gap * FEWEST_KNOTS * frequency_hz * np.median(np.diff(time_s)) > 1.0:
            continue
        # In the middle of a held value, or at the knot of a line.
        first = knots[0] + 1.0 + (0.5 * gap if order == 1 else 0.0)
        kept = np.arange(first % gap, len(values) - 0.5, gap).round().astype(int)
        return time_s[kept], values[kept]
    return time_s, values


def _even_gap(knots: Array | NDArray[np.intp]) -> float:
    """Return the distance (samples) of even knots, of which some are missing; 0 if uneven."""
    if len(knots) < 9:
        return 0.0
    gaps: Array = np.diff(knots).astype(float)
    gap = float(np.median(gaps))
    for _ in range(3):
        number = np.maximum(np.round(gaps / gap), 1.0)
        gap = float(gaps.sum() / number.sum())
    return gap if np.mean(np.abs(gaps - number * gap) <= 1.0) > IN_KNOTS else 0.0
