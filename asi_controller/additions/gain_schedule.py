"""
The gain of the compensator scheduled by the measured velocity.

The damping of the actuator depends on the opening of its valve, so that a moved piston answers a
change of the command with more force than one at rest: at 0.2 to 0.6 m/s, where it gives no
force, with 2.4 to 3.3 times as much (`asi_analysis/tuning/margins.py`). A gain that holds the
piston at rest makes it oscillate in motion. The schedule is about the inverse of that: a gain of
1/(1 + |v|/velocity) (Rugh and Shamma, Research on gain scheduling, Automatica 36, 2000).
"""

from asi_common.jit import jit
from asi_common.parameter import Parameter

PARAMETERS = (
    Parameter('velocity', 0.0, 'm/s', 'Velocity at which the gain is half of that at rest; 0: no '
              'schedule', 0.0, 100.0),
)


@jit
def scheduled(velocity, half):
    """Return the factor of the gain at a velocity (m/s), of which `half` (m/s) halves it."""
    return half / (half + abs(velocity)) if half > 0.0 else 1.0
