"""
Fits of a hypothesis with one more effect: the best of the linear screen, and their rivals.

Rough fits first, on a part of the recordings if these are far from explained; then the best one to
the end; then the next best, and what may take its place. What cannot reach the goal is given up.
"""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace

from asi_analysis.arrays import Array
from asi_analysis.gap.inference.posterior import (
    FAR,
    GAIN,
    NONE,
    ODDS_AGAINST,
    ROUNDS,
    SLIGHT,
    Best,
    most_probable,
    of_first_part,
)
from asi_analysis.gap.inference.probability import Names
from asi_analysis.gap.inference.simulated.fits import converged, from_usual_parameters
from asi_analysis.gap.inference.simulated.found import (
    COST_RANGE,
    Found,
    at_values_of,
    cost_of,
    freed_fields,
    with_values_of,
)
from asi_analysis.gap.inference.simulated.screen import Screened, Start, screen
from asi_analysis.gap.inference.simulated.special_cases import (
    from_values_of,
    never_slides,
    special_cases,
)
from asi_analysis.parallel import in_threads

# The cost that a fit must reach beside the best one, of the same base, and the nominal model.
Goal = Callable[[Found, Found], float]

# After the linear screen so many effects are fitted roughly, with so many Jacobians; and so many
# of them, beside the best, until convergence.
ROUGH_FITS, ROUGH_ROUNDS, FULL_FITS = 7, 1, 3
RIVALS = 7   # effects that are fitted in place of that of the best fit


def best_of(found: Mapping[Names, Found], more: Mapping[Names, Found]) -> dict[Names, Found]:
    """Return the union of two sets of fits; of a hypothesis in both, the better form."""
    return {**found, **{names: each for names, each in more.items()
                        if names not in found or each.criterion < found[names].criterion}}


def refitted_from_larger(base: Found, more: Sequence[Found]) -> Found:
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


def extended(base: Found, null: Found, tick: Callable[[], None], goal: Goal,
             at_null: Screened | None = None) -> dict[Names, Found]:
    """
    Return the fits of `base` with one more effect: the best of the linear screen.

    base: a fit of the nominal model or of one effect, or the same with the nominal parameter
    values; null: its fit. If that is the base, nothing is fitted unless the screen expects more
    from an effect than the prior odds against it. goal: what cannot reach it is given up.
    at_null: the screen at the fit, whose best effects are fitted in addition.
    """
    problem = base.problem
    if base is null and base.best.cost < ODDS_AGAINST:
        return {}
    screened = screen(base, base is null and not null.unexplained, tick)
    if base is null and screened.most < ODDS_AGAINST:
        return {}

    far = problem.is_far(base.best.cost)

    starts = [(start, screened.slopes) for start in screened.best(ROUGH_FITS)]
    if at_null is not None:
        names = {start.name for start, _ in starts}
        starts += [(start, at_null.slopes) for start in at_null.best(FULL_FITS)
                   if start.name not in names]

    def hypothesis(start: Start) -> Names:
        return tuple(sorted((*base.names, start.name)))

    def rough(of: tuple[Start, Mapping[str, Array]]) -> Found:
        start, slopes = of
        own = start.variant.fields
        begun = Found(hypothesis(start), (*base.variants, start.variant), start.problem,
                      base.best._replace(slopes=None))
        if far:
            # The first part of the recordings shows well enough which effect it is, or nothing.
            thetas = of_first_part(start.problem, start.theta).theta, start.nearest
            return min(map(begun.at, thetas), key=cost_of)
        best = most_probable(start.problem, start.nearest, ROUGH_ROUNDS, {
            field: column for field, column in slopes.items() if field not in own})
        return begun._replace(best=best._replace(slopes=None))

    forms = []
    for found in in_threads(rough, starts):
        if found.best.cost < math.inf:
            forms.append(found)
        tick()
    return around(forms, base, null, tick, goal, screened.slopes, {
        hypothesis(start) for start, slopes in starts if slopes is not screened.slopes})


def around(rough: Sequence[Found], base: Found, null: Found, tick: Callable[[], None],
           goal: Goal, at_base: Mapping[str, Array] = NONE, added: Collection[Names] = ()
           ) -> dict[Names, Found]:
    """
    Return the fits of `base` with one more effect, from rough fits of it in several forms.

    The best is fitted first; then the next best, and effects that may take its place. at_base:
    columns of the Jacobian, by field, from which the rough fits were made, but for those of the
    hypotheses that a second screen has added; these take no places of others. Else as `extended`.
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
    ranked = sorted(fits.values(), key=cost_of)[:1 + FULL_FITS + len(added)]
    leader = from_usual_parameters(converged(ranked[0].refined(2 * ROUNDS)))
    if never_slides(leader):
        return around([form for form in rough if form is not ranked[0]], base, null, tick, goal,
                      at_base, added)
    best_forms = {names: found.best for names, found in fits.items()}
    fits[leader.names] = leader
    fields, own = freed_fields(leader)
    # If the leader leaves more than noise, another effect must gain much: that is seen without
    # computing the whole Jacobian again.
    at_leader: Mapping[str, Array] = leader.problem.columns(leader.slopes)
    most, beside = goal(leader, null), leader.best.cost + COST_RANGE
    reached: dict[Names, float] = {}   # by a form of each effect

    def converged_fit(form: Found) -> Found:
        # The integration error is corrected as for the leader.
        form = form._replace(problem=replace(form.problem, group=leader.problem.group))
        shared = [with_values_of(form, leader, names) for names in (fields - own, fields)]
        of_effect = freed_fields(form)[1]
        if of_effect & own:   # of the same law, of which the leader may have a special case
            shared.append(with_values_of(form, leader, freed_fields(form)[0]))
        if all(free.scale == 'nominal' for free in form.variants[-1].free):
            shared.append(with_values_of(form, null, freed_fields(form)[0]))
        starts = [(min(shared, key=form.problem.cost), at_leader)]
        # Where there is much to explain, the leader's parameter values may be a bad start.
        if null.may_lack_an_effect and form.best is best_forms.get(form.names):
            starts.append((form.best.theta, NONE if form.names in added else at_base))
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
            fits[found.names] = found

    # One form of each effect first, the best if they were fitted roughly: the least cost that
    # these reach is the goal of further forms.
    first = {form.names: form for form in (*reversed(remaining), *ranked)}
    for further in (False, True):
        done = [leader]
        for found in in_threads(converged_fit, [
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
    thetas = in_threads(lambda start: start.nearest, starts)
    return [Found(tuple(sorted((*base.names, start.name))), (*base.variants, start.variant),
                  start.problem, Best(theta, math.inf, residual))
            for start, theta in zip(starts, thetas, strict=True)]
