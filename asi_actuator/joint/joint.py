"""
The joint: drive, mechanics and sensors, joined.

    load.mass a = force of the drive - damping v - friction - stiffness (q - rest)
                  - gravity.sine sin q - gravity.cosine cos q - offset - ripple + push from outside

`step` serves the node, `simulate` whole runs; both are the same compiled code. The command path,
friction, coupling and backlash are the blocks of the actuator.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from asi_actuator.joint.drive import DriveStep, drive, drive_step, wanted
from asi_actuator.joint.mechanics import mechanics
from asi_actuator.joint.sensors import SensorsStep, readings, sense, sensors_step
from asi_actuator.joint_parameters import check_delay
from asi_actuator.model.actuator import check_period
from asi_actuator.model.backlash import two_masses
from asi_actuator.model.command_path import CommandDelay, arrived, command_delay, sent
from asi_actuator.model.friction import SEALS_SHAPE
from asi_actuator.parameters import RING
from asi_common.jit import jit

STATE_DTYPE = np.dtype([
    ('time', np.float64),               # s
    ('sample', np.int64),               # ticks so far
    ('command_ring', np.float64, (RING,)),
    ('drive_first', np.float64),        # after the first lag of the drive
    ('drive_asked', np.float64),        # after both
    ('integral', np.float64),           # N, of the servo
    ('push', np.float64),               # N, force of the drive over the last sub-step
    ('position', np.float64),           # m, of the motor
    ('velocity', np.float64),           # m/s
    ('velocity_change', np.float64),    # m/s, over the last sub-step
    ('seals', np.float64, SEALS_SHAPE),  # m, deflections of what rubs
    ('friction_force', np.float64),     # N
    ('load_position', np.float64),      # m, of a load that is not rigidly coupled
    ('load_velocity', np.float64),      # m/s
    ('sensed_force', np.float64),       # N
    ('sensed_position', np.float64),    # m
])


class Trajectory(NamedTuple):
    """A simulated run: arrays of n samples; the command holds from its sample to the next."""

    time_s: npt.NDArray[np.float64]
    command: npt.NDArray[np.float64]
    force: npt.NDArray[np.float64]
    position: npt.NDArray[np.float64]
    velocity: npt.NDArray[np.float64]


class Steady(NamedTuple):
    """What is the same in every sub-step: their number and length (s), then block by block."""

    substeps: int
    h: float
    apart: bool
    command: CommandDelay
    drive: DriveStep
    sensors: SensorsStep


def rest(p: np.void) -> np.void:
    """Return the state of a joint at rest at its start, its drive at no command."""
    state = np.zeros(1, STATE_DTYPE)[0]
    for name in ('position', 'load_position', 'sensed_position'):
        state[name] = p['load_start']
    if p['backlash_gap'] > 0.0:
        state['load_position'] -= p['backlash_centre']
    state['drive_first'] = state['drive_asked'] = wanted(0.0, p)
    if p['servo_kp'] > 0.0:   # a servo holds where it stands until its first command
        asked = p['load_start']
        state['drive_first'] = state['drive_asked'] = asked
        state['command_ring'][:] = ((asked - p['drive_bias']) / p['drive_gain']
                                    if p['drive_gain'] else 0.0)
    return state


@jit
def prepare(p, period):
    """Return what is the same in every sub-step of control periods of `period` s."""
    count = max(1, math.ceil(period / p.maximum_substep * (1.0 - 1e-12)))
    h = period / count
    return Steady(count, h, two_masses(p), command_delay(p.command_path_delay, period, h),
                  drive_step(p, h), sensors_step(p, h))


@jit
def advance(state, command, p, steady):
    """Advance `state` by one control period at a constant command, in place."""
    limited = sent(state, command, p)
    delayed = p.command_path_delay > 0.0
    for number in range(steady.substeps):
        now = arrived(state, number, steady.command) if delayed else limited
        push_before, position_before = state.push, state.position
        push = drive(state, now, p, steady.drive, steady.h)
        mechanics(state, push, steady.apart, p, steady.h)
        state.time += steady.h
        sense(state, push_before, position_before, steady.sensors)
    state.sample += 1


@jit
def step(state, command, p, period):
    """
    Advance `state` by one control period (s) at a constant command, in place.

    state: record of STATE_DTYPE; p: record of JOINT_DTYPE.
    """
    advance(state, command, p, prepare(p, period))


@jit
def measure(state, p):
    """Return force, 0 (a joint has no valve), position and velocity as they are sensed."""
    force, position, velocity = readings(state, p)
    return force, 0.0, position, velocity


@jit
def _simulate(state, commands, p, period, out):
    steady = prepare(p, period)
    for k in range(commands.size):
        out[0, k], _, out[1, k], out[2, k] = measure(state, p)
        advance(state, commands[k], p, steady)


def simulate(p: np.void, commands: npt.ArrayLike, period_s: float,
             state: np.void | None = None) -> Trajectory:
    """
    Return the run of a sequence of commands.

    p: record of JOINT_DTYPE; commands: n forces or, of a servo, positions, each held for
    `period_s` s; state: where to begin (advanced in place), at rest if not given. Sample k is
    measured before command k acts. Raises ParameterError for a period that is too short.
    """
    check_period(period_s)
    check_delay({'command_path.delay': float(p['command_path_delay'])}, period_s)
    commands = np.ascontiguousarray(commands, np.float64)
    out = np.empty((3, commands.size))
    _simulate(rest(p) if state is None else state, commands, p, period_s, out)
    time_s = np.arange(commands.size, dtype=np.float64) * period_s
    return Trajectory(time_s, commands, *out)
