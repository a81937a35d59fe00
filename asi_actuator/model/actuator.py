"""
The actuator: the blocks of the paper's Fig. 2, joined.

`step` serves the node, `simulate` whole runs; both are the same compiled code. Every block is
second order in the sub-step, which is fixed, and stable for any.
"""

import math
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from asi_actuator.model.backlash import two_masses
from asi_actuator.model.command_path import (
    CommandDelay,
    arrived,
    command_delay,
    delay_now,
    sent,
)
from asi_actuator.model.fluid_dynamics import fluid_dynamics, fluid_gain, leaking, leaks
from asi_actuator.model.force_sensor import (
    SensorStep,
    force_sensor,
    held_reading,
    keep_reading,
    sensor_step,
)
from asi_actuator.model.friction import SEALS_SHAPE, friction
from asi_actuator.model.hydraulic_damping import hydraulic_damping
from asi_actuator.model.linear_lag import FirstOrder
from asi_actuator.model.load import PRESCRIBED, felt_force, is_linear, load, prescribed_velocity
from asi_actuator.model.valve_characteristic import (
    sagged,
    supplied,
    valve_characteristic,
    valve_opening,
    valve_position,
)
from asi_actuator.model.valve_flexure import (
    FlexureStep,
    deflected,
    flexure_gain,
    flexure_step,
    valve_flexure,
)
from asi_actuator.model.valve_hysteresis import (
    AT_ONCE,
    FURTHER,
    MagnetStep,
    magnet_step,
    magnetise,
)
from asi_actuator.parameters import RING
from asi_common.jit import FULL, inlined, jit
from asi_common.parameter import ParameterError

# The longest delay, 0.01 s, is RING - 2 sub-steps of 9.8 us.
SHORTEST_PERIOD_S: Final = 1e-5

STATE_DTYPE = np.dtype([
    ('time', np.float64),               # s
    ('sample', np.int64),               # ticks so far
    ('command_filtered', np.float64),   # N, the rate filter of the hysteresis
    ('flux', np.float64),               # N, memory of the hysteresis
    ('rounding_plays', np.float64, (FURTHER,)),  # N, of a loop with rounded corners
    ('further_plays', np.float64, (FURTHER,)),  # N, of a loop that widens with the amplitude
    ('plays_flux', np.float64),         # N, of all plays, before the lag of the flux
    ('lagged_flux', np.float64),        # N, behind it
    ('drive', np.float64),              # N, output of the hysteresis
    ('coil', np.float64),               # N
    ('flexure', np.float64),            # N
    ('flexure_rate', np.float64),       # N/s
    ('valve_position', np.float64),     # m
    ('static_force', np.float64),       # N, that the valve opening gives at rest
    ('hydraulic_force', np.float64),    # N
    ('damping_force', np.float64),      # N
    ('position', np.float64),           # m, of the piston
    ('velocity', np.float64),           # m/s, of the piston
    ('velocity_change', np.float64),    # m/s, over the last sub-step
    ('seals', np.float64, SEALS_SHAPE),  # m, deflections of the seals
    ('friction_force', np.float64),     # N
    ('felt_force', np.float64),         # N, where the force sensor is
    ('sensor', np.float64),             # N
    ('sensor_rate', np.float64),        # N/s
    ('card', np.float64),               # N, after the card's filter
    ('card_rate', np.float64),          # N/s
    ('sensed', np.float64),             # N, after the sensor's delay
    ('ring_index', np.int64),
    ('lagged_drive', np.float64),       # N, after the further lag of the valve
    ('twice_lagged_drive', np.float64),  # N, after one more
    ('supply_load', np.float64),        # mean size of the opening that the supply has seen
    ('load_position', np.float64),      # m, of a load that is not rigidly coupled
    ('load_velocity', np.float64),      # m/s
    ('sensor_input', np.float64),       # N, of the further lag of the sensor
    ('sensor_lagged', np.float64),      # N, after it, before one more
    ('kept_reading', np.float64),       # N, the last reading that was not lost
    ('command_ring', np.float64, (RING,)),
    ('flexure_ring', np.float64, (RING,)),
    ('sensor_ring', np.float64, (RING,)),
])


# Sensor readings: force N, valve position m, piston position m and velocity m/s.
Measurement = tuple[float, float, float, float]


class Trajectory(NamedTuple):
    """A simulated run: arrays of n samples; the command holds from its sample to the next."""

    time_s: npt.NDArray[np.float64]
    command_n: npt.NDArray[np.float64]
    force_n: npt.NDArray[np.float64]
    valve_position_m: npt.NDArray[np.float64]
    position_m: npt.NDArray[np.float64]
    velocity_m_s: npt.NDArray[np.float64]


def rest() -> np.void:
    """Return the state of the actuator at rest, unloaded."""
    return np.zeros(1, STATE_DTYPE)[0]


class Steady(NamedTuple):
    """What is the same in every sub-step: their number and length (s), then block by block."""

    substeps: int
    h: float
    leaks: bool
    apart: bool
    linear: bool
    half_magnet: MagnetStep
    command: CommandDelay
    supply_keep: float
    flexure: FlexureStep
    fluid: FirstOrder
    sensor: SensorStep


@jit
def prepare(p, period):
    """
    Return what is the same in every sub-step of control periods of `period` s.

    The period is cut into the fewest equal sub-steps that are not longer than p.maximum_substep.
    """
    count = max(1, math.ceil(period / p.maximum_substep * (1.0 - 1e-12)))
    h = period / count
    return Steady(count, h, leaks(p), two_masses(p), is_linear(p), magnet_step(p, 0.5 * h),
                  command_delay(p.command_path_delay, period, h),
                  math.exp(-h / p.valve_characteristic_supply_time), flexure_step(p, h),
                  fluid_dynamics(p, h), sensor_step(p, h))


@jit
def valve_jump(state, command, p):
    """Let the magnetic circuit jump to a new command (N), and a valve without dynamics too."""
    magnetise(state, command, p, AT_ONCE)
    if (p.valve_flexure_model != FULL and p.valve_flexure_deadband == 0.0
            and p.valve_flexure_lag_time == 0.0 and p.valve_flexure_second_lag_time == 0.0):
        state.valve_position = valve_position(deflected(flexure_gain(p) * state.drive, p), p)


@jit
def jump(state, command, p):
    """
    Let everything jump that a new command or a prescribed motion moves at once.

    So that the first sub-step begins with the values just after, and stays second order.
    """
    valve_jump(state, command, p)
    motion_jump(state, p)


@jit
def motion_jump(state, p):
    """Let all behind the valve jump to the position (m) to which the valve has jumped."""
    state.static_force = valve_characteristic(state.valve_position, p)
    if p.valve_characteristic_supply_sag > 0.0:
        state.static_force = sagged(state.static_force, state.supply_load, p)
    if p.load_type == PRESCRIBED:
        state.velocity = prescribed_velocity(state.time, p)
    state.friction_force = friction(state.seals, state.velocity, state.velocity, p, 0.0).force
    state.damping_force = hydraulic_damping(
        state.velocity, valve_opening(state.valve_position, p), p)
    if p.fluid_dynamics_model != FULL and p.fluid_dynamics_air_time == 0.0:
        gain = leaking(state.hydraulic_force, p, 0.0).new if leaks(p) else fluid_gain(p)
        state.hydraulic_force = gain * (state.static_force - state.damping_force)
    state.felt_force = felt_force(state, two_masses(p), p)


@inlined
def valve_substep(state, command, p, steady):
    """Advance the valve by a sub-step at a constant valve command (N)."""
    # The drive bends too much within a sub-step for a straight line: its mean by Simpson's rule.
    drive_before = state.drive
    drive_middle = magnetise(state, command, p, steady.half_magnet)
    drive_after = magnetise(state, command, p, steady.half_magnet)
    drive_mean = (drive_before + 4.0 * drive_middle + drive_after) / 6.0

    state.ring_index = (state.ring_index + 1) & (RING - 1)
    deflection = valve_flexure(state, drive_mean, drive_after, p, steady.flexure)
    state.valve_position = valve_position(deflection, p)


@inlined
def substep(state, command, p, steady):
    """Advance `state` by a sub-step at a constant valve command (N)."""
    valve_substep(state, command, p, steady)
    felt_before = state.felt_force
    motion_substep(state, p, steady)
    state.sensed = force_sensor(state, felt_before, state.felt_force, p, steady.sensor)


@inlined
def motion_substep(state, p, steady):
    """Advance all between valve and force sensor by a sub-step to the valve's position (m)."""
    static_before = state.static_force
    state.static_force = valve_characteristic(state.valve_position, p)
    opening = valve_opening(state.valve_position, p)
    if p.valve_characteristic_supply_sag > 0.0:
        state.static_force = supplied(state, state.static_force, opening, steady.supply_keep, p)

    load(state, static_before, opening, steady, p)
    state.time += steady.h
    state.felt_force = felt_force(state, steady.apart, p)


@jit
def advance(state, command, p, steady):
    """Advance `state` by one control period at a constant valve command (N), in place."""
    limited = sent(state, command, p)
    delayed = p.command_path_delay > 0.0
    delay = delay_now(state, p, steady)
    jump(state, arrived(state, 0, delay) if delayed else limited, p)
    for number in range(steady.substeps):
        substep(state, arrived(state, number, delay) if delayed else limited, p, steady)
    state.sample += 1
    if p.force_sensor_drop_rate > 0.0:
        keep_reading(state, p)


@inlined
def advance_valve(state, command, p, steady, positions):
    """
    Advance the valve alone by one control period at a constant valve command (N), in place.

    positions: is filled with its positions, m: after the jump, and after each sub-step.
    """
    limited = sent(state, command, p)
    delayed = p.command_path_delay > 0.0
    delay = delay_now(state, p, steady)
    valve_jump(state, arrived(state, 0, delay) if delayed else limited, p)
    positions[0] = state.valve_position
    for number in range(steady.substeps):
        valve_substep(state, arrived(state, number, delay) if delayed else limited, p, steady)
        positions[number + 1] = state.valve_position
    state.sample += 1


@inlined
def advance_motion(state, positions, felt, p, steady):
    """
    Advance all between a valve with these `positions` (see advance_valve) and the force sensor.

    By one period. felt: is filled with the force (N) where the sensor is, as positions are.
    """
    state.valve_position = positions[0]
    motion_jump(state, p)
    felt[0] = state.felt_force
    for number in range(steady.substeps):
        state.valve_position = positions[number + 1]
        motion_substep(state, p, steady)
        felt[number + 1] = state.felt_force
    state.sample += 1


@inlined
def advance_sensor(state, felt, p, steady):
    """Advance the force sensor alone by one period; felt: see advance_motion."""
    for number in range(steady.substeps):
        state.ring_index = (state.ring_index + 1) & (RING - 1)
        state.time += steady.h
        state.sensed = force_sensor(state, felt[number], felt[number + 1], p, steady.sensor)
    state.sample += 1


@jit
def step(state, command, p, period):
    """
    Advance `state` by one control period (s) at a constant valve command (N), in place.

    state: record of STATE_DTYPE; p: record of ACTUATOR_DTYPE.
    """
    advance(state, command, p, prepare(p, period))


@jit
def measure(state, p):
    """Return (force N, valve position m, piston position m, velocity m/s) as they are sensed."""
    return (held_reading(state, p), state.valve_position, state.position,
            state.velocity)


@jit
def _simulate(state, commands, p, period, out):
    steady = prepare(p, period)
    for k in range(commands.size):
        out[0, k], out[1, k], out[2, k], out[3, k] = measure(state, p)
        advance(state, commands[k], p, steady)


def check_period(period_s: float) -> None:
    """Raise ParameterError if a control period (s) is so short that the delays do not fit it."""
    if not SHORTEST_PERIOD_S <= period_s < math.inf:
        rate_hz = 1.0 / period_s if period_s else math.inf
        raise ParameterError(f'a control period of {period_s:g} s is not allowed (a rate of '
                             f'{rate_hz:g} Hz): it takes at least {SHORTEST_PERIOD_S:g} s')


def simulate(p: np.void, commands: npt.ArrayLike, period_s: float,
             state: np.void | None = None) -> Trajectory:
    """
    Return the run of a sequence of valve commands.

    p: record of ACTUATOR_DTYPE; commands: n valve commands, N, each held for `period_s` s;
    state: where to begin (advanced in place), at rest if not given. Sample k is measured before
    command k acts. Raises ParameterError for a period that is too short.
    """
    check_period(period_s)
    commands = np.ascontiguousarray(commands, np.float64)
    out = np.empty((4, commands.size))
    _simulate(rest() if state is None else state, commands, p, period_s, out)
    time_s = np.arange(commands.size, dtype=np.float64) * period_s
    return Trajectory(time_s, commands, *out)
