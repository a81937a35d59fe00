"""
Coupling of piston and load: a compliance, and a gap (backlash); rigid by default.

With a compliance, or a gap before the load's mass, piston and load are two masses. The contact is
a spring with a damper, and never pulls across a gap. A gap may also lie between the mass and the
spring of the load, with or without its damper (Nordin, Gutman, "Controlling mechanical systems
with backlash - a survey", Automatica 38, 2002).
"""

from typing import NamedTuple

from asi_common.jit import jit

MASS, SPRING_ALONE, SPRING_AND_DAMPER = 0, 1, 2


class Contact(NamedTuple):
    """Over a sub-step: force (N) on the load = force + damping * mean velocity of the piston."""

    force: float      # N
    damping: float    # N s/m
    push: float       # N, all other terms of the load's equation of motion
    inertia: float    # N s/m, (push + force on the load) / mean velocity of the load


@jit
def two_masses(p):
    """Return whether piston and load move apart."""
    return p.coupling_stiffness > 0.0 or (p.backlash_gap > 0.0 and p.backlash_location == MASS)


@jit
def half_gap(p):
    """Return half the gap (m) between piston and the load's mass."""
    return 0.5 * p.backlash_gap if p.backlash_location == MASS else 0.0


@jit
def contact_stiffness(p):
    """Return the stiffness (N/m) of what touches."""
    return p.coupling_stiffness if p.coupling_stiffness > 0.0 else p.backlash_contact_stiffness


@jit
def contact(state, velocity, pushed, stiffness, damper, p, h):
    """
    Return the contact over a sub-step of `h` s, with the piston at about a mean velocity (m/s).

    pushed: external force on the load, N; stiffness N/m, damper N s/m: of the load's spring. By
    the implicit midpoint rule, in closed form: stable for any stiffness of the contact. The
    velocity only says whether there is a contact.
    """
    half = 0.5 * h
    inertia = 2.0 * (1.0 - p.coupling_piston_share) * p.load_mass / h
    push = inertia * state.load_velocity + pushed - stiffness * state.load_position
    inertia += damper + half * stiffness
    gap, centre = half_gap(p), p.backlash_centre
    ahead = state.position - centre - state.load_position
    apart = ahead + half * (velocity - push / inertia)
    if gap > 0.0 and abs(apart) <= gap:
        return Contact(0.0, 0.0, push, inertia)
    reach = min(max(apart, -gap), gap)
    firm = contact_stiffness(p)
    link = p.coupling_damping + half * firm
    share = inertia / (inertia + link)
    force = share * firm * (ahead - reach) - (1.0 - share) * push
    if gap > 0.0 and (force + share * link * velocity) * reach < 0.0:
        return Contact(0.0, 0.0, push, inertia)
    return Contact(force, share * link, push, inertia)


@jit
def contact_force(state, p):
    """Return the force (N) on the load at the end of a sub-step."""
    gap = half_gap(p)
    apart = state.position - p.backlash_centre - state.load_position
    reach = min(max(apart, -gap), gap)
    if gap > 0.0 and apart == reach:
        return 0.0
    force = (contact_stiffness(p) * (apart - reach)
             + p.coupling_damping * (state.velocity - state.load_velocity))
    return 0.0 if gap > 0.0 and force * reach < 0.0 else force


@jit
def spring_and_damper(position, stiffness, damper, p):
    """
    Return stiffness, damping and origin (m) of the load's spring at a position (m) of the mass.

    In a gap between mass and spring there is none.
    """
    if p.backlash_gap == 0.0 or p.backlash_location == MASS:
        return stiffness, damper, 0.0
    half = 0.5 * p.backlash_gap
    off = position - p.backlash_centre
    reach = min(max(off, -half), half)
    if off == reach:
        return 0.0, 0.0 if p.backlash_location == SPRING_AND_DAMPER else damper, 0.0
    return stiffness, damper, p.backlash_centre + reach
