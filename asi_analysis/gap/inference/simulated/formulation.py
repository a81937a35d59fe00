"""Judge whether a machine obeys the simulator's own laws, or laws formulated in another way."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from types import MappingProxyType

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.gap.formulation import (
    with_formulation,
    with_tolerance_of_formulation,
    with_usual_shapes,
)
from asi_analysis.gap.inference.posterior import (
    FAR,
    GAIN,
    ODDS_AGAINST,
    mean_squares,
    most_probable,
)
from asi_analysis.gap.inference.probability import Names
from asi_analysis.gap.inference.simulated.evidence import (
    STEPS,
    equal_below,
    with_improbable_named,
    without_evident_steps,
)
from asi_analysis.gap.inference.simulated.fits import converged
from asi_analysis.gap.inference.simulated.found import (
    COST_RANGE,
    Found,
    at_values_of,
    changed,
    cost_of,
    freed_fields,
    nearest_to_nominal,
)

NONE: Mapping[Names, Found] = MappingProxyType({})
# A fit competes with the best as long as its model error is larger by at most this multiple.
EXCESS_RANGE = 2.0
STARTING_RIVALS = 3   # from whose values the nominal model is fitted again
# Negative log prior of the nominal parameters above which their errors may stand for an effect.
SUSPECT_PRIOR_COST = 3.0


def in_best_formulation(found: Mapping[Names, Found],
                        known: Mapping[Names, Found] = NONE) -> dict[Names, Found]:
    """
    Return hypotheses with the error floor of the simulator's own laws, or of another formulation.

    known: what an earlier call returned, which is not refitted in the same formulation.

    The laws are the simulator's own if a hypothesis with at most one effect, or one improbable
    nominal parameter, leaves only noise, and the best one needs no other shape parameters of the
    laws; or the nominal model is far from explaining the recordings, whatever the shapes, or only
    the steps of a converter explain them: that is not their fault. With a baseline, the error
    floor is measured and kept.
    """
    if next(iter(found.values())).problem.group.floor_measured:
        return dict(found)
    own = {names: _with_formulation(each, False) for names, each in found.items()}
    null, best = own[()], min(own.values(), key=cost_of)
    steps_explain = not best.may_lack_an_effect and without_evident_steps(own) is not None
    other = not any(map(_explains_with_one, own.values())) or not (
        null.problem.is_far(null.best.cost) or STEPS in best.names and steps_explain
        or not _needs_other_shapes(best))
    return in_formulation(found, other, known)


def _explains_with_one(found: Found) -> bool:
    """
    Return whether a hypothesis explains the recordings with one effect or parameter at most.

    And the steps of a converter, which no formulation of a law leaves.
    """
    parameters = (each for each in with_improbable_named(found, ODDS_AGAINST)
                  if len(each.variants[-1].free) < 2)
    return any(len({*each.names} - {STEPS}) < 2 and not each.may_lack_an_effect
               for each in (found, *parameters))


def _with_formulation(found: Found, other: bool) -> Found:
    """
    Return a hypothesis, not refitted, with the error floor and tolerances of its formulation.

    other: whether the laws are formulated in another way than the simulator's.
    """
    group = with_formulation(found.problem.group, other)
    free = with_tolerance_of_formulation(found.problem.free, found.problem.group, group)
    moved = found.weighed_as(replace(found.problem, group=group, free=free))
    return _with_other_shapes(moved) if group.other_formulation else moved


def _with_other_shapes(found: Found) -> Found:
    """Return a hypothesis in which further shapes of the laws are free, at their best start."""
    problem, best = found.problem, found.best
    known = {free.field for free in problem.free} | dict(problem.fixed).keys()
    more = [free for free in problem.group.other_shapes if free.field not in known]
    if not more:
        return found
    problem = replace(problem, free=(*problem.free, *more), group=replace(
        problem.group, nuisance=(*problem.group.nuisance, *more)))
    begun = (np.append(best.theta, [problem.parameter(free).share(value) for free, value
                                    in zip(more, values, strict=True)])
             for values in product(*(free.starts for free in more)))
    return found.moved(problem, min(begun, key=problem.cost))


def in_formulation(found: Mapping[Names, Found], other: bool,
                   known: Mapping[Names, Found] = NONE) -> dict[Names, Found]:
    """
    Return hypotheses with the error floor of that formulation; refitted if it changed.

    If the nominal model suffices in another formulation, and no steps of a converter show, which
    no formulation leaves, it alone is returned.
    """
    moved = {names: _with_formulation(each, other) for names, each in found.items()}
    if next(iter(found.values())).problem.group.other_formulation != other:
        if other:
            group = moved[()].problem.group
            enough = np.ones(len(group.channels)) if group.may_differ else equal_below(
                min(moved.values(), key=cost_of))
            moved[()], plain = _sufficient(moved[()], enough)
            if plain is not None and without_evident_steps(found) is None:
                return {(): plain}
        moved = _refitted(moved)
    if not other:
        return moved
    best = min(moved.values(), key=cost_of)
    equal = equal_below(best)

    def nearest(each: Found) -> Found:
        new = found[each.names] is not known.get(each.names)
        near = not each.names or each.best.cost < best.best.cost + COST_RANGE
        return nearest_to_nominal(each, equal) if new and near else each

    return changed(moved, nearest)


def sufficient(null: Found) -> Found | None:
    """Return the nominal model with laws formulated in another way, refitted, if it suffices."""
    group = null.problem.group
    if not group.may_differ or group.floor_measured:
        return None
    return _sufficient(_with_formulation(null, True), np.ones(len(group.channels)))[1]


def _sufficient(null: Found, enough: Array) -> tuple[Found, Found | None]:
    """
    Return the nominal model, refitted; and its fit if no effect can have evidence beside it.

    That is so if it leaves as little as is no evidence, with probable parameters; perhaps they are
    so only nearer to the nominal values. enough: that mean square by channel, in error floors.
    """
    null = null.refined(goal=FAR * float(enough.max()) * null.problem.noise_cost)
    if (mean_squares(null.problem, null.best.residual) > enough).any():
        return null, None
    near = null if null.prior_cost <= SUSPECT_PRIOR_COST else nearest_to_nominal(null, enough)
    return null, near if near.prior_cost <= SUSPECT_PRIOR_COST else None


def _refitted(found: Mapping[Names, Found]) -> dict[Names, Found]:
    """
    Return hypotheses, refitted; those that do not compete with the best are given up.

    The best one first. Last the nominal model, from the values of its rivals too: shapes of the
    laws that their fits have found may make the effects unnecessary.
    """
    best = min(found.values(), key=cost_of)
    leader = best.refined()
    goal, beside = goal_beside(leader), leader.best.cost + COST_RANGE
    refitted = changed(found, lambda each: leader if each is best else each.refined(
        goal=goal, beside=beside))
    return {**refitted, (): _least_from(refitted[()], sorted(
        (each for names, each in refitted.items() if names), key=cost_of)[:STARTING_RIVALS])}


def _least_from(null: Found, rivals: Sequence[Found]) -> Found:
    """Return the nominal model, refitted from the values of rivals where that costs less."""
    for rival in rivals:
        if rival.best.cost < null.best.cost - GAIN:
            fields, own = freed_fields(rival)
            start = min((at_values_of(null, rival, given) for given in (fields - own, fields)),
                        key=cost_of)
            # The start was simulated with another correction of the integration error.
            null = min(null, converged(start.refined(goal=null.best.cost)), key=cost_of)
    return null


def goal_beside(leader: Found) -> float:
    """Return the cost that a fit must reach to compete with the best one."""
    return (leader.best.cost + COST_RANGE
            + EXCESS_RANGE * max(leader.best.cost - leader.problem.noise_cost, 0.0))


def _needs_other_shapes(found: Found) -> bool:
    """Return whether the simulator's own shapes of the laws, refitted, fit far worse."""
    group, free = found.problem.group, with_usual_shapes(found.problem.group, found.problem.free)
    if free == found.problem.free:
        return False
    values, problem = found.problem.record(found.best.theta), replace(found.problem, free=free)
    theta = np.array([problem.parameter(each).share(float(
        (values if each in found.problem.free else group.nominal)[each.field])) for each in free])
    goal = found.best.cost + COST_RANGE
    return problem.cost(theta) > goal and most_probable(problem, theta, goal=goal).cost > goal
