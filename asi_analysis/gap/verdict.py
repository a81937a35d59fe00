"""
Weigh the hypotheses: which effects, none, or something that the vocabulary does not hold.

Each group of channels is weighed for itself (what moves the valve does not show beyond it, since
each block is driven by its measured input), then the groups are joined.
"""

import itertools
import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

from asi_analysis.gap.effects import BY_NAME, NO_GAP, UNKNOWN, Effect, Variant
from asi_analysis.gap.fit import (
    Fitted,
    Group,
    Promise,
    Values,
    channels_of,
    fit_variants,
    refit,
    residual_frequency,
)

Names = tuple[str, ...]


class Constants(NamedTuple):
    """
    The constants of the weighing, set by hand on blind cases with seeds below 10 000 (doc/gap.md).

    samples: independent samples that a channel is counted as if USUAL_S are held out; price: log
    prior of an effect against none; second: that of one more; parameter: that of a parameter more
    than one, so that a richer effect must explain more; left: share of the mean square of the gap
    that an explanation may leave before `unknown` is as likely; beyond: how many times the floor
    what is left must be to be doubted; steep: how fast the doubt grows with the log of both.
    """

    samples: float = 25.0
    price: float = 2.0
    second: float = 3.0
    parameter: float = 1.0
    left: float = 0.15
    beyond: float = 6.0
    steep: float = 2.0


CONSTANTS = Constants()
USUAL_S = 5.0
# How many effects are fitted, of those that promise most; to how many of them a second is added,
# of how many; and in how many of its forms each is fitted.
SINGLES, FOLLOWED, PAIRS, FORMS = 8, 3, 4, 2
LEAST_PROMISE = 0.02   # of the cost: what promises less is not fitted
RETRIED = 3        # hypotheses from whose parameters the null fit is tried again
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
    # Errors of a model go on through a recording, so twice the length does not tell twice as much.
    samples = c.samples * math.sqrt(group.held_out_s / USUAL_S)
    return sum(-0.5 * samples * math.log(left[channel] + group.floor[channel])
               for channel in group.channels)


def candidates_of(group: Group, null: Fitted, tick: Callable[[], None] = lambda: None
                  ) -> dict[Names, Candidate]:
    """Fit every effect on top of the nominal model's fit, and pairs of the best with others."""
    found: dict[Names, Candidate] = {(): Candidate((), (), null)}
    if excess(group, null.held_out) < WORTH:
        return found
    group.scale['residual_frequency'] = residual_frequency(group, null)
    choices: dict[Names, list[tuple[Variant, ...]]] = {
        (effect.name,): [(variant,) for variant in effect.variants
                         if _may_explain(variant, group, null) and not variant.joined]
        for effect in group.effects}
    found |= _most_promising(group, null, choices, SINGLES, tick)
    singles = sorted((c for c in found.values() if len(c.names) == 1),
                     key=lambda c: -_log_evidence(group, c.fitted.held_out, CONSTANTS))
    null = refit(group, null, [single.fitted for single in singles[:RETRIED]])
    found[()] = Candidate((), (), null)
    if excess(group, null.held_out) < WORTH:
        return {(): found[()]}
    for first in singles[:FOLLOWED]:
        pairs = {tuple(sorted({*first.names, effect.name})): list(_second(group, first, effect))
                 for effect in group.effects if effect.name not in first.names}
        found |= _most_promising(group, first.fitted, {
            names: variants for names, variants in pairs.items() if names not in found}, PAIRS,
            tick)
    for first in singles[:FOLLOWED]:
        richer = sorted((c.fitted for names, c in found.items()
                         if len(names) == 2 and set(first.variants) <= set(c.variants)),
                        key=lambda fitted: fitted.cost)
        better = [fitted for fitted in richer[:1] if fitted.cost < 0.98 * first.fitted.cost]
        found[first.names] = first._replace(fitted=refit(group, first.fitted, better))
    return found


def _most_promising(group: Group, base: Fitted, choices: dict[Names, list[tuple[Variant, ...]]],
                    most: int, tick: Callable[[], None]) -> dict[Names, Candidate]:
    """Fit the hypotheses that promise most on top of a fit, each in its most promising form."""
    promise = Promise(base)
    promised = []
    for names, forms in choices.items():
        costs = [(promise.cost(group, variants), number)
                 for number, variants in enumerate(forms)]
        promised += [(cost, names, forms[number]) for cost, number in sorted(costs)[:FORMS]
                     if cost < (1.0 - LEAST_PROMISE) * base.cost]
        tick()
    promised.sort(key=lambda entry: entry[0])
    chosen = list(dict.fromkeys(names for _, names, _ in promised))[:most]
    found: dict[Names, Candidate] = {}
    for _, names, variants in promised:
        if names in chosen:
            fitted = fit_variants(group, base, variants)
            if names not in found or fitted.cost < found[names].fitted.cost:
                found[names] = Candidate(names, variants, fitted)
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


def doubt(group: Group, null: Values, best: Values, c: Constants = CONSTANTS) -> float:
    """
    Return the probability that something outside the vocabulary is at work.

    From what the best explanation leaves: as a share of what there was, and in multiples of the
    floor; the worst channel counts. An explanation that leaves little, or only noise, is good.
    """
    worst = -math.inf
    for channel in group.channels:
        floor = group.floor[channel]
        over = max(best[channel] - floor, 1e-9 * floor)
        share = over / max(null[channel] - floor, over)
        worst = max(worst, min(math.log(share / c.left),
                               math.log(best[channel] / floor / c.beyond)))
    return 1.0 / (1.0 + math.exp(-c.steep * worst))


def weigh(group: Group, found: dict[Names, Candidate], c: Constants = CONSTANTS) -> Weighed:
    """Return the probability of every hypothesis of a group, `unknown` among them."""
    score = {}
    for names, candidate in found.items():
        own = {free.field for variant in candidate.variants for free in variant.free}
        prior = -(c.price * (len(names) > 0) + c.second * (len(names) > 1)
                  + c.parameter * max(len(own) - len(names), 0))
        score[names] = prior + _log_evidence(group, candidate.fitted.held_out, c)
    best = max(score, key=lambda names: score[names])
    weight = {names: math.exp(value - score[best]) for names, value in score.items()}
    unknown = doubt(group, found[()].fitted.held_out, found[best].fitted.held_out, c)
    total = sum(weight.values())
    probability = {names: (1.0 - unknown) * w / total for names, w in weight.items()}
    return Weighed(group, found, probability | {(UNKNOWN,): unknown})


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
