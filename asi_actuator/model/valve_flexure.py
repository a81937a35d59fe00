"""
Valve flexure: the coil and the flexure pipe that it bends (paper, section 2.2).

A first-order lag (coil and drive), a resonance (flexure), and the first of the two delays.
Integrated by the trapezoidal rule: second order, stable for any step.
"""

import math

from asi_actuator.model.jit import FULL, LINEAR, jit


@jit
def coil(force, drive_before, drive_after, p, h):
    """Return the coil's force (N) after a sub-step of `h` s, from the drive (N) at both ends."""
    a = math.pi * p.valve_flexure_coil_frequency * h
    return ((1.0 - a) * force + a * (drive_before + drive_after)) / (1.0 + a)


@jit
def second_order(y, dy, u_before, u_after, frequency_hz, damping_ratio, h):
    """
    Return output and its rate of a unit-gain second-order lag after a sub-step of `h` s.

    y, dy: output (unit of u) and its rate (that per s); u: input at both ends of the sub-step.
    """
    w = 2.0 * math.pi * frequency_hz
    b = 0.5 * h
    damp = 2.0 * damping_ratio * w
    # Trapezoidal rule, solved for the new rate; then the output follows from it.
    right = dy + b * (w * w * (u_before + u_after - 2.0 * y - b * dy) - damp * dy)
    dy_after = right / (1.0 + b * damp + b * b * w * w)
    return y + b * (dy + dy_after), dy_after


@jit
def valve_flexure(state, drive_before, drive_after, p, h):
    """Return the flexure's deflection, as the force (N) that bends it; updates coil and pipe."""
    if p.valve_flexure_model != FULL:
        gain = p.valve_flexure_linear_gain if p.valve_flexure_model == LINEAR else 1.0
        return gain * drive_after
    coil_after = coil(state.coil, drive_before, drive_after, p, h)
    state.flexure, state.flexure_rate = second_order(
        state.flexure, state.flexure_rate, state.coil, coil_after,
        p.valve_flexure_natural_frequency, p.valve_flexure_damping_ratio, h)
    state.coil = coil_after
    return state.flexure
