"""A fit with a nominal parameter beyond its tolerance has one more cause: that parameter."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from asi_analysis.gap.formulation import TOLERANCE_FACTOR, is_of_law
from asi_analysis.gap.inference.fit import Fitted
from asi_analysis.gap.inference.hypotheses import Candidate, Weighed
from asi_analysis.gap.inference.posterior import Posterior, fitted, most_probable
from asi_analysis.gap.inference.probability import Names
from asi_analysis.gap.inference.uncertainty import Likelihood, interval, likelihood
from asi_analysis.gap.model.effects import UNKNOWN, Variant, fields_of, without_prior
from asi_analysis.gap.model.group import Group

MOST_PARAMETERS = 2   # beyond their tolerance, to be named as the cause; more: `unknown`
LEAST_PROBABILITY = 0.01   # of a hypothesis that is judged
# Probability that the laws are the simulator's own, if the noise would hide another formulation.
# With others, a value just beyond the tolerance may be due to them.
OWN_LAWS = 0.6
# Probability that a parameter which may be within TOLERANCE_FACTOR tolerances is meant, and not
# other laws, or (linear nominal models, where it is exact) a gain of the sensor within its own.
AT_EDGE = 0.4


class _Beyond(NamedTuple):
    """A nominal parameter beyond its tolerance: its prior, and the form of an effect with it."""

    field: str
    prior: float   # standard deviation, over the nominal value
    variant: Variant


def with_parameters_named(weighed: Weighed) -> Weighed:
    """
    Return a group whose hypotheses keep all other parameters within their tolerances.

    Normal priors let a fit leave them. If the 95 % interval of a nominal parameter lies beyond its
    tolerance, that fit is one with this parameter, as far as the laws are the simulator's own; how
    far it is off says the fit without its prior. Its probability is divided among the hypotheses
    with that effect more, or another one, as their evidence is. If the nominal model takes more
    than MOST_PARAMETERS of them, the cause is `unknown`.
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
        if not more or names and len(more) > MOST_PARAMETERS:
            continue
        richer: Names = tuple(sorted({*names, *more}))
        freed = _freed(weighed, candidate, richer, more)
        known = candidates.get(richer)
        if len(more) > MOST_PARAMETERS:
            richer = (UNKNOWN,)
        elif known is None or known.fitted.free == freed.fitted.free:
            candidates[richer] = freed
        share = OWN_LAWS if group.may_differ and not shown else 1.0
        if not own_laws and not _are_beyond(freed, more.values()):
            share = AT_EDGE
        moved = share * weighed.probability[names]
        chance[names] -= moved
        for each, part in _shares(weighed.probability, names, richer).items():
            chance[each] = chance.get(each, 0.0) + part * moved
    return weighed._replace(candidates=candidates, probability=chance)


def _shares(chance: Mapping[Names, float], names: Names, richer: Names) -> dict[Names, float]:
    """
    Return the shares of hypotheses with `names` and as many effects as `richer`, by evidence.

    All belongs to `richer` if its evidence is not known.
    """
    if chance.get(richer, 0.0) == 0.0:
        return {richer: 1.0}
    alike = {each: value for each, value in chance.items()
             if len(each) == len(richer) and set(names) < set(each)}
    return {each: value / sum(alike.values()) for each, value in alike.items()}


def _freed(weighed: Weighed, candidate: Candidate, names: Names, more: Mapping[str, _Beyond]
           ) -> Candidate:
    """
    Return a hypothesis with further effects: their parameters have no prior now.

    That of the group, refitted, if these are free in it. Else it is fitted from nominal values of
    the others, too, which took up what the prior kept from the parameter.
    """
    known = weighed.candidates.get(names)
    if known and {each.field for each in more.values()} <= {
            free.field for free in known.fitted.free if free.prior == math.inf}:
        variants, problem, starts = known.variants, known.fitted.problem, [known.fitted.theta]
        assert isinstance(problem, Posterior)
    else:
        before, added = candidate.fitted.problem, tuple(each.variant for each in more.values())
        assert isinstance(before, Posterior)
        variants = (*candidate.variants, *added)
        problem = replace(before, free=without_prior(before.free, added))
        theta, (_, precision) = candidate.fitted.theta, problem.prior
        starts = [theta, np.where(precision > 0.0, problem.nominal, theta)]
    best = min((most_probable(problem, start) for start in starts), key=lambda each: each.cost)
    return Candidate(names, variants, fitted(problem, best))


def _beyond(weighed: Weighed, names: Names) -> dict[str, _Beyond]:
    """Return the nominal parameters beyond their tolerance, by the effect that holds them."""
    group, candidate = weighed.group, weighed.candidates[names]
    fit, found = candidate.fitted, dict[str, _Beyond]()
    own = fields_of(candidate.variants)
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
            if effect not in names:
                found[effect] = _Beyond(free.field, free.prior, variant)
    return found


def _are_beyond(freed: Candidate, more: Iterable[_Beyond]) -> bool:
    """Return whether parameters are far beyond their tolerance, fitted without their prior."""
    known = likelihood(freed.fitted)
    return all(_is_beyond(freed.fitted, known, each.field, TOLERANCE_FACTOR * each.prior)
               for each in more)


def _is_beyond(fit: Fitted, known: Likelihood, field: str, prior: float) -> bool:
    """Return whether the 95 % interval of a nominal parameter is beyond one end of a tolerance."""
    nominal = float(fit.problem.group.nominal[field])
    low, high = sorted(end / nominal for end in interval(fit, known, field))
    return low > 1.0 + 2.0 * prior or high < 1.0 - 2.0 * prior


def form_of(group: Group, field: str) -> tuple[str, Variant]:
    """
    Return the effect, and its form, in which a parameter is free with the fewest others.

    As a multiple of its nominal value: a damper of the load that is off is no viscous friction.
    """
    return min(((name, variant) for name, forms in group.effects.items() for variant in forms
                if field in {free.field for free in variant.free if free.scale == 'nominal'}),
               key=lambda found: len(found[1].free))
