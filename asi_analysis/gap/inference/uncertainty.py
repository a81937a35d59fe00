"""
Uncertainty of fitted parameters: the profile of a quadratic log likelihood, within the bounds.

All other parameters are free, so the interval of a parameter includes the tolerances of nominal
parameters that have a similar effect.
"""

from typing import NamedTuple

import numpy as np
from scipy.stats import norm

from asi_analysis.arrays import Array
from asi_analysis.gap.inference.bounded_least_squares import least_step
from asi_analysis.gap.inference.fit import AT_LIMIT, Fitted, independent_samples
from asi_analysis.gap.inference.posterior import Posterior, power
from asi_analysis.gap.inference.probability import CONSTANTS
from asi_analysis.gap.model.group import least_error

LIMIT_95 = float(norm.ppf(0.975))   # standard deviations from the mean to a 95 % limit
RISE = 0.5 * LIMIT_95 ** 2          # of the negative log likelihood there
HALVINGS = 24
# As shares of a parameter's range: the width in which the profile holds it; the distance from a
# bound within which it is at that bound.
HELD_WIDTH = 1e-9
AT_BOUND = 1e-6


class Likelihood(NamedTuple):
    """Negative log likelihood about a fit: 0.5 step' square step + slope' step, in shares."""

    square: Array
    slope: Array


def likelihood(fitted: Fitted, at_bound: float = AT_BOUND) -> Likelihood:
    """
    Return the quadratic negative log likelihood of the parameters about a fit.

    A channel has the effective sample size of its residual; its model error that of
    `Constants.samples`. at_bound: share of the range within which a parameter is at a bound.
    """
    problem, theta = fitted.problem, fitted.theta
    group = problem.group
    count = len(group.channels)
    residual = problem.residual(theta)
    slopes = problem.jacobian(theta, base=residual)
    square, slope = np.zeros((theta.size, theta.size)), np.zeros(theta.size)
    if isinstance(problem, Posterior):
        (residual, missed), (slopes, others) = map(problem.split, (residual, slopes))
        square += others.T @ others + np.diag(problem.prior[1])
        slope += others.T @ missed
    else:
        residual = residual.reshape(count, -1)
        slopes = slopes.reshape(count, residual.shape[1], -1)
    counts = independent_samples(group, fitted.record)
    # Effective samples are those of the held-out parts; the fitted ones may be longer.
    more = max(sum(float(r.fit.sum()) for r in group.recordings)
               / sum(float(r.held_out.sum()) for r in group.recordings), 1.0)
    sizes = power(group) if isinstance(problem, Posterior) else np.ones(count)
    for channel, rest, change, size in zip(group.channels, residual, slopes, sizes, strict=True):
        model_error = 1.0 - group.noise[channel] ** 2 / group.error_floor[channel]
        least = size * least_error(group, channel) / group.error_floor[channel]
        variance = (max(float(np.mean(rest ** 2)), least) / (more * counts[channel])
                    + size * model_error / CONSTANTS.samples)
        square += change.T @ change / (rest.size * variance)
        slope += change.T @ rest / (rest.size * variance)
    # Inside the bounds the gradient is zero, up to the tolerance of the optimiser.
    inside = (theta > at_bound) & (theta < 1.0 - at_bound)
    return Likelihood(square, np.where(inside, 0.0, slope))


def at_limit(fitted: Fitted) -> dict[str, str]:
    """
    Return the nominal parameters at a bound of their tolerance: 'low' or 'high', by field.

    Only those that the recordings determine: their 95 % interval is within that half of the range.
    """
    if isinstance(fitted.problem, Posterior):   # normal priors have no bounds
        return fitted.at_limit
    found = likelihood(fitted, AT_LIMIT)
    numbers = {free.field: number for number, free in enumerate(fitted.free)}

    def known(field: str, limit: str) -> bool:
        other = 0.0 if limit == 'high' else 1.0
        return abs(end(found, fitted.theta, numbers[field], other) - other) > 0.5

    return {field: limit for field, limit in fitted.at_limit.items() if known(field, limit)}


def draw(fitted: Fitted, found: Likelihood, rng: np.random.Generator) -> np.void:
    """Return a record drawn from the normal distribution of a fit's parameters, within bounds."""
    triangle = np.linalg.cholesky(found.square + np.eye(fitted.theta.size))
    step = np.linalg.solve(triangle.T, rng.standard_normal(fitted.theta.size))
    return fitted.problem.record(np.clip(fitted.theta + step, 0.0, 1.0))


def interval(fitted: Fitted, found: Likelihood, name: str) -> tuple[float, float]:
    """Return the 95 % interval of a free parameter of a fit, in its unit."""
    number = [free.field for free in fitted.free].index(name)
    values = []
    for bound in (0.0, 1.0):
        theta = fitted.theta.copy()
        theta[number] = end(found, fitted.theta, number, bound)
        values.append(float(fitted.problem.record(theta)[name]))
    return values[0], values[1]


def end(found: Likelihood, theta: Array, number: int, bound: float) -> float:
    """Return the limit of the 95 % interval towards a bound, by the profile likelihood."""
    low, high = -theta, 1.0 - theta

    def cost(share: float) -> float:
        step = share * (bound - theta[number])
        low[number], high[number] = step - HELD_WIDTH, step + HELD_WIDTH
        return -least_step(found.square, found.slope, low, high)[1]

    least, below, above = cost(0.0), 0.0, 1.0
    if cost(1.0) < least + RISE:
        return bound
    for _ in range(HALVINGS):
        middle = 0.5 * (below + above)
        below, above = (middle, above) if cost(middle) < least + RISE else (below, middle)
    return float(theta[number] + above * (bound - theta[number]))
