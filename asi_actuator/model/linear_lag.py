"""
Linear lags of first and second order: how far they go in a sub-step, worked out once a step.

Each is second order in the sub-step and stable for any.
"""

import math
from typing import NamedTuple

from asi_common.jit import jit


class FirstOrder(NamedTuple):
    """Output after a sub-step = keep * output + old * input before + new * input after."""

    keep: float
    old: float
    new: float


class SecondOrder(NamedTuple):
    """Rate after = keep * rate + pull * (mean input - output); output by the mean rate."""

    keep: float
    pull: float
    half_step: float


@jit
def first_order(frequency_hz, h):
    """Return the lag of a corner frequency, exact for an input that is linear in a sub-step."""
    x = 2.0 * math.pi * frequency_hz * h
    lost = -math.expm1(-x)
    mean = lost / x
    return FirstOrder(1.0 - lost, mean - (1.0 - lost), 1.0 - mean)


@jit
def first_order_or_none(time_s, h):
    """Return the lag of a time constant (s); none if it is 0."""
    if time_s == 0.0:
        return FirstOrder(0.0, 0.0, 1.0)
    return first_order(0.5 / (math.pi * time_s), h)


@jit
def second_order(frequency_hz, damping_ratio, h):
    """Return the lag of a natural frequency and damping ratio, by the trapezoidal rule."""
    half = 0.5 * h
    w = 2.0 * math.pi * frequency_hz
    damp = 2.0 * damping_ratio * w * half
    stiff = w * w * half * half
    whole = 1.0 + damp + stiff
    return SecondOrder((1.0 - damp - stiff) / whole, 2.0 * w * w * half / whole, half)


@jit
def second_order_step(output, rate, mean_input, lag):
    """Return output and rate (1/s) of a second-order lag of gain 1 after a sub-step."""
    after = lag.keep * rate + lag.pull * (mean_input - output)
    return output + lag.half_step * (rate + after), after
