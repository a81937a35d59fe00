"""
Does the simulator itself explain the recordings? Alone, or with effects switched on.

A linear screen ranks every effect in each of its forms; the best are fitted, and weighed by their
evidence. The shapes of the laws are free. A machine that the simulator's own shapes explain down
to the noise is within its equations; else it is of other books, and a little may be left.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_analysis.arrays import Array
from asi_analysis.gap.inference.beyond_tolerance import with_null_named
from asi_analysis.gap.inference.books import REACH, all_of_books, judged
from asi_analysis.gap.inference.evidence import ODDS_AGAINST, weigh
from asi_analysis.gap.inference.fit import Fitted
from asi_analysis.gap.inference.hypotheses import Candidate, Weighed
from asi_analysis.gap.inference.initial_guesses import initial_guesses
from asi_analysis.gap.inference.posterior import (
    GAIN,
    ROUNDS,
    Found,
    Posterior,
    fitted,
    mean_squares,
    most_probable,
)
from asi_analysis.gap.inference.probability import (
    SIMULATOR,
    Names,
    as_probability,
    unknown_odds,
    with_unknown,
)
from asi_analysis.gap.inference.screen import Start, screen
from asi_analysis.gap.model.effects import PARAMETER, UNKNOWN, Effect, Free, Variant, block_of
from asi_analysis.gap.model.group import (
    Group,
    acts_on,
    recorrected,
    with_fitted_start,
    with_lower_noise,
    with_simulated_valve,
)
from asi_analysis.gap.model.predict import measured
from asi_analysis.gap.model.simulator import SUBSTEPS_S
from asi_analysis.gap.model.start import SEAL
from asi_common.record import field_name

ROUGH = 1         # derivatives of a fit after the linear screen
# Times that a sub-step is corrected anew, until the log posterior changes by less than this.
CORRECTED, SETTLED = 4, 2.0
FITTED, POLISHED = 7, 5   # effects that are fitted after the linear screen, and to the end
SEALS = (0.15, 0.85)  # shares of the range of a deflection of the seals, from which a fit begins
SUSPICIOUS = 3.0        # log prior cost of nominal parameters that may hide an effect
FOLLOWED = 0.5          # share of a signal's power that may be left of the machine of the model
NEAR = 9.0              # error floors (mean square) that may be left of a machine of other books


def explained_by_simulator(groups: Sequence[Group], tick: Callable[[], None],
                           alone: bool = False) -> list[Weighed] | None:
    """
    Return the groups, weighed, if the simulator explains them; else None.

    groups: the valve and what follows it; or one, if the valve position was not recorded.
    As it is, with parameters within their tolerance, or with effects or parameters beyond their
    tolerance, at most two in each group. alone: nothing else predicts such recordings, so what is
    left is `unknown`.
    """
    valve, *others = groups
    first = _explained([valve], tick, alone)
    if first is None or not others:
        return None if first is None else [first.weighed]
    rest, = others
    rivals = [first.weighed, *_rivals(first.weighed)]
    second = _explained([with_simulated_valve(rest, _most_probable(rival).fitted.record)
                         for rival in rivals], tick, alone)
    if second is None:
        return None
    if second.weighed.group.other_books:   # so is the valve, which may not show it
        rivals[0] = _weighed(first.found, alone, True) or rivals[0]
    return [_with_rivals(rivals[second.number], rivals, second.costs), second.weighed]


class _Explained(NamedTuple):
    """A group that was explained: one of several; costs: of the nominal model in each."""

    weighed: Weighed
    found: dict[Names, Found]
    number: int
    costs: Array


def _explained(rivals: Sequence[Group], tick: Callable[[], None], alone: bool
               ) -> _Explained | None:
    """Return the group in which the nominal model costs least, weighed, if it is explained."""
    nulls = [_null(group) for group in rivals]
    costs = np.array([null.best.cost for null in nulls])
    number = int(np.argmin(costs))
    found = _hypotheses(_quieter(nulls[number]), tick)
    weighed = _weighed(found, alone)
    return None if weighed is None else _Explained(weighed, found, number, costs)


def _with_rivals(valve: Weighed, rivals: Sequence[Weighed], costs: Array) -> Weighed:
    """
    Return the valve with `rivals`: candidates that explain its position equally well.

    They share the probability of its best candidate. costs: of all that follows the valve in the
    signal path, given each (negative log posterior).
    """
    candidates, chance = dict(valve.candidates), dict(valve.probability)
    effects = dict.fromkeys(valve.group.effects)
    total = chance[_most_probable(valve).names]
    weights = np.exp(costs.min() - costs)
    for rival, share in zip(rivals, weights / weights.sum(), strict=True):
        candidate = _most_probable(rival)
        candidates[candidate.names] = candidate
        effects |= dict.fromkeys(rival.group.effects)
        chance[candidate.names] = total * float(share)
    return Weighed(replace(valve.group, effects=tuple(effects)), candidates, chance)


def _weighed(found: Mapping[Names, Found], alone: bool, other: bool | None = None
             ) -> Weighed | None:
    """
    Return a group, weighed, if a hypothesis leaves at most NEAR error floors.

    other: whether its laws are of other books, if that is known.
    """
    if other is not None:
        found = all_of_books(found, other)
    most, group = math.inf if alone else NEAR, found[()].problem.group
    if not any(f.over.max() <= most for f in found.values()):
        return None
    candidates = {names: Candidate(names, f.variants, _fitted(f)) for names, f in found.items()}
    weighed = Weighed(group, candidates, weigh(group, found))
    best, gap, unknown = found[_most_probable(weighed).names], found[()].over, 0.0
    if best.left:
        if best.over.max() > most or (alone and not _follows(found[()])):
            return None
        unknown = as_probability(max(
            unknown_odds(left, before, SIMULATOR, SIMULATOR.unknown_floor)
            for left, before in zip(best.over, gap, strict=True)))
    elif group.other_books and not best.names:   # the model error may mask an effect
        unknown = SIMULATOR.masked * max(1.0 - group.noise[channel] ** 2 / level
                                         for channel, level in group.error_floor.items())
    if unknown > 0.0:
        chance = {names: weighed.probability[names] for names in candidates}
        weighed = weighed._replace(probability=with_unknown(
            chance, unknown, float((1.0 - np.sqrt(best.over / gap)).max())))
    # Parameters of other books mean a little else: beyond a tolerance, they are no finding yet.
    return weighed if group.other_books else with_null_named(weighed)


def _follows(null: Found) -> bool:
    """Return whether the nominal model follows the signals; if not, it is of another machine."""
    group = null.problem.group
    power = np.array([np.mean(np.concatenate(
        [measured(r, channel)[r.known] for r in group.recordings]) ** 2)
        / group.error_floor[channel] for channel in group.channels])
    return bool(np.all(mean_squares(null.problem, null.best.residual) < FOLLOWED * power))


def _rivals(valve: Weighed) -> Iterator[Weighed]:
    """
    Yield the same, with another parameter that changes the valve position as its gain does.

    Thrust and full opening also act on the force, which distinguishes them.
    """
    best, gain = _most_probable(valve), 'valve_characteristic_gain'
    if (best.names != (PARAMETER + 'valve_characteristic.gain',)
            or valve.probability.get((UNKNOWN,), 0.0) > 0.0):
        return
    nominal = valve.group.nominal
    ratio = float(best.fitted.record[gain] / nominal[gain])
    for field, factor in (('valve_characteristic_maximum_force', 1.0 / ratio),
                          ('valve_characteristic_full_opening', ratio)):
        effect = _beyond(field, valve.group)
        free, = effect.variants[0].free
        problem = Posterior(valve.group, tuple(
            free if each.field == gain else each for each in best.fitted.free))
        record = best.fitted.record.copy()
        record[gain], record[field] = nominal[gain], factor * nominal[field]
        theta = np.array([problem.parameter(each).share(float(record[each.field]))
                          for each in problem.free])
        candidate = Candidate((effect.name,), effect.variants, best.fitted._replace(
            record=record, free=problem.free, theta=theta, problem=problem))
        others = {names: c for names, c in valve.candidates.items() if names != best.names}
        chance = {names: p for names, p in valve.probability.items() if names != best.names}
        yield Weighed(replace(valve.group, effects=(*valve.group.effects, effect)),
                      {**others, candidate.names: candidate},
                      {**chance, candidate.names: valve.probability[best.names]})


def _most_probable(weighed: Weighed) -> Candidate:
    names = max(weighed.candidates, key=lambda names: weighed.probability[names])
    return weighed.candidates[names]


def _null(group: Group) -> Found:
    """Return the nominal model, fitted."""
    group = replace(group, effects=(*group.effects, *parameter_errors(group)),
                    scale=dict(group.scale))
    problem = Posterior(group, group.nuisance)
    starts = list(_beginnings(problem))
    if len(starts) > 1:
        starts = [min((most_probable(problem, start, rounds=2) for start in starts),
                      key=lambda best: best.cost).theta]
    null = _converged(Found((), (), problem, most_probable(problem, starts[0],
                                                           rounds=2 * ROUNDS)))
    # The start of a recording in motion is as that fit found it.
    return null._replace(problem=replace(null.problem, group=with_fitted_start(
        null.problem.group, null.problem.record(null.best.theta))))


def _quieter(null: Found) -> Found:
    """Return the nominal model with the noise that it leaves, if that is far less."""
    group = null.problem.group
    left = mean_squares(null.problem, null.best.residual)
    quiet = with_lower_noise(group, {channel: float(each) * group.error_floor[channel]
                                     for channel, each in zip(group.channels, left, strict=True)})
    if quiet is group:
        return null
    # What rings above the band of a motion is no noise in it.
    problem = replace(null.problem, group=quiet)
    return _converged(null._replace(problem=problem,
                                    best=most_probable(problem, null.best.theta)))


def _hypotheses(null: Found, tick: Callable[[], None]) -> dict[Names, Found]:
    """Return the nominal model, single effects and pairs that were fitted."""
    null.problem.group.scale.update(initial_guesses(_fitted(null)))
    # Large deviations of nominal parameters may hide an effect: then it is sought without them.
    hidden = null.left or null.given > SUSPICIOUS
    singles = _extended(null.as_given if hidden else null, null, tick)
    found = judged({(): _without_last(null, list(singles.values()))} | singles)
    if singles and all(map(_wants_more, found.values())):
        first = min((found[names] for names in singles), key=lambda each: each.best.cost)
        found = judged(_best_of(found, _pairs(found[()], first, tick)))
    return found


def _wants_more(found: Found) -> bool:
    """Return whether a further effect may explain a residual, or deviations of the parameters."""
    usual = 0.5 * np.count_nonzero(found.problem.prior[1])   # that their priors let expect
    return found.left or bool(found.given > usual + ODDS_AGAINST)


def _pairs(null: Found, first: Found, tick: Callable[[], None]) -> dict[Names, Found]:
    """
    Return the pairs with the best single effect; if one explains all, also those with its second.

    The best single effect need not be one of the true two: it may imitate both.
    """
    pairs = _with_second(first, tick)
    best = min(pairs.values(), key=lambda each: each.best.cost)
    if best.left or not _wants_more(pairs[first.names]):
        return pairs
    return _best_of(pairs, _with_second(_second_alone(null, first, best), tick))


def _with_second(first: Found, tick: Callable[[], None]) -> dict[Names, Found]:
    """Return a single effect, fitted anew, and its pairs with others."""
    pairs = _extended(first.as_given, first, tick)
    return {first.names: _without_last(first, list(pairs.values()))} | pairs


def _second_alone(null: Found, first: Found, pair: Found) -> Found:
    """Return the effect that was added to `first`, alone, in the form that it has in the pair."""
    variant, values = pair.variants[-1], pair.problem.record(pair.best.theta)
    own = {free.field for free in variant.free}
    fixed = tuple(each for each in pair.problem.fixed
                  if each not in first.problem.fixed or each in null.problem.fixed)
    problem = replace(pair.problem, fixed=fixed, free=(
        *(free for free in null.problem.free if free.field not in own), *variant.free))
    theta = np.array([problem.parameter(free).share(float(values[free.field]))
                      for free in problem.free])
    names = tuple(name for name in pair.names if name not in first.names)
    return _converged(Found(names, (variant,), problem, most_probable(problem, theta)))


def _best_of(found: Mapping[Names, Found], more: Mapping[Names, Found]) -> dict[Names, Found]:
    """Return both, the one of the lower cost where they share a hypothesis."""
    return {**found, **{names: each for names, each in more.items()
                        if names not in found or each.best.cost < found[names].best.cost}}


def _without_last(base: Found, more: Sequence[Found]) -> Found:
    """Return a fit, from where those with one more effect show that it can be better."""
    problem, starts = base.problem, []
    for found in more:
        fields, own = _free_fields(found)
        starts.append(_with_shared(base, found, fields - own))
    costs = [problem.cost(start) for start in starts]
    if min(costs, default=math.inf) > base.best.cost - GAIN:
        return base
    start = starts[int(np.argmin(costs))]
    return _converged(base._replace(best=most_probable(problem, start)))


def _beginnings(problem: Posterior) -> Iterator[Array]:
    """Yield the nominal parameters with recordings that begin in several ways, if in motion."""
    mean = problem.prior[0]
    yield mean
    started = [n for n, free in enumerate(problem.free) if free.scale != 'nominal']
    if not started:
        return
    alone = replace(problem, free=tuple(problem.free[n] for n in started))
    begun = mean.copy()
    begun[started] = most_probable(alone, alone.prior[0]).theta
    yield begun
    seals = [n for n in started if problem.free[n].field.startswith(SEAL)]
    for share in SEALS if seals else ():
        begun = mean.copy()
        begun[seals] = share
        yield begun


def parameter_errors(group: Group) -> list[Effect]:
    """Return the hypotheses that a nominal parameter is beyond its tolerance."""
    held = {free.field for effect in group.effects for variant in effect.variants
            for free in variant.free}
    return [_beyond(free.field, group) for free in group.nuisance
            if free.prior < math.inf and free.scale == 'nominal' and free.field not in held]


def _beyond(field: str, group: Group) -> Effect:
    """Return the hypothesis that one nominal parameter is beyond its tolerance."""
    dotted = next(p.name for p in ACTUATOR_PARAMETERS if field_name(p.name) == field)
    free = Free(field, 0.1, 10.0, (0.5, 0.7, 1.5, 2.2), 'nominal')
    return Effect(PARAMETER + dotted, str(block_of(PARAMETER + dotted)),
                  f'{dotted} is beyond its tolerance',
                  (Variant((free,), tuple(channel for channel in group.channels
                                          if acts_on(field, channel, group))),), exact=True)


def _extended(base: Found, null: Found, tick: Callable[[], None]) -> dict[Names, Found]:
    """
    Return the fits of `base` with one more effect: those with the highest gain in a linear screen.

    base: the nominal model, or that with an effect, as it was given, or fitted; null: fitted. From
    there, none is fitted if all promise less than the odds against them.
    """
    problem = base.problem
    if base is null and base.best.cost < ODDS_AGAINST:
        return {}
    screened = screen(base, base is null and not null.left, tick)
    if base is null and screened.most < ODDS_AGAINST:
        return {}
    fits: dict[Names, Found] = {}

    def rough(start: Start) -> Found:
        own = {free.field for free in start.variant.free}
        best = most_probable(replace(start.problem, pool=None), start.theta, ROUGH, {
            field: column for field, column in screened.slopes.items() if field not in own})
        return Found(tuple(sorted((*base.names, start.name))), (*base.variants, start.variant),
                     start.problem, best)

    forms: dict[Names, list[Found]] = {}
    for found in problem.each(rough, screened.best(FITTED)):
        if found.best.cost == math.inf:
            continue
        forms.setdefault(found.names, []).append(found)
        if found.names not in fits or found.best.cost < fits[found.names].best.cost:
            fits[found.names] = found
        tick()
    if not fits:
        return {}
    leader, *rivals = sorted(fits.values(), key=lambda f: f.best.cost)
    leader = _converged(leader._replace(best=most_probable(leader.problem, leader.best.theta)))
    best_forms, far = {names: found.best for names, found in fits.items()}, null.left
    fits[leader.names] = leader
    fields, own = _free_fields(leader)

    def polished(form: Found) -> Found:
        # The sub-step is corrected where it was for the leader. Within a thread of the pool
        # nothing may wait for another one: all could wait.
        form = form._replace(problem=replace(
            form.problem, group=leader.problem.group, pool=None))
        shared = [_with_shared(form, leader, fields - own), _with_shared(form, leader, fields)]
        if all(free.scale == 'nominal' for free in form.variants[-1].free):
            shared.append(_with_shared(form, null, _free_fields(form)[0]))
        starts = [min(shared, key=form.problem.cost)]
        # Far from the nominal model, the other parameters' values may mislead.
        if far and form.best is best_forms[form.names]:
            starts.append(form.best.theta)
        goal = leader.best.cost + REACH
        best = min((most_probable(form.problem, start, goal=goal) for start in starts),
                   key=lambda best: best.cost)
        return _converged(form._replace(best=best), goal)

    # What takes the longest first, so that no core is idle at the end.
    left = [form for found in rivals[:POLISHED] for form in forms[found.names]]
    for found in problem.each(polished, sorted(left, key=_is_coarse)):
        # What is not fitted to the end has the corrections of another sub-step: not compared.
        unfinished = fits[found.names].best is best_forms[found.names]
        if unfinished or found.best.cost < fits[found.names].best.cost:
            fits[found.names] = found._replace(problem=replace(found.problem, pool=problem.pool))
        tick()
    return {names: found for names, found in fits.items() if found.best.cost < math.inf}


def _is_coarse(found: Found) -> bool:
    return bool(found.problem.record(found.best.theta)['maximum_substep']
                > found.problem.group.exact_substep_s)


def _converged(found: Found, goal: float = math.inf) -> Found:
    """
    Return a hypothesis fitted so that shorter sub-steps change nothing.

    The sub-step is corrected at the parameters that were found, again after each fit, and the best
    is kept; if that does not settle, short ones are simulated throughout.
    """
    known: list[Found] = []
    change = 0.0
    while found.best.cost <= goal:
        problem, best = found.problem, found.best
        p = problem.record(best.theta)
        if p['maximum_substep'] == problem.group.exact_substep_s:
            return found
        problem = replace(problem, group=recorrected(problem.group, p))
        residual = problem.residual(best.theta)
        change = 0.5 * float(residual @ residual - best.residual @ best.residual)
        known.append(found._replace(problem=problem, best=best._replace(
            cost=best.cost + change, residual=residual)))
        if abs(change) < SETTLED or len(known) == CORRECTED:
            break
        found = known[-1]._replace(best=most_probable(problem, best.theta, goal=goal))
    if not known:
        return found
    found = min(known, key=lambda each: each.best.cost)
    if abs(change) < REACH:
        return found
    group, p = found.problem.group, found.problem.record(found.best.theta)
    shorter = next((each for each in SUBSTEPS_S if group.exact_substep_s < each
                    < p['maximum_substep']), group.exact_substep_s)
    problem = replace(found.problem, fixed=(*found.problem.fixed, ('maximum_substep', shorter)))
    problem = replace(problem, group=recorrected(group, problem.record(found.best.theta)))
    return _converged(found._replace(problem=problem, best=most_probable(
        problem, found.best.theta, goal=goal)), goal)


def _with_shared(found: Found, other: Found, fields: set[str]) -> Array:
    """Return the parameters of a fit, those of some fields as in another fit."""
    values = other.problem.record(other.best.theta)
    return np.array([found.problem.parameter(free).share(float(values[free.field]))
                     if free.field in fields else share
                     for free, share in zip(found.problem.free, found.best.theta, strict=True)])


def _free_fields(found: Found) -> tuple[set[str], set[str]]:
    """Return the fields that a fit frees, and those of them that its last effect does."""
    return ({free.field for free in found.problem.free},
            {free.field for variant in found.variants[-1:] for free in variant.free})


def _fitted(found: Found) -> Fitted:
    """Return a hypothesis as the rest of the diagnosis takes it."""
    return fitted(found.problem, found.best)
