"""
The law of a servo of second order, with limits of speed and acceleration.

    a = clip(w^2 (r - x) - 2 d w v, ± acceleration),  v = clip(v, ± rate)

What disturbs it can be part of it: dry friction, a load on a compliance. Its damping may act on
the reference too: a lead; with integral action in the loop, a lag goes with it. A force is given
over the stiffness of the loop, as a position; integral action takes a constant one over, in
1 / integral s.
"""

import math

import numpy as np

from asi_actuator.model.linear_lag import first_order_or_none, second_order, second_order_step
from asi_common.jit import inlined, jit

# Position and rate of the drive, its output, position and rate of the load, force taken over.
STATES = 6
POSITION, RATE, OUTPUT, LOAD, LOAD_RATE, TAKEN = range(STATES)
# What a servo is beyond a lag of second order: fields of the plant's record, null at zero.
SERVO_FIELDS = (
    'servo_rate',               # m/s, limit
    'servo_acceleration',       # m/s2, limit
    'servo_limited',            # 1: it follows its reference within two limits only
    'servo_upper',              # m
    'servo_lower',              # m
    'servo_lead',               # s, of its damping, as far as it acts on the reference
    'servo_lag_share',          # of the lead: the lag of its integral action
    'servo_friction',           # m, its sliding friction over the stiffness of its loop
    'servo_breakaway',          # breakaway over sliding friction, less one
    'servo_stribeck',           # m/s
    'servo_integral',           # 1/s, the rate at which its integral action takes over a force
    'servo_load_frequency',     # Hz, of the load on its compliance; 0: the load is rigid
    'servo_load_damping',       # damping ratio of the load on its compliance
    'servo_ahead',              # m, at the start, of the drive before the load
    'servo_faster',             # m/s, the same of its rate
)
SERVO_DTYPE = np.dtype([(name, np.float64) for name in SERVO_FIELDS])


@jit
def within(reference, e):
    """Return a reference within the limits between which a servo follows it."""
    if e.servo_limited > 0.5:
        return min(max(reference, e.servo_lower), e.servo_upper)
    return reference


@jit
def disturbed(e):
    """Return whether a servo is more than a lag of second order."""
    return (e.servo_lead > 0.0 or e.servo_friction > 0.0 or e.servo_load_frequency > 0.0
            or e.servo_rate > 0.0 or e.servo_acceleration > 0.0)


@jit
def moving(position, rate, e):
    """Return the STATES of a servo whose load is at a position (m) and moves at a rate (m/s)."""
    state = np.zeros(STATES)
    state[LOAD], state[LOAD_RATE] = position, rate
    state[POSITION] = state[OUTPUT] = position + e.servo_ahead
    state[RATE] = rate + e.servo_faster
    return state


@jit
def servo_lags(e, h):
    """Return the lags of load and lead, and what integral action leaves of a force, in h s."""
    return (second_order(e.servo_load_frequency, e.servo_load_damping, h),
            first_order_or_none(e.servo_lead * e.servo_lag_share, h),
            math.exp(-e.servo_integral * h))


@inlined
def servo_step(state, drawn, lag, lags, e):
    """
    Return the position (m) of a servo's load after a sub-step; updates its STATES.

    drawn: mean reference, m; lag: of the undisturbed servo; lags: `servo_lags`.
    """
    load, output, left = lags
    led, before = state[POSITION] + e.servo_lead * state[RATE], state[OUTPUT]
    friction = drive_step(state, drawn + state[TAKEN], lag, e)
    state[TAKEN] = friction + (state[TAKEN] - friction) * left
    state[OUTPUT] = output.keep * before + output.old * led + output.new * (
        state[POSITION] + e.servo_lead * state[RATE])
    if e.servo_load_frequency == 0.0:
        return state[OUTPUT]
    state[LOAD], state[LOAD_RATE] = second_order_step(
        state[LOAD], state[LOAD_RATE], 0.5 * (before + state[OUTPUT]), load)
    return state[LOAD]


@inlined
def drive_step(state, drawn, lag, e):
    """
    Move the drive of a servo for a sub-step; return its dry friction, as a position (m).

    The acceleration is limited as that of a motor is, without the friction; a motion that friction
    stops ends within the sub-step, and may start the other way. drawn: the position to which the
    loop pulls, m.
    """
    position, rate = state[POSITION], state[RATE]
    if e.servo_friction + e.servo_acceleration + e.servo_rate == 0.0:
        state[POSITION], state[RATE] = second_order_step(position, rate, drawn, lag)
        return 0.0
    most = 2.0 * lag.half_step * e.servo_acceleration
    stiff = 2.0 * lag.pull / (1.0 + lag.keep)   # of the loop: its rise of the rate, 1/s
    friction = rub(pushed(0.0, drawn - position, most / stiff), rate, e)
    if rate == 0.0 and abs(friction) < e.servo_friction * (1.0 + e.servo_breakaway):
        return friction
    after = pushed(rate - stiff * friction,
                   second_order_step(position, rate, drawn - friction, lag)[1], most)
    if friction != 0.0 and rate * after < 0.0:   # it stops, and may start the other way
        share = rate / (rate - after)
        position += share * lag.half_step * rate
        share, rate = 1.0 - share, 0.0
        pull = drawn - position
        friction = rub(pushed(0.0, pull, most / stiff), rate, e)
        after = share * pushed(-stiff * friction, lag.pull * (pull - friction), most)
        if abs(friction) < e.servo_friction * (1.0 + e.servo_breakaway):
            after = 0.0
        position += share * lag.half_step * after - lag.half_step * after
    if e.servo_rate > 0.0:
        after = min(max(after, -e.servo_rate), e.servo_rate)
    state[POSITION], state[RATE] = position + lag.half_step * (rate + after), after
    return friction


@inlined
def pushed(rate, after, most):
    """Return the rate after a sub-step, that changes by at most `most`; 0: no limit."""
    return min(max(after, rate - most), rate + most) if most > 0.0 else after


@inlined
def rub(pull, rate, e):
    """Return the dry friction of a servo (m): at rest what holds, up to breakaway (Karnopp)."""
    if e.servo_friction == 0.0:
        return 0.0
    rise = e.servo_breakaway
    if rate == 0.0:
        most = e.servo_friction * (1.0 + rise)
        return min(max(pull, -most), most)
    if rise > 0.0:
        rise *= math.exp(-abs(rate) / e.servo_stribeck)
    return math.copysign(e.servo_friction * (1.0 + rise), rate)
