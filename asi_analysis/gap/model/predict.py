"""What a channel of a recording should have measured, by a record of the plant."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from asi_actuator.model.load import PRESCRIBED
from asi_actuator.parameters import ACTUATOR_PARAMETERS, as_record
from asi_analysis.gap.model import blocks
from asi_analysis.gap.model.blocks import Complex
from asi_analysis.gap.model.effects import OF_A_RECORDING, of_recording
from asi_analysis.gap.model.model_file import effect_fields
from asi_analysis.gap.prepare import Array, Recording
from asi_common.jit import FULL
from asi_common.parameter import Value, completed

# Valve position and velocity come sampled, and lags are exact for what moves straight, so finer
# steps than the first tell nothing new of the force; delays and a solid friction of the nominal
# model take the second; the hysteresis of the full model, whose width follows the rate of the
# command and so jumps within a sample, the third.
FORCE_STEP_S = 5e-4
STEP_S = 2.5e-4
FINER = 2
HYSTERESIS_STEP_S = 2e-4
# Of the load that is moved, against the damping of the oil that is late by 0.16 ms.
TRAVEL_STEP_S = 1e-4
CONTACT_STEP_S = 1e-4   # of a load that touches
# What valve and parts of the force depend on, and how many of them are kept.
SEALS = tuple(name for name in blocks.PLANT_DTYPE.names or ()
              if name.startswith(('friction_', 'viscous')))
ASKED = tuple(name for name in blocks.PLANT_DTYPE.names or () if name.startswith((
    'valve_characteristic_', 'hydraulic_damping_', 'fluid_dynamics_', 'supply_', 'damping_',
    'orifice_', 'force_limit', 'corner')))
VALVE = tuple(name for name in blocks.PLANT_DTYPE.names or ()
              if name.startswith(('valve_', 'command_', 'loop_', 'corner')))
KEPT = 6


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
    """Return what a channel should have measured: n samples, in the channel's unit."""
    p = _in_recording(p, recording.number)
    if channel == 'load':
        return _load(recording, p)
    if channel == 'valve':
        return _valve(recording, p)
    position = recording.valve_position
    if position is None:
        position = _kept(recording, VALVE, p, (), lambda: _valve(recording, p))
    velocity = _velocity(recording, p, position)
    stiff = FULL in (p['force_sensor_model'], p['friction_model'])
    count = recording.sub_steps(FORCE_STEP_S)
    wanted = _kept(recording, ASKED, p, (position, velocity), lambda: _finely_run(
        blocks.asked, recording, p, (position, velocity), count))
    if stiff:   # friction changes faster than valve and motion
        wanted, count = _finely(wanted, FINER), FINER * count
    rub = _kept(recording, SEALS, p, (velocity,), lambda: _finely_run(
        blocks.seals, recording, p, (velocity,), count))
    out = np.empty(recording.fit.size)
    # The smoothed motion, where there is one: noise grows with each derivative.
    motion = recording.motion
    acceleration = (np.gradient(velocity, recording.period_s) if motion is None else
                    motion.acceleration[motion.pad:motion.pad + out.size])
    blocks.force(wanted, rub, acceleration, *blocks.parts(p), recording.period_s, count, out)
    return out


def for_recordings(p: np.void, count: int) -> np.void:
    """Return a record with the fields of a recording once for each of `count` recordings."""
    if count == 1:
        return p
    names = [(field, of_recording(field, number)) for number in range(1, count)
             for field in OF_A_RECORDING]
    wide = np.zeros(1, np.dtype(p.dtype.descr + [(own, np.float64) for _, own in names]))[0]
    for name in p.dtype.names or ():
        wide[name] = p[name]
    for field, own in names:
        wide[own] = p[field]
    return wide


def _in_recording(p: np.void, number: int) -> np.void:
    """Return a record with the values that its fields have in one recording."""
    if number == 0:
        return p
    own = p.copy()
    for field in OF_A_RECORDING:
        own[field] = p[of_recording(field, number)]
    return own


def passed_on(recording: Recording, channel: str, p: np.void) -> float:
    """
    Return the mean square that the noise of its measured inputs leaves in what a channel predicts.

    Of valve position and motion. What acts behind a lag passes on less, and a lag that has to be
    undone more.
    """
    if channel == 'valve':
        return 0.0
    if channel == 'load':
        motion = recording.motion
        assert motion is not None
        omega = np.maximum(motion.omega, motion.omega[1])
        one, none = np.ones_like(omega), np.zeros_like(omega)
        moved = _linear(omega, one, one / (1j * omega), none, p) * motion.judge
        return float(np.mean(np.abs(moved) ** 2 * motion.noise))
    rng = np.random.default_rng(0)
    noisy: dict[str, Any] = {}
    if recording.valve_position is not None:
        noisy['valve_position'] = recording.valve_position + recording.noise[
            'valve_position'] * rng.standard_normal(recording.fit.size)
    motion = recording.motion
    if motion is not None:
        shaken = np.fft.rfft(rng.standard_normal(motion.velocity.size)) * np.sqrt(motion.noise)
        inner = slice(motion.pad, motion.pad + recording.fit.size)
        smoothed = shaken * motion.smooth
        if recording.velocity is not None:
            noisy['velocity'] = recording.velocity + np.fft.irfft(
                shaken, motion.velocity.size)[inner]
        noisy['motion'] = replace(
            motion, velocity=motion.velocity + np.fft.irfft(smoothed, motion.velocity.size),
            acceleration=motion.acceleration + np.fft.irfft(1j * motion.omega * smoothed,
                                                            motion.velocity.size))
    made = predict(replace(recording, kept={}, **noisy), channel, p) - predict(
        recording, channel, p)
    return float(np.mean(made[recording.held_out] ** 2))


def _kept(recording: Recording, fields: tuple[str, ...], p: np.void,
          signals: tuple[Array, ...], make: Callable[[], Array]) -> Array:
    """
    Return a part of a prediction, as it was if nothing that it depends on has changed.

    For a derivative only one parameter is moved, and that is in one part.
    """
    key = (fields[0], *(float(p[name]) for name in fields),
           *(hash(signal.tobytes()) for signal in signals))
    known = recording.kept
    if key not in known:
        while len(known) >= KEPT:
            del known[next(iter(known))]
        known[key] = make()
    known[key] = known.pop(key)   # the latest last
    return known[key]


def _finely_run(part: Callable[..., None], recording: Recording, p: np.void,
                signals: tuple[Array, ...], count: int) -> Array:
    """Return what a part of the force makes of signals at `count` sub-steps a sample."""
    out = np.empty((recording.fit.size - 1) * count + 1)
    part(*(_finely(signal, count) for signal in signals), *blocks.parts(p),
         recording.period_s / count, out)
    return out


def _finely(signal: Array, count: int) -> Array:
    """Return a signal at `count` sub-steps a sample, straight from sample to sample."""
    rise = np.diff(signal)[:, None] * (np.arange(count) / count)
    return np.append((signal[:-1, None] + rise).ravel(), signal[-1])


def _valve(recording: Recording, p: np.void) -> Array:
    """Return the valve position (m) that the recorded command should have made."""
    out = np.empty(recording.fit.size)
    longest = HYSTERESIS_STEP_S if p['valve_hysteresis_model'] == FULL else STEP_S
    if p['valve_flexure_model'] != FULL:
        # With nothing slow behind it only a mean over a whole sample moves with the delay.
        longest = recording.period_s
    blocks.valve(recording.command, *blocks.parts(p), recording.period_s,
                 recording.sub_steps(longest), out)
    return out


def _velocity(recording: Recording, p: np.void, position: Array) -> Array:
    """Return the velocity (m/s) of the piston; not measured, what the nominal load does."""
    if recording.velocity is not None:
        return recording.velocity
    motion = recording.motion
    if motion is not None:
        return motion.velocity[motion.pad:motion.pad + recording.fit.size]
    _, damping, stiffness = blocks.load_constants(p)
    out = np.zeros(recording.fit.size)
    if p['load_mass'] > 0.0 and int(p['load_type']) != PRESCRIBED:
        blocks.travel(position, *blocks.parts(p), damping, stiffness, recording.period_s,
                      recording.sub_steps(TRAVEL_STEP_S), out)
    return out


def _load(recording: Recording, p: np.void) -> Array:
    """Return the force (N) that the measured motion takes, as the sensor reads it, in band."""
    motion = recording.motion
    assert motion is not None
    _, damping, stiffness = blocks.load_constants(p)
    extra, slack = np.zeros((2, motion.velocity.size))
    blocks.load_nonlinear(motion.position, motion.velocity, damping, blocks.parts(p)[1],
                          recording.period_s, -motion.pad * recording.period_s, extra, slack)
    if p['backlash_floating'] > 0.0:
        mass = float(p['load_mass'] * p['piston_share'])
        carried = np.empty_like(extra)
        blocks.floating(motion.position, motion.velocity,
                        (p['load_mass'] - mass, damping, stiffness), blocks.parts(p)[1],
                        recording.period_s, recording.sub_steps(CONTACT_STEP_S), carried)
        extra += carried
        linear = ((1.0 - p['force_sensor_mass_share']) * mass * 1j * motion.omega
                  * motion.velocity_spectrum * _read(motion.omega, p))
    else:
        linear = _linear(motion.omega, motion.velocity_spectrum, motion.position_spectrum,
                         np.fft.rfft(slack), p)
    total = motion.judge * (linear + np.fft.rfft(extra) * _read(motion.omega, p))
    count = recording.fit.size
    inner = np.fft.irfft(total, extra.size)[motion.pad:motion.pad + count]
    if not motion.measured:   # the offset is outside the band
        return inner
    time = recording.time_s
    return inner + p['force_sensor_offset'] + p['sensor_offset'] + blocks.drift(
        time, blocks.parts(p)[1])


def _read(omega: Array, p: np.void) -> Complex:
    """Return what is read, or was commanded, over the force that the load takes."""
    return blocks.sensor_response(omega, p) * blocks.drive_inverse(omega, p)


def _linear(omega: Array, velocity: Complex, position: Complex, slack: Complex, p: np.void
            ) -> Complex:
    """Return the spectrum of the force that the linear load takes of a motion, as it is read."""
    if p['compliance'] > 0.0 or p['backlash'] > 0.0:
        return blocks.behind(omega, velocity, position, slack, p) * _read(omega, p)
    _, _, stiffness = blocks.load_constants(p)
    return (blocks.impedance(omega, p) * velocity + stiffness * position) * _read(omega, p)


def measured(recording: Recording, channel: str) -> Array:
    """Return what a channel has measured."""
    signal = {'valve': recording.valve_position, 'force': recording.force,
              'load': recording.force_judged}[channel]
    assert signal is not None
    return signal
