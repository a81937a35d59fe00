"""
Fluid dynamics: the oil in valve and cylinder, lumped to a first-order lag (paper, 4.1).

Null by default: leakage past the piston, which divides the static force by 1 + leakage and makes
the lag faster by as much; and entrained air, a further lag that shrinks as the force compresses
the air (Merritt, Hydraulic Control Systems, 1967, section 2.4).
"""

import math

from asi_actuator.model.linear_lag import FirstOrder, first_order
from asi_common.jit import FULL, LINEAR, jit


@jit
def fluid_gain(p):
    """Return the gain (N/N) of the fluid when it has no dynamics."""
    return p.fluid_dynamics_linear_gain if p.fluid_dynamics_model == LINEAR else 1.0


@jit
def fluid_dynamics(p, h):
    """
    Return how the hydraulic force follows its input over a sub-step of `h` s.

    As coefficients, because the input after depends on the velocity that the load solves for.
    """
    if p.fluid_dynamics_model == FULL:
        return first_order(p.fluid_dynamics_frequency, h)
    return FirstOrder(0.0, 0.0, fluid_gain(p))


@jit
def leaks(p):
    """Return whether leakage or air make the lag depend on the force."""
    return (p.fluid_dynamics_leakage > 0.0 or p.fluid_dynamics_leakage_growth > 0.0
            or p.fluid_dynamics_air_time > 0.0)


@jit
def leaking(force, p, h):
    """Return the coefficients of a sub-step of `h` s with leakage and air at a force (N)."""
    size = abs(force)
    leak = 1.0 + p.fluid_dynamics_leakage + p.fluid_dynamics_leakage_growth * size
    time = p.fluid_dynamics_air_time / (1.0 + size / p.fluid_dynamics_air_force)
    if p.fluid_dynamics_model == FULL:
        time += 0.5 / (math.pi * p.fluid_dynamics_frequency)
    gain = fluid_gain(p) / leak
    if time == 0.0:
        return FirstOrder(0.0, 0.0, gain)
    lag = first_order(0.5 * leak / (math.pi * time), h)
    return FirstOrder(lag.keep, gain * lag.old, gain * lag.new)
