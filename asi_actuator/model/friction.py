"""
Solid friction between seals and wall: Coulomb friction and stiction (paper, section 2.2).

An elasto-plastic bristle (Dupont, Hayward, Armstrong, Altpeter, "Single state elastoplastic
friction models", IEEE Trans. Automatic Control 47, 2002): below breakaway the seals only deform,
so that a locked piston neither creeps nor sticks and slips; beyond it they slide, with a friction
that falls from stiction to Coulomb over the Stribeck velocity. Stiction depends on the direction.
Null by default: viscous friction, another Coulomb friction each way, and a place behind the force
sensor. Books formulate these laws in several ways, so, null by default as well: sliding that sets
in gradually, with an exponent (Dahl, "A solid friction model", 1968; with damping: LuGre, Canudas
de Wit, Olsson, Astrom, Lischinsky, IEEE Trans. Automatic Control 40, 1995); elements in parallel
that slide one after the other (Maxwell slip: Al-Bender, Lampaert, Swevers, IEEE Trans. Automatic
Control 50, 2005); friction that falls, with the velocity or in one direction, with the stiffness
of the seals, not with their deflection.
"""

import math
from typing import Final, NamedTuple

import numpy as np

from asi_common.jit import FULL, LINEAR, inlined, jit

CYLINDER, BEHIND_SENSOR = 0, 1

# Share of the breakaway deflection below which the seals deform without any sliding.
ELASTIC_SHARE: Final = 0.7
# Beyond this many Stribeck velocities exp(-x * x) changes no bit of the friction.
FAR: Final = 7.0
# Share of the breakaway deflection below which Dahl's law is linear, for any exponent.
NEAR: Final = 1e-6
# Least breakaway deflection (m) of seals with friction: the inverse of a smaller one overflows.
LEAST_LIMIT: Final = 1e-100

# The seals are so many elements in parallel if they do not slide all at once.
ELEMENTS: Final = 4
# Rows of their deflections (m): at the start and the end of a sub-step; and the slope (s) of the
# latter with the velocity at the end.
BEFORE, AFTER, SLOPE = 0, 1, 2
SEALS_SHAPE: Final = (3, ELEMENTS)


class Friction(NamedTuple):
    """Friction at the end of a sub-step, and its slope with the velocity there."""

    force: float   # N
    slope: float   # N s/m


@jit
def coulomb_friction(forward, p):
    """Return the Coulomb friction (N) in a direction."""
    return p.friction_coulomb * (1.0 + (1.0 if forward else -1.0) * p.friction_coulomb_asymmetry)


@jit
def stiction(forward, p):
    """Return the breakaway force (N) in a direction."""
    return p.friction_stiction_push if forward else p.friction_stiction_pull


@jit
def stribeck(velocity, p):
    """Return the share of stiction beyond Coulomb friction that is left at a velocity (m/s)."""
    relative = velocity / p.friction_stribeck_velocity
    return math.exp(-relative * relative) if abs(relative) <= FAR else 0.0


@jit
def steady_friction(forward, left, p):
    """Return the steady friction (N, not negative) in a direction; left: from `stribeck`."""
    coulomb = coulomb_friction(forward, p)
    return coulomb + (stiction(forward, p) - coulomb) * left


@jit
def sliding_friction(velocity, p):
    """Return the steady friction (N, not negative) when sliding at `velocity` (m/s)."""
    return steady_friction(math.copysign(1.0, velocity) > 0.0, stribeck(velocity, p), p)


@jit
def held_friction(forward, p):
    """Return the larger one (N) of stiction and Coulomb friction in a direction."""
    return max(stiction(forward, p), coulomb_friction(forward, p))


@jit
def common_friction(p):
    """Return the friction (N) that goes with the common deflection of seals that soften."""
    return 0.5 * (held_friction(True, p) + held_friction(False, p))


@jit
def breakaway_deflection(forward, left, p):
    """Return the deflection (m) of the seals when sliding steadily; left: from `stribeck`."""
    force, softening = steady_friction(forward, left, p), p.friction_softening
    if softening != 0.0:
        force += softening * (common_friction(p) - force)
    return force / p.friction_presliding_stiffness


@jit
def softened(forward, velocity, left, p):
    """
    Return the stiffness of the seals as a share of p.friction_presliding_stiffness, and its slope.

    forward: whether their deflection is; velocity: m/s, with which the slope (s/m) is the
    derivative; left: from `stribeck`, at that velocity.
    """
    softening = p.friction_softening
    if softening == 0.0:
        return 1.0, 0.0
    slides, common = steady_friction(forward, left, p), common_friction(p)
    whole = slides + softening * (common - slides)
    if whole == 0.0:
        return 1.0, 0.0
    falls = (2.0 * velocity / p.friction_stribeck_velocity ** 2
             * (slides - coulomb_friction(forward, p)))
    # The square of a tiny force would be 0.
    return slides / whole, -softening * (common / whole) * (falls / whole)


@jit
def quarter_wave(x):
    """Return sin(x * pi / 2) for x from -1 to 1, to 7e-16: at half the time of math.sin."""
    t = x * x   # a polynomial through the Chebyshev points
    t2 = t * t
    return x * ((1.5707963267948966 - 0.6459640975062232 * t)
                + t2 * (0.07969262624568336 - 0.004681754131447063 * t)
                + t2 * t2 * ((1.604411695631026e-4 - 3.5988107063136795e-6 * t)
                             + t2 * (5.688318064017795e-8 - 6.449471237809134e-10 * t)))


@jit
def sliding_share(along):
    """
    Return how much of the motion slides, 0 to 1, by the elasto-plastic law.

    along: deflection along the motion, as a share of that at which all of the motion slides.
    """
    if along <= ELASTIC_SHARE:
        return 0.0
    if along >= 1.0:
        return 1.0
    middle = 0.5 * (1.0 + ELASTIC_SHARE)
    return 0.5 + 0.5 * quarter_wave((along - middle) * (2.0 / (1.0 - ELASTIC_SHARE)))


@jit
def sliding(along, p):
    """
    Return how much of the motion slides, divided by `along`, which `sliding_share` explains.

    From elasto-plastic, with 0 to 1, to Dahl's law, with 1 for an exponent of 1.
    """
    share = p.friction_presliding_slip
    if share != 1.0:
        elastoplastic = sliding_share(along)
        share = elastoplastic + share * (1.0 - elastoplastic)
    exponent = p.friction_presliding_exponent
    if exponent == 1.0:
        return share
    # The limit of the other direction, from which the deflection comes, may be far larger.
    slides = max(share * along, -1.0)
    if abs(slides) < NEAR:
        return exponent * share
    if slides >= 1.0:
        return share
    return share * (1.0 - (1.0 - slides) ** exponent) / slides


@jit
def deflect(before, velocity, limit, p, h):
    """
    Return a seal's deflection (m) after `h` s at a mean `velocity` (m/s), and its slope (s).

    limit: deflection (m) at which all of the motion slides. The slope is the derivative with the
    velocity (nearly, with an exponent), for the implicit solution of the load; not negative, so
    that Newton's rule always steps the right way. Second order, and never beyond the limit however
    long the sub-step.
    """
    if limit < LEAST_LIMIT:
        return 0.0, 0.0
    speed, forward = abs(velocity), math.copysign(1.0, velocity)
    inverse = 1.0 / limit   # one division, not three: each takes as long as four products
    # What slides, with the deflection of the middle of the sub-step.
    loss = sliding(forward * before * inverse, p) * inverse
    middle = (before + 0.5 * h * velocity) / (1.0 + 0.5 * h * loss * speed)
    loss = sliding(forward * middle * inverse, p) * inverse
    # d(deflection)/dt = velocity - loss * speed * deflection, with 1 + x + x * x / 2 for exp(x).
    x = h * loss * speed
    whole = 1.0 / (1.0 + x + 0.5 * x * x)
    after = (before + h * velocity * (1.0 + 0.5 * x)) * whole
    bound = max(limit, abs(before))
    if abs(after) > bound:
        return math.copysign(bound, after), 0.0
    return after, h * (1.0 + x) * whole * max(0.0, 1.0 - loss * forward * after)


@jit
def elements(p):
    """
    Return the number of elements of the seals, and the reach of the first one.

    The reach is the share of the breakaway deflection at which an element slides. Each carries the
    same force then, so its share of the stiffness is 1 / (number * reach).
    """
    ratio = p.friction_element_ratio
    if ratio == 1.0:
        return 1, 1.0
    shares, inverse = 0.0, 1.0 / ratio
    for _ in range(ELEMENTS):
        shares = shares * inverse + 1.0
    return ELEMENTS, shares / ELEMENTS


@inlined
def friction(seals, mean_velocity, velocity, p, h):
    """
    Return the friction after a sub-step of `h` s that ends at `velocity` (m/s).

    seals: SEALS_SHAPE; the deflections at the end are filled in, and kept by `settle`;
    mean_velocity: mean of the sub-step, m/s.
    """
    viscous = p.friction_viscous
    if p.friction_model == LINEAR:
        viscous += p.friction_linear_gain
    force, slope = viscous * velocity, viscous
    if p.friction_model != FULL:
        return Friction(force, slope)
    count, reach = elements(p)
    direction, left = math.copysign(1.0, velocity), stribeck(velocity, p)
    held = breakaway_deflection(math.copysign(1.0, mean_velocity) > 0.0,
                                stribeck(mean_velocity, p), p)
    limit = breakaway_deflection(direction > 0.0, left, p)
    damped = p.friction_presliding_damping > 0.0 and limit >= LEAST_LIMIT
    ahead, back = softened(True, velocity, left, p), softened(False, velocity, left, p)
    for i in range(count):
        after, deflects = deflect(seals[BEFORE, i], mean_velocity, reach * held, p, h)
        deflects *= 0.5  # the velocity at the end counts half in the mean
        seals[AFTER, i], seals[SLOPE, i] = after, deflects
        share, share_slope = ahead if after >= 0.0 else back
        part = 1.0 / (count * reach)
        stiffness = p.friction_presliding_stiffness * part
        force += share * stiffness * after
        slope += stiffness * (share * deflects + share_slope * after)
        if damped:
            # Only motion that deforms the seals is damped, never their relaxation when friction
            # falls from stiction to Coulomb: else it would drive the piston.
            along = direction * after / (reach * limit)
            elastic = max(0.0, 1.0 - sliding(along, p) * max(along, -1.0))
            damping = p.friction_presliding_damping * part * elastic
            force += damping * velocity
            slope += damping
        reach *= p.friction_element_ratio
    return Friction(force, slope)


@inlined
def settle(seals, change, p):
    """Let the next sub-step begin where this one ended, at a velocity larger by `change` (m/s)."""
    count = elements(p)[0] if p.friction_model == FULL else 0
    for i in range(count):
        seals[BEFORE, i] = seals[AFTER, i] + seals[SLOPE, i] * change
    for i in range(count, ELEMENTS):
        seals[BEFORE, i] = 0.0


@jit
def largest_deflection(p):
    """Return the deflection (m) at rest beyond which the last element of the seals slides."""
    count, reach = elements(p)
    held = max(held_friction(True, p), held_friction(False, p))
    held += p.friction_softening * (common_friction(p) - held)
    return reach * p.friction_element_ratio ** (count - 1) * held / p.friction_presliding_stiffness


@jit
def deflected_seals(deflection, p):
    """Return seals (SEALS_SHAPE) that were deflected (m) together, each up to where it slides."""
    seals = np.zeros(SEALS_SHAPE)
    limit = largest_deflection(p)
    for i in range(elements(p)[0] - 1, -1, -1):
        seals[BEFORE, i] = min(max(deflection, -limit), limit)
        limit /= p.friction_element_ratio
    return seals
