"""
A rigid joint or drive as nominal model, in the block language of the actuator.

Commanded by its force (or torque, or a voltage in proportion to it): a mass with viscous friction
and a constant offset, identified from the recording where no values are given. Commanded by its
position: a servo that follows at once.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from asi_actuator.parameters import Value
from asi_analysis.errors import InputError
from asi_analysis.gap.effects import Free
from asi_analysis.gap.fit import Group, make_group, plant_record
from asi_analysis.gap.prepare import Recording, prepare
from asi_analysis.run import Run

OFF = {f'{block}.model': 'off' for block in (
    'valve_hysteresis', 'valve_flexure', 'valve_characteristic', 'hydraulic_damping',
    'fluid_dynamics', 'friction', 'force_sensor')}
# An ideal servo: the position in metres is the command in metres.
IDEAL: dict[str, Value] = {**OFF, 'valve_characteristic.gain': 1.0, 'command_limit': 1e5,
                           'valve_characteristic.maximum_force': 1.0,
                           'valve_characteristic.full_opening': 0.01}
SERVO_SHARE = 0.1   # of the motion: a servo that follows better is not where the gap is


def drive_of(runs: Sequence[Run]) -> str:
    """
    Return what commands a joint: 'force' or 'position'.

    A recorded command is a force. Without one, a joint whose motion misses its reference by more
    than a tenth is a position servo; else its measured force drives it.
    """
    run = runs[0]
    if run.command_n is not None:
        return 'force'
    if run.reference_n is None or run.unit('reference') == 'N':
        if run.force_n is None:
            raise InputError(f'{run.source}: a joint needs a command, a force or a reference of '
                             'its motion; there are ' + ', '.join(run.signals()))
        return 'force'
    followed = run.signals().get(run.controlled())
    if followed is None:
        return 'force'
    missed = np.nanstd(followed - run.reference_n) / np.nanstd(followed)
    return 'position' if run.force_n is None or missed > SERVO_SHARE else 'force'


def joint_groups(runs: Sequence[Run], given: Mapping[str, Value], tolerance: float,
                 held_out: Sequence[bool], drive: str) -> list[Group]:
    """Return the one group of channels that a joint has."""
    recordings = prepare(runs, drive, held_out)
    if drive == 'position':
        nominal = plant_record(IDEAL)
        nominal['valve_characteristic_full_opening'] = 1.0
        nominal['load_mass'] = 0.0
        gain = Free('valve_characteristic_gain', 1.0 - tolerance, 1.0 + tolerance, (1.0,),
                    'nominal')
        return [make_group(nominal, recordings, ('valve',), nuisance=(gain,))]
    nominal = plant_record({**OFF, 'force_sensor.mass_share': 0.0, 'load.type': 'spring',
                            'load.stiffness': 0.0, **given})
    identified = _identified(recordings)
    nuisance = []
    for name, field in (('load.mass', 'load_mass'), ('load.damping', 'load_damping')):
        if name in given:
            nuisance.append(Free(field, 1.0 - tolerance, 1.0 + tolerance, (1.0,), 'nominal'))
        else:
            nominal[field] = abs(identified[field])
            nuisance.append(Free(field, 0.1, 3.0, (1.0,), 'nominal'))
    nominal['load_offset'] = identified['load_offset']
    nuisance.append(Free('load_offset', -0.5, 0.5, (0.0,), 'force'))
    return [make_group(nominal, recordings, ('load',), nuisance=tuple(nuisance))]


def _identified(recordings: Sequence[Recording]) -> dict[str, float]:
    """Return mass, damping and offset by linear least squares on the fitted parts."""
    rows, right = [], []
    for recording in recordings:
        motion, force = recording.motion, recording.force_judged
        if motion is None or force is None:
            raise InputError(f'{recording.source}: a joint that is driven by a force needs its '
                             'force (or command) and its position or velocity')
        count = motion.velocity.size
        inner = slice(motion.pad, motion.pad + recording.fit.size)
        columns = [np.fft.irfft(motion.velocity_spectrum * factor * motion.judge, count)[inner]
                   for factor in (1j * motion.omega, 1.0)]
        rows.append(np.column_stack([*columns, np.ones(recording.fit.size)])[recording.fit])
        right.append(force[recording.fit])
    solution = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]
    return dict(zip(('load_mass', 'load_damping', 'load_offset'), map(float, solution),
                    strict=True))
