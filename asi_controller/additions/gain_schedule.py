"""
The gain of the compensator scheduled by the measured velocity.

The damping of the actuator depends on the opening of its valve, so the small-signal gain from
command to force grows with the velocity. Around zero force it is 1.4 times that at rest at
0.1 m/s and 1.6 to 1.7 times from 0.15 to 0.6 m/s (`asi_analysis/tuning/margins.py`). A gain that
is stable at rest can oscillate in motion. The schedule is about the inverse of that ratio (Rugh
and Shamma, Research on gain scheduling, Automatica 36, 2000). The integrator, which reduces the
felt force, is not scheduled.
"""

from asi_common.jit import jit
from asi_common.parameter import Parameter

PARAMETERS = (
    Parameter('velocity', 0.0, 'm/s', 'Velocity at which the gain is halfway from that at rest to '
              'the least; 0: no schedule', 0.0, 100.0),
    Parameter('least', 0.0, '', 'Share of the gain that is kept at high velocities', 0.0, 1.0),
)


@jit
def scheduled(velocity, half, least):
    """Return the factor of the gain at a velocity (m/s); at `half` it is halfway to `least`."""
    if half == 0.0:
        return 1.0
    return least + (1.0 - least) * half / (half + abs(velocity))
