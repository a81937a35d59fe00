"""
Valve flexure: the coil and the flexure pipe that it bends (paper, section 2.2).

A first-order lag (coil and drive), a resonance (flexure), and the first of the two delays. Null by
default: a dead band of the drive, two further lags, an offset of the deflection, and a stop.
"""

import math
from typing import NamedTuple

from asi_actuator.model.delay import DelaySteps, delay, delay_steps
from asi_actuator.model.linear_lag import (
    FirstOrder,
    SecondOrder,
    first_order_or_none,
    second_order,
    second_order_step,
)
from asi_common.jit import FULL, LINEAR, jit


class FlexureStep(NamedTuple):
    """What is the same in every sub-step."""

    lag: FirstOrder
    second_lag: FirstOrder
    coil_decay: float
    pipe: SecondOrder
    delay: DelaySteps


@jit
def flexure_step(p, h):
    """Return what is the same in every sub-step of `h` s."""
    return FlexureStep(
        first_order_or_none(p.valve_flexure_lag_time, h),
        first_order_or_none(p.valve_flexure_second_lag_time, h),
        math.exp(-2.0 * math.pi * p.valve_flexure_coil_frequency * h),
        second_order(p.valve_flexure_natural_frequency, p.valve_flexure_damping_ratio, h),
        delay_steps(p.valve_flexure_delay, h))


@jit
def flexure_gain(p):
    """Return the gain (N/N) of the flexure when it has no dynamics."""
    return p.valve_flexure_linear_gain if p.valve_flexure_model == LINEAR else 1.0


@jit
def dead_zone(value, half_width):
    """Return a value less `half_width` towards zero, and 0 within it."""
    return value - min(max(value, -half_width), half_width)


@jit
def deflected(deflection, p):
    """Return the deflection (N of valve command) with the valve's offset, within its stops."""
    offset = deflection + p.valve_flexure_bias
    if p.valve_flexure_travel_limit == 0.0:
        return offset
    # What deflects to the stop, as a valve command.
    stop = (p.valve_flexure_travel_limit / p.valve_characteristic_full_opening
            * p.valve_characteristic_maximum_force / p.valve_characteristic_gain)
    return min(max(offset, -stop), stop)


@jit
def lagged(before, mean, lag):
    """
    Return the mean output of a lag over a sub-step, and that at its end.

    The drive jumps between sub-steps and moves within: its mean is what drives the lag.
    """
    after = lag.keep * before + (1.0 - lag.keep) * mean
    return 0.5 * (before + after), after


@jit
def valve_flexure(state, drive_mean, drive_after, p, steady):
    """
    Return the flexure's deflection, as the force (N) that bends it; updates coil and pipe.

    drive_mean, drive_after: drive (N), over the sub-step and at its end.
    """
    if p.valve_flexure_deadband > 0.0:
        drive_mean = dead_zone(drive_mean, p.valve_flexure_deadband)
        drive_after = dead_zone(drive_after, p.valve_flexure_deadband)
    if p.valve_flexure_lag_time > 0.0:
        drive_mean, drive_after = lagged(state.lagged_drive, drive_mean, steady.lag)
    state.lagged_drive = drive_after   # where a lag that is switched on begins
    if p.valve_flexure_second_lag_time > 0.0:
        drive_mean, drive_after = lagged(state.twice_lagged_drive, drive_mean, steady.second_lag)
    state.twice_lagged_drive = drive_after
    if p.valve_flexure_model != FULL:
        return deflected(flexure_gain(p) * drive_after, p)
    coil = drive_mean + (state.coil - drive_mean) * steady.coil_decay
    state.flexure, state.flexure_rate = second_order_step(
        state.flexure, state.flexure_rate, 0.5 * (state.coil + coil), steady.pipe)
    state.coil = coil
    return deflected(
        delay(state.flexure_ring, state.ring_index, state.flexure, steady.delay), p)
