"""
The quantisation of a servo's reference: estimated before the servo's response is identified.

Its origin is arbitrary, as that of the position is. If the quantisation is not modelled, a servo
of second order looks like one of first order with noise.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Final, NamedTuple

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from asi_analysis.arrays import Array
from asi_analysis.gap.model.servo.identification import (
    ALMOST,
    Servo,
    follow,
    left_of,
    response_of,
    second_order,
    thinned,
)
from asi_analysis.gap.prepare import Recording

# Over the range of the reference: as many are looked for, whatever its speed, and at most.
FEWEST_STEPS: Final = 60
MOST_STEPS: Final = 400
# Initial guesses: all numbers of steps over the range, at this spacing; at most so many samples
# are used; the best ones are refined, with ranges that become smaller.
SPACING: Final = 0.2
GUESS_SAMPLES: Final = 3000
CANDIDATES: Final = 10
OFFSETS: Final = np.linspace(-1.0, 1.0, 5)
RANGES: Final = (0.05, 0.025, 0.012, 0.006, 0.003)
# Steps are accepted if the residual power with them is below this share of that without.
MOST_RESIDUAL: Final = 0.6


class Steps(NamedTuple):
    """A quantum (unit of the reference) and its phase: 0 to 1; at 0 there is a level at 0."""

    quantum: float
    phase: float

    def of(self, reference: Array) -> Array:
        """Return a quantised reference."""
        return self.quantum * (np.floor(reference / self.quantum + 0.5 - self.phase) + self.phase)


def in_steps(recordings: Sequence[Recording], steps: Steps | None) -> list[Recording]:
    """Return recordings with a quantised command."""
    return [replace(r, command=steps.of(r.input)) for r in recordings] if steps else [*recordings]


def steps_of(recordings: Sequence[Recording], slow: Servo) -> Steps | None:
    """
    Return the quantisation of a servo's reference; None if there is none.

    slow: a delay and a lag, fitted without quantisation.
    """
    fitted = [r for r in recordings if r.fit.any()]
    noise = max(r.noise['valve_position'] for r in fitted)

    def left(servo: Servo, steps: Steps | None, part: str = 'fit') -> float:
        return float(np.mean(left_of(servo, in_steps(recordings, steps), part) ** 2))

    if left(slow, None, 'held_out') < (ALMOST * noise) ** 2:
        return None
    reference = _reference(recordings)
    found = []
    for servo in (slow, second_order(recordings)):   # steps may mislead the fit of either
        near = partial(left, servo)
        best = min((_refined(each, reference, RANGES[:1], near)
                    for each in _guesses(servo, fitted[0])), key=near)
        found.append((servo, _refined(best, reference, RANGES[1:], near)))
    servo, best = min(found, key=lambda each: left(*each))
    accepted = left(servo, best, 'held_out') < MOST_RESIDUAL * min(
        left(each, None, 'held_out') for each, _ in found)
    return best._replace(phase=best.phase % 1.0) if accepted else None


def placed_by(servo: Servo, recordings: Sequence[Recording], steps: Steps) -> Steps:
    """Return the quantisation of a reference, refined with a servo of second order."""
    best = _refined(steps, _reference(recordings), RANGES, lambda each: float(np.mean(
        left_of(servo, in_steps(recordings, each), 'fit') ** 2)))
    return best._replace(phase=best.phase % 1.0)


def _reference(recordings: Sequence[Recording]) -> Array:
    """Return the references of all recordings, one after the other."""
    return np.concatenate([r.input for r in recordings])


def _refined(steps: Steps, reference: Array, reaches: Sequence[float],
             left: Callable[[Steps], float]) -> Steps:
    """Return the quantisation near a given one with the smallest residual."""
    for reach in reaches:
        steps = min((_moved(steps, reference, reach * wider, reach * later)
                     for wider in OFFSETS for later in OFFSETS), key=left)
    return steps


def _moved(steps: Steps, reference: Array, more: float, later: float) -> Steps:
    """Return steps with `more` of them over a reference, and moved by a share in its middle."""
    low, high = float(reference.min()), float(reference.max())
    middle, span = 0.5 * (low + high), high - low
    quantum = span / (span / steps.quantum + more)
    return Steps(quantum, steps.phase + middle / quantum - middle / steps.quantum + later)


def _guesses(servo: Servo, recording: Recording) -> list[Steps]:
    """
    Return candidates for the quantisation: the best of a grid, by the residual of a servo.

    Rounding to steps of q adds -q/pi sin(2 pi (r/q - phase)) to a reference r, and harmonics of
    it. What the servo makes of that wave is fitted to the residual, for each q.
    """
    r = thinned([recording], GUESS_SAMPLES)[0]
    reference = r.input
    size, span = reference.size, float(np.ptp(reference))
    error = (r.output - response_of(servo, r))[r.fit]
    error -= error.mean()
    one = np.ones(size)
    one[0] = 0.0
    length = next_fast_len(2 * size, real=True)
    response = rfft(np.diff(follow(servo, one, 0.0, r.period_s), append=1.0), length)
    # The rounding of a reference that moves more than a step in a sample is mere noise.
    most = span / max(float(np.median(np.abs(np.diff(recording.input)))), span / MOST_STEPS)
    explained = {}
    for count in np.arange(1.5, max(most, FEWEST_STEPS), SPACING):
        angle = 2.0 * math.pi * count / span * reference
        waves = irfft(response * rfft([np.sin(angle), np.cos(angle)], length), length)[:, :size]
        waves = waves[:, r.fit]
        waves -= waves.mean(axis=1, keepdims=True)
        power, shared = waves @ waves.T, waves @ error
        sine, cosine = np.linalg.solve(power + 1e-12 * np.trace(power) * np.eye(2), shared)
        steps = Steps(span / count, math.atan2(cosine, -sine) / (2.0 * math.pi))
        explained[steps] = sine * shared[0] + cosine * shared[1]
    return sorted(explained, key=lambda steps: -explained[steps])[:CANDIDATES]
