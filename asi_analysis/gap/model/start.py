"""
The initial state of a recording: at rest, or in motion.

Most of it is measured. The rest (flux of the magnetic circuit, deflection of the seals) and the
measurement errors of position and velocity are free in every fit, for each recording.
"""

import math
from collections.abc import Sequence

import numpy as np

from asi_actuator.model.actuator import STATE_DTYPE
from asi_actuator.model.friction import (
    BEHIND_SENSOR,
    deflected_seals,
    friction,
    largest_deflection,
)
from asi_actuator.parameters import ACTUATOR_DTYPE
from asi_analysis.arrays import Array
from asi_analysis.gap.model.effects import Free, of_recording
from asi_analysis.gap.parts import BURN_IN_S
from asi_analysis.gap.prepare import START_S, Recording
from asi_common.jit import FULL, LINEAR
from asi_common.record import with_fields

# Flux as a share of the hysteresis's half width, seal's deflection as a share of its largest, what
# the supply has seen beyond the mean size of the opening; m; m/s.
FLUX, SEAL, SUPPLY, POSITION, VELOCITY = START_FIELDS = (
    'start_flux', 'start_seal', 'start_supply', 'start_position', 'start_velocity')
MEMORIES = (FLUX, SEAL)
SPREAD = 'command_path_delay_spread'
# As shares of the measured range: the bounds of position and velocity, and the standard deviation
# of their initial values from a line through the first samples.
WIDE, MISSED = 3.0, 0.3


def with_start_fields(p: np.void, recordings: Sequence[Recording]) -> np.void:
    """Return a record with the fields of the initial state, if a recording begins in motion."""
    if all(recording.at_rest for recording in recordings):
        return p
    return with_fields(p, START_FIELDS)


def start_parameters(p: np.void, recordings: Sequence[Recording], channels: Sequence[str]
                     ) -> list[Free]:
    """Return the free initial states of the recordings that begin in motion."""
    found: list[Free] = []
    for recording in recordings:
        if recording.at_rest or not recording.fit.any():
            continue
        own = []
        if ('valve' in channels or recording.valve_position is None) and (
                p['valve_hysteresis_model'] == FULL):
            own.append(Free(FLUX, -1.0, 1.0, (0.0,)))
        if 'force' in channels:
            own += [Free(SEAL, -1.0, 1.0, (0.0,))] if p['friction_model'] == FULL else []
            own.append(Free(SUPPLY, -1.0, 1.0, (0.0,)))
            motion = recording.motion
            if motion is not None:
                known = MISSED if motion.measured else math.inf
                own += [Free(POSITION, -WIDE, WIDE, (0.0,), 'position', prior=known),
                        Free(VELOCITY, -WIDE, WIDE, (0.0,), 'velocity', prior=MISSED)]
        found += [free._replace(field=of_recording(free.field, recording.number)) for free in own]
    return found


def _fitted(recording: Recording, p: np.void, name: str) -> float:
    """Return a field of the initial state; 0 for a recording that is not fitted."""
    return float(p[name]) if name in (p.dtype.names or ()) and recording.fit.any() else 0.0


def state_key(p: np.void) -> bytes:
    """Return the initial state of a record as bytes; that of a supply which never sags is none."""
    sags = p['valve_characteristic_supply_sag'] > 0.0
    return b''.join(p[name].tobytes() for name in START_FIELDS
                    if name in (p.dtype.names or ()) and (sags or name != SUPPLY))


def flux_key(recording: Recording, p: np.void) -> bytes:
    """Return the flux at the start as bytes, as a share of the hysteresis's half width."""
    return np.float64(_fitted(recording, p, FLUX)).tobytes()


def before_valve(recording: Recording, p: np.void, command: Array) -> tuple[np.void, Array]:
    """
    Return the valve's state some time before a recording, and the commands (N) since then.

    If the recording begins in motion, its first command is assumed to have been held.
    """
    state = np.zeros(1, STATE_DTYPE)[0]
    if recording.at_rest:
        return state, command[:0]
    state['command_filtered'] = command[0]
    for name in ('flux', 'plays_flux', 'lagged_flux'):
        state[name] = command[0] + _fitted(recording, p, FLUX) * p['valve_hysteresis_radius']
    # Lags that are too slow for the time before the recording begin near where they end.
    gain = p['valve_hysteresis_linear_gain'] if p['valve_hysteresis_model'] == LINEAR else 1.0
    for name in ('lagged_drive', 'twice_lagged_drive'):
        state[name] = gain * command[0]
    return state, np.full(math.ceil(BURN_IN_S / recording.period_s), command[0])


def _first(values: Array, period: float) -> float:
    """Return a signal at its first sample, by a line through those of the first START_S."""
    count = max(int(START_S / period), 2)
    return float(np.polyfit(np.arange(count), values[:count], 1)[1])


def actuator_of(p: np.void) -> np.void:
    """Return the actuator's own fields of a record, with the mean of an uneven delay."""
    q = np.frombuffer(bytearray(p.tobytes()), ACTUATOR_DTYPE, 1)[0]
    q[SPREAD] = 0.0
    return q


def state_at_start(recording: Recording, p: np.void, valve: Array) -> np.void:
    """Return the state at the first sample; valve: its position in each period, m."""
    state = np.zeros(1, STATE_DTYPE)[0]
    if recording.at_rest:
        return state
    actuator = actuator_of(p)
    state['valve_position'] = valve[0]
    if p['valve_characteristic_supply_sag'] > 0.0:
        opening = np.abs(valve) / p['valve_characteristic_full_opening']
        state['supply_load'] = min(max(np.minimum(opening, 1.0).mean()
                                       + _fitted(recording, p, SUPPLY), 0.0), 1.0)
    motion = recording.motion
    if motion is not None:
        position, velocity = recording.cached('first', (), lambda: np.array([
            _first(each[motion.pad:], recording.period_s)
            for each in (motion.position, motion.velocity)]))
        state['position'] = position * motion.measured + _fitted(recording, p, POSITION)
        state['velocity'] = velocity + _fitted(recording, p, VELOCITY)
    state['load_position'], state['load_velocity'] = state['position'], state['velocity']
    state['seals'] = deflected_seals(
        _fitted(recording, p, SEAL) * largest_deflection(actuator), actuator)
    if recording.force is not None:
        for name in ('hydraulic_force', 'sensor', 'card', 'sensed', 'sensor_input',
                     'sensor_lagged', 'sensor_ring'):
            state[name] = recording.force[0]
        if p['friction_model'] == FULL and p['friction_location'] != BEHIND_SENSOR:
            # What deflects the seals; their damping ends as soon as they slide.
            state['hydraulic_force'] += friction(state['seals'], 0.0, 0.0, actuator, 0.0).force
    return state
