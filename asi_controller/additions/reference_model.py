"""
A reference that the actuator can follow, and the command that makes it do so.

The model is the lag of the valve's coil, driven to the desired force with the given bandwidth,
within the limits of the drive. Its drive is the feed-forward; its force, delayed as the
actuator's, is the set point of the compensator. So the feedback need not overshoot after a step,
and a large step does not wind it up (model following: Åström and Wittenmark,
Computer-Controlled Systems, 1997, ch. 4). A moving reference is extrapolated by the lead time,
which compensates the delay; a jump (a slope above `slope`) is not.
"""

import math

from asi_common.jit import jit
from asi_common.parameter import Parameter

PARAMETERS = (
    Parameter('bandwidth', 0.0, 'Hz', 'Bandwidth of the model; 0: no model', 0.0, 1e4),
    Parameter('lag_frequency', 18.9, 'Hz', 'Corner of the lag of the actuator', 0.1, 1e4,
              source='valve_flexure.coil_frequency'),
    Parameter('drive', 1200.0, 'N', 'Largest drive of the model', 1.0, 1e5,
              source='valve_hysteresis.saturation'),
    Parameter('delay', 0.002, 's', 'Delay of the actuator, as the time constant of a lag',
              0.0, 0.1, source='assumed'),
    Parameter('lead_time', 0.0, 's', 'Time by which the reference is extrapolated', 0.0, 0.1),
    Parameter('slope', 2e4, 'N/s', 'Largest slope that is extrapolated: more is a jump', 0.0, 1e9,
              source='100 N at 32 Hz'),
)


@jit
def extrapolated(reference, before, lead_time, slope, period):
    """Return a reference (N) that was `before` (N) a control period (s) ago, a time (s) ahead."""
    rate = (reference - before) / period
    return reference + lead_time * rate if abs(rate) <= slope else reference


def model_ratio(bandwidth: float, lag_frequency: float, period: float) -> float:
    """
    Return the gain of the model from force error to drive; corners in Hz, control period in s.

    Discretised exactly: after a period, the force error is that of a loop with this bandwidth. The
    ratio of the corners would overshoot: with 325 Hz at 1 kHz the step is nearly twice as large.
    """
    return (math.expm1(-2.0 * math.pi * bandwidth * period)
            / math.expm1(-2.0 * math.pi * lag_frequency * period))


@jit
def model_drive(force, reference, ratio, drive):
    """Return the drive (N) of the model at a force and a desired force (N); see model_ratio."""
    wanted = force + ratio * (reference - force)
    return min(max(wanted, -drive), drive)


@jit
def approach(value, goal, rate, period):
    """Return a lag of `rate` (1/s) after a control period (s)."""
    return goal + (value - goal) * math.exp(-rate * period)
