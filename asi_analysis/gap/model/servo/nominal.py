"""Which servo is the nominal one of recordings, and whether its reference is quantised."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.signal import correlate

from asi_analysis.arrays import Array
from asi_analysis.gap.model.effects import Free, Variant
from asi_analysis.gap.model.group import MODEL_ERROR
from asi_analysis.gap.model.servo.identification import (
    LONGEST_DELAY,
    Servo,
    error_of,
    second_order,
    servo_of,
    servos_beside_an_effect,
    slow_servo,
    thinned,
)
from asi_analysis.gap.model.servo.stepped import Steps, in_steps, placed_by, steps_of
from asi_analysis.gap.prepare import Recording

SERVO_ERROR = 0.03     # model error of a drive without dynamics, as a share of its signal,
SERVO_RESIDUAL = 2.0   # or this multiple of the residual of a delay and a lag, if that is less


def can_be_identified(recordings: Sequence[Recording]) -> bool:
    """Return whether recordings have samples to fit to, and to choose by."""
    return any(r.fit.any() for r in recordings) and any(r.held_out.any() for r in recordings)


def identified_servo(recordings: Sequence[Recording], hidden: bool
                     ) -> tuple[list[Servo], Steps | None, float]:
    """
    Return the servos that may fit recordings, the reference's quantisation and a model error.

    That of a drive without dynamics (rms, as a share of the motion): small if the residual of a
    delay and a lag, which are effects then, is hardly more than noise.
    """
    decimated = thinned(recordings)
    slow = slow_servo(decimated)
    steps = steps_of(decimated, slow)
    stepped = in_steps(decimated, steps)
    if steps:   # estimated with a lag of first order: refined with a servo of second order
        steps = placed_by(second_order(stepped), decimated, steps)
        stepped = in_steps(decimated, steps)
        slow = slow_servo(stepped)
    moved = float(np.std(np.concatenate([r.output for r in decimated])))
    error = min(SERVO_ERROR, max(MODEL_ERROR, SERVO_RESIDUAL * error_of(slow, stepped) / moved))
    return (servos_beside_an_effect(slow, stepped) if hidden else servo_of(stepped, slow), steps,
            error)


def stepping(steps: Steps) -> Variant:
    """Return quantisation as an effect, with initial guesses of quantum and phase."""
    # The phase is periodic: one turn is added to keep it positive.
    return Variant((Free('command_quantum', 0.998 * steps.quantum, 1.002 * steps.quantum,
                         (steps.quantum,), '', 'N'),
                    Free('command_phase', 0.95 + steps.phase, 1.05 + steps.phase,
                         (1.0 + steps.phase,), '', 'turns')), ('valve',))


def near(free: Free, servos: Sequence[Servo]) -> Free:
    """Return a free delay or lag with further initial guesses: those identified with a servo."""
    own = {'command_delay': 'delay', 'valve_lag': 'lag', 'valve_lag_split': 'split'}.get(
        free.field)
    guess = [getattr(each, own) for each in servos] if own else []
    return free._replace(starts=(*filter(None, guess), *free.starts))


def late_by(recordings: Sequence[Recording]) -> float:
    """Return by how many whole samples (in s) an output follows its held command with a delay."""
    # Without a delay the output answers the command of the sample before.
    return max(r.period_s for r in recordings) * int(np.argmax(_explained(recordings)[1:]))


def in_rows(recordings: Sequence[Recording]) -> list[Recording]:
    """
    Return recordings of a drive whose output answers the command of the sample before.

    A log may have a command in the row of its answer: a convention, not a delay.
    """
    earlier = [replace(r, command=np.append(r.input[1:], r.input[-1])) for r in recordings]
    same_row = np.argmax(_explained(recordings)) == 0 and all(np.ptp(r.input) for r in earlier)
    return earlier if same_row else list(recordings)


def _explained(recordings: Sequence[Recording]) -> Array:
    """
    Return what a command explains of the power of its output, by the samples between the two.

    By correlation, for each delay: the noise of a command makes a local minimum of a fit between
    two samples, since their mean has less of it.
    """
    fitted = [r for r in recordings if r.fit.any()]
    period = max(r.period_s for r in recordings)
    most = max(min(math.ceil(LONGEST_DELAY / period), min(r.fit.size for r in fitted) // 4), 2)
    shared, power = np.zeros((2, most))
    for r in fitted:
        command, used = r.input - r.input.mean(), r.fit.astype(float)
        output = (r.output - r.output[r.fit].mean()) * used
        start = command.size - 1
        shared += correlate(output, command)[start:start + most]
        # About the mean of the same samples: else another delay may seem to explain more.
        power += (correlate(used, command ** 2) - correlate(used, command) ** 2 / used.sum())[
            start:start + most]
    return np.maximum(shared, 0.0) ** 2 / np.maximum(power, 1e-300)
