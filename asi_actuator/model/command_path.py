"""
Command path: what happens to the valve command before it drives the coil.

A limit of the drive (a current-limited amplifier), steps of a converter, and a transport delay.
The command is held over a control period, so its delay is exact: in each sub-step the mean of the
command that was sent `delay` earlier. The delay of a busy bus or network is uneven: in each period
it is drawn from a range.
"""

import math
from typing import NamedTuple

from asi_actuator.model.chance import LATE, uniform
from asi_actuator.parameters import RING
from asi_common.jit import jit

NEAREST, EDGE, ZERO = 0, 1, 2


class CommandDelay(NamedTuple):
    """A delay of the held command: whole control periods, and the rest in sub-steps."""

    periods: int
    substeps: float


@jit
def command_delay(delay, period, h):
    """
    Return a delay (s) of the command for control periods of `period` s in sub-steps of `h` s.

    At most RING - 2 control periods, so that the ring holds it.
    """
    if delay == 0.0:
        return CommandDelay(0, 0.0)
    periods = min(int(delay / period), RING - 2)
    rest = min((delay - periods * period) / h, period / h)
    return CommandDelay(periods, rest)


@jit
def delay_now(state, p, steady):
    """Return the delay of the command in this control period; drawn for it if it is uneven."""
    if p.command_path_delay_spread == 0.0:
        return steady.command
    share = 2.0 * uniform(int(p.force_sensor_noise_seed), state.sample, LATE) - 1.0
    delay = p.command_path_delay + share * min(p.command_path_delay_spread, p.command_path_delay)
    return command_delay(delay, steady.substeps * steady.h, steady.h)


@jit
def quantised(command, p):
    """Return a command (N) in steps of the quantum."""
    quantum = p.command_path_quantum
    if p.command_path_rounding == ZERO:
        return quantum * int(command / quantum)
    middle = 0.5 if p.command_path_rounding == EDGE else 0.0
    return quantum * (math.floor(command / quantum + 0.5 - middle) + middle)


@jit
def sent(state, command, p):
    """Return the command (N) of this control period as the drive sends it; the ring keeps it."""
    limited = min(max(command, -p.command_limit), p.command_limit)
    if p.command_path_quantum > 0.0:
        limited = quantised(limited, p)
    if p.command_path_delay > 0.0:
        state.command_ring[state.sample & (RING - 1)] = limited
    return limited


@jit
def arrived(state, number, delay):
    """Return the mean command (N) over sub-step `number` of this control period, delayed."""
    # The command before the first one is zero: the ring starts so.
    newer = state.command_ring[(state.sample - delay.periods) & (RING - 1)]
    older = state.command_ring[(state.sample - delay.periods - 1) & (RING - 1)]
    share = min(max(delay.substeps - number, 0.0), 1.0)
    return newer + share * (older - newer)
