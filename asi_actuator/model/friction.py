"""
Solid friction between seals and wall: Coulomb friction and stiction (paper, section 2.2).

An elasto-plastic bristle (Dupont, Hayward, Armstrong, Altpeter, "Single state elastoplastic
friction models", IEEE Trans. Automatic Control 47, 2002): below breakaway the seals only deform,
so that a locked piston neither creeps nor sticks and slips; beyond it they slide, with a friction
that falls from stiction to Coulomb over the Stribeck velocity. Stiction depends on the direction.
Null by default: viscous friction, another Coulomb friction each way, sliding that sets in
gradually (Dahl, "A solid friction model", 1968; with damping: LuGre, Canudas de Wit, Olsson,
Astrom, Lischinsky, IEEE Trans. Automatic Control 40, 1995), and a place behind the force sensor.
"""

import math
from typing import Final, NamedTuple

from asi_common.jit import FULL, LINEAR, inlined, jit

CYLINDER, BEHIND_SENSOR = 0, 1

# Share of the breakaway deflection below which the seals deform without any sliding.
ELASTIC_SHARE: Final = 0.7
# Beyond this many Stribeck velocities exp(-x * x) changes no bit of the friction.
FAR: Final = 7.0
# Least breakaway deflection (m) of seals with friction: the inverse of a smaller one overflows.
LEAST_LIMIT: Final = 1e-100


class Friction(NamedTuple):
    """Seals and friction at the end of a sub-step; slopes with the velocity there."""

    seal: float         # m, deflection
    seal_slope: float   # s
    force: float        # N
    force_slope: float  # N s/m


@jit
def sliding_friction(velocity, p):
    """Return the steady friction (N, not negative) when sliding at `velocity` (m/s)."""
    coulomb = p.friction_coulomb
    if p.friction_coulomb_asymmetry != 0.0:
        coulomb *= 1.0 + math.copysign(1.0, velocity) * p.friction_coulomb_asymmetry
    relative = velocity / p.friction_stribeck_velocity
    if abs(relative) > FAR:
        return coulomb
    stiction = p.friction_stiction_push if velocity >= 0.0 else p.friction_stiction_pull
    return coulomb + (stiction - coulomb) * math.exp(-relative * relative)


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
def sliding(deflection, velocity, limit, p):
    """Return how much of the motion slides, 0 to 1: elasto-plastic, or more, up to Dahl's 1."""
    slip = p.friction_presliding_slip
    if slip == 1.0:
        return 1.0
    share = sliding_share(deflection, velocity, limit)
    return share + slip * (1.0 - share)


@jit
def deflect(before, velocity, p, h):
    """
    Return the seals' deflection (m) after `h` s at a mean `velocity` (m/s), and its slope (s).

    The slope is the derivative with the velocity, for the implicit solution of the load; not
    negative, so that Newton's rule always steps the right way.
    Second order, and never beyond the breakaway deflection however long the sub-step.
    """
    limit = sliding_friction(velocity, p) / p.friction_presliding_stiffness
    if limit < LEAST_LIMIT:
        return 0.0, 0.0
    speed = abs(velocity)
    # What slides, with the deflection of the middle of the sub-step.
    loss = sliding(before, velocity, limit, p) / limit
    middle = (before + 0.5 * h * velocity) / (1.0 + 0.5 * h * loss * speed)
    loss = sliding(middle, velocity, limit, p) / limit
    # d(deflection)/dt = velocity - loss * speed * deflection, with 1 + x + x * x / 2 for exp(x).
    x = h * loss * speed
    fall = 1.0 + x + 0.5 * x * x
    after = (before + h * velocity * (1.0 + 0.5 * x)) / fall
    bound = max(limit, abs(before))
    if abs(after) > bound:
        return math.copysign(bound, after), 0.0
    along = math.copysign(1.0, velocity) * after
    return after, h * (1.0 + x) / fall * max(0.0, 1.0 - loss * along)


@inlined
def friction(before, mean_velocity, velocity, p, h):
    """
    Return seals and friction after a sub-step of `h` s that ends at `velocity` (m/s).

    before: deflection of the seals, m; mean_velocity: mean of the sub-step, m/s.
    """
    viscous = p.friction_viscous
    if p.friction_model == LINEAR:
        viscous += p.friction_linear_gain
    if p.friction_model != FULL:
        return Friction(0.0, 0.0, viscous * velocity, viscous)
    stiffness, damping = p.friction_presliding_stiffness, p.friction_presliding_damping
    after, slope = deflect(before, mean_velocity, p, h)
    slope *= 0.5  # the velocity at the end counts half in the mean
    # Only motion that deforms the seals is damped, never their relaxation when friction falls
    # from stiction to Coulomb: else it would drive the piston.
    elastic = 0.0
    limit = sliding_friction(velocity, p) / stiffness
    if limit >= LEAST_LIMIT:
        along = math.copysign(1.0, velocity) * after
        elastic = max(0.0, 1.0 - sliding(after, velocity, limit, p) * along / limit)
    damping = damping * elastic + viscous
    return Friction(after, slope, stiffness * after + damping * velocity,
                    stiffness * slope + damping)
