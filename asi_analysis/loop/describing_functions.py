"""
Describing functions N(A, f, bias): fundamental of the output over that of a sinusoidal input.

Each is computed with the block function of the model: the memory is settled at every amplitude
before the output is projected (Gelb and Vander Velde, Multiple-Input Describing Functions, 1968).
The tests compare with closed forms where they are known.
"""

import math
from typing import Final

import numpy as np

from asi_actuator.model.actuator import rest
from asi_actuator.model.friction import SEALS_SHAPE, friction, settle
from asi_actuator.model.hydraulic_damping import hydraulic_damping
from asi_actuator.model.valve_characteristic import valve_characteristic
from asi_actuator.model.valve_hysteresis import circuit, magnet_step
from asi_common.jit import jit
from asi_controller.additions.hysteresis_inverse import follow

# Samples a period (the error is of second order), and periods until the memory has settled.
SAMPLES: Final = 1440
SETTLING: Final = 3


@jit
def _hysteresis(state, amplitude, frequency, limit, samples, p, size, dead_zone):
    step = 1.0 / (frequency * samples)
    decay, lag_of_flux = magnet_step(p, step)
    # Exact lag of the rate filter for a piecewise linear command.
    lag = (1.0 - decay) / (2.0 * math.pi * p.valve_hysteresis_rate_filter * step)
    half = samples // 2
    before = min(max(amplitude * math.sin(-2.0 * math.pi / samples), -limit), limit)
    centre = max(min(dead_zone - min(amplitude, limit), 0.0), before - dead_zone)
    before += size * (before - centre) / dead_zone
    total = 0.0 + 0.0j
    # The block is odd, so half a period determines the other. The first half yields the periodic
    # state of the filter, the second settles the plays, a third yields the periodic state of the
    # flux's lag where there is one, the last is projected.
    last = 3 * half if p.valve_hysteresis_lagged > 0.0 else 2 * half
    for k in range(last + half):
        if k == half:
            state.command_filtered /= 1.0 + decay ** half
        if k == 2 * half:
            state.lagged_flux = 0.0
        if k == last:
            state.lagged_flux /= 1.0 + lag_of_flux.keep ** half
        angle = 2.0 * math.pi * k / samples
        sine = math.sin(angle)
        command = min(max(amplitude * sine, -limit), limit)
        centre = follow(centre, command, dead_zone)
        command += size * (command - centre) / dead_zone
        state.command_filtered = (
            command - lag * (command - before) + (state.command_filtered - before) * decay)
        before = command
        if k >= half:
            drive = circuit(state, command, p, lag_of_flux)
            if k >= last:
                total += drive * complex(sine, math.cos(angle))
    return total * 2.0 / (half * amplitude)


def hysteresis(amplitude_n: float, frequency_hz: float, p: np.void, limit_n: float = math.inf,
               samples: int = SAMPLES, inverse: tuple[float, float] = (0.0, 1.0)) -> complex:
    """
    Return N of the magnetic circuit (N/N) for a command A sin, limited to ± limit.

    In continuous time. Play, rate filter and saturation have no common closed form: the block
    function is run with `samples`, an even number, a period. inverse: size and dead zone (N) of
    the controller's hysteresis inverse before it.
    """
    return complex(_hysteresis(rest(), amplitude_n, frequency_hz, limit_n, samples, p, *inverse))


@jit
def characteristic(amplitude, bias, p):
    """Return N of the valve characteristic (N/m), real, for a valve position bias + A sin (m)."""
    total = 0.0
    for k in range(SAMPLES):
        wave = math.sin(2.0 * math.pi * (k + 0.5) / SAMPLES)
        total += valve_characteristic(bias + amplitude * wave, p) * wave
    return total * 2.0 / (SAMPLES * amplitude)


@jit
def damping(amplitude, opening, p):
    """Return N of the hydraulic damping (N s/m), real, for a velocity A sin at a valve opening."""
    total = 0.0
    for k in range(SAMPLES):
        wave = math.sin(2.0 * math.pi * (k + 0.5) / SAMPLES)
        total += hydraulic_damping(amplitude * wave, opening, p) * wave
    return total * 2.0 / (SAMPLES * amplitude)


@jit
def seal_friction(amplitude, frequency, p):
    """Return N of the friction (N s/m) for a velocity A sin (m/s) of a frequency (Hz)."""
    step = 1.0 / (frequency * SAMPLES)
    seals, before, total = np.zeros(SEALS_SHAPE), 0.0, 0.0 + 0.0j
    for k in range((SETTLING + 1) * SAMPLES):
        angle = 2.0 * math.pi * k / SAMPLES
        velocity = amplitude * math.sin(angle)
        force = friction(seals, 0.5 * (before + velocity), velocity, p, step).force
        settle(seals, 0.0, p)
        before = velocity
        if k >= SETTLING * SAMPLES:
            total += force * complex(math.sin(angle), math.cos(angle))
    return total * 2.0 / (SAMPLES * amplitude)


def saturation_closed_form(amplitude: float, limit: float, bias: float = 0.0) -> float:
    """Return N of a unit slope that saturates at ± limit, for bias + A sin."""
    def share(x: float) -> float:
        x = min(max(x, -1.0), 1.0)
        return (math.asin(x) + x * math.sqrt(1.0 - x * x)) / math.pi
    return share((limit - bias) / amplitude) + share((limit + bias) / amplitude)
