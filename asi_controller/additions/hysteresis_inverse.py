"""
The inverse of a play, in front of the valve: it compensates the hysteresis at a reversal.

The inverse of a play of half width r adds r in the direction in which the command moves (Tao and
Kokotovic, Adaptive Control of Systems with Actuator and Sensor Nonlinearities, 1996). At a
reversal it jumps by 2r, also at reversals by noise. Here the jump is spread over the change of the
command since the reversal, over a dead zone on each side. While `size` is at most the half width
of the valve's play, the two in series have at most the gain 1 at any amplitude.
"""

from asi_common.jit import jit
from asi_common.parameter import Parameter

PARAMETERS = (
    Parameter('size', 0.0, 'N', 'Half width of the play that is inverted; 0: none', 0.0, 1e3),
    Parameter('dead_zone', 10.0, 'N',
              'Half of the change of the command after a reversal over which the play is '
              'compensated', 0.1, 1e3, source='assumed'),
)


@jit
def follow(centre, command, dead_zone):
    """Return the centre (N) of a band of half width `dead_zone` (N) that the command pushes."""
    return min(max(centre, command - dead_zone), command + dead_zone)
