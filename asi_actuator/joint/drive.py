"""
The drive: from the command to the force on the joint.

    asked = gain * command + bias,  late by two lags
    force = asked,  or of a servo  kp (asked - position) - kv velocity + ki integral

A dead band is before the gain. While the drive gets warm, the force falls by a share; limits of
the force and of its rate are at the end. The rate of the force is limited from sub-step to
sub-step.
"""

import math
from typing import NamedTuple

from asi_actuator.model.linear_lag import FirstOrder, first_order_or_none
from asi_actuator.model.valve_flexure import dead_zone
from asi_common.jit import inlined, jit


class DriveStep(NamedTuple):
    """What is the same in every sub-step: two lags, the largest force, its largest change."""

    lag: FirstOrder
    second_lag: FirstOrder
    force_limit: float
    change_limit: float


class Push(NamedTuple):
    """A drive over a sub-step: its force = base - slope * mean velocity, between low and high."""

    base: float
    slope: float
    low: float
    high: float


@jit
def drive_step(p, h):
    """Return what is the same in every sub-step of `h` s."""
    limit = p.drive_force_limit if p.drive_force_limit > 0.0 else math.inf
    if p.servo_acceleration_limit > 0.0 and p.servo_kp > 0.0:
        limit = min(limit, p.servo_acceleration_limit * p.load_mass)
    change = p.drive_force_rate_limit * h if p.drive_force_rate_limit > 0.0 else math.inf
    return DriveStep(first_order_or_none(p.drive_lag_time, h),
                     first_order_or_none(p.drive_second_lag_time, h), limit, change)


@jit
def wanted(command, p):
    """Return what a command asks for at rest: a force or, of a servo, a position."""
    if p.drive_deadband > 0.0:
        command = dead_zone(command, p.drive_deadband)
    return p.drive_gain * command + p.drive_bias


@jit
def warmth(time, p):
    """Return the share of its force that the drive still has after so many seconds."""
    if p.drive_warm_loss == 0.0:
        return 1.0
    return 1.0 + p.drive_warm_loss * math.expm1(-time / p.drive_warm_time)


@inlined
def drive(state, command, p, steady, h):
    """Return the drive over a sub-step of `h` s at a constant command; lags move on."""
    now = wanted(command, p)
    # Held over the sub-step, so the input of the first lag is the same before and after.
    first_before, before = state.drive_first, state.drive_asked
    state.drive_first = steady.lag.keep * first_before + (
        steady.lag.old + steady.lag.new) * now
    state.drive_asked = (steady.second_lag.keep * before + steady.second_lag.old * first_before
                         + steady.second_lag.new * state.drive_first)
    asked = 0.5 * (before + state.drive_asked)
    if p.drive_lag_time == 0.0 and p.drive_second_lag_time == 0.0:
        asked = now
    limit = steady.force_limit
    low, high = -limit, limit
    if steady.change_limit < math.inf:
        low = max(low, state.push - steady.change_limit)
        high = min(high, state.push + steady.change_limit)
    share = warmth(state.time, p)
    if p.servo_kp == 0.0:
        return Push(share * asked, 0.0, low, high)
    state.integral += p.servo_ki * h * (asked - state.position)
    if limit < math.inf:   # anti-windup: the integral alone never exceeds the limit
        state.integral = min(max(state.integral, -limit), limit)
    return Push(share * (p.servo_kp * (asked - state.position) + state.integral),
                share * (p.servo_kv + 0.5 * h * p.servo_kp), low, high)


@inlined
def pushed(push, mean_velocity):
    """Return the force (N or Nm) of the drive and its slope at a mean velocity."""
    free = push.base - push.slope * mean_velocity
    force = min(max(free, push.low), push.high)
    return force, push.slope if force == free else 0.0
