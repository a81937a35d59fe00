"""Fluid dynamics: the oil in valve and cylinder, lumped to a first-order lag (paper, 4.1)."""

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
