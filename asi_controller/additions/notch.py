"""
A notch in series with the compensator, for a resonance of the load.

It is (s² + 2dζωs + ω²)/(s² + 2ζωs + ω²): its gain is d, the depth, at its frequency, and 1 far
from it; ζ is half of its width divided by its frequency. Frequency, depth and width are those at
the control rate, which must be more than twice the frequency and twice the width. Below its
frequency it adds a phase lag, so keep it well above the frequency of the limit cycle.
"""

import cmath
import math
from typing import Final

from asi_common.parameter import Parameter, ParameterError
from asi_controller.design import PREWARP_HZ, Design

PARAMETERS = (
    Parameter('frequency', 0.0, 'Hz', 'Frequency of the notch; 0: none', 0.0, 1e4),
    Parameter('depth', 0.3, '', 'Gain of the notch at its frequency', 1e-3, 1.0,
              source='assumed'),
    Parameter('width', 100.0, 'Hz',
              'Distance of the two frequencies at which its gain is sqrt((1 + depth^2) / 2)',
              0.1, 1e4, source='assumed'),
)
LOWEST_HZ: Final = 1.0


def with_notch(design: Design, frequency_hz: float, depth: float, width_hz: float,
               rate_hz: float | None = None) -> Design:
    """
    Return a compensator with a notch (frequency and width in Hz) in series; at 0 Hz, itself.

    rate_hz: the control rate for which it will be discretised; None: for continuous time.
    Raises ParameterError for a frequency below LOWEST_HZ, or one that the rate does not allow.
    """
    if frequency_hz == 0.0:
        return design
    if frequency_hz < LOWEST_HZ:
        raise ParameterError(f'notch.frequency = {frequency_hz:g} is not allowed: it is 0, or at '
                             f'least {LOWEST_HZ:g} Hz')
    if rate_hz is not None:
        frequency_hz, width_hz = _warped(frequency_hz, width_hz, rate_hz)
    damping_ratio = 0.5 * width_hz / frequency_hz
    return Design(design.zeros + _pair(frequency_hz, depth * damping_ratio),
                  design.poles + _pair(frequency_hz, damping_ratio), design.gain)


def _warped(frequency_hz: float, width_hz: float, rate_hz: float) -> tuple[float, float]:
    """Return the frequency and width (Hz) of which Tustin's rule makes the given ones."""
    for name, value_hz in (('frequency', frequency_hz), ('width', width_hz)):
        if value_hz >= 0.5 * rate_hz:
            raise ParameterError(f'notch.{name} = {value_hz:g} is not allowed at a control rate '
                                 f'of {rate_hz:g} Hz: it takes less than half of the rate')
    scale_hz = PREWARP_HZ / math.tan(math.pi * PREWARP_HZ / rate_hz)
    tangent = math.tan(math.pi * frequency_hz / rate_hz)
    # The edges are f1 and f2 with tan(f1) tan(f2) = tangent^2, hence the width exactly.
    return (scale_hz * tangent,
            scale_hz * (1.0 + tangent**2) * math.tan(math.pi * width_hz / rate_hz))


def _pair(frequency_hz: float, damping_ratio: float) -> tuple[complex, complex]:
    """Return the roots (rad/s) of s² + 2ζωs + ω²."""
    omega = 2.0 * math.pi * frequency_hz
    half = cmath.sqrt(damping_ratio**2 - 1.0)
    return omega * (-damping_ratio + half), omega * (-damping_ratio - half)
