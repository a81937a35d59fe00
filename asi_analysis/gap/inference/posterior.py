"""
Posterior of a hypothesis under the simulator: the most probable parameters.

Likelihood: white noise on each channel. Priors: normal on the nominal parameters, by their
tolerance; uniform between the bounds on those of effects (MacKay, Information Theory, Inference
and Learning Algorithms, 2003, ch. 27).
"""

import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import NamedTuple, TypeVar

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.gap.inference.bounded_least_squares import least_step
from asi_analysis.gap.inference.fit import Fitted, Problem, held_out_error
from asi_analysis.gap.inference.probability import Names
from asi_analysis.gap.model.effects import Free, Variant
from asi_analysis.gap.model.group import Group, exact
from asi_analysis.gap.model.predict import judged_error
from asi_analysis.gap.model.start import MEMORIES

STEP = 1e-4       # of a parameter's range, for the derivatives
ROUNDS = 12       # of the optimiser
# Of the log posterior, and as a share of it: a round that gains less than their sum is the last.
GAIN, CONVERGED = 0.05, 3e-4
DAMPING, TRIES = 1e-4, 5   # of a step: to begin with, and how often with more
SLOW = 0.003      # of the cost: an updated derivative that gains less is computed anew
HOPE = 2.0        # times what a linear problem would gain: a fit may gain no more
LONGEST_STEP = 0.3
SCANNED = 9       # values of a parameter for which derivatives mislead
# Error floors (mean square) that a right hypothesis may leave. The noise is estimated from fourth
# differences: three standard errors of its variance are about this over the root of the samples.
MARGIN, NOISE_ERROR = 1.1, 10.0
PART, BENT = 0.1, 0.4   # of a step: to see how the residual bends along it; the most that it may

NONE: Mapping[str, Array] = MappingProxyType({})
Item = TypeVar('Item')
Made = TypeVar('Made')


@dataclass
class Posterior(Problem):
    """The negative log posterior of a group's free parameters, as a least-squares problem."""

    pool: ThreadPoolExecutor | None = field(default_factory=lambda: ThreadPoolExecutor(
        len(os.sched_getaffinity(0))))   # None: within a thread of it

    def residual(self, theta: Array) -> Array:
        """Return the residual over the error floor (rms), channel after channel."""
        return self._of(self.record(theta))

    def cost(self, theta: Array, residual: Array | None = None) -> float:
        """Return the negative log posterior, up to a constant; residual: if it is known."""
        residual = self.residual(theta) if residual is None else residual
        return 0.5 * float(residual @ residual) + self.given(theta)

    def given(self, theta: Array) -> float:
        """Return the part of the cost that comes from the normal priors."""
        mean, precision = self.prior
        return 0.5 * float(precision @ (theta - mean) ** 2)

    def start(self, free: Free, value: float) -> float:
        """Return the share of a start value (relative, as in `Free`), off the bounds."""
        own = self.parameter(free)
        unit = own.high / free.high if free.high else 1.0
        return min(max(own.share(value * unit), 0.001), 0.999)

    def _of(self, p: np.void) -> Array:
        parts = []
        for channel in self.group.channels:
            scale = math.sqrt(self.group.weight[channel] / self.group.error_floor[channel])
            parts += [scale * judged_error(r, channel, p)[r.known]
                      for r in self.group.recordings if r.known.any()]
        return np.concatenate(parts)

    def jacobian(self, theta: Array, known: Mapping[str, Array] = NONE,
                 base: Array | None = None) -> Array:
        """
        Return the derivatives of the residual.

        known: derivatives, by field, that are not computed again; base: the residual.
        """
        residual = self.residual(theta) if base is None else base

        def column(number: int) -> Array:
            name = self.free[number].field
            if name in known:
                return known[name]
            moved = theta.copy()
            step = STEP if theta[number] < 0.5 else -STEP
            moved[number] += step
            return (self._of(self.record(moved)) - residual) / step

        return np.array(list(self.each(column, range(theta.size)))).T

    def each(self, function: Callable[[Item], Made], items: Iterable[Item]) -> Iterator[Made]:
        """Yield the value of a function of each item, on all cores if there is a pool."""
        return map(function, items) if self.pool is None else self.pool.map(function, items)

    def curvature(self, theta: Array, base: Array, step: Array) -> Array:
        """Return the second derivative of the residual along a step."""
        ahead, back = (self.residual(np.clip(theta + part * step, 0.0, 1.0))
                       for part in (PART, -PART))
        return (ahead - 2.0 * base + back) / PART ** 2

    @property
    def prior(self) -> tuple[Array, Array]:
        """Return mean and precision (1 over variance) of the normal priors; 0: none."""
        parameters = [self.parameter(free) for free in self.free]
        return (np.array([each.share(each.nominal) for each in parameters]),
                np.array([each.prior ** -2.0 for each in parameters]))


class Best(NamedTuple):
    """The most probable parameters: shares, cost (negative log posterior), residual."""

    theta: Array
    cost: float
    residual: Array


def most_probable(problem: Posterior, start: Array, rounds: int = ROUNDS,
                  known: Mapping[str, Array] = NONE, goal: float = math.inf) -> Best:
    """
    Return the most probable parameters, from a start.

    By the Levenberg-Marquardt method, with second derivatives along each step (Transtrum and
    Sethna, arXiv:1201.5885): sums of parameters are known far better than each, so the way to
    the minimum is long, narrow and bent. known: derivatives to begin with, by field. After each
    step all are updated by what it showed (Broyden's method); they are computed anew where that
    does not lead on, at most `rounds` times. Memories of the start are then sought in their whole
    range: what they change ends with a reversal of the motion, so that derivatives mislead.
    goal: a cost; a fit is given up if its rate or its derivatives show that it cannot reach this.
    """
    mean, precision = problem.prior

    theta, value = start, problem.residual(start)
    cost, damping = problem.cost(theta, value), DAMPING
    slopes, fresh = problem.jacobian(theta, known, value), not known
    since = cost   # the cost when the derivatives were last computed
    while True:
        if not np.isfinite(slopes).all():   # next to a plant that is none
            return Best(theta, cost if math.isfinite(cost) else math.inf, value)
        square = slopes.T @ slopes + np.diag(precision)
        slope = slopes.T @ value + precision * (theta - mean)
        before = cost
        if fresh and math.isfinite(goal):
            _, most = least_step(square, slope, -theta, 1.0 - theta)
            if cost - HOPE * most > goal:
                return Best(theta, cost, value)
        for _ in range(TRIES if fresh else 1):
            there = _next(problem, theta, value, slopes, square, slope, damping)
            value_there = problem.residual(there)
            if (cost_there := problem.cost(there, value_there)) < cost:
                step = there - theta
                missed = value_there - value - slopes @ step
                slopes = slopes + np.outer(missed, step / max(float(step @ step), 1e-300))
                theta, value, cost = there, value_there, cost_there
                damping = max(0.1 * damping, 1e-7)
                break
            damping = 10.0 * max(damping, 1e-3)
        if before - cost > GAIN + SLOW * before:
            fresh = False
            continue
        rounds -= 1
        ends = fresh and before - cost <= GAIN + CONVERGED * before
        if ends and rounds > 0:
            there = min(_elsewhere(problem, theta), default=theta, key=problem.cost)
            value_there = problem.residual(there)
            cost_there = problem.cost(there, value_there)
            if cost - cost_there > GAIN + CONVERGED * cost:
                theta, value, cost, ends = there, value_there, cost_there, False
        if rounds < 1 or ends or cost - rounds * (since - cost) > goal:
            return Best(theta, cost, value)
        slopes, fresh, since = problem.jacobian(theta, base=value), True, cost
        damping = min(damping, DAMPING)   # what failed with old derivatives may do with new ones


def _elsewhere(problem: Posterior, theta: Array) -> Iterator[Array]:
    """Yield the parameters with each memory of the start in turn at values in its whole range."""
    for number, free in enumerate(problem.free):
        if free.field.partition('@')[0] in MEMORIES:
            for share in np.linspace(0.0, 1.0, SCANNED):
                there = theta.copy()
                there[number] = share
                yield there


def _next(problem: Posterior, theta: Array, value: Array, slopes: Array, square: Array,
          slope: Array, damping: float) -> Array:
    """Return where a step leads, bent as the residual is along it."""
    damped = square + damping * np.diag(np.diag(square))
    low, high = np.maximum(-theta, -LONGEST_STEP), np.minimum(1.0 - theta, LONGEST_STEP)
    straight, _ = least_step(damped, slope, low, high)
    bend = 0.5 * slopes.T @ problem.curvature(theta, value, straight)
    bent, _ = least_step(damped, slope + bend, low, high)
    near = np.linalg.norm(bent - straight) < BENT * np.linalg.norm(straight)
    return np.clip(theta + (bent if near else straight), 0.0, 1.0)


def fitted(problem: Posterior, best: Best) -> Fitted:
    """Return a fit as the rest of the diagnosis takes it."""
    record = exact(problem.group, problem.record(best.theta))
    return Fitted(record, problem.free, best.theta, best.cost,
                  held_out_error(problem.group, record), problem)


def mean_squares(problem: Posterior, residual: Array) -> Array:
    """Return the mean square residual of each channel within its band, in error floors."""
    rows = residual.reshape(len(problem.group.channels), -1)
    return np.mean(rows ** 2, axis=1) / power(problem.group)


def power(group: Group) -> Array:
    """Return the mean square of a residual as large as the error floor, by channel."""
    return np.array([group.judged_share[channel] * group.weight[channel]
                     for channel in group.channels])


class Found(NamedTuple):
    """A hypothesis, its problem and most probable parameters."""

    names: Names
    variants: tuple[Variant, ...]
    problem: Posterior
    best: Best

    @property
    def over(self) -> Array:
        """The mean square that it leaves of each channel, in error floors as high as may be."""
        left = mean_squares(self.problem, self.best.residual)
        return left / (MARGIN + NOISE_ERROR / math.sqrt(self.best.residual.size / left.size))

    @property
    def left(self) -> bool:
        """Whether it leaves more than the error floor, as far as that is known."""
        return bool(self.over.max() > 1.0)

    @property
    def given(self) -> float:
        """The cost, in log prior density, of the deviations of the nominal parameters."""
        return self.problem.given(self.best.theta)

    @property
    def as_given(self) -> 'Found':
        """The same effects with all nominal parameters as they were given."""
        mean, precision = self.problem.prior
        theta = np.where(precision > 0.0, mean, self.best.theta)
        return self._replace(best=Best(theta, math.inf, self.problem.residual(theta)))
