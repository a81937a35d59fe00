"""
The lead and lag of `lead_lag` in series with a notch, for a resonance of what the piston moves.

The notch is (s² + 2dζωs + ω²)/(s² + 2ζωs + ω²): its gain is d, the depth, at its frequency, and 1
far from it; ζ is half of its width divided by its frequency. Below its frequency it takes phase
from the loop, so it is to stay well above the frequency of the limit cycle.
"""

import cmath
import math

from asi_common.parameter import Parameter
from asi_controller.compensators import lead_lag
from asi_controller.design import Compensator, Design


def pair(frequency_hz: float, damping_ratio: float) -> tuple[complex, complex]:
    """Return the roots (rad/s) of s² + 2ζωs + ω²."""
    omega = 2.0 * math.pi * frequency_hz
    half = cmath.sqrt(damping_ratio**2 - 1.0)
    return omega * (-damping_ratio + half), omega * (-damping_ratio - half)


def design(gain: float, notch_frequency: float, notch_depth: float, notch_width: float,
           **settings: float) -> Design:
    """Return lead, lag and notch; the other settings are those of `lead_lag`."""
    zeros, poles, gain = lead_lag.design(gain, **settings)
    damping_ratio = 0.5 * notch_width / notch_frequency
    return Design(zeros + pair(notch_frequency, notch_depth * damping_ratio),
                  poles + pair(notch_frequency, damping_ratio), gain)


COMPENSATOR = Compensator('lead_lag_notch', gain=13.0, order=25, design=design, parameters=(
    *lead_lag.COMPENSATOR.parameters,
    Parameter('notch_frequency', 321.0, 'Hz', 'Frequency of the notch', 1.0, 1e4,
              source='sqrt(load.locked_stiffness / load.mass) / (2 pi)'),
    Parameter('notch_depth', 0.3, '', 'Gain of the notch at its frequency', 1e-3, 1.0,
              source='assumed'),
    Parameter('notch_width', 100.0, 'Hz',
              'Distance of the two frequencies at which its gain is sqrt((1 + depth^2) / 2)',
              0.1, 1e4, source='assumed'),
))
