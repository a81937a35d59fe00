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
def _play(command, start, half, out):
    out[:start] = command[start] - half
    position = command[start] - half
    for k in range(start, command.size):
        position = play_step(position, command[k], half)
        out[k] = position


@jit
def _stick(command, start, band, jump, out):
    stem = Stem(command[start] - 0.5 * (band - jump), 1.0, command[start], False)
    out[:start + 1] = stem.position
    for k in range(start + 1, command.size):
        stem = stick_step(stem, command[k], command[k - 1], band, jump)
        out[k] = stem.position


def _start(command: Array, first: int) -> int:
    """Return the first sample of an operator: at a peak, where the valve has just moved up."""
    return int(np.argmax(command[:first]))


def play(command: Array, half: float, first: int) -> Array:
    """Return the output of a play of half width `half`, in units of the command."""
    out = np.empty_like(command)
    _play(np.ascontiguousarray(command), _start(command, first), half, out)
    return out


def stick(command: Array, band: float, jump: float, first: int) -> Array:
    """
    Return the position of a valve with stiction, in units of the command.

    band: stick band S; jump: slip jump J (Choudhury, Thornhill, Shah, Control Engineering Practice
    13, 2005; after Kano et al., DYCOPS 2004). It starts at the largest command within the `first`
    samples.
    """
    out = np.empty_like(command)
    _stick(np.ascontiguousarray(command), _start(command, first), band, jump, out)
    return out


def hysteresis(command: Array, width: float, first: int) -> Array:
    """Return the mean of plays of half widths up to `width` (Prandtl 1928): a smooth loop."""
    widths = width * (np.arange(6) + 0.5) / 6.0
    return np.mean([play(command, each, first) for each in widths], axis=0)


def clip(command: Array, half: float) -> Array:
    """Return the command limited to ± `half`, in its units, about its mid-range."""
    middle = 0.5 * (command.max() + command.min())
    return np.clip(command, middle - half, middle + half)
