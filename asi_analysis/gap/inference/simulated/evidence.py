"""
Evidence (marginal likelihood) of fitted hypotheses, and their probabilities.

By Laplace's approximation (MacKay, Information Theory, Inference and Learning Algorithms, 2003,
ch. 27 and 28). What a hypothesis leaves beyond the noise is its model error: an unknown signal of
unknown size, with MODEL_SAMPLES effective samples (Kennedy and O'Hagan, J. R. Stat. Soc. B 63,
2001). So no hypothesis is certain because another one leaves a little more.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import erfcx

from asi_analysis.arrays import Array, Mask
from asi_analysis.gap.formulation import MODEL_SAMPLES, model_error
from asi_analysis.gap.inference.coloured_noise import coloured
from asi_analysis.gap.inference.fit import independent_samples
from asi_analysis.gap.inference.posterior import ODDS_AGAINST, Posterior, mean_squares, power
from asi_analysis.gap.inference.probability import Names, log_odds_against
from asi_analysis.gap.inference.simulated.found import (
    COST_RANGE,
    Found,
    changed,
    cost_of,
    nearest_to_nominal,
)
from asi_analysis.gap.inference.simulated.special_cases import simpler_forms
from asi_analysis.gap.model.effects import PARAMETER, UNKNOWN, without_prior
from asi_analysis.gap.model.group import Group, least_error
from asi_analysis.gap.sampling import independent
from asi_analysis.parallel import in_threads
from asi_common.record import field_name

# Log odds below the best at which a hypothesis does not count; and the largest difference between
# the logs of posterior volumes, as long as none of them is known.
NEGLIGIBLE, VOLUMES = 12.0, 28.0
# Negative log prior at the tolerance of a nominal parameter: two standard deviations.
AT_TOLERANCE = 0.5 * 2.0 ** 2
# Log odds against a quantum of the command: the best of all down to 1/400 of the command, in three
# kinds of rounding, is a guess, and the bounds of the fit are 0.6 % apart.
STEPS, OF_ALL_QUANTA = 'command_quantisation', math.log(3.0 * math.log(200.0) / 0.006)
# A parameter is at an end of its range within this share of it; the least curvature, for which
# the posterior is uniform over the range.
AT_END, LEAST_CURVATURE = 1e-6, 1e-3
# Differences for the volume: at first, of a parameter without a normal prior, as a share of its
# range; then in standard deviations along the axes of the posterior, in so many passes, unless
# one changes the log of the product of these differences by less than SAME.
WIDEST, AXIS, PASSES, SAME = 0.3, 2.0, 2, 0.1
ROUNDS = 2   # so many Jacobians of a fit with another weight of the data: it starts nearby


class _Noise(NamedTuple):
    """White noise by channel: effective samples, and the mean square in error floors."""

    samples: Array
    level: Array

    def excess(self, left: Array) -> Array:
        """Return the mean square model error of a mean square residual, over that of the noise."""
        return np.maximum(left / self.level - 1.0, 0.0)

    def weight(self, excess: Array) -> Array:
        """Return the weight of the data beside such a model error; 1: there is none."""
        return 1.0 / (1.0 + self.samples / MODEL_SAMPLES * excess)

    def log_likelihood(self, left: Array) -> float:
        """Return the log likelihood of a mean square residual, up to a constant."""
        return 0.5 * MODEL_SAMPLES * float(np.log(self.weight(self.excess(left))).sum())


def weigh(group: Group, found: Mapping[Names, Found]
          ) -> tuple[dict[Names, float], dict[Names, Found]]:
    """
    Return the probability of every hypothesis by its effects, and the hypotheses.

    That of `unknown` is 0 here. Some hypotheses are added: fits whose nominal parameters are so
    improbable that they are an effect.
    """
    found = _to_the_end(found)
    least = min(found.values(), key=cost_of)
    samples = independent_samples(least.problem.group, least.problem.record(least.best.theta),
                                  'known')
    exact = _simulation_error(group)   # a smaller error is no evidence
    level = np.maximum(mean_squares(least.problem, least.best.residual), exact)
    noise = _Noise(np.array([samples[channel] for channel in group.channels]),
                   _noise_level(group, np.minimum(level, least.explained)))
    equal = equal_below(least) if group.other_formulation or coloured(group) else exact
    simplest = _simplest_explained(found) if group.may_differ else None

    def left(each: Found) -> Array:
        """Return the mean square residual; one below that of `simplest` is no evidence."""
        enough = simplest and found.get(_with_steps_of(each, simplest), simplest)
        low = equal if enough is None or len(each.names) <= len(enough.names) else (
            np.maximum(equal, mean_squares(enough.problem, enough.best.residual)))
        return np.maximum(mean_squares(each.problem, each.best.residual), low)

    smooth = without_evident_steps(found)

    def value(each: Found) -> float:
        """Return the log posterior."""
        log_posterior = _log_posterior(each, noise, left(each))
        if smooth is None or STEPS not in each.names:
            return log_posterior
        counted = noise.log_likelihood(left(each)) - noise.log_likelihood(left(smooth))
        return log_posterior + max(_gain_of_steps(each, smooth) - counted, 0.0)

    highest = max(map(value, found.values()))
    near = [each for each in found.values() if value(each) > highest - NEGLIGIBLE - VOLUMES]
    if equal is not exact:   # then more parameters, which cost a form probability, may gain none
        near += [nearest_to_nominal(simpler, equal) if group.other_formulation else simpler
                 for each in near for simpler in simpler_forms(each, least.best.cost + COST_RANGE)]
    near = [max(both, key=value) for both in zip(near, in_threads(
        lambda each: _with_model_error(each, noise), near), strict=True)]
    near += [more for each in near for more in with_improbable_named(each, AT_TOLERANCE)]
    evidence, fits = dict.fromkeys(found, -math.inf), dict(found)
    for each, weight in that_count(near, value, lambda each: _log_volume(each, noise, left(each))):
        if weight > evidence.get(each.names, -math.inf):
            evidence[each.names] = weight
            fits[each.names] = each
    highest = max(evidence.values())
    weights = {names: math.exp(value - highest) for names, value in evidence.items()}
    chance = {names: value / sum(weights.values()) for names, value in weights.items()}
    # As long as the residual is no more than noise, there is no unknown effect.
    return {**chance, (UNKNOWN,): 0.0}, fits


def that_count(near: Sequence[Found], value: Callable[[Found], float],
               log_volume_of: Callable[[Found], float]) -> Iterator[tuple[Found, float]]:
    """
    Yield those hypotheses that may count, with their log evidence.

    The one with the fewest parameters comes first, since its volume is the largest, in general;
    then the others, by their log posterior, `value`. What could not reach the best one with the
    largest volume so far does not count, and its own is not computed.
    """
    simple = min(near, key=lambda each: (each.best.theta.size, -value(each)))
    others = sorted((each for each in near if each is not simple), key=value, reverse=True)
    highest, largest = -math.inf, -math.inf
    for each in (simple, *others):
        if each is simple or value(each) + largest >= highest - NEGLIGIBLE:
            volume = log_volume_of(each)
            highest, largest = max(highest, value(each) + volume), max(largest, volume)
            yield each, value(each) + volume


def _to_the_end(found: Mapping[Names, Found]) -> dict[Names, Found]:
    """
    Return hypotheses; those that compete are fitted until nothing more is gained.

    Not if the laws are formulated in another way: then they are as near to the nominal parameters
    as the model error allows.
    """
    most = min(each.best.cost for each in found.values()) + NEGLIGIBLE + VOLUMES
    return changed(found, lambda each: each.refined(converged=0.0)
                   if each.best.cost < most and not each.problem.group.other_formulation else each)


def _noise_level(group: Group, level: Array) -> Array:
    """
    Return the mean square of the noise by channel, in error floors.

    level: that of the residual which noise explains. The error of the simulator itself counts as
    noise, the model error of laws formulated in another way does not.
    """
    others = np.array([group.other_formulation * group.other_error[channel]
                       / group.error_floor[channel] for channel in group.channels])
    return np.maximum(level * (1.0 - others), model_error(group) - others)


def with_improbable_named(found: Found, least: float) -> Iterator[Found]:
    """
    Yield a fit as that of one more effect, whose parameters are nominal ones of improbable values.

    The values are the same, but the effect's prior is uniform. least: their negative log prior.
    """
    problem = found.problem
    mean, precision = problem.prior
    costs = 0.5 * precision * (found.best.theta - mean) ** 2
    cost = dict(zip((free.field for free in problem.free), costs, strict=True))
    for name, forms in problem.group.effects.items():
        for variant in forms:
            fields = {free.field for free in variant.free if free.scale == 'nominal'}
            if (name not in found.names and len(fields) == len(variant.free)
                    and fields <= cost.keys()
                    and sum(cost[field] for field in fields) > least):
                yield found._replace(
                    names=tuple(sorted((*found.names, name))),
                    variants=(*found.variants, variant),
                    problem=replace(problem, free=without_prior(problem.free, [variant])))


def _simplest_explained(found: Mapping[Names, Found]) -> Found | None:
    """
    Return the hypothesis with the fewest effects that explains the recordings, if there is one.

    That is: it leaves only noise, with probable nominal parameters. A smaller residual is no
    evidence for more effects: a formulation that hardly differs from the simulator's leaves as
    much.
    """
    explained = [each for each in found.values() if not each.may_lack_an_effect]
    return min(explained, key=lambda each: (len(each.names), each.best.cost), default=None)


def _with_steps_of(found: Found, simplest: Found) -> Names:
    """
    Return the effects of `simplest`, with the steps of the command if the hypothesis has them.

    No formulation of another law leaves the steps of a converter.
    """
    return tuple(sorted({*simplest.names, *({STEPS} & {*found.names})}))


def without_evident_steps(found: Mapping[Names, Found]) -> Found | None:
    """
    Return the best hypothesis without the steps of a converter, if these show beside it.

    No formulation of a law leaves such steps: they show if what they gain outweighs their price.
    """
    smooth, stepped = (min((each for names, each in found.items() if (STEPS in names) == steps),
                           key=cost_of, default=None) for steps in (False, True))
    if smooth is None or stepped is None:
        return None
    price = OF_ALL_QUANTA + ODDS_AGAINST * (len(stepped.names) - len(smooth.names))
    return smooth if _gain_of_steps(stepped, smooth) > price else None


def _gain_of_steps(stepped: Found, smooth: Found) -> float:
    """
    Return the log likelihood ratio of hypotheses with the steps of a converter, and without.

    Errors of a formulation agree with the steps by chance only, as if both had so many independent
    samples as the change that the steps make.
    """
    (left, _), (before, _) = (each.problem.split(each.best.residual) for each in (stepped, smooth))
    samples = np.array([independent(change, np.ones(change.size)) for change in before - left])
    own, others = (np.maximum(mean_squares(each.problem, each.best.residual),
                              _simulation_error(each.problem.group)) for each in (stepped, smooth))
    return 0.5 * float(samples @ np.log(np.maximum(others / own, 1.0)))


def _simulation_error(group: Group) -> Array:
    """Return the mean square error of the simulation itself by channel, in error floors."""
    return np.array([least_error(group, channel) / group.error_floor[channel]
                     for channel in group.channels])


def equal_below(best: Found) -> Array:
    """
    Return the mean square residual of each channel below which hypotheses fit equally well.

    In error floors. best: the hypothesis with the lowest cost. The model error of laws that are
    formulated in another way is an unknown signal, so a smaller difference is no evidence. Nor is
    one below the share of coloured noise that is not sure.
    """
    group = best.problem.group
    level = mean_squares(best.problem, best.best.residual) + model_error(group)
    return np.maximum(level, 1.0) if group.may_differ else level


def _with_model_error(found: Found, noise: _Noise) -> Found:
    """
    Return a hypothesis, fitted with the weight that its model error leaves to the data.

    Fitted as if there were only white noise, nominal parameters take improbable values to make
    a model error a little smaller.
    """
    problem = found.problem
    weight = noise.weight(noise.excess(mean_squares(problem, found.best.residual)))
    if weight.min() > 0.5:
        return found
    group = replace(problem.group, weight=dict(zip(problem.group.channels, map(float, weight),
                                                   strict=True)))
    return found.weighed_as(replace(problem, group=group)).refined(ROUNDS).weighed_as(problem)


def _log_posterior(found: Found, noise: _Noise, left: Array) -> float:
    """
    Return the log posterior density of a hypothesis at its most probable parameters.

    Up to a constant. left: mean square residual by channel that counts, in error floors.
    """
    precision = found.problem.prior[1]
    normal, (_, others) = precision > 0.0, found.problem.split(found.best.residual)
    return (noise.log_likelihood(left)
            - 0.5 * float(others @ others)
            - found.prior_cost
            + 0.5 * float(np.log(precision[normal] / (2.0 * math.pi)).sum())
            - ODDS_AGAINST * len(found.names)
            - OF_ALL_QUANTA * (STEPS in found.names)
            - sum(log_odds_against(ratio) for ratio in _ratios(found)))


def _ratios(found: Found) -> Iterator[float]:
    """Yield the ratios to their nominal values of the parameters beyond their tolerance."""
    values, nominal = found.problem.record(found.best.theta), found.problem.group.nominal
    for name in found.names:
        if name.startswith(PARAMETER):
            field = field_name(name.removeprefix(PARAMETER))
            yield float(values[field] / nominal[field])


def _log_volume(found: Found, noise: _Noise, left: Array) -> float:
    """
    Return the log of the posterior volume of the parameters, by Laplace's approximation.

    left: as in `_log_posterior`.
    """
    problem, best = found.problem, found.best
    mean, precision = problem.prior
    residual, others = problem.split(best.residual)
    weight = (noise.samples / residual.shape[1] / power(problem.group) / noise.level
              * noise.weight(noise.excess(left)))
    slopes = _slopes_of_mass(found, weight)
    square = _square(problem, slopes, weight)
    of_channels, rest = problem.split(slopes)
    slope = (np.einsum('c,cni,cn->i', weight, of_channels, residual, optimize=True)
             + rest.T @ others + precision * (best.theta - mean))
    return log_volume(square, slope, best.theta, precision)


def _slopes_of_mass(found: Found, weight: Array) -> Array:
    """
    Return the Jacobian from differences as wide as the posterior is.

    Stick and slip makes the residual rough: narrower differences show jumps that do not matter,
    as if each parameter were known far better than it is. First along each parameter, as wide as
    its prior; then along the axes of the posterior. weight: of each channel's samples.
    """
    problem, best = found.problem, found.best
    size = 1.0 / np.sqrt(np.maximum(problem.prior[1], WIDEST ** -2.0))
    slopes = problem.jacobian(best.theta, base=best.residual, size=size)
    finite: Mask = np.isfinite(slopes.sum(axis=0))
    if not finite.all():   # so far away no plant is possible
        slopes = problem.jacobian(best.theta, _columns(problem, slopes, finite), best.residual)
    within = np.minimum(best.theta, 1.0 - best.theta) >= AT_END
    axes = _axes(problem, slopes, weight, within)
    for _ in range(PASSES):
        slopes[:, within] = _along_axes(found, slopes, axes, within)
        before, axes = axes, _axes(problem, slopes, weight, within)
        if abs(float(np.log(axes.reach / before.reach).sum())) < SAME:
            break
    # At an end of its range a parameter goes one way alone.
    square = np.diag(_square(problem, slopes, weight))
    return problem.jacobian(best.theta, _columns(problem, slopes, within), best.residual,
                            np.minimum(size, 1.0 / np.sqrt(np.maximum(square, 1.0))))


def _columns(problem: Posterior, slopes: Array, chosen: Mask) -> dict[str, Array]:
    """Return the chosen columns of a Jacobian, by field."""
    return {field: column for (field, column), known in zip(
        problem.columns(slopes).items(), chosen, strict=True) if known}


class _Axes(NamedTuple):
    """Axes of a posterior, as columns, and how far to go along each: in standard deviations."""

    directions: Array
    reach: Array


def _axes(problem: Posterior, slopes: Array, weight: Array, within: Mask) -> _Axes:
    """Return the axes of the posterior with a Jacobian; within: of parameters off their ends."""
    precision, directions = np.linalg.eigh(
        _square(problem, slopes, weight)[np.ix_(within, within)])
    return _Axes(directions, np.minimum(AXIS / np.sqrt(np.maximum(precision, 1.0)), WIDEST))


def _along_axes(found: Found, slopes: Array, axes: _Axes, within: Mask) -> Array:
    """
    Return columns of the Jacobian from central differences along the axes of the posterior.

    slopes: the Jacobian that gives these axes; within: the columns, of parameters off their ends.
    """
    problem, theta = found.problem, found.best.theta

    def along(number: int) -> Array:
        step = np.zeros(theta.size)
        step[within] = axes.reach[number] * axes.directions[:, number]
        ahead, back = (problem.residual(np.clip(theta + way * step, 0.0, 1.0))
                       for way in (1.0, -1.0))
        change = (ahead - back) / (2.0 * axes.reach[number])
        return (change if np.isfinite(change).all()
                else slopes[:, within] @ axes.directions[:, number])

    return np.array(list(in_threads(along, range(axes.reach.size)))).T @ axes.directions.T


def _square(problem: Posterior, jacobian: Array, weight: Array) -> Array:
    """Return the precision of the posterior, linearised; weight: of each channel's samples."""
    slopes, rest = problem.split(jacobian)
    return (np.einsum('c,cni,cnj->ij', weight, slopes, slopes, optimize=True)
            + rest.T @ rest + np.diag(problem.prior[1]))


def log_volume(square: Array, slope: Array, theta: Array, precision: Array) -> float:
    """
    Return the log of the integral of exp(-slope x - x square x / 2) over the ranges.

    x: parameters less `theta`, each of which goes from 0 to 1; precision: of their normal priors,
    contained in `square`; 0: a uniform prior. Within the range the slope is 0, but for the
    convergence of the fit. A parameter that is held at an end of its range is integrated over one
    side of it, with all that are within given, and without regard to others at their ends: for
    two that act alike that is an upper bound.
    """
    end = np.minimum(theta, 1.0 - theta) < AT_END
    within = ~end
    # Of a uniform prior, the volume is at most the range.
    inner = square[np.ix_(within, within)] + np.diag(2.0 * math.pi * (precision[within] == 0.0))
    along = np.linalg.solve(inner, square[np.ix_(within, end)])
    outward = np.sign(0.5 - theta[end])
    push = outward * (slope[end] - slope[within] @ along)
    bend = np.diag(square[np.ix_(end, end)] - square[np.ix_(end, within)] @ along)
    bend = np.maximum(bend, LEAST_CURVATURE)
    # Not pushed out of the range: the fit may have stopped there.
    share = np.maximum(push, 0.0) / np.sqrt(2.0 * bend)
    sides = np.minimum(np.sqrt(0.5 * math.pi / bend) * erfcx(share), 1.0)
    return (0.5 * inner.shape[0] * math.log(2.0 * math.pi)
            - 0.5 * float(np.linalg.slogdet(inner)[1]) + float(np.log(sides).sum()))
