"""
Weigh the hypotheses: which effects, none, or something that the vocabulary does not hold.

Each group of channels is weighed for itself (what moves the valve does not show beyond it, since
each block is driven by its measured input), then the groups are joined.
"""

import itertools
import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

from asi_analysis.gap.effects import BY_NAME, EFFECTS, NO_GAP, UNKNOWN, Effect, Variant
from asi_analysis.gap.fit import (
    Fitted,
    Group,
    Values,
    channels_of,
    fit_null,
    fit_variants,
    residual_frequency,
)

Names = tuple[str, ...]


class Constants(NamedTuple):
    """
    The constants of the weighing, fitted to blind cases with seeds below 10 000 (doc/gap.md).

    samples: independent samples that a channel is counted as; price: log prior of an effect
    against none; second: that of one more; unknown: log prior of an effect outside the vocabulary;
    left: share of the mean square that an explanation may leave.
    """

    samples: float = 25.0
    price: float = 3.0
    second: float = 3.0
    unknown: float = 4.0
    left: float = 0.15


CONSTANTS = Constants()
FOLLOWED = 2       # of the single effects, to which a second is tried
WORTH = 0.8        # times the floor: what must be left for another effect to be tried


class Candidate(NamedTuple):
    """A hypothesis in one group: the effects it holds and the best fit of their variants."""

    names: Names
    variants: tuple[Variant, ...]
    fitted: Fitted


class Weighed(NamedTuple):
    """One group with all its hypotheses, and the probability of each: names -> probability."""

    group: Group
    candidates: dict[Names, Candidate]
    probability: dict[Names, float]


def excess(group: Group, left: Values) -> float:
    """Return the largest ratio of what is left to the floor, over the channels."""
    return max(left[channel] / group.floor[channel] for channel in group.channels)


def _log_evidence(group: Group, left: Values, c: Constants) -> float:
    return sum(-0.5 * c.samples * math.log(left[channel] + group.floor[channel])
               for channel in group.channels)


def candidates_of(group: Group, tick: Callable[[], None] = lambda: None) -> dict[Names, Candidate]:
    """Fit the nominal model, every effect, and pairs of the best with every other."""
    null = fit_null(group)
    found: dict[Names, Candidate] = {(): Candidate((), (), null)}
    if excess(group, null.held_out) < WORTH:
        return found
    group.scale['residual_frequency'] = residual_frequency(group, null)
    for effect in EFFECTS:
        best = _best(group, null, [(variant,) for variant in effect.variants
                                   if _may_explain(variant, group, null) and not variant.joined],
                     (effect.name,))
        if best is not None:
            found[best.names] = best
        tick()
    singles = sorted((c for c in found.values() if len(c.names) == 1),
                     key=lambda c: -_log_evidence(group, c.fitted.held_out, CONSTANTS))
    for first in singles[:FOLLOWED]:
        for effect in EFFECTS:
            names = tuple(sorted({*first.names, effect.name}))
            if len(names) == 2 and names not in found:
                best = _best(group, first.fitted, list(_second(group, first, effect)), names)
                if best is not None:
                    found[names] = best
            tick()
    return found


def _may_explain(variant: Variant, group: Group, fitted: Fitted) -> bool:
    """Return whether a variant shows where a fit leaves more than the floor."""
    return any(fitted.held_out[channel] > WORTH * group.floor[channel]
               for channel in channels_of(variant, group))


def _second(group: Group, first: Candidate, effect: Effect) -> Iterable[tuple[Variant, ...]]:
    """Return the variants of a second effect, each with those of the first; none that clash."""
    fixed = dict(pair for variant in first.variants for pair in variant.fixed)
    friction = any('friction_level' in {free.field for free in variant.free}
                   for variant in first.variants)
    for variant in effect.variants:
        clash = any(fixed.get(name, value) != value for name, value in variant.fixed)
        rubs = 'friction_level' in {free.field for free in variant.free}
        # Two kinds of friction are one friction with the traits of both.
        if _may_explain(variant, group, first.fitted) and not clash and variant.joined == (
                friction and rubs and effect.name == 'friction_asymmetry'):
            yield (*first.variants, variant)


def _best(group: Group, base: Fitted, choices: list[tuple[Variant, ...]],
          names: Names) -> Candidate | None:
    """Return the variant of an effect that fits best, on the parts that were fitted."""
    fits = [(fit_variants(group, base, variants), variants) for variants in choices]
    if not fits:
        return None
    fitted, variants = min(fits, key=lambda pair: pair[0].cost)
    return Candidate(names, variants, fitted)


def weigh(group: Group, found: dict[Names, Candidate], c: Constants = CONSTANTS) -> Weighed:
    """Return the probability of every hypothesis of a group, `unknown` among them."""
    null = found[()].fitted.held_out
    score = {}
    for names, candidate in found.items():
        prior = -(c.price * (len(names) > 0) + c.second * (len(names) > 1))
        score[names] = prior + _log_evidence(group, candidate.fitted.held_out, c)
    something = {channel: max(2.0 * group.floor[channel], c.left * null[channel])
                 for channel in group.channels}
    score[(UNKNOWN,)] = -c.unknown + _log_evidence(group, something, c)
    top = max(score.values())
    weight = {names: math.exp(value - top) for names, value in score.items()}
    total = sum(weight.values())
    return Weighed(group, found, {names: w / total for names, w in weight.items()})


def join(groups: list[Weighed]) -> dict[Names, float]:
    """Return the probability of every hypothesis about the whole chain."""
    joined: dict[Names, float] = {}
    for parts in itertools.product(*(weighed.probability.items() for weighed in groups)):
        names = tuple(sorted({name for part, _ in parts for name in part}))
        joined[names] = joined.get(names, 0.0) + math.prod(p for _, p in parts)
    return joined


def marginals(joined: dict[Names, float]) -> dict[str, float]:
    """Return the probability of each effect, of `no_gap` and of `unknown`."""
    total: dict[str, float] = dict.fromkeys(BY_NAME, 0.0)
    total[UNKNOWN] = 0.0
    for names, probability in joined.items():
        for name in names:
            total[name] += probability
    return total | {NO_GAP: joined.get((), 0.0)}


def ambiguity_set(joined: dict[Names, float], coverage: float = 0.9) -> list[Names]:
    """Return the fewest hypotheses that hold the truth with this probability."""
    chosen, total = [], 0.0
    for names, probability in sorted(joined.items(), key=lambda item: -item[1]):
        chosen.append(names)
        total += probability
        if total >= coverage:
            break
    return chosen
