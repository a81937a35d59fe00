"""
Solid friction between seals and wall: Coulomb friction and stiction (paper, section 2.2).

An elasto-plastic bristle (Dupont, Hayward, Armstrong, Altpeter, "Single state elastoplastic
friction models", IEEE Trans. Automatic Control 47, 2002): below breakaway the seals only deform,
so that a locked piston neither creeps nor sticks and slips; beyond it they slide, with a friction
that falls from stiction to Coulomb over the Stribeck velocity. Stiction depends on the direction.
"""

import math

from asi_actuator.model.jit import FULL, LINEAR, jit

# Share of the breakaway deflection below which the seals deform without any sliding.
ELASTIC_SHARE = 0.7


@jit
def sliding_friction(velocity, p):
    """Return the steady friction (N, not negative) when sliding at `velocity` (m/s)."""
    stiction = p.friction_stiction_push if velocity >= 0.0 else p.friction_stiction_pull
    relative = velocity / p.friction_stribeck_velocity
    return p.friction_coulomb + (stiction - p.friction_coulomb) * math.exp(-relative * relative)


@jit
def sliding_share(deflection, velocity, limit):
    """Return how much of the motion slides, 0 to 1, at a deflection (m) of at most `limit` (m)."""
    if deflection * velocity <= 0.0:
        return 0.0
    elastic = ELASTIC_SHARE * limit
    size = abs(deflection)
    if size <= elastic:
        return 0.0
    if size >= limit:
        return 1.0
    middle = 0.5 * (limit + elastic)
    return 0.5 + 0.5 * math.sin(math.pi * (size - middle) / (limit - elastic))


@jit
def deflect(deflection, velocity, p, h):
    """
    Return the seals' deflection (m) after `h` s at a mean `velocity` (m/s), and its slope (s).

    The slope is the derivative with the velocity, for the implicit solution of the load.
    """
    limit = sliding_friction(velocity, p) / p.friction_presliding_stiffness
    if limit <= 0.0:
        return 0.0, 0.0
    share = sliding_share(deflection, velocity, limit)
    loss = 1.0 + h * share * abs(velocity) / limit
    after = (deflection + h * velocity) / loss
    return after, h * (1.0 - share * abs(after) / limit) / loss


@jit
def friction(before, velocity, p, h):
    """
    Return the seals' state after a sub-step of `h` s, and the friction over it.

    before: deflection of the seals, m; velocity: mean of the sub-step, m/s.
    As (deflection m, friction at the end N, mean friction N, slope of the mean N s/m).
    """
    if p.friction_model == LINEAR:
        force = p.friction_linear_gain * velocity
        return 0.0, force, force, p.friction_linear_gain
    if p.friction_model != FULL:
        return 0.0, 0.0, 0.0, 0.0
    after, slope = deflect(before, velocity, p, h)
    stiffness, damping = p.friction_presliding_stiffness, p.friction_presliding_damping
    damped = damping * (after - before) / h
    mean = 0.5 * stiffness * (before + after) + damped
    return after, stiffness * after + damped, mean, slope * (0.5 * stiffness + damping / h)
