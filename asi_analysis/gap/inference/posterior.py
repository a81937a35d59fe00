"""
Posterior of a hypothesis under the simulator, and its maximum: the most probable parameters.

Likelihood: white noise on each channel. Priors: normal on the nominal parameters, with half their
tolerance as standard deviation; uniform between the bounds on those of effects (MacKay,
Information Theory, Inference and Learning Algorithms, 2003, ch. 27).
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from asi_analysis.arrays import Array
from asi_analysis.gap.inference.bounded_least_squares import least_step
from asi_analysis.gap.inference.fit import Fitted, Problem, held_out_error
from asi_analysis.gap.model.effects import Free
from asi_analysis.gap.model.group import (
    MODEL_ERROR,
    VALVE_GAIN,
    Group,
    exact,
    with_valve_gain,
)
from asi_analysis.gap.model.predict import judged_error
from asi_analysis.gap.model.simulator import metres_per_newton, moves_nothing
from asi_analysis.gap.model.start import MEMORIES
from asi_analysis.gap.prepare import first_of_recording
from asi_analysis.parallel import in_threads

# Finite differences, as shares of a parameter's range: the usual ones; and, where the cost is
# rough (stick and slip), WIDER times as wide, up to the widest. There the linearised problem
# promises more than ROUGH times what ends a fit, and yet steps hardly help.
STEP, WIDER, WIDEST_STEP, ROUGH = 1e-4, 10.0, 1e-2, 20.0
ROUNDS = 12       # at most so many Jacobians are computed in a fit
# Convergence: a round lowers the cost by less than GAIN plus CONVERGED times the cost.
GAIN, CONVERGED = 0.05, 3e-4
# Damping of Levenberg and Marquardt: at first, and so small that no less is tried; the factor by
# which it is changed; steps that are tried; the share of the promised gain that is enough.
DAMPING, LEAST_DAMPING, CHANGE, TRIES, ENOUGH = 1e-4, 1e-7, 10.0, 8, 0.5
# A residual is far from explained if its cost is FAR times that of noise. Then a part of the
# recordings is fitted first: with a small weight of the data, then HEAVIER times more, so many
# Jacobians each; at the end until a round gains less than a share of the cost.
FAR, PART, HEAVIER, LIGHT_ROUNDS, ROUGHLY = 10.0, 0.125, 100.0, 3, 0.03
REST = 0.5   # of the noise of the rest counts as left by any fit
RUNS = 3   # simulations of a step, where a Jacobian takes one for each parameter
MOST_STEPS = 2   # for each parameter, with Broyden's updates of one Jacobian
LEAST_COST = 1e-300
GAIN_MARGIN = 2.0   # a fit can gain at most this times what its linearisation promises
LONGEST_STEP = 0.3   # as a share of a parameter's range
SCAN_POINTS = 9     # values of an initial state that are tried where gradients mislead
# Of a step: the share of it for second differences; the largest correction for curvature.
CURVATURE_STEP, MOST_CURVATURE = 0.1, 0.4

# Log prior odds against each effect, and each parameter beyond its tolerance: 4 % for all of about
# forty together, so that a false alarm is rare.
ODDS_AGAINST = 7.0
SLIGHT = 0.5 * ODDS_AGAINST   # a gain of an effect that cannot make it probable
MOST_KEPT = 2 ** 25   # bytes of a Jacobian that is kept

NONE: Mapping[str, Array] = MappingProxyType({})
Slopes = npt.NDArray[np.float32]   # half of the memory; finite differences are less exact


@dataclass
class Posterior(Problem):
    """The negative log posterior of a group's free parameters, as a least-squares problem."""

    def residual(self, theta: Array) -> Array:
        """Return the residual divided by the rms error floor, channel after channel."""
        return self._residual_of(self.record(theta))

    def cost(self, theta: Array, residual: Array | None = None) -> float:
        """Return the negative log posterior, up to a constant; residual: if it is known."""
        residual = self.residual(theta) if residual is None else residual
        return 0.5 * float(residual @ residual) + self.prior_cost(theta)

    def prior_cost(self, theta: Array) -> float:
        """Return the negative log density of the normal priors, up to a constant."""
        mean, precision = self.prior
        return 0.5 * float(precision @ (theta - mean) ** 2)

    @property
    def noise_cost(self) -> float:
        """Return the cost of a residual that is as large as the error floor."""
        return 0.5 * float(power(self.group).sum()) * self._rows

    @property
    def least_cost(self) -> float:
        """Return the cost of a residual that is noise alone, without the errors of a model."""
        group = self.group
        shares = [group.noise[channel] ** 2 / group.error_floor[channel]
                  for channel in group.channels]
        return 0.5 * float(power(group) @ shares) * self._rows

    @property
    def _rows(self) -> int:
        """Return the number of samples of a channel that are compared."""
        return sum(int(np.count_nonzero(r.known)) for r in self.group.recordings)

    def is_far(self, cost: float) -> bool:
        """Return whether a cost is far above what noise explains."""
        return cost > FAR * self.noise_cost

    def first_part(self, share: float) -> 'Posterior':
        """Return the posterior under the first share of each recording alone."""
        return replace(self, group=replace(self.group, recordings=[
            first_of_recording(each, share) for each in self.group.recordings]))

    def lighter(self, share: float) -> 'Posterior':
        """Return the posterior with this share of the weight of its data."""
        group = self.group
        return replace(self, group=replace(group, weight={
            channel: share * value for channel, value in group.weight.items()}))

    def start(self, free: Free, value: float) -> float:
        """Return a start value (relative, as in `Free`) as a share of the range, off its ends."""
        own = self.parameter(free)
        unit = own.high / free.high if free.high else 1.0
        return min(max(own.share(value * unit), 0.001), 0.999)

    def _residual_of(self, p: np.void) -> Array:
        """Return the residual of a record, as `residual` does."""
        parts = []
        for channel, scale in zip(self.group.channels, self.weights(), strict=True):
            parts += [scale * judged_error(r, channel, p)[r.known]
                      for r in self.group.recordings if r.known.any()]
        return np.concatenate([*parts, self._valve_gain_residual(p)])

    def _valve_gain_residual(self, p: np.void) -> Array:
        """Return the residual of the valve's gain; empty if that was not measured."""
        known = self.group.valve_gain
        return np.array([] if known is None else [
            math.log(metres_per_newton(p) / known) / MODEL_ERROR])

    def split(self, rows: Array) -> tuple[Array, Array]:
        """
        Return the rows of a residual or Jacobian: by channel (channels, samples, ...), and others.

        The others: of the gain of the valve, if it was measured.
        """
        others = int(self.group.valve_gain is not None)
        of_channels, rest = np.split(rows, [rows.shape[0] - others])
        count = len(self.group.channels)
        return of_channels.reshape(count, -1, *rows.shape[1:]), rest

    def weights(self) -> Array:
        """Return the factor of each channel's error in the residual."""
        return np.sqrt([self.group.weight[channel] / self.group.error_floor[channel]
                        for channel in self.group.channels])

    def jacobian(self, theta: Array, known: Mapping[str, Array] = NONE,
                 base: Array | None = None, size: float | Array = STEP) -> Array:
        """
        Return the Jacobian of the residual: samples by parameters, from finite differences.

        known: columns, by field, that are not computed again; base: the residual, if known;
        size: of the differences, as a share of each range, perhaps by parameter.
        """
        residual = self.residual(theta) if base is None else base
        steps = np.where(theta < 0.5, size, -np.asarray(size))

        def column(number: int) -> Array:
            name = self.free[number].field
            if name in known:
                return known[name]
            moved, step = theta.copy(), float(steps[number])
            moved[number] += step
            return (self._residual_of(self.record(moved)) - residual) / step

        # First those with the motion of the base, as long as that is cached.
        order = sorted(range(theta.size), key=lambda number: not moves_nothing(
            self.free[number].field))
        columns = np.empty((theta.size, residual.size))
        for number, values in zip(order, in_threads(column, order), strict=True):
            columns[number] = values
        return columns.T

    def curvature(self, theta: Array, base: Array, step: Array) -> Array:
        """Return the second directional derivative of the residual along a step."""
        ahead, back = in_threads(
            lambda part: self.residual(np.clip(theta + part * step, 0.0, 1.0)),
            (CURVATURE_STEP, -CURVATURE_STEP))
        return (ahead - 2.0 * base + back) / CURVATURE_STEP ** 2

    @cached_property
    def prior(self) -> tuple[Array, Array]:
        """Return mean and precision (1 / variance) of the normal priors; 0 where there is none."""
        return (np.array([each.share(each.nominal) for each in self.parameters]),
                np.array([each.prior ** -2.0 for each in self.parameters]))

    @property
    def nominal(self) -> Array:
        """Return the nominal parameter values, with the gain of the valve that was measured."""
        theta = self.prior[0].copy()
        for number, free in enumerate(self.free):
            if free.field == VALVE_GAIN:
                p = with_valve_gain(self.group, self.record(theta))
                theta[number] = self.parameter(free).share(float(p[VALVE_GAIN]))
        return theta


class Best(NamedTuple):
    """The most probable parameters: shares of the ranges, negative log posterior, residual."""

    theta: Array
    cost: float
    residual: Array
    slopes: Slopes | None = None   # the Jacobian there, or near
    fresh: bool = False            # whether it was computed in this fit, perhaps updated since


def most_probable(problem: Posterior, start: Array, rounds: int = ROUNDS,
                  known: Mapping[str, Array] = NONE, goal: float = math.inf,
                  converged: float = CONVERGED, near: Best | None = None,
                  without: float = math.inf, beside: float = math.inf) -> Best:
    """
    Return the most probable parameters, from a start, as `_maximised` does.

    A fit of more than a few rounds that begins far from explaining the recordings is made on
    their first part before. What leaves more of that part than the goal allows is given up.
    """
    point = _Point.of(problem, start)
    if rounds >= ROUNDS and problem.is_far(point.cost):
        found = of_first_part(problem, start, goal)
        there = _Point.of(problem, found.theta)
        if there.cost < point.cost:
            point, known, near = there, NONE, None
        if found.cost > goal:
            return Best(point.theta, point.cost, point.residual)
    return _maximised(problem, point.theta, rounds, known, goal, converged, near, without,
                      beside)


def of_first_part(problem: Posterior, start: Array, goal: float = math.inf) -> Best:
    """
    Return the most probable parameters, given the first part of the recordings alone, roughly.

    By continuation (Allgower and Georg, Introduction to Numerical Continuation Methods, 2003): the
    data have little weight at first, so that nominal parameters stay near their values until an
    effect explains what is large; else they imitate it, and the fit ends in a local minimum.
    Its cost is the least that the whole may have: noise is left of the rest, too. goal: as in
    `most_probable`, of the whole; far above it even with a small weight, a fit is given up.
    """
    part, theta = problem.first_part(PART), start
    rest = REST * min(goal, problem.least_cost - part.least_cost)
    found = _of_part(part, theta, goal - rest)
    return found._replace(cost=found.cost + rest)


def _of_part(part: Posterior, theta: Array, goal: float) -> Best:
    """Return the most probable parameters of a first part, as `of_first_part` finds them."""
    cost = part.cost(theta)
    share = theta.size / cost if math.isfinite(cost) else 1.0
    while share < 1.0:
        light = _maximised(part.lighter(share), theta, LIGHT_ROUNDS)
        if light.cost > FAR * goal:
            return light
        theta = light.theta
        share *= HEAVIER
    return _maximised(part, theta, goal=goal, converged=ROUGHLY)


def _maximised(problem: Posterior, start: Array, rounds: int = ROUNDS,
               known: Mapping[str, Array] = NONE, goal: float = math.inf,
               converged: float = CONVERGED, near: Best | None = None,
               without: float = math.inf, beside: float = math.inf) -> Best:
    """
    Return the most probable parameters, from a start.

    By the Levenberg-Marquardt method, with second derivatives along each step (Transtrum and
    Sethna, arXiv:1201.5885): parameters are strongly correlated, so the minimum lies at the end
    of a narrow curved valley. known: columns of the first Jacobian, by field. After each step it
    gets Broyden's update; it is computed again, up to `rounds` in all, where a step gains less, in
    the log of the cost, than the mean of all since then, the Jacobian counted as steps. At the
    end, initial states with memory (flux, seals) are scanned over their whole range: their
    influence ends at a reversal of the motion, so that gradients mislead.
    goal: a cost; a fit that will not reach it, by its rate or its Jacobian, is given up.
    converged: the last round gains less than GAIN and this share of the cost; no step is tried
    where a fresh Jacobian promises no more; near: a fit of the same problem whose Jacobian is
    used at first; without: the cost of the fit without the last effect. A fit that ends within
    SLIGHT of it with the `known` Jacobian, which promises no more, is given up. beside: a cost
    with which it hardly counts; above that it is found roughly.
    """
    at, damping = _Point.of(problem, start), DAMPING
    if near is None or near.slopes is None:
        slopes, fresh = problem.jacobian(at.theta, known, at.residual), not known
    else:
        slopes, fresh = near.slopes.astype(float), near.fresh
    computed, size = fresh, STEP
    since, steps = at.cost, at.theta.size / RUNS   # the cost when it was computed; its price
    while True:
        linear = _Linearised.of(problem, at, slopes)
        if linear is None:   # beside parameters with which no plant is possible
            return Best(at.theta, at.cost if math.isfinite(at.cost) else math.inf, at.residual)
        least = at.cost - GAIN_MARGIN * linear.most
        if since == at.cost and (fresh or known) and least > goal:   # a Jacobian just computed
            return at.best(slopes, computed)
        before = at.cost
        enough = GAIN + converged * before + ROUGHLY * max(before - beside, 0.0)
        settled = fresh and GAIN_MARGIN * linear.most <= enough
        there, damping, tried = linear.step(damping, 0 if settled else TRIES if fresh else 1)
        if there is not None:
            slopes, at = linear.updated(there), there
        steps += tried
        ends = fresh and before - at.cost <= enough
        if not ends and before - at.cost > GAIN and steps < MOST_STEPS * at.theta.size and (
                steps * _log_ratio(before, at.cost) > tried * _log_ratio(since, at.cost)):
            fresh = False
            continue
        if not computed and abs(at.cost - without) < SLIGHT and least > without - SLIGHT:
            return at.best(slopes, computed)
        rounds -= 1
        if ends and linear.most > ROUGH * enough and size < WIDEST_STEP:
            ends, size = False, WIDER * size
        if ends and rounds > 0:
            scanned = min((_Point.of(problem, theta) for theta in _scanned_memories(
                problem, at.theta)), default=at, key=lambda point: point.cost)
            if at.cost - scanned.cost > enough:
                at, ends = scanned, False
        if rounds < 1 or ends or (computed and at.cost - rounds * (since - at.cost) > goal):
            return at.best(slopes, computed)
        slopes = problem.jacobian(at.theta, base=at.residual, size=size)
        since, steps, computed, fresh = at.cost, at.theta.size / RUNS, True, True


def _log_ratio(before: float, after: float) -> float:
    """Return the log of the ratio of two costs, the later of which may be 0."""
    return math.log(max(before, LEAST_COST) / max(after, LEAST_COST))


class _Point(NamedTuple):
    """Parameters, with their residual and negative log posterior."""

    theta: Array
    residual: Array
    cost: float

    @staticmethod
    def of(problem: Posterior, theta: Array) -> '_Point':
        """Return the point of these parameters."""
        residual = problem.residual(theta)
        return _Point(theta, residual, problem.cost(theta, residual))

    def best(self, slopes: Array, fresh: bool) -> Best:
        """Return the point as the result of a fit."""
        return Best(self.theta, self.cost, self.residual, kept(slopes), fresh)


class _Linearised(NamedTuple):
    """A posterior about a point: Jacobian, normal equations, the largest gain they promise."""

    problem: Posterior
    at: _Point
    slopes: Array
    square: Array
    slope: Array
    most: float

    @staticmethod
    def of(problem: Posterior, at: _Point, slopes: Array) -> '_Linearised | None':
        """Return the posterior, linearised about a point by a Jacobian, unless that overflows."""
        mean, precision = problem.prior
        square = slopes.T @ slopes + np.diag(precision)
        if not np.isfinite(square).all():
            return None
        slope = slopes.T @ at.residual + precision * (at.theta - mean)
        most = least_step(square, slope, -at.theta, 1.0 - at.theta)[1]
        return _Linearised(problem, at, slopes, square, slope, most)

    def step(self, damping: float, tries: int) -> tuple[_Point | None, float, int]:
        """
        Return the best of steps with several dampings, if one helps, its damping, their number.

        A Jacobian costs as much as ten steps, and how much damping gains most changes along a
        curved valley by orders of magnitude. More is tried until a step helps, then less, down to
        what does not gain more, until a step gains most of what is promised.
        """
        best, least = None, 0.0   # least: the largest damping that gains less than the best
        tried = 0
        while tried < tries:
            tried += 1
            there = _Point.of(self.problem, self._damped(damping))
            if there.cost < (best or self.at).cost:
                best, chosen = there, damping
                if self.at.cost - there.cost > ENOUGH * self.most or damping <= LEAST_DAMPING:
                    break
            else:
                least = damping
            if best is None:
                damping = CHANGE * damping
            elif chosen > 0.5 * CHANGE * least:
                damping = math.sqrt(chosen * least) if least else chosen / CHANGE
            else:
                break
        return best, damping if best is None else chosen, tried

    def updated(self, there: _Point) -> Array:
        """Return the Jacobian after a step, with Broyden's update."""
        step = there.theta - self.at.theta
        missed = there.residual - self.at.residual - self.slopes @ step
        return self.slopes + np.outer(missed, step / max(float(step @ step), 1e-300))

    def _damped(self, damping: float) -> Array:
        """Return the parameters after a damped step, corrected for the residual's curvature."""
        theta = self.at.theta
        damped = self.square + damping * np.diag(np.diag(self.square))
        low, high = np.maximum(-theta, -LONGEST_STEP), np.minimum(1.0 - theta, LONGEST_STEP)
        straight, _ = least_step(damped, self.slope, low, high)
        bend = 0.5 * self.slopes.T @ self.problem.curvature(theta, self.at.residual, straight)
        bent, _ = least_step(damped, self.slope + bend, low, high)
        near = np.linalg.norm(bent - straight) < MOST_CURVATURE * np.linalg.norm(straight)
        return np.clip(theta + (bent if near else straight), 0.0, 1.0)


def kept(slopes: Array) -> Slopes | None:
    """Return a Jacobian to be kept, unless it is too large."""
    return slopes.astype(np.float32) if 4 * slopes.size <= MOST_KEPT else None


def _scanned_memories(problem: Posterior, theta: Array) -> Iterator[Array]:
    """Yield the parameters with each initial state that has a memory, at values in its range."""
    for number, free in enumerate(problem.free):
        if free.field.partition('@')[0] in MEMORIES:
            for share in np.linspace(0.0, 1.0, SCAN_POINTS):
                there = theta.copy()
                there[number] = share
                yield there


def fitted(problem: Posterior, best: Best) -> Fitted:
    """Return a fit as a `Fitted`, which the rest of the diagnosis uses."""
    record = exact(problem.group, problem.record(best.theta))
    return Fitted(record, problem.free, best.theta, best.cost,
                  held_out_error(problem.group, record), problem)


def mean_squares(problem: Posterior, residual: Array) -> Array:
    """Return the mean square residual of each channel within its band, in error floors."""
    rows, _ = problem.split(residual)
    return np.mean(rows ** 2, axis=1) / power(problem.group)


def power(group: Group) -> Array:
    """
    Return the mean square of the weighted residual of each channel at the error floor.

    The share of white noise that passes the channel's band, times the weight of its samples.
    """
    return np.array([group.judged_share[channel] * group.weight[channel]
                     for channel in group.channels])
