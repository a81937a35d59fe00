"""
Compensation of Coulomb friction from the measured velocity.

It adds a force in the direction of motion, which rises smoothly over the given speed, so that
noise at rest does not switch it (Armstrong-Hélouvry, Dupont and Canudas de
Wit, A Survey of Models, Analysis Tools and Compensation Methods for the Control of Machines with
Friction, 1994, section 6). With a level above the friction the actuator pushes in the direction of
motion, and is not passive.
"""

from math import hypot

from asi_common.jit import jit
from asi_common.parameter import Parameter

PARAMETERS = (
    Parameter('level', 0.0, 'N', 'Friction that is compensated; 0: none', 0.0, 1e4),
    Parameter('speed', 0.01, 'm/s', 'Speed at which 71 % of it is in use', 1e-4, 10.0,
              source='assumed'),
)


@jit
def compensated(velocity, level, speed):
    """Return the command (N) at a velocity (m/s)."""
    return level * velocity / hypot(velocity, speed)
