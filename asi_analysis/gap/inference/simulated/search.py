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

from asi_analysis.gap.formulation import with_lower_floor
from asi_analysis.gap.inference.coloured_noise import coloured, with_noise_of_valve
from asi_analysis.gap.inference.hypotheses import Weighed
from asi_analysis.gap.inference.initial_guesses import initial_guesses
from asi_analysis.gap.inference.posterior import (
    GAIN_MARGIN,
    ODDS_AGAINST,
    most_probable,
)
from asi_analysis.gap.inference.probability import Names
from asi_analysis.gap.inference.simulated.behind_valve import (
    behind_valve,
    gain_is_off,
    with_free_gain,
)
from asi_analysis.gap.inference.simulated.evidence import STEPS
from asi_analysis.gap.inference.simulated.explained import most_probable_of, weighed_of
from asi_analysis.gap.inference.simulated.fits import (
    converged,
    hides_an_effect,
    rough_null_fit,
    to_the_end,
    with_noise_from_fit,
    with_noise_left,
    with_start_of_fit,
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
    cost_of,
)
from asi_analysis.gap.inference.simulated.one_more_effect import (
    ROUGH_FITS,
    Goal,
    around,
    best_of,
    extended,
    refitted_from_larger,
)
from asi_analysis.gap.inference.simulated.screen import Screened, Start, screen
from asi_analysis.gap.inference.simulated.special_cases import alone_of
from asi_analysis.gap.inference.simulated.uneven_delay import with_uneven_delay
from asi_analysis.gap.model.effects import Effects
from asi_analysis.gap.model.group import Group, channels_of
from asi_analysis.parallel import in_threads


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
        singles = around(only, null.at_nominal, null, tick, goal)
    else:
        if not null.unexplained:
            singles = extended(null, null, tick, goal)
        # Errors of nominal parameters hide an effect: then the screen starts from usual ones.
        if hidden:
            singles = best_of(singles, extended(_beside(null), null, tick, goal))
    return {(): refitted_from_larger(null, list(singles.values()))} | singles


def changed_alone(null: Found, tick: Callable[[], None]) -> list[Found]:
    """
    Return the effects that explain the recordings beside the nominal values of all else.

    Nothing can be much more probable: only noise is left, and no nominal parameter is off.
    """
    null = _with_own_guesses(null)
    problem, theta = null.problem, null.problem.nominal
    values, base = problem.record(theta), null.moved(problem, theta)

    def fitted_alone(start: Start) -> Found:
        count = len(start.variant.free)
        own = replace(start.problem, free=start.variant.free, fixed=(
            *start.problem.fixed, *((free.field, float(values[free.field]))
                                    for free in start.problem.free[:-count])))
        best = most_probable(own, start.theta[-count:], goal=null.largest_cost)
        found = converged(Found((start.name,), (start.variant,), own, best), null.largest_cost)
        substep = float(found.problem.record(found.best.theta)['maximum_substep'])
        whole = replace(start.problem, group=found.problem.group, fixed=(
            *start.problem.fixed, ('maximum_substep', substep)))
        return found.moved(whole, np.append(start.theta[:-count], found.best.theta))

    fits = in_threads(fitted_alone, screen(base, False, tick).best(ROUGH_FITS))
    return [each for each in fits if each.best.cost < math.inf and not each.unexplained]


def _with_own_guesses(found: Found) -> Found:
    """
    Return a fit with the initial guesses of one more effect that its own residual gives.

    Other fits keep theirs, as these are the units of what they have fitted.
    """
    problem, used = found.problem, {free.scale for free in found.problem.free}
    guesses = {name: value for name, value in initial_guesses(found.as_fitted).items()
               if name not in used}
    return found._replace(problem=replace(problem, group=replace(
        problem.group, scale=problem.group.scale | guesses)))


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
    elif _may_be_of_other_laws(found):
        other = in_formulation(with_noise_from_fit(found), True)
        if _one_is_enough(other):
            return other
    pairs = with_pairs(found, tick, alone)
    if pairs is found or not (alone or _only_noise_left(pairs)):
        return pairs
    return in_best_formulation(with_noise_from_fit(pairs), found)


def _may_be_of_other_laws(found: Mapping[Names, Found]) -> bool:
    """
    Return whether laws formulated in another way may explain what follows a valve.

    Not of the valve itself: no formulation leaves the steps of a converter, which may be a second
    effect although the first one is enough.
    """
    group = found[()].problem.group
    return ('valve' not in group.channels and group.measures_valve and not group.floor_measured
            and not all(each.far for each in found.values()))


def with_pairs(found: dict[Names, Found], tick: Callable[[], None], alone: bool
               ) -> dict[Names, Found]:
    """
    Return hypotheses of single effects, and pairs where a second effect may be needed.

    That is where each of the single ones leaves more than noise; or where the noise that the best
    one leaves may hide another effect. alone: as in `explained_by_simulator`.
    """
    singles = [each for names, each in found.items() if names]
    if not singles or not found[()].may_lack_an_effect:
        return found
    enough = [each for each in singles if not each.may_lack_an_effect]
    if enough:
        return _with_hidden(found, min(enough, key=cost_of), tick, goal_of(alone))
    first = _with_own_guesses(min(singles, key=cost_of))
    screened = screen(first, not first.unexplained, tick)
    promised = screened.most
    # Without another model, an effect may be named although a residual is left.
    if promised < ODDS_AGAINST or not (alone or first.cost_beyond < GAIN_MARGIN * promised):
        return found
    return with_noise_left(best_of(found, _pairs(
        found[()], first, screened, tick, goal_of(alone))))


def _with_hidden(found: dict[Names, Found], first: Found, tick: Callable[[], None], goal: Goal
                 ) -> dict[Names, Found]:
    """Return hypotheses, with pairs of the best effect and one hidden in the noise it leaves."""
    group = first.problem.group
    hidden = _hidden_effects(first)
    first = _with_own_guesses(of_effects(first, hidden)) if hidden else first
    screened = screen(first, True, tick) if hidden else None
    if screened is None or screened.most < ODDS_AGAINST:
        return found
    pairs = {names: of_effects(each, group.effects) for names, each in _with_second(
        first, screened, tick, goal).items()}
    if min(map(cost_of, pairs.values())) > first.best.cost - ODDS_AGAINST:
        return found
    return with_noise_left(best_of(found, pairs))


def _hidden_effects(found: Found) -> Effects:
    """
    Return those effects that may be hidden in what a fit leaves as noise.

    Any effect, if that noise was estimated from such a residual, or if no other formulation of a
    law would leave as much. Else only the steps of a converter, which no formulation leaves.
    """
    group = found.problem.group
    any_may = coloured(group) or not group.may_differ
    return {name: forms for name, forms in group.effects.items()
            if name not in found.names and (any_may or name == STEPS)
            and any(channels_of(form, group) for form in forms)}


def of_effects(found: Found, effects: Effects) -> Found:
    """Return a fit to which only these effects can be added."""
    return found._replace(problem=replace(found.problem, group=replace(
        found.problem.group, effects=effects)))


def _one_is_enough(found: Mapping[Names, Found]) -> bool:
    """Return whether a hypothesis leaves only noise, with probable nominal parameters."""
    return not all(each.may_lack_an_effect for each in found.values())


def _only_noise_left(found: Mapping[Names, Found]) -> bool:
    """Return whether one of the hypotheses explains the recordings."""
    return not all(each.unexplained for each in found.values())


def _pairs(null: Found, first: Found, screened: Screened, tick: Callable[[], None], goal: Goal
           ) -> dict[Names, Found]:
    """
    Return the fits of pairs that hold the best single effect, or the other one of its best pair.

    The best single effect need not be one of the true two, since it may imitate both. screened:
    the screen at its fit.
    """
    pairs = _with_second(first, screened, tick, goal)
    best = min(pairs.values(), key=cost_of)
    if best.names == first.names or not pairs[first.names].may_lack_an_effect:
        return pairs
    second = _with_own_guesses(alone_of(null, best, best.variants[-1]))
    beside = goal_beside(best)   # what cannot reach it does not count
    pairs = best_of(pairs, _with_second(
        second, screen(second, not second.unexplained, tick), tick,
        lambda leader, base: min(goal(leader, base), beside)))
    third = min(pairs.values(), key=cost_of)
    if third is best or len(third.names) < 2:
        return pairs
    # Beside the second effect a third one is the best, which alone may explain as much.
    alone = alone_of(null, third, third.variants[-1])
    return best_of(pairs, {alone.names: alone})


def _with_second(first: Found, screened: Screened, tick: Callable[[], None], goal: Goal
                 ) -> dict[Names, Found]:
    """
    Return a single effect, refitted from its pairs where that helps, and these pairs.

    screened: the screen at its fit, which shows what usual nominal parameters may hide.
    """
    pairs = extended(_beside(first), first, tick, goal, screened)
    return {first.names: refitted_from_larger(first, list(pairs.values()))} | pairs
