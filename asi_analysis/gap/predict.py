"""What a channel of a recording should have measured, by a record of the plant."""

from collections.abc import Mapping

import numpy as np

from asi_actuator.model.jit import FULL
from asi_actuator.parameters import Value, as_record
from asi_analysis.gap import blocks
from asi_analysis.gap.prepare import Array, Recording, low_pass

# Valve position and velocity come sampled, and lags are exact for what moves straight, so finer
# steps than the first tell nothing new of the force; delays and a solid friction of the nominal
# model take the second; the hysteresis of the full model, whose width follows the rate of the
# command and so jumps within a sample, the third.
FORCE_STEP_S = 5e-4
STEP_S = 2.5e-4
HYSTERESIS_STEP_S = 2e-4


def plant_record(nominal: Mapping[str, Value]) -> np.void:
    """Return the plant's record of nominal actuator parameters, every effect null."""
    record = np.zeros(1, blocks.PLANT_DTYPE)[0]
    actuator = as_record(nominal)
    for name in actuator.dtype.names or ():
        record[name] = actuator[name]
    for name, value in (('force_scale', 1.0), ('friction_bristle', 1e-4), ('supply_time', 0.3),
                        ('friction_stribeck', 1.0), ('friction_falling', 1.0)):
        record[name] = value
    return record


def predict(recording: Recording, channel: str, p: np.void) -> Array:
    """Return what a channel should have measured: n samples, in the channel's unit."""
    if channel == 'load':
        return _load(recording, p)
    if channel == 'valve':
        return _valve(recording, p)
    out = np.empty(recording.fit.size)
    position = recording.valve_position
    if position is None:
        position = _valve(recording, p)
    stiff = FULL in (p['force_sensor_model'], p['friction_model'])
    blocks.force(position, _velocity(recording, p), *blocks.parts(p), recording.period_s,
                 recording.sub_steps(STEP_S if stiff else FORCE_STEP_S), out)
    return out


def _valve(recording: Recording, p: np.void) -> Array:
    """Return the valve position (m) that the recorded command should have made."""
    out = np.empty(recording.fit.size)
    longest = HYSTERESIS_STEP_S if p['valve_hysteresis_model'] == FULL else STEP_S
    blocks.valve(recording.command, *blocks.parts(p), recording.period_s,
                 recording.sub_steps(longest), out)
    return out


def _velocity(recording: Recording, p: np.void) -> Array:
    """Return the velocity (m/s) of the piston; not measured, what the nominal load would do."""
    if recording.velocity is not None:
        return recording.velocity
    motion = recording.motion
    if motion is not None:
        return motion.velocity[motion.pad:motion.pad + recording.fit.size]
    mass, damping, stiffness = blocks.load_constants(p)
    count = recording.fit.size
    if mass == 0.0 or stiffness == 0.0 or recording.force is None:
        return np.zeros(count)
    frequency = np.fft.rfftfreq(count, recording.period_s)
    s = 2j * np.pi * frequency
    velocity = s / (mass * s * s + damping * s + stiffness) * np.fft.rfft(recording.force)
    return np.fft.irfft(velocity * low_pass(frequency, 0.1 / recording.period_s), count)


def _load(recording: Recording, p: np.void) -> Array:
    """Return the force (N) that the measured motion takes, as the sensor reads it, in band."""
    motion = recording.motion
    assert motion is not None
    _, damping, stiffness = blocks.load_constants(p)
    linear = (blocks.impedance(motion.omega, p) * motion.velocity_spectrum
              + stiffness * motion.position_spectrum)
    extra = np.zeros(motion.velocity.size)
    blocks.load_nonlinear(motion.position, motion.velocity, stiffness, damping,
                          blocks.parts(p)[1], recording.period_s,
                          -motion.pad * recording.period_s, extra)
    if p['compliance'] > 0.0:
        linear = blocks.compliant(motion.omega, motion.velocity_spectrum,
                                  motion.position_spectrum, p)
    total = ((linear + np.fft.rfft(extra)) * blocks.sensor_response(motion.omega, p)
             * blocks.drive_inverse(motion.omega, p) * motion.judge)
    count = recording.fit.size
    inner = np.fft.irfft(total, extra.size)[motion.pad:motion.pad + count]
    if not motion.measured:   # the offset is outside the band
        return inner
    time = recording.time_s
    return inner + (p['force_sensor_offset'] + p['sensor_offset'] + p['sensor_drift'] * time
                    + p['sensor_drift_curve'] * time * time)


def measured(recording: Recording, channel: str) -> Array:
    """Return what a channel has measured."""
    signal = {'valve': recording.valve_position, 'force': recording.force,
              'load': recording.force_judged}[channel]
    assert signal is not None
    return signal
