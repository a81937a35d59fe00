"""The answer in words: names of effects, blocks and sizes for people, and the sentences."""

import re
from collections.abc import Mapping, Sequence
from typing import Any, Final

from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_analysis.bags.run import Run
from asi_analysis.gap.model.effects import (
    DOTTED,
    MOTIONS,
    NO_GAP,
    PARAMETER,
    UNKNOWN,
    Free,
    block_of,
)
from asi_analysis.gap.model.static import static_signals
from asi_common.record import field_name

NAMES: Final = {
    'transport_delay': 'dead time of the command', 'command_quantisation': 'steps of the command',
    'valve_hysteresis': 'hysteresis of the valve', 'valve_deadband': 'dead band of the valve',
    'valve_saturation': 'saturation of the valve', 'valve_bias': 'bias of the valve',
    'valve_lag': 'lag of the valve', 'coulomb_friction': 'Coulomb friction',
    'friction_asymmetry': 'asymmetric friction', 'load_compliance': 'compliance of the load',
    'sensor_offset': 'offset of the force sensor', 'sensor_gain': 'gain of the force sensor',
    'drive_gain': 'gain of the drive', 'position_gain': 'gain of the position sensor',
    'sensor_lag': 'lag of the force sensor', 'sensor_drift': 'drift of the force sensor',
    'sensor': 'force sensor', UNKNOWN: 'something that no known effect explains'}
# Of a joint, whose drive may be electric and whose force may be a torque.
OF_A_JOINT: Final = (('valve', 'drive'), ('disturbance force', 'disturbance'),
                     ('force sensor', 'sensor'))
# Of a static characteristic, from any input to any output.
OF_STATIC: Final = {
    'transport_delay': 'delay', 'command_quantisation': 'steps of the input',
    'valve_hysteresis': 'hysteresis', 'valve_deadband': 'dead band',
    'valve_saturation': 'saturation', 'valve_lag': 'lag',
    'gain_asymmetry': 'different gains to both sides', 'curvature': 'curvature',
    'disturbance_force': 'disturbance', 'sensor_drift': 'drift', 'sensor_gain': 'another gain',
    'sensor_offset': 'offset', 'command_path': 'path of the input', 'valve': 'characteristic',
    'mechanics': 'surroundings', 'sensor': 'zero and gain'}
# Sizes of effects that are not parameters of the simulator. Other fields are shape parameters.
SIZES: Final = {
    'command_delay': 'delay', 'command_quantum': 'step', 'command_bias': 'bias',
    'loop_width': 'half width', 'command_deadband': 'half width', 'valve_lag': 'time',
    'valve_limit': 'limit', 'orifice_deadband': 'half width', 'orifice_bias': 'bias',
    'force_limit': 'limit', 'damping_viscous': 'viscous', 'damping_quadratic': 'quadratic',
    'damping_opening': 'at full opening', 'supply_drop': 'share lost',
    'supply_sag': 'share lost with the valve open', 'leakage_linear': 'share lost',
    'leakage_quadratic': 'share lost at the largest force', 'air_time': 'time at no force',
    'friction_level': 'sliding friction', 'friction_asymmetry': 'asymmetry',
    'friction_breakaway': 'breakaway over sliding friction, less one', 'viscous': 'damping',
    'friction_creep': 'velocity over which the friction rises',
    'viscous_asymmetry': 'asymmetry of the viscous friction', 'backlash': 'half width of the gap',
    'compliance': 'compliance', 'disturbance': 'constant', 'disturbance_wave': 'wave',
    'disturbance_frequency': 'frequency', 'disturbance_pulse': 'pulse',
    'disturbance_start': 'from', 'disturbance_end': 'to', 'sensor_offset': 'offset',
    'sensor_gain_error': 'relative error of the gain', 'sensor_lag': 'time',
    'sensor_drift': 'drift',
    'drive_loss': 'share of the force lost', 'position_gain_error': 'relative error of the gain',
    'drive_delay': 'delay', 'drive_lag': 'time',
    'servo_friction': 'sliding friction over the stiffness of the loop',
    'servo_breakaway': 'breakaway over sliding friction, less one',
    'servo_load_frequency': 'natural frequency',
    'servo_upper': 'upper limit of the reference',
    'servo_lower': 'lower limit of the reference',
    'gravity_sine': 'sin q term', 'gravity_cosine': 'cos q term',
    'deadband_centre': 'centre',
    'deadband_slope': 'share of the gain within',
    'gain_asymmetry': 'half of the difference over the mean gain',
    'asymmetry_centre': 'from', 'limit_above': 'upper limit', 'limit_below': 'lower limit',
    'curve_square': 'of second order', 'curve_cube': 'of third order', 'gain': 'gain',
    'offset': 'shifted by'}
UNIT_OF_SCALE: Final = {'command': 'N', 'force': 'N', 'drift': 'N/s'}
UNITS: Final = {field_name(parameter.name): parameter.unit for parameter in ACTUATOR_PARAMETERS}
LEAST_SHARE: Final = 0.05   # share of the gap from which a block is named
LISTED: Final = 6   # the most unchanged parameters that are named
NARROW: Final = 0.02   # an interval below this share of the value is shown as ±


def in_words(name: str, plant: str) -> str:
    """Return an effect, a block, `no_gap` or `unknown` in words of the plant."""
    words = NAMES.get(name, name.replace('_', ' '))
    if plant == 'static':
        return OF_STATIC.get(name, words)
    if name.startswith(PARAMETER):
        return f'{name.removeprefix(PARAMETER)} beyond its tolerance'
    for ours, theirs in OF_A_JOINT if plant == 'joint' else ():
        words = words.replace(ours, theirs)
    return words


def with_id(name: str, plant: str) -> str:
    """Return an effect in words, with its name in brackets where they differ."""
    words = in_words(name, plant)
    same = name.startswith(PARAMETER) or words == name.replace('_', ' ')
    return words if same else f'{words} ({name})'


def signal_of(channel: str, run: Run, plant: str) -> str:
    """Return the recorded signal that a channel predicts; `valve` is the drive of a joint."""
    if channel in MOTIONS:
        return channel
    if channel == 'static':
        return static_signals(run)[1]
    if channel != 'valve':
        return 'force' if run.force_n is not None else 'command'
    if plant != 'joint':
        return 'valve_position'
    return 'force' if run.command_n is not None else run.controlled()


def unit_of(unit: str, channel: str, run: Run, plant: str) -> str:
    """Return a unit of the actuator's parameters, in the units of the recording."""
    if plant == 'static':
        given, got = (run.unit(name) for name in static_signals(run))
        return _of_number(unit, given, 'input').replace('input', given).replace('output', got)
    if plant != 'joint':
        return unit
    force = run.unit(signal_of(channel, run, plant))
    length = (run.unit('position') if run.position_m is not None else
              run.unit('velocity').removesuffix('/s'))
    if channel == 'valve':   # in the unit of what it follows
        force, length = run.unit('command' if run.command_n is not None else 'reference'), force
    if (force, length) != ('N', 'm'):
        unit = unit.replace('kg', 'N s2/m')
    unit = _of_number(_of_number(unit, force, 'N'), length, 'm')
    return re.sub('[Nm]', lambda match: {'N': force, 'm': length}[match[0]], unit)


def _of_number(unit: str, given: str, name: str) -> str:
    """Return a unit without what has the unit `name` in it if a mere number is given for that."""
    if given != '1':
        return unit
    return re.sub(f'^{name}2?(?= |$)|/{name}2?(?= |$)', '', unit).strip().replace(f'{name}/', '1/')


def unit_of_free(free: Free, channel: str, run: Run, plant: str) -> str:
    """Return the unit of a free parameter, in the units of the recording."""
    return unit_of(free.unit or UNITS.get(free.field.partition('@')[0],
                                          UNIT_OF_SCALE.get(free.scale, '')), channel, run, plant)


def percent(share: float) -> str:
    """Return a share in per cent, with three significant digits; 0 only if it is."""
    if 0.0 < share < 5e-6:
        return 'below 0.001 %'
    return f'{round(100.0 * share, 3):.3g} %'


def chance(probability: float) -> str:
    """Return a probability in per cent; never 0 or 100."""
    if probability < 0.001 or probability > 0.999:
        return 'below 0.1 %' if probability < 0.001 else 'above 99.9 %'
    return percent(probability)


def digits(value: float, unit: str = '') -> str:
    """Return a value with three significant digits and its unit."""
    return f'{f"{value:#.3g}".rstrip(".")} {unit}'.rstrip()


def between(value: float, low: float, high: float, unit: str = '') -> str:
    """Return a value with its interval, which is shown as ± if it is NARROW."""
    if high - low < NARROW * abs(value):
        return f'{digits(value, unit)} ± {50.0 * (high - low) / abs(value):.1g} %'
    return f'{digits(value, unit)} ({digits(low)} to {digits(high)})'


def shrink_in_words(row: Mapping[str, Any]) -> str:
    """Return by how much a gap shrinks, with the 95 % interval."""
    if row['shrink_low'] > 0.999:
        return 'more than 99.9 %'
    return (f'{percent(row["shrink"])} ({percent(row["shrink_low"])} to '
            f'{percent(row["shrink_high"])})')


def size_in_words(row: Mapping[str, Any], field: str) -> str:
    """Return a size of a row of `which` with name, unit, interval and multiple of the nominal."""
    plain, _, recording = field.partition('@')
    value, nominal = row['parameters'][field], row['nominal'].get(field)
    return ''.join((
        SIZES.get(plain) or DOTTED[plain], f' in recording {recording}' if recording else '', ' ',
        between(value, row['parameters_low'][field], row['parameters_high'][field],
                row['units'][field]),
        f', {digits(value / nominal)} times nominal' if nominal is not None else '',
        ', at the limit of its range' if field in row['at_limit'] else ''))


def sizes_in_words(row: Mapping[str, Any], known: Sequence[str] = ()) -> str:
    """Return the sizes of a row of `which`, but for those that are `known`."""
    return '; '.join(size_in_words(row, field) for field in row['parameters']
                     if field not in known and field.partition('@')[0] in SIZES | DOTTED)


def _named(name: str, answer: Mapping[str, Any], plant: str) -> str:
    """Return an effect in words; of a nominal parameter, its ratio to the nominal value."""
    if not name.startswith(PARAMETER):
        return in_words(name, plant)
    row = next(row for row in answer['which'] if row['effect'] == name)
    (field, nominal), = row['nominal'].items()
    value, low, high = (row[key][field] / nominal
                        for key in ('parameters', 'parameters_low', 'parameters_high'))
    times = between(value, low, high, 'times nominal')
    if answer['baseline']:
        return f'{DOTTED[field]} is {times.replace("nominal", "the healthy one")}'
    return (f'{DOTTED[field]} is {times}, beyond the tolerance of '
            f'{percent(row["tolerance"][field])}')


def sentences(answer: Mapping[str, Any]) -> list[str]:
    """Return the sentences of an answer: verdict, shrink, doubts, next experiment."""
    plant = answer['plant']
    limits = ', '.join(f'{row["parameter"]} ({digits(row["value"], row["unit"])}, '
                       f'{digits(row["value"] / row["nominal"])} times nominal)'
                       for row in answer['at_limit'])
    rest = [together(verdict, plant) for verdict in answer['ambiguity_set']
            if verdict != answer['verdict']]
    following = answer['next_experiment']
    return [each for each in (
        answer['baseline'] and answer['baseline']['change'] == 'cannot_tell'
        and 'It is uncertain whether anything has changed.',
        _found(answer, plant), *_changes(answer, plant), _error(answer), answer['unexplained'],
        limits and f'At the limit of the {"spread" if answer["baseline"] else "tolerance"}: '
                   f'{limits}. If the real value lies beyond it, '
                   'the answer may be wrong.',
        f'It could also be {"; or ".join(rest)}.' if rest else
        answer['verdict'] != NO_GAP and 'No other explanation is nearly as probable.',
        following and f'What next: {following["advice"]}.') if each]


def together(verdict: str, plant: str) -> str:
    """Return the effects of a verdict in words, the unknown one last."""
    names = sorted(verdict.split('+'), key=lambda name: name == UNKNOWN)
    return ' and '.join(in_words(name, plant) for name in names)


def _found(answer: Mapping[str, Any], plant: str) -> str:
    """Return the verdict as a sentence."""
    names = sorted(answer['verdict'].split('+'), key=lambda name: name == UNKNOWN)
    sure = f'(probability {chance(answer["probability"])})'
    changed = answer['baseline']
    if names == [NO_GAP]:
        return (f'{"Perhaps nothing" if changed["change"] == "cannot_tell" else "Nothing"} has '
                f'changed beyond the spread of the healthy recordings {sure}.'
                if changed else f'No gap beyond the noise and the tolerance of the model {sure}.')
    where = {row['block']: row['share'] for row in answer['where']
             if row['share'] >= LEAST_SHARE}
    named = {block for name in names if (block := block_of(name))}
    blocks = [block for block in where if block in named] or list(where)[:1]
    what = ('The gap' if not changed else 'The change' if changed['change'] == 'changed' else
            'A change, if there is one,')
    found = (f'{what} lies in the {" and the ".join(in_words(each, plant) for each in blocks)}: '
             f'{" and ".join(_named(name, answer, plant) for name in names)} {sure}.')
    if len(where) < 2:
        return found
    return found + ' Shares of the gap: ' + ', '.join(
        f'{in_words(block, plant)} {share:.0%}'.replace('%', ' %')
        for block, share in where.items()) + '.'


def _changes(answer: Mapping[str, Any], plant: str) -> list[str]:
    """Return the sentences of what has changed since the healthy recordings, and what has not."""
    if not (found := answer['baseline']):
        return []
    count = len(found['sources'])
    of = f'the {count} healthy recordings' if count > 1 else 'the healthy recording'
    whose = 'their' if count > 1 else 'its'
    gap = next(row for row in found['left'] if row['channel'] == answer['gap']['channel'])
    lines = [f'The model of {of} leaves at most {percent(gap["healthy_nrmse"])} of {whose} '
             f'{gap["signal"].replace("_", " ")} (rms), and now {percent(gap["now_nrmse"])}.']
    rows = found['parameters']
    changed = [f'{_called(row, plant)} {_healthy(row)} to '
               f'{between(row["now"], row["now_low"], row["now_high"], row["unit"])}'
               for row in rows if row['changed']]
    within = list(dict.fromkeys(_called(row, plant) for row in rows if not row['changed']))
    if len(within) > LISTED:
        within = [f'{len(within)} parameters (--json lists them)']
    return [*lines, *([f'Changed: {"; ".join(changed)}.'] if changed else []),
            *([f'Within the spread of {of}: {", ".join(within)}.'] if within else [])]


def _called(row: Mapping[str, Any], plant: str) -> str:
    """Return the name of a parameter of the baseline; the size of an effect with the effect."""
    name = row['parameter']
    size = name if row['effect'] is None else f'{in_words(row["effect"], plant)}: {SIZES[name]}'
    return size + (f' in recording {row["recording"]}' if row['recording'] else '')


def _healthy(row: Mapping[str, Any]) -> str:
    """Return the healthy value of a parameter with its range."""
    low, high = row['healthy_low'], row['healthy_high']
    if low == high:
        return f'from {digits(row["healthy"])}'
    return f'from {between(row["healthy"], low, high)}'


def _error(answer: Mapping[str, Any]) -> str:
    """Return the sentence of the errors before and after, and of the shrink."""
    gap = answer['gap']
    before, refitted, after, noise = (percent(gap[f'{name}_nrmse']) for name in (
        'before', 'refitted', 'after', 'noise_floor'))
    signal = gap['signal'].replace('_', ' ')
    if answer['verdict'] == NO_GAP:
        return (f'The error of the {signal} is {before} of the signal (rms), and {refitted} with '
                f'the parameters refitted within their tolerance; the noise alone is {noise}.')
    changes = (f'stays at {before}' if before == after else
               f'falls from {before} to {after}' if gap['after_nrmse'] < gap['before_nrmse'] else
               f'rises from {before} to {after}')
    return (f'On the validation samples the error of the {signal} {changes} of the signal (rms); '
            f'the noise alone is {noise}. The gap '
            f'{"shrinks by" if gap["shrink"] > 0.0 else "does not shrink: its shrink is"} '
            f'{shrink_in_words(gap)}; the '
            '95 % interval is for another recording '
            + ('of any amplitude and excitation.' if answer['plant'] == 'actuator' else
               'of this kind.'))
