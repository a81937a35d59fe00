"""
The steps in which a servo takes its reference: found before its response is identified.

Their origin may be anywhere, since that of the position may; and behind unknown steps a servo of
second order looks like one of first order and noise.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from scipy.signal import lfilter

from asi_analysis.arrays import Array
from asi_analysis.gap.model.servo import Servo, left_by, left_of
from asi_analysis.gap.prepare import Recording

LEVELS: Final = 2000       # of the reference, in the spectrum of what is left over it
PADDED: Final = 8
MOST_STEPS: Final = 60     # over the range of the reference
TRIED: Final = 5           # strongest spatial frequencies
NEARBY: Final = np.linspace(-1.0, 1.0, 5)
# Reach of each refinement, as a share of the quantum; the phase is uncertain by more.
FINER: Final = (0.01, 0.005, 0.0025, 0.0012)
PHASE: Final = 6.0
RESPONSE_S: Final = 2.0
# Share of the power of the motion, below which no steps are looked for; and of what is left
# without them, below which they are there.
FOLLOWED: Final = 1e-4
LEFT: Final = 0.6


class Steps(NamedTuple):
    """A quantum (unit of the reference), and where its steps are: 0 to 1, 0 has a level at 0."""

    quantum: float
    phase: float

    def of(self, reference: Array) -> Array:
        """Return a reference in steps."""
        return self.quantum * (np.floor(reference / self.quantum + 0.5 - self.phase) + self.phase)


def in_steps(recordings: Sequence[Recording], steps: Steps | None) -> list[Recording]:
    """Return recordings whose command comes in steps."""
    return [r if steps is None or r.command is None else replace(r, command=steps.of(r.command))
            for r in recordings]


def steps_of(recordings: Sequence[Recording], servo: Servo) -> Steps | None:
    """
    Return the steps in which a servo takes its reference; None if it shows none.

    servo: a delay and a lag, as it is without them.
    """
    fitted = [r for r in recordings if r.fit.any()]
    power = max(float(np.var(r.valve_position[r.known])) for r in fitted
                if r.valve_position is not None)

    def left(steps: Steps | None, part: str = 'fit') -> float:
        responses = [_response(servo, r) for r in in_steps(recordings, steps)]
        return float(np.mean(left_by(responses, recordings, part) ** 2))

    plain = left(None, 'held_out')
    if plain < FOLLOWED * power:
        return None
    best = min((_placed(each, FINER[:1], left) for each in _strongest(servo, fitted[0])),
               key=left)
    best = _placed(best, FINER[1:], left)
    return best._replace(phase=best.phase % 1.0) if left(best, 'held_out') < LEFT * plain else None


def placed_by(servo: Servo, recordings: Sequence[Recording], steps: Steps) -> Steps:
    """Return the steps of a reference, placed again by a servo of second order."""
    best = _placed(steps, FINER, lambda each: float(np.mean(
        left_of(servo, in_steps(recordings, each), 'fit') ** 2)))
    return best._replace(phase=best.phase % 1.0)


def _placed(steps: Steps, reaches: Sequence[float], left: Callable[[Steps], float]) -> Steps:
    """Return the steps near by that leave least."""
    for reach in reaches:
        steps = min((Steps(steps.quantum * (1.0 + reach * wider),
                           steps.phase + PHASE * reach * later)
                     for wider in NEARBY for later in NEARBY), key=left)
    return steps


def _response(servo: Servo, recording: Recording) -> Array:
    """Return what a delay and a lag make of a command; from where the motion begins."""
    command, period = recording.command, recording.period_s
    assert command is not None and recording.valve_position is not None
    time = period * np.arange(command.size)
    keep = math.exp(-0.5 * period * servo.pulsation / servo.damping)
    late = np.interp(time - servo.delay - period, time, command)
    return lfilter([1.0 - keep], [1.0, -keep], late,
                   zi=[keep * float(recording.valve_position[0])])[0]


def _strongest(servo: Servo, recording: Recording) -> list[Steps]:
    """
    Return the steps that would explain most of what a servo leaves.

    That is a sawtooth over the reference, behind the response of the servo: the strongest of its
    spatial frequencies.
    """
    reference, period = recording.command, recording.period_s
    assert reference is not None and recording.valve_position is not None
    size = reference.size
    error = recording.valve_position - _response(servo, recording)
    error = (error - error[recording.fit].mean()) * recording.fit
    one = np.ones(min(size, int(RESPONSE_S / period)))
    one[0] = 0.0
    response = np.diff(_response(servo, replace(recording, command=one, valve_position=0.0 * one)),
                       append=1.0)
    # Its product with what a step at each sample would change.
    gain = np.fft.irfft(np.conj(np.fft.rfft(response, 2 * size))
                        * np.fft.rfft(error, 2 * size))[:size]
    low, span = float(reference.min()), float(np.ptp(reference))
    level = np.minimum(((reference - low) / span * LEVELS).astype(int), LEVELS - 1)
    spectrum = np.fft.rfft(np.bincount(level, gain, LEVELS), PADDED * LEVELS)[
        :PADDED * MOST_STEPS]
    rest = np.abs(spectrum)
    rest[:3 * PADDED // 2] = 0.0
    found = []
    for _ in range(TRIED):
        line = int(np.argmax(rest))
        rest[max(line - PADDED, 0):line + PADDED] = 0.0
        # q round(u / q - phase) + q phase - u is -sin(2 pi (u / q - phase)) and its harmonics.
        turns = 0.25 - np.angle(spectrum[line]) / (2.0 * np.pi)
        quantum = span * PADDED / max(line, 1)
        found.append(Steps(quantum, float(turns + low / quantum)))
    return found
