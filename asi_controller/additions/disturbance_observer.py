"""
A disturbance observer: it subtracts from the command the disturbance that it estimates.

The inverse of a model (the lag of the valve's coil), with a low-pass of the given bandwidth,
computes from the measured force the command that should have caused it. The actual command is
passed through the same low-pass; the difference is the disturbance, as a command (Ohnishi, Shibata
and Murakami, Motion control for advanced mechatronics, IEEE/ASME Transactions on Mechatronics 1,
1996).
Below its bandwidth it acts as an integrator, which a saturated command cannot wind up.
"""

from math import inf, pi

from asi_common.jit import jit
from asi_common.parameter import Parameter
from asi_controller.additions.reference_model import approach

PARAMETERS = (
    Parameter('bandwidth', 0.0, 'Hz', 'Bandwidth of the low-pass of the observer; 0: no observer',
              0.0, 1e4),
    Parameter('lag_frequency', 18.9, 'Hz', 'Corner of the lag of the actuator', 0.1, 1e4,
              source='valve_flexure.coil_frequency'),
)


@jit
def disturbance(slow, measured, bandwidth, lag_frequency):
    """
    Return the disturbance, as a command (N), at a measured force (N).

    slow: low-pass of the measured force less that of the command, N, and of the force alone, N.
    """
    return slow[0] + bandwidth / lag_frequency * (measured - slow[1])


@jit
def observe(slow, measured, command, bandwidth, period):
    """
    Advance `slow` by a control period (s), in place.

    command: without the inverse of the hysteresis, N. At a bandwidth of 0, it follows at once.
    """
    rate = 2.0 * pi * bandwidth if bandwidth > 0.0 else inf
    slow[0] = approach(slow[0], measured - command, rate, period)
    slow[1] = approach(slow[1], measured, rate, period)
