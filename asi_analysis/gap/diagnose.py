"""Diagnose recordings against a nominal model: `diagnose`, and its JSON document."""

import itertools
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np

from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError, InputWarning
from asi_analysis.gap.actuator import actuator_groups, simulated_groups
from asi_analysis.gap.baseline import (
    Healthy,
    against,
    changed_only,
    doubted,
    healthy_of,
    shares,
)
from asi_analysis.gap.experiment import next_experiment
from asi_analysis.gap.experiment.next_course import choose_course
from asi_analysis.gap.experiment.next_motion import choose_motion
from asi_analysis.gap.findings import localisation
from asi_analysis.gap.findings.edges import PLACED, placed
from asi_analysis.gap.findings.no_effect import SENSOR_GAIN as GAIN
from asi_analysis.gap.findings.no_effect import place_of_gap, with_gap_centre, with_tolerated_gain
from asi_analysis.gap.findings.one_rate import at_one_rate
from asi_analysis.gap.findings.shrink import Shrink, shrink_of
from asi_analysis.gap.inference import plausibility
from asi_analysis.gap.inference.beyond_tolerance import LEAST_PROBABILITY
from asi_analysis.gap.inference.coloured_noise import NOT_WHITE, not_white
from asi_analysis.gap.inference.hypotheses import Candidate, Weighed, join, weigh_groups
from asi_analysis.gap.inference.other_extent import with_hidden_load, with_lower_band
from asi_analysis.gap.inference.probability import (
    Names,
    ambiguity_set,
    marginals,
    with_hidden_effect,
)
from asi_analysis.gap.inference.simulated.own_laws import OwnLaws, by_own_laws
from asi_analysis.gap.inference.simulated.search import explained_by_simulator
from asi_analysis.gap.inference.simulated.uneven_delay import how_uneven
from asi_analysis.gap.model.effects import DOTTED, NO_GAP, PARAMETER, UNKNOWN, block_of
from asi_analysis.gap.model.group import (
    SIMULATOR_ERROR,
    TOLERANCE,
    VALVE_GAIN,
    Group,
    with_tolerances,
)
from asi_analysis.gap.model.joint import OF_ANY_SIZE, WHOLE, Extent, drive_of, joint_groups
from asi_analysis.gap.model.model_file import improved_model
from asi_analysis.gap.model.simulator import (
    VALVE_ERROR,
    has_linear_laws,
    of_simulator,
)
from asi_analysis.gap.model.static import static_group
from asi_analysis.gap.prepare import shared_band
from asi_analysis.gap.sizes import limits_of, sizes_of
from asi_analysis.gap.words import signal_of, unit_of
from asi_analysis.terminal import Progress, silent
from asi_common.parameter import Value
from asi_common.record import field_name

OTHER_LAWS = ("the simulator's own laws leave a gap, and no effect is found that closes it: laws "
              'of another form do, or an effect that they hide')
# Effects that may be a constant force, which only the zero of the position tells apart.
CONSTANT = {'disturbance_force', 'valve_bias', 'sensor_offset'}


@dataclass(frozen=True)
class Diagnosis:
    """
    The result.

    tolerance: of the nominal parameters; tolerances: other ones, by field; joined: probability of
    each set of effects; shrinks: by channel.
    """

    runs: Sequence[Run]
    plant: str
    tolerance: float
    tolerances: Mapping[str, float]
    groups: list[Weighed]
    joined: dict[Names, float]
    verdict: Names                 # () for no gap, ('unknown',) if it holds that
    shrinks: list[Shrink]
    notes: list[str]
    next_experiment: dict[str, object] | None
    chain: dict[str, float] | None
    # With a baseline: the diagnosis of the healthy recordings, and their machine, by channels.
    healthy: 'Diagnosis | None' = None
    machine: Mapping[tuple[str, ...], Healthy] = field(default_factory=dict)
    extent: Extent = WHOLE         # of a joint

    def compared(self, channel: str) -> Weighed:
        """Return the group that holds a channel."""
        return next(each for each in self.groups if channel in each.group.channels)

    def best(self, weighed: Weighed) -> Candidate:
        """Return the hypothesis of a group that agrees with the verdict, but for `unknown`."""
        part = next(part for part, group in zip(_parts(self.groups, self.verdict), self.groups,
                                                strict=True) if group is weighed)
        names = tuple(name for name in part if name != UNKNOWN)
        if names or not part:
            return weighed.candidates[names]
        known = max(weighed.candidates, key=lambda n: weighed.probability.get(n, 0.0))
        # With a gap that is unknown, an improbable effect is no better than none.
        return weighed.candidates[known if weighed.probability[known] > LEAST_PROBABILITY else ()]


def _parts(groups: Sequence[Weighed], names: Names) -> tuple[Names, ...]:
    """Return the hypothesis of each group of which a joint hypothesis most probably consists."""
    fits = [[part for part in weighed.probability if set(part) <= set(names)]
            for weighed in groups]
    return max((parts for parts in itertools.product(*fits)
                if {name for part in parts for name in part} == set(names)),
               key=lambda parts: math.prod(weighed.probability[part] for weighed, part in zip(
                   groups, parts, strict=True)))


def _groups(runs: Sequence[Run], model: Mapping[str, Value], plant: str, tolerance: float,
            held_out: Sequence[bool], drive: str | None, healthy: Diagnosis | None,
            extent: Extent) -> tuple[list[Group], list[Group], list[str]]:
    """Return the groups of channels, the same with the simulator as predictor, and notes."""
    simulated: list[Group] = []
    before = healthy.runs if healthy else []
    if plant == 'joint':
        groups, notes = _joint(runs, model, tolerance, held_out, drive, healthy, extent)
    elif plant == 'static':
        group, notes = static_group(runs, model, tolerance, held_out, before)
        groups = [group]
    else:
        groups, notes = actuator_groups(runs, model, tolerance, held_out)
        simulated = simulated_groups(groups, improved_of(healthy, model) if healthy else model,
                                     tolerance)
    return groups, simulated, [
        note for run in runs for note in plausibility.check_signals(run)] + notes


def _joint(runs: Sequence[Run], model: Mapping[str, Value], tolerance: float,
           held_out: Sequence[bool], drive: str | None, healthy: Diagnosis | None, extent: Extent
           ) -> tuple[list[Group], list[str]]:
    """Return the groups of channels of a joint, and notes."""
    before = healthy.runs if healthy else []
    known, weight = dict(model), (0.0, 0.0)
    for record in _records(healthy)[-1:] if healthy else ():
        known |= {name: float(record[field_name(name)]) for name in OF_ANY_SIZE}
        weight = float(record['gravity_sine']), float(record['gravity_cosine'])
    return joint_groups(runs, known, tolerance, held_out, drive or drive_of(before or runs),
                        before, weight, extent)


def _in_one_band(runs: Sequence[Run], healthy: Diagnosis | None, drive: str, extent: Extent,
                 again: Callable[..., Diagnosis]) -> tuple[Extent, Diagnosis | None]:
    """
    Return the extent of a joint with the band that all its recordings have in common.

    And the healthy machine fitted in that band, by `again` if it was another: in a wider one it
    has other parameters, which is no change.
    """
    if drive != 'force':
        return extent, healthy
    before = healthy.runs if healthy else ()
    extent = extent._replace(band_hz=min(extent.band_hz, shared_band([*before, *runs], drive)))
    if healthy and healthy.extent.band_hz > extent.band_hz:
        healthy = again(before, extent=extent._replace(hidden=healthy.extent.hidden))
    # Its load rattles: it was fitted in a lower band.
    return (extent._replace(band_hz=min(extent.band_hz, healthy.extent.band_hz)) if healthy else
            extent), healthy


def _machine_of(healthy: Diagnosis, own: Mapping[str, float]) -> dict[tuple[str, ...], Healthy]:
    """Return the healthy machine by channels; own: tolerances by field."""
    return {w.group.channels: healthy_of(healthy.best(w).fitted, healthy.tolerance, own)
            for w in healthy.groups}


def improved_of(diagnosis: Diagnosis, model: Mapping[str, Value]) -> dict[str, Value]:
    """Return the actuator's parameters of the improved model."""
    return improved_model(model, _records(diagnosis))[0]


def _records(diagnosis: Diagnosis) -> list[np.void]:
    """Return the fitted records of the verdict, one for each group of channels."""
    return [diagnosis.best(weighed).fitted.record for weighed in diagnosis.groups]


def diagnose(runs: Sequence[Run], model: Mapping[str, Value], plant: str = 'actuator',
             tolerance: float = TOLERANCE, held_out: Sequence[bool] | None = None,
             drive: str | None = None, report: Progress = silent,
             tolerances: Mapping[str, float] = MappingProxyType({}),
             healthy: Diagnosis | None = None, simulate: bool = True,
             extent: Extent = WHOLE) -> Diagnosis:
    """
    Return where recordings differ from their nominal model, why, and by how much a fit helps.

    runs: one or more; model: the nominal parameters; plant: 'actuator', 'joint' or 'static';
    tolerance of the nominal parameters, as a share; held_out: which runs are used for validation
    only; drive: of a joint, 'force' or 'position'; None: found from the signals; tolerances: of
    single parameters, by dotted name. healthy: the diagnosis of other recordings: what has changed
    since them is found. simulate: the simulator itself is tried first as the predictor. extent: of
    a joint; the band is at most that which all recordings, healthy ones too, have in common.
    Raises InputError for recordings that cannot be diagnosed; `notes` holds the warnings.
    """
    out = list(held_out) if held_out is not None else [False] * len(runs)
    again = partial(diagnose, model=model, plant=plant, tolerance=tolerance, report=report,
                    tolerances=tolerances)
    if plant == 'joint':
        drive = drive or drive_of(healthy.runs if healthy else runs)
        again = partial(again, drive=drive)
        extent, healthy = _in_one_band(runs, healthy, drive, extent, again)
    groups, simulated, notes = _groups(runs, model, plant, tolerance, out, drive, healthy, extent)
    given = {field_name(name): share for name, share in tolerances.items()}
    own = dict(given)
    uncertain = sorted({DOTTED.get(free.field, free.field) for group in (*groups, *simulated)
                        for free in group.nuisance if free.scale == 'nominal'}
                       | ({DOTTED[GAIN]} if plant == 'actuator' else set()))
    for name in tolerances.keys() - set(uncertain):
        raise InputError(f'tolerance {name}: no uncertain parameter of the nominal model; '
                         f'uncertain are: {", ".join(uncertain) or "none"}')
    groups, simulated = ([with_tolerances(group, own) for group in each]
                         for each in (groups, simulated if simulate else []))
    machine: dict[tuple[str, ...], Healthy] = {}
    predicted = {of_simulator(each.group.nominal) for each in healthy.groups} if healthy else set()
    # With a linear model, or where the simulator explained the valve only: block by block.
    if healthy is not None and (has_linear_laws(model) or len(predicted) > 1):
        simulated = []
        if True in predicted:
            healthy = again(healthy.runs, simulate=False)
    if healthy is not None:
        machine = _machine_of(healthy, own)
        simulated = [against(group, machine) for group in simulated] if (
            of_simulator(healthy.groups[0].group.nominal)) else []
        groups = groups if simulated else [against(group, machine) for group in groups]
        own |= shares(machine)
    steps, done = 4 * sum(len(group.effects) for group in groups), 0

    def tick() -> None:
        nonlocal done
        done += 1
        # Their number is estimated: beyond it, nobody knows how many are left.
        report('fitting effects', done / steps if done < steps else None)

    told = healthy.notes if healthy else []
    for note in (each for each in notes if each not in told):   # first: it may explain a refusal
        warnings.warn(note, InputWarning, stacklevel=2)
    answered, laws = list[Weighed | None](), list[OwnLaws]()
    if simulated and model.get('load.type') != 'free':
        for group in groups:
            plausibility.check_against_model(group, alike=True)
    if simulated and has_linear_laws(model):
        # Block by block, what is implausible is refused: as early as that is known.
        laws = by_own_laws(simulated, tick, lambda: plausibility.check_against_model(groups[0]))
        answered = [law.weighed for law in laws]
    elif simulated:
        # The block-wise model needs the measured force, which is small with a free load.
        answered = explained_by_simulator(simulated, tick, model.get('load.type') == 'free')
    if simulated and healthy is not None and None in answered:
        return again(runs, held_out=held_out, healthy=again(healthy.runs, simulate=False),
                     simulate=False)
    weighed = [each for each in answered if each is not None]
    if len(weighed) < len(groups):
        for group, known in itertools.zip_longest(groups, answered):
            if known is not None and model.get('load.type') == 'free':
                continue   # its force is too small for the check
            if plant == 'actuator':
                for note in plausibility.check_against_model(group):
                    warnings.warn(note, InputWarning, stacklevel=2)
                    notes.append(note)
            elif plant == 'joint':
                plausibility.check_joint(group)
        weighed = weigh_groups(groups, tick, answered)
        if plant == 'joint':
            tried: dict[Extent, tuple[Diagnosis | None, dict[tuple[str, ...], Healthy]]] = {}

            def made(to: Extent) -> Sequence[Group]:
                was = healthy and again(healthy.runs, extent=to)
                tried[to] = was, _machine_of(was, given) if was else {}
                others, _ = _joint(runs, model, tolerance, out, drive, was, to if not was else
                                   to._replace(band_hz=min(to.band_hz, was.extent.band_hz)))
                others = [with_tolerances(each, given) for each in others]
                return [against(each, tried[to][1]) for each in others] if was else others

            for other in (with_hidden_load, with_lower_band):
                weighed, more, extent = other(weighed, made, extent, tick)
                notes += more
            healthy, machine = tried.get(extent, (healthy, machine))
            own = given | shares(machine)
        if plant == 'static':
            weighed = [at_one_rate(each) for each in weighed]
    if machine:
        found = [doubted(changed_only(each, was), was, tolerance)
                 for each in weighed for was in [machine[each.group.channels]]]
        weighed = [each for each, _ in found]
        notes += [note for _, more in found for note in more]
    elif plant == 'actuator':
        weighed = [with_tolerated_gain(with_gap_centre(each), own.get(GAIN, tolerance))
                   for each in weighed]
    if laws:
        weighed = [law.agreeing(each) for law, each in zip(laws, weighed, strict=True)]
    joined = join(weighed)
    if simulated and not laws and any(
            each is None or each.group.hides_effects for each in answered):
        joined, before = with_hidden_effect(joined), joined
        notes += [OTHER_LAWS] if joined != before else []
    verdict = max(joined, key=lambda names: joined[names])
    as_fitted, weighed = weighed, [placed(each) for each in weighed]
    if 'disturbance_force' in verdict and any(
            each is not old for each, old in zip(weighed, as_fitted, strict=True)):
        notes.append(PLACED)
    notes += [NOT_WHITE.format(signal_of(channel, runs[0], plant).replace('_', ' '))
              for each in weighed for channel in not_white(each.group)]
    answer = Diagnosis(runs, plant, tolerance, own, weighed, joined, verdict, [], notes, None,
                       None, healthy, machine, extent)
    notes += filter(None, (of(answer.best(each)) for each in weighed
                           for of in (place_of_gap, how_uneven)))
    shrinks = [shrink_of(w.group, channel, w.candidates[()].fitted.record,
                         answer.best(w).fitted.record, elsewhere=plant == 'actuator')
               for w in weighed for channel in w.group.channels]
    ambiguous = ambiguity_set(joined)
    if plant == 'actuator' and any(CONSTANT & {*names} for names in ambiguous):
        notes += plausibility.doubtful_origin(groups[-1].recordings, model)
    experiment, chain = None, None
    if plant == 'actuator' and len(ambiguous) > 1:
        force = groups[-1].scale['force'] if groups[-1].scale['force'] != 1.0 else 300.0
        experiment = next_experiment.choose(weighed, ambiguous, model, max(round(force, -1), 10.0),
                                            _missing(runs, ('position', 'valve_position')))
    elif plant == 'static':
        experiment = choose_course(weighed, ambiguous)
    elif len(ambiguous) > 1:
        experiment = choose_motion(weighed, ambiguous, _missing(runs, ('position', 'force')),
                                   _unit_of_motion(runs[0], drive))
    if [w.group.channels for w in weighed] == [('valve',), ('force', 'load')] and not (
            of_simulator(weighed[0].group.nominal)):
        # With refitted parameters, since a difference within their tolerance is not a gap.
        chain = localisation.along_the_chain(groups[0].recordings[0], *(
            w.candidates[()].fitted.record for w in weighed))
    return replace(answer, shrinks=shrinks, next_experiment=experiment, chain=chain)


def _unit_of_motion(run: Run, drive: str | None) -> str:
    """Return the unit in which a course of a joint is told: of what moves, or of a reference."""
    if drive == 'position':
        return run.unit('reference')
    if drive == 'drive':
        return run.unit('command')
    return (run.unit('position') if run.position_m is not None else
            run.unit('velocity').removesuffix('/s'))


def _missing(runs: Sequence[Run], wanted: Sequence[str]) -> list[str]:
    """Return the wanted signals that are missing in a run."""
    return [name for name in wanted if any(name not in run.signals() for run in runs)]


def hypothesis_name(names: Names) -> str:
    """Return the name of a hypothesis: effects joined by +, `unknown`, or `no_gap`."""
    return '+'.join(names) if names else NO_GAP


def main_shrink(diagnosis: Diagnosis) -> Shrink:
    """Return the shrink of the channel in which the verdict explains most, in noise floors."""
    shown = list(diagnosis.shrinks)
    # The residual of the refitted model counts, unless it is noise on every channel.
    visible = any(shrink.refitted > max(shrink.noise_floor, SIMULATOR_ERROR) for shrink in shown)

    def explained(shrink: Shrink) -> float:
        before = shrink.refitted if visible else shrink.nominal
        return (before ** 2 - shrink.after ** 2) / max(shrink.noise_floor, 1e-9) ** 2

    if not diagnosis.verdict or UNKNOWN in diagnosis.verdict:
        return max(shown, key=lambda shrink: (
            shrink.refitted if diagnosis.verdict else shrink.nominal
        ) / max(shrink.noise_floor, 1e-9))
    named = {channel for weighed in diagnosis.groups if diagnosis.best(weighed).names
             for channel in weighed.group.channels}
    if PARAMETER + DOTTED[VALVE_GAIN] in diagnosis.verdict:   # found with what follows the valve
        named.add('valve')
    return max([shrink for shrink in shown if shrink.channel in named] or shown, key=explained)


def document(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the answer as `asi gap --json` prints it; plain data."""
    chance = marginals(diagnosis.joined)
    # The effects of the verdict first, by their probability as single effects.
    alone = {name: max(w.probability.get((name,), 0.0) for w in diagnosis.groups)
             for name in chance}
    listed = [name for name in sorted(chance.keys() - {NO_GAP, UNKNOWN}, key=lambda n: (
        n not in diagnosis.verdict, -alone[n] if n in diagnosis.verdict else -chance[n], n))
        if chance[name] > 0.001]
    sizes = sizes_of(diagnosis, listed)
    which = [{'effect': name, 'block': block_of(name), 'probability': chance[name], **sizes[name]}
             for name in listed]
    ambiguous = ambiguity_set(diagnosis.joined)
    main = main_shrink(diagnosis)
    errors = {shrink.channel: {
        'channel': shrink.channel, 'signal': signal_of(shrink.channel, diagnosis.runs[0],
                                                       diagnosis.plant),
        'before_nrmse': shrink.nominal, 'refitted_nrmse': shrink.refitted,
        'after_nrmse': shrink.after, 'noise_floor_nrmse': shrink.noise_alone,
        'shrink': shrink.shrink, 'shrink_low': shrink.low, 'shrink_high': shrink.high,
        'edge_hz': shrink.edge_hz}
        for shrink in diagnosis.shrinks}
    weighed = diagnosis.compared(main.channel)
    best = diagnosis.best(weighed).fitted.record
    regimes = localisation.by_regime(weighed.group, main.channel,
                                     weighed.candidates[()].fitted.record, best)
    unexplained = None
    if UNKNOWN in diagnosis.verdict or UNKNOWN in {name for names in ambiguous for name in names}:
        unexplained = localisation.in_words(
            regimes, localisation.dependence(weighed.group, main.channel, best),
            localisation.ripple(weighed.group, main.channel, best),
            unit_of('m', main.channel, diagnosis.runs[0], diagnosis.plant))
    return {
        'verdict': hypothesis_name(diagnosis.verdict), 'plant': diagnosis.plant,
        'probability': diagnosis.joined[diagnosis.verdict],
        'where': [{'block': block, 'share': share}
                  for block, share in localisation.by_block(diagnosis.groups).items()],
        'which': which,
        'no_gap_probability': chance[NO_GAP], 'unknown_probability': chance[UNKNOWN],
        'ambiguity_set': [hypothesis_name(names) for names in ambiguous],
        'gap': errors[main.channel], 'channels': list(errors.values()),
        'chain': diagnosis.chain,
        'regimes': [regime._asdict() for regime in regimes],
        'unexplained': unexplained,
        'consequences': [], 'baseline': None, 'characteristic': None,
        'next_experiment': diagnosis.next_experiment, 'at_limit': limits_of(diagnosis),
        'notes': diagnosis.notes, 'sources': [run.source for run in diagnosis.runs],
        'nuisance': {weighed.group.channels[-1]: {
            free.field: float(diagnosis.best(weighed).fitted.record[free.field])
            for free in weighed.group.nuisance if not free.field.startswith(VALVE_ERROR)}
            for weighed in diagnosis.groups},
    }


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
