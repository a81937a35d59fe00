"""
The load: what the piston pushes against (paper, Fig. 2: piston, stiffness of the structure).

Locked against the structure's stiffness, a mass with spring and damper, a free mass, or a motion
prescribed from outside, so that the actuator can be driven back (Fig. 3).
"""

import math

from asi_actuator.model.friction import friction
from asi_actuator.model.hydraulic_damping import damping_curve, damping_force
from asi_actuator.model.jit import jit

LOCKED, SPRING, FREE, PRESCRIBED = 0, 1, 2, 3

# Newton's rule from the last velocity. Two rounds leave less than the rounding of the trapezoidal
# rule itself (test/test_model.py compares with many), and a fixed number costs the same each time.
NEWTON_ROUNDS = 2


@jit
def load_spring(p):
    """Return stiffness (N/m) and damping (N s/m) between the piston and the world."""
    if p.load_type == LOCKED:
        return p.load_locked_stiffness, p.load_locked_damping
    if p.load_type == SPRING:
        return p.load_stiffness, p.load_damping
    return 0.0, 0.0


@jit
def prescribed_velocity(time_s, p):
    """Return the velocity (m/s) of the prescribed motion at a time (s)."""
    if p.load_frequency == 0.0:
        return p.load_velocity
    return p.load_velocity * math.sin(2.0 * math.pi * p.load_frequency * time_s)


@jit
def load(state, static_before, static_after, opening, fluid, p, h):
    """
    Advance piston, seals and hydraulic force by a sub-step of `h` s; return the transmitted N.

    static_before, static_after: static valve force at both ends, N; opening: valve opening at the
    end, -1 to 1; fluid: coefficients of `fluid_dynamics`. What is transmitted to the load, and so
    to the force sensor, is the hydraulic force less the friction.

    The equation of motion is solved by the trapezoidal rule for the velocity at the end: the slope
    of the damping over the mass reaches 40 000 1/s, too stiff for an explicit rule.
    """
    keep, old, new = fluid
    curve = damping_curve(opening, p)
    known = keep * state.hydraulic_force + old * (static_before - state.damping_force)
    stiffness, damper = load_spring(p)
    moves = p.load_type != PRESCRIBED
    velocity = state.velocity if moves else prescribed_velocity(state.time + h, p)

    damping, slope = damping_force(velocity, curve, p)
    hydraulic = known + new * (static_after - damping)
    mean = 0.5 * (state.velocity + velocity)
    seal, friction_end, friction_mean, friction_slope = friction(state.seal, mean, p, h)
    if moves:
        for _ in range(NEWTON_ROUNDS):
            position = state.position + 0.5 * h * mean
            residual = (p.load_mass / h * (velocity - state.velocity)
                        - 0.5 * (state.hydraulic_force + hydraulic) + friction_mean
                        + stiffness * position + damper * mean - p.load_external_force)
            steepness = (p.load_mass / h + 0.5 * (new * slope + friction_slope + damper)
                         + 0.25 * stiffness * h)
            velocity -= residual / steepness
            damping, slope = damping_force(velocity, curve, p)
            hydraulic = known + new * (static_after - damping)
            mean = 0.5 * (state.velocity + velocity)
            seal, friction_end, friction_mean, friction_slope = friction(state.seal, mean, p, h)

    state.position += h * mean
    state.velocity = velocity
    state.hydraulic_force = hydraulic
    state.damping_force = damping
    state.seal = seal
    return hydraulic - friction_end
