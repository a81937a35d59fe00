"""
Valve hysteresis: the magnetic circuit that drives the valve (paper, section 2.2, Fig. 5).

A play whose half width grows with the rate of the command. At rest it leaves the small remanence
that the paper's steady-state errors allow; at 100 Hz it gives the phase lag that the paper's
limit cycle needs. A play of constant width cannot do both.
"""

import math

from asi_common.jit import FULL, LINEAR, jit


@jit
def rate_decay(p, h):
    """Return the share of command less filtered command that is left after `h` s."""
    return math.exp(-2.0 * math.pi * p.valve_hysteresis_rate_filter * h)


@jit
def command_rate(command, filtered, p):
    """Return the rate (N/s) of the command (N) as the rate filter, at `filtered` (N), sees it."""
    return 2.0 * math.pi * p.valve_hysteresis_rate_filter * (command - filtered)


@jit
def half_width(rate, p):
    """Return half the width (N) of the loop at a rate (N/s) of the command."""
    speed = abs(rate)
    if speed == 0.0:
        return p.valve_hysteresis_radius
    growth = (speed / p.valve_hysteresis_reference_rate) ** p.valve_hysteresis_rate_exponent
    return p.valve_hysteresis_radius + p.valve_hysteresis_lag_time * speed * growth


@jit
def play(drive, command, radius):
    """Return the output (N) of a play of half width `radius` (N) that was at `drive` (N)."""
    return min(max(drive, command - radius), command + radius)


@jit
def saturated(flux, p):
    """
    Return the drive (N) of a magnetic circuit at a flux (N: the drive if the iron were linear).

    Linear within 0.4 % up to a third of the saturation, as a transducer's working range must be.
    """
    if p.valve_hysteresis_model != FULL:
        return flux
    relative = flux / p.valve_hysteresis_saturation
    square = relative * relative
    return flux / math.sqrt(math.sqrt(1.0 + square * square))


@jit
def valve_hysteresis(flux, command, filtered, p):
    """
    Return the flux (N) of the magnetic circuit.

    flux: its last value, N; command: valve command, N; filtered: state of the rate filter, N.
    """
    if p.valve_hysteresis_model == FULL:
        return play(flux, command, half_width(command_rate(command, filtered, p), p))
    if p.valve_hysteresis_model == LINEAR:
        return p.valve_hysteresis_linear_gain * command
    return command


@jit
def magnetise(state, command, decay, p):
    """
    Return the drive (N) after a time at a constant command (N); updates the magnetic circuit.

    decay: what `rate_decay` returns for that time; 1 for no time, so that only the command jumps.
    """
    # The rate filter is a lag: its exact solution.
    state.command_filtered = command + (state.command_filtered - command) * decay
    state.flux = valve_hysteresis(state.flux, command, state.command_filtered, p)
    state.drive = saturated(state.flux, p)
    return state.drive
