"""
Probabilities of hypotheses from the residuals of their fits.

In two steps: how many effects there are, relative to the error floor; and which ones, relative to
the noise with the effective sample size. See doc/explanation/gap_method.md.
"""

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

from asi_analysis.gap.model.effects import EFFECTS, NO_GAP, PARAMETER, UNKNOWN, has_one_law
from asi_analysis.gap.model.group import Values

Names = tuple[str, ...]


class Constants(NamedTuple):
    """
    The constants of the probabilities, fitted on blind cases by bench/tune_probabilities.py.

    How many effects: samples: effective samples of a channel with USUAL_S of held-out data; price:
    log prior odds against a first effect; second: against each further one; formulation, exact:
    rms error of the formulation of an effect, as a share of what it explains, without and with
    one law; fitted_floor: weight of the smallest residual in the error floor, against its prior
    value.
    Which effects: trust: weight of the log likelihood; parameter: log prior odds against each
    further parameter; indistinct: share of the formulation error within which residuals are
    equal; formulation_samples: effective samples of the formulation error.
    `unknown`: unknown_offset: log odds; unknown_floor, unknown_gap: their slopes in the log of the
    residual relative to the error floor and to the gap; masked: probability of an effect that the
    nominal nonlinearities mask, where their formulation makes the whole error floor.
    """

    samples: float = 22.0
    price: float = 4.0
    second: float = 5.4
    formulation: float = 0.08
    exact: float = 0.025
    fitted_floor: float = 0.355
    trust: float = 0.43
    parameter: float = 0.53
    indistinct: float = 0.29
    formulation_samples: float = 100.0
    unknown_offset: float = -4.0
    unknown_floor: float = 1.42
    unknown_gap: float = 0.73
    masked: float = 0.17


CONSTANTS = Constants()
# Of a joint or a static characteristic; tuned on blind joints of seeds 340000 to 340149, and on
# mixed ones of seeds 360000 to 360079.
OWN_MODEL = CONSTANTS._replace(unknown_offset=-2.4, unknown_gap=0.45)
# Of a servo: its output is measured directly, so that formulation errors are small.
SERVO = OWN_MODEL._replace(exact=0.005, formulation=0.01)
# Of the simulator, whose error floor is little more than the noise.
SIMULATOR = CONSTANTS._replace(unknown_offset=-1.4)
# A machine that obeys other laws than the simulator's, and on which no effect is found, has none,
# or one that the difference of the laws hides: about as often, on machines by other authors.
NONE_HIDDEN = 0.55
NOISE_SHARE = 0.1   # of the noise variance: smaller differences of residuals do not count
LEAST_RESIDUAL = 0.01   # of the error floor: lower limit of a residual
USUAL_S = 5.0       # length of the held-out data that `Constants` refer to
# Factor of the slope of `unknown` in the log residual, if the error floor was measured.
MEASURED = 2.0
BEYOND_TOLERANCE = 1.1   # log prior odds of an effect against a parameter beyond its tolerance
# Such a parameter has a log-normal prior: its log has a standard deviation of log(USUAL_FACTOR).
USUAL_FACTOR = 2.0


def log_odds_against(ratio: float) -> float:
    """Return the log prior odds against a parameter with this ratio to its nominal value."""
    return 0.5 * (math.log(ratio) / math.log(USUAL_FACTOR)) ** 2


class Evidence(NamedTuple):
    """
    The data from which the probabilities of a group's hypotheses follow.

    noise, error_floor, formulation: mean squares, as in `Group`; independent: effective sample
    size; residual: mean square on the held-out parts; all by channel. parameters: number of free
    parameters of the effects. far: log prior odds against nominal parameters so far beyond their
    tolerance. measured: the error floor is what healthy recordings of the same machine leave.
    """

    noise: Values
    error_floor: Values
    formulation: Values
    independent: Values
    held_out_s: float
    residual: dict[Names, Values]
    parameters: dict[Names, int]
    far: Mapping[Names, float] = MappingProxyType({})
    measured: bool = False


def as_plain(e: Evidence) -> dict[str, Any]:
    """Return evidence as plain data, with the keys of rows.jsonl."""
    names = list(e.residual)
    return {'noise': e.noise, 'floor': e.error_floor, 'formulation': e.formulation,
            'independent': e.independent, 'held_out_s': e.held_out_s,
            'left': [e.residual[n] for n in names],
            'parameters': [e.parameters[n] for n in names], 'names': [list(n) for n in names],
            'far': [e.far.get(n, 0.0) for n in names]}


def as_evidence(plain: Mapping[str, Any]) -> Evidence:
    """Return the inverse of `as_plain`."""
    names = [tuple(n) for n in plain['names']]
    return Evidence(plain['noise'], plain['floor'], plain['formulation'], plain['independent'],
                    plain['held_out_s'], dict(zip(names, plain['left'], strict=True)),
                    dict(zip(names, plain['parameters'], strict=True)),
                    dict(zip(names, plain['far'], strict=True)))


def _log_evidence(e: Evidence, c: Constants) -> dict[Names, float]:
    """
    Return the log evidence of each hypothesis against others with as many effects.

    The log likelihood of the residual, with the effective sample size of the best hypothesis. If
    its residual is near the noise, that is large. A larger residual is correlated, so the
    effective sample size is small; formulation errors reduce it further.
    """
    evidence = {names: -c.parameter * max(e.parameters[names] - len(names), 0)
                - BEYOND_TOLERANCE * sum(name.startswith(PARAMETER) for name in names)
                - e.far.get(names, 0.0)
                for names in e.residual}
    for channel, noise in e.noise.items():
        best = min(e.residual, key=lambda names: e.residual[names][channel])
        formulation = e.formulation[channel] + _formulation_error(e, c, best, channel)
        share = formulation / (formulation + noise + 1e-300)
        samples = 1.0 / (1.0 / e.independent[channel] + share / c.formulation_samples)
        level = NOISE_SHARE * noise + c.indistinct * formulation
        for names, residual in e.residual.items():
            evidence[names] -= c.trust * 0.5 * samples * math.log(residual[channel] + level)
    return evidence


def _evidence_gain(e: Evidence, c: Constants, before: Names, after: Names) -> float:
    """
    Return the gain in log evidence from one set of effects to a larger one.

    From the residuals relative to the error floor plus the formulation error of the smaller set.
    For a first effect, the white noise is subtracted from both: its power is known to NOISE_SHARE
    and would hide an effect that is clear in so many samples.
    """
    samples, gain = _effective_samples(e, c), 0.0
    for channel, floor in e.error_floor.items():
        first, second = e.residual[before][channel], e.residual[after][channel]
        least = min(residual[channel] for residual in e.residual.values())
        least = min(max(least, LEAST_RESIDUAL * floor), floor)
        white = 0.0 if before else (1.0 - NOISE_SHARE) * min(e.noise[channel], least)
        level = ((floor - white) ** (1.0 - c.fitted_floor) * (least - white) ** c.fitted_floor
                 + _formulation_error(e, c, before, channel))
        gain += 0.5 * samples * math.log((first - white + level) / (second - white + level))
    return gain


def _formulation_error(e: Evidence, c: Constants, names: Names, channel: str) -> float:
    """Return the mean square formulation error of the effects of a hypothesis."""
    share = max((c.exact if has_one_law(name) else c.formulation for name in names), default=0.0)
    return share ** 2 * max(e.residual[()][channel] - e.residual[names][channel], 0.0)


def _price(effects: int, c: Constants) -> float:
    """Return the log prior odds against so many effects."""
    return c.price + c.second * (effects - 1) if effects else 0.0


def _effective_samples(e: Evidence, c: Constants) -> float:
    """Return the effective sample size of a channel's residual, if it is a model error."""
    # A model error is correlated over a recording: its information grows with the square root.
    return c.samples * math.sqrt(e.held_out_s / USUAL_S)


def _evidence_limit(e: Evidence, c: Constants) -> float:
    """
    Return the upper limit of the log evidence against the nominal model.

    It is 0 if the residual of the nominal model is at the error floor, even if that of another
    hypothesis is far smaller.
    """
    return 0.5 * _effective_samples(e, c) * sum(
        max(math.log(e.residual[()][channel] / floor), 0.0)
        for channel, floor in e.error_floor.items())


def unknown_probability(e: Evidence, best: Names, c: Constants) -> float:
    """
    Return the probability of an effect outside the vocabulary.

    It grows with the residual of the best hypothesis above the error floor, in the worst channel.
    """
    worst, masked = -math.inf, 0.0
    slope = c.unknown_floor * (MEASURED if e.measured else 1.0)
    for channel, floor in e.error_floor.items():
        masked = max(masked, c.masked * min(e.formulation[channel] / floor, 1.0))
        residual, gap = e.residual[best][channel], e.residual[()][channel]
        worst = max(worst, unknown_odds(residual / floor, gap / floor, c, slope))
    return max(as_probability(worst), 0.0 if best else masked)


def unknown_odds(residual: float, gap: float, c: Constants, slope: float) -> float:
    """
    Return the log odds of an effect outside the vocabulary, from one channel.

    residual: of the best hypothesis; gap: of the nominal model (mean squares, in error floors);
    slope: of the log odds in the log of the residual.
    """
    excess = residual - 1.0
    if excess <= 0.0:
        return -math.inf
    return c.unknown_offset + slope * math.log(residual) + c.unknown_gap * math.log(
        excess / max(gap - 1.0, excess))


def as_probability(log_odds: float) -> float:
    """Return the probability that belongs to log odds."""
    return 1.0 / (1.0 + math.exp(-log_odds)) if log_odds > -50.0 else 0.0


def probabilities(e: Evidence, c: Constants = CONSTANTS) -> dict[Names, float]:
    """Return the probability of each hypothesis of a group, with and without something unknown."""
    which = _log_evidence(e, c)
    score = {0: 0.0}
    best: dict[int, Names] = {0: ()}
    for before, count in itertools.pairwise(sorted({0} | {len(names) for names in which})):
        best[count] = max((names for names in which if len(names) == count),
                          key=lambda names: which[names])
        score[count] = (score[before] - _price(count, c) + _price(before, c)
                        + _evidence_gain(e, c, best[before], best[count]))
    highest = max(score.values())
    score[0] = max(0.0, highest - _evidence_limit(e, c))
    weight = {count: math.exp(value - highest) for count, value in score.items()}
    chance = {}
    for names, value in which.items():
        count = len(names)
        same = sum(math.exp(which[other] - which[best[count]]) for other in which
                   if len(other) == count)
        chance[names] = (weight[count] / sum(weight.values())
                         * math.exp(value - which[best[count]]) / same)
    likely = max(chance, key=lambda names: chance[names])
    unknown = unknown_probability(e, likely, c)
    effects = max((names for names in chance if names), key=lambda names: chance[names],
                  default=())
    # What is below the error floor needs no effect.
    gap, left = ([e.residual[names][channel] + e.error_floor[channel] for channel in e.noise]
                 for names in ((), effects))
    return with_unknown(chance, unknown, beside_unknown(
        gap, left, len(effects), _effective_samples(e, c), c))


def beside_unknown(gap: Iterable[float], left: Iterable[float], effects: int, samples: float,
                   c: Constants) -> float:
    """
    Return the probability that effects are real, if there is something unknown.

    Either what is unknown makes the whole gap, or what the effects leave of it. It has so many
    effective samples, and each effect has its prior odds, as in `probabilities`.

    gap, left: mean squares of each channel without and with the effects; effects: their number.
    """
    gain = 0.5 * samples * sum(math.log(before / after)
                               for before, after in zip(gap, left, strict=True))
    return as_probability(gain - _price(effects, c)) if effects else 0.0


def with_unknown(chance: Mapping[Names, float], unknown: float, real: float
                 ) -> dict[Names, float]:
    """
    Return the probability of every hypothesis with and without something unknown.

    chance: probabilities without; unknown: probability of something unknown; real: probability
    that effects are real beside it.
    """
    effects = 1.0 - chance[()]
    beside = {tuple(sorted((*names, UNKNOWN))): unknown * real * p / effects
              for names, p in chance.items() if names and effects > 0.0}
    return ({names: (1.0 - unknown) * p for names, p in chance.items()} | beside
            | {(UNKNOWN,): unknown - sum(beside.values())})


def with_hidden_effect(joined: Mapping[Names, float]) -> dict[Names, float]:
    """
    Return the probabilities on a machine that the simulator's own laws do not explain.

    If `no_gap` is the most probable, it keeps at most NONE_HIDDEN of that and `unknown` together.
    """
    none, unknown = joined[()], joined.get((UNKNOWN,), 0.0)
    kept = min(none, NONE_HIDDEN * (none + unknown))
    if none < max(joined.values()):
        return dict(joined)
    return {**joined, (): kept, (UNKNOWN,): none + unknown - kept}


def with_moved(chance: Mapping[Names, float], of: Names, to: Names, share: float = 1.0
               ) -> dict[Names, float]:
    """Return probabilities, of which a share of that of one hypothesis is now another's."""
    moved = share * chance.get(of, 0.0)
    return {**chance, of: chance.get(of, 0.0) - moved, to: chance.get(to, 0.0) + moved}


def join_probabilities(groups: Sequence[dict[Names, float]]) -> dict[Names, float]:
    """Return the probability of every union of one hypothesis of each group."""
    joined: dict[Names, float] = {}
    for parts in itertools.product(*(chances.items() for chances in groups)):
        names = tuple(sorted({name for part, _ in parts for name in part}))
        joined[names] = joined.get(names, 0.0) + math.prod(p for _, p in parts)
    return joined


def marginals(joined: dict[Names, float]) -> dict[str, float]:
    """Return the probability of each effect, of `no_gap` and of `unknown`."""
    total: dict[str, float] = dict.fromkeys(EFFECTS, 0.0)
    total[UNKNOWN] = 0.0
    for names, probability in joined.items():
        for name in names:
            total[name] = total.get(name, 0.0) + probability
    return total | {NO_GAP: joined.get((), 0.0)}


def ambiguity_set(joined: dict[Names, float], coverage: float = 0.9) -> list[Names]:
    """Return the smallest set of hypotheses with at least this total probability."""
    chosen, total = [], 0.0
    for names, probability in sorted(joined.items(), key=lambda item: -item[1]):
        chosen.append(names)
        total += probability
        if total >= coverage:
            break
    return chosen
