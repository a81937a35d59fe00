"""
Fit the nominal model, alone and with effects, to recordings.

The uncertain nominal parameters are bounded by their tolerance: without bounds they absorb the
effect. Fits are compared on another part of the data.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from asi_actuator.parameters import ACTUATOR_DTYPE
from asi_analysis.arrays import Array
from asi_analysis.free_parameter import FreeParameter, Scale
from asi_analysis.gap.inference.bounded_least_squares import least_step, minimise
from asi_analysis.gap.model.effects import (
    FLOATING,
    OF_A_RECORDING,
    OSCILLATION,
    Free,
    Variant,
    fields_of,
)
from asi_analysis.gap.model.group import Group, Values, acts_on
from asi_analysis.gap.model.predict import judged_error, measured, predict, unexplained
from asi_analysis.gap.prepare import Recording
from asi_analysis.gap.sampling import independent
from asi_common.jit import FULL
from asi_common.record import copy_of

STEP = 1e-3          # of a parameter's range, for finite differences
PRIOR_WEIGHT = 1.0   # of the deviation from the start by a parameter's range, as a residual
ROUNDS = 15          # of the optimiser
COARSE_TOLERANCE, FINE_TOLERANCE = 1e-3, 1e-4   # relative gain of the last round
POLISH_ROUNDS = 6    # rounds with the full Jacobian, at the end
MASS_SHARES = (0.25, 0.5, 0.75)  # further starts of a share of the mass, relative to its range
LARGEST = 3.0        # upper bound of an effect in the linear screen, as a multiple of its start
NOMINAL_FIELDS = frozenset(ACTUATOR_DTYPE.names or ())
AT_LIMIT = 0.005     # of the range: distance within which a parameter is at a bound
STARTS, FEW_STARTS = 2, 3   # so many of the best starts are fitted, but of few only one
LINE = ('offset', 'gain')   # of a static characteristic
LOG_RANGE = 50.0     # ratio of bounds above which a parameter has a logarithmic scale


class Fitted(NamedTuple):
    """The fit of a hypothesis: its record, parameters and residuals."""

    record: np.void
    free: tuple[Free, ...]
    theta: Array
    cost: float                  # on the fitted parts, in units of `Group.fit_unit`
    held_out: Values             # mean square residual on the held-out parts, by channel
    problem: 'Problem'

    @property
    def at_limit(self) -> dict[str, str]:
        """Return the nominal parameters at a bound: 'low' or 'high', by field."""
        nominal = self.problem.group.nominal
        ratios = {free: self.record[free.field] / nominal[free.field] - 1.0
                  for free in self.free if free.scale == 'nominal' and free.prior < math.inf}
        if ratios:
            return {free.field: 'high' if ratio > 0.0 else 'low'
                    for free, ratio in ratios.items() if abs(ratio) > 2.0 * free.prior}
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
    """Return the residual of a channel on the fitted parts, divided by its rms unit."""
    parts = [(measured(recording, channel) - predict(recording, channel, p))[recording.fit]
             for recording in group.recordings if recording.fit.any()]
    return np.concatenate(parts) / math.sqrt(group.fit_unit(channel))


def _unit(free: Free, group: Group, p: np.void) -> float:
    """Return the unit of a free parameter's bounds, given the record of a plant."""
    own = float(group.nominal[free.field])
    if free.scale in NOMINAL_FIELDS:
        return own * float(p[free.scale] / group.nominal[free.scale])
    return own if free.scale == 'nominal' else group.scale[free.scale]


def _parameter(free: Free, group: Group, p: np.void) -> FreeParameter:
    """
    Return a free parameter with bounds in its own unit.

    p: record that holds the parameter which `free.scale` refers to.
    """
    unit = _unit(free, group, p)
    low, high = sorted((free.low * unit, free.high * unit))
    scale = Scale.LOG if low > 0.0 and high > LOG_RANGE * low else Scale.LINEAR
    nominal, prior = float(group.nominal[free.field]), math.inf
    if free.prior < math.inf:
        prior = free.prior * (abs(unit) / (high - low) if scale is Scale.LINEAR
                              else 1.0 / math.log(high / low))
    return FreeParameter(free.field, nominal, low, high, scale, prior)


def _share(parameter: FreeParameter, value: float) -> float:
    """Return a start value as a share of the range, off its ends."""
    return min(max(parameter.share(value), 0.001), 0.999)


def comparable(recording: Recording, fit_on: Sequence[Recording]) -> npt.NDArray[np.bool_]:
    """Return the held-out samples whose inputs are within the range of the fitted parts."""
    inside = recording.held_out.copy()
    for name in ('command', 'valve_position', 'velocity'):
        here = getattr(recording, name)
        fitted = [getattr(other, name)[other.fit] for other in fit_on
                if other.fit.any() and getattr(other, name) is not None]
        if here is not None and fitted:
            low, high = min(s.min() for s in fitted), max(s.max() for s in fitted)
            slack = 0.02 * (high - low)
            inside &= (here >= low - slack) & (here <= high + slack)
    return inside if inside.sum() > 0.2 * recording.held_out.sum() else recording.held_out


def held_out_error(group: Group, p: np.void) -> Values:
    """Return the mean square residual on the held-out parts, by channel."""
    residual = {}
    for channel in group.channels:
        total, count = 0.0, 0
        for recording in group.recordings:
            # A characteristic has few parameters and may deviate anywhere: hence all samples.
            mask = recording.known if channel == 'static' else comparable(
                recording, group.recordings)
            error = unexplained(recording, channel, p)[mask]
            total += float(error @ error)
            count += error.size
        residual[channel] = total / count
    return residual


def independent_samples(group: Group, p: np.void, of: str = 'held_out') -> Values:
    """
    Return the effective sample size of the residual on a part of the data, by channel.

    of: a mask of the recording: 'fit', 'held_out' or 'known'.
    """
    return {channel: sum(independent(judged_error(recording, channel, p),
                                     getattr(recording, of).astype(float))
                         for recording in group.recordings) for channel in group.channels}


def fit(group: Group, free: Sequence[Free], starts: Sequence[Array],
        fixed: Sequence[tuple[str, float]] = (), rounds: int = ROUNDS,
        known: Mapping[str, Array] = MappingProxyType({}), followed: int = 1) -> Fitted:
    """
    Return the best fit of the free parameters, from the best of the starts.

    starts: parameter vectors, as shares of the ranges; the best `followed` of them are fitted;
    known: columns of the Jacobian by field, which are not computed again.
    """
    problem = Problem(group, tuple(free), tuple(fixed))
    if {*LINE} & {each.field for each in free}:
        starts = [_with_line_fitted(problem, theta) for theta in starts]
    ranked = sorted(starts, key=lambda theta: float(np.sum(problem.residual(theta) ** 2)))
    best_cost, best_theta = math.inf, ranked[0]
    tolerance = COARSE_TOLERANCE if known else FINE_TOLERANCE
    for start in ranked[:followed]:
        theta, cost = minimise(
            problem.residual, lambda theta, base: problem.jacobian(theta, known, base), start,
            PRIOR_WEIGHT, rounds, tolerance)
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

    @cached_property
    def parameters(self) -> tuple[FreeParameter, ...]:
        """Return the free parameters with their bounds in their own units."""
        return tuple(self.parameter(free) for free in self.free)

    def record(self, theta: Array) -> np.void:
        """Return the plant's record at a parameter vector (shares of the ranges)."""
        p, ratios = copy_of(self.group.nominal), []
        for name, value in self.fixed:
            p[name] = value
        for free, parameter, share in zip(self.free, self.parameters, theta, strict=True):
            if free.scale in NOMINAL_FIELDS:
                ratios.append((free, share))
            else:
                p[free.field] = parameter.value(float(share))
        for free, share in ratios:
            p[free.field] = _parameter(free, self.group, p).value(float(share))
        return p

    def theta(self, p: np.void) -> Array:
        """Return the parameter vector (shares of the ranges) of a plant's record."""
        return np.array([each.share(float(p[free.field]))
                         for free, each in zip(self.free, self.parameters, strict=True)])

    def columns(self, jacobian: Array) -> dict[str, Array]:
        """Return the columns of a Jacobian by the fields of the free parameters."""
        return dict(zip((free.field for free in self.free), jacobian.T, strict=True))

    def parameter(self, free: Free) -> FreeParameter:
        """Return a free parameter with its bounds in its own unit."""
        return _parameter(free, self.group, self.group.nominal)

    def residual(self, theta: Array) -> Array:
        """Return the weighted residual on the fitted parts, channel after channel."""
        p = self.record(theta)
        return np.concatenate([_residual(self.group, each, p) for each in self.group.channels])

    def jacobian(self, theta: Array, known: Mapping[str, Array] = MappingProxyType({}),
                 base: Array | None = None) -> Array:
        """
        Return the Jacobian by finite differences, for the channels that a parameter acts on.

        known: columns, by field, that are not computed again; base: the residual, if known.
        """
        channels = self.group.channels
        residual = self.residual(theta) if base is None else base
        columns = np.zeros((residual.size, theta.size))
        by_channel = columns.reshape(len(channels), -1, theta.size)
        for i, parameter in enumerate(self.free):
            if parameter.field in known:
                columns[:, i] = known[parameter.field]
                continue
            step = STEP if theta[i] < 0.5 else -STEP
            moved = theta.copy()
            moved[i] += step
            p = self.record(moved)
            for channel, part, rows in zip(channels, residual.reshape(len(channels), -1),
                                           by_channel, strict=True):
                if acts_on(parameter.field, channel, self.group):
                    rows[:, i] = (_residual(self.group, channel, p) - part) / step
        return columns


def _with_line_fitted(problem: Problem, theta: Array) -> Array:
    """
    Return a start with offset and gain from linear least squares, if that fits better.

    With a wrong line, a small effect may fit better than one of the right size.
    """
    numbers = [i for i, free in enumerate(problem.free) if free.field in LINE]
    base, columns = problem.residual(theta), []
    for number in numbers:
        moved = theta.copy()
        moved[number] += STEP if theta[number] < 0.5 else -STEP
        columns.append((problem.residual(moved) - base) / (moved[number] - theta[number]))
    best = theta.copy()
    best[numbers] += np.linalg.lstsq(np.array(columns).T, -base, rcond=None)[0]
    best = np.clip(best, 0.001, 0.999)
    left = problem.residual(best)
    return best if left @ left < base @ base else theta


def with_known_gain(group: Group, valve: Fitted) -> Group:
    """
    Return a group with the static gain limited by the fit of the valve channel.

    Command to valve position and valve position to force share the full opening. Each gain has
    the tolerance of several parameters, their product only that of one. Where the valve opens
    fully the maximum force is identifiable; elsewhere only its ratio to the opening.
    """
    opening, thrust = ('valve_characteristic_full_opening', 'valve_characteristic_maximum_force')
    own = next((free for free in group.nuisance if free.field == opening), None)
    if own is None:
        return group
    gain = float(valve.record['valve_characteristic_gain']
                 / valve.problem.group.nominal['valve_characteristic_gain'])
    low, high = own.low, own.high
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

    With more rounds than other fits: without convergence here any effect would seem to help.
    """
    theta = np.array([_share(_parameter(free, group, group.nominal), _start(free, group))
                      for free in group.nuisance])
    return fit(group, group.nuisance, [theta], rounds=3 * ROUNDS)


def _fit_from(group: Group, problem: Problem, other: Fitted) -> Fitted:
    """Return the fit of a problem, started at the parameters of another fit."""
    theta = np.array([_share(_parameter(free, group, other.record),
                             float(other.record[free.field])) for free in problem.free])
    return fit(group, problem.free, [theta], problem.fixed)


def refit(group: Group, fitted: Fitted, others: Sequence[Fitted]) -> Fitted:
    """Return the best of a fit and its repetitions, started from the parameters of other fits."""
    best = fitted
    for other in others:
        repeated = _fit_from(group, fitted.problem, other)
        best = min(best, repeated, key=lambda each: each.cost)
    return best


def _start(free: Free, group: Group, index: int = 0) -> float:
    """Return a start value of a free parameter in its own unit."""
    return free.starts[index] * _unit(free, group, group.nominal)


def at_start(group: Group, variant: Variant, index: int = 0) -> np.void:
    """Return the nominal record with an effect, each parameter at that start, or its last."""
    p = group.nominal.copy()
    for name, value in variant.fixed:
        p[name] = value
    for free in variant.free:
        p[free.field] = _start(free, group, min(index, len(free.starts) - 1))
    return p


def _extended_problem(group: Group, base: Fitted, variants: Sequence[Variant]
           ) -> tuple[Problem, list[Array]]:
    """Return the problem of a fit extended by the parameters of variants, and its starts."""
    fixed = tuple(pair for variant in variants for pair in variant.fixed)
    known = {free.field for free in base.free}
    new: dict[str, Free] = {}
    for variant in variants:
        for free in variant.free:
            old = new.get(free.field)   # a shared field gets the wider bounds
            new[free.field] = free if old is None else free._replace(
                low=min(free.low, old.low), high=max(free.high, old.high))
    frees = [free for free in base.free if free.field not in new] + list(new.values())
    warm = {free.field: _share(_parameter(free, group, base.record),
                               float(base.record[free.field]))
            for free in frees if free.field in known}
    fresh = [free for free in new.values() if free.field not in known]
    starts: list[Array] = []
    for count, free in enumerate(fresh):
        for index in range(len(free.starts)):
            if index == 0 and count > 0:
                continue
            begin = warm | {
                other.field: _share(_parameter(other, group, group.nominal),
                                    _start(other, group, index if other is free else 0))
                for other in fresh}
            starts.append(np.array([begin[other.field] for other in frees]))
    if not fresh:
        starts.append(np.array([warm[free.field] for free in frees]))
    repeated = [number for number, free in enumerate(frees) if free.anew]
    places = [[_share(_parameter(frees[number], group, group.nominal),
                      _start(frees[number], group, index)) for number in repeated]
              for index in range(len(frees[repeated[0]].starts) if repeated else 0)]
    for start, place in itertools.product(list(starts), places):
        start = start.copy()
        start[repeated] = place
        starts.append(start)
    return Problem(group, tuple(frees), fixed), starts


def fit_subset(group: Group, null: Fitted, variants: Sequence[Variant], whole: Fitted) -> Fitted:
    """Return the fit of some variants of a larger fit, started from its parameters."""
    problem, _ = _extended_problem(group, null, variants)
    return _fit_from(group, problem, whole)


def fit_variants(group: Group, screen: 'LinearScreen', variants: Sequence[Variant],
                 followed: int = STARTS) -> Fitted:
    """
    Return an approximate fit of one variant each of one or more effects.

    The fit of `screen` is the start, extended by the parameters of the variants. The columns of
    its Jacobian are used again, but not if the fit also begins at distant initial guesses.
    followed: so many of the best starts are fitted; all, if a mass is within a backlash: each
    contact makes a local minimum.
    """
    problem, starts = _extended_problem(group, screen.base, variants)
    most = followed if len(starts) > FEW_STARTS else 1
    followed = len(starts) if FLOATING in problem.fixed else most
    places = max((len(free.starts) for free in problem.free if free.anew), default=0)
    # The parameters of the variants may have other bounds, so their columns differ.
    own = fields_of(variants)
    known = {name: column for name, column in screen.derivatives.items() if name not in own}
    rounds = ROUNDS
    if places:   # distant initial guesses: the best start at each of them is fitted
        known, rounds = {}, 3 * ROUNDS
        count, followed = len(starts) // (places + 1), places + 1
        groups = [starts[:count]] + [starts[count + n::places] for n in range(places)]
        starts = [min(each, key=lambda theta: float(np.sum(problem.residual(theta) ** 2)))
                  for each in groups]
    return fit(group, problem.free, starts, problem.fixed, rounds, known, followed)


def polish(group: Group, fitted: Fitted) -> Fitted:
    """
    Return an approximate fit, continued with the full Jacobian.

    With a mass that moves freely within a backlash, also from other shares of that mass: each
    contact that appears or vanishes makes a local minimum.
    """
    fixed = fitted.problem.fixed
    best = fit(group, fitted.free, [fitted.theta], fixed, rounds=POLISH_ROUNDS)
    fields = [free.field for free in fitted.free]
    if FLOATING in fixed and 'piston_share' in fields:
        for share in MASS_SHARES:
            moved = best.theta.copy()
            moved[fields.index('piston_share')] = share
            repeated = fit(group, fitted.free, [moved], fixed, rounds=POLISH_ROUNDS)
            best = min(best, repeated, key=lambda each: each.cost)
    return best


class LinearScreen:
    """
    Linear screen of effects that are added to a fit: the expected cost, from a few simulations.

    At each start of an effect, bounded linear least squares: the residual is explained by the
    change that the effect causes (up to LARGEST times) and by the parameters of the fit.
    A nominal parameter beyond its tolerance has the bounds of that effect.
    """

    def __init__(self, base: Fitted) -> None:
        self.base = base
        self._residual = base.problem.residual(base.theta)
        self._jacobian = base.problem.jacobian(base.theta, base=self._residual)
        self.derivatives = base.problem.columns(self._jacobian)
        self._square = self._jacobian.T @ self._jacobian
        self._right = self._jacobian.T @ self._residual

    def cost(self, group: Group, variants: Sequence[Variant]) -> float:
        """Return the expected cost of a fit of these variants."""
        problem, starts = _extended_problem(group, self.base, variants)
        p = self.base.record
        wide = {free.field: _parameter(free, group, p) for free in problem.free}
        low, high = -self.base.theta, 1.0 - self.base.theta
        for i, free in enumerate(self.base.free):
            own = _parameter(free, group, p)
            low[i] += (wide[free.field].low - own.low) / (own.high - own.low)
            high[i] += (wide[free.field].high - own.high) / (own.high - own.low)
        fields = {field.partition('@')[0] for field in fields_of(variants)}
        per_recording = bool((fields - OSCILLATION) & {*OF_A_RECORDING})
        return min(self._linear(*self._changes(problem, start, per_recording), low, high)
                   for start in starts)

    def _changes(self, problem: Problem, start: Array, per_recording: bool
                 ) -> tuple[Array, Array, Array]:
        """
        Return what an effect changes of the residual at a start (columns), and their bounds.

        A load's free oscillation is a column of its own: without it no resonance would fit.
        per_recording: the effect has its own size in each recording.
        """
        at_start = problem.residual(start)
        group, change = self.base.problem.group, (at_start - self._residual)[:, None]
        columns, least = [change], [0.0]
        if per_recording and len({r.number for r in group.recordings}) > 1:
            number = np.concatenate([np.full(r.fit.sum(), r.number) for r in group.recordings])
            number = np.tile(number, len(group.channels))
            columns = [change * (number[:, None] == np.unique(number))]
            least = [-LARGEST] * columns[0].shape[1]
        most = [LARGEST] * len(least)
        for i, free in enumerate(problem.free):
            if free.field.partition('@')[0] in OSCILLATION:
                moved = start.copy()
                moved[i] = 1.0
                columns.append((problem.residual(moved) - at_start)[:, None])
                least, most = [*least, -start[i] / (1.0 - start[i])], [*most, 1.0]
        return np.concatenate(columns, axis=1), np.array(least), np.array(most)

    def _linear(self, changes: Array, least: Array, most: Array, low: Array, high: Array
                ) -> float:
        """Return the expected cost with an effect that changes the residual so."""
        with np.errstate(over='ignore', invalid='ignore'):   # a plant may be impossible
            cross = self._jacobian.T @ changes
            square = np.block([[self._square, cross], [cross.T, changes.T @ changes]])
            slope = np.append(self._right, changes.T @ self._residual)
        _, gain = least_step(square, slope, np.append(low, least), np.append(high, most))
        return 0.5 * float(self._residual @ self._residual) - gain
