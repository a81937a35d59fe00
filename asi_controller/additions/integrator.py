"""
An integrator of the error, added to the output of the compensator.

Anti-windup by conditional integration: it stops while the command is saturated in the direction
in which it would move.
"""

from asi_common.jit import jit
from asi_common.parameter import Parameter

PARAMETERS = (
    Parameter('rate', 0.0, '1/s', 'Command per integral of the error; 0: no integrator', 0.0, 1e4),
)


@jit
def integrate(integral, error, excess, rate, period):
    """
    Return the integral (N) after a control period (s).

    error: N; excess: command that is wanted less the command that is given, N; rate: 1/s.
    """
    step = rate * period * error
    return integral + step if excess * step <= 0.0 else integral
