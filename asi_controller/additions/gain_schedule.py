"""
The gain of the compensator scheduled by the desired force.

The valve and the play act differently on small and on large forces, and so does the onset of the
limit cycle. From no desired force to `force` the gain goes linearly to `factor` times itself, and
stays there. The desired force comes from outside of the loop, so no feedback arises by it (Rugh
and Shamma, Research on gain scheduling, Automatica 36, 2000).
"""

from asi_common.jit import jit
from asi_common.parameter import Parameter

PARAMETERS = (
    Parameter('force', 0.0, 'N', 'Desired force from which on the whole factor holds; 0: no '
              'schedule', 0.0, 1e5),
    Parameter('factor', 1.0, '', 'Gain at that force and above, relative to that at no force',
              0.0, 10.0),
)


@jit
def scheduled(goal, force, factor):
    """Return the factor of the gain at a desired force (N)."""
    return 1.0 + (factor - 1.0) * min(abs(goal) / force, 1.0) if force > 0.0 else 1.0
