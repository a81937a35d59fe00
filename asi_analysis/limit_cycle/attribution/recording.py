"""`asi attribute BAG`: the cause of a recorded oscillation, by its shape and by its model."""

import json
from contextlib import suppress
from typing import Any, Final

import numpy as np

from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.experiments.experiment import CONTROLLER_PARAMETERS
from asi_analysis.limit_cycle.attribution.ablation import attribute_model
from asi_analysis.limit_cycle.attribution.answer import Attribution
from asi_analysis.limit_cycle.attribution.classifier import (
    LEAST_PROBABILITY,
    VALVE_FAULTS,
    WEIGHTS,
    probabilities,
)
from asi_analysis.limit_cycle.attribution.shape import FEWEST_CYCLES, MOST_CYCLES, Shape, shape
from asi_analysis.limit_cycle.detection.agreement import judge_run
from asi_analysis.limit_cycle.detection.feedback import RELAY, levels_of
from asi_analysis.limit_cycle.detection.verdict import AT_REST, Segment, response_of
from asi_analysis.measures.quality import Trust, findings, quality_of, trust
from asi_analysis.terminal import Progress, silent
from asi_common.parameter import completed

# Keys of a cause that only one of the two methods fills; null by the other.
EMPTY: Final[dict[str, Any]] = dict.fromkeys(
    [f'{prefix}_{name}' for prefix in ('alone', 'all_but') for name in (
        'frequency_hz', 'amplitude_n', 'predicted_frequency_hz', 'predicted_amplitude_n',
        'onset_gain')] + ['unexplained', 'frequency_error', 'amplitude_error'])
# Error of a predicted cycle: standard deviation of the logarithm of frequency, amplitude.
SPREAD: Final = (0.03, 0.15)
# Cycles that a record must have beyond FEWEST_CYCLES: with fewer it may be a slow drift.
EXTRA_CYCLES: Final = 0.25
# Overlapping parts of the oscillation that are classified beside the whole, and their length: a
# share of it, of at most MOST_CYCLES.
PARTS: Final = 5
PART: Final = 0.8
# Least share of a record that is analysed alone.
LEAST_PART: Final = 0.5
# Prior odds of the causes in oscillating loops: surveys attribute a third of them to the valve,
# nearly always friction, a third to tuning, the rest to disturbances
# (Bialkowski, Pulp & Paper Canada 94, 1993; Desborough and Miller, CPC VI, 2001).
PRIOR: Final = {'stiction': 2.0, 'backlash': 1.0, 'hysteresis': 0.5, 'saturation': 0.7,
                'tight_tuning': 2.0, 'disturbance': 2.0}
SEPARATE: Final = {
    frozenset({'tight_tuning', 'disturbance'}): 'open the loop (controller in manual): the '
        'oscillation continues with a disturbance, and stops with tight tuning',
    frozenset({'stiction', 'disturbance'}): 'open the loop (controller in manual): the '
        'oscillation continues with a disturbance, and stops with stiction',
    frozenset({'stiction', 'backlash'}): 'move the command up and down by small steps in manual: '
        'with backlash only the first step after a reversal has no effect, with stiction the '
        'output jumps',
    frozenset({'stiction', 'tight_tuning'}): 'halve the gain: the oscillation stops with '
        'tight tuning, and continues, more slowly, with stiction',
    frozenset({'backlash', 'tight_tuning'}): 'halve the gain: the oscillation decays with '
        'tight tuning, and continues or stops at once with backlash',
    frozenset({'backlash', 'hysteresis'}): 'a slow triangle of the command in manual, in two '
        'sizes: the width of a play stays the same, that of hysteresis grows',
}


def _segment_of(run: Run, signal: str | None) -> Segment:
    """
    Return the longest segment in which the signal moves.

    If all segments are short, it covers the whole record: an intermittent oscillation is judged by
    its shape over all of it.
    """
    segments = judge_run(run, signal)
    moving = [s for s in segments if s.why != AT_REST] or segments
    swings = [s for s in moving if s.verdict != 'noise'] or moving
    chosen = max(swings, key=lambda s: s.end_s - s.start_s)
    if chosen.end_s - chosen.start_s < LEAST_PART * run.duration_s:
        return chosen._replace(start_s=segments[0].start_s, end_s=segments[-1].end_s)
    return chosen


def shape_of(run: Run, document: dict[str, Any], signal: str | None = None) -> Shape:
    """Return the shape of the oscillation in the segment of an `attribute_cycle` document."""
    part = _part_of(run, document)
    name, _ = response_of(part, signal)
    if part.command_n is None or name == 'command':
        raise InputError(f'{run.source or "the run"}: to judge the shape of an oscillation takes '
                         'command and output of the loop')
    try:
        return _shape(part, name)
    except InputError as error:
        raise InputError(f'{run.source or "the run"}: {error}') from None


def _part_of(run: Run, document: dict[str, Any]) -> Run:
    return run.between(document['start_s'], document['end_s'] + 0.5 * run.period_s)


def _shape(part: Run, name: str) -> Shape:
    assert part.command_n is not None
    found = shape(part.time_s, part.command_n, part.signal(name))
    if found.cycles < FEWEST_CYCLES + EXTRA_CYCLES:
        raise InputError('a slow drift, no oscillation: no peak of the spectrum has '
                         f'{FEWEST_CYCLES:g} cycles or more')
    return found


def agreed_probabilities(part: Run, name: str, whole: Shape) -> dict[str, float]:
    """
    Return the probability of each cause, by shape; the most probable first.

    It is the mean over the whole oscillation, overlapping parts of it, and every second sample of
    it: one pass depends on where the record happens to begin and end.
    """
    passes = [shape_probabilities(whole)]
    cycles = whole.frequency_hz * part.duration_s
    length = int(len(part) * min(PART, MOST_CYCLES / cycles))
    for other in [*(part[start:start + length] for start in np.linspace(
            0, len(part) - length, PARTS).astype(int)), part[::2]]:
        with suppress(InputError):   # too few cycles
            passes.append(shape_probabilities(_shape(other, name)))
    mean = {cause: sum(each[cause] for each in passes) / len(passes) for cause in PRIOR}
    return dict(sorted(mean.items(), key=lambda item: -item[1]))


def shape_probabilities(found: Shape) -> dict[str, float]:
    """Return the probability of each cause, by one shape."""
    trained = json.loads(WEIGHTS.read_text())
    chances = dict(zip(trained['causes'], probabilities(found.features, trained)[0], strict=True))
    weighted = {name: float(chance) * PRIOR[name] for name, chance in chances.items()}
    total = sum(weighted.values())
    return {name: chance / total for name, chance in weighted.items()}


def attribute_cycle(run: Run, signal: str | None = None, progress: Progress = silent
                    ) -> Attribution:
    """
    Return the probable causes of an oscillation in a recording.

    run: with command and output of any loop, classified by the shape of the oscillation. If the
    recording holds parameters of this package's actuator, its cycle is compared with the cycles of
    the model with each nonlinearity alone. signal: name of the output; by default the force, or
    the first other that was recorded. Raises InputError without command and output, or if the
    motion is forced by the reference.

    >>> import asi_analysis as asi
    >>> level, valve, integral, rows = 0.5, 0.0, 0.0, []
    >>> for k in range(3000):               # a PI loop whose valve sticks
    ...     integral -= 0.02 * level
    ...     command = integral - level
    ...     valve = command if abs(command - valve) > 0.2 else valve
    ...     rows.append((0.05 * k, command, level))
    ...     level += 0.02 * (valve - level)
    >>> time_s, command_n, force_n = np.array(rows).T
    >>> run = asi.Run(time_s, command_n=command_n, force_n=force_n)
    >>> asi.attribute_cycle(run).causes[0]['nonlinearity']
    'stiction'
    """
    progress('detection', 0.0)
    segment = _segment_of(run, signal)
    configuration = run.information
    modelled = 'actuator' in configuration and 'controller' in configuration and (
        segment.verdict in ('limit_cycle', 'unsteady', 'growing'))
    if segment.verdict == 'forced' or modelled and not np.isfinite(segment.frequency_hz):
        raise InputError(f'{run.source or "the run"}: no oscillation of its own to attribute: '
                         f'{segment.why}')
    document: dict[str, Any] = {
        'source': run.source, 'start_s': segment.start_s, 'end_s': segment.end_s,
        'oscillation': segment.verdict, 'frequency_hz': None, 'amplitude_n': None,
        'quality': quality_of([run])}
    samples = trust(findings(run), run, (segment.signal, 'command', 'reference'),
                    segment.start_s, segment.end_s)
    document['reliable'] = samples.reliable
    if np.isfinite(segment.frequency_hz):
        document |= {'frequency_hz': segment.frequency_hz, 'amplitude_n': segment.amplitude}
    if modelled:
        return _marked(document | _by_model(run, segment, progress), samples, run, signal)
    progress('shape', 0.3)
    found = shape_of(run, document, signal)
    document['frequency_hz'] = found.frequency_hz
    part = _part_of(run, document)
    chances = _weighed(agreed_probabilities(part, response_of(part, signal)[0], found),
                       part, segment)
    causes = [{'nonlinearity': cause, 'necessary': None, 'sufficient': None, 'share': None,
               'probability': chance, 'unexplained': _unexplained(found, cause)}
              for cause, chance in chances.items()]
    return _marked(document | {'causes': [EMPTY | cause for cause in causes],
                               'verdict': _shape_verdict(chances, found, segment)},
                   samples, run, signal)


def _weighed(chances: dict[str, float], part: Run, segment: Segment) -> dict[str, float]:
    """
    Return the probabilities by shape, given what the command and the detection show.

    The training set has no switching controller; its command has two levels. A limit
    cycle that comes from within the loop is no disturbance from outside, and vice versa.
    """
    assert part.command_n is not None
    cycle = segment.confidence if segment.verdict == 'limit_cycle' else 0.5
    if levels_of(part.command_n) == RELAY:
        chances = {name: (1.0 - cycle) * chance for name, chance in chances.items()}
        chances |= {'switching_controller': cycle}
    elif segment.verdict == 'limit_cycle':
        # Where the two disagree, the shape is of a kind that was not trained: any other cause.
        surplus = max(chances['disturbance'] - (1.0 - 0.5 * cycle), 0.0)
        chances = {name: chance - surplus if name == 'disturbance'
                   else chance + surplus / (len(chances) - 1) for name, chance in chances.items()}
    return dict(sorted(chances.items(), key=lambda item: -item[1]))


def _marked(document: dict[str, Any], samples: Trust, run: Run, signal: str | None) -> Attribution:
    """Return the answer; if it rests on doubtful samples, its verdict says so."""
    if not samples.reliable:
        document['verdict'] += f'; doubtful, because {samples.reason}'
    return Attribution(document, run=run, signal=signal)


def _unexplained(found: Shape, cause: str) -> float | None:
    kind = 'linear' if cause in ('tight_tuning', 'disturbance') else cause
    return found.explanations[kind].unexplained if kind in found.explanations else None


def _shape_verdict(chances: dict[str, float], found: Shape, segment: Segment) -> str:
    (first, most), (second, next_) = list(chances.items())[:2]
    what = (f'{found.frequency_hz:.4g} Hz, {found.cycles:.3g} cycles ({segment.verdict}), '
            'by shape')
    if most >= LEAST_PROBABILITY:
        return f'{what}: {_words(first)} ({100 * most:.0f} %)'
    valve = sum(chances[name] for name in VALVE_FAULTS)
    if valve >= LEAST_PROBABILITY:
        kinds = ', '.join(f'{_words(name)} {100 * chance:.0f} %'
                          for name, chance in chances.items() if name in VALVE_FAULTS)
        return f'{what}: the valve ({100 * valve:.0f} %), its fault is ambiguous: {kinds}'
    test = SEPARATE.get(frozenset({first, second}),
                        'a step of the command in manual, and a run at half the gain')
    return (f'{what}: cannot distinguish {_words(first)} ({100 * most:.0f} %) from '
            f'{_words(second)} ({100 * next_:.0f} %); this would distinguish them: {test}')


def _words(cause: str) -> str:
    return {'tight_tuning': 'tight linear tuning', 'disturbance': 'an outside disturbance',
            'switching_controller': 'a switching controller'}.get(cause, cause)


def _by_model(run: Run, segment: Segment, progress: Progress) -> dict[str, Any]:
    """Return the causes of a cycle of this package's actuator, each with its predicted cycle."""
    information = run.information
    controller = completed(information['controller'], CONTROLLER_PARAMETERS)
    rate = float(information.get('experiment', {}).get('rate_hz') or run.rate_hz)
    gain = float(controller.get('gain') or 0.0)
    from asi_controller.compensator import OWN_GAIN
    gain = gain or OWN_GAIN[str(controller.get('compensator', 'proportional'))]
    table = attribute_model(information['actuator'], controller, rate, gain, progress)
    weights = []
    for cause in table['causes']:
        frequency, amplitude = cause['alone_frequency_hz'], cause['alone_amplitude_n']
        if frequency is None:
            cause |= {'frequency_error': None, 'amplitude_error': None}
            weights.append(1e-3)
            continue
        errors = (np.log(frequency / segment.frequency_hz), np.log(amplitude / segment.amplitude))
        cause |= {'frequency_error': float(np.expm1(errors[0])),
                  'amplitude_error': float(np.expm1(errors[1]))}
        # The cycle without the other nonlinearities also differs by their share.
        spread = (SPREAD[0] + 0.05, SPREAD[1] + 0.5)
        weights.append(float(np.exp(-0.5 * sum((e / s) ** 2 for e, s in zip(errors, spread,
                                                                           strict=True)))))
    for cause, weight in zip(table['causes'], weights, strict=True):
        cause['probability'] = weight / max(sum(weights), 1e-12)
    expected = table['frequency_hz']
    fits = expected is not None and abs(np.log(expected / segment.frequency_hz)) < SPREAD[0]
    verdict = table['verdict'] if fits else (
        'the model of the bag does not predict the measured cycle '
        f'({segment.frequency_hz:.4g} Hz, {segment.amplitude:.4g} {segment.unit}) but '
        + (f'{expected:.4g} Hz, {table["amplitude_n"]:.4g} N' if expected else 'none')
        + ': find the gap first (asi gap)')
    return {'causes': [EMPTY | cause for cause in table['causes']], 'verdict': verdict}
