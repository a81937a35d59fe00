"""
Weigh the hypotheses: which effects, none, or something that the vocabulary does not hold.

Each group of channels is weighed for itself (what moves the valve does not show beyond it, since
each block is driven by its measured input), then the groups are joined.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_analysis.gap.inference.fit import (
    Fitted,
    Promise,
    fit_null,
    fit_part,
    fit_variants,
    independent_samples,
    polish,
    refit,
    with_known_gain,
)
from asi_analysis.gap.inference.seen import seen
from asi_analysis.gap.model.effects import (
    BY_NAME,
    NO_GAP,
    PARAMETER,
    UNKNOWN,
    Effect,
    Variant,
    is_exact,
    off_nominal,
)
from asi_analysis.gap.model.group import Group, Values, channels_of, less_noisy, shows_in
from asi_analysis.gap.model.predict import passed_on
from asi_common.record import field_name

Names = tuple[str, ...]


class Constants(NamedTuple):
    """
    The constants of the weighing, fitted on blind cases (`python -m asi_analysis.gap.check.tune`).

    How many effects: samples, independent samples that a channel is counted as if USUAL_S are
    held out; price: log prior of an effect against none; second: of one more; formulation, exact:
    how much of what an effect explains, in rms, its formulation may leave, where its law can be
    written in several ways, and where not; seen: how far the floor is what the best hypothesis
    leaves (1), or what was thought of before (0).
    Which: trust, share of the evidence of independent samples that is believed; parameter: log
    prior of a parameter more than one; alike: share of the error of the nominal nonlinearities
    below which no two hypotheses are told apart; few: how many independent samples that error
    is. unknown, beyond, left: log odds of the doubt in an explanation, and how they grow with the
    log of what it leaves, in multiples of the floor and as a share of the gap. hidden: probability
    that something hides in nonlinearities whose shape is free, where they make all of the floor.
    """

    samples: float = 21.0
    price: float = 2.9
    second: float = 4.85
    formulation: float = 0.08
    exact: float = 0.025
    seen: float = 0.38
    trust: float = 0.27
    parameter: float = 0.53
    alike: float = 0.29
    few: float = 100.0
    unknown: float = -2.5
    beyond: float = 1.45
    left: float = 1.17
    hidden: float = 0.17


CONSTANTS = Constants()
NEAR_NOISE = 0.1   # of the noise's mean square: by less no two hypotheses are told apart
LEAST = 0.01       # of the floor: less is never seen
NOISE_DOUBT = 0.2  # of the mean square that the noise of the inputs makes
BELOW_FLOOR = 0.0    # log odds of an effect, at most, where the nominal model leaves no more
USUAL_S = 5.0
# How many effects are fitted, of those that promise most; to how many of them a second is added,
# of how many; and in how many of its forms each is fitted.
SINGLES, FOLLOWED, SECONDS, FORMS = 8, 3, 4, 2
BEYOND_TOLERANCE = 1.1   # log prior odds of an effect against a parameter beyond its tolerance
LEAST_EXPLAINED = 0.002   # of the cost: an effect that lowers it by less has size zero
LEAST_PROMISE = 0.04   # of the cost: what promises less is not fitted
# How many are fitted to the end, of those that cost less than this multiple of the least.
FINISHED, RIVAL = 4, 4.0
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


def candidates_of(group: Group, null: Fitted, tick: Callable[[], None] = lambda: None
                  ) -> dict[Names, Candidate]:
    """Fit every effect on top of the nominal model's fit, and pairs of the best with others."""
    found: dict[Names, Candidate] = {(): Candidate((), (), null)}
    group.scale.update(seen(null))
    choices: dict[Names, list[tuple[Variant, ...]]] = {
        (effect.name,): [(variant,) for variant in effect.variants
                         if channels_of(variant, group) and not variant.joined]
        for effect in group.effects}
    found |= _most_promising(group, null, choices, SINGLES, tick)
    singles = sorted((c for c in found.values() if len(c.names) == 1),
                     key=lambda c: c.fitted.cost)
    null = refit(group, null, [single.fitted for single in singles[:RETRIED]])
    found[()] = Candidate((), (), null)
    if not singles or excess(group, singles[0].fitted.held_out) < WORTH:
        return found
    for first in singles[:FOLLOWED]:
        found |= _grown(first, found, tick)
    found |= _both_ways(group, found)
    pairs = [candidate for names, candidate in found.items() if len(names) == 2]
    if pairs:
        found |= _grown(min(pairs, key=lambda c: c.fitted.cost), found, tick)
    for first in singles[:FOLLOWED]:
        richer = sorted((c.fitted for names, c in found.items()
                         if len(names) == 2 and set(first.variants) <= set(c.variants)),
                        key=lambda fitted: fitted.cost)
        better = [fitted for fitted in richer[:1] if fitted.cost < 0.98 * first.fitted.cost]
        found[first.names] = first._replace(fitted=refit(group, first.fitted, better))
    return found | _pruned(group, found)


def _both_ways(group: Group, found: dict[Names, Candidate]) -> dict[Names, Candidate]:
    """Return pairs that leave more than one of their two effects, fitted anew from that one."""
    better: dict[Names, Candidate] = {}
    for names, pair in found.items():
        if len(names) == 2:
            alone = min((found[(name,)] for name in names if (name,) in found),
                        key=lambda candidate: candidate.fitted.cost)
            if alone.fitted.cost < pair.fitted.cost:
                again = fit_variants(group, Promise(alone.fitted), pair.variants)
                better[names] = pair._replace(fitted=polish(group, again))
    return better


def _pruned(group: Group, found: dict[Names, Candidate]) -> dict[Names, Candidate]:
    """
    Return what the best hypothesis is worth without one of its effects, where that is better.

    On the way up an effect may have been given a form in which it is stuck without the others.
    """
    best = min(found.values(), key=lambda candidate: candidate.fitted.cost)
    better: dict[Names, Candidate] = {}
    for effect in (effect for effect in group.effects if effect.name in best.names):
        names = tuple(name for name in best.names if name != effect.name)
        variants = tuple(each for each in best.variants if each not in effect.variants)
        if names and len(variants) == len(names) and not any(each.joined for each in variants):
            fitted = fit_part(group, found[()].fitted, variants, best.fitted)
            if names not in found or fitted.cost < found[names].fitted.cost:
                better[names] = Candidate(names, variants, fitted)
    return better


def _grown(first: Candidate, found: dict[Names, Candidate], tick: Callable[[], None]
           ) -> dict[Names, Candidate]:
    """Fit the effects that promise most on top of a hypothesis, if that leaves anything."""
    group = first.fitted.problem.group
    # Seen better, once the first is out of the way; but what it rests on itself stays.
    group = replace(group, scale=group.scale | {
        name: value for name, value in seen(first.fitted).items()
        if name not in {free.scale for free in first.fitted.free}})
    more = {tuple(sorted({*first.names, effect.name})): list(_second(group, first, effect))
            for effect in group.effects if effect.name not in first.names}
    return _most_promising(group, first.fitted, {
        names: variants for names, variants in more.items() if variants}, SECONDS, tick, 1, {
            names: candidate.fitted.cost for names, candidate in found.items()})


def _most_promising(group: Group, base: Fitted, choices: dict[Names, list[tuple[Variant, ...]]],
                    most: int, tick: Callable[[], None], forms: int = FORMS,
                    reached: Mapping[Names, float] = MappingProxyType({})
                    ) -> dict[Names, Candidate]:
    """
    Fit the hypotheses that promise most on top of a fit, in their most promising forms.

    reached: costs of those that were fitted before, on top of another fit: of two effects one may
    hide what form the other has, so they are fitted again if they promise more from here.
    """
    if not choices:
        return {}
    promise = Promise(base)
    promised = []
    for names, ways in choices.items():
        costs = [(promise.cost(group, variants), number)
                 for number, variants in enumerate(ways)]
        promised += [(cost, names, ways[number]) for cost, number in sorted(costs)[:forms]
                     if cost < (1.0 - LEAST_PROMISE) * min(base.cost,
                                                           reached.get(names, math.inf))]
        tick()
    promised.sort(key=lambda entry: entry[0])
    chosen = list(dict.fromkeys(names for _, names, _ in promised))[:most]
    found: dict[Names, Candidate] = {}
    for _, names, variants in promised:
        if names in chosen:
            fitted = fit_variants(group, promise, variants, forms)
            best = found[names].fitted.cost if names in found else reached.get(names, math.inf)
            if fitted.cost < best:
                found[names] = Candidate(names, variants, fitted)
    least = sorted(candidate.fitted.cost for candidate in found.values())[:FINISHED]
    limit = min(RIVAL * least[0], least[-1]) if least else 0.0
    return {names: candidate._replace(fitted=polish(group, candidate.fitted))
            if candidate.fitted.cost <= limit else candidate
            for names, candidate in found.items()}


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


class Evidence(NamedTuple):
    """
    All that the hypotheses of a group are weighed by.

    noise, floor, formulation: mean squares, as a group has them; independent: how many independent
    samples; left: mean square on the held-out parts; all by channel; parameters: how many an
    effect has.
    """

    noise: Values
    floor: Values
    formulation: Values
    independent: Values
    held_out_s: float
    left: dict[Names, Values]
    parameters: dict[Names, int]


def evidence_of(group: Group, found: dict[Names, Candidate]) -> Evidence:
    """
    Return what the hypotheses of a group are weighed by.

    What they leave is made comparable: one that passes more of its inputs' noise on than the
    nominal model does must leave more. That noise is taken to be so strong as all of them allow.
    """
    best = min(found.values(), key=lambda candidate: candidate.fitted.cost)
    noise = {channel: level ** 2 for channel, level in group.noise.items()}
    passed = {names: _passed_on(group, candidate.fitted) for names, candidate in found.items()}
    left = {names: dict(candidate.fitted.held_out) for names, candidate in found.items()}
    for channel, level in noise.items():
        more = {names: passed[names][channel] - passed[()][channel] for names in found}
        share = min(1.0, *(left[names][channel] / (level + more[names] + 1e-300)
                           for names in found))
        for names in found:
            # As well as it is known, so much of it as leaves the noise that all of them have.
            ends = [factor * more[names] for factor in (
                share * (1.0 - NOISE_DOUBT), 1.0 + NOISE_DOUBT)]
            above = left[names][channel] - share * level
            left[names][channel] = max(
                left[names][channel] - min(max(above, min(ends)), max(ends)),
                LEAST * left[names][channel])
    return Evidence(
        noise, group.floor,
        group.formulation, independent_samples(group, best.fitted.record), group.held_out_s, left,
        {names: len({free.field.partition('@')[0] for variant in candidate.variants
                     for free in variant.free})
         for names, candidate in found.items()})


def _passed_on(group: Group, fitted: Fitted) -> Values:
    """Return the mean square that the noise of the inputs leaves in each channel."""
    return {channel: float(np.mean([passed_on(recording, channel, fitted.record)
                                    for recording in group.recordings]))
            for channel in group.channels}


def as_plain(e: Evidence) -> dict[str, Any]:
    """Return evidence as plain data, as rows.jsonl holds it."""
    names = list(e.left)
    return {**e._asdict(), 'names': [list(n) for n in names],
            'left': [e.left[n] for n in names], 'parameters': [e.parameters[n] for n in names]}


def as_evidence(plain: Mapping[str, Any]) -> Evidence:
    """Return the evidence that plain data hold."""
    names = [tuple(n) for n in plain['names']]
    return Evidence(plain['noise'], plain['floor'], plain['formulation'], plain['independent'],
                    plain['held_out_s'], dict(zip(names, plain['left'], strict=True)),
                    dict(zip(names, plain['parameters'], strict=True)))


def _which(e: Evidence, c: Constants) -> dict[Names, float]:
    """
    Return the log evidence of each hypothesis against others with as many effects.

    Of independent samples above the noise: models that leave little more than the noise are told
    apart sharply; where the best leaves more, that goes on for long and counts as few samples.
    What the formulation of nominal nonlinearities and of the effects may leave counts as well.
    """
    evidence = {names: -c.parameter * max(e.parameters[names] - len(names), 0)
                - BEYOND_TOLERANCE * sum(name.startswith(PARAMETER) for name in names)
                for names in e.left}
    for channel, noise in e.noise.items():
        best = min(e.left, key=lambda names: e.left[names][channel])
        formulation = e.formulation[channel] + _misformulated(e, c, best, channel)
        share = formulation / (formulation + noise + 1e-300)
        samples = 1.0 / (1.0 / e.independent[channel] + share / c.few)
        level = NEAR_NOISE * noise + c.alike * formulation
        for names, left in e.left.items():
            evidence[names] -= c.trust * 0.5 * samples * math.log(left[channel] + level)
    return evidence


def _worth(e: Evidence, c: Constants, before: Names, after: Names) -> float:
    """
    Return by how much the log evidence grows from one set of effects to a larger one.

    Above the floor, and above what the formulation of the effects before is not trusted with.
    """
    samples, gain = _samples(e, c), 0.0
    for channel, floor in e.floor.items():
        first, second = e.left[before][channel], e.left[after][channel]
        least = min(left[channel] for left in e.left.values())
        least = min(max(least, LEAST * floor), floor)
        level = (floor ** (1.0 - c.seen) * least ** c.seen
                 + _misformulated(e, c, before, channel))
        gain += 0.5 * samples * math.log((first + level) / (second + level))
    return gain


def _misformulated(e: Evidence, c: Constants, names: Names, channel: str) -> float:
    """Return the mean square that the formulation of a hypothesis' effects may leave."""
    share = max((c.exact if is_exact(name) else c.formulation for name in names), default=0.0)
    return share ** 2 * max(e.left[()][channel] - e.left[names][channel], 0.0)


def _samples(e: Evidence, c: Constants) -> float:
    # Errors of a model go on through a recording, so twice the length does not tell twice as much.
    return c.samples * math.sqrt(e.held_out_s / USUAL_S)


def _at_most(e: Evidence, c: Constants) -> float:
    """
    Return the most log evidence against the nominal model that a recording may hold.

    What leaves no more than the floor, which any model may leave, is as likely right as wrong,
    whatever else leaves less.
    """
    return BELOW_FLOOR + 0.5 * _samples(e, c) * sum(
        max(math.log(e.left[()][channel] / floor), 0.0) for channel, floor in e.floor.items())


def doubt(e: Evidence, best: Names, c: Constants) -> float:
    """
    Return the probability that something outside the vocabulary is at work.

    From what the best explanation leaves; the worst channel counts. An explanation that leaves
    little more than the floor is good.
    """
    worst, hidden = -math.inf, 0.0
    for channel, floor in e.floor.items():
        hidden = max(hidden, c.hidden * e.formulation[channel] / floor)
        left, gap = e.left[best][channel], e.left[()][channel]
        over = left - floor
        if over > 0.0:
            worst = max(worst, c.unknown + c.beyond * math.log(left / floor)
                        + c.left * math.log(over / max(gap - floor, over)))
    outside = 1.0 / (1.0 + math.exp(-worst)) if worst > -50.0 else 0.0
    return max(outside, 0.0 if best else hidden)


def probabilities(e: Evidence, c: Constants = CONSTANTS) -> dict[Names, float]:
    """Return the probability of every hypothesis of a group, `unknown` among them."""
    which = _which(e, c)
    most = max(map(len, which))
    score = {0: 0.0}
    best: dict[int, Names] = {0: ()}
    for count in range(1, most + 1):
        best[count] = max((names for names in which if len(names) == count),
                          key=lambda names: which[names])
        score[count] = (score[count - 1] - (c.second if count > 1 else c.price)
                        + _worth(e, c, best[count - 1], best[count]))
    highest = max(score.values())
    score[0] = max(0.0, highest - _at_most(e, c))
    weight = {count: math.exp(value - highest) for count, value in score.items()}
    chance = {}
    for names, value in which.items():
        count = len(names)
        same = sum(math.exp(which[other] - which[best[count]]) for other in which
                   if len(other) == count)
        chance[names] = (weight[count] / sum(weight.values())
                         * math.exp(value - which[best[count]]) / same)
    unknown = doubt(e, max(chance, key=lambda names: chance[names]), c)
    return {names: (1.0 - unknown) * p for names, p in chance.items()} | {(UNKNOWN,): unknown}


def weigh(group: Group, found: dict[Names, Candidate]) -> Weighed:
    """Return a group with the probability of every hypothesis, `unknown` among them."""
    kept = explaining(found)
    return Weighed(group, kept, probabilities(evidence_of(group, kept)))


def explaining(found: dict[Names, Candidate]) -> dict[Names, Candidate]:
    """
    Return the hypotheses of which every effect explains something of the fitted parts.

    An effect that was fitted to size zero leaves what the hypothesis without it leaves. It is no
    explanation of its own, and would only take probability from those that are.
    """
    def explains(candidate: Candidate) -> bool:
        return all(candidate.fitted.cost < (1.0 - LEAST_EXPLAINED) * found[part].fitted.cost
                   for part in (tuple(n for n in candidate.names if n != name)
                                for name in candidate.names) if part in found)

    return {names: candidate for names, candidate in found.items() if explains(candidate)}


def weigh_groups(groups: Sequence[Group], tolerance: float,
                 tick: Callable[[], None] = lambda: None) -> list[Weighed]:
    """Return the groups with the probabilities of their hypotheses, in the order of the signal."""
    weighed: list[Weighed] = []
    for group in groups:
        known = weighed and weighed[0].probability[(UNKNOWN,)] < 0.5
        if known and weighed[0].group.channels == ('valve',):
            best = max(weighed[0].candidates, key=lambda n: weighed[0].probability[n])
            group = with_known_gain(group, weighed[0].candidates[best].fitted, tolerance)
        null = fit_null(group)
        if (quieter := less_noisy(group, null.held_out)) is not group:
            group, null = quieter, fit_null(quieter)
        group = with_parameters(group, null, tolerance)
        weighed.append(weigh(group, candidates_of(group, null, tick)))
    return weighed


def with_parameters(group: Group, null: Fitted, tolerance: float) -> Group:
    """
    Return a group with the hypotheses that a nominal parameter is beyond its tolerance.

    Of those parameters that rest on a limit of it without any effect, and are part of none.
    """
    dotted = {field_name(parameter.name): parameter.name for parameter in ACTUATOR_PARAMETERS}
    held = {free.field for effect in group.effects for variant in effect.variants
            for free in variant.free}
    more = tuple(off_nominal(dotted[field], field, limit, tolerance, tuple(
                     channel for channel in group.channels if shows_in(field, channel, group)))
                 for field, limit in null.at_limit.items() if field not in held)
    return replace(group, effects=(*group.effects, *more))


def join(groups: Sequence[Weighed]) -> dict[Names, float]:
    """Return the probability of every hypothesis about the whole chain."""
    return join_probabilities([weighed.probability for weighed in groups])


def join_probabilities(groups: Sequence[dict[Names, float]]) -> dict[Names, float]:
    """Return the probability of every union of one hypothesis of each group."""
    joined: dict[Names, float] = {}
    for parts in itertools.product(*(chances.items() for chances in groups)):
        names = tuple(sorted({name for part, _ in parts for name in part}))
        joined[names] = joined.get(names, 0.0) + math.prod(p for _, p in parts)
    return joined


def marginals(joined: dict[Names, float]) -> dict[str, float]:
    """Return the probability of each effect, of `no_gap` and of `unknown`."""
    total: dict[str, float] = dict.fromkeys(BY_NAME, 0.0)
    total[UNKNOWN] = 0.0
    for names, probability in joined.items():
        for name in names:
            total[name] = total.get(name, 0.0) + probability
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
