"""
Fits of the simulator: of the nominal model, corrected for the sub-step, with the noise they leave.

That of the nominal model is of its uncertain parameters, shapes of laws and initial states.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.gap.inference.coloured_noise import with_coloured_noise
from asi_analysis.gap.inference.posterior import (
    FAR,
    LIGHT_ROUNDS,
    ODDS_AGAINST,
    ROUGHLY,
    ROUNDS,
    Posterior,
    mean_squares,
    most_probable,
)
from asi_analysis.gap.inference.probability import Names
from asi_analysis.gap.inference.simulated.found import (
    COST_RANGE,
    Found,
    at_values_of,
    changed,
    cost_of,
    freed_fields,
)
from asi_analysis.gap.model.effects import DOTTED, PARAMETER, Effects, Free, Variant
from asi_analysis.gap.model.group import (
    Group,
    Values,
    recorrected,
    with_fitted_start,
    with_lower_noise,
)
from asi_analysis.gap.model.simulator import (
    FINAL_ERROR,
    VALVE_ERROR,
    different_substeps,
    with_corrections,
)
from asi_analysis.gap.model.start import SEAL

# The integration error of a long sub-step is corrected again after each fit: at most so often, and
# until that changes the log posterior by less than SETTLED, or by less than a share of what noise
# does not explain.
CORRECTIONS, SETTLED, SETTLED_SHARE = 4, 2.0, 0.01
# Of the weight of the data, for a fit with usual parameters: the factor of each next fit, and the
# smallest one.
LIGHTER, LEAST_SHARE = 0.125, 1e-6
SEAL_STARTS = (0.15, 0.85)   # initial guesses of the seals' deflection, as shares of its range


def converged(found: Found, goal: float = math.inf, beside: float = math.inf) -> Found:
    """
    Return a fit that shorter sub-steps of the simulation would not change.

    The integration error of the sub-step is corrected at the fitted parameters, again after each
    fit, and the best fit is kept. If that does not converge, a shorter sub-step is used. goal: a
    negative log posterior; a fit that cannot reach it is given up. beside: one with which
    a fit hardly counts; above that it is found roughly.
    """
    known: list[Found] = []
    change, left = 0.0, 0.0
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
        cost = known[-1].best.cost
        left = (SETTLED_SHARE * max(cost - found.largest_cost, 0.0)
                + ROUGHLY * max(cost - beside, 0.0))
        if abs(change) < SETTLED + left or len(known) == CORRECTIONS:
            break
        found = known[-1].refined(goal=goal, beside=beside)
    if not known:
        return found
    found = min(known, key=cost_of)
    if abs(change) < COST_RANGE + left:
        return found
    group, p = found.problem.group, found.problem.record(found.best.theta)
    shorter = next((each for each in different_substeps(group.recordings)
                    if group.exact_substep_s < each < p['maximum_substep']),
                   group.exact_substep_s)
    problem = replace(found.problem, fixed=(*found.problem.fixed, ('maximum_substep', shorter)))
    problem = replace(problem, group=recorrected(group, problem.record(found.best.theta)))
    return converged(found._replace(problem=problem, best=most_probable(
        problem, found.best.theta, goal=goal, beside=beside)), goal, beside)


def with_fine_substeps(found: Mapping[Names, Found]) -> dict[Names, Found]:
    """
    Return hypotheses; those that compete are refitted with sub-steps that need no correction.

    The correction of a longer one holds at the fitted parameters, not beside them: where it
    changes fast with a parameter, as the frequency of a resonance, a fit ends off its optimum.
    """
    least = min(each.best.cost for each in found.values())

    def again(each: Found) -> Found:
        group, p = each.problem.group, each.problem.record(each.best.theta)
        recordings, substep = with_corrections(
            group.recordings, group.channels, p, group.error_floor, group.exact_substep_s,
            FINAL_ERROR)
        if substep >= p['maximum_substep']:
            return each
        fixed = dict(each.problem.fixed) | {'maximum_substep': substep}
        problem = replace(each.problem, fixed=tuple(fixed.items()),
                          group=replace(group, recordings=recordings))
        return each._replace(problem=problem).at(each.best.theta).refined()

    return changed(found, lambda each: again(each)
                   if each.best.cost < least + COST_RANGE else each)


def with_noise_left(found: Mapping[Names, Found]) -> dict[Names, Found]:
    """Return hypotheses with the residual of the best as noise, where it is noise, but more."""
    best = min(found.values(), key=cost_of)
    louder = with_coloured_noise(best.problem.group, best.problem.record(best.best.theta))
    if louder is best.problem.group:
        return dict(found)

    def problem_of(each: Found) -> Posterior:
        own = each.problem.group
        recordings = [replace(r, noise=heard.noise, colour=heard.colour)
                      for r, heard in zip(own.recordings, louder.recordings, strict=True)]
        return replace(each.problem, group=replace(
            own, noise=louder.noise, error_floor=louder.error_floor, recordings=recordings))

    if _colour(louder) == _colour(best.problem.group):
        return {names: each.weighed_as(problem_of(each)) for names, each in found.items()}
    leader = refitted_as(best, problem_of(best))
    goal = leader.best.cost + COST_RANGE
    return changed(found, lambda each: leader if each is best else refitted_as(
        each, problem_of(each), goal))


def refitted_as(found: Found, problem: Posterior, goal: float = math.inf) -> Found:
    """Return a hypothesis, refitted as another problem of the same parameters."""
    return found.moved(problem, found.best.theta).refined(goal=goal)


def _colour(group: Group) -> list[dict[str, tuple[float, ...]]]:
    """Return what the errors of a group's recordings are made white with."""
    return [recording.colour for recording in group.recordings]


def with_noise_from_fit(found: Mapping[Names, Found],
                        lowered: Callable[[Group, Values], Group] = with_lower_noise
                        ) -> dict[Names, Found]:
    """
    Return hypotheses with the residual of the best one as the noise, if that is far smaller.

    Oscillations above the band of a motion were counted as noise in it. lowered: how a group is
    changed by that residual.
    """
    best = min(found.values(), key=cost_of)
    leader = best
    while True:   # the best one first: the others are only compared with what it ends with
        group, level = leader.problem.group, mean_squares(leader.problem, leader.best.residual)
        quieter = lowered(group, {channel: float(share) * group.error_floor[channel]
                                  for channel, share in zip(group.channels, level, strict=True)})
        if quieter is group:
            break
        leader = leader.weighed_as(replace(leader.problem, group=quieter))
        leader = converged(min(_with_nominal(leader), key=cost_of).refined())
    if leader is best:
        return dict(found)
    goal = leader.best.cost + COST_RANGE

    def quiet(each: Found) -> Found:
        same = replace(each.problem.group, noise=group.noise, error_floor=group.error_floor)
        weighed = each.weighed_as(replace(each.problem, group=same))
        # One that is part of the best must not be given up at values from before.
        start = min(*_with_nominal(weighed),
                    at_values_of(weighed, leader, freed_fields(leader)[0]), key=cost_of)
        if (each.problem.is_far(each.best.cost) and start.problem.is_far(start.best.cost)
                and not leader.problem.is_far(leader.best.cost)):
            return start   # it does not even explain what is above the larger noise
        return converged(start.refined(goal=goal), goal)

    return with_noise_from_fit(changed(
        found, lambda each: leader if each is best else quiet(each)), lowered)


def _with_nominal(found: Found) -> tuple[Found, Found]:
    """Return a fit, and that at nominal values, which it may have left for a larger noise."""
    problem, (_, precision) = found.problem, found.problem.prior
    group = problem.group
    shapes = [free in (*group.shapes, *group.other_shapes) for free in problem.free]
    theta = np.where((precision > 0.0) | shapes, problem.nominal, found.best.theta)
    group = recorrected(problem.group, problem.record(theta))
    return found, found.moved(replace(problem, group=group), theta)


def with_usual_parameters(found: Found) -> Found:
    """
    Return a hypothesis with nominal parameters as probable as usual, so that more is left.

    The data get less and less weight, down to LEAST_SHARE. Where improbable parameters hide an
    effect, it shows there, and the residual is smaller than with the nominal values.
    """
    share = 1.0
    while found.improbable and share * LIGHTER > LEAST_SHARE:
        share *= LIGHTER
        found = found.lighter(share, LIGHT_ROUNDS)
    return found


def from_usual_parameters(found: Found) -> Found:
    """
    Return a fit, repeated from usual nominal parameters if those found are improbable.

    Where they act alike, a fit may stop in their valley, far from its lowest point.
    """
    usual = with_usual_parameters(found)
    if usual is found:
        return found
    again = usual._replace(best=usual.best._replace(slopes=None)).refined()
    return min(found, converged(again), key=cost_of)


def null_fit(group: Group) -> Found:
    """Return the fit of the nominal model: of its uncertain parameters and initial states."""
    return with_start_of_fit(to_the_end(rough_null_fit(group)))


def rough_null_fit(group: Group) -> Found:
    """Return `null_fit`, roughly converged."""
    group = replace(group, effects=group.effects | parameter_errors(group),
                    scale=dict(group.scale))
    problem = Posterior(group, group.nuisance)
    first = min((most_probable(problem, start, rounds=2) for start in _start_guesses(problem)),
                key=lambda best: best.cost)
    return Found((), (), problem, most_probable(
        problem, first.theta, rounds=2 * ROUNDS, converged=ROUGHLY, near=first))


def to_the_end(null: Found) -> Found:
    """Return a rough fit of the nominal model, converged unless it explains nothing anyway."""
    if null.best.cost >= FAR * null.largest_cost:
        return null
    return converged(null._replace(best=most_probable(
        null.problem, null.best.theta, rounds=2 * ROUNDS, converged=0.0, near=null.best)))


def with_start_of_fit(null: Found) -> Found:
    """Return a fit from which on recordings that start in motion have its initial states."""
    return null._replace(best=null.best._replace(slopes=None), problem=replace(
        null.problem, group=with_fitted_start(
            null.problem.group, null.problem.record(null.best.theta))))


def hides_an_effect(null: Found) -> bool:
    """Return whether the nominal model leaves a residual, or its parameters are improbable."""
    return null.unexplained or null.prior_cost > ODDS_AGAINST


def _start_guesses(problem: Posterior) -> Iterator[Array]:
    """Yield nominal parameters, with guesses of the shapes of laws and of initial states."""
    mean = problem.nominal
    yield mean
    started = [n for n, free in enumerate(problem.free) if free.scale != 'nominal'
               and not free.field.startswith(VALVE_ERROR)]
    if not started:
        return
    alone = replace(problem, free=tuple(problem.free[n] for n in started))
    begun = mean.copy()
    begun[started] = most_probable(alone, alone.prior[0]).theta
    yield begun
    seals = [n for n in started if problem.free[n].field.startswith(SEAL)]
    for share in SEAL_STARTS if seals else ():
        begun = mean.copy()
        begun[seals] = share
        yield begun


def parameter_errors(group: Group) -> Effects:
    """Return the hypotheses that a nominal parameter is beyond its tolerance."""
    held = {free.field for forms in group.effects.values() for form in forms
            for free in form.free if free.scale == 'nominal'}
    return {PARAMETER + DOTTED[free.field]: (Variant((
        Free(free.field, 0.1, 10.0, (0.5, 0.7, 1.5, 2.2), 'nominal'),)),)
        for free in group.nuisance
        if free.prior < math.inf and free.scale == 'nominal' and free.field not in held}
