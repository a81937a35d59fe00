"""Diagnose recordings against a nominal model: `diagnose`."""

import itertools
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

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
from asi_analysis.gap.diagnosis import Diagnosis, improved_of, records_of
from asi_analysis.gap.experiment import next_experiment
from asi_analysis.gap.experiment.next_course import choose_course
from asi_analysis.gap.experiment.next_motion import choose_motion
from asi_analysis.gap.findings import localisation
from asi_analysis.gap.findings.edges import PLACED, placed
from asi_analysis.gap.findings.no_effect import SENSOR_GAIN as GAIN
from asi_analysis.gap.findings.no_effect import (
    place_of_gap,
    sampling_delay,
    with_gap_centre,
    with_tolerated_gain,
    without_sampling_delay,
)
from asi_analysis.gap.findings.one_rate import at_one_rate
from asi_analysis.gap.findings.one_sensor import with_one_sensor
from asi_analysis.gap.findings.pattern import leaves_more_than_noise, with_pattern
from asi_analysis.gap.findings.shrink import shrink_of
from asi_analysis.gap.inference import plausibility
from asi_analysis.gap.inference.coloured_noise import NOT_WHITE, not_white
from asi_analysis.gap.inference.hypotheses import (
    Weighed,
    join,
    weigh_groups,
)
from asi_analysis.gap.inference.other_extent import with_hidden_load, with_lower_band
from asi_analysis.gap.inference.probability import (
    Names,
    ambiguity_set,
    with_hidden_effect,
)
from asi_analysis.gap.inference.simulated.own_laws import OwnLaws, by_own_laws
from asi_analysis.gap.inference.simulated.search import explained_by_simulator
from asi_analysis.gap.inference.simulated.uneven_delay import how_uneven
from asi_analysis.gap.model.effects import DOTTED
from asi_analysis.gap.model.group import (
    TOLERANCE,
    Group,
    Values,
    with_tolerances,
)
from asi_analysis.gap.model.joint import OF_ANY_SIZE, WHOLE, Extent, drive_of, joint_groups
from asi_analysis.gap.model.simulator import (
    has_linear_laws,
    of_simulator,
)
from asi_analysis.gap.model.static import static_group
from asi_analysis.gap.prepare import shared_band
from asi_analysis.gap.words import signal_of
from asi_analysis.terminal import Progress, silent
from asi_common.parameter import Value
from asi_common.record import field_name

OTHER_LAWS = ("the simulator's own laws leave a gap, and no effect is found that closes it: laws "
              'of another form do, or an effect that they hide')
MORE_THAN_NOISE = ('the model leaves far more than noise, but within the usual error of a '
                   "joint's model: an effect may hide in it")
# Effects that may be a constant force, which only the zero of the position tells apart.
CONSTANT = {'disturbance_force', 'valve_bias', 'sensor_offset'}


@dataclass(frozen=True)
class _Case:
    """What is asked: the arguments of `diagnose`."""

    runs: Sequence[Run]
    model: Mapping[str, Value]
    plant: str
    tolerance: float
    held_out: Sequence[bool] | None
    drive: str | None
    report: Progress
    tolerances: Mapping[str, float]
    healthy: Diagnosis | None
    simulate: bool
    extent: Extent

    def answer(self) -> Diagnosis:
        """Return its diagnosis."""
        return diagnose(**vars(self))

    def of(self, healthy: Diagnosis, **other: Any) -> Diagnosis:
        """Return the diagnosis of the healthy recordings again, with some `other` arguments."""
        return replace(self, runs=healthy.runs, held_out=None, healthy=None, **other).answer()


@dataclass(frozen=True)
class _Groups:
    """
    Channels that are judged together, in two ways.

    blocks: predicted block by block; simulated: by the simulator, or []; own: tolerances by field;
    machine: the healthy one, by channels.
    """

    blocks: Sequence[Group]
    simulated: Sequence[Group]
    own: Mapping[str, float]
    machine: Mapping[tuple[str, ...], Healthy] = field(default_factory=dict)


def _in_one_band(case: _Case) -> _Case:
    """
    Return the case of a joint with the band that all its recordings have in common.

    And with the healthy machine fitted in that band, if it was in another: in a wider one it has
    other parameters, which is no change.
    """
    before = case.healthy.runs if case.healthy else []
    drive = case.drive or drive_of(before or case.runs)
    case = replace(case, drive=drive)
    if drive != 'force':
        return case
    extent = case.extent._replace(
        band_hz=min(case.extent.band_hz, shared_band([*before, *case.runs], drive)))
    healthy = case.healthy
    if healthy and healthy.extent.band_hz > extent.band_hz:
        healthy = case.of(healthy, extent=extent._replace(hidden=healthy.extent.hidden))
    if healthy:   # its load rattles: it was fitted in a lower band
        extent = extent._replace(band_hz=min(extent.band_hz, healthy.extent.band_hz))
    return replace(case, extent=extent, healthy=healthy)


def _groups(case: _Case) -> tuple[_Groups, list[str]]:
    """Return the groups of channels of a case, and notes."""
    held_out = _held_out(case)
    healthy, simulated = case.healthy, list[Group]()
    if case.plant == 'joint':
        for run in case.runs:
            plausibility.check_units_of_motion(run)
        groups, notes = _of_joint(case)
    elif case.plant == 'static':
        group, notes = static_group(case.runs, case.model, case.tolerance, held_out,
                                    healthy.runs if healthy else [])
        groups = [group]
    else:
        groups, notes = actuator_groups(case.runs, case.model, case.tolerance, held_out)
        simulated = simulated_groups(groups, improved_of(healthy, case.model) if healthy else
                                     case.model, case.tolerance)
    groups, simulated = _with_tolerances(case, groups, simulated)
    return _Groups(groups, simulated if case.simulate else [], _given(case)), [
        note for run in case.runs for note in plausibility.check_signals(run)] + notes


def _held_out(case: _Case) -> Sequence[bool]:
    """Return which recordings are used for validation only."""
    return list(case.held_out) if case.held_out is not None else [False] * len(case.runs)


def _of_joint(case: _Case) -> tuple[list[Group], list[str]]:
    """Return the groups of channels of a joint, and notes."""
    healthy = case.healthy
    before = healthy.runs if healthy else []
    known, weight = dict(case.model), (0.0, 0.0)
    for record in records_of(healthy)[-1:] if healthy else ():
        known |= {name: float(record[field_name(name)]) for name in OF_ANY_SIZE}
        weight = float(record['gravity_sine']), float(record['gravity_cosine'])
    return joint_groups(case.runs, known, case.tolerance, _held_out(case),
                        case.drive or drive_of(before or case.runs), before, weight, case.extent)


def _given(case: _Case) -> Values:
    """Return the tolerances of single parameters that are given, by field."""
    return {field_name(name): share for name, share in case.tolerances.items()}


def _with_tolerances(case: _Case, groups: Sequence[Group], simulated: Sequence[Group]
                     ) -> tuple[list[Group], list[Group]]:
    """
    Return the groups with the tolerances that are given for single parameters.

    Raises InputError for one of a parameter that is not uncertain.
    """
    uncertain = sorted({DOTTED.get(free.field, free.field) for group in (*groups, *simulated)
                        for free in group.nuisance if free.scale == 'nominal'}
                       | ({DOTTED[GAIN]} if case.plant == 'actuator' else set()))
    for name in case.tolerances.keys() - set(uncertain):
        raise InputError(f'tolerance {name}: no uncertain parameter of the nominal model; '
                         f'uncertain are: {", ".join(uncertain) or "none"}')
    own = _given(case)
    return ([with_tolerances(group, own) for group in groups],
            [with_tolerances(group, own) for group in simulated])


def _with_healthy_machine(case: _Case, groups: _Groups) -> tuple[_Case, _Groups]:
    """Return the case and its groups, with the healthy machine, if any, as nominal model."""
    healthy = case.healthy
    if healthy is None:
        return case, groups
    predicted = {of_simulator(each.group.nominal) for each in healthy.groups}
    # With a linear model, or where the simulator explained the valve only: block by block.
    alike = not has_linear_laws(case.model) and len(predicted) == 1
    if not alike and True in predicted:
        healthy = case.of(healthy, simulate=False)
    machine = _machine_of(healthy, groups.own)
    simulated = [against(group, machine) for group in groups.simulated] if (
        alike and True in predicted) else []
    blocks = groups.blocks if simulated else [against(group, machine) for group in groups.blocks]
    return replace(case, healthy=healthy), _Groups(
        blocks, simulated, {**groups.own, **shares(machine)}, machine)


def _machine_of(healthy: Diagnosis, own: Mapping[str, float]) -> dict[tuple[str, ...], Healthy]:
    """Return the healthy machine by channels; own: tolerances by field."""
    return {w.group.channels: healthy_of(healthy.best(w).fitted, healthy.tolerance, own)
            for w in healthy.groups}


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
    case = _Case(runs, model, plant, tolerance, held_out, drive, report, tolerances, healthy,
                 simulate, extent)
    case = _in_one_band(case) if plant == 'joint' else case
    groups, notes = _groups(case)
    case, groups = _with_healthy_machine(case, groups)
    told = case.healthy.notes if case.healthy else []
    _warn(note for note in notes if note not in told)   # first: it may explain a refusal
    tick = _ticks(report, 4 * sum(len(group.effects) for group in groups.blocks))
    answered, laws = _by_simulator(case, groups, tick)
    if groups.simulated and case.healthy and None in answered:
        healthy = case.of(case.healthy, simulate=False)
        return replace(case, healthy=healthy, simulate=False).answer()
    weighed, more = _by_blocks(case, groups, answered, tick)
    notes += more
    if plant == 'joint':
        weighed, case, groups, more = _in_another_extent(case, groups, weighed, tick)
        notes += more
    weighed, more = _as_changes(case, groups, weighed)
    notes += more
    if laws:
        weighed = [law.agreeing(each) for law, each in zip(laws, weighed, strict=True)]
    joined = join(weighed)
    if plant == 'joint':
        hidden = any(map(leaves_more_than_noise, weighed))
    else:
        hidden = bool(groups.simulated) and not laws and any(
            each is None or each.group.hides_effects for each in answered)
    if hidden:
        joined, before = with_hidden_effect(joined), joined
        may_hide = MORE_THAN_NOISE if plant == 'joint' else OTHER_LAWS
        notes += [may_hide] if joined != before else []
    return _answer(case, groups, weighed, joined, notes)


def _warn(notes: Iterable[str], depth: int = 3) -> None:
    """Print notes as warnings of the caller of `diagnose`, which is so many calls up."""
    for note in notes:
        warnings.warn(note, InputWarning, stacklevel=depth)


def _ticks(report: Progress, steps: int) -> Callable[[], None]:
    """Return what reports one step more of an estimated number of steps."""
    count = itertools.count(1)

    def tick() -> None:
        done = next(count)
        # Beyond the estimate nobody knows how many are left.
        report('fitting effects', done / steps if done < steps else None)

    return tick


def _by_simulator(case: _Case, groups: _Groups, tick: Callable[[], None]
                  ) -> tuple[Sequence[Weighed | None], Sequence[OwnLaws]]:
    """
    Return the groups that the simulator explains, None for each other, and what its laws say.

    Both are empty if it is not the predictor, and what its laws say if the nominal ones are not
    linear.
    """
    free = case.model.get('load.type') == 'free'
    if groups.simulated and not free:
        for group in groups.blocks:
            plausibility.check_against_model(group, alike=True)
    if not groups.simulated:
        return [], []
    if not has_linear_laws(case.model):
        # The block-wise model needs the measured force, which is small with a free load.
        return explained_by_simulator(groups.simulated, tick, free), []
    # Block by block, what is implausible is refused: as early as that is known.
    laws = by_own_laws(groups.simulated, tick,
                       lambda: plausibility.check_against_model(groups.blocks[0]))
    return [law.weighed for law in laws], laws


def _by_blocks(case: _Case, groups: _Groups, answered: Sequence[Weighed | None],
               tick: Callable[[], None]) -> tuple[list[Weighed], list[str]]:
    """Return the groups as answered, or by the block-wise model where they are not, and notes."""
    weighed = [each for each in answered if each is not None]
    if len(weighed) == len(groups.blocks):
        return weighed, []
    notes: list[str] = []
    for group, known in itertools.zip_longest(groups.blocks, answered):
        if case.plant == 'joint':
            plausibility.check_joint(group)
        # The force of a free load is too small for the check.
        elif case.plant == 'actuator' and not (known and case.model.get('load.type') == 'free'):
            more = plausibility.check_against_model(group)
            _warn(more, 4)
            notes += more
    weighed = weigh_groups(groups.blocks, tick, answered)
    return [at_one_rate(each) if case.plant == 'static' else each for each in weighed], notes


def _in_another_extent(case: _Case, groups: _Groups, weighed: list[Weighed],
                       tick: Callable[[], None]
                       ) -> tuple[list[Weighed], _Case, _Groups, list[str]]:
    """Return a joint with a hidden load or in a lower band, if that explains it, and notes."""
    tried = {case.extent: (case, groups)}
    given = _given(case)

    def made(extent: Extent) -> Sequence[Group]:
        before = case.healthy and case.of(case.healthy, extent=extent)
        other = replace(case, extent=extent, healthy=before)
        machine = _machine_of(before, given) if before else {}
        tried[extent] = other, replace(groups, machine=machine, own={**given, **shares(machine)})
        if before:
            other = replace(other, extent=extent._replace(
                band_hz=min(extent.band_hz, before.extent.band_hz)))
        made = [with_tolerances(each, given) for each in _of_joint(other)[0]]
        return [against(each, machine) for each in made] if before else made

    extent, notes = case.extent, list[str]()
    for alternative in (with_lower_band, with_hidden_load):
        weighed, more, extent = alternative(weighed, made, extent, tick)
        notes += more
    return weighed, *tried[extent], notes


def _as_changes(case: _Case, groups: _Groups, weighed: Sequence[Weighed]
                ) -> tuple[list[Weighed], list[str]]:
    """Return the groups with what is no change, or within its tolerance, as no effect; notes."""
    if case.plant == 'joint':
        weighed = with_one_sensor([without_sampling_delay(each) for each in weighed])
    if groups.machine:
        found = [doubted(changed_only(each, was), was, case.tolerance)
                 for each in weighed for was in [groups.machine[each.group.channels]]]
        return [each for each, _ in found], [note for _, more in found for note in more]
    if case.plant == 'joint':
        return [with_pattern(each) for each in weighed], []
    if case.plant == 'actuator':
        return [with_tolerated_gain(with_gap_centre(each), groups.own.get(GAIN, case.tolerance))
                for each in weighed], []
    return list(weighed), []


def _answer(case: _Case, groups: _Groups, as_fitted: list[Weighed],
            joined: dict[Names, float], notes: list[str]) -> Diagnosis:
    """Return the verdict with all that is told of it."""
    runs, plant = case.runs, case.plant
    verdict = max(joined, key=lambda names: joined[names])
    weighed = [placed(each) for each in as_fitted]
    if 'disturbance_force' in verdict and any(
            each is not old for each, old in zip(weighed, as_fitted, strict=True)):
        notes.append(PLACED)
    notes += [NOT_WHITE.format(signal_of(channel, runs[0], plant).replace('_', ' '))
              for each in weighed for channel in not_white(each.group)]
    answer = Diagnosis(runs, plant, case.tolerance, groups.own, weighed, joined, verdict, [],
                       notes, None, None, case.healthy, groups.machine, case.extent)
    notes += filter(None, (of(answer.best(each)) for each in weighed
                           for of in (place_of_gap, sampling_delay, how_uneven)))
    shrinks = [shrink_of(w.group, channel, w.candidates[()].fitted.record,
                         answer.best(w).fitted.record, elsewhere=plant == 'actuator')
               for w in weighed for channel in w.group.channels]
    ambiguous = ambiguity_set(joined)
    if plant == 'actuator' and any(CONSTANT & {*names} for names in ambiguous):
        notes += plausibility.doubtful_origin(groups.blocks[-1].recordings, case.model)
    return replace(answer, shrinks=shrinks, chain=_chain(groups, weighed),
                   next_experiment=_experiment(case, groups, weighed, ambiguous))


def _experiment(case: _Case, groups: _Groups, weighed: list[Weighed], ambiguous: list[Names]
                ) -> dict[str, object] | None:
    """Return the experiment that tells apart what these recordings cannot; None if none does."""
    if case.plant == 'static':
        return choose_course(weighed, ambiguous)
    if len(ambiguous) < 2:
        return None
    if case.plant == 'joint':
        return choose_motion(weighed, ambiguous, _missing(case.runs, ('position', 'force')),
                             _unit_of_motion(case.runs[0], case.drive))
    scale = groups.blocks[-1].scale['force']
    force = scale if scale != 1.0 else 300.0
    return next_experiment.choose(weighed, ambiguous, case.model, max(round(force, -1), 10.0),
                                  _missing(case.runs, ('position', 'valve_position')))


def _chain(groups: _Groups, weighed: Sequence[Weighed]) -> dict[str, float] | None:
    """Return the error along the signal chain of an actuator, if it was fitted block by block."""
    if [w.group.channels for w in weighed] != [('valve',), ('force', 'load')] or of_simulator(
            weighed[0].group.nominal):
        return None
    # With refitted parameters, since a difference within their tolerance is not a gap.
    return localisation.along_the_chain(groups.blocks[0].recordings[0], *(
        w.candidates[()].fitted.record for w in weighed))


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
