"""
Posterior of a hypothesis under the simulator: the most probable parameters, and the evidence.

Likelihood: white noise on each channel. Priors: normal on the nominal parameters, by their
tolerance; uniform between the bounds on those of effects. The evidence is that of Laplace's
approximation, with the noise that the best hypothesis leaves and its effective sample size, so
that a model error counts as coloured noise (MacKay, Information Theory, Inference and Learning
Algorithms, 2003, ch. 27 and 28).
"""

import math
import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from asi_analysis.gap.inference.bounded_least_squares import least_step
from asi_analysis.gap.inference.fit import Fitted, Problem, held_out_error
from asi_analysis.gap.model.effects import Free
from asi_analysis.gap.model.predict import measured, predict
from asi_analysis.gap.prepare import Array

STEP = 1e-4       # of a parameter's range, for the derivatives
ROUNDS = 12       # of the optimiser
GAIN = 0.05       # of the log posterior: a round that gains less is the last
TRIES = 5         # of a step, with more damping each
LONGEST_STEP = 0.3


@dataclass
class Posterior(Problem):
    """The negative log posterior of a group's free parameters, as a least-squares problem."""

    pool: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(
        len(os.sched_getaffinity(0))))

    def residual(self, theta: Array) -> Array:
        """Return the residual over the error floor (rms), channel after channel."""
        return self._of(self.record(theta))

    def start(self, free: Free, value: float) -> float:
        """Return the share of a start value (relative, as in `Free`), off the bounds."""
        own = self.parameter(free)
        unit = own.high / free.high if free.high else 1.0
        return min(max(own.share(value * unit), 0.001), 0.999)

    def _of(self, p: np.void) -> Array:
        parts = []
        for channel in self.group.channels:
            scale = 1.0 / math.sqrt(self.group.error_floor[channel])
            parts += [scale * (measured(r, channel) - predict(r, channel, p))[r.known]
                      for r in self.group.recordings if r.known.any()]
        return np.concatenate(parts)

    def jacobian(self, theta: Array, known: Mapping[str, Array] | None = None) -> Array:
        """Return its derivatives; `known` ones, by field, are not computed again."""
        known, base = known or {}, self.residual(theta)

        def column(number: int) -> Array:
            name = self.free[number].field
            if name in known:
                return known[name]
            moved = theta.copy()
            step = STEP if theta[number] < 0.5 else -STEP
            moved[number] += step
            return (self._of(self.record(moved)) - base) / step

        return np.array(list(self.pool.map(column, range(theta.size)))).T

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
                  known: Mapping[str, Array] | None = None) -> Best:
    """Return the most probable parameters, from a start, by the Levenberg-Marquardt method."""
    mean, precision = problem.prior

    def cost_of(theta: Array, value: Array) -> float:
        return 0.5 * float(value @ value) + 0.5 * float(precision @ (theta - mean) ** 2)

    theta, value = start, problem.residual(start)
    cost, damping = cost_of(theta, value), 1e-4
    for _ in range(rounds):
        slopes = problem.jacobian(theta, known)
        square = slopes.T @ slopes + np.diag(precision)
        slope = slopes.T @ value + precision * (theta - mean)
        before = cost
        for _ in range(TRIES):
            step, _ = least_step(
                square + damping * np.diag(np.diag(square)), slope,
                np.maximum(-theta, -LONGEST_STEP), np.minimum(1.0 - theta, LONGEST_STEP))
            there = np.clip(theta + step, 0.0, 1.0)
            value_there = problem.residual(there)
            if (cost_there := cost_of(there, value_there)) < cost:
                theta, value, cost = there, value_there, cost_there
                damping = max(0.1 * damping, 1e-7)
                break
            damping = 10.0 * max(damping, 1e-3)
        if before - cost <= GAIN + 1e-4 * before:
            break
    return Best(theta, cost, value)


def fitted(problem: Posterior, best: Best) -> Fitted:
    """Return a fit as the rest of the diagnosis takes it."""
    record = problem.record(best.theta)
    return Fitted(record, problem.free, best.theta, best.cost,
                  held_out_error(problem.group, record), problem)


def mean_squares(problem: Posterior, residual: Array) -> Array:
    """Return the mean square residual of each channel, in error floors."""
    return np.mean(residual.reshape(len(problem.group.channels), -1) ** 2, axis=1)
