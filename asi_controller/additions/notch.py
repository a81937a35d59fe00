"""
A notch in series with the compensator, for a resonance of the load.

It is (s² + 2dζωs + ω²)/(s² + 2ζωs + ω²): its gain is d, the depth, at its frequency, and 1 far
from it; ζ is half of its width divided by its frequency. Below its frequency it adds a
phase lag, so keep it well above the frequency of the limit cycle.
"""

import cmath
import math
from typing import Final

from asi_common.parameter import Parameter, ParameterError
from asi_controller.design import Design

PARAMETERS = (
    Parameter('frequency', 0.0, 'Hz', 'Frequency of the notch; 0: none', 0.0, 1e4),
    Parameter('depth', 0.3, '', 'Gain of the notch at its frequency', 1e-3, 1.0,
              source='assumed'),
    Parameter('width', 100.0, 'Hz',
              'Distance of the two frequencies at which its gain is sqrt((1 + depth^2) / 2)',
              0.1, 1e4, source='assumed'),
)
LOWEST_HZ: Final = 1.0


def with_notch(design: Design, frequency_hz: float, depth: float, width_hz: float) -> Design:
    """
    Return a compensator with a notch (frequency and width in Hz) in series; at 0 Hz, itself.

    Raises ParameterError for a frequency below LOWEST_HZ.
    """
    if frequency_hz == 0.0:
        return design
    if frequency_hz < LOWEST_HZ:
        raise ParameterError(f'notch.frequency = {frequency_hz:g} is not allowed: it is 0, or at '
                             f'least {LOWEST_HZ:g} Hz')
    damping_ratio = 0.5 * width_hz / frequency_hz
    return Design(design.zeros + _pair(frequency_hz, depth * damping_ratio),
                  design.poles + _pair(frequency_hz, damping_ratio), design.gain)


def _pair(frequency_hz: float, damping_ratio: float) -> tuple[complex, complex]:
    """Return the roots (rad/s) of s² + 2ζωs + ω²."""
    omega = 2.0 * math.pi * frequency_hz
    half = cmath.sqrt(damping_ratio**2 - 1.0)
    return omega * (-damping_ratio + half), omega * (-damping_ratio - half)
