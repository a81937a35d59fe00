"""A fit with a nominal parameter beyond its tolerance has one more cause: that parameter."""

import math
from dataclasses import replace

import numpy as np

from asi_analysis.gap.formulation import TOLERANCE_FACTOR, is_of_law
from asi_analysis.gap.inference.fit import Fitted
from asi_analysis.gap.inference.hypotheses import Candidate, Weighed
from asi_analysis.gap.inference.posterior import Posterior, fitted, most_probable
from asi_analysis.gap.inference.probability import Names
from asi_analysis.gap.inference.uncertainty import Likelihood, interval, likelihood
from asi_analysis.gap.model.effects import UNKNOWN, Effect, Variant, without_prior
from asi_analysis.gap.model.group import Group

MOST_PARAMETERS = 2   # beyond their tolerance, to be named as the cause; more: `unknown`
LEAST_PROBABILITY = 0.01   # of a hypothesis that is judged
# Probability that the laws are the simulator's own, if the noise would hide another formulation.
# With others, a value just beyond the tolerance may be due to them.
OWN_LAWS = 0.6
# Probability that a parameter which may be within TOLERANCE_FACTOR tolerances is meant, and not
# other laws, or (linear nominal models, where it is exact) a gain of the sensor within its own.
AT_EDGE = 0.4


def with_parameters_named(weighed: Weighed) -> Weighed:
    """
    Return a group whose hypotheses keep all other parameters within their tolerances.

    Normal priors let a fit leave them. If the 95 % interval of a nominal parameter lies beyond its
    tolerance, that fit and its probability belong to the hypothesis with this parameter, as far as
    the laws are the simulator's own; how far it is off says the fit without its prior. If the
    nominal model takes more than MOST_PARAMETERS of them, the cause is `unknown`.
    """
    group = weighed.group
    shown = any(group.other_error[channel] > group.error_floor[channel]
                for channel in group.channels)
    # Then all else that could be meant is free within its own tolerance.
    own_laws = group.may_differ and shown and not group.other_formulation
    chance, candidates = dict(weighed.probability), dict(weighed.candidates)
    for names, candidate in weighed.candidates.items():
        if weighed.probability[names] < LEAST_PROBABILITY:
            continue
        more = _beyond(weighed, names)
        if not more:
            continue
        richer: Names = tuple(sorted({*names, *more}))
        freed = candidates.get(richer) or _freed(candidate, richer, tuple(more.values()))
        if len(more) <= MOST_PARAMETERS:
            candidates[richer] = freed
        elif names:
            continue
        else:
            richer = (UNKNOWN,)
        share = OWN_LAWS if group.may_differ and not shown else 1.0
        if not own_laws and not _is_surely_beyond(freed, candidate):
            share = AT_EDGE
        moved = share * weighed.probability[names]
        chance[richer] = chance.get(richer, 0.0) + moved
        chance[names] -= moved
    return weighed._replace(candidates=candidates, probability=chance)


def _freed(candidate: Candidate, names: Names, more: tuple[Variant, ...]) -> Candidate:
    """
    Return a hypothesis with further effects, fitted again: their parameters have no prior now.

    Also from nominal values of the others, which took up what the prior kept from the parameter.
    """
    before = candidate.fitted.problem
    assert isinstance(before, Posterior)
    problem = replace(before, free=without_prior(before.free, more))
    theta, (_, precision) = candidate.fitted.theta, problem.prior
    usual = np.where(precision > 0.0, problem.nominal, theta)
    best = min((most_probable(problem, start) for start in (theta, usual)),
               key=lambda each: each.cost)
    return Candidate(names, (*candidate.variants, *more), fitted(problem, best))


def _beyond(weighed: Weighed, names: Names) -> dict[str, Variant]:
    """Return the effects of parameters beyond their tolerance, and their forms."""
    group, candidate = weighed.group, weighed.candidates[names]
    fit, found = candidate.fitted, dict[str, Variant]()
    own = {free.field for variant in candidate.variants for free in variant.free}
    # Of laws formulated in another way, a parameter means something slightly different.
    others = group.other_formulation and group.may_differ
    suspects = [free for free in fit.free if free.field in fit.at_limit.keys() - own
                and not (others and is_of_law(free, group))]
    if not suspects:
        return found
    known = likelihood(fit)
    for free in suspects:
        if _is_beyond(fit, known, free.field, free.prior):
            effect, variant = form_of(group, free.field)
            if effect.name not in names:
                found[effect.name] = variant
    return found


def _is_surely_beyond(freed: Candidate, before: Candidate) -> bool:
    """Return whether parameters have lost their prior, and are far beyond the tolerance of it."""
    fit, priors = freed.fitted, {free.field: free.prior for free in before.fitted.free}
    fields = [free.field for free in fit.free
              if free.prior == math.inf and priors.get(free.field, math.inf) < math.inf]
    if not fields:
        return False
    known = likelihood(fit)
    return all(_is_beyond(fit, known, field, TOLERANCE_FACTOR * priors[field])
               for field in fields)


def _is_beyond(fit: Fitted, known: Likelihood, field: str, prior: float) -> bool:
    """Return whether the 95 % interval of a nominal parameter is beyond the tolerance."""
    nominal = float(fit.problem.group.nominal[field])
    return all(abs(end / nominal - 1.0) > 2.0 * prior for end in interval(fit, known, field))


def form_of(group: Group, field: str) -> tuple[Effect, Variant]:
    """
    Return the effect, and its form, in which a parameter is free with the fewest others.

    As a multiple of its nominal value: a damper of the load that is off is no viscous friction.
    """
    return min(((effect, variant) for effect in group.effects for variant in effect.variants
                if field in {free.field for free in variant.free if free.scale == 'nominal'}),
               key=lambda found: len(found[1].free))
