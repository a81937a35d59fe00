"""
A rigid joint or drive as nominal model, in the block language of the actuator.

Commanded by its force (or torque, or a proportional voltage or current): a mass with viscous
friction and a constant force and, if the recording needs them, a spring and, if it turns, gravity.
Values that are not given are identified from the recording. Commanded by its position: an ideal
servo, or one of second order (`servo/`). If command and force are both measured, the drive
between them is an ideal servo too. A joint that turns has rad, N m, kg m2 in place of m, N, kg.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import lsq_linear

from asi_actuator.joint_parameters import JOINT_PARAMETERS
from asi_analysis.arrays import Array
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.gap.model.coupling import guessed_coupling
from asi_analysis.gap.model.effects import (
    EFFECTS,
    GRAVITY,
    Effects,
    Free,
    Variant,
)
from asi_analysis.gap.model.gravity import (
    by_position,
    from_one_origin,
    turns_measured,
    without_bias,
    without_gravity,
)
from asi_analysis.gap.model.group import MODEL_ERROR, RIGID_ERROR, Group, make_group
from asi_analysis.gap.model.joint_effects import (
    LONGEST,
    LONGEST_SAMPLES,
    LOOP_TIMES,
    joint_effects,
)
from asi_analysis.gap.model.model_file import joint_fields
from asi_analysis.gap.model.predict import plant_record, predict
from asi_analysis.gap.model.rattling import (
    Rattling,
    first_rattling,
    rattling_in,
    rattling_mechanics,
)
from asi_analysis.gap.model.servo.forms import (
    forms_of,
    initial_state,
    limited_reference,
    loop_of,
    swapped,
)
from asi_analysis.gap.model.servo.identification import (
    DAMPINGS,
    Servo,
    begins_moving,
    offset_of,
    settled,
    slow_servo,
    thinned,
)
from asi_analysis.gap.model.servo.nominal import (
    SERVO_ERROR,
    can_be_identified,
    identified_servo,
    in_rows,
    late_by,
    near,
    stepping,
)
from asi_analysis.gap.model.servo.stepped import Steps
from asi_analysis.gap.motion import judged
from asi_analysis.gap.prepare import RIGID_BAND_HZ, Recording, prepare
from asi_analysis.gap.sampling import noise_of
from asi_analysis.gap.scales import scales
from asi_common.jit import FULL
from asi_common.parameter import Value

OFF = {f'{block}.model': 'off' for block in (
    'valve_hysteresis', 'valve_flexure', 'valve_characteristic', 'hydraulic_damping',
    'fluid_dynamics', 'friction', 'force_sensor')}
# An ideal servo: the position in metres is the command in metres.
IDEAL: dict[str, Value] = {**OFF, 'valve_characteristic.gain': 1.0, 'command_limit': 1e5,
                           'valve_characteristic.maximum_force': 1.0,
                           'valve_characteristic.full_opening': 0.01}
# Parameters with another range than the actuator's: the inertia of a joint may be very small.
OF_ANY_SIZE = frozenset(('load.mass', 'load.damping', 'load.stiffness'))
# A coil without effect; bounds of a servo's frequency, relative to that identified.
NO_LAG_HZ = 1e9
FREQUENCY_BOUNDS = (0.2, 40.0)
AMID = ('the recording begins off its reference or amid a motion: its first samples, which answer '
        'to what was before, are left out')
LIMITS = tuple(Free(f'servo_{name}', 0.3, 3.0, (1.0,), 'nominal') for name in (
    'rate', 'acceleration'))
SERVO_SHARE = 0.1   # tracking error, as a share of the motion, above which the servo has a gap
SECOND_ORDER = 0.002   # model error of a servo of second order, as a share of its tracking error
QUASI_STATIC = 0.05 # share of the inertia in the force below which it cannot be identified
TYPICAL = 0.3       # share of the force that inertia or damping may have, masked by friction
MOST = 10.0         # upper bound of a parameter, as a multiple of the value identified first
ONE_WAY = 0.02      # share of the time in which noise may reverse a motion in one direction
# Lost motion of a position loop at reversals: one play between the loop and the motion.
LOST_MOTION = Variant((Free('loop_width', 0.0, 0.8, (0.007, 0.02, 0.06, 0.15), 'command'),),
                      ('valve',), (('loop_behind', 1.0),))
# A drive whose measured force is another multiple of its command than the units say.
OTHER_GAIN: Effects = {'drive_gain': (Variant((Free(
    'valve_characteristic_gain', 0.25, 4.0, (0.5, 2.0), 'nominal'),), ('valve',)),)}


def drive_of(runs: Sequence[Run]) -> str:
    """
    Return what commands a joint: 'force', 'position' or 'drive', as `prepare` takes it.

    A recorded command is a force. Without one, a joint with a tracking error of more than a tenth
    is a position servo; else its measured force is the input. Without a motion, the force is the
    output of a servo whose input is a reference or command.
    """
    run = runs[0]
    present = run.signals()
    moves = 'position' in present or 'velocity' in present
    # The command of a simulated servo is a position: its reference.
    commanded = 'command' in present and run.unit('command') not in ('m', 'rad')
    if commanded:
        return 'force' if moves or 'force' not in present else 'drive'
    followed = present.get(run.controlled()) if 'reference' in present else None
    if followed is None:
        if 'force' in present:
            return 'force'
        hint = ('; a pressure times the area of its piston is a force: import it as '
                'force=PRESSURE*AREA[bar*cm^2]' if 'pressure' in present else '')
        raise InputError(f'{run.source}: a joint needs a command, a force or a reference of '
                         'its motion; there are ' + ', '.join(present) + hint)
    if run.controlled() == 'force':
        return 'force' if moves else 'position'
    missed = np.nanstd(followed - run.signal('reference')) / np.nanstd(followed)
    return 'position' if 'force' not in present or missed > SERVO_SHARE else 'force'


class Extent(NamedTuple):
    """
    What of a joint is modelled, and in which band.

    hidden: gravity or a spring, or a servo of second order, is in every fit, even if not
    identified without an effect; band_hz: the highest frequency at which the force is compared.
    """

    hidden: bool = False
    band_hz: float = RIGID_BAND_HZ


WHOLE = Extent()


def joint_groups(runs: Sequence[Run], given: Mapping[str, Value], tolerance: float,
                 held_out: Sequence[bool], drive: str, healthy: Sequence[Run] = (),
                 weight: tuple[float, float] = (0.0, 0.0), extent: Extent = WHOLE
                 ) -> tuple[list[Group], list[str]]:
    """
    Return the groups of channels that a joint has, and notes.

    healthy: recordings from which servo, gravity, spring and mean force are identified; none:
    `runs`; weight: gravity that their fit adds to it, N m of sin q and of cos q.
    """
    recordings = prepare(runs, drive, held_out, extent.band_hz)
    of = prepare(healthy, drive, band_hz=extent.band_hz) if healthy else recordings
    if drive == 'position':
        if identifiable := can_be_identified(of):
            slow = slow_servo(thinned(of))
            recordings, of = ([settled(r, slow) for r in each] for each in (recordings, of))
        servos, steps, error = (identified_servo(of, extent.hidden) if identifiable else
                                ([], None, SERVO_ERROR))
        notes = [AMID] if any(map(begins_moving, recordings)) else []
        return [_servo(recordings, tolerance, False, servos, steps, error)], notes
    if drive != 'force':
        return [_servo(recordings, tolerance, True)], []
    turns = turns_measured(recordings, runs)
    stiffness = given.get('load.stiffness')
    rattling = first_rattling(of, healthy or runs)
    rattles = rattling or first_rattling(recordings, runs)   # worn since it was healthy
    found = by_position(of, healthy or runs, None if stiffness is None else float(stiffness),
                        rattling)
    told = bool({'gravity.sine', 'gravity.cosine'} & given.keys())
    if told:
        found = found._replace(sine=float(given.get('gravity.sine', 0.0)),
                               cosine=float(given.get('gravity.cosine', 0.0)))
    found = found._replace(sine=found.sine + weight[0], cosine=found.cosine + weight[1])
    if rattles is not None:   # the weight beyond gravity at the middle of the motion
        middle = float(np.nanmean((runs if rattling is None else healthy or runs)[0]
                                  .signal('position')))
        rattles = rattles._replace(weight=rattles.weight - found.sine * np.sin(middle)
                                   - found.cosine * np.cos(middle))
    recordings, notes = without_gravity(recordings, runs, found)
    notes = [] if told else notes
    of = without_gravity(of, healthy, found)[0] if healthy else recordings
    recordings, of = (from_one_origin(each, which, found.stiffness)
                      for each, which in ((recordings, runs), (of, healthy or runs)))
    recordings, more = without_bias(recordings, of)
    if turns:
        recordings = [replace(r, taken={**r.taken, 'middle': float(np.nanmean(
            run.signal('position')))}) for run, r in zip(runs, recordings, strict=True)]
    notes = [*notes, *more, *_not_identifiable(recordings, runs)]
    groups = []
    if all({'command', 'force'} <= run.signals().keys()
           and run.unit('command') not in ('m', 'rad') for run in runs):
        driven, (other,) = prepare(runs, 'drive', held_out), OTHER_GAIN['drive_gain'][0].free
        # With a known mass the units are to be trusted: of equal ones, the gain is 1. Or a gear's.
        one = 'load.mass' in given and other.low < _gain(driven) < other.high and all(
            run.unit('command') == run.unit('force') for run in runs)
        groups.append(_servo(driven, tolerance, True, gain_is_one=one))
    force_measured = all(run.force_n is not None for run in runs)
    holds = extent.hidden and not turns and stiffness is None and all(
        run.position_m is not None for run in runs)
    weighs = turns and (extent.hidden or told or bool(healthy) or bool(found.sine or found.cosine))
    mechanics = _mechanics(recordings, given, tolerance, force_measured, weighs,
                           told or bool(healthy),
                           holds or bool(found.stiffness) and not found.given, rattling, rattles)
    return [*groups, _without_hidden_compliance(mechanics)], notes


def _not_identifiable(recordings: Sequence[Recording], runs: Sequence[Run]) -> list[str]:
    """Return notes about parameters that recordings of a joint do not determine."""
    notes = []
    if any(run.position_m is None for run in runs):
        notes.append('without the position neither gravity nor a spring is looked for')
    ways = [np.sign(np.quantile(r.motion.velocity[r.motion.inner], [ONE_WAY, 1.0 - ONE_WAY]))
            for r in recordings if r.motion is not None]
    if ways and (np.all(np.array(ways) > 0.0) or np.all(np.array(ways) < 0.0)):
        notes.append('the joint moves one way only: its friction cannot be distinguished from a '
                     'constant load')
    return notes


def _without_hidden_compliance(group: Group) -> Group:
    """
    Return a group without load compliance if the motion is too slow to show the inertia.

    The compliance cannot be identified then, and would be confused with friction.
    """
    mass = float(group.nominal['load_mass'])
    for recording in group.recordings:
        motion, force = recording.moved, recording.force_judged
        assert force is not None
        moved = np.gradient(motion.velocity[motion.inner], recording.period_s)
        if mass * float(moved.std()) > QUASI_STATIC * float(force.std()):
            return group
    return replace(group, effects={name: forms for name, forms in group.effects.items()
                                   if name != 'load_compliance'})


def _servo(recordings: Sequence[Recording], tolerance: float, proportional: bool,
           servos: Sequence[Servo] = (), steps: Steps | None = None,
           model_error: float = SERVO_ERROR, gain_is_one: bool = False) -> Group:
    """
    Return the group of a drive that should follow its command at once, or as a servo.

    proportional: its gain is identified, unless it should be 1 (gain_is_one); steps: quantisation
    of its reference. servos: the first one takes the place of the actuator's flexure. Its
    frequency, damping and limits are free in every fit, since a lag or a delay beside it resembles
    another servo; fits with effects start from each of them.
    """
    nominal = plant_record(IDEAL)
    recordings = in_rows(recordings) if proportional else recordings
    dynamics: tuple[Free, ...] = ()
    if servos:
        servo = servos[0]
        nominal['valve_flexure_model'] = FULL
        nominal['valve_flexure_coil_frequency'] = NO_LAG_HZ
        nominal['valve_flexure_delay'] = 0.0
        nominal['valve_flexure_natural_frequency'] = 0.5 * servo.pulsation / np.pi
        nominal['valve_flexure_damping_ratio'] = servo.damping
        nominal['servo_rate'], nominal['servo_acceleration'] = servo.rate, servo.acceleration
        # With integral action in its loop, a lag goes with a lead.
        starts = [(each, 0.0) for each in (*servos, *swapped(servos))] + [
            (each, each.lag) for each in servos if each.lag > 0.0]
        low, high = (each / servo.damping for each in DAMPINGS)
        dynamics = *(Free(f'valve_flexure_{name}', *bounds, tuple(
            getattr(each, own) / getattr(servo, own) for each, _ in starts), 'nominal', anew=True)
            for name, own, bounds in (('natural_frequency', 'pulsation', FREQUENCY_BOUNDS),
                                      ('damping_ratio', 'damping', (low, high)))
        ), *([limit for limit in LIMITS if nominal[limit.field] > 0.0] if servo.limited else
             loop_of(servo, [lead for _, lead in starts])), *initial_state(recordings)
    nominal['valve_characteristic_full_opening'] = 1.0
    nominal['load_mass'] = 0.0
    identified = proportional and not gain_is_one
    if identified:
        nominal['valve_characteristic_gain'] = _gain(recordings)
    recordings = [_with_least_noise(r, nominal) for r in recordings]
    # The gain was identified without a lag: with one it is biased towards zero.
    low, high = (0.1, 10.0) if identified else (1.0 - tolerance, 1.0 + tolerance)
    gain = Free('valve_characteristic_gain', low, high, (1.0,), 'nominal')
    effects = servo_effects(recordings, proportional, servos, steps) | (
        OTHER_GAIN if gain_is_one else {})
    group = make_group(nominal, recordings, ('valve',), nuisance=(gain, *dynamics),
                       effects=effects, model_error=MODEL_ERROR if dynamics else model_error,
                       floor_by_best=True)
    error = SECOND_ORDER * bool(dynamics) * float(np.std(np.concatenate(
        [r.input - r.output for r in recordings])))
    return replace(group, formulation={'valve': group.formulation['valve'] + error ** 2})


def _with_least_noise(recording: Recording, nominal: np.void) -> Recording:
    """Return the recording of a drive, of whose output a rough command makes no noise."""
    left = noise_of(recording.output - predict(replace(recording, number=0), 'valve', nominal))
    share = min(left / (noise_of(recording.output) or math.inf), 1.0)
    return replace(recording, noise={
        **recording.noise, 'valve_position': share * recording.noise['valve_position']})


def servo_effects(recordings: Sequence[Recording], proportional: bool = False,
                  servos: Sequence[Servo] = (), steps: Steps | None = None) -> Effects:
    """Return the candidate effects of a drive; the arguments are those of `_servo`."""
    # If the motion is too slow to show the servo's dynamics, dry friction in its loop is a play.
    own: dict[str, tuple[Variant, ...]] = {} if proportional else {
        'backlash': (LOST_MOTION,), 'coulomb_friction': (LOST_MOTION,),
        'valve_saturation': (EFFECTS['valve_saturation'][0], limited_reference(recordings))}
    own |= {'command_quantisation': (stepping(steps),)} if steps else {}
    own |= forms_of(servos[0], recordings) if servos else {}
    late = [] if servos else [Servo(1.0, 0.0, delay=late_by(recordings))]
    return {name: own[name] if name in own else tuple(
        form._replace(free=tuple(near(_of_a_loop(free, recordings, proportional), [*servos, *late])
                                 for free in form.free))
        for form in forms if not any(field.startswith('valve_flexure') for field in form.fields))
        for name, forms in EFFECTS.items()}


def _of_a_loop(free: Free, recordings: Sequence[Recording], proportional: bool) -> Free:
    """
    Return a free delay, lag or bias with the range of a position loop; others as they are.

    proportional: of a drive, whose output may have another unit than its command.
    """
    if free.field == 'command_bias' and not proportional:
        found = float(np.mean([offset_of(r) for r in recordings if r.fit.any()]))
        most = free.high * scales(recordings)['command'] + 2.0 * abs(found)
        return Free(free.field, -most, most, (found,), '', free.unit)
    if free.field not in ('command_delay', 'valve_lag'):
        return free
    period = max(r.period_s for r in recordings)
    slow = [samples * period for samples in (1.0, 5.0) if period * LONGEST_SAMPLES > LONGEST]
    return Free(free.field, 1e-4, max(LONGEST, LONGEST_SAMPLES * period),
                (*LOOP_TIMES, *slow), '', 's')


def _gain(recordings: Sequence[Recording]) -> float:
    """Return the gain from command to force, by least squares."""
    command = np.concatenate([r.input[r.fit] for r in recordings])
    force = np.concatenate([r.output[r.fit] for r in recordings])
    if not command.any():
        raise InputError(f'{recordings[0].source}: the command moves only where nothing is fitted')
    return float(command @ force / (command @ command))


def _mechanics(recordings: Sequence[Recording], given: Mapping[str, Value], tolerance: float,
               force_measured: bool, weighs: bool, healthy: bool, springs: bool,
               rattling: Rattling | None, rattles: Rattling | None) -> Group:
    """
    Return the group that compares the measured force with that of the motion.

    weighs: the joint has gravity, which is free in every fit or, if it is known (healthy), an
    effect; springs: it has a spring whose stiffness is not given; rattling, rattles: initial guess
    of the nominal joint beside a backlash, and of the backlash.
    """
    own = {parameter.name for parameter in JOINT_PARAMETERS}
    rest = {name: value for name, value in given.items() if name not in own}
    nominal = plant_record({**OFF, 'force_sensor.mass_share': 0.0, 'load.type': 'spring',
                            'load.stiffness': 0.0, **rest})
    for name in OF_ANY_SIZE & given.keys():
        nominal[name.replace('.', '_')] = given[name]
    for name, known in joint_fields(given, force_measured).items():
        nominal[name] = known
    identified, typical = _identified(recordings, float(nominal['load_stiffness']), springs)
    guess = rattling_mechanics(rattling, springs) if rattling else {}
    nuisance = []
    for name, field in (('load.mass', 'load_mass'), ('load.damping', 'load_damping'),
                        ('load.stiffness', 'load_stiffness')):
        if name in given:
            if nominal[field] > 0.0:   # 0 has no relative tolerance
                nuisance.append(Free(field, 1.0 - tolerance, 1.0 + tolerance, (1.0,), 'nominal'))
        elif field in identified:
            # Identified without friction, so it may be far from the true value.
            value = guess.get(field, identified[field])
            nominal[field] = value
            most = MOST * max(value, identified[field], TYPICAL * typical[field])
            nuisance.append(Free(field, 0.0, most, (value,), anew=rattling is not None))
    nuisance += _given_friction(nominal, given, tolerance)
    nominal['load_offset'] = identified['load_offset']
    start = identified['load_offset'] / scales(recordings)['force']
    # At a constant speed damping explains the mean force, and so does gravity at the middle of
    # the motion; but a mean force may have been removed.
    largest = max(1.0, 2.0 * abs(start)) + 2.0 * (weighs and not healthy)
    nuisance.append(Free('load_offset', -largest, largest, (start,), 'force'))
    period = max(recording.period_s for recording in recordings)
    # A held command has a mean delay of half a sample, and its time stamp may be off by as much;
    # a force may be sampled before the next command.
    nuisance.append(Free('drive_hold', -period if force_measured else 0.0, period, (0.0,)))
    # A measured force may be held, too. By the square of that time, since so it attenuates.
    held = 0.0 if force_measured else period ** 2
    nuisance.append(Free('drive_held', 0.0, period ** 2, (held,)))
    travel = max(float(np.ptp(r.motion.position[r.motion.inner]))
                 for r in recordings if r.motion)
    effects = joint_effects(period, travel, 'load.mass' in given, force_measured,
                            rattling_in(rattles), guessed_coupling(recordings),
                            nominal['friction_level'] > 0.0)
    if weighs and healthy:
        effects |= GRAVITY
        size = tolerance * math.hypot(*(float(given.get(f'gravity.{part}', 0.0))
                                        for part in ('sine', 'cosine')))
        nuisance += [free._replace(low=-size, high=size, starts=(0.0,), scale='')
                     for free in GRAVITY['gravity'][0].free if size > 0.0]
    elif weighs:   # it was identified without the effects
        nuisance += [free._replace(starts=(0.0,)) for free in GRAVITY['gravity'][0].free]
    return make_group(nominal, recordings, ('load',), nuisance=tuple(nuisance), effects=effects,
                      model_error=RIGID_ERROR, floor_by_best=True)


def _given_friction(nominal: np.void, given: Mapping[str, Value], tolerance: float) -> list[Free]:
    """Return the parameters of a friction that is given: uncertain as mass and damping are."""
    frees = [Free(field, 1.0 - tolerance, 1.0 + tolerance, (1.0,), 'nominal')
             for field in ('friction_level', 'viscous') if nominal[field] > 0.0]
    if nominal['friction_level'] > 0.0 and 'friction.presliding_stiffness' not in given:
        # How it begins to slide is not given, so it is known to orders of magnitude.
        frees.append(Free('friction_bristle', 1e-3, 10.0, (1.0, 0.03), 'nominal', anew=True))
    return frees


def _identified(recordings: Sequence[Recording], stiffness: float, springs: bool
                ) -> tuple[dict[str, float], dict[str, float]]:
    """
    Return mass, damping, offset and stiffness by least squares on the fitted parts.

    And the value of each with which it alone would explain the whole force (rms). All but the
    offset are positive. stiffness: the given one, or 0; springs: one is identified.
    """
    rows, right = [], []
    for recording in recordings:
        motion, force = recording.motion, recording.force_judged
        if motion is None or force is None:
            raise InputError(f'{recording.source}: a joint that is driven by a force needs its '
                             'force (or command) and its position or velocity')
        count, inner = motion.velocity.size, motion.inner
        columns: list[Array] = [
            np.fft.irfft(motion.velocity_spectrum * factor * motion.judge, count)[inner]
            for factor in (1j * motion.omega, 1.0)]
        position = judged(motion.position[inner], motion)
        columns += [*[position] * springs, np.ones(recording.fit.size)]
        rows.append(np.column_stack(columns)[recording.fit])
        right.append((force - stiffness * position)[recording.fit])
    matrix, force = np.concatenate(rows), np.concatenate(right)
    size = np.sqrt(np.mean(matrix ** 2, axis=0)) + 1e-30
    least = [0.0] * (matrix.shape[1] - 1) + [-np.inf]
    solution = lsq_linear(matrix / size, force, (least, np.inf)).x / size
    names = ('load_mass', 'load_damping', *['load_stiffness'] * springs, 'load_offset')
    strength: Array = float(force.std()) / size
    return (dict(zip(names, map(float, solution), strict=True)),
            dict(zip(names, map(float, strength), strict=True)))
