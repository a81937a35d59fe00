"""What a file holds, before it is imported: columns, units, times, and a mapping to check."""

import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.bags.bag_file import read_contents
from asi_analysis.bags.exchange.bag_table import is_bag, read_bag_table
from asi_analysis.bags.exchange.column_mapping import UNITS_OF, listed, numbers_of
from asi_analysis.bags.exchange.dates import since_first
from asi_analysis.bags.exchange.lerobot import is_dataset, notes_of, refuse_episode
from asi_analysis.bags.exchange.ros1_bag import opened
from asi_analysis.bags.exchange.several_files import GAP
from asi_analysis.bags.exchange.table_file import Table, read_table
from asi_analysis.bags.exchange.units import BRACKETS, UNITS, conversion, unit_in
from asi_analysis.bags.run import usual_step
from asi_analysis.errors import InputError
from asi_analysis.reporting.result import Result, table_of
from asi_analysis.reporting.result import Table as Printed

# Words in the name of a column that suggest a signal, the more specific signal first.
WORDS: Final[dict[str, frozenset[str]]] = {signal: frozenset(words.split()) for signal, words in {
    'time': 't time timestamp stamp clock sec secs seconds zeit elapsed ms',
    'reference': 'ref reference des desired set setpoint sp target goal soll wanted commanded '
                 'demand action',
    'command': 'command cmd commands u control voltage volt volts current pwm duty op drive',
    'force': 'force torque load effort tau f fx loadcell moment thrust',
    'velocity': 'vel velocity speed dq qd qdot omega rpm',
    'pressure': 'pressure press p',
    'position': 'pos position angle q qm x displacement disp stroke encoder enc theta '
                'extension pv'}.items()}
VALVE: Final = frozenset(('valve', 'spool'))
# Assumed unit of each signal without one.
ASSUMED: Final = {'time': 's', 'reference': '', 'command': 'N', 'force': 'N', 'velocity': 'm/s',
                  'pressure': 'Pa', 'position': 'm', 'valve_position': 'm'}
# Signals that may be controlled.
OUTPUTS: Final = ('position', 'velocity', 'pressure', 'force')
# Name of the joint positions in a LeRobot dataset, unless the names of the joints say otherwise.
STATE: Final = 'observation.state'
# Words in brackets after a name that are no units.
REMARKS: Final = frozenset('measured actual filtered meas act raw est estimated calc true left '
                           'right desired joint motor load axis'.split())
# Words that suggest a rotary joint.
TURNS: Final = frozenset('angle q theta joint torque tau moment'.split())
# Message types of which a preview is made; the columns of any other can be mapped too.
PREVIEWED: Final = ('sensor_msgs/msg/JointState', 'geometry_msgs/msg/WrenchStamped',
                    'std_msgs/msg/Float64', 'std_msgs/msg/Float32',
                    'std_msgs/msg/Float64MultiArray', 'sensor_msgs/msg/FluidPressure')
# Units of a rotary joint and of a wrench, by REP 103.
JOINT_UNITS: Final = {'position': 'rad', 'velocity': 'rad/s', 'effort': 'Nm'}
WRENCH_UNITS: Final = {'force': 'N', 'torque': 'Nm'}
# Times since 1970 in whole units of s, ms, us and ns are above these.
EPOCH: Final = ((1e17, 'ns'), (1e14, 'us'), (1e11, 'ms'))


class _Guess(NamedTuple):
    signal: str
    unit: str
    why: str


class Preview(Result):
    """The result of `preview`, by the keys of `asi import --json` without a mapping."""

    rows = 'columns'

    def parts(self) -> Iterator[str | Printed]:
        yield f'{self.file}: {self.samples} rows'
        yield table_of(self.columns, {
            'column': '{name}', 'from': '{smallest:.5g}', 'to': '{largest:.5g}',
            'missing': '{missing:d}', 'unit': '{unit}', 'signal': '{signal}', 'why': '{why}'})
        if self.rate_hz:
            yield (f'time: {self.duration_s:.6g} s, {self.rate_hz:.6g} Hz, {self.gaps} gaps'
                   + (f', the longest {self.longest_gap_s:.4g} s' if self.gaps else ''))
        yield from (f'to check: {note}' for note in self.notes)


def preview(path: str | Path, rate_hz: float | None = None, *, skip_lines: int = 0,
            delimiter: str | None = None, columns: Sequence[str] | None = None,
            episode: int | None = None) -> Preview:
    r"""
    Return what a file holds, and a guess of its mapping with the reasons; nothing is imported.

    Arguments as of `import_recording`. `command` is the call of `asi import` to copy, `notes` say
    what was assumed. Raises InputError for a file that cannot be read.

    >>> import pathlib, tempfile
    >>> from asi_analysis.bags.exchange.preview import preview
    >>> file = pathlib.Path(tempfile.mkdtemp(), 'log.csv')
    >>> _ = file.write_text('time_ms,angle_deg\n0,0.0\n1,0.5\n2,1.0\n')
    >>> preview(file).mapping
    ['time=time_ms[ms]', 'position=angle_deg[deg]']
    """
    path = Path(path)
    if not is_dataset(path):
        refuse_episode(path, episode)
    table = (_bag_columns(path) if is_bag(path) else
             read_table(path, skip_lines, delimiter, columns, episode, guess=True))
    dataset = is_dataset(path)
    notes: list[str] = notes_of(path, episode) if dataset else []
    values = _values(table, path, notes)
    if not values:
        raise InputError(f'{path} has no column of numbers; '
                         + ('; '.join(notes) or 'it has no column'))
    dates = {name for name in values if not np.issubdtype(table[name].dtype, np.number)
             and since_first(name, table[name], path) is not None}
    longest = max(map(len, values.values()))
    guesses = {name: _guess(name) for name, column in values.items() if len(column) == longest}
    notes += [f'{name}: no signal has the unit {unit}: give a scale to one that a signal has, or '
              f'let a signal stand for it, as in position={name}'
              for name in values if (unit := _unknown_unit(name))]
    time: str | None = None
    time_s: Array | None = None
    if is_bag(path):    # it has its own times
        time_s = values.pop('time')
        guesses.pop('time')
    elif rate_hz is None:
        time = _time(values, dates, guesses, notes)
        time_s = _seconds(values, time, guesses)
    chosen = _chosen(guesses, notes, time)
    mapping = [f'{guess.signal}={name}' + ('' if name in dates else f'[{guess.unit}]')
               for name, guess in chosen.items()]
    if time_s is None and rate_hz is None:
        notes.append('no column is a time: give --rate HZ')
    others = [name for name in values if name != time]
    if others and not set(chosen) - {time}:
        notes.append('no column has the name of a signal: map them yourself')
        mapping.append(f'SIGNAL={others[0]}[UNIT]')
    options = {'rate': rate_hz or ('HZ' if time_s is None else None), 'delimiter': delimiter,
               'skip-lines': skip_lines, 'columns': ','.join(columns or ()),
               'episode': str(episode or 0) if dataset else None}
    return Preview({
        'file': str(path), 'samples': longest,
        'columns': [_column(name, column, guesses.get(name), name in chosen)
                    for name, column in values.items()],
        **_times(time_s, rate_hz, longest), 'mapping': mapping, 'notes': notes,
        'command': command([path], mapping, options)}, options=options)


def _values(table: Table, path: Path, notes: list[str]) -> dict[str, Array]:
    """Return the columns of numbers, dates as seconds; add a note on each other one."""
    found = {}
    for name, column in table.items():
        try:
            seconds = since_first(name, column, path)
            found[name] = numbers_of(name, column, path) if seconds is None else seconds
        except InputError as error:
            notes.append(f'left out: {str(error).removeprefix(f"{path}: ")}')
    return found


def _words(name: str) -> list[str]:
    """Return the words of a name: jointPos_cmd[deg] is joint, pos, cmd, deg."""
    apart = re.sub(r'(?<=[a-z])(?=[A-Z])', ' ', name)
    return [word.lower() for word in re.split(r'[^A-Za-z]+', apart) if word]


def _unknown_unit(name: str) -> str:
    """Return the unit that stands in brackets after a name, if no signal can have it."""
    found = BRACKETS.search(name)
    unknown = found is not None and not unit_in(name) and not REMARKS & set(_words(found[1]))
    return found[1] if found and unknown and re.search(r'[^\W\d]', found[1]) else ''


def _guess(name: str) -> _Guess | None:
    """Return a guess of the signal in a column, from its name; None without one."""
    unit = unit_in(name)
    if _unknown_unit(name):
        return None
    if name == 'X_Value':
        return _Guess('time', '', 'named so by LabVIEW')
    if name.startswith('/'):
        name = re.sub('/[xyz]$', '', name)
        unit = unit or (JOINT_UNITS | WRENCH_UNITS).get(name.rpartition('/')[2], '')
    words = _words(name.rpartition('/')[2] if _is_of_joint(name) else name)
    signals = [signal for signal, known in WORDS.items() if known & set(words)]
    if not signals and name.startswith(STATE):
        signals, words = ['position'], ['state', *words]
    if 'position' in signals and VALVE & set(words):
        signals = ['valve_position']
    motion = [signal for signal in signals if signal in ('position', 'velocity', 'pressure')]
    if 'command' in signals and motion:          # a commanded motion is a reference
        signals = ['reference', *motion]
    si = (conversion(unit) or ('',))[0]
    if unit and signals and not any(si in UNITS_OF[signal] for signal in signals):
        # In tau_m the m means measured, in u_in the in means input, in p_A the A a port. A share
        # of the range of a process is no length: one stands for it.
        other = unit in ('m', 'in') or (unit == 'A' and 'pressure' in signals) or (
            si == '1' and signals[0] in ('position', 'reference'))
        signals, unit = (signals, '') if other else ([], unit)
    if signals:
        signal = next(each for each in signals if not unit or si in UNITS_OF[each])
        matched = next((word for word in words if word in WORDS.get(signal, VALVE)), words[0])
        return _Guess(signal, unit, f'named {matched}' + (f', in {unit}' if unit else ''))
    by_unit = [signal for signal in (
        'time', 'position', 'velocity', 'force', 'pressure', 'command')
               if si in UNITS_OF[signal] and si not in ('1', 'V')]   # V: a sensor
    return _Guess(by_unit[0], unit, f'in {unit}') if unit and by_unit else None


def _is_of_joint(name: str) -> bool:
    return name.startswith('/') and name.rpartition('/')[2] in JOINT_UNITS


def _rises(column: Array) -> bool:
    steps = np.diff(column[np.isfinite(column)])
    return bool(len(steps) and (steps >= 0.0).all() and np.median(steps) > 0.0)


def _time(values: dict[str, Array], dates: set[str], guesses: dict[str, _Guess | None],
          notes: list[str]) -> str | None:
    """Return the name of the column of the time, and complete its guess; None without one."""
    named = [name for name, guess in guesses.items() if guess and guess.signal == 'time']
    for name in named:
        if not _rises(values[name]):
            notes.append(f'{name} is named as a time but does not rise')
            guesses[name] = None
    named = [name for name in named if guesses[name]]
    even = [name for name, guess in guesses.items() if guess is None and _rises(values[name])
            and np.ptp(np.diff(values[name])) < 0.1 * float(np.median(np.diff(values[name])))]
    found = next(iter(named or even), None)
    if found is None:
        notes += [f'{name} rises, but not evenly: is it the time?'
                  for name, guess in guesses.items() if guess is None and _rises(values[name])]
        return None
    name, guess = found, guesses[found] or _Guess('time', '', 'rises evenly')
    if not guess.unit and name not in dates:
        size = float(np.nanmax(np.abs(values[name])))
        unit = next((unit for least, unit in EPOCH if size > least), 's')
        guess = guess._replace(unit=unit)
        step = float(np.median(np.diff(values[name][np.isfinite(values[name])])))
        notes.append(f'{name} has no unit: with {unit} a step is {step * UNITS[unit][1]:.4g} s')
    guesses[name] = guess
    return name


def _seconds(values: dict[str, Array], name: str | None, guesses: dict[str, _Guess | None]
             ) -> Array | None:
    """Return the time in seconds; None if no column is a time."""
    guess = guesses.get(name or '')
    if name is None or guess is None:
        return None
    return values[name] * (conversion(guess.unit) or ('s', 1.0))[1]


def _chosen(guesses: dict[str, _Guess | None], notes: list[str], time: str | None
            ) -> dict[str, _Guess]:
    """Return the guess of the first column of each signal; add a note on the others."""
    chosen: dict[str, _Guess] = {}
    others: dict[str, list[str]] = {}
    for name, guess in guesses.items():
        if guess is None or (guess.signal == 'time') != (name == time):
            continue
        taken = next((other for other, each in chosen.items() if each.signal == guess.signal), '')
        if taken:
            others.setdefault(f'the {guess.signal} as well as {taken}', []).append(name)
            continue
        chosen[name] = guess
    notes += [f'{listed(names)} may be {what}' for what, names in others.items()]
    if any(map(_is_of_joint, chosen)):
        notes.append('a joint state has no units: those of a rotary joint are assumed')
    kinds = [(conversion(each.unit) or ('',))[0] for each in chosen.values() if each.unit]
    rotary = bool({'rad', 'rad/s', 'Nm'} & set(kinds)) or (
        not {'m', 'm/s', 'N'} & set(kinds) and any(
            TURNS & set(_words(name)) or name.startswith(STATE) for name in chosen))
    # A reference has the unit of the signal that it is for.
    for name, guess in sorted(chosen.items(), key=lambda each: each[1].signal == 'reference'):
        if guess.unit or guess.signal == 'time':
            continue
        unit = ASSUMED[guess.signal]
        if rotary:
            unit = {'m': 'rad', 'm/s': 'rad/s', 'N': 'Nm'}.get(unit, unit)
        if guess.signal == 'reference':
            named = [each for each in OUTPUTS if WORDS[each] & set(_words(name))] or OUTPUTS
            unit = next((chosen[other].unit or ASSUMED[chosen[other].signal] for other in chosen
                         if chosen[other].signal in named), unit or 'N')
        share = conversion(unit_in(name)) == ('1', 0.01)
        notes.append(f'{name} is in %, which no {guess.signal} has: {unit} stands for it' if share
                     else f'{name} has no unit: {unit} is assumed')
        chosen[name] = guess._replace(unit=unit)
    return chosen


def _column(name: str, values: Array, guess: _Guess | None, chosen: bool) -> dict[str, Any]:
    known = values[np.isfinite(values)]
    return {'name': name, 'missing': len(values) - len(known),
            'smallest': float(known.min()) if len(known) else None,
            'largest': float(known.max()) if len(known) else None,
            'unit': guess.unit if guess else '',
            'signal': guess.signal if guess and chosen else '', 'why': guess.why if guess else ''}


def _times(time_s: Array | None, rate_hz: float | None, samples: int) -> dict[str, Any]:
    """Return rate, duration and gaps."""
    if time_s is None:
        return {'rate_hz': rate_hz, 'duration_s': samples / rate_hz if rate_hz else None,
                'gaps': 0, 'longest_gap_s': None}
    steps = np.diff(time_s[np.isfinite(time_s)])
    usual = usual_step(time_s[np.isfinite(time_s)])
    gaps = steps[steps > GAP * usual]
    return {'rate_hz': 1.0 / usual if usual > 0.0 else None, 'duration_s': float(steps.sum()),
            'gaps': len(gaps), 'longest_gap_s': float(gaps.max()) if len(gaps) else None}


def command(paths: Sequence[Path], mapping: Sequence[str], options: Mapping[str, Any]) -> str:
    """Return the call of `asi import` for a mapping; options that are empty are left out."""
    parts = ['asi', 'import', *map(str, paths)]
    parts += [part for each in mapping for part in ('--map', each)]
    parts += [part for name, value in options.items() if value
              for part in (f'--{name}', f'{value:g}' if isinstance(value, float) else str(value))]
    return shlex.join([*parts, '--out', paths[0].name.partition('.')[0] + '_bag'])


def _bag_columns(path: Path) -> Table:
    """Return the columns of the topics of PREVIEWED types; the first joint state is the base."""
    types = message_types(path)
    topics = sorted((topic for topic, type_ in types.items() if type_ in PREVIEWED),
                    key=lambda topic: PREVIEWED.index(types[topic]))
    if not topics:
        raise InputError(f'{path}: no topic of the types {", ".join(PREVIEWED)}; it has '
                         + ', '.join(f'{topic} ({type_})' for topic, type_ in types.items()))
    table = read_bag_table(path, [f'{topic}/' for topic in topics])[0]
    return {name: column for name, column in table.items() if '/layout/' not in name}


def message_types(path: Path) -> dict[str, str]:
    """Return the message types of the topics that have messages."""
    try:
        with opened(path) as reader:
            return {each.topic: each.msgtype for each in reader.connections if each.msgcount}
    except InputError:   # cut off, or without metadata.yaml
        topics = {} if path.suffix == '.bag' else read_contents(path, lambda _: True).topics
        if not any(map(len, topics.values())):
            raise
        return {each.name: each.type for each in topics.values() if len(each)}
