"""
The loop gain scheduled by the control period: a slower loop answers later, and bears less gain.

A command that is held for a control period acts, on average, half of it late. What a loop bears is
about inversely proportional to its delay, proportional part and integrator alike (Skogestad,
Simple analytic rules for model reduction and PID controller tuning, Journal of Process Control 13,
2003). So with the delay of the loop itself given, settings for one control rate serve at others.
"""

from asi_common.jit import jit
from asi_common.parameter import Parameter

PARAMETERS = (
    Parameter('delay', 0.0, 's', 'Delay of the loop without that of the hold: gain and integrator '
              'are times delay / (delay + half a control period); 0: the same at all rates',
              0.0, 0.1),
)


@jit
def share_of_gain(delay, period):
    """Return the factor of the gain at a control period (s)."""
    return delay / (delay + 0.5 * period) if delay > 0.0 else 1.0
