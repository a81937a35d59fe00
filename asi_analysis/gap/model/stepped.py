"""
The quantisation of a servo's reference: estimated before the servo's response is identified.

Its origin is arbitrary, as that of the position is. If the quantisation is not modelled, a servo
of second order looks like one of first order with noise.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Final, NamedTuple

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from asi_analysis.arrays import Array
from asi_analysis.gap.model.servo import Servo, left_of, response_of, second_order, thinned
from asi_analysis.gap.prepare import Recording

MOST_STEPS: Final = 60     # over the range of the reference
# Initial guesses: all numbers of steps over the range and all phases, at this spacing; at most so
# many samples are used; the best ones are refined, with ranges that become smaller.
SPACING: Final = 0.1
GUESS_SAMPLES: Final = 3000
CANDIDATES: Final = 5
OFFSETS: Final = np.linspace(-1.0, 1.0, 5)
RANGES: Final = (0.05, 0.025, 0.012, 0.006, 0.003)
# No steps are looked for if the residual power without them is below this share of the motion's;
# they are accepted if the residual power with them is below this share of that without.
NO_STEPS: Final = 1e-4
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
    power = max(float(np.var(r.output[r.known])) for r in fitted)

    def left(servo: Servo, steps: Steps | None, part: str = 'fit') -> float:
        return float(np.mean(left_of(servo, in_steps(recordings, steps), part) ** 2))

    if left(slow, None, 'held_out') < NO_STEPS * power:
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
    """Return candidates for the quantisation: the best of a grid, by the residual of a servo."""
    r = thinned([recording], GUESS_SAMPLES)[0]
    reference = r.input
    size, span = reference.size, float(np.ptp(reference))
    error = r.output - response_of(servo, r)
    one = np.ones(size)
    one[0] = 0.0
    jump = replace(r, command=one, valve_position=np.zeros(size))
    length = next_fast_len(2 * size, real=True)
    response = rfft(np.diff(response_of(servo, jump), append=1.0), length)
    power = {}
    for count in np.arange(1.5, MOST_STEPS, SPACING):
        tried = [Steps(span / count, phase) for phase in np.arange(0.0, 1.0, SPACING)]
        changes = np.array([steps.of(reference) - reference for steps in tried])
        moved = irfft(response * rfft(changes, length), length)[:, :size]
        left = np.var((error - moved)[:, r.fit], axis=1)
        best = int(np.argmin(left))
        power[tried[best]] = left[best]
    return sorted(power, key=lambda steps: power[steps])[:CANDIDATES]
