"""
A disturbance observer: it takes off the command what the measured force has beyond a model's.

The model is the lag of the valve's coil. Its inverse, with a low-pass of the given bandwidth,
makes from the measured force the command that should have caused it; what was given is passed
through the same low-pass, and the difference is the disturbance, as a command (Ohnishi, Shibata
and Murakami, Motion control for advanced mechatronics, IEEE/ASME Transactions on Mechatronics 1,
1996).
Below its bandwidth it acts as an integrator, which a saturated command cannot wind up.
"""

from math import inf, pi

from asi_common.jit import jit
from asi_common.parameter import Parameter
from asi_controller.additions.reference_model import approach

PARAMETERS = (
    Parameter('bandwidth', 0.0, 'Hz', 'Up to which disturbances are observed; 0: no observer',
              0.0, 1e4),
    Parameter('lag_frequency', 18.9, 'Hz', 'Corner of the lag of the actuator', 0.1, 1e4,
              source='valve_flexure.coil_frequency'),
)


@jit
def disturbance(slow, measured, bandwidth, lag_frequency):
    """
    Return the command (N) of which the measured force (N) has too much.

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
