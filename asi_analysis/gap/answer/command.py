"""`asi gap`: recordings and a nominal model in, the diagnosis out."""

import itertools
import math
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from types import MappingProxyType

import numpy as np

from asi_actuator.joint_parameters import JOINT_PARAMETERS
from asi_actuator.node_parameters import PHYSICS
from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError, InputWarning
from asi_analysis.experiments.experiment import TABLES, parse_setting, read_parameters
from asi_analysis.gap.answer.changes import changes
from asi_analysis.gap.answer.characteristic import characteristic, line_of
from asi_analysis.gap.answer.result import Gap
from asi_analysis.gap.diagnose import diagnose as diagnosis_of
from asi_analysis.gap.diagnosis import Diagnosis
from asi_analysis.gap.document import document, plain
from asi_analysis.gap.model.effects import DOTTED
from asi_analysis.gap.model.group import TOLERANCE
from asi_analysis.gap.model.joint import OF_ANY_SIZE
from asi_analysis.gap.model.model_file import DIRECT, LAGS
from asi_analysis.gap.model.simulator import of_simulator
from asi_analysis.gap.model.static import GIVEN, static_signals
from asi_analysis.gap.prepare import Recording
from asi_analysis.gap.recordings import (
    against_healthy,
    units_not_given,
    unwrapped,
    without_repeats,
)
from asi_analysis.gap.words import UNITS, digits, percent, signal_of, unit_of
from asi_analysis.measures.quality import doubts, quality_of
from asi_analysis.terminal import Progress, silent
from asi_common import parameter_file
from asi_common.jit import FULL
from asi_common.parameter import ParameterError, Value, completed, is_number

PLANTS = ('actuator', 'joint', 'static')
LEAST_TOLERANCE = 1e-3
DRIVES = (None, 'force', 'position')
LOAD = next(p for p in ACTUATOR_PARAMETERS if p.name == 'load.type')
# Effects of the simulator that the block-wise model computes by other equations; 0 if off.
EFFECT_SIZES = (set(DIRECT.values()) - {'valve_characteristic.supply_time'}) | {
    f'{block}.{name}' for block in LAGS.values() for name in ('lag_time', 'second_lag_time')} | {
    'fluid_dynamics.leakage_growth', 'friction.coulomb_asymmetry', 'coupling.stiffness',
    'backlash.gap', 'load.external_force', 'force_sensor.drop_rate'}


Model = str | Path | Mapping[str, Value]


def nominal_model(model: Model | None, plant: str = 'actuator') -> dict[str, Value]:
    """
    Return the actuator's parameters of a model, by name or in a file; {} without one.

    Mass and damping of a joint may be of any size. Warns of a name that is no parameter; under
    /** a file may have the controller's. Raises InputError for a value out of its range.
    """
    if model is None:
        return {}
    if plant == 'static':
        return _line(read_static(Path(model)) if isinstance(model, str | Path) else model)
    known = _names(plant) | {parameter.name for parameter in ACTUATOR_PARAMETERS}
    path = 'model' if isinstance(model, Mapping) else Path(model)
    found = model if isinstance(model, Mapping) else read_parameters(
        Path(model), 'actuator', plant)
    for name in found.keys() - known - {parameter.name for parameter in TABLES['controller']}:
        near = get_close_matches(name, known, 1)
        warnings.warn(f'{path}: {name} is no parameter of the actuator, and left out'
                      + (f': did you mean {near[0]}?' if near else ''), InputWarning, stacklevel=2)
    values = {name: value for name, value in found.items() if name in known}
    _check_ranges(values, plant, str(path))
    return values


def _names(plant: str) -> set[str]:
    """Return the names of the parameters of a simulated plant."""
    return {parameter.name for parameter in PHYSICS.get(plant, ACTUATOR_PARAMETERS)}


def _check_ranges(values: Mapping[str, Value], plant: str, origin: str) -> None:
    """Raise InputError for a parameter out of its range; origin: what it is from."""
    ranged = dict(values)
    for name in OF_ANY_SIZE & values.keys() if plant == 'joint' else ():
        value = ranged.pop(name)
        allowed = is_number(value) and 0.0 <= value < math.inf
        if not allowed or (name == 'load.mass' and value == 0.0):
            raise InputError(f'{origin}: {name} = {value!r} is not allowed: it takes a number '
                             + ('above 0' if name == 'load.mass' else 'from 0'))
    own = {name: value for name, value in ranged.items()
           if plant == 'joint' and name in _names(plant)}
    try:
        completed(own, JOINT_PARAMETERS)
        completed({name: value for name, value in ranged.items() if name not in own},
                  ACTUATOR_PARAMETERS)
    except ParameterError as error:
        raise InputError(f'{origin}: {error}') from None


def read_static(path: Path) -> dict[str, Value]:
    """Return gain and offset of a parameter file, under `asi_static` or /**."""
    try:
        return parameter_file.read_parameters(path, 'asi_static')
    except ParameterError as error:
        raise InputError(str(error)) from None


def _line(given: Mapping[str, Value]) -> dict[str, Value]:
    """Return the given gain and offset; raises InputError for anything else."""
    for name, value in given.items():
        if name not in GIVEN:
            raise InputError(f'{name} is no parameter of a static characteristic: '
                             + ' or '.join(GIVEN))
        if not is_number(value) or not math.isfinite(value) or (name == 'gain' and not value):
            raise InputError(f'{name} = {value!r} is not allowed: a number'
                             + (' but 0' if name == 'gain' else ''))
    return {name: float(value) for name, value in given.items()}


def recorded_model(runs: Sequence[Run], plant: str = 'actuator') -> dict[str, Value]:
    """
    Return the plant's parameters in the metadata of the first bag; {} without any.

    Raises InputError if one is not allowed, and for an actuator's model of a joint's bag.
    """
    information = runs[0].information
    recorded = information.get('plant', 'actuator')
    if plant == 'actuator' and recorded == 'joint':
        raise InputError(f'{runs[0].source}: recorded with plant = joint: --plant joint')
    if plant != recorded:
        return {}
    found = {name: value for name, value in information.get('actuator', {}).items()
             if name in _names(plant)}
    try:
        completed(found, PHYSICS[plant])
    except ParameterError as error:
        raise InputError(f'{runs[0].source}: metadata of the run: {error}') from None
    return found


def parse_tolerances(texts: Sequence[str]) -> tuple[float, dict[str, float]]:
    """
    Return the tolerance of the nominal parameters, and those of single ones by dotted name.

    texts: such as '0.3' or 'load.mass=0.5'. Raises InputError for what is no tolerance.
    """
    found = {name.strip(): parameter_file.read_scalar(share.strip())
             for name, _, share in (text.rpartition('=') for text in texts)}
    own = _tolerances(found)
    return own.pop('', TOLERANCE), own


def _tolerances(found: Mapping[str, Value]) -> dict[str, float]:
    """Return tolerances by dotted name; '': of all others. Raises InputError."""
    for name, share in found.items():
        if not is_number(share) or not LEAST_TOLERANCE <= share < 1.0:
            raise InputError(f'tolerance {name}{"=" if name else ""}{share} is not allowed: '
                             f'a share from {LEAST_TOLERANCE:g}, below 1')
    return {name: float(share) for name, share in found.items()}


def model_tolerances(model: Model | None) -> dict[str, Value]:
    """Return the tolerances in a model file, by dotted name: `tolerance.NAME` of asi_gap."""
    if not isinstance(model, str | Path):
        return {}
    with suppress(ParameterError):   # a file without a section of asi_gap
        return {name.removeprefix('tolerance.'): value for name, value
                in parameter_file.read_parameters(Path(model), 'asi_gap').items()
                if name.startswith('tolerance.')}
    return {}


def _of_the_model(runs: Sequence[Run], values: Mapping[str, Value], given: bool) -> list[str]:
    """Return notes: the origin of the nominal model, and bags recorded with another load."""
    load = str(values.get('load.type', LOAD.default))
    origin = ('as given' if given else f'from the metadata of {runs[0].source}' if values else
              'the defaults, since the bag holds none')
    notes = [f'nominal model: {origin}; load {load}, {1.0 / runs[0].period_s:.4g} Hz']
    for run in runs:
        other = run.information.get('actuator', {}).get('load.type', load)
        if other != load:
            notes.append(f'{run.source}: recorded with the load {other}, but the nominal model '
                         f'has the load {load}')
    return notes


def _of_the_joint(diagnosis: Diagnosis, values: Mapping[str, Value]) -> list[str]:
    """Return notes that describe the nominal model of a joint."""
    notes = []
    origin = 'near the healthy one' if diagnosis.healthy else 'near the given one'
    for weighed in diagnosis.groups if diagnosis.plant == 'joint' else ():
        channel, run = weighed.group.channels[0], diagnosis.runs[0]
        if channel == 'load':
            turns = unit_of('m', 'load', run, 'joint') == 'rad'
            p = diagnosis.best(weighed).fitted.record
            notes.append('nominal joint: ' + ', '.join(
                f'{words} {digits(p[field], unit_of(UNITS[field], channel, run, "joint"))} '
                f'({origin if DOTTED[field] in values or diagnosis.healthy else "identified"})'
                for field, words in (
                    ('load_mass', 'inertia' if turns else 'mass'),
                    ('load_damping', 'viscous friction'),
                    *[('load_stiffness', 'spring')] * bool(p['load_stiffness']))
                ).replace('Nm s2/rad', 'kg m2') + ('' if diagnosis.healthy else _gravity(
                    weighed.group.recordings[0], p, run,
                    origin if {'gravity.sine', 'gravity.cosine'} & values.keys() else
                    'identified'))
                + ', and a constant force')
        else:
            p = diagnosis.best(weighed).fitted.record
            how = _as_a_servo(p, channel, run) if p['valve_flexure_model'] == FULL else 'at once'
            notes.append(f'nominal drive: the {signal_of(channel, run, "joint")} follows the '
                         + (f'reference {how}' if run.command_n is None else
                            'command at once, in proportion'))
    return notes


def _as_a_servo(p: np.void, channel: str, run: Run) -> str:
    """Return the words for a servo of second order, with the limits that it has."""
    words = (f'as a servo of second order: {digits(p["valve_flexure_natural_frequency"], "Hz")}, '
             f'damping ratio {digits(p["valve_flexure_damping_ratio"])}')
    for word, field, unit in (('largest speed', 'servo_rate', 'm/s'),
                              ('largest acceleration', 'servo_acceleration', 'm/s2')):
        if p[field] > 0.0:
            words += f', {word} {digits(p[field], unit_of(unit, channel, run, "joint"))}'
    return words


def _gravity(recording: Recording, p: np.void, run: Run, origin: str) -> str:
    """Return the words for the gravity of a joint; '' if it has none."""
    sine, cosine = (recording.taken.get(name, 0.0) + float(p[name])
                    for name in ('gravity_sine', 'gravity_cosine'))
    if not sine and not cosine:
        return ''
    return (f', gravity {digits(math.hypot(sine, cosine), unit_of("N", "load", run, "joint"))} '
            'times the sine of the position less '
            f'{math.degrees(math.atan2(-cosine, sine)):.3g} degrees ({origin})')


def _of_the_line(diagnosis: Diagnosis, values: Mapping[str, Value]) -> str:
    """Return a note: the signals of a characteristic, and its nominal line."""
    run, weighed = diagnosis.runs[0], diagnosis.groups[0]
    given, got = static_signals(run)
    line = line_of(weighed.group, diagnosis.best(weighed).fitted.record)
    texts = [f'{name} {digits(float(values.get(name, line[name])), in_unit)} '
             f'({"given" if name in values else "fitted"})'
             for name, unit in (('gain', 'output/input'), ('offset', 'output'))
             for in_unit in [unit_of(unit, 'static', run, 'static')]]
    return (f'nominal characteristic: {got.replace("_", " ")} over {given.replace("_", " ")}, '
            + ', '.join(texts))


def _of_the_tolerances(diagnosis: Diagnosis) -> list[str]:
    """Return a note of the tolerances, if a nominal parameter has one."""
    uncertain = any(free.scale == 'nominal' for weighed in diagnosis.groups
                    for free in weighed.group.nuisance)
    if diagnosis.healthy is not None:
        return ['tolerances of the parameters: their spread in '
                f'{len(diagnosis.healthy.runs)} healthy recordings, at most '
                f'{percent(diagnosis.tolerance)}']
    return [', '.join((f'tolerance of its parameters: {percent(diagnosis.tolerance)}', *(
        f'{DOTTED.get(field, field)} {percent(share)}'
        for field, share in diagnosis.tolerances.items())
        ))] if uncertain else []


def _of_the_predictor(diagnosis: Diagnosis, values: Mapping[str, Value]) -> list[str]:
    """Return notes: which model predicts, and how it differs from the simulator."""
    simulated = [of_simulator(each.group.nominal) for each in diagnosis.groups]
    if all(simulated):
        return ['predicted by the simulator itself, which explains the recordings']
    on = sorted(name for name in EFFECT_SIZES if values.get(name, 0.0) != 0.0)
    partly = ', but the simulator itself predicts ' + ' and '.join(
        channel for each, by_it in zip(diagnosis.groups, simulated, strict=True) if by_it
        for channel in each.group.channels) if any(simulated) else ''
    return [f'predicted block by block, each from its measured input{partly}'] + ([
        f'the nominal model has {", ".join(on)}, which the diagnosis does not compute as the '
        'simulator does: the difference may be reported as a gap'] if on else [])


def _joint_recordings(drive: str | None, *given: Sequence[Run]
                      ) -> tuple[list[list[Run]], list[str]]:
    """
    Return the new, held-out and healthy recordings of a joint, mended, and notes.

    Raises InputError if the healthy ones cannot be compared with the others.
    """
    mended = [[unwrapped(run) for run in each] for each in given]
    runs, held_out, healthy = ([run for run, _ in each] for each in mended)
    runs, repeated = without_repeats(runs)
    held_out, also_fitted = without_repeats(held_out, runs)
    healthy, known = without_repeats(healthy)
    whole = [runs, held_out, healthy]
    return whole, [*(note for each in mended for _, notes in each for note in notes),
                   *repeated, *also_fitted, *known,
                   *against_healthy([*runs, *held_out], healthy, drive),
                   *(note for each in whole for run in each for note in units_not_given(run))]


def _check_units(runs: Sequence[Run]) -> None:
    """Raise InputError if a signal has another unit in another recording."""
    for before, run in itertools.combinations(runs, 2):
        for name in before.signals().keys() & run.signals().keys():
            if before.unit(name) != run.unit(name):
                raise InputError(f'{run.source}: {name} is in {run.unit(name)}, in '
                                 f'{before.source} in {before.unit(name)}: import both alike')


def diagnose(runs: Sequence[Run], model: Model | None = None, plant: str = 'actuator',
             held_out: Sequence[Run] = (), tolerance: float = TOLERANCE, drive: str | None = None,
             progress: Progress = silent, settings: Sequence[str] = (),
             tolerances: Mapping[str, float] = MappingProxyType({}),
             baseline: Sequence[Run] = (), signals: tuple[str | None, str | None] = (None, None)
             ) -> Gap:
    """
    Return where recordings of the real machine differ from their model, why, and how far.

    model: nominal parameters by name or a ROS parameter file; None: those of the first bag's
    metadata, else the defaults; settings: 'name=value', which override both. plant:
    'actuator', 'joint' for any rigid joint or drive, or 'static' for a static characteristic, from
    the first of `signals` to the second (None: the likeliest). held_out: recordings for validation
    only. tolerance: of the nominal parameters, as a share; with the simulator as the predictor it
    is two standard deviations of a normal prior, in the block-wise fits a hard bound; tolerances:
    the same of single parameters, by dotted name. drive: of a joint, 'force' or 'position'; None:
    by its signals. baseline: recordings of the same machine when it was healthy; the answer is
    then what has changed since. Raises InputError for recordings that cannot be diagnosed; `notes`
    says what is doubtful.

    >>> import asi_analysis as asi
    >>> time_s = 0.01 * np.arange(2000)
    >>> command_n = np.abs(time_s % 4.0 - 2.0) - 1.0    # to and fro
    >>> force_n = np.zeros(2000)                        # through a play of 0.2 N
    >>> for k in range(1, 2000):
    ...     force_n[k] = np.clip(force_n[k - 1], command_n[k] - 0.1, command_n[k] + 0.1)
    >>> run = asi.Run(time_s, command_n=command_n, force_n=force_n)
    >>> asi.diagnose([run], plant='static').verdict
    'valve_hysteresis'
    """
    if plant not in PLANTS:
        raise InputError(f'--plant {plant!r} is not allowed: one of {", ".join(PLANTS)}')
    if drive not in DRIVES:
        raise InputError(f'--drive {drive!r} is not allowed: force or position')
    if drive is not None and plant == 'static':
        raise InputError('--drive takes --plant joint')
    if signals != (None, None) and plant != 'static':
        raise InputError('--input and --output take --plant static')
    if plant == 'static':
        runs, held_out = ([replace(run, information={**run.information, 'characteristic': {
            'input': signals[0], 'output': signals[1]}}) for run in each]
            for each in (runs, held_out))
    given: list[str] = []
    if plant == 'joint':
        (runs, held_out, baseline), given = _joint_recordings(drive, runs, held_out, baseline)
    own = _tolerances({**model_tolerances(model), **tolerances, '': tolerance})
    del own['']
    everything = [*runs, *held_out]
    values = (recorded_model([*baseline, *runs], plant) if model is None and plant in PHYSICS else
              nominal_model(model, plant))
    recorded = bool(values) and model is None and plant == 'joint'
    for text in settings:
        if plant == 'static':
            name, _, number = text.partition('=')
            values |= _line({name.strip(): parameter_file.read_scalar(number.strip())})
            continue
        _, name, value = parse_setting(f'actuator.{text}', plant)
        values[name] = value
    if settings and plant != 'static':
        _check_ranges(values, plant, '--set')
    notes = (_of_the_model([*baseline, *everything], values, model is not None)
             if plant == 'actuator' else given)
    # Before the checks, since a note may explain a refusal.
    for note in notes[plant == 'actuator':]:
        warnings.warn(note, InputWarning, stacklevel=2)
    # Mass and damping of a healthy joint are identified, unless they are given.
    declared = {name: share for name, share in own.items()
                if plant == 'actuator' or name in values}
    _check_units([*baseline, *everything])
    healthy = diagnosis_of(baseline, values, plant, tolerance, None, drive, progress,
                           declared) if baseline else None
    diagnosis = diagnosis_of(everything, values, plant, tolerance,
                             [False] * len(runs) + [True] * len(held_out), drive, progress, own,
                             healthy)
    if recorded:
        notes.append(f'nominal joint: from the metadata of {runs[0].source}')
    notes += [*_of_the_joint(diagnosis, values), *_of_the_tolerances(diagnosis)]
    if plant == 'static':
        notes = [_of_the_line(diagnosis, values), *notes]
    if plant == 'actuator':
        notes += _of_the_predictor(diagnosis, values)
    answer = plain(document(diagnosis))
    answer['characteristic'] = plain(characteristic(diagnosis)) if plant == 'static' else None
    if baseline:
        answer['baseline'] = plain(changes(diagnosis))
    doubtful = doubts([*baseline, *everything], plant != 'static')
    answer['notes'] = [*(f'doubtful, because {each}' for each in doubtful), *notes,
                       *answer['notes']]
    if plant == 'actuator':
        from asi_analysis.gap.answer.consequences import consequences
        progress('in the loop', None)
        answer['consequences'] = plain([each._asdict() for each
                                        in consequences(diagnosis, values, runs[0])])
        following = answer['next_experiment']
        if isinstance(model, str | Path) and following and following['command']:
            longer = f'{following["command"]} --actuator {model}'
            following['advice'] = following['advice'].replace(following['command'], longer)
            following['command'] = longer
    return Gap(answer | {'report': None, 'exports': [], 'quality': quality_of(everything),
                         'reliable': not doubtful},
               runs=everything, diagnosis=diagnosis,
               model=values if plant in PHYSICS else None)
