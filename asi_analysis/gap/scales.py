"""Ranges of the signals: the units in which bounds and initial guesses of effects are given."""

from collections.abc import Sequence

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.gap.model.predict import predict
from asi_analysis.gap.model.simulator import simulated_motion
from asi_analysis.gap.prepare import Recording

Values = dict[str, float]


def _range(signals: Sequence[Array | None]) -> float:
    """Return the 99.9 % quantile of a signal's size, the largest over recordings; 1 if it is 0."""
    present = [np.quantile(np.abs(signal), 0.999) for signal in signals if signal is not None]
    return float(max(present, default=0.0)) or 1.0


def scales(recordings: Sequence[Recording]) -> Values:
    """Return the units of the bounds of effects, by the ranges of the signals."""
    motions = [recording.motion for recording in recordings if recording.motion]
    command = _range([recording.command for recording in recordings])
    force = _range([recording.force for recording in recordings])
    velocity = _range([motion.velocity[motion.inner] for motion in motions])
    position = _range([motion.position[motion.inner] for motion in motions])
    duration = max(recording.fit.size * recording.period_s for recording in recordings)
    return {
        '': 1.0, 'command': command, 'force': force,
        'valve_position': _range([r.valve_position for r in recordings]),
        'drift': force / duration, 'drift_curve': force / duration ** 2,
        'drift_bend': force / duration ** 3,
    } | _of_motion(force, velocity, position)


def _of_motion(force: float, velocity: float, position: float) -> Values:
    """Return the units that hold ranges of the motion."""
    return {'velocity': velocity, 'position': position, 'damping': force / velocity,
            'damping_quadratic': force / velocity ** 2, 'compliance': position / force}


def with_motion(scale: Values, recordings: Sequence[Recording], p: np.void) -> Values:
    """Return scales with the ranges of the simulator's nominal motion, if none was measured."""
    if any(r.motion is not None or r.command is None for r in recordings):
        return scale
    motions = [simulated_motion(r, p) for r in recordings]
    velocity, position = (_range([motion[row] for motion in motions]) for row in (0, 1))
    return scale | _of_motion(scale['force'], velocity, position)


def with_valve(scale: Values, recordings: Sequence[Recording], p: np.void) -> Values:
    """Return scales with the nominal model's range of the valve position, if not measured."""
    if any(r.valve_position is not None or r.command is None for r in recordings):
        return scale
    return scale | {'valve_position': _range([predict(r, 'valve', p) for r in recordings])}


def with_valve_force(scale: Values, nominal: np.void) -> Values:
    """
    Return scales whose force is at least the hydraulic force of the valve.

    With a free load, damping and seals balance most of it, and the sensor measures little.
    """
    opening = min(scale['valve_position'] / float(nominal['valve_characteristic_full_opening']),
                  1.0)
    ratio = max(opening * float(nominal['valve_characteristic_maximum_force']) / scale['force'],
                1.0)
    return scale | {name: ratio * scale[name] for name in ('force', 'damping',
                                                           'damping_quadratic')}
