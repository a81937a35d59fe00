"""
The motion of a servo with what disturbs it: dry friction, a load on a compliance.

Without them it is a lag of second order, by which a PD controller moves a mass. Its damping may
act on the reference too: a lead. A force is given over the stiffness of the loop, as a position;
a loop with integral action takes a constant one over, in 1 / integral s.
"""

import math

from asi_actuator.model.linear_lag import second_order, second_order_step
from asi_common.jit import jit

STATES = 5   # position and rate of the drive, of the load, and the force that was taken over
POSITION, RATE, LOAD, LOAD_RATE, TAKEN = range(STATES)


@jit
def disturbed(e):
    """Return whether a servo is more than a lag of second order."""
    return e.servo_lead > 0.0 or e.servo_friction > 0.0 or e.servo_load_frequency > 0.0


@jit
def servo_lags(e, h):
    """Return the lag of the load, and what integral action leaves of a force, for steps of h s."""
    return (second_order(e.servo_load_frequency, e.servo_load_damping, h),
            math.exp(-e.servo_integral * h))


@jit
def servo_step(state, drawn, lag, lags, e):
    """
    Return the position (m) of a servo's load after a sub-step; updates its STATES.

    drawn: mean reference, m; lag: of the undisturbed servo; lags: `servo_lags`.
    """
    load, left = lags
    before = state[POSITION] + e.servo_lead * state[RATE]
    if e.servo_friction > 0.0:
        friction = rub(state, drawn + state[TAKEN], lag, e)
        state[TAKEN] = friction + (state[TAKEN] - friction) * left
    else:
        state[POSITION], state[RATE] = second_order_step(state[POSITION], state[RATE], drawn, lag)
    after = state[POSITION] + e.servo_lead * state[RATE]
    if e.servo_load_frequency == 0.0:
        return after
    state[LOAD], state[LOAD_RATE] = second_order_step(
        state[LOAD], state[LOAD_RATE], 0.5 * (before + after), load)
    return state[LOAD]


@jit
def rub(state, drawn, lag, e):
    """
    Move a servo with dry friction for a sub-step; return the friction, as a position (m).

    At rest the friction is what holds, up to breakaway (Karnopp 1985); a motion that it stops
    ends within the sub-step. drawn: the position to which the loop pulls, m.
    """
    position, rate = state[POSITION], state[RATE]
    pull = drawn - position
    rise = e.servo_breakaway
    if rate == 0.0:
        if abs(pull) <= e.servo_friction * (1.0 + rise):
            return pull
        friction = math.copysign(e.servo_friction * (1.0 + rise), pull)
    else:
        if rise > 0.0:
            rise *= math.exp(-abs(rate) / e.servo_stribeck)
        friction = math.copysign(e.servo_friction * (1.0 + rise), rate)
    state[POSITION], state[RATE] = second_order_step(position, rate, drawn - friction, lag)
    if rate * state[RATE] < 0.0:
        share = rate / (rate - state[RATE])
        state[POSITION], state[RATE] = position + share * lag.half_step * rate, 0.0
    return friction
