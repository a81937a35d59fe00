"""`asi gap --plan`: the recipe before recording a joint, from its nominal model and its limits."""

import math
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.bags.exchange.exporting import export
from asi_analysis.bags.exchange.units import conversion
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.gap.answer.command import nominal_model
from asi_analysis.gap.experiment.next_experiment import MEASURE
from asi_analysis.gap.experiment.plan import (
    ENCODER_BITS,
    FORCE_NOISE,
    FORCE_SHARE,
    IDENTIFIED,
    LIMIT_SHARE,
    MOST_RUNS,
    Drawn,
    Limits,
    Planned,
    answer_of,
    chances,
    nominal_force,
    plan_courses,
    recorded,
)
from asi_analysis.gap.experiment.suspects import Suspect, Told
from asi_analysis.gap.inference.probability import Names
from asi_analysis.gap.model.effects import PARAMETER
from asi_analysis.gap.model.group import TOLERANCE
from asi_analysis.gap.words import SIZES, UNIT_OF_SCALE, chance, digits, in_words, unit_of
from asi_analysis.reporting.result import Pictures, Result, Table
from asi_analysis.terminal import Progress, silent
from asi_common import parameter_file
from asi_common.parameter import ParameterError, Value

SENSORS: Final = ('command', 'position')
# Signals that are tried as one more sensor, and those that a plan knows.
MORE: Final = ('force', 'velocity', 'position')
KNOWN: Final = ('reference', 'command', 'force', 'position', 'velocity')
LIMITED: Final = {'position': ('rad', 'm'), 'velocity': ('rad/s', 'm/s'), 'command': ('Nm', 'N')}
RATES_HZ: Final = (50.0, 1000.0)
STILL: Final = 0.01   # of the largest speed of a course: below it the joint rests
SHORTEST_REST_S: Final = 0.2
_NUMBER: Final = r'[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?'
_LIMIT: Final = re.compile(
    rf'\s*(?:(?P<low>{_NUMBER})\s*:\s*)?(?P<high>{_NUMBER})\s*\[(?P<unit>[^\[\]]+)\]\s*')


class Plan(Result):
    """What to play and to record before a diagnosis of a joint: `plan_recording`."""

    title = 'What to record'
    rows = 'suspects'
    run: Run
    force: Array

    def parts(self) -> Iterator[str | Table]:
        unit = self.unit
        yield (f'Move the joint as follows, {self.runs} times, and record '
               f'{" and ".join(self.sensors)} at {self.rate_hz:g} Hz: {self.duration_s:.0f} s '
               'each time, from rest to rest.')
        names = (f'amplitude, {unit}', 'band, Hz', 'rests, s', f'speed, {unit}/s',
                 f'{"torque" if unit == "rad" else "force"}, {self.force_unit}', 'duration, s')
        yield Table(('motion', *names), [[
            each['course'], digits(each['amplitude']), _band(each['low_hz'], each['high_hz']),
            digits(each['rest_s']) if each['rest_s'] else '-', digits(each['speed']),
            digits(each['force']),
            f'{each["duration_s"]:.0f}'] for each in self.courses],
            f'motions about {self.middle:.4g} {unit}; force of the nominal model', names)
        yield Table(('effect', 'smallest size', 'probability of being named',
                     'nearest other explanation', 'distance, error floors'), [[
                         _in_words(each['suspect']), each['size'], chance(each['probability']),
                         _in_words(each['nearest']), digits(each['separation'])]
                         for each in self.suspects], 'what these recordings can identify',
                    ('probability of being named', 'distance, error floors'))
        yield from self.advice
        yield from (f'note: {note}' for note in self.notes)
        if self.reference:
            yield f'reference: {self.reference}'

    def pictures(self) -> Pictures:
        from asi_analysis.reporting.figures import recording
        name = 'torque' if self.unit == 'rad' else 'force'
        position = self.run.signal('reference')
        return {'reference': (recording(self.run.time_s, {
            'reference': (position, self.unit),
            'velocity': (np.gradient(position, self.run.period_s), f'{self.unit}/s'),
            name: (self.force, self.force_unit)}),
            f'The reference, its speed, and the {name} that it takes of the nominal joint.')}


def _band(low: float, high: float) -> str:
    return digits(high) if high < 1.2 * low else f'{digits(low)} to {digits(high)}'


def _in_words(name: str) -> str:
    return {f'{PARAMETER}load.stiffness': 'a spring', 'no_gap': 'no gap',
            f'{PARAMETER}load.mass': 'wrong mass or inertia'}.get(name) or in_words(name, 'joint')


def limits_of(path: Path, options: Sequence[str] = (), noise: Sequence[str] = ()) -> Limits:
    """
    Return the limits of a joint: `limit.SIGNAL` of asi_gap in a model file, then `options`.

    Texts such as 'position=-45:45[deg]', 'velocity=3[rad/s]' or 'command=5[Nm]'; noise: such as
    'position=0.01[deg]'. Raises InputError for what is no limit, or if one is missing.
    """
    texts = dict(_limits_in(path))
    for text in options:
        name, equals, value = text.partition('=')
        if not equals:
            raise InputError(f'--limit {text!r}: expected SIGNAL=VALUE[UNIT], as '
                             'velocity=3[rad/s]')
        texts[name.strip()] = (value, '--limit')
    found = {name: _limit(name, value, origin) for name, (value, origin) in texts.items()}
    for name, example in (('position', 'position=-45:45[deg]'),
                          ('velocity', 'velocity=90[deg/s]')):
        if name not in found:
            raise InputError(f'{path}: how far and how fast may the joint move? The limit of the '
                             f'{name} is missing: --limit {example}, or limit.{name} of asi_gap '
                             'in the file')
    units = {name: unit for name, (_, _, unit) in found.items()}
    turns = units['position'] == 'rad'
    for name, unit in units.items():
        if unit != LIMITED[name][not turns]:
            raise InputError(f'the limits do not agree: the position is in {units["position"]}, '
                             f'but the {name} in {unit}')
    low, high, _ = found['position']
    least = {name: _deviation(text, turns) for text in noise
             for name in [text.partition('=')[0].strip()]}
    return Limits(low, high, found['velocity'][1],
                  found['command'][1] if 'command' in found else math.inf, turns, least)


def _limits_in(path: Path) -> Iterator[tuple[str, tuple[str, str]]]:
    with suppress(ParameterError):   # of a file that has nothing for it
        for name, value in parameter_file.read_parameters(path, 'asi_gap').items():
            if name.startswith('limit.'):
                yield name.removeprefix('limit.'), (str(value), str(path))


def _limit(name: str, text: str, origin: str) -> tuple[float, float, str]:
    """Return the two ends of a limit in SI units, and the unit."""
    if name not in LIMITED:
        raise InputError(f'{origin}: {name} has no limit here: one of {", ".join(LIMITED)}')
    match = _LIMIT.fullmatch(text)
    converted = conversion(match['unit']) if match else None
    if match is None or converted is None or converted[0] not in LIMITED[name]:
        raise InputError(f'{origin}: {name}={text} is not a limit: expected a number and a unit '
                         'in brackets, ' + ('LOW:HIGH[deg] or [m]' if name == 'position' else
                                            f'one of {", ".join(LIMITED[name])}'))
    unit, factor = converted
    high = factor * float(match['high'])
    low = factor * float(match['low']) if match['low'] else -high
    if not (math.isfinite(high) and math.isfinite(low) and 1e-9 < high - low < 1e9) or (
            match['low'] and name != 'position'):
        raise InputError(f'{origin}: {name}={text} is not allowed: it takes ' + (
            'LOW:HIGH, the first below the second' if name == 'position' else
            'one number above 0'))
    return low, high, unit


def _deviation(text: str, turns: bool) -> float:
    """Return the standard deviation of a signal's noise, in SI units."""
    name, _, value = text.partition('=')
    match, units = _LIMIT.fullmatch(value), LIMITED.get(
        'command' if name.strip() == 'force' else name.strip())
    converted = conversion(match['unit']) if match and not match['low'] else None
    if match is None or converted is None or not units or converted[0] != units[not turns]:
        raise InputError(f'--noise {text!r}: expected SIGNAL=VALUE[UNIT], as position=0.01[deg]')
    level = converted[1] * float(match['high'])
    if not 0.0 <= level < 1e9:
        raise InputError(f'--noise {text!r} is not allowed: it takes a number from 0')
    return level


def _nominal(path: Path) -> dict[str, Value]:
    """Return the joint's parameters; {} if the file has its limits alone."""
    alone = any(True for _ in _limits_in(path))
    with warnings.catch_warnings():
        warnings.simplefilter('default')
        try:
            return {name: value for name, value in nominal_model(path, 'joint').items()
                    if name in ('load.mass', 'load.damping', 'load.stiffness')}
        except InputError as error:
            if alone and 'has nothing for the node' in str(error):
                return {}
            raise


def plan_recording(model: str | Path, sensors: Sequence[str] = SENSORS,
                   limits: Sequence[str] = (), noise: Sequence[str] = (), rate_hz: float = 250.0,
                   tolerance: float = TOLERANCE, out: str | Path | None = None,
                   progress: Progress = silent) -> Plan:
    """
    Return what to play and to record so that the usual suspects of a joint are separated.

    model: the file that `diagnose` takes, with load.mass (and load.damping, load.stiffness), and
    limit.position and limit.velocity of asi_gap if `limits` does not hold them, as texts like
    'position=-45:45[deg]'; sensors: signals that are recorded; noise: their standard deviations,
    as 'position=0.01[deg]'; rate_hz: of the recording, and of the reference; out: a .csv file for
    that. Raises InputError for what cannot be planned.
    """
    path = Path(model)
    if not RATES_HZ[0] <= rate_hz <= RATES_HZ[1]:
        raise InputError(f'--rate {rate_hz:g} is not allowed: from {RATES_HZ[0]:g} to '
                         f'{RATES_HZ[1]:g} Hz')
    if out is not None and Path(out).exists():   # before minutes of computing
        raise InputError(f'{out} exists already: give another file')
    given, bounds = _nominal(path), limits_of(path, limits, noise)
    names = _sensors(sensors, given, path)
    period = 1.0 / rate_hz
    plan = plan_courses(names, bounds, period, given, tolerance, progress)
    progress('more sensors', 0.95)
    force = nominal_force(plan.position, period, given)
    unit = 'rad' if bounds.turns else 'm'
    shown = recorded(plan.position, names, bounds, period, given)
    rows = [_row(name, plan, shown) for name in dict.fromkeys(
        each.name for each in plan.answer.tells)]
    untold = [row['suspect'] for row in rows if not row['told']]
    helping = _more_sensors(untold, names, plan, bounds, given, tolerance)
    for row in rows:
        row['sensor'] = helping.get(row['suspect'])
    run = Run(period * np.arange(plan.position.size, dtype=np.float64),
              reference_n=bounds.middle + plan.position, source='the plan',
              information={'signals': {'reference': unit}})
    document = {
        'plant': 'joint', 'model': str(path), 'sensors': list(names), 'runs': plan.runs,
        'rate_hz': rate_hz, 'duration_s': run.duration_s, 'unit': unit,
        'force_unit': 'Nm' if bounds.turns else 'N', 'middle': bounds.middle,
        'courses': [_course(each, period, given) for each in plan.courses],
        'suspects': rows, 'advice': list(_advice(rows, names)),
        'notes': list(_notes(bounds, names, plan, force, given)), 'reference': None}
    if out is not None:
        export(run, out)
        document['reference'] = str(out)
    return Plan(document, run=run, force=force)


def _sensors(names: Sequence[str], given: Mapping[str, Value], path: Path) -> tuple[str, ...]:
    """Return the sensors in order. Raises InputError for those that show nothing of a joint."""
    for name in names:
        if name not in KNOWN:
            raise InputError(f'--sensors {name}: it is no signal of a plan; those are '
                             + ', '.join(KNOWN))
    has = set(names)
    if has == {'reference', 'position'} or has == {'reference', 'velocity'}:
        if 'velocity' in has:
            raise InputError('--sensors reference,velocity: a plan moves a position; it takes '
                             'reference,position')
    elif not has & {'command', 'force'} or not has & {'position', 'velocity'}:
        raise InputError(f'--sensors {",".join(names)}: nothing to compare: it takes the command '
                         'or the force with the position or the velocity, or reference,position')
    elif 'load.mass' not in given:
        raise InputError(f'{path}: load.mass is missing, the mass or inertia of the joint: it '
                         'sets what a motion takes; or --sensors reference,position')
    # A loop that follows its reference is judged by the command where that is recorded.
    return tuple(name for name in KNOWN if name in has and (
        name != 'reference' or not has & {'command', 'force'}))


def _row(name: str, plan: Planned, run: Run) -> dict[str, Any]:
    """Return the row of a suspect: of its least size that is identified, else of its largest."""
    expected = {each: value for each, value in chances(plan.answer.tells, plan.runs).items()
                if each.name == name}
    suspect = next((each for each, value in expected.items() if value >= IDENTIFIED),
                   [*expected][-1])
    tells = plan.answer.tells[suspect]
    nearest = _nearest(tells)
    return {'suspect': name, 'size': _size(suspect, plan, run),
            'probability': expected[suspect], 'told': expected[suspect] >= IDENTIFIED,
            'nearest': '+'.join(nearest) or 'no_gap',
            'separation': math.sqrt(max(tells.left[nearest], 0.0))}


def _nearest(tells: Told) -> Names:
    return min(tells.left, key=lambda names: tells.left[names])


def _size(suspect: Suspect, plan: Planned, run: Run) -> str:
    """Return the assumed size of a suspect, in words."""
    group, free = plan.groups[suspect.group], suspect.variant.free[0]
    value, name = float(plan.answer.records[suspect][free.field]), free.field
    if free.scale == 'nominal':
        return f'{digits(value / float(group.nominal[name]))} times nominal'
    unit = free.unit or UNIT_OF_SCALE.get(free.scale, '')
    words = {'load_stiffness': 'stiffness'}.get(name) or SIZES[name]
    return f'{words} {digits(value, unit_of(unit, group.channels[0], run, "joint"))}'


def _course(course: Drawn, period: float, given: Mapping[str, Value]) -> dict[str, Any]:
    """Return a course in figures."""
    x = course.position
    speed = np.gradient(x, period)
    # Of the moving part: from one passage of the middle upwards to the next.
    up = np.flatnonzero((x[:-1] <= 0.0) & (x[1:] > 0.0)) * period
    cycles = np.diff(up) if up.size > 1 else np.array([1.0 / course.frequency_hz])
    still = np.abs(speed) < STILL * np.abs(speed).max()
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.view(np.int8), [0]])))
    rests = [(end - begin) * period for begin, end in zip(edges[::2], edges[1::2], strict=True)
             if begin > 0 and end < x.size and (end - begin) * period > SHORTEST_REST_S]
    return {'course': course.name, 'amplitude': float(np.abs(x).max()),
            'low_hz': float(1.0 / cycles.max()), 'high_hz': float(1.0 / cycles.min()),
            'rest_s': float(max(rests, default=0.0)), 'duration_s': x.size * period,
            'speed': float(np.abs(speed).max()),
            'force': float(np.abs(nominal_force(x, period, given)).max())}


def _more_sensors(untold: Sequence[str], sensors: Sequence[str], plan: Planned, limits: Limits,
                  given: Mapping[str, Value], tolerance: float) -> dict[str, str]:
    """Return, by suspect, one more sensor with which the same courses would identify it."""
    found: dict[str, str] = {}
    if 'reference' in sensors:
        return found
    for sensor in (name for name in MORE if name not in sensors):
        wanted = [name for name in untold if name not in found]
        if not wanted:
            break
        with_it = [name for name in KNOWN if name in {*sensors, sensor}]
        answer = answer_of(plan.position, with_it, limits, plan.period_s, given, tolerance,
                           plan.scales, only=wanted)
        found |= {each.name: sensor for each, value in chances(answer.tells, plan.runs).items()
                  if value >= IDENTIFIED}
    return found


def _advice(rows: Sequence[Mapping[str, Any]], sensors: Sequence[str]) -> Iterator[str]:
    """Yield which suspects are not identified, and what would identify them."""
    for row in rows:
        if row['told']:
            continue
        name, words = row['suspect'], _in_words(row['suspect'])
        text = (f'{words} of this size cannot be identified: no motion here separates it enough '
                f'from {_in_words(row["nearest"])} with {" and ".join(sensors)}')
        quantity = next((what for names, what in MEASURE if name in names), None)
        if row['sensor']:
            text += f'; with the {row["sensor"]} recorded too it can be identified'
        elif quantity:
            text += f'; measure {quantity}'
        yield text
    if 'reference' in sensors:
        yield ('friction, compliance, gravity, springs and the inertia do not show in reference '
               'and position: record the command of the drive too (its torque or current)')


def _notes(limits: Limits, sensors: Sequence[str], plan: Planned, force: Array,
           given: Mapping[str, Value]) -> Iterator[str]:
    """Yield what was assumed."""
    unit, force_unit = ('rad', 'Nm') if limits.turns else ('m', 'N')
    yield (f'limits: {limits.low:.4g} to {limits.high:.4g} {unit} and {limits.speed:.4g} {unit}/s,'
           f' of which {LIMIT_SHARE:.0%} are used'.replace('%', ' %'))
    if 'load.mass' in given:
        most = float(np.abs(force).max())
        yield (f'the drive gives at most {limits.force:.4g} {force_unit}, of which the nominal '
               f'joint needs {most / limits.force:.0%}, at most {FORCE_SHARE:.0%}'
               .replace('%', ' %')
               if math.isfinite(limits.force) else
               f'no limit of the force was given (--limit command=VALUE[{force_unit}]): the drive '
               f'must give {2.0 * most:.3g} {force_unit}, twice what the nominal joint needs')
        yield ('of the load ' + ', '.join(
            f'{name.removeprefix("load.")} {value:.4g}' for name, value in given.items())
            + '; gravity, friction and what the model does not hold come on top')
    assumed = [name for name in sensors if name not in limits.noise and name != 'reference']
    if assumed:
        yield (f'noise assumed of {" and ".join(assumed)}: an encoder of {ENCODER_BITS} bits, '
               f'{100.0 * FORCE_NOISE:g} % of a force; --noise position=0.01[deg] sets it')
    yield ('the probabilities assume that everything else is as in the model: a real joint '
           'differs in several ways, and each is identified less surely')
    if plan.runs == MOST_RUNS:
        yield f'more than {MOST_RUNS} runs were not tried'
