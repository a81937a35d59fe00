"""
A measured static characteristic: a gain and an offset, from any input to any output.

The input passes, in this order: delay, steps, hysteresis, dead band, two slopes, curvature, gain
and offset, saturation, lag; drift and disturbance are added. Signals count from the middle of
their range, so nothing depends on their origin; sizes are in units of their half range, so
nothing depends on their units.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np

from asi_analysis.arrays import Array, Mask
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.gap.course import at_rest, cycle, one_rate, passes, turning_points
from asi_analysis.gap.model import static_blocks
from asi_analysis.gap.model.effects import Effects, Free, Variant, freed, in_each
from asi_analysis.gap.model.group import Group
from asi_analysis.gap.model.predict import for_recordings
from asi_analysis.gap.parts import reported, split
from asi_analysis.gap.prepare import Recording
from asi_analysis.gap.sampling import SHARED, noise_of, recorded, uniform
from asi_common.parameter import Value

CHANNEL: Final = 'static'
# Signals that may be the input, and the output, the likeliest first.
INPUTS: Final = ('command', 'reference', 'valve_position', 'position', 'force')
OUTPUTS: Final = ('pressure', 'force', 'velocity', 'position', 'valve_position')
GIVEN: Final = ('gain', 'offset')   # the nominal parameters
MOST_SAMPLES: Final = 6000          # of all recordings; of more, means of neighbours are taken
FEWEST, FEWEST_OF_A_PART = 100, 30   # samples
DEADBAND_END: Final = 0.97    # share of the half range within which a dead band must end
# Of the coarse search for a dead band and for two slopes: samples, half widths and centres.
SEARCHED: Final = 400
WIDTHS: Final = (0.01, 0.03, 0.06, 0.1, 0.15, 0.2, 0.3, 0.45)
CENTRES: Final = tuple(round(0.08 * number, 2) for number in range(-10, 11))
MODEL_ERROR: Final = 0.003          # rms error of any model, as a share of the output's rms
LINE: Final = 0.5     # share of the power above which a spectral line is a disturbance, not noise
# Numbers of parts of a recording; prime, so that no cycle fits.
DIVISIONS: Final = (13, 17, 19, 23, 29, 31, 37, 41, 43)
SHORTEST_PART_S: Final = 0.2
BINS: Final = 6
STRETCHES: Final = 12   # of a recording: the noise is the median over them
AT_REST_SHARE: Final = 0.5   # share of the time at rest above which an input is itself in steps
LEAST_SIGNAL: Final = 2.0    # least rms of the output, as a multiple of its noise
LEAST_EXPLAINED: Final = 0.3   # least share of the output's power that a curve explains
LEAST_NOISE: Final = 1e-6   # as a share of the output's rms
SMALL_NOISE: Final = 5e-4   # noise of an input that needs no smoothing, as a share of its range
LONGEST_MEAN: Final = 0.01   # longest moving average of an input, as a share of its cycle

# Sizes of effects that count from the origin of a signal.
ABSOLUTE: Final = {'deadband_centre': 'input', 'asymmetry_centre': 'input',
                   'limit_above': 'output', 'limit_below': 'output',
                   'servo_upper': 'reference', 'servo_lower': 'reference'}


def _forms(*forms: tuple[Free, ...], bend: float = 0.0) -> tuple[Variant, ...]:
    """Return forms of an effect; bend: see FIELDS."""
    fixed = (('bend', bend),) if bend else ()
    return tuple(Variant(free, (CHANNEL,), fixed) for free in forms)


_LOOP = Free('loop_width', 0.0, 0.8, (0.006, 0.02, 0.06, 0.15), 'command', 'input')
_BEGIN = Free('loop_start', -1.0, 1.0, (0.0,))
_BAND = (Free('command_deadband', 0.0, 0.8, (0.02, 0.06, 0.2, 0.4), 'command', 'input'),
         Free('deadband_centre', -0.9, 0.9, (0.0, 0.3, -0.3), 'command', 'input'))
_CURVE = (Free('curve_square', -0.6, 0.6, (0.05, -0.05)),
          Free('curve_cube', -0.6, 0.6, (0.05, -0.05)))
_ABOVE = Free('limit_above', 0.6, 1.1, (0.97, 0.85), 'valve_position', 'output')
_BELOW = Free('limit_below', -1.1, -0.6, (-0.97, -0.85), 'valve_position', 'output')
_CORNER = Free('corner', 0.0, 0.2, (0.03, 0.1))
_LAG = Free('valve_lag', 0.002, 2.0, (0.01, 0.05, 0.2), 'time', 's')

EFFECTS: Final[Effects] = {
    'transport_delay': _forms((
        Free('command_delay', 0.002, 2.0, (0.01, 0.05, 0.2), 'time', 's'),)),
    'command_quantisation': _forms((   # the input acts in steps
        Free('command_quantum', 0.99, 1.01, (1.0,), 'residual_step', 'input'),
        Free('command_phase', 0.4, 1.6, (1.0, 0.75, 1.25, 0.55), 'residual_step_phase', 'turns'),
        Free('command_edge', 0.0, 0.3, (0.05,)))),
    # The way up and the way down differ, however slow.
    'valve_hysteresis': (
        Variant((_LOOP, _BEGIN), (CHANNEL,), (('loop_share', 1.0), ('loop_spread', 0.0))),
        *_forms((
            _LOOP, _BEGIN, Free('loop_share', 0.03, 1.0, (0.9, 0.3)),
            Free('loop_spread', 0.0, 1.0, (0.7, 0.3)), Free('loop_skew', -0.9, 0.9, (0.0,))))),
    # The output stands still about a value of the input.
    'valve_deadband': _forms(_BAND, (*_BAND, Free('deadband_slope', 0.0, 0.5, (0.1,)))),
    'valve_saturation': _forms((_ABOVE, _BELOW, _CORNER), (_ABOVE, _CORNER), (_BELOW, _CORNER)),
    # One gain that changes, at a point or everywhere: not both.
    'gain_asymmetry': _forms((
        Free('gain_asymmetry', -0.8, 0.8, (0.1, -0.1)),
        Free('asymmetry_centre', -0.8, 0.8, (0.0, 0.3, -0.3), 'command', 'input')), bend=1.0),
    'curvature': _forms(_CURVE, (*_CURVE, Free('curve_fourth', -0.6, 0.6, (0.02,)),
                                 Free('curve_fifth', -0.6, 0.6, (0.02,))), bend=2.0),
    'valve_lag': _forms((_LAG,), (_LAG, Free('valve_lag_split', 0.0, 0.5, (0.2,)))),
    # Something else acts on the output.
    'disturbance_force': _forms(
        (Free('disturbance_wave', 0.0, 1.0, (0.05,), 'valve_position', 'output'),
         Free('disturbance_phase', 0.5, 1.5, (1.0,), 'residual_phase', 'turns'),
         Free('disturbance_frequency', 0.98, 1.02, (1.0,), 'residual_frequency', 'Hz')),
        (Free('disturbance_pulse', -2.0, 2.0, (0.05, -0.05), 'valve_position', 'output'),
         Free('disturbance_start', 0.997, 1.003, (1.0,), 'residual_start', 's'),
         Free('disturbance_end', 0.997, 1.003, (1.0,), 'residual_end', 's'))),
    'sensor_drift': _forms((
        Free('sensor_drift', -3.0, 3.0, (0.02, -0.02), 'drift', 'output/s'),
        Free('sensor_drift_curve', -3.0, 3.0, (0.0,), 'drift_curve', 'output/s2'),
        Free('sensor_drift_bend', -3.0, 3.0, (0.0,), 'drift_bend', 'output/s3'))),
}
# Of several recordings: each has its own zero too.
SHIFT = Free('sensor_offset', -1.0, 1.0, (0.0,), 'valve_position', 'output')
# Where these are given.
GAIN: Final[Effects] = {'sensor_gain': _forms((
    Free('gain', -10.0, 10.0, (1.1, 0.9), 'slope', 'output/input'),))}
OFFSET: Final[Effects] = {'sensor_offset': _forms((
    Free('offset', -5.0, 5.0, (0.02, -0.02), 'valve_position', 'output'),))}


def static_signals(run: Run, wanted_in: str | None = None, wanted_out: str | None = None
                   ) -> tuple[str, str]:
    """
    Return the names of input and output: as wanted, else the likeliest of those recorded.

    Raises InputError if there are not two that move.
    """
    chosen = run.information.get('characteristic', {})
    wanted_in, wanted_out = wanted_in or chosen.get('input'), wanted_out or chosen.get('output')
    moving = [name for name, values in run.signals().items()
              if np.nanmax(values) > np.nanmin(values)]
    for name in (wanted_in, wanted_out):
        if name is not None and name not in moving:
            raise InputError(f'{run.source}: no {name} that moves; there are: '
                             + (', '.join(moving) or 'none'))
    given = wanted_in or next((n for n in INPUTS if n in moving and n != wanted_out), None)
    got = wanted_out or next((n for n in OUTPUTS if n in moving and n != given), None)
    if given is None or got is None or given == got:
        raise InputError(f'{run.source}: a characteristic takes an input and an output that move; '
                         f'there are: {", ".join(moving) or "none"}')
    return given, got


def _noise_between_cycles(given: Array, got: Array, slope: float) -> float:
    """
    Return the noise (rms), of any colour, of an output whose input is periodic; 0: unknown.

    From the difference of neighbouring cycles, which has twice its power. Drift and disturbances
    are not noise: a trend is removed, a pulse does not change the median, and with a single
    strong line the noise is unknown.
    """
    lag = cycle(given)
    if not lag:
        return 0.0
    apart = (got[lag:] - got[:-lag] - slope * (given[lag:] - given[:-lag])) / math.sqrt(2.0)
    time = np.linspace(-1.0, 1.0, apart.size)
    place = (given[lag:] - given.mean()) / np.ptp(given)
    # A smooth change with time or input from cycle to cycle is an effect, not noise.
    known = np.stack([np.ones_like(time), time, place, place * time, place ** 2, place ** 3])
    apart = apart - known.T @ np.linalg.lstsq(known.T, apart, rcond=None)[0]
    spectrum = np.fft.rfft(apart * np.hanning(apart.size))
    top = int(np.argmax(np.abs(spectrum)))
    near = slice(max(top - 2, 0), top + 3)
    if np.sum(np.abs(spectrum[near]) ** 2) > LINE * np.sum(np.abs(spectrum) ** 2) and top > 2:
        return 0.0
    # The lower one of both halves, since the first holds the response to what came before the
    # recording; and the median over short stretches, since a pulse is not noise.
    halves = (float(np.median(np.abs(part - np.median(part)))) / 0.6745
              for part in np.array_split(apart, 2))
    stretches = np.median([np.std(part) for part in np.array_split(apart, STRETCHES)])
    return min(*halves, float(stretches))


def _resolution(got: Array) -> float:
    """Return the quantisation step of a recorded signal; 0: it is not quantised."""
    levels = np.unique(got[np.isfinite(got)])
    return float(np.median(np.diff(levels))) if 1 < levels.size < SHARED * got.size else 0.0


def _explained_by_input(given: Array, got: Array) -> float:
    """Return the share of an output's power explained by curves of the input, up and down."""
    place = (given - given.mean()) / np.ptp(given)
    way = np.sign(np.gradient(given))
    curve = np.stack([place ** power for power in range(5)])
    known = np.concatenate([curve, way * curve]).T
    left = got - known @ np.linalg.lstsq(known, got, rcond=None)[0]
    return 1.0 - float(np.var(left) / np.var(got))


def _smooth(given: Array) -> tuple[Array, float]:
    """
    Return a measured input after a moving average, and its remaining noise (rms).

    The average is as long as SMALL_NOISE needs, and at most LONGEST_MEAN of a cycle.
    """
    # Fourth differences take the steps of a staircase for noise; the median of the first does not.
    noise = min(noise_of(given),
                float(np.median(np.abs(np.diff(given)))) / 0.6745 / math.sqrt(2.0))
    span = float(np.ptp(given))
    if noise < SMALL_NOISE * span or _resolution(given) > 0.0:
        return given, 0.0
    turns = turning_points(given)
    most = LONGEST_MEAN * float(np.median(np.diff(turns))) * 2.0 if len(turns) > 1 else 1.0
    width = int(min((noise / (SMALL_NOISE * span)) ** 2, most))
    if width < 2:
        return given, noise
    width += 1 - width % 2
    half = width // 2
    padded = np.pad(given, half, 'reflect', reflect_type='odd')
    return np.convolve(padded, np.ones(width) / width, 'valid'), noise / math.sqrt(width)


def _decimated(values: Array, every: int) -> Array:
    """Return a signal decimated by a factor: means of `every` neighbours."""
    count = values.size // every
    return values[:count * every].reshape(count, every).mean(axis=1)


def _balanced_parts(given: Array, period: float) -> tuple[Mask, Mask]:
    """Return which samples to fit on and to hold out: both cover the input's range both ways."""
    place = np.clip(((given - given.min()) / np.ptp(given) * BINS).astype(int), 0, BINS - 1)
    place = 2 * place + (np.gradient(given) > 0.0)
    every = np.maximum(np.bincount(place, minlength=2 * BINS), 1)

    def uneven(masks: tuple[Mask, Mask]) -> float:
        shares = [np.bincount(place[mask], minlength=2 * BINS) / every for mask in masks]
        return float(max(np.abs(share - 0.5)[every > 5].max() for share in shares))

    usable = [parts for parts in DIVISIONS if parts * SHORTEST_PART_S < given.size * period]
    return min((split(given.size, period, parts) for parts in usable[-4:] or DIVISIONS[:1]),
               key=uneven)


def _middle(signals: Sequence[Array]) -> float:
    return 0.5 * float(min(each.min() for each in signals) + max(each.max() for each in signals))


def static_recordings(runs: Sequence[Run], held_out: Sequence[bool], given: str, got: str
                      ) -> list[Recording]:
    """
    Return runs ready for the diagnosis: input and output relative to the middle of their ranges.

    `taken` holds these middles: input, output. Raises InputError if a run cannot be diagnosed.
    """
    read: list[tuple[float, Array, Array, Array]] = []
    for run in runs:
        static_signals(run, given, got)
        period, time, signals, _ = uniform(run)
        read.append((period, time, signals[given], signals[got]))
    every = max(math.ceil(sum(each[1].size for each in read) / MOST_SAMPLES), 1)
    middle = {'input': _middle([x for _, _, x, _ in read]),
              'output': _middle([y for _, _, _, y in read])}
    recordings: list[Recording] = []
    whole = any(held_out)
    for run, out, (period, time, x, y) in zip(runs, held_out, read, strict=True):
        if x.size < FEWEST:
            raise InputError(f'{run.source}: {x.size} samples; a characteristic needs {FEWEST}')
        smooth, left = _smooth(x)
        slope = float(np.polyfit((x - x.mean()) / np.ptp(x), y, 1)[0]) / float(np.ptp(x))
        there = recorded(run, 'static', time)
        raw = y
        if every > 1:
            smooth, y = _decimated(smooth, every), _decimated(y, every)
            there = _decimated(there.astype(float), every) > 0.99
            left /= math.sqrt(every)
        # The corners of an input in steps are not noise.
        noise = min(noise_of(y), noise_of(y - slope * smooth))
        if float(np.std(y)) < LEAST_SIGNAL * noise:
            raise InputError(f'{run.source}: {got} hardly moves: {np.std(y):.3g} with noise of '
                             f'{noise:.3g} (rms)')
        noise = max(_noise_between_cycles(smooth, y, slope) or math.hypot(noise, slope * left),
                    _resolution(raw) / math.sqrt(12.0 * every), LEAST_NOISE * float(np.std(y)))
        if (explained := _explained_by_input(smooth, y)) < LEAST_EXPLAINED:
            raise InputError(f'{run.source}: {got} does not follow from {given}: a curve of it '
                             f'explains {100.0 * explained:.2g} %')
        fit, held = (mask & there for mask in _balanced_parts(smooth, period * every))
        report = np.zeros_like(fit) if whole else reported(held)
        held = held & ~report
        if whole and out:
            fit, held, report = np.zeros_like(fit), np.zeros_like(fit), fit | held
        recordings.append(Recording(
            source=run.source, period_s=period * every, command=smooth - middle['input'],
            force=None, valve_position=y - middle['output'], velocity=None, motion=None,
            force_judged=None, noise={'valve_position': noise}, fit=fit, held_out=held,
            report=report, taken=middle,
            number=sum(bool(r.fit.any()) for r in recordings) if fit.any() else 0))
    few = min(sum(int(getattr(r, part).sum()) for r in recordings)
              for part in ('fit', 'held_out', 'report'))
    if few < FEWEST_OF_A_PART:
        raise InputError(f'{", ".join(r.source for r in recordings)}: too few samples: {few} to '
                         'fit, choose or judge on; the others are lost, at the ends, or next to '
                         'such ones')
    return recordings


def static_group(runs: Sequence[Run], known: Mapping[str, Value], tolerance: float,
                 held_out: Sequence[bool], healthy: Sequence[Run] = ()
                 ) -> tuple[Group, list[str]]:
    """
    Return the group of a static characteristic, ready to be fitted, and notes.

    known: `gain` (output over input) and `offset` (output at no input), if they are given.
    Raises InputError for what cannot be judged.
    """
    if healthy:
        raise InputError('--baseline takes --plant actuator or joint')
    recordings = static_recordings(runs, held_out, *static_signals(runs[0]))
    x = np.concatenate([r.input for r in recordings])
    y = np.concatenate([r.output for r in recordings])
    scale = scales(recordings)
    slope, shift = float(np.polyfit(x, y, 1)[0]), 0.0
    middle = recordings[0].taken
    p = np.zeros(1, static_blocks.DTYPE)[0]
    p['reach'], p['size'] = scale['command'], scale['valve_position']
    p['gain'] = float(known.get('gain', slope))
    if 'offset' in known:
        p['base'] = float(known['offset']) + p['gain'] * middle['input'] - middle['output']
    else:
        p['offset'] = float(np.mean(y - p['gain'] * x))
        shift = float(p['offset'])
    count = 1 + max(r.number for r in recordings)
    p = for_recordings(p, count)
    nuisance = [Free('offset', -5.0, 5.0, (shift / scale['valve_position'],), 'valve_position')
                ] if 'offset' not in known else []
    effects = _with_initial_guesses(recordings)
    if 'gain' not in known:
        nuisance.append(Free('gain', -10.0, 10.0, (slope / scale['slope'],), 'slope'))
    else:
        nuisance.append(Free('gain', 1.0 - tolerance, 1.0 + tolerance, (1.0,), 'nominal'))
        effects |= GAIN
    if 'offset' in known:
        effects |= OFFSET
    if all(at_rest(r) > AT_REST_SHARE for r in recordings):
        del effects['command_quantisation']
    if count > 1:
        effects |= freed({'sensor_drift': effects['sensor_drift']}, lambda free: (*free, SHIFT))
    noise = max(r.noise['valve_position'] for r in recordings)
    size = float(np.std(y))
    floor = noise ** 2 + (MODEL_ERROR * size) ** 2
    return Group(p, recordings, (CHANNEL,), tuple(nuisance), scale, {CHANNEL: noise},
                 {CHANNEL: floor}, {CHANNEL: 0.0}, freed(effects, partial(in_each, count=count)),
                 floor_measured=any(cycle(r.input) for r in recordings),
                 passes=max(sum(len(passes(r)) for r in recordings), 1)
                 ), notes_of(runs, recordings)


def _with_initial_guesses(recordings: Sequence[Recording]) -> Effects:
    """Return the effects, with initial guesses of dead band and two slopes by a coarse search."""
    x = np.concatenate([r.input[r.known] for r in recordings])
    y = np.concatenate([r.output[r.known] for r in recordings])
    every = max(x.size // SEARCHED, 1)
    x, y = x[::every], y[::every]
    reach = float(np.abs(x).max())

    def left(bent: Array) -> float:
        known = np.stack([np.ones_like(x), bent] if bent.ndim == 1 else [np.ones_like(x), *bent])
        return float(np.linalg.norm(y - known.T @ np.linalg.lstsq(known.T, y, rcond=None)[0]))

    half, middle = min(
        ((half, middle) for half in WIDTHS for middle in CENTRES),
        key=lambda at: left(np.sign(x - at[1] * reach) * np.maximum(
            np.abs(x - at[1] * reach) - at[0] * reach, 0.0)))
    knee = min(CENTRES, key=lambda at: left(np.stack([x, np.abs(x - at * reach)])))
    begins = {'command_deadband': half, 'deadband_centre': middle, 'asymmetry_centre': knee}
    return freed(EFFECTS, lambda frees: tuple(
        free._replace(starts=(begins[free.field], *free.starts)) if free.field in begins else free
        for free in frees))


def scales(recordings: Sequence[Recording]) -> dict[str, float]:
    """Return the units of the bounds of effects: half ranges, and half of a median pass (s)."""
    def half(name: str) -> float:
        return max(0.5 * float(np.ptp(np.concatenate([getattr(r, name) for r in recordings]))),
                   1e-300)

    reach, size = half('command'), half('valve_position')
    lengths = [(end - start) * r.period_s for r in recordings for start, end in passes(r)]
    duration = max(r.fit.size * r.period_s for r in recordings)
    return {'': 1.0, 'command': reach, 'valve_position': size, 'slope': size / reach,
            'time': 0.5 * (float(np.median(lengths)) if lengths else duration),
            'drift': size / duration, 'drift_curve': size / duration ** 2,
            'drift_bend': size / duration ** 3}


def like(group: Group, run: Run) -> Recording:
    """Return another recording of the same device, ready, with the origins of a group."""
    found = static_recordings([run], [False], *static_signals(run))[0]
    here, there = found.taken, group.recordings[0].taken
    return replace(found, taken=there, command=found.input + here['input'] - there['input'],
                   valve_position=found.output + here['output'] - there['output'])


def zero_of(group: Group, field: str) -> float:
    """Return the origin from which an effect's parameter counts; 0 unless it is a position."""
    signal = ABSOLUTE.get(field.partition('@')[0])
    return float(group.recordings[0].taken[signal]) if signal else 0.0


def at_the_end(group: Group, p: np.void) -> bool:
    """Return whether a dead band reaches the end of the range: then it is a saturation."""
    edge = abs(float(p['deadband_centre'])) + float(p['command_deadband'])
    return bool(p['command_deadband'] > 0.0) and edge > DEADBAND_END * group.scale['command']


def as_limit(p: np.void) -> tuple[np.void, str]:
    """Return a record with a saturation in place of a dead band at an end, and its field."""
    p, sign = p.copy(), math.copysign(1.0, float(p['deadband_centre']))
    edge = float(p['deadband_centre'] - sign * p['command_deadband'])
    level = float(p['base'] + p['offset'])   # of the output within the dead band
    field = 'limit_above' if sign * float(p['gain']) > 0.0 else 'limit_below'
    p[field], p['command_deadband'], p['deadband_centre'] = level, 0.0, 0.0
    p['offset'] -= p['gain'] * edge
    return p, field


def notes_of(runs: Sequence[Run], recordings: Sequence[Recording]) -> list[str]:
    """Return notes of what recordings of a characteristic cannot determine."""
    notes = [f'{run.source}: {got} is quantised in steps of {step:.3g} {run.unit(got)}, which '
             'count as noise' for run in runs for got in [static_signals(run)[1]]
             if (step := _resolution(run.signal(got)))]
    if one_rate(recordings):
        notes.append('the input moves at one rate only: lag and delay cannot be distinguished '
                     'reliably from hysteresis; the same input at another rate separates them')
    if max(len(passes(r)) for r in recordings) < 2:
        notes.append('the input never comes back: hysteresis does not show, and a drift looks '
                     'like another gain; go up and down at least twice')
    elif not any(cycle(r.input) for r in recordings):
        notes.append('the input does not repeat: noise that is not white cannot be distinguished '
                     'from an unknown effect; repeat the same cycle')
    return notes
