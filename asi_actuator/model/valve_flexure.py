"""
Valve flexure: the coil and the flexure pipe that it bends (paper, section 2.2).

A first-order lag (coil and drive), a resonance (flexure), and the first of the two delays.
"""

import math
from typing import NamedTuple

from asi_actuator.model.delay import DelaySteps, delay, delay_steps
from asi_actuator.model.linear_lag import SecondOrder, second_order, second_order_step
from asi_common.jit import FULL, LINEAR, jit


class FlexureStep(NamedTuple):
    """What is the same in every sub-step."""

    coil_decay: float
    pipe: SecondOrder
    delay: DelaySteps


@jit
def flexure_step(p, h):
    """Return what is the same in every sub-step of `h` s."""
    return FlexureStep(
        math.exp(-2.0 * math.pi * p.valve_flexure_coil_frequency * h),
        second_order(p.valve_flexure_natural_frequency, p.valve_flexure_damping_ratio, h),
        delay_steps(p.valve_flexure_delay, h))


@jit
def flexure_gain(p):
    """Return the gain (N/N) of the flexure when it has no dynamics."""
    return p.valve_flexure_linear_gain if p.valve_flexure_model == LINEAR else 1.0


@jit
def valve_flexure(state, drive_mean, drive_after, p, steady):
    """
    Return the flexure's deflection, as the force (N) that bends it; updates coil and pipe.

    drive_mean, drive_after: drive (N), over the sub-step and at its end.
    """
    if p.valve_flexure_model != FULL:
        return flexure_gain(p) * drive_after
    coil = drive_mean + (state.coil - drive_mean) * steady.coil_decay
    state.flexure, state.flexure_rate = second_order_step(
        state.flexure, state.flexure_rate, 0.5 * (state.coil + coil), steady.pipe)
    state.coil = coil
    return delay(state.flexure_ring, state.ring_index, state.flexure, steady.delay)
