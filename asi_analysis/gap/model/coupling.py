"""
An initial guess of a load behind a spring, from the frequency response of the whole motion.

Of a motor and a load (inertias J1, J2) with a spring between them, the force on the motor and its
velocity obey (1 + d s + s2/w2) F = (c1 + c2 s + c3 s2 + J1/w2 s3) v, where w is the frequency at
which the load swings while the motor stands. That is linear in its coefficients; the error of the
equation is weighted by the response found before (Sanathanan and Koerner, IEEE Trans. Autom.
Control 8, 1963). A fit that begins with a rigid load ends there: its mass is far too small.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from asi_analysis.arrays import Array, Complex
from asi_analysis.gap.motion import extended
from asi_analysis.gap.prepare import Recording

ROUNDS: Final = 6
LEAST_DAMPING: Final = 0.01   # damping ratio of the weight
MOST_SHARE: Final = 0.8       # of the mass before the spring: else it is one mass


class Coupling(NamedTuple):
    """The whole mass (kg), its friction (N s/m) and the spring (m/N); if it turns, rad, N m."""

    mass: float
    damping: float
    compliance: float
    damping_time: float   # s, of the spring
    share: float    # of the mass, before the spring


def guessed_coupling(recordings: Sequence[Recording]) -> Coupling | None:
    """Return the load behind a spring that explains force and motion; None if there is none."""
    weights = [np.ones_like(r.moved.velocity_spectrum) for r in recordings]
    found = np.zeros(7)
    for _ in range(ROUNDS):
        rows = [_terms(*each) for each in zip(recordings, weights, strict=True)
                if each[0].fit.any()]
        matrix = np.concatenate(rows)
        size = np.sqrt(np.mean(matrix ** 2, axis=0)) + 1e-300
        found = np.linalg.lstsq(matrix[:, 1:] / size[1:], matrix[:, 0], rcond=None)[0] / size[1:]
        slow, square = found[:2]
        if square <= 0.0:
            return None
        slow = max(slow, 2.0 * LEAST_DAMPING * np.sqrt(square))
        weights = [1.0 + slow * (s := 1j * r.moved.omega) + square * s ** 2 for r in recordings]
    slow, square, damping, second, _, fourth, _ = map(float, found)
    mass, before = second - damping * slow, fourth / square
    if not 0.0 < before < MOST_SHARE * mass:
        return None
    return Coupling(mass, max(damping, 0.0), square / (mass - before), max(slow, 0.0),
                    before / mass)


def _terms(recording: Recording, weight: Complex) -> Array:
    """Return the terms of the equation on the fitted samples: of F, then of each coefficient."""
    motion, force = recording.moved, recording.force
    assert force is not None
    s, speed = 1j * motion.omega, motion.velocity_spectrum
    pushed = motion.smooth * np.fft.rfft(extended(force - force.mean(), motion.pad))
    terms = (pushed, -s * pushed, -s ** 2 * pushed, *(s ** n * speed for n in range(4)))
    columns = [np.fft.irfft(motion.judge / weight * term, motion.velocity.size)[motion.inner]
               for term in terms]
    return np.column_stack([*columns, np.ones(recording.fit.size)])[recording.fit]
