"""Diagnose recordings against a nominal model: `diagnose`, and its JSON document."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError, InputWarning
from asi_analysis.gap.experiment import next_experiment
from asi_analysis.gap.experiment.next_motion import choose_motion
from asi_analysis.gap.inference import localisation, plausibility
from asi_analysis.gap.inference.fit import Fitted
from asi_analysis.gap.inference.hypotheses import Candidate, Weighed, join, weigh_groups
from asi_analysis.gap.inference.probability import Names, ambiguity_set, marginals
from asi_analysis.gap.inference.search import explained_by_simulator
from asi_analysis.gap.inference.shrink import Shrink, shrink_of
from asi_analysis.gap.inference.uncertainty import (
    Likelihood,
    at_limit,
    interval,
    likelihood,
)
from asi_analysis.gap.model.effects import NO_GAP, PARAMETER, UNKNOWN, block_of
from asi_analysis.gap.model.group import TOLERANCE, Group, Values, make_group, simulator_group
from asi_analysis.gap.model.joint import drive_of, joint_groups
from asi_analysis.gap.model.predict import plant_record
from asi_analysis.gap.model.simulator import by_simulator, simulator_record
from asi_analysis.gap.prepare import prepare
from asi_analysis.terminal import Progress, silent
from asi_common.parameter import Value
from asi_common.record import field_name


@dataclass(frozen=True)
class Diagnosis:
    """The result. joined: probability of each set of effects; shrinks: by channel."""

    sources: list[str]
    groups: list[Weighed]
    joined: dict[Names, float]
    verdict: Names                 # () for no gap, ('unknown',) if it holds that
    shrinks: list[Shrink]
    notes: list[str]
    next_experiment: dict[str, object] | None
    chain: dict[str, float] | None

    def best(self, weighed: Weighed) -> Candidate:
        """Return the hypothesis of a group that agrees with the verdict."""
        names = _part(weighed, self.verdict)
        if names in weighed.candidates:
            return weighed.candidates[names]
        known = [n for n in weighed.probability if n in weighed.candidates]
        return weighed.candidates[max(known, key=lambda n: weighed.probability[n])]


def _part(weighed: Weighed, names: Names) -> Names:
    """Return the part of a joint hypothesis that is a hypothesis of a group."""
    fits = [part for part in weighed.probability if set(part) <= set(names)]
    return max(fits, key=lambda part: (len(part), weighed.probability[part]))


def actuator_groups(runs: Sequence[Run], nominal: Mapping[str, Value], tolerance: float,
                    held_out: Sequence[bool]) -> tuple[list[Group], list[str]]:
    """Return the groups of channels that these recordings of the actuator have, and notes."""
    for run in runs:
        plausibility.check_units(run)
    recordings = prepare(runs, 'valve', held_out)
    p = plant_record(nominal)
    notes, groups = [], []
    has = {name: all(getattr(r, name) is not None for r in recordings)
           for name in ('command', 'force', 'valve_position', 'motion')}
    for run, recording in zip(runs, recordings, strict=True):
        plausibility.check_excitation(recording)
        notes += plausibility.check_motion(run)
        notes += plausibility.check_origin(recording)
    if has['command'] and has['valve_position']:
        groups.append(make_group(p, recordings, ('valve',), tolerance))
    else:
        notes.append('without command and valve position the valve cannot be told from the '
                     'hydraulics by its own signal')
    moves = has['motion'] and has['force'] and nominal.get('load.type') != 'prescribed'
    channels = tuple(name for name, there in (
        ('force', has['force'] and (has['valve_position'] or has['command'])),
        ('load', moves))
        if there)
    if not has['force']:
        notes.append('without the force nothing is said of hydraulics, mechanics and sensor')
    elif not moves:
        notes.append('without the motion of the piston, backlash, compliance, a disturbance and '
                     'the gain of the force sensor cannot be told apart from other causes; it is '
                     'simulated with the nominal load')
    if channels:
        groups.append(make_group(p, recordings, channels, tolerance))
    if not groups:
        raise InputError(f'{runs[0].source}: no block has both its input and its output recorded')
    return groups, notes


def simulated_groups(groups: Sequence[Group], nominal: Mapping[str, Value], tolerance: float
                     ) -> list[Group]:
    """Return the same channels as the simulator predicts them; the load's is the motion."""
    p = simulator_record(nominal)
    return [simulator_group(p, group.recordings, tuple(
        'motion' if channel == 'load' else channel for channel in group.channels), tolerance)
        for group in groups]


def diagnose(runs: Sequence[Run], model: Mapping[str, Value], plant: str = 'actuator',
             tolerance: float = TOLERANCE, held_out: Sequence[bool] | None = None,
             drive: str | None = None, report: Progress = silent) -> Diagnosis:
    """
    Return where recordings differ from their nominal model, why, and by how much a fit helps.

    runs: one or more; model: the nominal parameters; plant: 'actuator' or 'joint'; tolerance of
    the nominal parameters, as a share; held_out: which runs are used for validation only;
    drive: of a joint, 'force' or 'position'; None: found from the signals.
    Raises InputError for recordings that cannot be diagnosed; `notes` holds the warnings.
    """
    out = list(held_out) if held_out is not None else [False] * len(runs)
    notes: list[str] = []
    if plant == 'joint':
        groups, notes = joint_groups(runs, model, tolerance, out, drive or drive_of(runs))
    else:
        groups, notes = actuator_groups(runs, model, tolerance, out)
    notes = [note for run in runs for note in plausibility.check_signals(run)] + notes
    steps, done = 4 * sum(len(group.effects) for group in groups), 0

    def tick() -> None:
        nonlocal done
        done += 1
        report('fitting effects', min(done / steps, 1.0))

    for note in notes:   # before the checks, since they may explain why one fails
        warnings.warn(note, InputWarning, stacklevel=2)
    weighed = None
    if plant == 'actuator' and by_simulator(model) and len(groups) == 2:
        weighed = explained_by_simulator(simulated_groups(groups, model, tolerance), tick)
    if weighed is None:
        for group in groups:
            if plant == 'actuator':
                for note in plausibility.check_against_model(group):
                    warnings.warn(note, InputWarning, stacklevel=2)
                    notes.append(note)
            else:
                plausibility.check_joint(group)
        weighed = weigh_groups(groups, tolerance, tick)
    joined = join(weighed)
    verdict = max(joined, key=lambda names: joined[names])
    answer = Diagnosis([run.source for run in runs], weighed, joined, verdict, [], notes, None,
                       None)
    shrinks = [shrink_of(w.group, channel, w.candidates[()].fitted.record,
                         answer.best(w).fitted.record)
               for w in weighed for channel in w.group.channels]
    ambiguous = ambiguity_set(joined)
    if plant == 'actuator' and any('disturbance_force' in names for names in ambiguous):
        notes += plausibility.doubtful_origin(groups[-1].recordings, model)
    experiment, chain = None, None
    if plant == 'actuator' and len(ambiguous) > 1:
        force = groups[-1].scale['force'] if groups[-1].scale['force'] != 1.0 else 300.0
        experiment = next_experiment.choose(weighed, ambiguous, model, max(round(force, -1), 10.0),
                                            _missing(runs, ('position', 'valve_position')))
    elif len(ambiguous) > 1:
        experiment = choose_motion(weighed, ambiguous, _missing(runs, ('position', 'force')))
    if [w.group.channels for w in weighed] == [('valve',), ('force', 'load')]:
        # With refitted parameters: a difference within their tolerance is no gap.
        chain = localisation.along_the_chain(groups[0], groups[1], *(
            w.candidates[()].fitted.record for w in weighed))
    return Diagnosis(answer.sources, weighed, joined, verdict, shrinks, notes, experiment, chain)


def _missing(runs: Sequence[Run], wanted: Sequence[str]) -> list[str]:
    """Return the wanted signals that some run does not hold."""
    return [name for name in wanted if any(name not in run.signals() for run in runs)]


def hypothesis_name(names: Names) -> str:
    """Return the name of a hypothesis: effects joined by +, `unknown`, or `no_gap`."""
    return '+'.join(names) if names else NO_GAP


def main_shrink(diagnosis: Diagnosis) -> Shrink:
    """Return the shrink of the channel in which the verdict explains most."""
    def explained(shrink: Shrink) -> float:
        return shrink.refitted ** 2 - shrink.after ** 2

    shown = list(diagnosis.shrinks)
    if not diagnosis.verdict or UNKNOWN in diagnosis.verdict:
        return max(shown, key=lambda shrink: shrink.refitted / max(shrink.noise_floor, 1e-9))
    named = {channel for weighed in diagnosis.groups if diagnosis.best(weighed).names
             for channel in weighed.group.channels}
    return max([shrink for shrink in shown if shrink.channel in named] or shown, key=explained)


def _holding(diagnosis: Diagnosis, name: str) -> tuple[Fitted, set[str]] | None:
    """Return the fit of the best hypothesis that holds an effect, and the effect's fields."""
    # An effect of several groups of channels is told by the one that is surest of it.
    for weighed in sorted(diagnosis.groups, reverse=True,
                          key=lambda w: marginals(w.probability).get(name, 0.0)):
        holding = [candidate for names, candidate in weighed.candidates.items() if name in names]
        if holding:
            own = diagnosis.best(weighed)
            chosen = own if name in own.names else max(
                holding, key=lambda c: weighed.probability.get(c.names, 0.0))
            effect = next(e for e in weighed.group.effects if e.name == name)
            return chosen.fitted, {free.field for variant in effect.variants
                                   if variant in chosen.variants for free in variant.free}
    return None


def _sizes(diagnosis: Diagnosis, names: Sequence[str]) -> dict[str, dict[str, Values]]:
    """Return the fitted parameters of effects, and the ends of their intervals, by effect."""
    known: dict[int, Likelihood] = {}   # shared by all effects of a hypothesis
    sizes = {}
    for name in names:
        fitted, fields = _holding(diagnosis, name) or (None, set())
        if fitted is not None and id(fitted) not in known:
            known[id(fitted)] = likelihood(fitted)
        shown = [] if fitted is None else [
            (field, value, *interval(fitted, known[id(fitted)], field))
            for field, value in fitted.values.items() if field in fields]
        sizes[name] = {'parameters': {field: value for field, value, _, _ in shown},
                       'parameters_low': {field: low for field, _, low, _ in shown},
                       'parameters_high': {field: high for field, _, _, high in shown}}
    return sizes


def _at_limit(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Return the nominal parameters at a limit of their tolerance in the fit of the verdict."""
    dotted = {field_name(parameter.name): parameter.name for parameter in ACTUATOR_PARAMETERS}
    return [{'parameter': dotted[field], 'channel': weighed.group.channels[-1],
             'value': float(fitted.record[field]), 'nominal': float(weighed.group.nominal[field]),
             'limit': limit}
            for weighed in diagnosis.groups for fitted in [diagnosis.best(weighed).fitted]
            for field, limit in at_limit(fitted).items()]


def document(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the answer as `asi gap --json` prints it; plain data."""
    chance = marginals(diagnosis.joined)
    # The effects of the verdict first, by their probability as single effects.
    alone = {name: max(w.probability.get((name,), 0.0) for w in diagnosis.groups)
             for name in chance}
    listed = [name for name in sorted(chance.keys() - {NO_GAP, UNKNOWN}, key=lambda n: (
        n not in diagnosis.verdict, -alone[n] if n in diagnosis.verdict else -chance[n], n))
        if chance[name] > 0.001]
    sizes = _sizes(diagnosis, listed)
    which = [{'effect': name, 'block': block_of(name), 'probability': chance[name], **sizes[name]}
             for name in listed]
    ambiguous = ambiguity_set(diagnosis.joined)
    main = main_shrink(diagnosis)
    weighed = next(w for w in diagnosis.groups if main.channel in w.group.channels)
    best = diagnosis.best(weighed).fitted.record
    regimes = localisation.by_regime(weighed.group, main.channel,
                                     weighed.candidates[()].fitted.record, best)
    unexplained = None
    if UNKNOWN in diagnosis.verdict or UNKNOWN in {name for names in ambiguous for name in names}:
        unexplained = localisation.in_words(
            regimes, localisation.dependence(weighed.group, main.channel, best))
    return {
        'verdict': hypothesis_name(diagnosis.verdict),
        'probability': diagnosis.joined[diagnosis.verdict],
        'where': [{'block': block, 'share': share}
                  for block, share in localisation.by_block(diagnosis.groups).items()],
        'which': which,
        'no_gap_probability': chance[NO_GAP], 'unknown_probability': chance[UNKNOWN],
        'ambiguity_set': [hypothesis_name(names) for names in ambiguous],
        'gap': {'before_nrmse': main.nominal, 'refitted_nrmse': main.refitted,
                'after_nrmse': main.after, 'noise_floor_nrmse': main.noise_floor,
                'shrink': main.shrink, 'shrink_low': main.low, 'shrink_high': main.high,
                'channel': main.channel},
        'channels': [{'channel': s.channel, 'before_nrmse': s.nominal,
                      'refitted_nrmse': s.refitted, 'after_nrmse': s.after,
                      'noise_floor_nrmse': s.noise_floor, 'shrink': s.shrink,
                      'shrink_low': s.low, 'shrink_high': s.high}
                     for s in diagnosis.shrinks],
        'chain': diagnosis.chain,
        'regimes': [regime._asdict() for regime in regimes],
        'unexplained': unexplained,
        'consequences': [],
        'next_experiment': diagnosis.next_experiment, 'at_limit': _at_limit(diagnosis),
        'notes': diagnosis.notes, 'sources': diagnosis.sources,
        'nuisance': {weighed.group.channels[-1]: {
            free.field: float(diagnosis.best(weighed).fitted.record[free.field])
            for free in weighed.group.nuisance} for weighed in diagnosis.groups},
    }


def _in_words(name: str, answer: Mapping[str, Any]) -> str:
    """Return the name of an effect; of a parameter beyond its tolerance its value too."""
    if not name.startswith(PARAMETER):
        return name
    found = next(row for row in answer['which'] if row['effect'] == name)
    (field, value), = found['parameters'].items()
    return (f'{name.removeprefix(PARAMETER)} is {value:.3g} ({found["parameters_low"][field]:.3g} '
            f'to {found["parameters_high"][field]:.3g}), beyond its tolerance')


def sentences(answer: Mapping[str, Any]) -> list[str]:
    """Return the verdict in three sentences, from the document."""
    verdict, gap = answer['verdict'], answer['gap']
    sure = f'{100 * answer["probability"]:.0f} %'
    if verdict == NO_GAP:
        first = f'No gap beyond noise and the tolerance of the model ({sure}).'
    elif UNKNOWN in verdict.split('+'):
        first = (f'There is a gap in the {answer["where"][0]["block"]} that no effect of the '
                 f'vocabulary explains ({sure}).')
    else:
        names = verdict.split('+')
        blocks = dict.fromkeys(str(block_of(name)) for name in names)
        first = (f'The gap lies in the {" and the ".join(blocks)}: '
                 f'{" and ".join(_in_words(name, answer) for name in names)} ({sure}).')
    second = (f'On samples used for nothing else the error of the {gap["channel"]} falls from '
              f'{100 * gap["before_nrmse"]:.1f} % to {100 * gap["after_nrmse"]:.1f} % of the '
              f'signal (shrink {gap["shrink"]:.2f}, 95 % interval {gap["shrink_low"]:.2f} to '
              f'{gap["shrink_high"]:.2f} for another recording of this kind; noise '
              f'{100 * gap["noise_floor_nrmse"]:.1f} %).')
    if verdict == NO_GAP:
        second = (f'The error of the {gap["channel"]} is {100 * gap["before_nrmse"]:.1f} % of the '
                  f'signal, and {100 * gap["refitted_nrmse"]:.1f} % with the parameters refitted '
                  f'within their tolerance; noise alone makes '
                  f'{100 * gap["noise_floor_nrmse"]:.1f} %.')
    rest = [name for name in answer['ambiguity_set'] if name != verdict]
    third = ('Nothing else explains it nearly as well.' if not rest else
             f'It could also be {" or ".join(rest)}.')
    if answer['at_limit']:
        limits = ', '.join(f'{row["parameter"]} ({row["value"]:.3g}, '
                           f'{row["value"] / row["nominal"]:.3g} times nominal)'
                           for row in answer['at_limit'])
        third = (f'At the limit of the tolerance: {limits}. If the real value lies beyond it, '
                 f'the verdict may be wrong. {third}')
    if UNKNOWN in verdict.split('+') and answer['unexplained']:
        third = f'{answer["unexplained"]} {third}'
    if answer['next_experiment']:
        third += f' What next: {answer["next_experiment"]["advice"]}.'
    return [first, second, third]


def plain(value: Any) -> Any:
    """Return a document with numpy numbers as plain ones and without infinities."""
    if isinstance(value, Mapping):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
