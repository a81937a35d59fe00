"""Predict a channel of a recording from its measured inputs and a record of the plant."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from asi_actuator.model.load import PRESCRIBED
from asi_actuator.parameters import ACTUATOR_PARAMETERS, as_record
from asi_analysis.arrays import Array, Complex
from asi_analysis.gap.model import blocks, simulator, static_blocks
from asi_analysis.gap.model.effects import MOTIONS, OF_A_RECORDING, of_recording
from asi_analysis.gap.model.model_file import effect_fields
from asi_analysis.gap.motion import Motion, extended, judged
from asi_analysis.gap.prepare import Recording, velocity_of
from asi_analysis.gap.sampling import noise_of_colour, whitened, whitened_by
from asi_common.jit import FULL
from asi_common.parameter import Value, completed
from asi_common.record import copy_of, with_fields

# Longest sub-steps. Lags are exact for inputs that are linear between samples.
FORCE_STEP_S = 5e-4
STEP_S = 2.5e-4           # of the valve, for its delay
SUB_STEP = 0.02           # of a servo: its natural frequency times the sub-step, rad
FRICTION_FACTOR = 2       # dry friction and the sensor: so many for each of those of the force
HYSTERESIS_STEP_S = 2e-4  # of the full hysteresis, whose width depends on the command's rate
TRAVEL_STEP_S = 1e-4      # of the simulated load: hydraulic damping acts after 0.16 ms
CONTACT_STEP_S = 1e-4     # of a load with contacts
RATTLING_STEP_S = 2.5e-4  # of a load whose contacts last
# Fields that the cached parts of a prediction depend on.
FRICTION_FIELDS = tuple(name for name in blocks.PLANT_DTYPE.names or ()
              if name.startswith(('friction_', 'viscous')))
STEADY_FORCE_FIELDS = tuple(name for name in blocks.PLANT_DTYPE.names or () if name.startswith((
    'valve_characteristic_', 'hydraulic_damping_', 'fluid_dynamics_', 'supply_', 'damping_',
    'orifice_', 'force_limit', 'corner')))
VALVE_FIELDS = tuple(name for name in blocks.PLANT_DTYPE.names or ()
              if name.startswith(('valve_', 'command_', 'loop_', 'corner')))


def plant_record(nominal: Mapping[str, Value]) -> np.void:
    """Return the plant's record of nominal actuator parameters, every effect null."""
    record = np.zeros(1, blocks.PLANT_DTYPE)[0]
    actuator = as_record(nominal)
    for name in actuator.dtype.names or ():
        record[name] = actuator[name]
    for name, value in (('force_scale', 1.0), ('friction_bristle', 1e-4), ('supply_time', 0.3),
                        ('friction_stribeck', 1.0), ('friction_falling', 1.0),
                        ('viscous_exponent', 1.0), ('velocity_scale', 1.0)):
        record[name] = value
    for name, value in effect_fields(completed(nominal, ACTUATOR_PARAMETERS)).items():
        record[name] = value
    return record


def predict(recording: Recording, channel: str, p: np.void) -> Array:
    """Return the predicted output of a channel: n samples, in the channel's unit."""
    if channel == 'static':
        return static_blocks.predict(recording, p)
    p = in_recording(p, recording.number)
    if simulator.of_simulator(p):
        return simulator.predict(recording, channel, p)
    if channel == 'load':
        return _load(recording, p)
    if channel == 'valve':
        return _valve(recording, p)
    position = (recording.valve_position if recording.valve_estimate is None else
                recording.valve_estimate)
    if position is None:
        position = _cached(recording, VALVE_FIELDS, p, (), lambda: _valve(recording, p))
    velocity = _velocity(recording, p, position)
    fine = FULL in (p['force_sensor_model'], p['friction_model'])
    count = recording.sub_steps(FORCE_STEP_S)
    steady_force = _cached(
        recording, STEADY_FORCE_FIELDS, p, (position, velocity), lambda: _at_sub_steps(
            blocks.steady_state_force, recording, p, (position, velocity), count))
    if fine:   # friction changes faster than valve and motion
        steady_force, count = _interpolated(steady_force, FRICTION_FACTOR), FRICTION_FACTOR * count
    friction = _cached(recording, FRICTION_FIELDS, p, (velocity,), lambda: _at_sub_steps(
        blocks.cylinder_friction, recording, p, (velocity,), count))
    out = np.empty(recording.fit.size)
    # Of the smoothed motion, if there is one: differentiation amplifies noise.
    motion = recording.motion
    acceleration = (np.gradient(velocity, recording.period_s) if motion is None else
                    motion.acceleration[motion.inner])
    blocks.force(steady_force, friction, acceleration, *blocks.parts(p), recording.period_s,
                 count, out)
    return out


def for_recordings(p: np.void, count: int) -> np.void:
    """Return a record in which each field of `OF_A_RECORDING` is there for `count` recordings."""
    if count == 1:
        return p
    names = [(field, of_recording(field, number)) for number in range(1, count)
             for field in OF_A_RECORDING if field in (p.dtype.names or ())]
    wide = with_fields(p, [own for _, own in names])
    for field, own in names:
        wide[own] = p[field]
    return wide


def in_recording(p: np.void, number: int) -> np.void:
    """Return a record with the fields of `OF_A_RECORDING` set to those of one recording."""
    if number == 0:
        return p
    own = copy_of(p)
    for field in OF_A_RECORDING:
        if field in (p.dtype.names or ()):
            own[field] = p[of_recording(field, number)]
    return own


def propagated_noise(recording: Recording, channel: str, p: np.void) -> float:
    """
    Return the mean square noise of a predicted channel that comes from its measured inputs.

    These are valve position and motion. A lag attenuates their noise, an inverted lag amplifies
    it.
    """
    if channel in ('valve', 'static') or simulator.of_simulator(p):
        return 0.0
    if channel == 'load':
        motion = recording.moved
        omega = np.maximum(motion.omega, motion.omega[1])
        one, none = np.ones_like(omega), np.zeros_like(omega)
        moved = _linear(omega, one, one / (1j * omega), none, p) * _reading(
            omega, p) * motion.judge
        return float(np.mean(np.abs(moved) ** 2 * motion.noise))
    rng = np.random.default_rng(0)
    noisy: dict[str, Any] = {}
    if recording.valve_position is not None:
        noise = recording.noise['valve_position'] * noise_of_colour(
            recording.fit.size, recording.colour.get('valve_position', ()), rng)
        name = 'valve_position' if recording.valve_estimate is None else 'valve_estimate'
        noisy[name] = getattr(recording, name) + noise
    if recording.motion is not None:
        motion = recording.motion
        shaken = np.fft.rfft(rng.standard_normal(motion.velocity.size)) * np.sqrt(motion.noise)
        smoothed = shaken * motion.smooth
        if recording.velocity is not None:
            noisy['velocity'] = recording.velocity + np.fft.irfft(
                shaken, motion.velocity.size)[motion.inner]
        noisy['motion'] = replace(
            motion, velocity=motion.velocity + np.fft.irfft(smoothed, motion.velocity.size),
            acceleration=motion.acceleration + np.fft.irfft(1j * motion.omega * smoothed,
                                                            motion.velocity.size))
    made = predict(replace(recording, cache={}, **noisy), channel, p) - predict(
        recording, channel, p)
    used = recording.held_out if recording.held_out.any() else recording.valid
    return float(np.mean(made[used] ** 2))


def _cached(recording: Recording, fields: tuple[str, ...], p: np.void,
            signals: tuple[Array, ...], make: Callable[[], Array]) -> Array:
    """
    Return a part of a prediction, from the cache if nothing that it depends on has changed.

    A finite difference changes one parameter, which acts on one part only.
    """
    return recording.cached(fields[0], (*(float(p[name]) for name in fields),
                                        *(hash(signal.tobytes()) for signal in signals)), make)


def _at_sub_steps(part: Callable[..., None], recording: Recording, p: np.void,
                signals: tuple[Array, ...], count: int) -> Array:
    """Return a part of the force at `count` sub-steps per sample."""
    out = np.empty((recording.fit.size - 1) * count + 1)
    part(*(_interpolated(signal, count) for signal in signals), *blocks.parts(p),
         recording.period_s / count, out)
    return out


def _interpolated(signal: Array, count: int) -> Array:
    """Return a signal at `count` sub-steps per sample, by linear interpolation."""
    rise = np.diff(signal)[:, None] * (np.arange(count) / count)
    return np.append((signal[:-1, None] + rise).ravel(), signal[-1])


def _valve(recording: Recording, p: np.void) -> Array:
    """Return the valve position (m) predicted from the recorded command."""
    out = np.empty(recording.fit.size)
    longest = HYSTERESIS_STEP_S if p['valve_hysteresis_model'] == FULL else STEP_S
    if p['valve_flexure_model'] != FULL:
        # Without a lag, sub-steps would make the output a discontinuous function of the delay.
        longest = recording.period_s
    else:   # a slow servo allows longer ones
        longest = max(longest, SUB_STEP / (2.0 * np.pi * p['valve_flexure_natural_frequency']))
    blocks.valve(recording.command, *blocks.parts(p), recording.period_s,
                 recording.sub_steps(longest), out, recording.begins or blocks.AT_REST)
    return out


def _velocity(recording: Recording, p: np.void, position: Array) -> Array:
    """Return the velocity (m/s) of the piston; simulated with the nominal load if not measured."""
    if (moved := velocity_of(recording)) is not None:
        return moved
    _, damping, stiffness = blocks.load_constants(p)
    out = np.zeros(recording.fit.size)
    if p['load_mass'] > 0.0 and int(p['load_type']) != PRESCRIBED:
        blocks.travel(position, *blocks.parts(p), damping, stiffness, recording.period_s,
                      recording.sub_steps(TRAVEL_STEP_S), out)
    return out


def _load(recording: Recording, p: np.void) -> Array:
    """Return the force (N) for the measured motion, as read by the sensor, band-limited."""
    motion = _motion(recording, p)
    _, damping, stiffness = blocks.load_constants(p)
    extra, slack = np.zeros((2, motion.velocity.size))
    weight, taken, slope = _weight(recording, p)
    passed, reading = _spectrum(weight), _reading(motion.omega, p)
    blocks.load_nonlinear(motion.position, motion.velocity, damping, blocks.parts(p)[1],
                          recording.period_s, -motion.pad * recording.period_s,
                          _balance(recording, motion, p, weight, taken), extra, slack)
    if p['backlash_floating'] > 0.0:
        mass = float(p['load_mass'] * p['piston_share'])
        moved = np.empty((2, extra.size))
        gravity, middle = _gravity(recording, p), _middle(recording, p)
        blocks.floating(motion.position, motion.velocity, middle,
                        (p['load_mass'] - mass, damping, stiffness), gravity,
                        blocks.parts(p)[1], recording.period_s, recording.sub_steps(
                            RATTLING_STEP_S if p['contact_time'] > 0.0 else CONTACT_STEP_S), moved)
        extra += damping * moved[1] + stiffness * moved[0]
        passed = _spectrum(gravity[0] * np.sin(moved[0] + middle)
                           + gravity[1] * np.cos(moved[0] + middle))
        # From its momentum, since a contact may be shorter than a sample.
        linear = 1j * motion.omega * (
            (1.0 - p['force_sensor_mass_share']) * mass * motion.velocity_spectrum
            + (p['load_mass'] - mass) * np.fft.rfft(moved[1]))
    else:
        linear = _linear(motion.omega, motion.velocity_spectrum, motion.position_spectrum,
                         _spectrum(slack), p, slope)
        if p['compliance'] > 0.0:   # the weight is beyond it
            passed *= blocks.transmitted(motion.omega, p, slope)
    total = motion.judge * ((linear + _spectrum(extra) + passed) * reading - _spectrum(taken))
    inner = np.fft.irfft(total, extra.size)[motion.inner]
    if p['compliance'] > 0.0 and (p['swing_cosine'] != 0.0 or p['swing_sine'] != 0.0):
        inner = inner + judged(blocks.swing(recording.time_s, p, slope), motion)
    return inner + _offset(recording, p)


def _offset(recording: Recording, p: np.void) -> Array | float:
    """Return what the force sensor reads too much (N): its offset and drift."""
    if not recording.moved.measured:   # they are outside the band
        return 0.0
    return np.asarray(p['force_sensor_offset'] + p['sensor_offset'] + blocks.drift(
        recording.time_s, blocks.parts(p)[1]))


def _balance(recording: Recording, motion: Motion, p: np.void, weight: Array, taken: Array
             ) -> Array:
    """
    Return the force (N) that is left for friction where the load halts; empty without any.

    nan where it moves. weight, taken: see `_weight`.
    """
    rigid = p['compliance'] == 0.0 and p['backlash'] == 0.0   # else the load goes on moving
    if (p['friction_level'] == 0.0 or p['friction_creep'] > 0.0 or p['friction_inside'] > 0.5
            or not rigid or not motion.halts.any()):
        return np.empty(0)
    assert recording.force is not None
    mass, damping, stiffness = blocks.load_constants(p)
    sensed = np.fft.rfft(extended(recording.force - _offset(recording, p), motion.pad) + taken)
    force = np.fft.irfft(motion.smooth * sensed / _reading(motion.omega, p), taken.size)
    moving = (mass * motion.acceleration + damping * motion.velocity
              + stiffness * motion.position + weight)
    return np.where(motion.halts, force - moving, np.nan)


def _motion(recording: Recording, p: np.void) -> Motion:
    """Return the motion of a load, of which a sensor may read another multiple."""
    motion = recording.moved
    if (error := float(p['position_gain_error'])) == 0.0:
        return motion
    return replace(motion, **{name: getattr(motion, name) / (1.0 + error) for name in (
        'position', 'velocity', 'acceleration', 'position_spectrum', 'velocity_spectrum')})


def _middle(recording: Recording, p: np.void) -> float:
    """Return the angle of a joint at the middle of its motion."""
    return recording.taken.get('middle', 0.0) / (1.0 + float(p['position_gain_error']))


def _gravity(recording: Recording, p: np.void) -> Array:
    """Return the gravity of a joint: amplitudes (N m) of sine and cosine of its angle."""
    return np.array([recording.taken.get(f'gravity_{part}', 0.0) + p[f'gravity_{part}']
                     for part in ('sine', 'cosine')])


def _weight(recording: Recording, p: np.void) -> tuple[Array, Array, float]:
    """
    Return the gravity of a joint, the part of it that was subtracted from the force, its slope.

    The first two along the motion, N m; the slope by the angle at the middle of it, N m/rad.
    """
    motion, taken = recording.moved, recording.taken
    before = [taken.get(f'gravity_{part}', 0.0) for part in ('sine', 'cosine')]
    now = [own + float(p[f'gravity_{part}']) for own, part in zip(before, ('sine', 'cosine'),
                                                                  strict=True)]
    none = np.zeros_like(motion.position)
    if not any(before) and not any(now):
        return none, none, 0.0
    middle = _middle(recording, p)
    moved, read = _motion(recording, p).position + middle, motion.position + taken['middle']
    made, off = (each[0] * np.sin(angle) + each[1] * np.cos(angle)
                 for each, angle in ((now, moved), (before, read)))
    return made, off, now[0] * math.cos(middle) - now[1] * math.sin(middle)


def _spectrum(signal: Array) -> Complex:
    """Return the Fourier transform of a signal, which mostly is zero: that costs nothing."""
    if signal.any():
        return np.fft.rfft(signal)
    return np.zeros(signal.size // 2 + 1, complex)


def _reading(omega: Array, p: np.void) -> Complex:
    """Return the frequency response from the force on the load to the sensor's, or the command."""
    return blocks.sensor_response(omega, p) * blocks.drive_inverse(omega, p)


def _linear(omega: Array, velocity: Complex, position: Complex, slack: Complex, p: np.void,
            slope: float = 0.0) -> Complex:
    """Return the spectrum of the force of the linear load for a motion."""
    if p['compliance'] > 0.0 or p['backlash'] > 0.0:
        return blocks.behind(omega, velocity, position, slack, p, slope)
    _, _, stiffness = blocks.load_constants(p)
    return blocks.impedance(omega, p) * velocity + stiffness * position


def measured(recording: Recording, channel: str) -> Array:
    """Return the measured output of a channel, n samples."""
    signal = {'valve': recording.valve_position, 'static': recording.valve_position,
              'force': recording.force,
              'load': recording.force_judged, 'velocity': recording.raw_velocity,
              'position': recording.raw_position}[channel]
    assert signal is not None
    return signal


def judged_error(recording: Recording, channel: str, p: np.void) -> Array:
    """
    Return the error of a prediction, n samples in the channel's unit, as `compared` returns it.

    Noise of the simulator's channels is made white (Ljung, System Identification, 2nd ed., 7.3).
    """
    error: Array = measured(recording, channel) - predict(recording, channel, p)
    colour = recording.colour.get('valve_position' if channel == 'valve' else channel)
    if simulator.of_simulator(p):
        mean, factor = recording.uneven_mean, recording.uneven_delay
        if channel == 'valve' and p[simulator.SPREAD] > 0.0 and (
                mean is not None and factor is not None):
            error = whitened_by(factor, error - mean, recording.valid)
        elif colour:
            error = whitened(error, recording.valid, colour)
    return compared(recording, channel, error)


def unexplained(recording: Recording, channel: str, p: np.void) -> Array:
    """Return what a prediction leaves of a channel's output, n samples, as it is compared."""
    return compared(recording, channel, measured(recording, channel)
                    - predict(recording, channel, p))


def compared(recording: Recording, channel: str, signal: Array) -> Array:
    """
    Return a signal as its channel is compared: a motion in its band, any other as it is.

    Above that band a mass rings when it begins or ends to slide, which the force does not show.
    """
    if channel not in MOTIONS or recording.motion is None:
        return signal
    return judged(signal, recording.motion)
