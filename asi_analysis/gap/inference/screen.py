"""
The linear screen: how much each effect, in each form, would lower the cost of a fit.

By the change of the residual that it causes at a start of its size, with all other parameters
free, by linear least squares, and alone.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from asi_analysis.arrays import Array
from asi_analysis.gap.inference.posterior import Found, Posterior
from asi_analysis.gap.model.effects import Variant
from asi_analysis.gap.model.group import channels_of

LARGEST = 3.0   # of an effect's start
RIDGE = 1e-9
# Fields of contacts and couplings, and how many of their starts, those that change the least, are
# looked at where the nominal model explains the signals: what is hidden there is small.
STIFF, SMALLEST = {'backlash_gap', 'coupling_stiffness'}, 2
STIFF_S = 1e-4   # longest sub-step that they are first simulated with


class _Explained:
    """What parameters of a fit explain of signals, by linear least squares."""

    def __init__(self, slopes: Array, precision: Array) -> None:
        self._size = size = np.sqrt(np.sum(slopes ** 2, axis=0) + precision) + 1e-30
        self._scaled = slopes / size
        self._square = self._scaled.T @ self._scaled + np.diag(precision / size ** 2 + RIDGE)

    def along(self, signal: Array, prior: Array | float = 0.0) -> Array:
        """
        Return the products of a signal (n samples) with the derivatives of the parameters.

        prior: the slope of the log prior of each, if the signal is the residual.
        """
        product: Array = self._scaled.T @ signal + prior / self._size
        return product

    def common(self, one: Array, other: Array, keep: list[int]) -> float:
        """Return the product of what some parameters explain of two signals, of their `along`."""
        factor = cho_factor(self._square[np.ix_(keep, keep)])
        return float(one[keep] @ cho_solve(factor, other[keep]))


def _promise(along: float, size: float) -> float:
    """Return by how much the best amount of a change of the residual lowers the cost."""
    amount = min(max(-along / size, 0.0), LARGEST)
    return -amount * along - 0.5 * amount ** 2 * size


class Start(NamedTuple):
    """A form of an effect at one of its starts: its problem and parameters."""

    name: str
    variant: Variant
    problem: Posterior
    theta: Array


def _starts(base: Found, small: bool) -> list[Start]:
    """
    Return every effect in each form at each of its starts, all else as in `base`.

    small: of contacts and couplings only those that change the least.
    """
    group, problem = base.problem.group, base.problem
    shares = dict(zip((free.field for free in problem.free), base.best.theta, strict=True))
    shorter = max(group.exact_substep_s, min(STIFF_S, float(group.nominal['maximum_substep'])))
    work = []
    held = {free.field for variant in base.variants for free in variant.free}
    for effect in group.effects:
        for variant in effect.variants if effect.name not in base.names else ():
            # A wave or pulse of a disturbance is only guessed where the motion was measured.
            guessed = all(free.scale in group.scale for free in variant.free
                          if free.scale.startswith('residual_'))
            own = {free.field for free in variant.free}
            if not channels_of(variant, group) or not guessed or own & held:
                continue
            # Contacts and couplings may be too stiff for the sub-step of the group.
            fixed = (*problem.fixed, *variant.fixed, *(
                (('maximum_substep', shorter),) if own & STIFF else ()))
            extended = Posterior(group, (*(f for f in problem.free if f.field not in own),
                                         *variant.free), fixed, pool=problem.pool)
            for varied in variant.free:   # one at its starts, the others at their first
                if len(varied.starts) == 1 and varied is not variant.free[0]:
                    continue
                few = small and varied.field in STIFF
                for start in varied.starts[:SMALLEST if few else None]:
                    theta = np.array([
                        shares[f.field] if f.field not in own else
                        extended.start(f, start if f is varied else f.starts[0])
                        for f in extended.free])
                    work.append(Start(effect.name, variant, extended, theta))
    return work


class Screened(NamedTuple):
    """What a screen found: the starts, best first; their highest gain; derivatives by field."""

    ranked: list[Start]
    most: float
    slopes: dict[str, Array]

    def best(self, count: int) -> list[Start]:
        """Return the first start of each form of the first effects; one may be ranked twice."""
        chosen: dict[str, dict[Variant, Start]] = {}
        for start in self.ranked:
            if start.name in chosen or len(chosen) < count:
                chosen.setdefault(start.name, {}).setdefault(start.variant, start)
        return [start for forms in chosen.values() for start in forms.values()]


def screen(base: Found, small: bool, tick: Callable[[], None]) -> Screened:
    """
    Return the effects, ranked by how much they lower the cost of a fit if they are added to it.

    small: what is sought is small.
    """
    problem, residual = base.problem, base.best.residual
    (mean, precision), slopes = problem.prior, problem.jacobian(base.best.theta)
    explained = _Explained(slopes, precision)
    along_residual = explained.along(residual, precision * (base.best.theta - mean))

    def gain(start: Start) -> tuple[float, float]:
        # With all other parameters free, and alone. Of a large gap the first promises too much:
        # parameters whose small changes act linearly seem to explain anything.
        own = {free.field for free in start.variant.free}
        change = start.problem.residual(start.theta) - residual
        if not np.isfinite(change).all():
            return -math.inf, -math.inf
        keep = [n for n, free in enumerate(problem.free) if free.field not in own]
        along_change, all_of_it = explained.along(change), float(change @ change)
        size = all_of_it - explained.common(along_change, along_change, keep)
        if size <= RIDGE * all_of_it:
            return -math.inf, -math.inf
        along = float(residual @ change)
        alone = _promise(along, all_of_it)
        along -= explained.common(along_residual, along_change, keep)
        # What other parameters explain by themselves is the same for all but those without one.
        return 0.5 * explained.common(along_residual, along_residual, keep) + _promise(
            along, size), alone

    starts, gains = _starts(base, small), []
    for n, value in enumerate(problem.in_parallel(gain, starts)):
        gains.append(value)
        if n % 10 == 0:
            tick()
    ranks = (sorted(range(len(starts)), key=lambda n: -gains[n][kind]) for kind in (0, 1))
    ranked = [starts[n] for both in zip(*ranks, strict=True) for n in both]
    return Screened(ranked, max(first for first, _ in gains), {
        free.field: column for free, column in zip(problem.free, slopes.T, strict=True)})
