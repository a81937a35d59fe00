"""
Fit the hypotheses: the nominal model, single effects, and combinations of the best.

Then compute their probabilities, in each group of channels by itself, since each block is driven
by its measured input.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from asi_analysis.gap.course import in_step
from asi_analysis.gap.inference.coloured_noise import (
    with_coloured_noise,
    with_noise_of_valve,
)
from asi_analysis.gap.inference.fit import (
    Fitted,
    LinearScreen,
    fit_null,
    fit_subset,
    fit_variants,
    independent_samples,
    polish,
    refit,
    with_known_gain,
)
from asi_analysis.gap.inference.initial_guesses import initial_guesses
from asi_analysis.gap.inference.probability import (
    CONSTANTS,
    LEAST_RESIDUAL,
    NOISE_SHARE,
    OWN_MODEL,
    SERVO,
    Evidence,
    Names,
    join_probabilities,
    log_odds_against,
    marginals,
    probabilities,
)
from asi_analysis.gap.inference.related import Candidate, refitted_from_related
from asi_analysis.gap.inference.simpler import as_simple_friction
from asi_analysis.gap.model.effects import (
    PARAMETER,
    UNKNOWN,
    Variant,
    fields_of,
    of_recording,
    parameter_error,
)
from asi_analysis.gap.model.group import (
    Group,
    Values,
    acts_on,
    channels_of,
    with_less_noisy_valve,
    with_lower_noise,
)
from asi_analysis.gap.model.predict import propagated_noise
from asi_analysis.gap.model.rattling import is_closed
from asi_analysis.gap.model.static import as_limit, at_the_end
from asi_analysis.parallel import in_threads

NOISE_UNCERTAINTY = 0.2   # of the mean square propagated noise, relative
# After the linear screen so many single effects are fitted; so many of these get a second effect;
# so many second effects are fitted to each; and each effect is fitted in so many forms.
SINGLES, EXTENDED, SECONDS, FORMS = 8, 3, 4, 2
# As shares of the cost: an effect that lowers it by less has size zero; if the linear screen
# expects less of an effect, it is not fitted.
LEAST_EXPLAINED = 0.002
LEAST_SCREENED_GAIN = 0.04
# So many of the best fits are completed, if their cost is at most this multiple of the least.
POLISHED, POLISHED_RATIO = 4, 4.0
NULL_RESTARTS = 3   # the fit of the nominal model is repeated from so many other hypotheses
PARAMETER_PRICE = 0.003   # share of the cost by which a further parameter must lower it
# Of a static characteristic: the share of the probability of `unknown` that an implausible
# hypothesis gets: a disturbance in step with the input, or three effects on the curve's shape.
IMPLAUSIBLE_SHARE = 0.4
SHAPES = {'valve_deadband', 'valve_saturation', 'gain_asymmetry', 'curvature'}
# Of a joint: if a fit leaves at most this multiple of the noise variance, the model error is what
# it leaves beyond the noise, and the error floor allows for as much again. Of a joint that is
# driven by a force, it is at least FLOOR_MARGIN times what that fit leaves (mean squares).
QUIET_RATIO, FLOOR_MARGIN = 9.0, 2.0
SMALLEST_RESIDUAL = 1e-12   # lower limit of a mean square residual, in error floors
SUFFICIENT = 0.8   # mean square residual, in error floors, below which no effect is added


class Weighed(NamedTuple):
    """
    A group with its fitted hypotheses and the probability of each, by effect names.

    closest: of what is unknown, the effects that come closest to it as a model.
    """

    group: Group
    candidates: dict[Names, Candidate]
    probability: dict[Names, float]
    closest: Names | None = None


def _needs_more(group: Group, fitted: Fitted, channel: str) -> bool:
    """
    Return whether a fit leaves more of a channel than a further effect may have to explain.

    If the best residual limits the model error, that may be anything above the noise.
    """
    least = (1.0 + NOISE_UNCERTAINTY) * group.noise[channel] ** 2
    most = SUFFICIENT * group.error_floor[channel]
    return fitted.held_out[channel] > (min(least, most) if group.floor_by_best else most)


def candidates_of(group: Group, null: Fitted, tick: Callable[[], None] = lambda: None
                  ) -> dict[Names, Candidate]:
    """Return the fits of single effects, of pairs of the best, and of triples on the best pair."""
    found: dict[Names, Candidate] = {(): Candidate((), (), null)}
    group.scale.update(initial_guesses(null))
    choices: dict[Names, list[tuple[Variant, ...]]] = {
        (name,): [(form,) for form in forms if channels_of(form, group) and not form.joined]
        for name, forms in group.effects.items()}
    found |= _fit_best_screened(group, null, choices, SINGLES, tick)
    found |= refitted_from_related(group, found)
    singles = sorted((c for c in found.values() if len(c.names) == 1),
                     key=lambda c: c.fitted.cost)
    null = refit(group, null, [single.fitted for single in singles[:NULL_RESTARTS]])
    found[()] = Candidate((), (), null)
    if not singles or not any(_needs_more(group, singles[0].fitted, channel)
                              for channel in group.channels):
        return _without_closed(found)
    for first in singles[:EXTENDED]:
        found |= _extended(first, found, tick)
    found |= _refitted_pairs(group, found)
    pairs = [candidate for names, candidate in found.items() if len(names) == 2]
    if pairs:
        found |= _extended(min(pairs, key=lambda c: c.fitted.cost), found, tick)
    for first in singles[:EXTENDED]:
        richer = sorted((c.fitted for names, c in found.items()
                         if len(names) == 2 and set(first.variants) <= set(c.variants)),
                        key=lambda fitted: fitted.cost)
        better = [fitted for fitted in richer[:1] if fitted.cost < 0.98 * first.fitted.cost]
        found[first.names] = first._replace(fitted=refit(group, first.fitted, better))
    return _without_closed(found | _pruned(group, found))


def _without_closed(found: dict[Names, Candidate]) -> dict[Names, Candidate]:
    """Return the fits but those of a backlash that has closed."""
    return {names: each for names, each in found.items()
            if not is_closed(each.variants, each.fitted.free, each.fitted.theta)}


def _refitted_pairs(group: Group, found: dict[Names, Candidate]) -> dict[Names, Candidate]:
    """Return pairs that fit worse than one of their effects alone, refitted from that."""
    better: dict[Names, Candidate] = {}
    for names, pair in found.items():
        if len(names) == 2:
            alone = min((found[(name,)] for name in names if (name,) in found),
                        key=lambda candidate: candidate.fitted.cost)
            if alone.fitted.cost < pair.fitted.cost:
                again = fit_variants(group, LinearScreen(alone.fitted), pair.variants)
                better[names] = pair._replace(fitted=polish(group, again))
    return better


def _pruned(group: Group, found: dict[Names, Candidate]) -> dict[Names, Candidate]:
    """
    Return the best hypothesis without one of its effects, where that improves the smaller one.

    A single effect may have been fitted in a form that is not the best one in a combination, or
    not at all. The best of the smaller ones is reduced in turn.
    """
    best = min(found.values(), key=lambda candidate: candidate.fitted.cost)
    better: dict[Names, Candidate] = {}
    while len(best.names) > 1:
        smaller = []
        for effect in (name for name in group.effects if name in best.names):
            names = tuple(name for name in best.names if name != effect)
            variants = tuple(each for each in best.variants if each not in group.effects[effect])
            if len(variants) == len(names) and not any(each.joined for each in variants):
                fitted = fit_subset(group, found[()].fitted, variants, best.fitted)
                smaller.append(Candidate(names, variants, fitted))
        better |= {each.names: each for each in smaller if each.names not in found
                   or each.fitted.cost < found[each.names].fitted.cost}
        if not smaller:
            break
        best = min(smaller, key=lambda candidate: candidate.fitted.cost)
    return better


def _extended(first: Candidate, found: dict[Names, Candidate], tick: Callable[[], None]
           ) -> dict[Names, Candidate]:
    """Return a hypothesis extended by one effect, for the best effects of the linear screen."""
    group = first.fitted.problem.group
    # With the first effect fitted, initial guesses improve; those in its own bounds are kept.
    group = replace(group, scale=group.scale | {
        name: value for name, value in initial_guesses(first.fitted).items()
        if name not in {free.scale for free in first.fitted.free}})
    more = {tuple(sorted({*first.names, name})): list(_second_effects(group, first, name))
            for name in group.effects if name not in first.names}
    return _fit_best_screened(group, first.fitted, {
        names: variants for names, variants in more.items() if variants}, SECONDS, tick, 1, {
            names: candidate.fitted.cost for names, candidate in found.items()})


def _fit_best_screened(group: Group, base: Fitted, choices: dict[Names, list[tuple[Variant, ...]]],
                    most: int, tick: Callable[[], None], forms: int = FORMS,
                    reached: Mapping[Names, float] = MappingProxyType({})
                    ) -> dict[Names, Candidate]:
    """
    Return the fits of the hypotheses with the lowest cost in the linear screen.

    choices: alternative forms of each hypothesis; most: number of hypotheses that are fitted, each
    in all forms that have one of the best `forms` sets of free parameters; reached: costs of
    hypotheses that were fitted from another base; they are fitted again if the screen expects a
    lower cost from this one.
    """
    if not choices:
        return {}
    screen = LinearScreen(base)
    screened = []

    def costs_of(alternatives: list[tuple[Variant, ...]]) -> list[tuple[float, int]]:
        return [(screen.cost(group, variants), number)
                for number, variants in enumerate(alternatives)]

    costs = in_threads(costs_of, choices.values())
    for (names, alternatives), of_forms in zip(choices.items(), costs, strict=True):
        ranked = [(cost, alternatives[number]) for cost, number in sorted(of_forms)]
        fields = list(dict.fromkeys(frozenset(fields_of(variants)) for _, variants in ranked))
        screened += [(cost, names, variants) for cost, variants in ranked
                     if fields_of(variants) in fields[:forms]
                     and cost < (1.0 - LEAST_SCREENED_GAIN) * min(base.cost,
                                                           reached.get(names, math.inf))]
        tick()
    screened.sort(key=lambda entry: entry[0])
    chosen = list(dict.fromkeys(names for _, names, _ in screened))[:most]
    found: dict[Names, Candidate] = {}
    promising = [(names, variants) for _, names, variants in screened if names in chosen]
    fits = in_threads(lambda each: fit_variants(group, screen, each[1], forms), promising)
    for (names, variants), fitted in zip(promising, fits, strict=True):
        best = found[names].fitted.cost if names in found else reached.get(names, math.inf)
        if fitted.cost < best:
            found[names] = Candidate(names, variants, fitted)
    least = sorted(candidate.fitted.cost for candidate in found.values())[:POLISHED]
    limit = min(POLISHED_RATIO * least[0], least[-1]) if least else 0.0
    near = [each for each in found.values() if each.fitted.cost <= limit]
    polished = in_threads(lambda each: polish(group, each.fitted), near)
    found |= {each.names: each._replace(fitted=fitted)
              for each, fitted in zip(near, polished, strict=True)}
    return _without_closed(found)


def _second_effects(group: Group, first: Candidate, name: str) -> Iterable[tuple[Variant, ...]]:
    """Yield the forms of a first hypothesis with each compatible form of a further effect."""
    fixed = dict(pair for variant in first.variants for pair in variant.fixed)
    friction = any('friction_level' in variant.fields for variant in first.variants)
    creeps = any('friction_creep' in variant.fields for variant in first.variants)
    for variant in group.effects[name]:
        clash = any(fixed.get(field, value) != value for field, value in variant.fixed)
        adds_friction = 'friction_level' in variant.fields
        clash |= friction and adds_friction and creeps != ('friction_creep' in variant.fields)
        # Two kinds of friction are combined in one friction model.
        leaves = any(_needs_more(group, first.fitted, each)
                     for each in channels_of(variant, group))
        if leaves and not clash and variant.joined == (
                friction and adds_friction and name == 'friction_asymmetry'):
            yield (*first.variants, variant)


def evidence_of(group: Group, found: dict[Names, Candidate]) -> Evidence:
    """
    Return the evidence of a group's hypotheses.

    Hypotheses propagate the noise of their measured inputs differently. To be comparable, each
    residual is reduced by its propagated noise in excess of that of the nominal model. The noise
    variance is lowered if a residual is smaller than it.
    """
    best = min(found.values(), key=lambda candidate: candidate.fitted.cost)
    noise = {channel: level ** 2 for channel, level in group.noise.items()}
    propagated = {names: _propagated_noise(group, candidate.fitted)
                  for names, candidate in found.items()}
    independent = independent_samples(group, best.fitted.record)
    residual = {names: {channel: max(left, SMALLEST_RESIDUAL * group.error_floor[channel])
                        for channel, left in candidate.fitted.held_out.items()}
                for names, candidate in found.items()}
    for channel, level in noise.items():
        more = {names: propagated[names][channel] - propagated[()][channel] for names in found}
        left = {names: residual[names][channel] / (level + more[names] + 1e-300)
                for names in found}
        share = min(1.0, *left.values())
        # Of few independent samples, it is known to a few tenths: what the nominal model leaves
        # may be noise alone.
        if left[()] < share * (1.0 + 2.0 * math.sqrt(2.0 / max(independent[channel], 2.0))):
            share = min(1.0, left[()])
        for names in found:
            # The excess, within its uncertainty, that leaves the common noise variance.
            ends = [factor * more[names] for factor in (
                share * (1.0 - NOISE_UNCERTAINTY), 1.0 + NOISE_UNCERTAINTY)]
            above = residual[names][channel] - share * level
            residual[names][channel] = max(
                residual[names][channel] - min(max(above, min(ends)), max(ends)),
                LEAST_RESIDUAL * residual[names][channel])
    floor, formulation = group.error_floor, group.formulation
    least = {channel: min(each[channel] for each in residual.values()) for channel in floor}
    if group.floor_by_best and all(least[name] < QUIET_RATIO * noise[name] for name in floor):
        # A rough command, or noise above the compared band, is no noise of what is compared.
        noise = {name: min(level, least[name]) for name, level in noise.items()}
        # Of a valve, which is measured directly, all that is left is known.
        margin = 1.0 + NOISE_SHARE if group.channels == ('valve',) else FLOOR_MARGIN
        error = {name: max(least[name] - level, 0.0) for name, level in noise.items()}
        floor = {name: min(level, max(margin * max(noise[name], least[name]),
                                      least[name] + error[name]))
                 for name, level in floor.items()}
        formulation = {name: min(level, error[name]) for name, level in formulation.items()}
    return Evidence(
        noise, floor, formulation,
        independent, group.held_out_s, residual,
        {names: len({field.partition('@')[0] for field in fields_of(candidate.variants)})
         for names, candidate in found.items()},
        {names: _log_odds_against_values(candidate, group) for names, candidate in found.items()},
        group.floor_measured)


def _log_odds_against_values(candidate: Candidate, group: Group) -> float:
    """Return the log prior odds against the values of parameters beyond their tolerance."""
    return sum(log_odds_against(candidate.fitted.values[free.field]
                                / float(group.nominal[free.field]))
               for name in group.effects
               if name in candidate.names and name.startswith(PARAMETER)
               for form in group.effects[name] if form in candidate.variants
               for free in form.free)


def _propagated_noise(group: Group, fitted: Fitted) -> Values:
    """Return the mean square propagated noise of each channel."""
    return {channel: float(np.mean([propagated_noise(recording, channel, fitted.record)
                                    for recording in group.recordings]))
            for channel in group.channels}


def weigh(group: Group, found: dict[Names, Candidate]) -> Weighed:
    """Return a group with the probability of every hypothesis, with `unknown`."""
    effective = effective_hypotheses(found)
    evidence = evidence_of(group, effective)
    constants = CONSTANTS   # with a baseline, too: the model error is measured then
    if group.channels == ('static',) or group.floor_by_best:
        quiet = evidence.error_floor != group.error_floor
        constants = SERVO if quiet and group.channels == ('valve',) else OWN_MODEL
    chance = probabilities(evidence, constants)
    if group.channels == ('load',) and (group.floor_by_best or group.floor_measured):
        chance = as_simple_friction(chance, effective)
    return Weighed(group, effective, chance)


def effective_hypotheses(found: dict[Names, Candidate]) -> dict[Names, Candidate]:
    """
    Return the hypotheses in which every effect lowers the cost.

    With an effect of size zero, a hypothesis equals the one without that effect, and would share
    its probability.
    """
    def explains(candidate: Candidate) -> bool:
        return all(candidate.fitted.cost < (1.0 - LEAST_EXPLAINED) * found[part].fitted.cost
                   for part in (tuple(n for n in candidate.names if n != name)
                                for name in candidate.names) if part in found)

    return {names: candidate for names, candidate in found.items() if explains(candidate)}


def weigh_groups(groups: Sequence[Group], tick: Callable[[], None] = lambda: None,
                 known: Sequence[Weighed | None] = ()) -> list[Weighed]:
    """Return the groups, in the order of the signal chain, with all probabilities, or `known`."""
    weighed: list[Weighed] = []
    for group, answer in itertools.zip_longest(groups, known):
        if answer is not None:
            weighed.append(answer)
            continue
        if weighed and weighed[0].group.channels == ('valve',):
            group = with_noise_of_valve(group, weighed[0].group)
        sure = weighed and marginals(weighed[0].probability)[UNKNOWN] < 0.5
        if sure and weighed[0].group.channels == ('valve',):
            best = max(weighed[0].candidates, key=lambda n: weighed[0].probability[n])
            valve = weighed[0].candidates[best].fitted
            group = with_less_noisy_valve(with_known_gain(group, valve), valve.record)
        null = fit_null(group)
        # The noise of a static characteristic is measured; a perfect line has none.
        if group.channels != ('static',) and (
                quieter := with_lower_noise(group, null.held_out)) is not group:
            group, null = quieter, fit_null(quieter)
        group = with_parameter_errors(_with_noise_left(group, null), null)
        found = candidates_of(group, null, tick)
        leader = min(found.values(), key=lambda candidate: candidate.fitted.cost)
        group = _with_noise_left(group, leader.fitted)
        weighed.append(_weigh_static(group, null, found) if group.channels == ('static',) else
                       weigh(group, found))
    return weighed


def _with_noise_left(group: Group, fitted: Fitted) -> Group:
    """Return a group of an actuator with what a fit leaves as noise, if it is noise, but more."""
    if group.floor_by_best or group.channels == ('static',):
        return group
    return with_coloured_noise(group, fitted.record)


def _weigh_static(group: Group, null: Fitted, found: dict[Names, Candidate]) -> Weighed:
    """
    Return the group of a static characteristic with the probability of every hypothesis.

    The simplest of the nested forms is taken. An implausible hypothesis (a disturbance in step
    with the input, or three effects on the shape) counts only if no other explains the gap, and
    is then less probable than `unknown`.
    """
    every: dict[Names, Candidate] = {}
    for each in found.values():
        simple = _simplest(group, null, each)
        if at_the_end(group, simple.fitted.record):
            if 'valve_saturation' in simple.names:
                continue
            simple = _simplest(group, null, _with_limit(group, null, simple))
        known = every.get(simple.names)
        if known is None or simple.fitted.cost < known.fitted.cost:
            every[simple.names] = simple
    implausible = {names: each for names, each in every.items()
                   if _has_disturbance_in_step(group, each) or len(SHAPES & set(names)) > 2}
    weighed = weigh(group, {names: each for names, each in every.items()
                            if names not in implausible})
    most_probable = max(weighed.probability, key=lambda names: weighed.probability[names])
    if UNKNOWN not in most_probable or not implausible:
        return weighed
    best = min(implausible.values(), key=lambda each: each.fitted.cost)
    outside = sum(p for names, p in weighed.probability.items() if UNKNOWN in names)
    # At most so much that it stays less probable than the best of the others.
    share = min(IMPLAUSIBLE_SHARE, 0.9 * weighed.probability[most_probable] / (
        outside + weighed.probability[most_probable]))
    chance = {names: p * (1.0 - share if UNKNOWN in names else 1.0)
              for names, p in weighed.probability.items()}
    chance[best.names] = share * outside
    return weighed._replace(probability=chance,
                            candidates=weighed.candidates | {best.names: best})


def _simplest(group: Group, null: Fitted, found: Candidate) -> Candidate:
    """Return a hypothesis in those nested forms that fit as well with the fewest parameters."""
    for variants in (group.effects[name] for name in group.effects if name in found.names):
        own = next(each for each in found.variants if each in variants)
        forms = {own: found.fitted}
        for form in variants:
            if form.fields < own.fields or form.fields > own.fields:
                forms[form] = fit_subset(group, null, tuple(
                    form if each is own else each for each in found.variants), found.fitted)
        best = min(forms, key=lambda form: len(form.free)
                   + forms[form].cost * (1.0 + PARAMETER_PRICE * len(form.free)))
        found = found._replace(fitted=forms[best], variants=tuple(
            best if each is own else each for each in found.variants))
    return found


def _with_limit(group: Group, null: Fitted, found: Candidate) -> Candidate:
    """Return a hypothesis with a saturation in place of a dead band at an end of the range."""
    p, field = as_limit(found.fitted.record)
    band, limit = 'valve_deadband', 'valve_saturation'
    form = next(each for each in group.effects[limit] if each.fields == {field, 'corner'})
    variants = tuple(form if each in group.effects[band] else each for each in found.variants)
    names = tuple(sorted(limit if name == band else name for name in found.names))
    return Candidate(names, variants, fit_subset(group, null, variants,
                                                 found.fitted._replace(record=p)))


def _has_disturbance_in_step(group: Group, found: Candidate) -> bool:
    """Return whether a hypothesis has a disturbance in step with the input in each recording."""
    values = found.fitted.values
    return 'disturbance_frequency' in values and all(
        in_step(r, values[of_recording('disturbance_frequency', r.number)])
        for r in group.recordings if r.fit.any())


def with_parameter_errors(group: Group, null: Fitted) -> Group:
    """
    Return a group with hypotheses of nominal parameters beyond their tolerance.

    One for each nominal parameter that is at a bound in the null fit and belongs to no effect.
    """
    held = fields_of(itertools.chain(*group.effects.values()))
    bounds = {free.field: (free.low, free.high) for free in group.nuisance}
    effects = dict(group.effects)
    for field, limit in null.at_limit.items():
        if field not in held:
            effects |= parameter_error(field, limit, bounds[field], tuple(
                channel for channel in group.channels if acts_on(field, channel, group)))
    return replace(group, effects=effects)


def join(groups: Sequence[Weighed]) -> dict[Names, float]:
    """Return the joint probability of every combination of one hypothesis of each group."""
    return join_probabilities([weighed.probability for weighed in groups])
