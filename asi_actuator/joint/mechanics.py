"""
The equation of motion of the joint: inertia, spring, damper, friction, and what pushes it.

By the trapezoidal rule for the velocity at the end of a sub-step, as the actuator's load, with
its friction and its coupling of two masses. Forces that depend on the position are taken at the
middle of the sub-step.
"""

import math
from typing import Final

from asi_actuator.joint.drive import pushed
from asi_actuator.joint.position_forces import position_force
from asi_actuator.model.backlash import contact, spring_and_damper
from asi_actuator.model.friction import friction, settle
from asi_actuator.model.load import LEAST_STEEPNESS, MOST_ROUNDS, bracketed, external_force
from asi_common.jit import inlined

# A Newton step that is so small, as a share of the velocity or in m/s or rad/s, is the last.
LAST_STEP: Final = 1e-10


@inlined
def mechanics(state, push, apart, p, h):
    """Advance the joint by a sub-step of `h` s; apart: motor and load are two masses."""
    velocity = state.velocity + state.velocity_change
    wave = p.load_external_force_frequency > 0.0
    outside = external_force(state.time + 0.5 * h if wave else state.time, p)
    mass, stiffness, damper, origin = p.load_mass, p.load_stiffness, p.load_damping, 0.0
    if apart:
        middle = state.load_position + 0.5 * h * state.load_velocity
        load_push = outside - position_force(middle, p) + stiffness * p.load_rest
        touch = contact(state, state.velocity + 0.5 * state.velocity_change, load_push,
                        stiffness, damper, p, h)
        mass, stiffness, damper = p.coupling_piston_share * mass, 0.0, touch.damping
        outside = -touch.force
    else:
        middle = state.position + 0.5 * h * (state.velocity + 0.25 * state.velocity_change)
        stiffness, damper, origin = spring_and_damper(
            state.position - p.load_rest, stiffness, damper, p)
        origin += p.load_rest
        outside -= position_force(middle, p)
    begin = (outside - stiffness * (state.position - origin) - 0.5 * state.friction_force)
    low, high = -math.inf, math.inf
    change = 0.0
    for _ in range(MOST_ROUNDS):
        velocity += change
        mean = 0.5 * (state.velocity + velocity)
        rub = friction(state.seals, mean, velocity, p, h)
        force, force_slope = pushed(push, mean)
        residual = (mass / h * (velocity - state.velocity) - begin - force + 0.5 * rub.force
                    + (damper + 0.5 * h * stiffness) * mean)
        steepness = (mass / h + 0.25 * h * stiffness
                     + 0.5 * (rub.slope + damper + force_slope))
        steepness = max(steepness, LEAST_STEEPNESS * mass / h)
        change = -residual / steepness
        if abs(change) <= LAST_STEP * (1.0 + abs(velocity)):
            break
        change, low, high = bracketed(velocity, change, residual, low, high)
    if p.servo_rate_limit > 0.0 and p.servo_kp > 0.0:
        velocity = min(max(velocity, -p.servo_rate_limit), p.servo_rate_limit)
    mean = 0.5 * (state.velocity + velocity)
    if apart:
        load_mean = (touch.push + touch.force + touch.damping * mean) / touch.inertia
        state.load_position += h * load_mean
        state.load_velocity = 2.0 * load_mean - state.load_velocity
    state.push = force
    state.position += h * mean
    state.velocity_change = velocity - state.velocity
    state.velocity = velocity
    settle(state.seals, 0.0, p)
    state.friction_force = rub.force
