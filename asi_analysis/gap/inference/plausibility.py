"""
Refuse, or warn of, recordings that would lead to a confident wrong answer.

These are mistakes of a recording, not of a model: a reversed sign, a factor of ten or a thousand,
clocks that differ, no excitation, another machine.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.signal import correlate

from asi_actuator.model.load import FREE
from asi_analysis.arrays import Array, Mask
from asi_analysis.bags.exchange.column_mapping import UNITS_OF
from asi_analysis.bags.run import SIGNALS, Run
from asi_analysis.errors import InputError
from asi_analysis.gap.model.effects import MOTIONS, Free
from asi_analysis.gap.model.group import Group
from asi_analysis.gap.model.predict import measured, predict
from asi_analysis.gap.motion import agree, velocity_over_derivative
from asi_analysis.gap.prepare import MEASURED, Recording, velocity_of
from asi_analysis.gap.sampling import clipped, noise_of
from asi_common.jit import FULL
from asi_common.parameter import Value

LEAST_SWING = 5.0      # least rms of a signal, as a multiple of its noise
FACTOR = 4.0           # ratio of sizes to the model's above which the unit is wrong
SOFT_LOAD_FACTOR = 2.0   # the same is larger by this for a load that is softer than its model
LEAST_CORRELATION = 0.3  # correlation with the model below which it is another machine
SHAPE_CORRELATION = 0.6  # correlation above which a factor or a reversed sign is reliable
LARGEST_FACTOR = 20.0  # a factor that is refused whatever the shape
# A load takes power: below the negative of this, the correlation of force and velocity shows a
# reversed sign.
AGAINST_MOTION = 0.2
# Correlation with velocity, acceleration and speed below which a force is of another motion.
UNRELATED = 0.1
EARLIEST_S, LATEST_S = 0.004, 0.08
EARLY_SAMPLES = 1.5    # or so many samples: an answer may be logged with the next command
SHIFTED_CORRELATION = 0.93  # correlation, after a time shift, above which only that differs
SHIFT_GAIN = 0.1       # by which a shift of the clock must raise the correlation

# The output and the input of each channel.
COMPARED = {'valve': ('valve_position', 'command'), 'force': ('force', 'valve_position'),
            'load': ('force', 'velocity or position'),
            'velocity': ('velocity', 'command'), 'position': ('position', 'command')}


def check_signals(run: Run) -> list[str]:
    """Return a warning of each signal that is constant, or cut off at its extremes."""
    notes = []
    for name, values in run.signals().items():
        known = values[np.isfinite(values)]
        if known.size and np.ptp(known) == 0.0:
            notes.append(f'{run.source}: {name} is constant, and taken as not recorded')
        elif name in MEASURED and known.size and (cut := clipped(known)).any():
            share = f'in {100 * cut.mean():.1f} % of the samples'
            notes.append(f'{run.source}: {name} ' + (
                f'stands still at its extremes, {share}: at a stop of the valve, or its sensor '
                'reaches no farther' if name == 'valve_position' else
                f'is cut off at its extremes, {share}; these are left out'))
    return notes


def check_cut_off(run: Run) -> list[str]:
    """Return a note if the force is cut off: its effect on the load is then unknown."""
    force = run.signals().get('force', np.zeros(0))
    if not clipped(force[np.isfinite(force)]).any():
        return []
    return [f'{run.source}: the force is cut off at its extremes: the motion of the load, which '
            'follows from it, is not judged']


def check_units(run: Run) -> None:
    """Refuse a recording whose signals are not in the actuator's units."""
    for signal in SIGNALS:
        unit = run.unit(signal.name)
        if signal.name in run.signals() and signal.name != 'reference' and unit != signal.unit:
            raise InputError(f"{run.source}: {signal.name} is in {unit}, the actuator's in "
                             f'{signal.unit}; of a joint or drive: --plant joint')


def check_units_of_motion(run: Run) -> None:
    """Refuse a joint whose motion is neither in metres nor in radians: gravity needs an angle."""
    for name in MOTIONS:
        unit = run.unit(name)
        if name in run.signals() and unit not in UNITS_OF[name]:
            raise InputError(f'{run.source}: {name} is in {unit!r}; of a joint it takes '
                             f'{" or ".join(UNITS_OF[name])}')


def check_joint(group: Group) -> None:
    """Refuse a joint whose signals are uncorrelated, or of opposite sign."""
    for recording in group.recordings:
        for channel in group.channels:
            real, model = measured(recording, channel), predict(recording, channel, group.nominal)
            valid = recording.valid
            if channel == 'load':
                what = 'force (or command) compared with that of the motion'
                against = recording.moved
                # A load takes power, whatever it is made of, and friction always does: in the
                # mean, and in what varies.
                velocity = against.velocity[against.inner]
                with_velocity = max(float(np.corrcoef(real[valid], velocity[valid])[0, 1]),
                                    _power_share(recording, velocity, valid))
                # A delayed force of a mass, however, may oppose the velocity.
                with_acceleration = float(np.corrcoef(
                    real[valid], np.gradient(velocity)[valid])[0, 1])
                reversed_ = with_velocity < -AGAINST_MOTION and with_acceleration < AGAINST_MOTION
                # A current that was recorded without its sign is of its motion, too.
                with_speed = float(np.corrcoef(real[valid], np.abs(velocity[valid]))[0, 1])
                with_position = float(np.corrcoef(   # of a spring, or gravity
                    real[valid], against.position[against.inner][valid])[0, 1])
                if not reversed_ and max(with_velocity, abs(with_acceleration),
                                         abs(with_position), with_speed) < UNRELATED:
                    raise InputError(
                        f'{recording.source}: force (or command) and motion do not belong '
                        'together: the force moves no mass, and no spring or friction answers '
                        'it; are columns swapped, or of two recordings?')
                real_size, model_size = float(np.std(real[valid])), float(np.std(model[valid]))
                # With friction and gravity the force is larger than the model's, not smaller.
                if LARGEST_FACTOR * real_size < model_size:
                    raise InputError(f'{recording.source}: {what}: a factor of '
                                     f'{real_size / model_size:.3g}; check the units, or '
                                     'load.mass and load.damping of the model')
            else:
                what = 'output of the drive compared with its command'
                correlation = float(np.corrcoef(real[valid], model[valid])[0, 1])
                reversed_ = correlation < -SHAPE_CORRELATION
                # A known servo is compared with its command, which it follows: its model may be
                # slower than the real one.
                known = group.nominal['valve_flexure_model'] == FULL
                driving = recording.input if known else model
                shift, shifted = best_delay(real[valid], driving[valid], recording.period_s)
                if abs(shifted) < LEAST_CORRELATION and not reversed_:
                    raise InputError(f'{recording.source}: {what}: not correlated')
                slope = float(np.std(real[valid]) / np.std(model[valid]))
                if shifted > SHAPE_CORRELATION and not 1.0 / FACTOR < slope < FACTOR:
                    raise InputError(f'{recording.source}: {what}: a factor of {slope:.3g}; check '
                                     'the units')
                if shift < -_earliest(recording) and shifted > SHAPE_CORRELATION:
                    raise InputError(f'{recording.source}: {what}: the output comes '
                                     f'{-1e3 * shift:.0f} ms before it; the clocks differ')
            if reversed_:
                raise InputError(f'{recording.source}: {what}: the sign is reversed; check the '
                                 'signs of both, and whether their columns are swapped')


def _power_share(recording: Recording, velocity: Array, valid: Mask) -> float:
    """Return the mean power of the force, as a share of what in-phase signals would have."""
    force = recording.force if recording.force is not None else recording.input
    whole = (force + recording.taken.get('constant', 0.0))[valid]
    return float(np.mean(whole * velocity[valid])
                 / np.sqrt(np.mean(whole ** 2) * np.mean(velocity[valid] ** 2)))


def check_excitation(recording: Recording) -> None:
    """Refuse a recording whose command or force does not vary."""
    for name in ('command', 'force'):
        values = getattr(recording, name)
        if (values is not None and np.std(values) < LEAST_SWING * recording.noise[name]
                and not (name == 'command' and _moves_something(recording))
                and not (name == 'force' and _moves_freely(recording))):
            raise InputError(
                f'{recording.source}: no excitation: {name} swings by {np.std(values):.3g} (rms), '
                f'its noise is {recording.noise[name]:.3g}; record a run in which it moves')


def _moves_something(recording: Recording) -> bool:
    """Return whether force or valve position follow a command that looks like noise."""
    answer = recording.valve_position
    answer = recording.force if answer is None else answer
    return (answer is not None and recording.command is not None
            and best_delay(answer, recording.command, recording.period_s)[1] > LEAST_CORRELATION)


def _moves_freely(recording: Recording) -> bool:
    """Return whether the piston moves although there is no force, as a free piston does."""
    return any(np.std(moved) > LEAST_SWING * noise_of(moved)
               for moved in (velocity_of(recording), recording.raw_position) if moved is not None)


def check_motion(run: Run) -> list[str]:
    """Return a warning if velocity is not the derivative of position; it is then not used."""
    if run.velocity_m_s is None or run.position_m is None:
        return []
    known = np.isfinite(run.velocity_m_s) & np.isfinite(run.position_m)
    position, velocity = run.position_m[known], run.velocity_m_s[known]
    if agree(position, velocity, run.period_s):
        return []
    slope = 1.0 / velocity_over_derivative(position, velocity, run.period_s)
    return [f'{run.source}: velocity is not the derivative of position: that is {slope:.3g} times '
            'as large; check sign and unit of velocity, which is left out']


def check_origin(recording: Recording) -> list[str]:
    """Return a note if the position does not count from where the piston rests at the start."""
    origin_m = recording.origin_m
    if not origin_m:
        return []
    return [f'{recording.source}: position_m starts at rest at {origin_m:.3g} m and counts from '
            'there; a constant force that held the load there before cannot be seen']


def doubtful_origin(recordings: Sequence[Recording], nominal: Mapping[str, Value]) -> list[str]:
    """Return a note of each recording in which a shifted position may be a constant effect."""
    if nominal.get('load.type', 'locked') not in ('locked', 'spring'):
        return []
    return [f'{recording.source}: does not start at rest without a force, so its position_m is '
            'taken to be 0 where the load is relaxed: a shifted zero looks like a constant force, '
            'and a bias of the valve like an offset of the force sensor'
            for recording in recordings
            if recording.motion and recording.motion.measured and recording.origin_m is None]


def _earliest(recording: Recording) -> float:
    """Return by how much (s) the time stamp of an output may be before that of its input."""
    return max(EARLIEST_S, EARLY_SAMPLES * recording.period_s)


def check_against_model(group: Group, alike: bool = False) -> list[str]:
    """
    Return warnings of outputs that come before their inputs.

    Raises InputError for a channel that differs from the model by more than any effect explains.
    alike: only if its shape is that of the model, so that a sign, a unit or a clock is wrong.
    """
    notes = []
    for recording in group.recordings:
        # The load first: the model of the force uses the velocity of the same motion.
        for channel in sorted(group.channels, reverse=True):
            real, model = measured(recording, channel), predict(recording, channel, group.nominal)
            valid = recording.valid
            if max(np.std(real[valid]), np.std(model[valid])) < LEAST_SWING * group.noise[channel]:
                continue   # it hardly varies, as the force of a free piston
            output, driven = COMPARED[channel]
            if driven == 'valve_position' and recording.valve_position is None:
                driven = 'command'
            where = (f'{recording.source}: {output} compared with the response of the model to '
                     f'{driven}')
            if np.std(model[valid]) == 0.0:
                if alike:
                    continue
                raise InputError(f'{where}: that is constant')
            correlation = float(np.corrcoef(real[valid], model[valid])[0, 1])
            slope = float(np.std(real[valid]) / np.std(model[valid]))
            if correlation < -SHAPE_CORRELATION:
                raise InputError(f'{where}: the sign is reversed (correlation {correlation:.2f}); '
                                 f'check the sign of {output} and of {driven}')
            soft = SOFT_LOAD_FACTOR if channel in ('load', *MOTIONS) else 1.0
            least = 1.0 / (soft * FACTOR)
            implausible = not 1.0 / LARGEST_FACTOR < slope < LARGEST_FACTOR
            of_shape = correlation > SHAPE_CORRELATION
            if (implausible and (of_shape or not alike)) or (
                    of_shape and not alike and not least < slope < FACTOR):
                load = '' if int(group.nominal['load_type']) != FREE else (
                    ': its load is free, so that force and motion are those of the mass alone')
                raise InputError(f'{where}: a factor of {slope:.3g}; check the unit of {output} '
                                 f'and of {driven}, or the model{load}')
            shift, shifted = best_delay(real[valid], model[valid], recording.period_s)
            if shifted < LEAST_CORRELATION and not alike:
                raise InputError(f'{where}: not correlated (correlation {correlation:.2f}): '
                                 'this is not the actuator of the model, or not '
                                 'the signal that its name says')
            early = shift < -_earliest(recording)
            off = (f'{where}: {"late" if shift > 0.0 else "early"} by {abs(shift) * 1e3:.0f} ms '
                   f'(correlation {correlation:.3f}, shifted {shifted:.3f}): the clocks of '
                   f'{output} and {driven}')
            # A free load may also lead a model of wrong damping, but is less correlated.
            if shifted > max(correlation + SHIFT_GAIN, SHIFTED_CORRELATION) and (
                    shift > LATEST_S or early and shift < -_earliest(recording)
                    - _earlier_within_tolerance(group, recording, channel)):
                raise InputError(f'{off} differ')
            if early and 1.0 - shifted < 0.5 * (1.0 - correlation):
                notes.append(f'{off} may differ')
    return notes


def _earlier_within_tolerance(group: Group, recording: Recording, channel: str) -> float:
    """
    Return by how much (s) parameters within their tolerance shift the response of the model.

    At most LATEST_S. The force of a cylinder, for one, is a small difference of thrust and
    damping.
    """
    valid, model = recording.valid, predict(recording, channel, group.nominal)

    def shift(field: str, times: float) -> float:
        p = group.nominal.copy()
        p[field] *= times
        response = predict(recording, channel, p)[valid]
        if np.std(response) == 0.0:
            return 0.0
        delay, alike = best_delay(response, model[valid], recording.period_s)
        return abs(delay) if alike > SHIFTED_CORRELATION else 0.0   # else it is another shape

    shifts = [max(shift(free.field, times) for times in (1.0 - off, 1.0 + off))
              for free in group.nuisance if (off := _tolerance(free)) > 0.0]
    return min(math.hypot(*shifts), LATEST_S)


def _tolerance(free: Free) -> float:
    """Return the tolerance of a nominal parameter, over its nominal value; 0: it has none."""
    if free.scale != 'nominal':
        return 0.0
    if free.prior < math.inf:
        return 2.0 * free.prior
    # Bounds of a block-wise model; those of a shape of a law are none.
    off = free.high - 1.0
    return off if math.isclose(free.low, 1.0 - off) else 0.0


def best_delay(real: Array, model: Array, period: float) -> tuple[float, float]:
    """Return the delay (s) of `real` behind `model` with the largest correlation, and that."""
    a, b = real - real.mean(), model - model.mean()
    most = min(int(1.0 / period), a.size // 4)
    both = correlate(a, b, 'full', 'fft') / (np.linalg.norm(a) * np.linalg.norm(b))
    middle = b.size - 1
    window = both[middle - most:middle + most + 1]
    best = int(np.argmax(window))
    return (best - most) * period, float(window[best])
