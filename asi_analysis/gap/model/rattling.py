"""
The load of a geared joint that rattles in its gap: half width and share of the mass, roughly.

A fit finds them only from nearby: with another gap the load flies and touches at other times. But
what the load does follows from the measured motion of the motor, the gap and the pull on the load,
whatever the masses, and the force is linear in all masses and constants: so gaps are tried in turn
(backlash with two masses: Nordin and Gutman, Automatica 38, 2002). Without this a gap would hide
gravity and spring, which act on the load, not on the motor.
"""

import math
from typing import Final, NamedTuple

import numpy as np
from scipy.optimize import lsq_linear

from asi_analysis.arrays import Array
from asi_analysis.gap.model import blocks
from asi_analysis.gap.motion import Motion, judged
from asi_analysis.gap.prepare import Recording

# Gaps that are tried, half widths as a share of the range of motion; then around the best.
GAPS: Final = np.geomspace(0.003, 0.09, 14)
NEARBY: Final = (0.8, 0.9, 1.0, 1.1, 1.25)
CONTACT_S: Final = 0.004
STEP_S: Final = 1e-3
# Of the mass and the damping: what is behind the gap, before that is known; its damping per mass.
SHARE: Final = 0.6
DECAY: Final = 0.5
MOST_DECAY: Final = 5.0
# Shares of the constant load that may act on the load, and how they are refined.
WEIGHTS: Final = (0.0, 0.5, 1.0)
FINER: Final = (-0.25, 0.0, 0.25)
ROUNDS: Final = 3
SHARES: Final = (0.05, 0.95)
LIGHTEST: Final = 0.1   # share of the mass: with less it would be some other force
# Share of the force's power left by a rigid joint, below which no gap is looked for; and of that,
# what a gap may leave to be believed.
RIGID: Final = 4e-4
LEFT: Final = 0.7
CREEP: Final = 0.05   # of the usual speed: friction is full from there on


class Rattling(NamedTuple):
    """
    Half width m of a gap and what is behind it: share of the mass, kg, N of the constant load.

    Stiffness N/m of its spring, damping over mass 1/s; constant load N in all.
    """

    gap: float
    share: float = SHARE
    mass: float = 1.0
    weight: float = 0.0
    stiffness: float = 0.0
    decay: float = DECAY
    constant: float = 0.0


class _Trial(NamedTuple):
    """Powers left of fitted and held-out parts; load as fitted; share of the constant on it."""

    left: float
    held_out: float
    load: Rattling
    weighs: float

    def changed(self, factor: float, more: float) -> tuple[Rattling, float]:
        """Return the load with another gap and share of the constant load."""
        weighs = self.weighs + more
        return self.load._replace(gap=factor * self.load.gap,
                                  weight=weighs * self.load.constant), weighs


def load_motion(motion: Motion, period: float, load: Rattling) -> Array:
    """Return position and velocity (2 x n) of a load behind its gap."""
    effects = np.zeros(1, blocks.EFFECT_DTYPE)[0]
    effects['backlash'], effects['contact_time'] = load.gap, CONTACT_S
    effects['load_weight'] = load.weight / load.mass
    out = np.empty((2, motion.velocity.size))
    blocks.floating(motion.position, motion.velocity, 0.0,
                    (1.0, load.decay, load.stiffness / load.mass), np.zeros(2), effects, period,
                    max(1, math.ceil(period / STEP_S - 1e-9)), out)
    return out


class _Force:
    """The force of a recording, and what a joint with a gap makes of its motion."""

    def __init__(self, recording: Recording, late: float) -> None:
        """Late: s, by which the force acts later than it is recorded."""
        assert recording.motion is not None and recording.force_judged is not None
        self.recording, self.motion = recording, recording.motion
        motion = self.motion
        self.inner = slice(motion.pad, motion.pad + recording.fit.size)
        self.scale = float(np.quantile(np.abs(motion.position), 0.999))
        omega = 2.0 * np.pi * np.fft.rfftfreq(recording.fit.size, recording.period_s)
        self.force = np.fft.irfft(np.fft.rfft(recording.force_judged)
                                  * np.exp(-1j * omega * late), recording.fit.size)
        usual = float(motion.velocity.std()) + 1e-30
        self.own = np.array([
            self._judged(1j * motion.omega * motion.velocity_spectrum),
            judged(np.tanh(motion.velocity[self.inner] / (CREEP * usual)), motion),
            np.ones(recording.fit.size)])
        self.power = float(np.var(self.force[recording.held_out]))

    def _judged(self, spectrum: blocks.Complex) -> Array:
        return np.fft.irfft(spectrum * self.motion.judge, self.motion.velocity.size)[self.inner]

    def rigid(self) -> _Trial:
        """Return what a joint without a gap leaves."""
        return self._trial(np.array([self.motion.position, self.motion.velocity]), Rattling(0.0))

    def tried(self, load: Rattling, weighs: float) -> _Trial:
        """Return what a joint with a gap leaves."""
        return self._trial(load_motion(self.motion, self.recording.period_s, load), load, weighs)

    def _trial(self, moved: Array, load: Rattling, weighs: float = 0.0) -> _Trial:
        """Return the force fitted by masses, damping, spring, friction and constant."""
        motion = self.motion
        velocity = np.fft.rfft(moved[1])
        columns = np.vstack([
            self._judged(1j * motion.omega * velocity), self._judged(velocity),
            self._judged(np.fft.rfft(moved[0] - motion.position) + motion.position_spectrum),
            self.own])
        size = np.sqrt(np.mean(columns ** 2, axis=1)) + 1e-30
        fit = self.recording.fit
        rows, right = (columns / size[:, None])[:, fit], self.force[fit]
        # The same problem by its triangle.
        triangle = np.linalg.cholesky(rows @ rows.T + 1e-9 * fit.sum() * np.eye(size.size)).T
        low = np.where(np.isin(np.arange(size.size), (2, 5)), -np.inf, 0.0)
        values = lsq_linear(triangle, np.linalg.solve(triangle.T, rows @ right), (low, np.inf),
                            'bvls').x / size
        error = self.force - values @ columns
        behind, damping, stiffness, before, _, constant = map(float, values)
        total = behind + before + 1e-30
        share = min(max(behind / total, SHARES[0]), SHARES[1])
        mass = share * total
        left, held_out = (float(np.mean(error[part] ** 2))
                          for part in (fit, self.recording.held_out))
        return _Trial(left, held_out, Rattling(
            load.gap, share, mass, weighs * constant, stiffness, min(damping / mass, MOST_DECAY),
            constant), weighs)


def rattling_of(recording: Recording, late: float) -> Rattling | None:
    """
    Return how the load of a joint rattles in its gap; None if that explains no more than friction.

    late: s, by which the force acts later than it is recorded.
    """
    force = _Force(recording, late)
    rigid = force.rigid()
    if rigid.held_out < RIGID * force.power:
        return None
    mass = SHARE * rigid.load.mass / rigid.load.share
    loads = [(Rattling(share * force.scale, SHARE, mass, weighs * rigid.load.constant, stiffness),
              weighs)
             for share in GAPS for weighs in WEIGHTS for stiffness in (0.0, rigid.load.stiffness)]
    best = rigid
    for number in range(1 + ROUNDS):
        if number:
            loads = [best.changed(factor, more) for factor in NEARBY
                     for more in (FINER if number % 2 else (0.0,))]
        best = min((best, *(force.tried(*each) for each in loads)), key=lambda each: each.left)
    there = best.held_out < LEFT * rigid.held_out and LIGHTEST < best.load.share < SHARES[1]
    return best.load if there else None
