"""
Whether the simulator explains the recordings, as it is or with effects of the vocabulary.

A linear screen ranks every effect in each of its forms. The best are fitted; the evidence gives
their probabilities. The shape parameters of the laws (friction, hysteresis) are free in each fit.
If the simulator leaves only noise, it explains the recordings. Else the block-wise fits are asked;
where they are of no use, the laws are taken to be formulated in another way than the simulator's,
and a model error is allowed for.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.gap.formulation import with_lower_floor
from asi_analysis.gap.inference.coloured_noise import with_noise_of_valve
from asi_analysis.gap.inference.hypotheses import Weighed
from asi_analysis.gap.inference.initial_guesses import initial_guesses
from asi_analysis.gap.inference.posterior import (
    FAR,
    GAIN,
    GAIN_MARGIN,
    NONE,
    ODDS_AGAINST,
    ROUNDS,
    SLIGHT,
    Best,
    most_probable,
    of_first_part,
)
from asi_analysis.gap.inference.probability import Names
from asi_analysis.gap.inference.simulated.behind_valve import (
    behind_valve,
    gain_is_off,
    with_free_gain,
)
from asi_analysis.gap.inference.simulated.explained import most_probable_of, weighed_of
from asi_analysis.gap.inference.simulated.fits import (
    columns_of,
    converged,
    with_noise_from_fit,
    with_noise_left,
    with_usual_parameters,
)
from asi_analysis.gap.inference.simulated.formulation import (
    goal_beside,
    in_best_formulation,
    in_formulation,
    sufficient,
)
from asi_analysis.gap.inference.simulated.found import (
    COST_RANGE,
    Found,
    at_values_of,
    cost_of,
    freed_fields,
    with_values_of,
)
from asi_analysis.gap.inference.simulated.nominal_fit import (
    hides_an_effect,
    rough_null_fit,
    to_the_end,
    with_start_of_fit,
)
from asi_analysis.gap.inference.simulated.screen import Start, screen
from asi_analysis.gap.inference.simulated.special_cases import (
    alone_of,
    from_values_of,
    never_slides,
    special_cases,
)
from asi_analysis.gap.inference.simulated.uneven_delay import with_uneven_delay
from asi_analysis.gap.model.group import Group

# The cost that a fit must reach beside the best one, of the same base, and the nominal model.
Goal = Callable[[Found, Found], float]

# After the linear screen so many effects are fitted roughly, with so many Jacobians; and so many
# of them, beside the best, until convergence.
ROUGH_FITS, ROUGH_ROUNDS, FULL_FITS = 7, 1, 3
RIVALS = 7   # effects that are fitted in place of that of the best fit


def explained_by_simulator(groups: Sequence[Group], tick: Callable[[], None],
                           alone: bool = False) -> list[Weighed | None]:
    """
    Return each group with the probabilities of its hypotheses, if the simulator explains it.

    Else None, and for what follows a valve that it does not explain. It explains a group as it
    is, with parameters within their tolerance, or with at most two effects or parameters beyond
    their tolerance, if only noise is left. groups: the valve and what follows it; or one, if the
    valve position was not recorded. alone: no other model predicts such recordings, so laws
    formulated in another way get a model error, and a residual is `unknown`.
    """
    valve, *others = groups
    valve, gain = with_free_gain(valve) if others else (valve, None)
    first = _explained(valve, tick, alone)
    if first is None or not others:
        return [None if first is None else first.weighed, *(None for _ in others)]
    rest, = others
    of_valve = most_probable_of(first.weighed).fitted
    second = _explained(behind_valve(
        with_noise_of_valve(rest, first.weighed.group), of_valve, gain), tick, alone)
    # If the laws behind the valve are formulated in another way, so are the valve's, although
    # its position may not show it; unless they are far less probable with no effect.
    costs = [each.best.cost for each in first.found.values()]
    changed = ((second is None or second.weighed.group.other_formulation)
               and not first.weighed.group.other_formulation
               and first.found[()].best.cost < min(costs) + COST_RANGE)
    if second is None and gain_is_off(of_valve.record, rest, gain):
        return [None, None]
    return [(weighed_of(first.found, alone, True) if changed else None) or first.weighed,
            None if second is None else second.weighed]


class _Explained(NamedTuple):
    """A group that the simulator explains, and its fitted hypotheses."""

    weighed: Weighed
    found: Mapping[Names, Found]


def _explained(group: Group, tick: Callable[[], None], alone: bool) -> _Explained | None:
    """Return a group, if the simulator explains it."""
    rough = with_noise_left({(): rough_null_fit(group)})[()]
    only = changed_alone(with_start_of_fit(rough), tick) if hides_an_effect(rough) else None
    if only:   # beside that, a nominal model that is far from it need not be fitted to the end
        null = with_start_of_fit(
            rough if rough.problem.is_far(rough.best.cost) else to_the_end(rough))
    else:
        null = with_noise_left(with_noise_from_fit(
            {(): with_start_of_fit(to_the_end(rough))}))[()]
        if not null.unexplained:   # without noise it shows more than a model error would allow
            null = with_noise_from_fit({(): null}, with_lower_floor)[()]
    found = _hypotheses(null, only, tick, alone)
    if _only_noise_left(found):
        quiet = with_noise_from_fit(found, with_lower_floor) if len(found) > 1 else found
        found = quiet if _only_noise_left(quiet) else found
    elif not all(each.far for each in found.values()):
        # Only the model error of laws formulated in another way explains the rest.
        found, alone = in_formulation(found, True), True
    weighed = weighed_of(found, alone)
    if weighed is None:
        return None
    laws = weighed.group
    hides = null.may_lack_an_effect and laws.other_formulation and laws.may_differ
    return _Explained(weighed._replace(group=replace(laws, hides_effects=hides)), found)


def goal_of(alone: bool) -> Goal:
    """
    Return the goal of a search.

    alone: as in `explained_by_simulator`; if not, what will leave more than noise is given up.
    """
    def goal(leader: Found, null: Found) -> float:
        most = math.inf if alone or not leader.far else leader.largest_cost
        return min(goal_beside(leader), most)

    return goal


def single_effects(null: Found, tick: Callable[[], None], goal: Goal,
                   only: Sequence[Found] | None = None) -> dict[Names, Found]:
    """
    Return the fits of the nominal model and of single effects.

    goal: what cannot reach it is given up; only: what `changed_alone` found, if it was asked.
    """
    null.problem.group.scale.update(initial_guesses(null.as_fitted))
    singles: dict[Names, Found] = {}
    hidden = hides_an_effect(null)
    if hidden and only is None:
        only = changed_alone(null, tick)
    if only:
        singles = _around(only, null.at_nominal, null, tick, goal)
    else:
        if not null.unexplained:
            singles = _extended(null, null, tick, goal)
        # Errors of nominal parameters hide an effect: then the screen starts from usual ones.
        if hidden:
            singles = _best_of(singles, _extended(_beside(null), null, tick, goal))
    return {(): _refitted_from_larger(null, list(singles.values()))} | singles


def changed_alone(null: Found, tick: Callable[[], None]) -> list[Found]:
    """
    Return the effects that explain the recordings beside the nominal values of all else.

    Nothing can be much more probable: only noise is left, and no nominal parameter is off.
    """
    # With guesses of their own: those of the fits that follow must not change what these mean.
    null = null._replace(problem=replace(null.problem, group=replace(
        null.problem.group, scale=null.problem.group.scale | initial_guesses(null.as_fitted))))
    problem, theta = null.problem, null.problem.nominal
    values, at = problem.record(theta), null.at(theta)
    base = at._replace(best=at.best._replace(slopes=None))

    def fitted_alone(start: Start) -> Found:
        count = len(start.variant.free)
        own = replace(start.problem, free=start.variant.free, pool=None, fixed=(
            *start.problem.fixed, *((free.field, float(values[free.field]))
                                    for free in start.problem.free[:-count])))
        best = most_probable(own, start.theta[-count:], goal=null.largest_cost)
        found = converged(Found((start.name,), (start.variant,), own, best), null.largest_cost)
        substep = float(found.problem.record(found.best.theta)['maximum_substep'])
        return found._replace(problem=replace(
            start.problem, group=found.problem.group, fixed=(
                *start.problem.fixed, ('maximum_substep', substep)))).at(
                    np.append(start.theta[:-count], found.best.theta))

    fits = problem.in_parallel(fitted_alone, screen(base, False, tick).best(ROUGH_FITS))
    return [each._replace(best=each.best._replace(slopes=None)) for each in fits
            if each.best.cost < math.inf and not each.unexplained]


def _beside(found: Found) -> Found:
    """Return where the search for one more effect starts, beside improbable parameters."""
    usual = with_usual_parameters(found)
    return found.at_nominal if usual is found else usual


def _hypotheses(null: Found, only: Sequence[Found] | None, tick: Callable[[], None], alone: bool
                ) -> dict[Names, Found]:
    """
    Return the fits of the nominal model, of single effects and, if needed, of pairs.

    only: as in `single_effects`; alone: as in `explained_by_simulator`.
    """
    found = with_uneven_delay(with_noise_left(single_effects(null, tick, goal_of(alone), only)))
    if alone or _only_noise_left(found):
        found = in_best_formulation(with_noise_from_fit(found))
    elif (plain := sufficient(found[()])) is not None:   # beside it, nothing has evidence
        return {(): plain}
    pairs = with_pairs(found, tick, alone)
    if pairs is found or not (alone or _only_noise_left(pairs)):
        return pairs
    return in_best_formulation(with_noise_from_fit(pairs), found)


def with_pairs(found: dict[Names, Found], tick: Callable[[], None], alone: bool
               ) -> dict[Names, Found]:
    """
    Return hypotheses of single effects, and pairs, if each of the single ones may lack an effect.

    alone: as in `explained_by_simulator`.
    """
    singles = [names for names in found if names]
    if not singles or not all(each.may_lack_an_effect for each in found.values()):
        return found
    first = min((found[names] for names in singles), key=cost_of)
    promised = screen(first, not first.unexplained, tick).most
    # Without another model, an effect may be named although a residual is left.
    if promised < ODDS_AGAINST or not (
            alone or first.best.cost - GAIN_MARGIN * promised < first.largest_cost):
        return found
    return with_noise_left(_best_of(found, _pairs(found[()], first, tick, goal_of(alone))))


def _only_noise_left(found: Mapping[Names, Found]) -> bool:
    """Return whether one of the hypotheses explains the recordings."""
    return not all(each.unexplained for each in found.values())


def _pairs(null: Found, first: Found, tick: Callable[[], None], goal: Goal
           ) -> dict[Names, Found]:
    """
    Return the fits of pairs that hold the best single effect.

    If the best pair leaves only noise, also of the pairs that hold its second effect: the best
    single effect need not be one of the true two, since it may imitate both.
    """
    pairs = _with_second(first, tick, goal)
    best = min(pairs.values(), key=cost_of)
    if best.names == first.names or best.far or not pairs[first.names].may_lack_an_effect:
        return pairs
    second = alone_of(null, best, best.variants[-1])
    pairs = _best_of(pairs, _with_second(second, tick, goal))
    third = min(pairs.values(), key=cost_of)
    if third is best or len(third.names) < 2:
        return pairs
    # Beside the second effect a third one is the best, which alone may explain as much.
    alone = alone_of(null, third, third.variants[-1])
    return _best_of(pairs, {alone.names: alone})


def _with_second(first: Found, tick: Callable[[], None], goal: Goal) -> dict[Names, Found]:
    """Return a single effect, refitted from its pairs where that helps, and these pairs."""
    pairs = _extended(_beside(first), first, tick, goal)
    return {first.names: _refitted_from_larger(first, list(pairs.values()))} | pairs


def _best_of(found: Mapping[Names, Found], more: Mapping[Names, Found]) -> dict[Names, Found]:
    """Return the union of two sets of fits; of a hypothesis in both, the better form."""
    return {**found, **{names: each for names, each in more.items()
                        if names not in found or each.criterion < found[names].criterion}}


def _refitted_from_larger(base: Found, more: Sequence[Found]) -> Found:
    """Return a fit, repeated from the values of fits with one more effect if that costs less."""
    starts = []
    for found in more:
        fields, own = freed_fields(found)
        starts += [at_values_of(base, found, names) for names in (fields - own, fields)]
    start = min(starts, key=lambda start: start.best.cost, default=base)
    if start.best.cost > base.best.cost - GAIN:
        return base
    # The start was simulated with another correction of the integration error.
    refitted = converged(start.refined())
    return refitted if refitted.best.cost < base.best.cost - GAIN else base


def _extended(base: Found, null: Found, tick: Callable[[], None], goal: Goal
              ) -> dict[Names, Found]:
    """
    Return the fits of `base` with one more effect: the best of the linear screen.

    base: a fit of the nominal model or of one effect, or the same with the nominal parameter
    values; null: its fit. If that is the base, nothing is fitted unless the screen expects more
    from an effect than the prior odds against it. goal: what cannot reach it is given up.
    """
    problem = base.problem
    if base is null and base.best.cost < ODDS_AGAINST:
        return {}
    screened = screen(base, base is null and not null.unexplained, tick)
    if base is null and screened.most < ODDS_AGAINST:
        return {}

    far = problem.is_far(base.best.cost)

    def rough(start: Start) -> Found:
        own = start.variant.fields
        single = replace(start.problem, pool=None)
        begun = Found(tuple(sorted((*base.names, start.name))), (*base.variants, start.variant),
                      start.problem, base.best._replace(slopes=None))
        if far:   # the first part of the recordings shows well enough which effect it is
            return begun.at(of_first_part(single, start.theta).theta)
        best = most_probable(single, start.nearest, ROUGH_ROUNDS, {
            field: column for field, column in screened.slopes.items() if field not in own})
        return begun._replace(best=best._replace(slopes=None))

    forms = []
    for found in problem.in_parallel(rough, screened.best(ROUGH_FITS)):
        if found.best.cost < math.inf:
            forms.append(found)
        tick()
    return _around(forms, base, null, tick, goal, screened.slopes)


def _around(rough: Sequence[Found], base: Found, null: Found, tick: Callable[[], None],
            goal: Goal, at_base: Mapping[str, Array] = NONE) -> dict[Names, Found]:
    """
    Return the fits of `base` with one more effect, from rough fits of it in several forms.

    The best is fitted first; then the next best, and effects that may take its place. at_base:
    columns of the Jacobian, by field, from which the rough fits were made; else as `_extended`.
    """
    problem = base.problem
    fits: dict[Names, Found] = {}
    forms: dict[Names, list[Found]] = {}
    for found in rough:
        forms.setdefault(found.names, []).append(found)
        if found.names not in fits or found.criterion < fits[found.names].criterion:
            fits[found.names] = found
    if not fits:
        return {}
    ranked = sorted(fits.values(), key=cost_of)[:1 + FULL_FITS]
    leader = converged(ranked[0].refined(2 * ROUNDS))
    if never_slides(leader):
        return _around([form for form in rough if form is not ranked[0]], base, null, tick, goal,
                       at_base)
    best_forms = {names: found.best for names, found in fits.items()}
    fits[leader.names] = leader
    fields, own = freed_fields(leader)
    # If the leader leaves more than noise, another effect must gain much: that is seen without
    # computing the whole Jacobian again.
    at_leader: Mapping[str, Array] = columns_of(leader.problem, leader.slopes)
    most, beside = goal(leader, null), leader.best.cost + COST_RANGE
    reached: dict[Names, float] = {}   # by a form of each effect

    def converged_fit(form: Found) -> Found:
        # The integration error is corrected as for the leader. A thread of the pool must not
        # wait for another one, since all of them could: hence no pool.
        form = form._replace(problem=replace(
            form.problem, group=leader.problem.group, pool=None))
        shared = [with_values_of(form, leader, names) for names in (fields - own, fields)]
        of_effect = freed_fields(form)[1]
        if of_effect & own:   # of the same law, of which the leader may have a special case
            shared.append(with_values_of(form, leader, freed_fields(form)[0]))
        if all(free.scale == 'nominal' for free in form.variants[-1].free):
            shared.append(with_values_of(form, null, freed_fields(form)[0]))
        starts = [(min(shared, key=form.problem.cost), at_leader)]
        # Where there is much to explain, the leader's parameter values may be a bad start.
        if null.may_lack_an_effect and form.best is best_forms.get(form.names):
            starts.append((form.best.theta, at_base))
        best = form.best._replace(cost=math.inf)
        # A further form only counts if it is better than the others of its effect.
        limit = min(most, reached.get(form.names, math.inf) + COST_RANGE)
        for start, near in starts:
            known = {field: column for field, column in near.items() if field not in of_effect}
            again = most_probable(form.problem, start, goal=min(limit, best.cost), known=known,
                                  without=null.best.cost, beside=beside)
            best = min(best, again, key=lambda best: best.cost)
        found = form._replace(best=best)
        # With a sub-step of its own, the cost of a fit is not yet known.
        own_substep = any(name == 'maximum_substep' for name, _ in form.problem.fixed)
        return (converged(found, limit, beside) if own_substep or _may_count(found, null)
                else found)

    # Of recordings far from explained, a rough fit was made to the end on a part. So it is known
    # well enough which are hopeless beside the best rough one; if that is, the best forms suffice.
    hopeless = leader.best.cost > FAR * most
    least = FAR * max(most, ranked[0].best.cost) if problem.is_far(base.best.cost) else math.inf
    remaining = [form for found in ranked
                 for form in ([found] if hopeless else forms[found.names])
                 if form is not ranked[0] and form.best.cost <= least]
    # Of the nominal model, the first screen was already made at fitted parameters.
    if base is not null and not hopeless:
        known = {(form.names, form.variants) for form in (*remaining, leader, *(
            form for form in rough if form.best.cost > least))}
        remaining += [form for form in _rivals(base, leader, tick)
                      if (form.names, form.variants) not in known]
    def keep(found: Found) -> None:
        # A rough fit was not corrected for the integration error: its cost is not comparable.
        earlier = fits.get(found.names)
        if never_slides(found):
            return
        if (earlier is None or earlier.best is best_forms.get(found.names)
                or found.criterion < earlier.criterion):
            fits[found.names] = found._replace(problem=replace(found.problem, pool=problem.pool))

    # One form of each effect first, the best if they were fitted roughly: the least cost that
    # these reach is the goal of further forms.
    first = {form.names: form for form in (*reversed(remaining), *ranked)}
    for further in (False, True):
        done = [leader]
        for found in problem.in_parallel(converged_fit, [
                form for form in remaining if (form is not first[form.names]) == further]):
            keep(found)
            if not never_slides(found):
                done.append(found)
            tick()
        reached = {found.names: found.best.cost for found in done}
        best = min(done, key=cost_of)
        most, beside = min(most, goal(best, null)), best.best.cost + COST_RANGE
    best = min(fits.values(), key=cost_of)
    for form in special_cases(best, [*rough, *remaining]):
        keep(from_values_of(best, form, most))
    return {names: found for names, found in fits.items() if found.best.cost < math.inf
            and (names == leader.names or _may_count(found, null)) and not never_slides(found)}


def _may_count(found: Found, null: Found) -> bool:
    """
    Return whether a fit with one more effect can have evidence beside the one without it.

    That is: its log posterior is higher, or its nominal parameters are more probable. These
    count for more where a model error leaves the data a smaller weight.
    """
    return (found.best.cost < null.best.cost - SLIGHT
            or found.prior_cost < null.prior_cost - SLIGHT)


def _rivals(base: Found, leader: Found, tick: Callable[[], None]) -> list[Found]:
    """
    Return the effects that may take the place of the leader's last one, as fits to begin with.

    By a linear screen at the leader's parameter values: at those of the base, errors of nominal
    parameters hide which effects look alike.
    """
    problem = replace(base.problem, group=leader.problem.group)
    fields, own = freed_fields(leader)
    theta = with_values_of(base, leader, fields - own)
    residual = problem.residual(theta)
    without = base._replace(problem=problem, best=Best(
        theta, problem.cost(theta, residual), residual))
    starts = screen(without, False, tick).best(RIVALS)
    thetas = problem.in_parallel(lambda start: start.nearest, starts)
    return [Found(tuple(sorted((*base.names, start.name))), (*base.variants, start.variant),
                  start.problem, Best(theta, math.inf, residual))
            for start, theta in zip(starts, thetas, strict=True)]
