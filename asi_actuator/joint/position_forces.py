"""Forces that depend on the position: gravity and ripple, and the constant one."""

import math

from asi_common.jit import inlined


@inlined
def position_force(position, p):
    """Return the force (N or Nm) that the drive has to hold at a position, without the spring."""
    force = p.load_offset
    if p.gravity_sine != 0.0:
        force += p.gravity_sine * math.sin(position)
    if p.gravity_cosine != 0.0:
        force += p.gravity_cosine * math.cos(position)
    if p.ripple_force > 0.0:
        force += p.ripple_force * math.sin(
            2.0 * math.pi * (position / p.ripple_period + p.ripple_phase))
    return force
