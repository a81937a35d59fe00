"""
Fit the nominal model, and each effect on top of it, to recordings.

The uncertain nominal parameters stay within their declared tolerance by hard bounds: let
loose, they swallow the effect. What is fitted on one part of the data is judged on another.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from asi_actuator.parameters import ACTUATOR_DTYPE
from asi_analysis.gap.inference.bounded_least_squares import least_step, minimise
from asi_analysis.gap.model.blocks import PLANT_DTYPE
from asi_analysis.gap.model.effects import OF_A_RECORDING, Free, Variant
from asi_analysis.gap.model.group import Group, Values, acts_on
from asi_analysis.gap.model.predict import measured, predict
from asi_analysis.gap.prepare import Array, Recording
from asi_common.jit import FULL

STEP = 1e-3          # of a parameter's range, for the derivatives
PRIOR_WEIGHT = 1.0           # of the start, on a parameter that is a whole range away
ROUNDS = 15          # of the optimiser
ROUGHLY, CLOSELY = 1e-3, 1e-4   # relative gain of a round that is not worth another
POLISHING = 6        # of those, with all derivatives
LARGEST = 3.0        # times a start that an effect is taken to be
NOMINAL_FIELDS = frozenset(ACTUATOR_DTYPE.names or ())
AT_LIMIT = 0.005     # of the way between bounds, within which a parameter rests on one
STARTS = 2           # of the best starting points that are followed


class Fitted(NamedTuple):
    """One hypothesis, fitted: its record, its parameters and what it leaves."""

    record: np.void
    free: tuple[Free, ...]
    theta: Array
    cost: float                  # on the fitted parts, weighed by the floors
    held_out: Values             # mean square residual on the held-out parts, by channel
    problem: 'Problem'

    @property
    def at_limit(self) -> dict[str, str]:
        """Return the nominal parameters that rest on a bound: 'low' or 'high', by field."""
        declared = {free for free in self.problem.group.nuisance
                    if free.scale == 'nominal' and free.field in NOMINAL_FIELDS}
        return {free.field: 'low' if share < 0.5 else 'high'
                for free, share in zip(self.free, self.theta, strict=True)
                if free in declared and min(share, 1.0 - share) < AT_LIMIT}

    @property
    def values(self) -> Values:
        """Return the fitted parameters."""
        return {free.field: float(self.record[free.field]) for free in self.free}


def _residual(group: Group, channel: str, p: np.void) -> Array:
    """Return what a channel leaves on the fitted parts, weighed by its floor."""
    parts = [(measured(recording, channel) - predict(recording, channel, p))[recording.fit]
             for recording in group.recordings if recording.fit.any()]
    return np.concatenate(parts) / math.sqrt(group.error_floor[channel])


def _unit(free: Free, group: Group, p: np.void) -> float:
    """Return what a free parameter's bounds are multiples of, in a record."""
    own = float(group.nominal[free.field])
    if free.scale in NOMINAL_FIELDS:
        return own * float(p[free.scale] / group.nominal[free.scale])
    return own if free.scale == 'nominal' else group.scale[free.scale]


def _bounds(free: Free, group: Group, p: np.void) -> tuple[float, float]:
    unit = _unit(free, group, p)
    return free.low * unit, free.high * unit


def _is_logarithmic(low: float, high: float) -> bool:
    return low > 0.0 and high > 50.0 * low


def _value(share: float, low: float, high: float) -> float:
    """Return the value at a share, 0 to 1, of the way between bounds."""
    if _is_logarithmic(low, high):
        return low * (high / low) ** share
    return low + share * (high - low)


def _share(value: float, low: float, high: float) -> float:
    """Return the inverse of `_value`, within 0.001 to 0.999; of what is beyond the bounds, too."""
    value = min(max(value, low), high)
    if _is_logarithmic(low, high):
        share = math.log(value / low) / math.log(high / low)
    else:
        share = (value - low) / (high - low)
    return min(max(share, 0.001), 0.999)


def _record(group: Group, free: Sequence[Free], theta: Array,
            fixed: Sequence[tuple[str, float]]) -> np.void:
    """Return the plant's record at a parameter vector (shares of the way between bounds)."""
    p = group.nominal.copy()
    for name, value in fixed:
        p[name] = value
    ratios_last = sorted(zip(free, theta, strict=True),
                         key=lambda pair: pair[0].scale in NOMINAL_FIELDS)
    for parameter, share in ratios_last:
        p[parameter.field] = _value(float(share), *_bounds(parameter, group, p))
    return p


def _comparable(recording: Recording, fit_on: Sequence[Recording]) -> npt.NDArray[np.bool_]:
    """Return the held-out samples whose inputs lie within the range that the fits have seen."""
    inside = recording.held_out.copy()
    for name in ('command', 'valve_position', 'velocity'):
        here = getattr(recording, name)
        seen = [getattr(other, name)[other.fit] for other in fit_on
                if other.fit.any() and getattr(other, name) is not None]
        if here is not None and seen:
            low, high = min(s.min() for s in seen), max(s.max() for s in seen)
            slack = 0.02 * (high - low)
            inside &= (here >= low - slack) & (here <= high + slack)
    return inside if inside.sum() > 0.2 * recording.held_out.sum() else recording.held_out


def held_out_error(group: Group, p: np.void) -> Values:
    """Return the mean square residual on the held-out parts, by channel."""
    residual = {}
    for channel in group.channels:
        total, count = 0.0, 0
        for recording in group.recordings:
            mask = _comparable(recording, group.recordings)
            error = (measured(recording, channel) - predict(recording, channel, p))[mask]
            total += float(error @ error)
            count += error.size
        residual[channel] = total / count
    return residual


def independent_samples(group: Group, p: np.void) -> Values:
    """
    Return how many independent samples the held-out parts are worth, by channel.

    Their number over the time, in samples, that what is residual goes on for: the sum of its
    autocorrelation up to where neighbours no longer agree (Geyer 1992).
    """
    worth = {}
    for channel in group.channels:
        worth[channel] = 0.0
        for recording in group.recordings:
            kept = recording.held_out.astype(float)
            residual = (measured(recording, channel) - predict(recording, channel, p)) * kept
            size = 2 * residual.size
            products = np.fft.irfft(np.abs(np.fft.rfft(residual, size)) ** 2)[:residual.size]
            pairs = np.fft.irfft(np.abs(np.fft.rfft(kept, size)) ** 2)[:residual.size]
            correlation = products / np.maximum(pairs, 1.0) * pairs[0] / max(products[0], 1e-300)
            twos = correlation[1:residual.size // 8 * 2 + 1].reshape(-1, 2).sum(axis=1)
            ends = int(np.argmax(np.append(twos, -1.0) <= 0.0))
            worth[channel] += kept.sum() / (1.0 + 2.0 * float(twos[:ends].sum()))
    return worth


def fit(group: Group, free: Sequence[Free], starts: Sequence[Array],
        fixed: Sequence[tuple[str, float]] = (), rounds: int = ROUNDS,
        known: Mapping[str, Array] = MappingProxyType({}), followed: int = STARTS) -> Fitted:
    """
    Return the best fit of the free parameters, from the best few of the starts.

    starts: parameter vectors, as shares of the way between bounds; the best `followed` of them
    are followed; known: derivatives, by field, that are taken for granted.
    """
    problem = Problem(group, tuple(free), tuple(fixed))
    ranked = sorted(starts, key=lambda theta: float(np.sum(problem.residual(theta) ** 2)))
    best_cost, best_theta = math.inf, ranked[0]
    for start in ranked[:followed if len(starts) > 3 else 1]:
        theta, cost = minimise(problem.residual, lambda theta: problem.jacobian(theta, known),
                               start, PRIOR_WEIGHT, rounds, ROUGHLY if known else CLOSELY)
        if cost < best_cost:
            best_cost, best_theta = cost, theta
    record = problem.record(best_theta)
    return Fitted(record, problem.free, best_theta, best_cost, held_out_error(group, record),
                  problem)


@dataclass
class Problem:
    """A least-squares problem: which parameters of a group are free, and what is fixed."""

    group: Group
    free: tuple[Free, ...]
    fixed: tuple[tuple[str, float], ...] = ()
    _key: bytes = b''
    _last: list[Array] = field(default_factory=list)

    def record(self, theta: Array) -> np.void:
        """Return the plant's record at a parameter vector."""
        return _record(self.group, self.free, theta, self.fixed)

    def _by_channel(self, theta: Array) -> list[Array]:
        if self._key != theta.tobytes():
            p = self.record(theta)
            self._last = [_residual(self.group, channel, p) for channel in self.group.channels]
            self._key = theta.tobytes()
        return self._last

    def residual(self, theta: Array) -> Array:
        """Return what is residual on the fitted parts, channel after channel, in floors."""
        return np.concatenate(self._by_channel(theta))

    def jacobian(self, theta: Array, known: Mapping[str, Array] = MappingProxyType({})) -> Array:
        """
        Return its derivatives, by differences; only of channels that a parameter acts on.

        known: those that are not worked out, by field.
        """
        base = self._by_channel(theta)
        columns = np.zeros((sum(part.size for part in base), theta.size))
        for i, parameter in enumerate(self.free):
            if parameter.field in known:
                columns[:, i] = known[parameter.field]
                continue
            step = STEP if theta[i] < 0.5 else -STEP
            moved = theta.copy()
            moved[i] += step
            p = self.record(moved)
            begin = 0
            for channel, part in zip(self.group.channels, base, strict=True):
                end = begin + part.size
                if acts_on(parameter.field, channel, self.group):
                    columns[begin:end, i] = (_residual(self.group, channel, p) - part) / step
                begin = end
        return columns


def with_known_gain(group: Group, valve: Fitted, tolerance: float) -> Group:
    """
    Return a group whose valve passes as much as the fit of the valve channel leaves possible.

    Command to valve position and valve position to force share the full opening: by itself each
    may be off by the tolerance of several parameters, together by that of the gain alone. Where
    the valve opens fully the thrust tells by itself; elsewhere only its ratio to the opening.
    """
    opening, thrust = ('valve_characteristic_full_opening', 'valve_characteristic_maximum_force')
    if not any(free.field == opening for free in group.nuisance):
        return group
    gain = float(valve.record['valve_characteristic_gain']
                 / valve.problem.group.nominal['valve_characteristic_gain'])
    low, high = 1.0 - tolerance, 1.0 + tolerance
    least, most = max(gain / high, low / high), min(gain / low, high / low)
    if least >= most:
        return group
    fully = (group.nominal['valve_characteristic_model'] == FULL
             and group.scale['valve_position'] > low * group.nominal[opening])
    ratio = Free(opening, least, most, (gain,), thrust if fully else 'nominal')
    return replace(group, nuisance=tuple(
        ratio if free.field == opening else free for free in group.nuisance
        if fully or free.field != thrust))


def fit_null(group: Group) -> Fitted:
    """
    Return the nominal model with its uncertain parameters refitted.

    To the end: a fit that is stuck here would make any effect look like an explanation.
    """
    theta = np.array([_share(_start(free, group), *_bounds(free, group, group.nominal))
                      for free in group.nuisance])
    return fit(group, group.nuisance, [theta], rounds=3 * ROUNDS)


def _fit_from(group: Group, problem: Problem, other: Fitted) -> Fitted:
    """Return the fit of a problem's parameters from where another fit has them."""
    theta = np.array([_share(float(other.record[free.field]), *_bounds(free, group, other.record))
                      for free in problem.free])
    return fit(group, problem.free, [theta], problem.fixed)


def refit(group: Group, fitted: Fitted, others: Sequence[Fitted]) -> Fitted:
    """Return a fit, tried again from where richer hypotheses took its parameters."""
    best = fitted
    for other in others:
        again = _fit_from(group, fitted.problem, other)
        best = min(best, again, key=lambda each: each.cost)
    return best


def _start(free: Free, group: Group, index: int = 0) -> float:
    return free.starts[index] * _unit(free, group, group.nominal)


def _added(group: Group, base: Fitted, variants: Sequence[Variant]
           ) -> tuple[Problem, list[Array]]:
    """Return the problem of a fit with the parameters of variants added, and its starts."""
    fixed = tuple(pair for variant in variants for pair in variant.fixed)
    known = {free.field for free in base.free}
    new: dict[str, Free] = {}
    for variant in variants:
        for free in variant.free:
            old = new.get(free.field)   # where both hold a field the wider bounds win
            new[free.field] = free if old is None else free._replace(
                low=min(free.low, old.low), high=max(free.high, old.high))
    frees = [free for free in base.free if free.field not in new] + list(new.values())
    warm = {free.field: _share(float(base.record[free.field]),
                               *_bounds(free, group, base.record))
            for free in frees if free.field in known}
    fresh = [free for free in new.values() if free.field not in known]
    starts = []
    for count, free in enumerate(fresh):
        for index in range(len(free.starts)):
            if index == 0 and count > 0:
                continue
            begin = warm | {
                other.field: _share(_start(other, group, index if other is free else 0),
                                    *_bounds(other, group, group.nominal)) for other in fresh}
            starts.append(np.array([begin[other.field] for other in frees]))
    if not fresh:
        starts.append(np.array([warm[free.field] for free in frees]))
    return Problem(group, tuple(frees), fixed), starts


def fit_subset(group: Group, null: Fitted, variants: Sequence[Variant], whole: Fitted) -> Fitted:
    """Return the fit of some of the variants of a fit, from where that has their parameters."""
    problem, _ = _added(group, null, variants)
    return _fit_from(group, problem, whole)


def fit_variants(group: Group, screen: 'LinearScreen', variants: Sequence[Variant],
                 followed: int = STARTS) -> Fitted:
    """
    Return the fit of one variant each of one or more effects, all together, nearly.

    screen: of the fit to start from (nested warm start): its parameters stay, those of the
    variants are added. Their derivatives change little, and are taken from there.
    followed: how many of the best starts are followed.
    """
    problem, starts = _added(group, screen.base, variants)
    # A nominal parameter that gets wider bounds has other derivatives: by shares of those.
    own = {free.field for variant in variants for free in variant.free}
    known = {name: column for name, column in screen.derivatives.items() if name not in own}
    return fit(group, problem.free, starts, problem.fixed, known=known, followed=followed)


def polish(group: Group, fitted: Fitted) -> Fitted:
    """Return a fit that is nearly there, fitted to the end with all derivatives."""
    return fit(group, fitted.free, [fitted.theta], fitted.problem.fixed, rounds=POLISHING)


class LinearScreen:
    """
    How much an effect on top of a fit could explain, from a few simulations of it.

    At each of its starts: the least squares of what is residual over the change that the effect
    makes, at any size up to LARGEST times, and over the parameters that are fitted already, all
    of it linear and within the bounds: those of the effect where it is a nominal parameter that
    is off by more than its tolerance.
    """

    def __init__(self, base: Fitted) -> None:
        self.base = base
        self._residual = base.problem.residual(base.theta)
        self._jacobian = base.problem.jacobian(base.theta)
        self.derivatives = {free.field: column for free, column
                            in zip(base.free, self._jacobian.T, strict=True)}
        self._square = self._jacobian.T @ self._jacobian
        self._right = self._jacobian.T @ self._residual

    def cost(self, group: Group, variants: Sequence[Variant]) -> float:
        """Return the cost that a fit of these variants may be expected to reach."""
        problem, starts = _added(group, self.base, variants)
        p = self.base.record
        wide = {free.field: _bounds(free, group, p) for free in problem.free}
        low, high = -self.base.theta, 1.0 - self.base.theta
        for i, free in enumerate(self.base.free):
            least, most = _bounds(free, group, p)
            low[i] += (wide[free.field][0] - least) / (most - least)
            high[i] += (wide[free.field][1] - most) / (most - least)
        own = any(free.field.partition('@')[0] in OF_A_RECORDING
                  for variant in variants for free in variant.free)
        return min(self._linear(problem.residual(start) - self._residual, low, high, own)
                   for start in starts)

    def _linear(self, change: Array, low: Array, high: Array, own: bool) -> float:
        group = self.base.problem.group
        changes, least = change[:, None], 0.0
        if own and group.nominal.dtype != PLANT_DTYPE:   # of another size in each recording
            number = np.concatenate([np.full(r.fit.sum(), r.number) for r in group.recordings])
            number = np.tile(number, len(group.channels))
            changes, least = change[:, None] * (number[:, None] == np.unique(number)), -LARGEST
        cross = self._jacobian.T @ changes
        square = np.block([[self._square, cross], [cross.T, changes.T @ changes]])
        count = changes.shape[1]
        _, gain = least_step(square, np.append(self._right, changes.T @ self._residual),
                             np.append(low, np.full(count, least)),
                             np.append(high, np.full(count, LARGEST)))
        return 0.5 * float(self._residual @ self._residual) - gain
