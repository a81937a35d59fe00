"""
The linear screen: by how much each effect, in each form, is expected to lower the cost of a fit.

The effect is simulated once at each initial guess. By linear least squares, the best multiple of
that change of the residual is found, with all other parameters free within their bounds, and with
none.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.gap.inference.bounded_least_squares import least_step
from asi_analysis.gap.inference.posterior import Posterior
from asi_analysis.gap.inference.simulated.found import Found
from asi_analysis.gap.model.effects import Variant, fields_of
from asi_analysis.gap.model.group import channels_of
from asi_analysis.parallel import in_threads

# Largest multiple of an effect's initial guess; the least one that a fit can begin with.
LARGEST_AMOUNT, LEAST_AMOUNT = 3.0, 0.01
# Parameters of contacts and couplings. If the nominal model explains the signals, such an effect
# is small: then only the first of their initial guesses, the smallest effects, are screened.
STIFF, SMALL_STARTS = {'backlash_gap', 'coupling_stiffness'}, 2
STIFF_S = 1e-4   # longest sub-step of their first simulation, s


class Start(NamedTuple):
    """A form of an effect at one of its initial guesses: its posterior and parameters."""

    name: str
    variant: Variant
    problem: Posterior
    theta: Array
    null: Array   # the parameters without the effect
    amount: float = 1.0   # multiple of the guess that the screen expects

    @property
    def nearest(self) -> Array:
        """Return the parameters at the guess, or at its expected multiple if that costs less."""
        other = np.clip(self.null + self.amount * (self.theta - self.null), 0.0, 1.0)
        return min(self.theta, other, key=self.problem.cost)


def _starts(base: Found, small: bool) -> list[Start]:
    """
    Return every effect in each form at each initial guess, all else as in `base`.

    small: of contacts and couplings only the smallest effects.
    """
    group, problem = base.problem.group, base.problem
    values = problem.record(base.best.theta)
    shares = dict(zip((free.field for free in problem.free), base.best.theta, strict=True))
    shorter = max(group.exact_substep_s, min(STIFF_S, float(group.nominal['maximum_substep'])))
    work = []
    held = fields_of(base.variants)
    for name, forms in group.effects.items():
        for variant in forms if name not in base.names else ():
            # A wave or pulse of a disturbance is only guessed where the motion was measured.
            guessed = all(free.scale in group.scale for free in variant.free
                          if free.scale.startswith('residual_'))
            own = variant.fields
            if not channels_of(variant, group) or not guessed or own & held:
                continue
            # Contacts and couplings may be too stiff for the sub-step of the group.
            fixed = (*problem.fixed, *variant.fixed, *(
                (('maximum_substep', shorter),) if own & STIFF else ()))
            extended = Posterior(group, (*(f for f in problem.free if f.field not in own),
                                         *variant.free), fixed)
            null = np.array([
                shares[f.field] if f.field not in own else
                float(np.clip(extended.parameter(f).share(float(values[f.field])), 0.0, 1.0))
                for f in extended.free])
            if own <= shares.keys():   # parameters of the base itself, as fitted
                work.append(Start(name, variant, extended, null, null))
            for varied in variant.free:   # each in turn at all its starts, the others at the first
                if len(varied.starts) == 1 and varied is not variant.free[0]:
                    continue
                restricted = small and varied.field in STIFF
                for start in varied.starts[:SMALL_STARTS if restricted else None]:
                    theta = np.array([
                        shares[f.field] if f.field not in own else
                        extended.start(f, start if f is varied else f.starts[0])
                        for f in extended.free])
                    work.append(Start(name, variant, extended, theta, null))
    return work


class Screened(NamedTuple):
    """
    Result of a screen: starts, best first; their highest gain; Jacobian columns by field.

    most: minus infinity if no effect acts on the group's channels.
    """

    ranked: list[Start]
    most: float
    slopes: dict[str, Array]

    def best(self, count: int) -> list[Start]:
        """
        Return the best start of each form of the best `count` effects.

        Of forms that differ in bounds alone (an asymmetry of either sign) only the best one.
        """
        chosen: dict[str, dict[Variant, Start]] = {}
        for start in self.ranked:
            if start.name in chosen or len(chosen) < count:
                unbounded = start.variant._replace(free=tuple(
                    free._replace(low=0.0, high=0.0, starts=()) for free in start.variant.free))
                chosen.setdefault(start.name, {}).setdefault(unbounded, start)
        return [start for forms in chosen.values() for start in forms.values()]


def screen(base: Found, small: bool, tick: Callable[[], None]) -> Screened:
    """
    Return the effects, ranked by how much they lower the cost of a fit if they are added to it.

    small: only small effects are expected.
    """
    problem, residual, theta = base.problem, base.best.residual, base.best.theta
    (mean, precision), slopes = problem.prior, base.slopes
    of_data = slopes.T @ slopes
    square = of_data + np.diag(precision)
    slope = slopes.T @ residual + precision * (theta - mean)
    count = theta.size

    def gain(start: Start) -> tuple[float, float, float]:
        # With all other parameters free, and with none. If the gap is large, the first is too
        # optimistic: linearised, the other parameters seem to explain much. And the best multiple.
        own = start.variant.fields
        change = start.problem.residual(start.theta) - residual
        # Some effects replace a free parameter.
        keep = [n for n, free in enumerate(problem.free) if free.field not in own]
        if not np.isfinite(change).all() or (len(keep) + len(own) > count and not change.any()):
            return -math.inf, -math.inf, 1.0
        if not change.any():   # it replaces parameters by themselves, without their priors
            held = np.zeros(count)
            held[keep] = precision[keep]
            return least_step(of_data + np.diag(held), slope - (precision - held) * (theta - mean),
                              -theta, 1.0 - theta)[1], -math.inf, 1.0
        size, along = float(change @ change), float(residual @ change)
        whole = np.empty((count + 1, count + 1))
        whole[:count, :count] = square
        whole[count, :count] = whole[:count, count] = slopes.T @ change
        whole[count, count] = size
        keep.append(count)
        step, free = least_step(whole[np.ix_(keep, keep)], np.append(slope, along)[keep],
                                np.append(-theta, 0.0)[keep],
                                np.append(1.0 - theta, LARGEST_AMOUNT)[keep])
        amount = min(max(-along / size, 0.0), LARGEST_AMOUNT)
        multiple = next((each for each in (float(step[-1]), amount) if each > LEAST_AMOUNT), 1.0)
        return free, -amount * along - 0.5 * amount ** 2 * size, multiple

    starts, gains = _starts(base, small), []
    for n, value in enumerate(in_threads(gain, starts)):
        gains.append(value)
        if n % 10 == 0:
            tick()
    ranks = (sorted(range(len(starts)), key=lambda n: -gains[n][kind]) for kind in (0, 1))
    ranked = [starts[n]._replace(amount=gains[n][2])
              for both in zip(*ranks, strict=True) for n in both]
    most = max((free for free, *_ in gains), default=-math.inf)
    return Screened(ranked, most, problem.columns(slopes))
