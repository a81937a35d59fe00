"""
Sensors of the joint: the force between drive and joint, position and velocity of the motor.

Offset, gain and drift are added at the reading; lags move with the sub-steps.
"""

import math
from typing import NamedTuple

from asi_actuator.model.chance import normal
from asi_actuator.model.force_sensor import reading
from asi_actuator.model.linear_lag import FirstOrder, first_order_or_none
from asi_common.jit import inlined, jit

# Added to the seed, so that the noises of the sensors are independent.
POSITION_SEED, VELOCITY_SEED = 2**32, 2**33


class SensorsStep(NamedTuple):
    """What is the same in every sub-step."""

    force: FirstOrder
    position: FirstOrder


@jit
def sensors_step(p, h):
    """Return what is the same in every sub-step of `h` s."""
    return SensorsStep(first_order_or_none(p.force_sensor_lag_time, h),
                       first_order_or_none(p.position_sensor_lag_time, h))


@inlined
def sense(state, push_before, position_before, steady):
    """Move the lags of the sensors on by a sub-step."""
    state.sensed_force = (steady.force.keep * state.sensed_force + steady.force.old * push_before
                          + steady.force.new * state.push)
    state.sensed_position = (steady.position.keep * state.sensed_position
                             + steady.position.old * position_before
                             + steady.position.new * state.position)


@jit
def readings(state, p):
    """Return force, position and velocity as they are measured."""
    seed = int(p.force_sensor_noise_seed)
    position = (p.position_sensor_gain * state.sensed_position + p.position_sensor_offset
                + p.position_sensor_drift * state.time)
    if p.position_sensor_noise > 0.0:
        position += p.position_sensor_noise * normal(seed + POSITION_SEED, state.sample)
    if p.position_sensor_resolution > 0.0:
        position = p.position_sensor_resolution * math.floor(
            position / p.position_sensor_resolution + 0.5)
    velocity = state.velocity
    if p.velocity_sensor_noise > 0.0:
        velocity += p.velocity_sensor_noise * normal(seed + VELOCITY_SEED, state.sample)
    return reading(state.sensed_force, state.sample, state.time, p), position, velocity
