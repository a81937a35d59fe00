"""
The quantisation of a servo's reference: estimated before the servo's response is identified.

Its origin is arbitrary, as that of the position is. If the quantisation is not modelled, a servo
of second order looks like one of first order with noise.
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

LEVELS: Final = 2000       # bins of the reference, for the spectrum of the residual over it
PADDED: Final = 8
MOST_STEPS: Final = 60     # over the range of the reference
CANDIDATES: Final = 5      # so many of the strongest lines of that spectrum are tried
OFFSETS: Final = np.linspace(-1.0, 1.0, 5)
# Range of each refinement, as a share of the quantum; that of the phase is larger by PHASE_FACTOR.
RANGES: Final = (0.01, 0.005, 0.0025, 0.0012)
PHASE_FACTOR: Final = 6.0
RESPONSE_S: Final = 2.0
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
    return [r if steps is None or r.command is None else replace(r, command=steps.of(r.command))
            for r in recordings]


def steps_of(recordings: Sequence[Recording], servo: Servo) -> Steps | None:
    """
    Return the quantisation of a servo's reference; None if there is none.

    servo: a delay and a lag, fitted without quantisation.
    """
    fitted = [r for r in recordings if r.fit.any()]
    power = max(float(np.var(r.valve_position[r.known])) for r in fitted
                if r.valve_position is not None)

    def left(steps: Steps | None, part: str = 'fit') -> float:
        responses = [_response(servo, r) for r in in_steps(recordings, steps)]
        return float(np.mean(left_by(responses, recordings, part) ** 2))

    plain = left(None, 'held_out')
    if plain < NO_STEPS * power:
        return None
    best = min((_refined(each, RANGES[:1], left) for each in _guesses(servo, fitted[0])),
               key=left)
    best = _refined(best, RANGES[1:], left)
    accepted = left(best, 'held_out') < MOST_RESIDUAL * plain
    return best._replace(phase=best.phase % 1.0) if accepted else None


def placed_by(servo: Servo, recordings: Sequence[Recording], steps: Steps) -> Steps:
    """Return the quantisation of a reference, refined with a servo of second order."""
    best = _refined(steps, RANGES, lambda each: float(np.mean(
        left_of(servo, in_steps(recordings, each), 'fit') ** 2)))
    return best._replace(phase=best.phase % 1.0)


def _refined(steps: Steps, reaches: Sequence[float], left: Callable[[Steps], float]) -> Steps:
    """Return the quantisation near a given one with the smallest residual."""
    for reach in reaches:
        steps = min((Steps(steps.quantum * (1.0 + reach * wider),
                           steps.phase + PHASE_FACTOR * reach * later)
                     for wider in OFFSETS for later in OFFSETS), key=left)
    return steps


def _response(servo: Servo, recording: Recording) -> Array:
    """Return the response of a delay and a lag to a command, from the measured initial value."""
    command, period = recording.command, recording.period_s
    assert command is not None and recording.valve_position is not None
    time = period * np.arange(command.size)
    keep = math.exp(-0.5 * period * servo.pulsation / servo.damping)
    late = np.interp(time - servo.delay - period, time, command)
    return lfilter([1.0 - keep], [1.0, -keep], late,
                   zi=[keep * float(recording.valve_position[0])])[0]


def _guesses(servo: Servo, recording: Recording) -> list[Steps]:
    """
    Return candidates for the quantisation, from the residual of a servo.

    A quantiser leaves a sawtooth over the reference, filtered by the servo: its period is that of
    a strong line in the spectrum over the reference.
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
    # Inner product of the residual with the response to a step at each sample.
    gain = np.fft.irfft(np.conj(np.fft.rfft(response, 2 * size))
                        * np.fft.rfft(error, 2 * size))[:size]
    low, span = float(reference.min()), float(np.ptp(reference))
    level = np.minimum(((reference - low) / span * LEVELS).astype(int), LEVELS - 1)
    spectrum = np.fft.rfft(np.bincount(level, gain, LEVELS), PADDED * LEVELS)[
        :PADDED * MOST_STEPS]
    rest = np.abs(spectrum)
    rest[:3 * PADDED // 2] = 0.0
    found = []
    for _ in range(CANDIDATES):
        line = int(np.argmax(rest))
        rest[max(line - PADDED, 0):line + PADDED] = 0.0
        # q round(u / q - phase) + q phase - u is -sin(2 pi (u / q - phase)) and its harmonics.
        turns = 0.25 - np.angle(spectrum[line]) / (2.0 * np.pi)
        quantum = span * PADDED / max(line, 1)
        found.append(Steps(quantum, float(turns + low / quantum)))
    return found
