"""
The load: what the piston pushes against (paper, Fig. 2: piston, stiffness of the structure).

Locked against the structure's stiffness, a mass with spring and damper, a free mass, or a motion
prescribed from outside, so that the actuator can be driven back (Fig. 3).
"""

import math
from typing import Final

from asi_actuator.model.backlash import contact, contact_force, spring_and_damper
from asi_actuator.model.fluid_dynamics import leaking
from asi_actuator.model.friction import BEHIND_SENSOR, friction, settle
from asi_actuator.model.hydraulic_damping import damping_curve, damping_force
from asi_common.jit import FULL, inlined, jit

LOCKED, SPRING, FREE, PRESCRIBED = 0, 1, 2, 3

# A Newton step (m/s) so small that the damping is linear over it: for the default damping the
# error is below 1e-4 N (test/actuator/test_model_convergence.py compares with full convergence).
LINEAR_STEP: Final = 5e-6
# Least slope of the residual with the velocity, as a share of that of the mass alone.
LEAST_STEEPNESS: Final = 0.25
# Enough for the bisection that a Newton step falls back to.
MOST_ROUNDS: Final = 60


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
def external_force(time_s, p):
    """Return the push from outside (N) at a time (s)."""
    lasts = p.load_external_force_end == 0.0 or time_s < p.load_external_force_end - 1e-9
    if not lasts or time_s < p.load_external_force_start - 1e-9:
        return 0.0
    if p.load_external_force_frequency == 0.0:
        return p.load_external_force
    turns = p.load_external_force_frequency * time_s + p.load_external_force_phase
    return p.load_external_force * math.sin(2.0 * math.pi * turns)


@inlined
def felt_force(state, apart, p):
    """
    Return the force (N) where the sensor is: what is transmitted, less the inertia before it.

    In the paper's section 4.1 the damping acts on the rate of the sensed force: there the force is
    that of the spring which holds the mass.
    """
    net = state.hydraulic_force - state.friction_force
    transmitted = state.hydraulic_force if p.friction_location == BEHIND_SENSOR else net
    if p.force_sensor_mass_share == 0.0:
        return transmitted
    if p.load_type == PRESCRIBED:
        w = 2.0 * math.pi * p.load_frequency
        inertia = p.load_mass * p.load_velocity * w * math.cos(w * state.time)
    elif apart:
        inertia = net - contact_force(state, p)
    else:
        stiffness, damper = load_spring(p)
        stiffness, damper, origin = spring_and_damper(state.position, stiffness, damper, p)
        inertia = (net + external_force(state.time, p) - stiffness * (state.position - origin)
                   - damper * state.velocity)
    return transmitted - p.force_sensor_mass_share * inertia


@jit
def is_linear(p):
    """Return whether all forces are linear in the velocity: then one Newton step is exact."""
    return (p.friction_model != FULL and p.hydraulic_damping_model != FULL
            and p.hydraulic_damping_quadratic == 0.0)


@inlined
def bracketed(velocity, change, residual, low, high):
    """
    Return the next change of a velocity (m/s), and the bracket of the solution.

    change: the Newton step; where it leaves the bracket, bisection takes its place.
    """
    if residual > 0.0:
        high = velocity
    else:
        low = velocity
    if not low <= velocity + change <= high:
        change = 0.5 * (low + high) - velocity
    return change, low, high


@inlined
def load(state, static_before, opening, steady, p):
    """
    Advance piston, seals, hydraulic force and load by a sub-step.

    static_before: static valve force at the start, N; opening: valve opening at the end, -1 to 1;
    steady: what `prepare` returns.

    The equation of motion is solved by the trapezoidal rule for the velocity at the end: the slope
    of the damping over the mass reaches 40 000 1/s, too stiff for an explicit rule. Newton's rule
    from the velocity extrapolated, kept within the bracket that the residual's signs give.
    """
    curve = damping_curve(opening, p)
    h, fluid = steady.h, steady.fluid
    if steady.leaks:
        fluid = leaking(state.hydraulic_force, p, h)
    known = (fluid.keep * state.hydraulic_force + fluid.new * state.static_force
             + fluid.old * (static_before - state.damping_force))
    stiffness, damper = load_spring(p)
    moves = p.load_type != PRESCRIBED
    velocity = (state.velocity + state.velocity_change if moves
                else prescribed_velocity(state.time + h, p))
    wave = p.load_external_force_frequency > 0.0
    pushed = external_force(state.time + 0.5 * h if wave else state.time, p)
    mass, origin = p.load_mass, 0.0
    apart = steady.apart and moves
    if apart:
        touch = contact(state, velocity, pushed, stiffness, damper, p, h)
        mass, stiffness, damper, pushed = (
            p.coupling_piston_share * mass, 0.0, touch.damping, -touch.force)
    elif moves:
        stiffness, damper, origin = spring_and_damper(state.position, stiffness, damper, p)
    # The trapezoidal rule's half of the forces at the start, and the force of the spring there.
    begin = (pushed - stiffness * (state.position - origin)
             + 0.5 * (state.hydraulic_force - state.friction_force))
    low, high = -math.inf, math.inf
    change = 0.0
    for _ in range(MOST_ROUNDS):
        velocity += change
        damping, damping_slope = damping_force(velocity, curve, p)
        hydraulic = known - fluid.new * damping
        mean = 0.5 * (state.velocity + velocity)
        rub = friction(state.seals, mean, velocity, p, h)
        if not moves:
            break
        residual = (mass / h * (velocity - state.velocity) - begin
                    - 0.5 * (hydraulic - rub.force) + (damper + 0.5 * h * stiffness) * mean)
        steepness = (mass / h + 0.25 * h * stiffness
                     + 0.5 * (fluid.new * damping_slope + rub.slope + damper))
        # Friction that falls with the velocity may make it negative.
        steepness = max(steepness, LEAST_STEEPNESS * mass / h)
        change = -residual / steepness
        if steady.linear or abs(change) <= LINEAR_STEP:
            break
        change, low, high = bracketed(velocity, change, residual, low, high)
    velocity += change
    if apart:
        force = touch.force + 0.5 * touch.damping * (state.velocity + velocity)
        load_mean = (touch.push + force) / touch.inertia
        state.load_position += h * load_mean
        state.load_velocity = 2.0 * load_mean - state.load_velocity
    state.position += 0.5 * h * (state.velocity + velocity)
    state.velocity_change = velocity - state.velocity
    state.velocity = velocity
    state.hydraulic_force = hydraulic - fluid.new * damping_slope * change
    state.damping_force = damping + damping_slope * change
    settle(state.seals, change, p)
    state.friction_force = rub.force + rub.slope * change
