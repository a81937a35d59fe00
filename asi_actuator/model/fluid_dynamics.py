"""Fluid dynamics: the oil in valve and cylinder, lumped to a first-order lag (paper, 4.1)."""

import math

from asi_actuator.model.jit import FULL, LINEAR, jit


@jit
def fluid_dynamics(p, h):
    """
    Return how the hydraulic force follows its input over a sub-step of `h` s: (keep, old, new).

    force after = keep * force + old * input before + new * input after, by the trapezoidal rule.
    As coefficients, because the input after depends on the velocity that the load solves for.
    """
    if p.fluid_dynamics_model == FULL:
        a = math.pi * p.fluid_dynamics_frequency * h
        return (1.0 - a) / (1.0 + a), a / (1.0 + a), a / (1.0 + a)
    gain = p.fluid_dynamics_linear_gain if p.fluid_dynamics_model == LINEAR else 1.0
    return 0.0, 0.0, gain
