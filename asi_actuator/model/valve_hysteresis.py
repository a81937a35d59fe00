"""
Valve hysteresis: the loop of the magnetic circuit that drives the valve (paper, 2.2, Fig. 5).

A play whose half width grows with the rate of the command. At rest it leaves the small remanence
that the paper's steady-state errors allow; at 100 Hz it gives the phase lag that the paper's
limit cycle needs. A play of constant width cannot do both.

As a choice, plays of spread widths round the corners of the loop, and further plays widen it with
the amplitude, without any dependence on the rate (Prandtl 1928; with evenly spread widths from 0
on it is Rayleigh's law, Phil. Mag. 23, 1887). As another choice, the flux lags behind the plays
instead of their growing with the rate: eddy currents, to first order.
"""

import math
from typing import Final, NamedTuple

from asi_actuator.model.linear_lag import FirstOrder, first_order_or_none
from asi_common.jit import FULL, LINEAR, inlined, jit

# Number of the plays of a spread loop, and of the further ones: of evenly spread widths.
FURTHER = 8


class MagnetStep(NamedTuple):
    """What is the same in every step of one length."""

    decay: float      # share of command less filtered command that is left after it
    lag: FirstOrder   # of the flux behind the plays


# No time passes: only the command jumps.
AT_ONCE: Final = MagnetStep(1.0, FirstOrder(1.0, 0.0, 0.0))


@jit
def magnet_step(p, h):
    """Return what is the same in every step of `h` s."""
    return MagnetStep(
        math.exp(-2.0 * math.pi * p.valve_hysteresis_rate_filter * h),
        first_order_or_none(p.valve_hysteresis_lagged * p.valve_hysteresis_lag_time, h))


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
    time = (1.0 - p.valve_hysteresis_lagged) * p.valve_hysteresis_lag_time
    return p.valve_hysteresis_radius + time * speed * growth


@jit
def play(drive, command, radius):
    """Return the output (N) of a play of half width `radius` (N) that was at `drive` (N)."""
    return min(max(drive, command - radius), command + radius)


@jit
def rounded(flux, plays, command, filtered, p):
    """
    Return the flux (N) of a loop whose corners are rounded, of a single play at `flux` (N).

    A share of it moves in plays of half widths from 0 to twice that of the single one, so that
    their mean, and the slope of large motion, are the same. Updates `plays`, N; command: valve
    command, N; filtered: state of the rate filter, N.
    """
    if p.valve_hysteresis_rounding == 0.0 or p.valve_hysteresis_model != FULL:
        return flux
    grown = half_width(command_rate(command, filtered, p), p) - p.valve_hysteresis_radius
    total = 0.0
    for k in range(FURTHER):
        width = (2.0 * k + 1.0) / FURTHER * p.valve_hysteresis_radius
        plays[k] = play(plays[k], command, width + grown)
        total += plays[k]
    return flux + p.valve_hysteresis_rounding * (total / FURTHER - flux)


@jit
def widened(flux, plays, command, filtered, p):
    """
    Return the flux (N) of all plays, the first of which is at `flux` (N); updates the others.

    plays: the further ones, N; command: valve command, N; filtered: state of the rate filter, N.
    None of them moves before the command has swung by its width, so that the slope for small
    motion stays 1, and the loop of a larger one is wider. Each has the rate's share of the first.
    """
    if p.valve_hysteresis_widening == 0.0 or p.valve_hysteresis_model != FULL:
        return flux
    grown = half_width(command_rate(command, filtered, p), p) - p.valve_hysteresis_radius
    total, step = 0.0, p.valve_hysteresis_widening_range / FURTHER
    for k in range(FURTHER):
        width = p.valve_hysteresis_widening_from + (k + 0.5) * step
        plays[k] = play(plays[k], command, width + grown)
        total += plays[k]
    return flux + p.valve_hysteresis_widening * total / FURTHER


@jit
def behind(state, flux, p, lag):
    """Return the flux (N) that lags behind that of the plays, `flux` (N); updates the lag."""
    if (p.valve_hysteresis_lagged * p.valve_hysteresis_lag_time == 0.0
            or p.valve_hysteresis_model != FULL):
        state.plays_flux = state.lagged_flux = flux   # where a lag that is switched on begins
        return flux
    state.lagged_flux = (
        lag.keep * state.lagged_flux + lag.old * state.plays_flux + lag.new * flux)
    state.plays_flux = flux
    return state.lagged_flux


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
    Return the flux (N) of the magnetic circuit, without the further plays.

    flux: its last value, N; command: valve command, N; filtered: state of the rate filter, N.
    """
    if p.valve_hysteresis_model == FULL:
        return play(flux, command, half_width(command_rate(command, filtered, p), p))
    if p.valve_hysteresis_model == LINEAR:
        return p.valve_hysteresis_linear_gain * command
    return command


@inlined
def circuit(state, command, p, lag):
    """
    Return the drive (N) at a command (N); updates the plays and the lag of the flux.

    The rate filter, state.command_filtered, is already there. lag: `MagnetStep.lag` of the time
    since the last call.
    """
    filtered = state.command_filtered
    state.flux = valve_hysteresis(state.flux, command, filtered, p)
    flux = rounded(state.flux, state.rounding_plays, command, filtered, p)
    flux = widened(flux, state.further_plays, command, filtered, p)
    return saturated(behind(state, flux, p, lag), p)


@inlined
def magnetise(state, command, p, step):
    """
    Return the drive (N) after a time at a constant command (N); updates the magnetic circuit.

    step: what `magnet_step` returns for that time, or AT_ONCE.
    """
    # The rate filter is a lag: its exact solution.
    state.command_filtered = command + (state.command_filtered - command) * step.decay
    state.drive = circuit(state, command, p, step.lag)
    return state.drive
