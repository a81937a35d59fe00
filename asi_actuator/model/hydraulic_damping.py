"""
Hydraulic damping: oil forced through the valve's orifices (paper, section 2.2, Fig. 3).

A family of hyperbolic tangents in the velocity whose magnitude, scale and position depend on the
valve opening, as the paper fitted them, plus a viscous part, bounded by 1200 N. Null by default:
another function in place of the tangents, and beyond that bound a part with the square of the
velocity, and a viscous one that grows with the opening.
"""

import math

from asi_common.jit import FULL, LINEAR, inlined, jit


@jit
def tanh(x):
    """Return the hyperbolic tangent to 2e-16: by one exp, at half the time of math.tanh."""
    return 1.0 - 2.0 / (math.exp(2.0 * x) + 1.0)


@inlined
def saturation(x, tail):
    """
    Return a function that saturates at -1 and 1, of slope 1 at 0, and its slope.

    tail: how slowly; -1: error function, 0: hyperbolic tangent, 1: x / sqrt(1 + x^2), 2: arc
    tangent.
    """
    if tail > 1.0:   # without the hyperbolic tangent, which takes a third of the time
        root, along = 1.0 / math.sqrt(1.0 + x * x), 0.5 * math.pi * x
        bounded = (2.0 - tail) * x * root + (tail - 1.0) * math.atan(along) * 2.0 / math.pi
        return bounded, ((2.0 - tail) * root * root * root
                         + (tail - 1.0) / (1.0 + along * along))
    bounded = tanh(x)
    slope = 1.0 - bounded * bounded
    if tail > 0.0:
        root = 1.0 / math.sqrt(1.0 + x * x)
        bounded += tail * (x * root - bounded)
        slope += tail * (root * root * root - slope)
    elif tail < 0.0:
        bounded -= tail * (math.erf(0.5 * math.sqrt(math.pi) * x) - bounded)
        slope -= tail * (math.exp(-0.25 * math.pi * x * x) - slope)
    return bounded, slope


@inlined
def damping_curve(opening, p):
    """
    Return the curve of the family that belongs to a valve opening (-1 to 1).

    As (magnitude N, velocity m/s about which it rises extending, the same retracting,
    width m/s, value of the tangents at rest, size of the opening).
    """
    size = abs(opening)
    if p.hydraulic_damping_model != FULL:   # what follows takes a third of a linear model's time
        return 0.0, 0.0, 0.0, 0.0, 0.0, size
    centre = (p.hydraulic_damping_saturation_velocity
              - p.hydraulic_damping_saturation_narrowing * size)
    shift = p.hydraulic_damping_saturation_shift * opening
    extending, retracting = centre + shift, centre - shift
    width = p.hydraulic_damping_velocity_width * (1.0 + p.hydraulic_damping_width_growth * size)
    share = p.hydraulic_damping_centre_share
    magnitude = 0.5 * p.hydraulic_damping_maximum_force * (share + (1.0 - share) * size)
    tail = p.hydraulic_damping_tail
    at_rest = saturation(retracting / width, tail)[0] - saturation(extending / width, tail)[0]
    return magnitude, extending, retracting, width, at_rest, size


@inlined
def tangents_force(velocity, curve, p):
    """Return the force (N) of the curve against a velocity (m/s), and its slope (N s/m)."""
    bound = p.hydraulic_damping_maximum_force
    if p.hydraulic_damping_model == LINEAR:
        return p.hydraulic_damping_linear_gain * velocity, p.hydraulic_damping_linear_gain
    if p.hydraulic_damping_model != FULL or bound == 0.0:
        return 0.0, 0.0
    magnitude, extending, retracting, width, at_rest, _ = curve
    tail = p.hydraulic_damping_tail
    out, out_slope = saturation((velocity - extending) / width, tail)
    back, back_slope = saturation((velocity + retracting) / width, tail)
    force = magnitude * (out + back - at_rest) + p.hydraulic_damping_viscous * velocity
    slope = magnitude / width * (out_slope + back_slope) + p.hydraulic_damping_viscous
    bounded, bounded_slope = saturation(force / bound, tail)
    return bound * bounded, slope * bounded_slope


@inlined
def damping_force(velocity, curve, p):
    """Return the damping force (N) against a velocity (m/s), and its slope (N s/m)."""
    force, slope = tangents_force(velocity, curve, p)
    quadratic, viscous = p.hydraulic_damping_quadratic, p.hydraulic_damping_opening_viscous
    if quadratic > 0.0 or viscous > 0.0:
        speed = abs(velocity)
        grown = viscous * curve[5] + quadratic * speed
        return force + grown * velocity, slope + grown + quadratic * speed
    return force, slope


@jit
def hydraulic_damping(velocity, opening, p):
    """Return the damping force (N) at a velocity (m/s) and a valve opening (-1 to 1)."""
    return damping_force(velocity, damping_curve(opening, p), p)[0]
