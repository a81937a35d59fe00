"""
A joint as plain numbers, as a simulator takes them: `joint_model` of a diagnosis.

And as parameters of the node that simulates it (`plant: joint`): `node_parameters`.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np

from asi_actuator.joint_parameters import JOINT_PARAMETERS
from asi_analysis.arrays import Array
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.gap.diagnosis import Diagnosis
from asi_analysis.gap.findings.one_sensor import of_the_drive
from asi_analysis.gap.inference.hypotheses import Candidate, Weighed
from asi_analysis.gap.inference.uncertainty import interval, likelihood
from asi_analysis.gap.model.effects import UNKNOWN, Variant, of_recording
from asi_analysis.gap.model.group import RIGID_ERROR
from asi_analysis.gap.model.model_file import (
    coupling_parameters,
    external_force,
    friction_parameters,
)
from asi_analysis.gap.model.static import zero_of
from asi_analysis.gap.sizes import is_shown
from asi_analysis.gap.words import SIZES, between, digits, in_words, unit_of_free
from asi_common.jit import FULL
from asi_common.parameter import Value, defaults

# Fields of the diagnosis that a `JointModel` has a field for, by the channel that they are of.
HELD: Final = {
    'load': frozenset(('load_mass', 'load_damping', 'load_stiffness', 'load_offset', 'drive_hold',
                       'drive_held', 'drive_delay', 'drive_lag', 'drive_loss', 'viscous',
                       'friction_level', 'friction_asymmetry', 'gravity_sine', 'gravity_cosine')),
    'valve': frozenset(('valve_characteristic_gain', 'command_delay', 'command_bias', 'valve_lag',
                        'valve_limit', 'valve_flexure_natural_frequency',
                        'valve_flexure_damping_ratio', 'servo_rate', 'servo_acceleration',
                        'servo_friction', 'servo_upper', 'servo_lower'))}
# Fields that the parameters of a node hold.
WRITTEN: Final = {
    'load': HELD['load'] | {
        'friction_breakaway', 'backlash', 'compliance', 'disturbance', 'disturbance_wave',
        'disturbance_frequency', 'disturbance_pulse', 'disturbance_start', 'disturbance_end',
        'sensor_offset', 'sensor_gain_error', 'sensor_lag', 'sensor_drift'},
    'valve': HELD['valve'] - {'servo_upper', 'servo_lower'} | {
        'command_quantum', 'command_deadband', 'servo_breakaway'}}
# Parameters of a node that are written even where they have the default.
ALWAYS: Final = frozenset(('joint.type', 'load.mass', 'load.damping'))
PARAMETERS: Final = frozenset(parameter.name for parameter in JOINT_PARAMETERS)
# What is said of fields that are no sizes of effects.
NAMES: Final = {'load_mass': 'inertia', 'load_damping': 'damping',
                'load_stiffness': 'stiffness',
                'valve_flexure_natural_frequency': 'natural frequency',
                'valve_flexure_damping_ratio': 'damping ratio',
                'servo_rate': 'limit of the speed',
                'servo_acceleration': 'limit of the acceleration',
                'load_offset': 'constant load',
                'valve_characteristic_gain': 'gain'}
# Damping of what rubs, as a share of critical, before it slides: the fit has none, and the
# simulated joint would ring.
RUBBING_DAMPING: Final = 0.2
# The nearest to an effect that a simulator's joint has no field for, or not for all its sizes.
NEAREST: Final = dict.fromkeys(('coulomb_friction', 'stiction', 'friction_asymmetry'),
                               'coulomb_friction')
# A servo that follows at once: time of its response, as a share of delay and lag, or in samples.
SHARE_LATE: Final = 0.1
SAMPLES: Final = 1.0


class JointModel(NamedTuple):
    """
    A joint with its drive, in SI units: of a joint that turns rad, N m, kg m2.

        inertia a = push - damping v - friction sign(v) - stiffness (q - rest)
                    - sine sin(q) - cosine cos(q)
        push = gain u + bias - kp q - kv v

    u is the command, late by `delay_s` and `lag_s`; of a servo the reference. Where the command is
    no force, its `unit` stands in place of that.
    """

    turns: bool
    inertia: float
    damping: float = 0.0
    friction: float = 0.0
    stiffness: float = 0.0
    rest: float = 0.0
    sine: float = 0.0
    cosine: float = 0.0
    gain: float = 1.0
    bias: float = 0.0
    kp: float = 0.0
    kv: float = 0.0
    delay_s: float = 0.0
    lag_s: float = 0.0
    least_command: float = -np.inf
    most_command: float = np.inf
    most_push: float = np.inf      # of gain u + bias - kp q - kv v, either way
    most_speed: float = np.inf     # of a servo
    unit: str = ''                 # of the command or force
    period_s: float = 1e-3         # of the samples
    travel: tuple[float, float] = (0.0, 0.0)   # of the recording, with its largest force, speed
    seen_push: float = 0.0
    seen_speed: float = 0.0
    notes: Mapping[str, str] = MappingProxyType({})   # values in words, with intervals, by field
    loads: tuple[float, ...] = ()  # constant load of each recording, beyond the first's
    unsaid: tuple[str, ...] = ()   # what was found that has no field here


def joint_model(diagnosis: Diagnosis, nominal: bool = False) -> JointModel:
    """
    Return the joint with what was found, or the nominal one.

    Raises InputError for a joint without a motion, or that follows anything but a position.
    """
    run = diagnosis.runs[0]
    groups = {weighed.group.channels[0]: weighed for weighed in diagnosis.groups}
    servo = 'load' not in groups
    if servo and (run.reference_n is None or run.controlled() != 'position'):
        raise InputError(f'{run.source}: --export takes a joint that is moved by a force, or that '
                         'follows a reference of its position')
    notes: dict[str, str] = {}
    unsaid: list[str] = []
    for weighed in () if nominal else groups.values():
        more, left = _in_words(diagnosis, weighed)
        notes |= more
        unsaid += left
    records = {channel: weighed.group.as_given if nominal else
               _record(channel, _held(diagnosis, weighed)) for channel, weighed in groups.items()}
    if servo:
        found = _followed(groups['valve'], records['valve'], run)
    else:
        found = moved_by(groups['load'], records['load'], diagnosis.runs)
        if 'valve' in records:
            found = _driven(found, records['valve'])
    if UNKNOWN in diagnosis.verdict and not nominal:
        unsaid.append(in_words(UNKNOWN, 'joint'))
    return found._replace(notes={**notes, **found.notes}, unsaid=(*unsaid, *found.unsaid))


def moved_by(weighed: Weighed, p: np.void, runs: Sequence[Run]) -> JointModel:
    """Return a joint that is moved by a force."""
    run = runs[0]
    recording = weighed.group.recordings[0]
    taken, motion = recording.taken, recording.moved
    origin = _origin(run)
    unit = run.unit('position' if run.position_m is not None else 'velocity')
    level = float(p['friction_level'])
    # Friction level (sign(v) + asymmetry) is even friction and a constant force.
    gain = 1.0 - float(p['drive_loss'])
    constant = (gain * taken.get('constant', 0.0) + float(p['load_offset'] - p['disturbance'])
                + level * float(p['friction_asymmetry']))
    inner = motion.position[motion.inner] + origin
    delay = float(p['drive_delay'])
    notes = {}   # of what was identified before the fit, or is written as another value
    if delay:   # a command that is held is late by half a sample without any
        delay += float(p['drive_hold']) - 0.5 * recording.period_s * (run.force_n is None)
        notes['delay'] = (f'delay here {digits(delay, "s")}: a command that is held for each '
                          'sample is late by half of it without')
    lag, second = poles(p, 'drive_lag')
    sine, cosine = (taken.get(name, 0.0) + float(p[name])
                    for name in ('gravity_sine', 'gravity_cosine'))
    driving = 'command' if run.force_n is None else 'force'
    force = run.unit(driving)
    if sine or cosine:
        notes['gravity'] = (f'gravity {digits(sine, force)} sin q and {digits(cosine, force)} '
                            'cos q')
    if 'constant' in taken:
        load = digits(gain * taken['constant'], force)
        notes['constant'] = f'beside the constant load {load} (no interval)'
    # Each recording has its own origin, the same spring acts on all.
    spring = float(p['load_stiffness'])
    constants = [r.taken.get('constant', 0.0) + float(p[of_recording('load_offset', r.number)])
             - spring * _origin(each) for each, r in zip(runs, weighed.group.recordings,
                                                         strict=True)]
    loads = [each - constants[0] for each in constants]
    pushed = _most(run.signal(driving))
    mass, damping = float(p['load_mass']), float(p['load_damping'] + p['viscous'])
    if mass < damping * recording.period_s:
        mass = damping * recording.period_s
        notes['too_small'] = 'the inertia is too small to show: that of a sample is taken'
    return JointModel(
        unit.startswith('rad'), mass, damping, level, spring, origin, sine,
        cosine, gain=gain, bias=-constant, delay_s=delay + second, lag_s=lag,
        period_s=recording.period_s, travel=(float(inner.min()), float(inner.max())),
        seen_push=pushed,
        seen_speed=_most(motion.velocity[motion.inner]), notes=notes, unit=force,
        loads=tuple(loads),
        unsaid=tuple(f'constant load of recording {number}, {digits(each, force)} more'
                     for number, each in enumerate(loads, 1) if abs(each) > RIGID_ERROR * pushed))


def poles(p: np.void, field: str) -> tuple[float, float]:
    """Return the time constants of a lag, s; the second, which is shorter, acts as a delay."""
    time, split = float(p[field]), float(p[f'{field}_split'])
    return time * (1.0 - split), time * split


def _lags(p: np.void, field: str) -> dict[str, Value]:
    """Return the two time constants of a lag, as parameters of a node's drive."""
    return dict(zip(('drive.lag_time', 'drive.second_lag_time'), poles(p, field), strict=True))


def _origin(run: Run) -> float:
    """Return the position from which the fit counts that of a recording."""
    return 0.0 if run.position_m is None else float(np.nanmean(run.position_m))


def _driven(moved: JointModel, p: np.void) -> JointModel:
    """Return a joint whose force is what a drive makes of its command."""
    gain = float(p['valve_characteristic_gain'])
    shift, most = float(p['command_bias']), (float(p['valve_limit']) or np.inf) / abs(gain)
    lag, second = poles(p, 'valve_lag')
    return moved._replace(
        gain=gain, bias=moved.bias + gain * shift, delay_s=float(p['command_delay']) + second,
        lag_s=lag, least_command=-most - shift, most_command=most - shift)


def _followed(weighed: Weighed, p: np.void, run: Run) -> JointModel:
    """Return a servo of a unit inertia that follows a reference of its position."""
    recording = weighed.group.recordings[0]
    assert run.reference_n is not None and run.position_m is not None
    gain = float(p['valve_characteristic_gain'])
    origin = float(np.nanmean(run.reference_n))
    lag, second = poles(p, 'valve_lag')
    delay = float(p['command_delay']) + second
    rate, most_push = (float(p[f'servo_{name}']) or np.inf for name in ('rate', 'acceleration'))
    limited = bool(np.isfinite(rate))
    unsaid: tuple[str, ...] = ()
    notes: dict[str, str] = {}
    if p['valve_flexure_model'] == FULL:
        w = 2.0 * np.pi * float(p['valve_flexure_natural_frequency'])
        damping = float(p['valve_flexure_damping_ratio'])
        unsaid = tuple(_loop_in_words(p, w, damping))
        # A push that the damping of the joint balances at the largest speed.
        if limited:
            steady = 2.0 * damping * w * rate
            if most_push < steady:
                unsaid += (f'acceleration of the servo, at most {digits(most_push)} '
                           f'{run.unit("position")}/s2',)
            most_push = steady
    else:
        # The response of a critically damped servo is late by 2 / w, which the delay, then the lag
        # have less.
        late = max(SHARE_LATE * (delay + lag), SAMPLES * recording.period_s)
        w, damping = 2.0 / late, 1.0
        delay, lag = max(delay - late, 0.0), max(min(lag, delay + lag - late), 0.0)
        notes = {'servo': f'kp and kv are of a servo that follows within {digits(late, "s")}: the '
                          'recording shows no slower one'}
    shift, most = float(p['command_bias']), (float(p['valve_limit']) or np.inf) / gain
    lowest, highest = ((float(p['servo_lower']), float(p['servo_upper'])) if p['servo_limited']
                       else (-most, most))
    return JointModel(
        run.unit('position') == 'rad', 1.0, gain=w * w * gain, kp=w * w,
        bias=w * w * (origin * (1.0 - gain) + gain * shift),
        kv=0.0 if limited else 2.0 * damping * w, damping=2.0 * damping * w if limited else 0.0,
        friction=w * w * float(p['servo_friction']),
        delay_s=delay, lag_s=lag, least_command=origin - shift + lowest,
        most_command=origin - shift + highest,
        most_push=most_push, most_speed=rate,
        period_s=recording.period_s, notes=notes, unsaid=unsaid,
        travel=(float(np.nanmin(run.position_m)), float(np.nanmax(run.position_m))),
        seen_push=w * w * float(np.ptp(run.position_m[np.isfinite(run.position_m)])),
        seen_speed=_most(np.gradient(run.position_m, run.time_s)))


def _loop_in_words(p: np.void, w: float, damping: float) -> Iterator[str]:
    """Yield what the loop of a servo (natural frequency rad/s, damping ratio) has beyond these."""
    lead, share = float(p['servo_lead']), float(p['servo_lag_share'])
    if lead * abs(1.0 - share) > SHARE_LATE * 2.0 * damping / w:   # they do not cancel
        yield (f'a lead of the servo of {digits(lead, "s")}, and a lag of '
               f'{digits(share * lead, "s")} of its integral action')
    if p['servo_friction'] > 0.0 and p['servo_integral'] > 0.0:
        yield ('integral action of the servo, that takes friction over at '
               f'{digits(float(p["servo_integral"]))} 1/s')


def followed_law(weighed: Weighed, p: np.void, run: Run) -> dict[str, Value]:
    """
    Return the servo of a unit inertia as parameters of a simulated joint.

    Its acceleration and rate are limited as in the law that was fitted (servo/law.py), which a
    force against a damping of MJCF only resembles.
    """
    found = _followed(weighed, p, run)
    values: dict[str, Value] = {
        'load.mass': found.inertia, 'servo.kp': found.kp, 'servo.kv': found.kv or found.damping,
        'drive.gain': found.gain / found.kp, 'drive.bias': found.bias / found.kp,
        'command_path.delay': found.delay_s - poles(p, 'valve_lag')[1],
        'servo.rate_limit': float(p['servo_rate']),
        'servo.acceleration_limit': float(p['servo_acceleration']), **_lags(p, 'valve_lag')}
    if found.friction:
        values['friction.coulomb'] = found.friction
    if p['servo_breakaway'] > 0.0:
        breakaway = found.friction * (1.0 + float(p['servo_breakaway']))
        values |= {'friction.stiction_push': breakaway, 'friction.stiction_pull': breakaway,
                   'friction.stribeck_velocity': float(p['servo_stribeck'])}
    if p['valve_flexure_model'] != FULL:   # at once: the lag is the servo's own
        values |= {'command_path.delay': found.delay_s, 'drive.lag_time': found.lag_s,
                   'drive.second_lag_time': 0.0}
    return values


def _said(diagnosis: Diagnosis, groups: Mapping[str, Weighed]) -> tuple[list[str], list[str]]:
    """Return the values of the verdict in words: of fields that are WRITTEN, and of others."""
    said: list[str] = []
    unsaid = [in_words(UNKNOWN, 'joint')] if UNKNOWN in diagnosis.verdict else []
    for channel, weighed in groups.items():
        for field, text in _sizes(diagnosis, weighed, diagnosis.best(weighed)).items():
            (said if field.partition('@')[0] in WRITTEN[channel] and '@' not in field
             else unsaid).append(text)
    return said, unsaid


def _most(values: Array) -> float:
    """Return the largest size of a signal, rare peaks left out."""
    return float(np.nanquantile(np.abs(values), 0.999))


def _record(channel: str, found: Candidate) -> np.void:
    """Return the fitted record of a channel, that of the drive without what is the sensor's."""
    p = found.fitted.record
    return of_the_drive(p, found.names) if channel == 'valve' else p


def _held(diagnosis: Diagnosis, weighed: Weighed) -> Candidate:
    """
    Return the verdict of a group as far as a joint model has fields for it.

    Where it has none for an effect, the fit without that: what remains of a fit, once a part is
    left out, fits worse.
    """
    best = diagnosis.best(weighed)
    names = {NEAREST.get(name, '') if variant in _unsaid_variants(best, weighed) else name
             for variant, name in _effects(best, weighed).items()} - {''}
    return next((candidate for each, candidate in weighed.candidates.items()
                 if set(each) == names), best)


def _effects(best: Candidate, weighed: Weighed) -> dict[Variant, str]:
    """Return the effect that each variant of a hypothesis is of."""
    return {form: name for name, forms in weighed.group.effects.items() if name in best.names
            for form in forms if form in best.variants}


def _unsaid_variants(best: Candidate, weighed: Weighed) -> list[Variant]:
    """Return the variants that set a size that a joint model has no field for."""
    held = HELD[weighed.group.channels[0]]
    return [variant for variant in best.variants for free in variant.free
            if best.fitted.record[free.field] != 0.0
            and free.field.partition('@')[0] in SIZES.keys() - held]


def _in_words(diagnosis: Diagnosis, weighed: Weighed) -> tuple[dict[str, str], list[str]]:
    """Return the values of a group that a joint model holds, and those of the verdict beyond."""
    best, kept = diagnosis.best(weighed), _held(diagnosis, weighed)
    held = _sizes(diagnosis, weighed, kept)
    more = {} if kept is best else _sizes(diagnosis, weighed, best)
    fields = HELD[weighed.group.channels[0]]
    return ({field: text for field, text in held.items() if field in fields},
            [text for field, text in (held | more).items() if field not in fields])


def _sizes(diagnosis: Diagnosis, weighed: Weighed, candidate: Candidate) -> dict[str, str]:
    """Return the fitted values of a hypothesis in words, by field."""
    fitted, channel = candidate.fitted, weighed.group.channels[0]
    known = likelihood(fitted)
    effects = {free.field: in_words(name, 'joint') + ': ' for variant, name in
               _effects(candidate, weighed).items() for free in variant.free}
    found = {}
    for free in fitted.free:
        field, _, recording = free.field.partition('@')
        word = NAMES.get(field) or SIZES.get(field)
        if (word is None or fitted.record[free.field] == 0.0 or (recording and field in NAMES)
                or not is_shown(fitted, free.field)):
            continue
        unit = '' if field == 'valve_characteristic_gain' else unit_of_free(
            free, channel, diagnosis.runs[0], 'joint')
        low, high = interval(fitted, known, free.field)
        zero = zero_of(weighed.group, field)
        size = between(zero + float(fitted.record[free.field]), zero + low, zero + high, unit)
        found[free.field] = (f'{effects.get(free.field, "")}{word} {size}'
                             + (f' in recording {recording}' if recording else ''))
    return found


def node_parameters(diagnosis: Diagnosis, given: Mapping[str, Value]
                    ) -> tuple[dict[str, Value], list[str], list[str]]:
    """
    Return the joint with what was found, as parameters by name; values in words; what is left out.

    given: the nominal parameters, such as those of a servo in the metadata of the bag; what is
    identified takes their place. Raises InputError for a joint that a node cannot simulate.
    """
    groups = {weighed.group.channels[0]: weighed for weighed in diagnosis.groups}
    records = {channel: _record(channel, diagnosis.best(weighed))
               for channel, weighed in groups.items()}
    run = diagnosis.runs[0]
    values: dict[str, Value] = {'plant': 'joint', **{
        name: value for name, value in given.items() if name in PARAMETERS}}
    if 'load' in groups:
        found = moved_by(groups['load'], records['load'], diagnosis.runs)
        values |= _mechanics(found, records['load'], run.force_n is not None)
        if 'valve' in records:
            values |= _drive(records['valve'])
    else:
        values |= followed_law(groups['valve'], records['valve'], run)
        if records['valve']['command_quantum'] > 0.0:
            values['command_path.quantum'] = float(records['valve']['command_quantum'])
    turns = run.unit('position' if run.position_m is not None else 'velocity').startswith('rad')
    values['joint.type'] = 'revolute' if turns else 'prismatic'
    if run.position_m is not None:
        values['load.start'] = float(run.position_m[np.isfinite(run.position_m)][0])
    said, unsaid = _said(diagnosis, groups)
    null = {name: value for name, value in defaults(JOINT_PARAMETERS).items()
            if name not in ALWAYS}
    return {name: value for name, value in values.items()
            if name not in null or value != null[name]}, said, unsaid


def _mechanics(found: JointModel, p: np.void, force_measured: bool) -> dict[str, Value]:
    """Return what moves, and between command and motion the drive if no force is measured."""
    level = float(p['friction_level'])
    values: dict[str, Value] = {
        'load.mass': found.inertia, 'load.damping': float(p['load_damping']),
        'friction.viscous': float(p['viscous']), 'load.stiffness': found.stiffness,
        'load.rest': found.rest if found.stiffness else 0.0,
        'gravity.sine': found.sine, 'gravity.cosine': found.cosine,
        # Without the parts of it that have parameters of their own.
        'load.offset': -found.bias + float(p['disturbance'])
        - level * float(p['friction_asymmetry'])}
    off = defaults(JOINT_PARAMETERS) | {'friction.model': 'off'}
    values |= friction_parameters(p, off) | coupling_parameters(p) | external_force(p)
    if stiffness := float(values.get('friction.presliding_stiffness', 0.0)):
        values['friction.presliding_damping'] = RUBBING_DAMPING * math.sqrt(
            stiffness * found.inertia)
    if not force_measured:
        values |= {'command_path.delay': max(found.delay_s - poles(p, 'drive_lag')[1], 0.0),
                   'drive.gain': found.gain, **_lags(p, 'drive_lag')}
    values |= {'force_sensor.offset': float(p['sensor_offset']),
               'force_sensor.gain': 1.0 + float(p['sensor_gain_error']),
               'force_sensor.lag_time': float(p['sensor_lag']),
               'force_sensor.drift': float(p['sensor_drift']),
               'force_sensor.drift_curve': float(p['sensor_drift_curve'])}
    return {name: value for name, value in values.items() if name in PARAMETERS}


def _drive(p: np.void) -> dict[str, Value]:
    """Return the drive between a command and the measured force."""
    gain = float(p['valve_characteristic_gain'])
    return {'drive.gain': gain, 'drive.bias': gain * float(p['command_bias']),
            'drive.deadband': float(p['command_deadband']),
            'drive.force_limit': float(p['valve_limit']),
            'command_path.quantum': float(p['command_quantum']),
            'command_path.delay': float(p['command_delay']), **_lags(p, 'valve_lag')}
