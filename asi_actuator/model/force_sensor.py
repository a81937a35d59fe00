"""
Force sensor: a flexure on the cylinder with a Hall-effect transducer (paper, section 2.1).

A resonance, the filter of the analogue card that conditions the signal, and the second of the two
delays; then gain, offset and noise ("this force sensor is a non-zero sensor, thus calibration is
required"). Null by default: two further lags, a drift of the offset, and lost readings.
"""

import math
from typing import Final, NamedTuple

from asi_actuator.model.chance import LOST, normal, uniform
from asi_actuator.model.delay import DelaySteps, delay, delay_steps
from asi_actuator.model.linear_lag import (
    FirstOrder,
    SecondOrder,
    first_order_or_none,
    second_order,
    second_order_step,
)
from asi_common.jit import FULL, LINEAR, jit

CARD_DAMPING: Final = math.sqrt(0.5)


class SensorStep(NamedTuple):
    """What is the same in every sub-step."""

    flexure: SecondOrder
    card: SecondOrder
    delay: DelaySteps
    lag: FirstOrder
    second_lag: FirstOrder


@jit
def sensor_step(p, h):
    """Return what is the same in every sub-step of `h` s."""
    return SensorStep(
        second_order(p.force_sensor_natural_frequency, p.force_sensor_damping_ratio, h),
        second_order(p.force_sensor_card_frequency, CARD_DAMPING, h),
        delay_steps(p.force_sensor_delay, h), first_order_or_none(p.force_sensor_lag_time, h),
        first_order_or_none(p.force_sensor_second_lag_time, h))


@jit
def force_sensor(state, force_before, force_after, p, steady):
    """Return the sensed force (N) after a sub-step, before gain, offset and noise."""
    conditioned = _conditioned(state, force_before, force_after, p, steady)
    if p.force_sensor_lag_time == 0.0 and p.force_sensor_second_lag_time == 0.0:
        # Where lags that are switched on begin.
        state.sensor_input = state.sensor_lagged = conditioned
        return conditioned
    # `sensor_input` and `sensor_lagged` are what the two lags were given last.
    first = _lagged(state.sensor_lagged, state.sensor_input, conditioned, steady.lag)
    second = _lagged(state.sensed, state.sensor_lagged, first, steady.second_lag)
    state.sensor_input, state.sensor_lagged = conditioned, first
    return second


@jit
def _lagged(output, before, after, lag):
    """Return the output of a lag after a sub-step; before, after: its input."""
    return lag.keep * output + lag.old * before + lag.new * after


@jit
def _conditioned(state, force_before, force_after, p, steady):
    """Return the force (N) after flexure, card and delay."""
    if p.force_sensor_model != FULL:
        gain = p.force_sensor_linear_gain if p.force_sensor_model == LINEAR else 1.0
        return gain * force_after
    sensor_before = state.sensor
    state.sensor, state.sensor_rate = second_order_step(
        state.sensor, state.sensor_rate, 0.5 * (force_before + force_after), steady.flexure)
    state.card, state.card_rate = second_order_step(
        state.card, state.card_rate, 0.5 * (sensor_before + state.sensor), steady.card)
    return delay(state.sensor_ring, state.ring_index, state.card, steady.delay)


@jit
def reading(force, sample, time_s, p):
    """
    Return what the sensor reads (N) of a sensed force (N).

    sample: number of the reading; time_s: its time, s.
    """
    noise = 0.0
    if p.force_sensor_noise > 0.0:
        noise = p.force_sensor_noise * normal(int(p.force_sensor_noise_seed), sample)
    wander = 0.0
    if p.force_sensor_drift != 0.0 or p.force_sensor_drift_curve != 0.0:
        wander = time_s * (p.force_sensor_drift + time_s * p.force_sensor_drift_curve)
    return p.force_sensor_gain * force + (p.force_sensor_offset + wander) + noise


@jit
def keep_reading(state, p):
    """Take note of the newest reading that was not lost, for `held_reading`."""
    if uniform(int(p.force_sensor_noise_seed), state.sample, LOST) >= p.force_sensor_drop_rate:
        state.kept_reading = reading(state.sensed, state.sample, state.time, p)


@jit
def held_reading(state, p):
    """Return what the sensor reads now (N): if readings are lost, the last that was not."""
    if p.force_sensor_drop_rate > 0.0:
        return state.kept_reading
    return reading(state.sensed, state.sample, state.time, p)
