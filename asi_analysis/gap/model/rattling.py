"""
Initial guess of the backlash of a geared joint: its half width, and the share of the mass behind.

The cost has many local minima: with another width, contacts occur at other times. But the motion
of the load follows from the measured motion of the motor, the width and the force per mass on the
load; then the force is linear in the masses and constants. So a grid of widths is tried (backlash
with two masses: Nordin and Gutman, Automatica 38, 2002). Without this, backlash would hide gravity
and spring, which act on the load, not on the motor.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

import numpy as np
from scipy.optimize import lsq_linear

from asi_analysis.arrays import Array
from asi_analysis.bags.run import Run
from asi_analysis.gap.model import blocks
from asi_analysis.gap.model.effects import FLOATING, Free, Variant
from asi_analysis.gap.motion import Motion, judged
from asi_analysis.gap.prepare import Recording

# Half widths that are tried, as shares of the motion's size; then factors of the best.
GAPS: Final = np.geomspace(0.003, 0.09, 14)
GAP_FACTORS: Final = (0.8, 0.9, 1.0, 1.1, 1.25)
CONTACT_S: Final = 0.004
STEP_S: Final = 1e-3
# First guesses: share of the mass behind the backlash; its damping over mass, 1/s, at most ...
SHARE: Final = 0.6
DECAY: Final = 0.5
MOST_DECAY: Final = 5.0
# Shares of the constant force that act behind the backlash: first guesses and their refinement.
WEIGHTS: Final = (0.0, 0.5, 1.0)
WEIGHT_STEPS: Final = (-0.25, 0.0, 0.25)
ROUNDS: Final = 3
SHARE_BOUNDS: Final = (0.05, 0.95)
LEAST_SHARE: Final = 0.1   # of the mass behind the backlash: less is another effect
# No backlash is looked for if the residual power of a rigid joint is below this share of the
# force's; it is accepted if its residual power is below this share of that of the rigid joint.
RIGID_RESIDUAL: Final = 4e-4
MOST_RESIDUAL: Final = 0.7
CREEP: Final = 0.05   # share of the rms speed at which Coulomb friction is fully developed

# The share of its range below which a width is zero: within 13 % of the smallest one where the
# range is logarithmic, 10 % where it is linear.
CLOSED: Final = 0.019


class Rattling(NamedTuple):
    """
    Half width m of a backlash, and what is behind it.

    share: of the mass; mass: kg; weight: constant force N on it; stiffness of its spring N/m;
    decay: damping over mass 1/s. constant: the constant force on motor and load, N.
    """

    gap: float
    share: float = SHARE
    mass: float = 1.0
    weight: float = 0.0
    stiffness: float = 0.0
    decay: float = DECAY
    constant: float = 0.0


class _Trial(NamedTuple):
    """Residual power of fitted and held-out parts; the load; its share of the constant force."""

    residual: float
    held_out: float
    load: Rattling
    weighs: float

    def changed(self, factor: float, more: float) -> tuple[Rattling, float]:
        """Return the load with another backlash and share of the constant force."""
        weighs = self.weighs + more
        return self.load._replace(gap=factor * self.load.gap,
                                  weight=weighs * self.load.constant), weighs


def load_motion(motion: Motion, period: float, load: Rattling) -> Array:
    """Return position (m) and velocity (m/s) of a load behind its backlash: 2 x n."""
    effects = np.zeros(1, blocks.EFFECT_DTYPE)[0]
    effects['backlash'], effects['contact_time'] = load.gap, CONTACT_S
    effects['load_weight'] = load.weight / load.mass
    out = np.empty((2, motion.velocity.size))
    blocks.floating(motion.position, motion.velocity, 0.0,
                    (1.0, load.decay, load.stiffness / load.mass), np.zeros(2), effects, period,
                    max(1, math.ceil(period / STEP_S - 1e-9)), out)
    return out


class _Force:
    """The force of a recording, fitted by that of a joint with a backlash."""

    def __init__(self, recording: Recording, late: float) -> None:
        """Late: the delay of the force behind its record, s."""
        assert recording.force_judged is not None
        self.recording, self.motion = recording, recording.moved
        motion = self.motion
        self.scale = float(np.quantile(np.abs(motion.position), 0.999))
        omega = 2.0 * np.pi * np.fft.rfftfreq(recording.fit.size, recording.period_s)
        self.force = np.fft.irfft(np.fft.rfft(recording.force_judged)
                                  * np.exp(-1j * omega * late), recording.fit.size)
        usual = float(motion.velocity.std()) + 1e-30
        self.own = np.array([
            self._judged(1j * motion.omega * motion.velocity_spectrum),
            judged(np.tanh(motion.velocity[motion.inner] / (CREEP * usual)), motion),
            np.ones(recording.fit.size)])
        self.power = float(np.var(self.force[recording.held_out]))

    def _judged(self, spectrum: blocks.Complex) -> Array:
        motion = self.motion
        return np.fft.irfft(spectrum * motion.judge, motion.velocity.size)[motion.inner]

    def rigid(self) -> _Trial:
        """Return the fit without backlash."""
        return self._trial(np.array([self.motion.position, self.motion.velocity]), Rattling(0.0))

    def tried(self, load: Rattling, weighs: float) -> _Trial:
        """Return the fit with this backlash."""
        return self._trial(load_motion(self.motion, self.recording.period_s, load), load, weighs)

    def _trial(self, moved: Array, load: Rattling, weighs: float = 0.0) -> _Trial:
        """
        Return the fit of the force by masses, damping, spring, friction and a constant.

        moved: position (m) and velocity (m/s) of the load; weighs: its share of the constant.
        """
        motion = self.motion
        velocity = np.fft.rfft(moved[1])
        columns = np.vstack([
            self._judged(1j * motion.omega * velocity), self._judged(velocity),
            self._judged(np.fft.rfft(moved[0] - motion.position) + motion.position_spectrum),
            self.own])
        if not np.isfinite(columns).all():   # the force moves such a load out of all bounds
            return _Trial(math.inf, math.inf, load, weighs)
        size = np.sqrt(np.mean(columns ** 2, axis=1)) + 1e-30
        fit = self.recording.fit
        rows, right = (columns / size[:, None])[:, fit], self.force[fit]
        # The same problem, smaller, by Cholesky factorisation.
        triangle = np.linalg.cholesky(rows @ rows.T + 1e-9 * fit.sum() * np.eye(size.size)).T
        low = np.where(np.isin(np.arange(size.size), (2, 5)), -np.inf, 0.0)
        values = lsq_linear(triangle, np.linalg.solve(triangle.T, rows @ right), (low, np.inf),
                            'bvls').x / size
        error = self.force - values @ columns
        behind, damping, stiffness, before, _, constant = map(float, values)
        total = behind + before + 1e-30
        share = min(max(behind / total, SHARE_BOUNDS[0]), SHARE_BOUNDS[1])
        mass = share * total
        left, held_out = (float(np.mean(error[part] ** 2))
                          for part in (fit, self.recording.held_out))
        return _Trial(left, held_out, Rattling(
            load.gap, share, mass, weighs * constant, stiffness, min(damping / mass, MOST_DECAY),
            constant), weighs)


def rattling_of(recording: Recording, late: float) -> Rattling | None:
    """
    Return the backlash of a joint; None if it does not explain the force better than friction.

    late: the delay of the force behind its record, s.
    """
    force = _Force(recording, late)
    rigid = force.rigid()
    if rigid.held_out < RIGID_RESIDUAL * force.power:
        return None
    mass = SHARE * rigid.load.mass / rigid.load.share
    loads = [(Rattling(share * force.scale, SHARE, mass, weighs * rigid.load.constant, stiffness),
              weighs)
             for share in GAPS for weighs in WEIGHTS for stiffness in (0.0, rigid.load.stiffness)]
    best = rigid
    for number in range(1 + ROUNDS):
        if number:
            loads = [best.changed(factor, more) for factor in GAP_FACTORS
                     for more in (WEIGHT_STEPS if number % 2 else (0.0,))]
        best = min((best, *(force.tried(*each) for each in loads)), key=lambda each: each.residual)
    explained = best.held_out < MOST_RESIDUAL * rigid.held_out
    plausible = best.load.gap > 0.0 and LEAST_SHARE < best.load.share < SHARE_BOUNDS[1]
    return best.load if explained and plausible else None


def is_closed(variants: Iterable[Variant], free: Sequence[Free], theta: Array) -> bool:
    """
    Return whether a fitted backlash with two masses has nearly its smallest width, and so is none.

    theta: the fitted values of `free`, as shares of their ranges. What is left is a soft, damped
    contact between two masses, and another cause is meant.
    """
    floating = any(FLOATING in variant.fixed for variant in variants)
    return floating and any(each.field == 'backlash' and share < CLOSED
                            for each, share in zip(free, theta, strict=True))


def rattling_in(rattling: Rattling | None) -> list[Variant]:
    """
    Return forms of a backlash within which the load moves freely; a contact hardly rebounds.

    rattling: initial guess, or None. The joint's damping is the load's; in the second form the
    motor has damping, too.
    """
    if rattling is None:
        gap = Free('backlash', 0.001, 0.7, (0.004, 0.015, 0.05, 0.15), 'position', 'm')
        share, weight = 0.4, []
    else:
        gap = Free('backlash', 0.4 * rattling.gap, 2.5 * rattling.gap,
                   tuple(factor * rattling.gap for factor in (1.0, 0.92, 1.08)), '', 'm')
        share, most = 1.0 - rattling.share, 2.0 * (abs(rattling.constant) + abs(rattling.weight))
        weight = [Free('load_weight', -most, most, (rattling.weight,), '', 'N')]
    return [Variant((gap, Free('contact_time', 0.0005, 0.02, (CONTACT_S,), '', 's'),
                     Free('piston_share', 0.05, 0.9, (share,)), *damped, *weight), ('load',),
                    (FLOATING,))
            for damped in ((), (Free('viscous', 0.0, 1.0, (0.0,), 'damping', 'N s/m'),))]


def rattling_mechanics(rattling: Rattling, springs: bool) -> dict[str, float]:
    """Return mass, damping and, if it has a spring, stiffness of a joint with that backlash."""
    return {'load_mass': rattling.mass / rattling.share,
            'load_damping': rattling.decay * rattling.mass} | (
                {'load_stiffness': max(rattling.stiffness, 0.0)} if springs else {})


def first_rattling(recordings: Sequence[Recording], runs: Sequence[Run]) -> Rattling | None:
    """Return the initial guess of a backlash, from one recording; None without backlash."""
    for run, recording in zip(runs, recordings, strict=True):
        motion = recording.motion
        if (recording.fit.any() and recording.held_out.any() and motion is not None
                and motion.measured and recording.force_judged is not None):
            late = 0.5 * recording.period_s if run.force_n is None else 0.0
            return rattling_of(recording, late)
    return None
