"""A fitted hypothesis: what it leaves, and how probable its nominal parameters are."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.gap.inference.bounded_least_squares import least_step
from asi_analysis.gap.inference.fit import Fitted
from asi_analysis.gap.inference.posterior import (
    CONVERGED,
    ODDS_AGAINST,
    ROUNDS,
    Best,
    Posterior,
    fitted,
    kept,
    mean_squares,
    most_probable,
    power,
)
from asi_analysis.gap.inference.probability import Names
from asi_analysis.gap.model.effects import Variant, fields_of
from asi_analysis.gap.model.simulator import VALVE_ERROR
from asi_analysis.parallel import in_threads

# A right hypothesis may leave a mean square of MARGIN error floors, and of the uncertainty of the
# noise variance: it is estimated from fourth differences, and three standard errors of it are
# about NOISE_ERROR over the square root of the number of samples.
MARGIN, NOISE_ERROR = 1.1, 10.0
# A fit whose log posterior is farther below the best is given up; if that is so of the
# simulator's own laws, the machine's are formulated in another way.
COST_RANGE = 50.0
# Nearest to nominal: so many Jacobians, unless one lowers the prior's cost by little; the least
# weight of the data, bisections to find it; halvings of a step that goes too far.
NEARER, LITTLE, LEAST_WEIGHT, BISECTIONS, HALVINGS = 4, 0.05, 0.5 ** 8, 6, 4


class Found(NamedTuple):
    """A fitted hypothesis: its effects, their forms, its posterior and the maximum of that."""

    names: Names
    variants: tuple[Variant, ...]
    problem: Posterior
    best: Best

    @property
    def slopes(self) -> Array:
        """Return the Jacobian at the most probable parameters."""
        problem, best = self.problem, self.best
        return (best.slopes.astype(float) if best.slopes is not None and best.fresh
                else problem.jacobian(best.theta, base=best.residual))

    def at(self, theta: Array) -> 'Found':
        """Return the hypothesis at other parameters."""
        residual = self.problem.residual(theta)
        return self._replace(best=Best(theta, self.problem.cost(theta, residual), residual,
                                       self.best.slopes))

    def moved(self, problem: Posterior, theta: Array) -> 'Found':
        """Return the hypothesis at parameters of another problem, whose Jacobian is not known."""
        return self._replace(problem=problem, best=self.best._replace(slopes=None)).at(theta)

    def weighed_as(self, problem: Posterior) -> 'Found':
        """Return the hypothesis in a problem that only weighs the channels otherwise."""
        slopes, moved = self.best.slopes, self._replace(problem=problem).at(self.best.theta)
        if slopes is not None:
            of_channels, others = problem.split(slopes)
            ratio = (problem.weights() / self.problem.weights()).astype(slopes.dtype)
            slopes = np.concatenate([(ratio[:, None, None] * of_channels).reshape(
                -1, slopes.shape[1]), others])
        return moved._replace(best=moved.best._replace(slopes=slopes, fresh=self.best.fresh))

    def refined(self, rounds: int = ROUNDS, goal: float = math.inf,
                converged: float = CONVERGED, beside: float = math.inf) -> 'Found':
        """Return the hypothesis with its fit continued, as `most_probable` does."""
        return self._replace(best=most_probable(
            self.problem, self.best.theta, rounds, goal=goal, converged=converged,
            near=self.best, beside=beside))

    def lighter(self, share: float, rounds: int = ROUNDS) -> 'Found':
        """Return the hypothesis, refitted with this share of the weight of its data."""
        return self.weighed_as(self.problem.lighter(share)).refined(rounds).weighed_as(
            self.problem)

    @property
    def relative_residual(self) -> Array:
        """Return the mean square residual of each channel over the highest that noise explains."""
        return mean_squares(self.problem, self.best.residual) / self.explained

    @property
    def explained(self) -> float:
        """Return the highest mean square residual that noise explains, in error floors."""
        samples = self.best.residual.size / len(self.problem.group.channels)
        return MARGIN + NOISE_ERROR / math.sqrt(samples)

    @property
    def criterion(self) -> float:
        """
        Return half of the Bayesian information criterion, by which forms of an effect compare.

        A form with more parameters costs less, but may be less probable.
        """
        count = sum(len(variant.free) for variant in self.variants)
        return self.best.cost + 0.5 * count * math.log(self.best.residual.size)

    @property
    def largest_cost(self) -> float:
        """Return the highest cost of a residual that noise and any model error explain."""
        return float(self._largest_costs.sum())

    @property
    def cost_beyond(self) -> float:
        """
        Return the cost above that which noise and any model error explain.

        What a channel leaves counts, however little others do.
        """
        rows, _ = self.problem.split(self.best.residual)
        own = 0.5 * np.sum(rows ** 2, axis=1)
        return max(self.best.cost - self.largest_cost,
                   float(np.maximum(own - self._largest_costs, 0.0).sum()))

    @property
    def _largest_costs(self) -> Array:
        """Return the highest cost of each channel that noise and any model error explain."""
        rows, _ = self.problem.split(self.best.residual)
        return (0.5 * self.explained * rows.shape[1]
                * power(self.problem.group) * self._any_formulation)

    @property
    def _any_formulation(self) -> Array:
        """Return the error floor of laws formulated in another way, over that in use."""
        group = self.problem.group
        if group.other_formulation or group.floor_measured:
            return np.ones(len(group.channels))
        return np.array([1.0 + group.other_error[channel] / group.error_floor[channel]
                         for channel in group.channels])

    @property
    def far(self) -> bool:
        """Return whether it leaves more than noise and the model error of other formulations."""
        return bool((self.relative_residual / self._any_formulation).max() > 1.0)

    @property
    def unexplained(self) -> bool:
        """Return whether the residual of a channel is more than noise and model error explain."""
        return not bool(self.relative_residual.max() <= 1.0)   # also if it overflows

    @property
    def prior_cost(self) -> float:
        """Return the negative log prior density of the parameters with one, up to a constant."""
        return self.problem.prior_cost(self.best.theta)

    @property
    def odds_of_one_more(self) -> float:
        """
        Return the log odds for an unknown effect beside which the parameters are as usual.

        An effect may be imitated by nominal parameters or by errors of the valve's fit.
        """
        mean, precision = self.problem.prior
        # Of a usual parameter the mean of the prior's cost is a half.
        costs = 0.5 * (precision * (self.best.theta - mean) ** 2 - (precision > 0.0))
        nominal = [not free.field.startswith(VALVE_ERROR) for free in self.problem.free]
        return float(max(costs.sum(), costs[nominal].sum()) - ODDS_AGAINST)

    @property
    def improbable(self) -> bool:
        """Return whether the nominal parameters are far less probable than they usually are."""
        return self.odds_of_one_more > 0.0

    @property
    def may_lack_an_effect(self) -> bool:
        """Return whether a residual, or improbable nominal parameters, are left to explain."""
        return self.unexplained or self.improbable

    @property
    def as_fitted(self) -> Fitted:
        """Return the hypothesis as a `Fitted`, which the rest of the diagnosis uses."""
        return fitted(self.problem, self.best)

    @property
    def at_nominal(self) -> 'Found':
        """Return the hypothesis with the fitted effects, but the nominal parameter values."""
        _, precision = self.problem.prior
        theta = np.where(precision > 0.0, self.problem.nominal, self.best.theta)
        return self._replace(best=Best(theta, math.inf, self.problem.residual(theta)))


def changed(found: Mapping[Names, Found], change: Callable[[Found], Found]) -> dict[Names, Found]:
    """Return hypotheses, each changed by a function that runs in several threads."""
    return dict(zip(found, in_threads(change, found.values()), strict=True))


def cost_of(found: Found) -> float:
    """Return the negative log posterior of a fit, up to a constant: the key of `min`."""
    return found.best.cost


def at_values_of(found: Found, other: Found, fields: set[str]) -> Found:
    """
    Return a hypothesis at the values of another fit for some fields.

    With the integration error corrected as in that fit, if its sub-step is the same.
    """
    problem = found.problem
    substeps = {float(each.problem.record(each.best.theta)['maximum_substep'])
                for each in (found, other)}
    if len(substeps) == 1:
        problem = replace(problem, group=replace(
            problem.group, recordings=other.problem.group.recordings))
    return found.moved(problem, with_values_of(found, other, fields))


def with_values_of(found: Found, other: Found, fields: set[str]) -> Array:
    """Return a fit's parameter vector with the values of another fit for some fields."""
    values = other.problem.record(other.best.theta)
    return np.array([found.problem.parameter(free).share(float(values[free.field]))
                     if free.field in fields else share
                     for free, share in zip(found.problem.free, found.best.theta, strict=True)])


def freed_fields(found: Found) -> tuple[set[str], set[str]]:
    """Return the fields that are free in a fit, and those among them of its last effect."""
    return ({free.field for free in found.problem.free},
            fields_of(found.variants[-1:]))


def nearest_to_nominal(found: Found, equal: Array) -> Found:
    """
    Return a hypothesis with parameters as near to the nominal values as the model error allows.

    equal: mean square residual of each channel, in error floors, that the model error explains.
    The data get the least weight with which the residual stays below it (the discrepancy
    principle, Morozov 1966): that of the linearised problem, again about what it gives.
    """
    for _ in range(NEARER):
        nearer = _nearer(found, equal) if found.prior_cost > LITTLE else None
        if nearer is None or nearer.prior_cost > found.prior_cost - LITTLE:
            break
        found = nearer
    return found


def _nearer(found: Found, equal: Array) -> Found | None:
    """Return a hypothesis nearer to the nominal values, if a fit leaves no more than is equal."""
    problem = found.problem

    def is_equal(each: Found) -> bool:
        return bool((mean_squares(problem, each.best.residual) <= equal).all())

    if not is_equal(found):
        return None
    slopes = found.slopes
    found = found._replace(best=found.best._replace(slopes=kept(slopes), fresh=True))
    there = found.lighter(_least_weight(found, slopes, equal), 1)
    for _ in range(HALVINGS):   # the posterior is not linear
        if is_equal(there):
            break
        there = found.at(0.5 * (found.best.theta + there.best.theta))
    # Of a Jacobian there, only an update is known.
    return there._replace(best=there.best._replace(slopes=None)) if is_equal(there) else None


def _least_weight(found: Found, slopes: Array, equal: Array) -> float:
    """Return the least weight of the data with which the linearised residual stays `equal`."""
    problem, best = found.problem, found.best
    of_channels, others = problem.split(slopes)
    rows, rest = problem.split(best.residual)
    squares = np.einsum('cni,cnj->cij', of_channels, of_channels, optimize=True)
    along = np.einsum('cni,cn->ci', of_channels, rows, optimize=True)
    mean, precision = problem.prior
    # The measured gain of the valve keeps its weight.
    own_square = others.T @ others + np.diag(precision)
    own_slope = others.T @ rest + precision * (best.theta - mean)

    def is_equal(weight: float) -> bool:
        step, _ = least_step(weight * squares.sum(axis=0) + own_square,
                             weight * along.sum(axis=0) + own_slope,
                             -best.theta, 1.0 - best.theta)
        left = (np.sum(rows ** 2, axis=1) + 2.0 * along @ step
                + np.einsum('i,cij,j->c', step, squares, step))
        return bool((left <= equal * rows.shape[1] * power(problem.group)).all())

    enough, least = 1.0, LEAST_WEIGHT
    for _ in range(BISECTIONS):
        middle = math.sqrt(enough * least)
        enough, least = (middle, least) if is_equal(middle) else (enough, middle)
    return enough
