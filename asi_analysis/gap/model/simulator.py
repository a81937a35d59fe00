"""
The simulator as the predictor: its own steps, run on the recorded command.

If the valve position was measured, its residual is added to the simulated position, period by
period; between samples the simulated valve moves, so nothing is interpolated. Piston and load are
simulated open loop from the initial state: the output-error form of the prediction-error method
(Ljung, System Identification, 2nd ed., ch. 7).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.signal import welch

from asi_actuator.model.actuator import (
    STATE_DTYPE,
    advance_motion,
    advance_sensor,
    advance_valve,
    prepare,
)
from asi_actuator.model.force_sensor import held_reading
from asi_actuator.model.load import load_spring
from asi_actuator.parameters import ACTUATOR_DTYPE, as_record
from asi_analysis.arrays import Array
from asi_analysis.gap.model.effects import Free
from asi_analysis.gap.model.start import (
    SPREAD,
    actuator_of,
    before_valve,
    flux_key,
    state_at_start,
    state_key,
)
from asi_analysis.gap.motion import extended
from asi_analysis.gap.parts import BURN_IN_S
from asi_analysis.gap.prepare import Recording
from asi_analysis.gap.sampling import noise_spectrum
from asi_common.jit import OFF, jit
from asi_common.parameter import Value
from asi_common.record import copy_of, with_fields

# Sub-steps that are tried, the longest first: each has half of the integration error of the one
# before. Their largest error (rms), as a share of the rms error floor; at the end of a fit.
SUBSTEPS_S = tuple(1e-3 * 2.0 ** (-0.5 * number) for number in range(10))
SUBSTEP_ERROR, FINAL_ERROR = 0.2, 0.02
# Fields that the valve position depends on.
VALVE_FIELDS = tuple(name for name in ACTUATOR_DTYPE.names or () if name.startswith((
    'command_', 'valve_hysteresis_', 'valve_flexure_'))) + (
        'valve_characteristic_gain', 'valve_characteristic_maximum_force',
        'valve_characteristic_full_opening', 'maximum_substep')
GAIN_FIELDS = tuple(f'valve_characteristic_{name}' for name in (
    'gain', 'maximum_force', 'full_opening'))
# Where those fields are in a record on which the deflection of the valve, in N, depends.
VALVE_BYTES = tuple(dict[str, Any](ACTUATOR_DTYPE.fields or {})[name][1] for name in VALVE_FIELDS
                    if name not in (*GAIN_FIELDS, 'valve_flexure_travel_limit'))
# Where those are of the force sensor alone, on which the motion does not depend.
SENSOR_FIELDS = frozenset(name for name in ACTUATOR_DTYPE.names or () if name.startswith(
    'force_sensor_') and name != 'force_sensor_mass_share')
SENSOR_BYTES = tuple(dict[str, Any](ACTUATOR_DTYPE.fields or {})[name][1]
                     for name in SENSOR_FIELDS)
NOTHING = bytes(8)
# Fields of the delays of the command.
DELAYS = ('command_path_delay', 'valve_flexure_delay')
# Fields of the errors of the valve's fit, and their largest size, standard deviations.
VALVE_ERROR, MOST_ERROR = 'valve_error_', 6.0
POSITION_ERROR = 0.002   # model error of velocity and position, as a share of their rms
LEAST_SHARE = 0.5   # gain of the Wiener filter below which all power is taken for noise


@jit
def _valve(state, command, p, period):
    """Return the valve positions (m) after the command's jump and each sub-step of n periods."""
    steady = prepare(p, period)
    positions = np.empty((command.size, steady.substeps + 1))
    for k in range(command.size):
        advance_valve(state, command[k], p, steady, positions[k])
    return positions


@jit
def _follow(state, deflection, unit, error, p, period, out):
    """
    Fill `out` (velocity, position, then the felt forces; n samples) for given valve positions (m).

    These are unit * deflection + error. deflection: after the command's jump and each sub-step of
    a period, N, as the felt forces are; unit: m/N; error: in each period, m.
    """
    steady = prepare(p, period)
    positions = np.empty(deflection.shape[1])
    for k in range(out.shape[1]):
        out[0, k], out[1, k] = state.velocity, state.position
        for j in range(positions.size):
            positions[j] = unit * deflection[k, j] + error[k]
        advance_motion(state, positions, out[2:, k], p, steady)


@jit
def _sense(state, felt, p, period):
    """Return the readings (N, n samples) of the force sensor; felt: as `_follow` returns it."""
    steady, out = prepare(p, period), np.empty(felt.shape[1])
    for k in range(out.size):
        out[k] = held_reading(state, p)
        advance_sensor(state, felt[:, k], p, steady)
    return out


def simulator_record(nominal: Mapping[str, Value]) -> np.void:
    """Return the record of nominal parameters for predictions: without noise."""
    p = as_record(nominal)
    p['force_sensor_noise'] = p['force_sensor_drop_rate'] = p[SPREAD] = 0.0
    return p


def by_simulator(nominal: Mapping[str, Value]) -> bool:
    """Return whether the simulator itself is the predictor: not of simplified nominal models."""
    return all(nominal.get(f'{block}.model', 'full') == 'full' for block in (
        'valve_hysteresis', 'valve_flexure', 'hydraulic_damping', 'friction')) and (
            nominal.get('load.type') != 'prescribed')


def has_linear_laws(nominal: Mapping[str, Value]) -> bool:
    """Return whether a nominal model has no law that textbooks formulate in several ways."""
    return all(nominal.get(f'{block}.model', 'full') != 'full' for block in (
        'valve_hysteresis', 'hydraulic_damping', 'friction')) and (
            nominal.get('load.type') != 'prescribed')


def of_simulator(p: np.void) -> bool:
    """Return whether a record is the simulator's, perhaps with fields of each recording."""
    return 'loop_width' not in (p.dtype.names or ())


def simulated_valve(recording: Recording, p: np.void) -> Array:
    """Return the valve position (m, n samples) simulated from the recorded command."""
    return metres_per_newton(p) * _deflection(recording, p)[:-1, -1]


def metres_per_newton(p: np.void) -> float:
    """Return the valve position (m) at a deflection of 1 N of valve command."""
    return float(p['valve_characteristic_gain'] * p['valve_characteristic_full_opening']
                 / p['valve_characteristic_maximum_force'])


def _deflection(recording: Recording, p: np.void) -> Array:
    """
    Return the valve's deflection (N of valve command) simulated from the recorded command.

    Rows: the period before the recording and its n periods; columns: after the command's jump and
    after each sub-step. It does not depend on the gain of the valve, and is cached.
    """
    travel_limit = p['valve_flexure_travel_limit'] / metres_per_newton(p)

    def run() -> Array:
        q, command = actuator_of(p), recording.command
        q['valve_flexure_travel_limit'] = travel_limit
        for name in GAIN_FIELDS:
            q[name] = 1.0
        if command is None:
            command = np.zeros(recording.fit.size)
        state, before = before_valve(recording, p, command)
        found = _valve(state, np.concatenate([before, command]), q, recording.period_s)
        first = found[before.size - 1] if before.size else np.zeros(found.shape[1])
        return np.concatenate([first[None], found[before.size:]])

    whole = p.tobytes()
    key = b''.join(whole[k:k + 8] for k in VALVE_BYTES)
    return recording.cached(
        'valve', key + travel_limit.tobytes() + flux_key(recording, p), run)


def estimated_valve(recording: Recording, p: np.void) -> Array | None:
    """Return the valve position (m, n samples), estimated from measurement and simulation."""
    if recording.valve_position is None:
        return None
    return less_noisy_valve(recording, simulated_valve(recording, p))[0]


def less_noisy_valve(recording: Recording, predicted: Array) -> tuple[Array, float]:
    """
    Return the valve position (m, n samples), estimated with a prediction, and its error (m, rms).

    The prediction plus its Wiener-filtered residual: at frequencies where the residual has the
    power of the noise, the prediction is kept. The error is the noise that passes the filter, and
    the part of the prediction's error that does not.
    """
    missed = recording.output - predicted
    if not recording.at_rest:   # the response to commands before the recording
        missed[:int(BURN_IN_S / recording.period_s)] = 0.0
    frequency, power = welch(missed, nperseg=min(missed.size // 16, 256), detrend=False)
    noise = 2.0 * recording.noise['valve_position'] ** 2 * noise_spectrum(
        frequency, recording.colour.get('valve_position', ()))
    keep = np.clip(1.0 - noise / np.maximum(power, 1e-300), 0.0, 1.0)
    keep[keep <= LEAST_SHARE] = 0.0
    left = keep ** 2 * noise + (1.0 - keep) ** 2 * np.maximum(power - noise, 0.0)
    spectrum = np.fft.rfft(missed)
    keep = np.interp(np.fft.rfftfreq(missed.size), frequency, keep)
    return (predicted + np.fft.irfft(spectrum * keep, missed.size),
            math.sqrt(0.5 * float(np.mean(left))))


def simulated_motion(recording: Recording, p: np.void) -> Array:
    """Return velocity (m/s) and position (m), then the felt forces (N), each of n samples."""
    def run() -> Array:
        deflection, unit = _deflection(recording, p), metres_per_newton(p)
        state = state_at_start(recording, p, unit * deflection[:-1, -1])
        out, error = np.empty((2 + deflection.shape[1], recording.fit.size)), np.zeros(
            recording.fit.size)
        if recording.valve_estimate is not None:
            error = recording.valve_estimate - unit * deflection[:-1, -1]
            error[:-1] = 0.5 * (error[:-1] + error[1:])   # in a period: the mean of both ends
        _follow(state, deflection[1:], unit, error, actuator_of(p), recording.period_s, out)
        return out

    raw = bytearray(actuator_of(p).tobytes())
    for k in SENSOR_BYTES:
        raw[k:k + 8] = NOTHING
    return recording.cached('motion', bytes(raw) + state_key(p), run)


def simulated_force(recording: Recording, p: np.void) -> Array:
    """Return what the force sensor reads (N, n samples)."""
    def run() -> Array:
        state = state_at_start(recording, p, np.zeros(1))
        return _sense(state, simulated_motion(recording, p)[2:], actuator_of(p),
                      recording.period_s)

    return recording.cached('force', actuator_of(p).tobytes() + state_key(p), run)


def moves_nothing(field: str) -> bool:
    """Return whether the simulated motion does not depend on a parameter."""
    return field in SENSOR_FIELDS or field.startswith(VALVE_ERROR)


def with_valve_errors(p: np.void, count: int) -> tuple[np.void, tuple[Free, ...]]:
    """Return a record with errors of the valve's fit, in standard deviations, and these free."""
    return with_fields(p, _errors(count)), tuple(
        Free(name, -MOST_ERROR, MOST_ERROR, (0.0,), prior=1.0) for name in _errors(count))


def _errors(count: int) -> list[str]:
    """Return the fields of the errors of the valve's fit."""
    return [f'{VALVE_ERROR}{number}' for number in range(count)]


def with_corrections(recordings: Sequence[Recording], channels: Sequence[str], p: np.void,
                     floor: Mapping[str, float], shortest: float, error: float = SUBSTEP_ERROR
                     ) -> tuple[list[Recording], float]:
    """
    Return recordings with corrections for the longest possible sub-step (s), and that sub-step.

    floor: error floor by channel, mean square; shortest: sub-step that needs no correction, s;
    error: its largest integration error (rms), as a share of the rms error floor.
    """
    exact = _predictions(recordings, channels, p, shortest)
    for substep in different_substeps(recordings):
        if substep <= shortest:
            break
        found = corrected(recordings, channels, p, substep, exact)
        if all(np.sqrt(np.mean(each.corrections[channel] ** 2) / floor[channel]) < error
               for each in found for channel in channels):
            return found, substep
    return [replace(recording, corrections={}, cache={}) for recording in recordings], shortest


def different_substeps(recordings: Sequence[Recording]) -> list[float]:
    """Return those of SUBSTEPS_S (s) that cut the recordings' periods into different numbers."""
    different = {tuple(math.ceil(each.period_s / substep * (1.0 - 1e-12)) for each in recordings):
                 substep for substep in reversed(SUBSTEPS_S)}
    return sorted(different.values(), reverse=True)


def corrected(recordings: Sequence[Recording], channels: Sequence[str], p: np.void,
              substep: float, exact: Sequence[Mapping[str, Array]] | float) -> list[Recording]:
    """
    Return recordings with corrections for the integration error of a sub-step (s) at a record.

    That error hardly depends on the parameters, so the correction at `p` is added to all
    predictions. exact: the sub-step (s) that needs no correction, or its predictions.
    """
    if isinstance(exact, float):
        exact = _predictions(recordings, channels, p, exact)
    uncorrected = _predictions(recordings, channels, p, substep)
    return [replace(recording, corrected_substep_s=substep, cache={}, corrections={
        channel: fine[channel] - coarse[channel] for channel in channels})
        for recording, fine, coarse in zip(recordings, exact, uncorrected, strict=True)]


def _predictions(recordings: Sequence[Recording], channels: Sequence[str], p: np.void,
                 substep: float) -> list[dict[str, Array]]:
    """Return the predictions with a sub-step (s), uncorrected, by recording and channel."""
    q = copy_of(p)
    q['maximum_substep'] = substep
    return [{channel: predict(replace(recording, corrections={}), channel, q)
             for channel in channels} for recording in recordings]


def predict(recording: Recording, channel: str, p: np.void) -> Array:
    """Return the predicted output of a channel: n samples, in the channel's unit."""
    longer = p['maximum_substep'] == recording.corrected_substep_s
    correction = recording.corrections.get(channel, 0.0) if longer else 0.0
    if channel in recording.valve_errors:
        changes = recording.valve_errors[channel]
        correction = correction + changes @ [p[name] for name in _errors(changes.shape[1])]
    if channel == 'valve':
        return simulated_valve(recording, p) + correction
    if channel == 'force':
        return simulated_force(recording, p) + correction
    velocity, position = simulated_motion(recording, p)[:2]
    if channel == 'velocity':
        return velocity + correction + _mean_position_error(recording, position, p)
    assert recording.raw_position is not None
    off = np.mean((position - recording.raw_position)[recording.valid])
    return position + correction - (1.0 - 1.0 / math.sqrt(recording.valid.sum())) * off


def _mean_position_error(recording: Recording, position: Array, p: np.void) -> float:
    """
    Return the error of the mean of a simulated position (m), scaled to a velocity (m/s).

    A constant force displaces a load on a spring, which its velocity does not show. The error is
    scaled by the uncertainties of both and weighted as a single sample, since the zero of the
    position is uncertain.
    """
    motion = recording.motion
    if motion is None or not motion.measured or load_spring(actuator_of(p))[0] == 0.0:
        return 0.0
    velocity, real = motion.velocity[motion.inner], motion.position[motion.inner]
    valid = recording.valid
    sizes = recording.cached('sizes', (), lambda: np.array([velocity.std(), real.std()])).tolist()
    errors = [math.hypot(recording.noise.get(name, 0.0), POSITION_ERROR * size)
              for name, size in zip(('velocity', 'position'), sizes, strict=True)]
    off = float((position - real) @ valid) / int(np.count_nonzero(valid)) ** 1.5
    return errors[0] / max(errors[1], 1e-300) * off


def missed_force(recording: Recording, p: np.void) -> Array:
    """
    Return the force (N, n samples) that explains the error of a simulated motion.

    The force that moves the load by the difference of simulated and measured velocity, minus the
    difference of the forces; in the band in which motion and force are compared.
    """
    motion = recording.moved
    assert recording.force is not None
    velocity = simulated_motion(recording, p)[0]
    stiffness, damping = load_spring(actuator_of(p))
    raw = recording.raw_velocity
    measured = motion.velocity[motion.inner] if raw is None else raw

    def spectrum(values: Array) -> Any:
        return np.fft.rfft(extended(values, motion.pad, 'even'))

    s = 1j * np.maximum(motion.omega, motion.omega[1])
    mass = (1.0 - p['force_sensor_mass_share']) * p['load_mass']
    needed = (mass * s + damping + stiffness / s) * spectrum(velocity - measured)
    total = motion.judge * (needed - spectrum(
        simulated_force(recording, p) - recording.force))
    return np.fft.irfft(total, velocity.size + 2 * motion.pad)[motion.inner]


def valve_response(recording: Recording, p: np.void, samples: int, count: int) -> Any:
    """Return the linear frequency response of the valve, from `samples` of its step response."""
    ends = _step_response(actuator_of(p), recording.period_s, samples)
    out = np.concatenate([[0.0], ends[:-1]])
    return np.fft.rfft(np.diff(out, append=out[-1]), count)


def pulse_response(p: np.void, period_s: float, samples: int) -> Array:
    """
    Return the linear response (m/N) of the valve, at the end of each period, to a command in one.

    Without delays: from the period on in which the command arrives.
    """
    q = actuator_of(p)
    for name in DELAYS:
        q[name] = 0.0
    return np.diff(_step_response(q, period_s, samples), prepend=0.0)


def _step_response(q: np.void, period_s: float, samples: int) -> Array:
    """Return the linear response (m/N) of the valve at the end of periods with a command."""
    q['valve_hysteresis_model'] = OFF
    for name in ('command_path_quantum', 'valve_flexure_deadband', 'valve_flexure_bias',
                 'valve_flexure_travel_limit'):
        q[name] = 0.0
    return _valve(np.zeros(1, STATE_DTYPE)[0], np.ones(samples), q, period_s)[:, -1]
