"""Valve nonlinearities as operators on a command: play, stiction, hysteresis, saturation."""

from typing import NamedTuple

import numpy as np

from asi_actuator.model.valve_hysteresis import play as play_step
from asi_analysis.arrays import Array
from asi_common.jit import jit


class Stem(NamedTuple):
    """State of a valve with stiction; direction: of its last move, 1 or -1."""

    position: float
    direction: float
    stopped_at: float    # command when it stopped
    stuck: bool


@jit
def stick_step(stem, command, before, band, jump):
    """Return the state of a valve with stiction after a command from `before` to `command`."""
    position, direction, stopped_at, stuck = stem
    if not stuck and direction * (command - before) <= 0.0:
        stuck, stopped_at = True, before
    if stuck:
        push = direction * (command - stopped_at)
        if push < -band:
            direction, stuck = -direction, False
        elif push > jump:
            stuck = False
    if not stuck:
        position = command - direction * (0.5 * (band - jump))
    return Stem(position, direction, stopped_at, stuck)


@jit
def play(command, half, first):
    """
    Return the output of a play of half width `half`, in units of the command.

    It starts at the largest command within the `first` samples, where the valve has just moved up.
    """
    start, out = np.argmax(command[:first]), np.empty_like(command)
    position = command[start] - half
    out[:start] = position
    for k in range(start, command.size):
        position = play_step(position, command[k], half)
        out[k] = position
    return out


@jit
def stick(command, band, jump, first):
    """
    Return the position of a valve with stiction, in units of the command; it starts as `play`.

    band: stick band S; jump: slip jump J (Choudhury, Thornhill, Shah, Control Engineering Practice
    13, 2005; after Kano et al., DYCOPS 2004).
    """
    start, out = np.argmax(command[:first]), np.empty_like(command)
    stem = Stem(command[start] - 0.5 * (band - jump), 1.0, command[start], False)
    out[:start + 1] = stem.position
    for k in range(start + 1, command.size):
        stem = stick_step(stem, command[k], command[k - 1], band, jump)
        out[k] = stem.position
    return out


def hysteresis(command: Array, width: float, first: int) -> Array:
    """Return the mean of plays of half widths up to `width` (Prandtl 1928): a smooth loop."""
    widths = width * (np.arange(6) + 0.5) / 6.0
    return np.mean([play(command, each, first) for each in widths], axis=0)


def clip(command: Array, half: float) -> Array:
    """Return the command limited to ± `half`, in its units, about its mid-range."""
    middle = 0.5 * (command.max() + command.min())
    return np.clip(command, middle - half, middle + half)
