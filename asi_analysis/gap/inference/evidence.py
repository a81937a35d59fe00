"""
Evidence (marginal likelihood) of fitted hypotheses, and their probabilities.

By Laplace's approximation (MacKay, Information Theory, Inference and Learning Algorithms, 2003,
ch. 27 and 28). The noise variance is the mean square residual of the best hypothesis, with the
effective sample size of that residual, so that a model error counts as coloured noise.
"""

import math
from collections.abc import Mapping

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.gap.formulation import MODEL_SAMPLES, model_error
from asi_analysis.gap.inference.fit import independent_samples
from asi_analysis.gap.inference.posterior import Found, mean_squares, power
from asi_analysis.gap.inference.probability import Names
from asi_analysis.gap.model.effects import UNKNOWN
from asi_analysis.gap.model.group import Group

# Log prior odds against each effect, and each parameter beyond its tolerance: 4 % for all of about
# forty together, so that a false alarm is rare.
ODDS_AGAINST = 7.0
NEGLIGIBLE = 15.0   # log odds below the best at which the posterior volume is not computed


def weigh(group: Group, found: Mapping[Names, Found]) -> dict[Names, float]:
    """Return the probability of every hypothesis by its effects; that of `unknown` is 0 here."""
    least = min(found.values(), key=lambda f: f.best.cost)
    samples = independent_samples(least.problem.group, least.problem.record(least.best.theta),
                                  'known')
    model = model_error(group)
    counts = 1.0 / (1.0 / np.array([samples[channel] for channel in group.channels])
                    + model / MODEL_SAMPLES)
    total = sum(int(r.known.sum()) for r in group.recordings)
    level = mean_squares(least.problem, least.best.residual)
    equal = equal_below(least) if group.other_formulation else 0.0 * level
    simplest = _simplest_explained(found)

    def no_evidence_below(names: Names) -> Array:
        if simplest is None or len(names) <= len(simplest.names):
            return equal
        return np.maximum(equal, mean_squares(simplest.problem, simplest.best.residual))

    rough = {names: _log_posterior(f, counts, level, model, no_evidence_below(names))
             for names, f in found.items()}
    highest = max(rough.values())
    evidence = {names: rough[names] + _log_volume(f, counts / total, model)
                for names, f in found.items() if rough[names] > highest - NEGLIGIBLE}
    highest = max(evidence.values())
    evidence = dict.fromkeys(found, -math.inf) | evidence
    weight = {names: math.exp(value - highest) for names, value in evidence.items()}
    chance = {names: value / sum(weight.values()) for names, value in weight.items()}
    # As long as the residual is no more than noise, there is no unknown effect.
    return {**chance, (UNKNOWN,): 0.0}


def _simplest_explained(found: Mapping[Names, Found]) -> Found | None:
    """
    Return the hypothesis with the fewest effects that leaves only noise, if there is one.

    A smaller residual is no evidence for more effects: a formulation that hardly differs from the
    simulator's leaves as much. Improbable nominal parameters are.
    """
    explained = [each for each in found.values() if not each.unexplained]
    return min(explained, key=lambda each: (len(each.names), each.best.cost), default=None)


def equal_below(best: Found) -> Array:
    """
    Return the mean square residual of each channel below which hypotheses fit equally well.

    In error floors. best: the hypothesis with the lowest cost. The model error of laws that are
    formulated in another way is an unknown signal, so a smaller difference is no evidence.
    """
    level = mean_squares(best.problem, best.best.residual)
    return np.maximum(level + model_error(best.problem.group), 1.0)


def _log_posterior(found: Found, counts: Array, level: Array, model: Array, equal: Array
                   ) -> float:
    """
    Return the log posterior density of a hypothesis at its most probable parameters.

    Up to a constant. All by channel: counts: effective samples; mean squares in error floors:
    level: residual of the best hypothesis; model: model error; equal: a smaller residual counts
    as this.
    """
    mean, precision = found.problem.prior
    left = np.maximum(mean_squares(found.problem, found.best.residual), equal)
    normal, (_, others) = precision > 0.0, found.problem.split(found.best.residual)
    return (-0.5 * float(counts @ np.log((left + model) / (level + model)))
            - 0.5 * float(others @ others)
            - 0.5 * float(precision @ (found.best.theta - mean) ** 2)
            + 0.5 * float(np.log(precision[normal] / (2.0 * math.pi)).sum())
            - ODDS_AGAINST * len(found.names))


def _log_volume(found: Found, share: Array, model: Array) -> float:
    """
    Return the log of the posterior volume of the parameters, by Laplace's approximation.

    share: effective sample size by channel, as a share of all samples; model: mean square model
    error by channel, in error floors.
    """
    problem, theta = found.problem, found.best.theta
    precision = problem.prior[1]
    left = mean_squares(problem, found.best.residual)
    of_channels, others = problem.split(problem.jacobian(theta))
    weight = share / power(problem.group) / (left + model)
    square = (np.einsum('c,cni,cnj->ij', weight, of_channels, of_channels, optimize=True)
              + others.T @ others + np.diag(precision))
    normal = precision > 0.0
    # Of a uniform prior, the volume is at most the range.
    square[~normal, ~normal] += 2.0 * math.pi * np.ones((~normal).sum())
    _, log_det = np.linalg.slogdet(square)
    return 0.5 * theta.size * math.log(2.0 * math.pi) - 0.5 * float(log_det)
