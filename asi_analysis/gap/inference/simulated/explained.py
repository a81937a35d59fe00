"""The probabilities of the simulator's hypotheses, if one of them explains the recordings."""

from collections.abc import Mapping

import numpy as np

from asi_analysis.gap.formulation import model_error
from asi_analysis.gap.inference.beyond_tolerance import with_parameters_named
from asi_analysis.gap.inference.hypotheses import Candidate, Weighed
from asi_analysis.gap.inference.posterior import (
    Best,
    Posterior,
    mean_squares,
    most_probable,
)
from asi_analysis.gap.inference.probability import (
    NONE_HIDDEN,
    SIMULATOR,
    Names,
    as_probability,
    beside_unknown,
    unknown_odds,
    with_unknown,
)
from asi_analysis.gap.inference.simulated.evidence import weigh
from asi_analysis.gap.inference.simulated.formulation import in_formulation
from asi_analysis.gap.inference.simulated.found import Found
from asi_analysis.gap.model.effects import UNKNOWN
from asi_analysis.gap.model.predict import measured

# The model is of this machine if it leaves at most this share of each signal's mean square.
FOLLOWED_SHARE = 0.5


def weighed_of(found: Mapping[Names, Found], alone: bool, other: bool | None = None
             ) -> Weighed | None:
    """
    Return a group with the probabilities of its hypotheses, if one of them explains it.

    alone: as in `explained_by_simulator`; other: whether the laws are formulated in another way,
    if known.
    """
    if other is not None:
        found = in_formulation(found, other)
    group = found[()].problem.group
    if not alone and all(each.far for each in found.values()):
        return None
    chance, found = weigh(group, found)
    candidates = {names: Candidate(names, f.variants, f.as_fitted) for names, f in found.items()}
    weighed = with_parameters_named(Weighed(group, candidates, chance))
    best, gap, unknown = _fitted_to_the_end(weighed), found[()].relative_residual, 0.0
    candidates = weighed.candidates | {best.names: Candidate(best.names, best.variants,
                                                             best.as_fitted)}
    weighed = weighed._replace(candidates=candidates)
    # Of a linear nominal model, what is left may be the formulation of the effect.
    if group.may_differ and all(each.far for each in found.values()):
        if not _follows_signals(found[()]):
            return None
        unknown = as_probability(max(
            unknown_odds(left, before, SIMULATOR, SIMULATOR.unknown_floor)
            for left, before in zip(best.relative_residual, gap, strict=True)))
    elif not best.names and (group.other_formulation or best.unexplained):
        unknown = SIMULATOR.masked * _model_share(best)   # a model error may mask an effect
    # An unknown effect may leave the parameters as they are, and so may laws of another form.
    if best.names:
        unknown = max(unknown, NONE_HIDDEN * as_probability(best.odds_of_one_more))
    if unknown == 0.0:
        return weighed
    outside = weighed.probability[(UNKNOWN,)]
    chance = with_unknown(
        {names: weighed.probability[names] for names in candidates}, unknown,
        beside_unknown(gap, best.relative_residual, len(best.names), SIMULATOR.samples, SIMULATOR))
    return weighed._replace(probability=chance | {
        (UNKNOWN,): chance[(UNKNOWN,)] + (1.0 - unknown) * outside})


def _fitted_to_the_end(weighed: Weighed) -> Found:
    """
    Return the most probable hypothesis with its parameters fitted to the end.

    Also from nominal values, since friction makes the cost rough; that is given up where it does
    not promise to cost less.
    """
    chosen = most_probable_of(weighed)
    problem, theta = chosen.fitted.problem, chosen.fitted.theta
    assert isinstance(problem, Posterior)
    found = Found(chosen.names, chosen.variants, problem, Best(
        theta, problem.cost(theta), problem.residual(theta)))
    best = most_probable(problem, theta, converged=0.0)
    again = most_probable(problem, found.at_nominal.best.theta, converged=0.0, goal=best.cost)
    return found._replace(best=min(best, again, key=lambda each: each.cost))


def _model_share(found: Found) -> float:
    """Return the largest share of a channel's residual that may be model error."""
    group = found.problem.group
    return float(np.max(model_error(group) if group.other_formulation else
                        1.0 - 1.0 / np.maximum(found.relative_residual, 1.0)))


def _follows_signals(null: Found) -> bool:
    """
    Return whether the nominal model, refitted, explains enough of the power of each signal.

    What noise explains does not count: the force of a free load may be hardly more than that.
    """
    group = null.problem.group
    power = np.array([np.mean(np.concatenate(
        [measured(r, channel)[r.known] for r in group.recordings]) ** 2)
        / group.error_floor[channel] for channel in group.channels])
    left = mean_squares(null.problem, null.best.residual) - null.explained
    return bool(np.all(left < FOLLOWED_SHARE * power))


def most_probable_of(weighed: Weighed) -> Candidate:
    """Return the most probable hypothesis that was fitted."""
    names = max(weighed.candidates, key=lambda names: weighed.probability[names])
    return weighed.candidates[names]
