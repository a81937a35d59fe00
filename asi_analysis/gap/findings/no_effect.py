"""
What is no effect of its own, though it is free as one in block-wise fits.

A tolerated gain of the force sensor, a constant force in a gap, a delay or lag of less than a
sample.
"""

import math

from scipy.stats import norm

from asi_analysis.gap.inference.beyond_tolerance import LEAST_PROBABILITY
from asi_analysis.gap.inference.hypotheses import Candidate, Weighed
from asi_analysis.gap.inference.probability import CONSTANTS, Names, with_moved
from asi_analysis.gap.inference.uncertainty import LIMIT_95, interval, likelihood
from asi_analysis.gap.model.blocks import load_constants
from asi_analysis.gap.model.effects import UNKNOWN

GAIN = 'sensor_gain'
SENSOR_GAIN = 'force_sensor_gain'
GAIN_ERROR = 'sensor_gain_error'   # of the block-wise model, relative to the nominal gain
DISTURBANCE = 'disturbance_force'
LATE = {'transport_delay': 'command_delay', 'valve_lag': 'valve_lag'}   # and their time
# Fields of a constant one: of the block-wise model and of the simulator.
CONSTANT = frozenset(('disturbance', 'load_external_force'))


def with_tolerated_gain(weighed: Weighed, tolerance: float) -> Weighed:
    """
    Return a group in which `sensor_gain` is a gain beyond its tolerance.

    That part of the probability of a hypothesis with this effect that lies within the tolerance,
    by the interval of the fitted gain, belongs to the hypothesis without it; there are the prior
    odds of an effect against the rest. In block-wise fits the gain is free only as an effect: as
    one more uncertain parameter it would scale the others.
    """
    for names, candidate in weighed.candidates.items():
        if GAIN in names and weighed.probability[names] >= LEAST_PROBABILITY:
            weighed = _moved(weighed, names, GAIN, _share_within(candidate, tolerance))
    return weighed


def with_gap_centre(weighed: Weighed) -> Weighed:
    """
    Return a group in which a constant force beside a backlash is the place of its gap.

    Where the middle of the gap lies is not known: away from it, the spring of the load pulls with
    a constant force. A force that would place the gap outside the motion is a disturbance.
    """
    furthest = weighed.group.scale['position']
    for names, candidate in weighed.candidates.items():
        if {'backlash', DISTURBANCE} <= set(names):
            _, _, stiffness = load_constants(candidate.fitted.record)
            force = _constant_force(candidate)
            if force is not None and abs(force) <= stiffness * furthest:
                weighed = _moved(weighed, names, DISTURBANCE, 1.0)
    return weighed


def without_sampling_delay(weighed: Weighed) -> Weighed:
    """
    Return a group of a joint in which a delay or lag of less than a sample is no effect.

    A controller holds its command, and time stamps may be off by as much.
    """
    period = min(recording.period_s for recording in weighed.group.recordings)
    for effect, field in LATE.items():
        for names, candidate in weighed.candidates.items():
            if effect in names and candidate.fitted.values.get(field, period) < period:
                weighed = _moved(weighed, names, effect, 1.0)
    return weighed


def sampling_delay(best: Candidate) -> str | None:
    """Return the note on a delay or lag that is taken for that of the recording; None: none."""
    late = [best.fitted.values[field] for effect, field in LATE.items()
            if field in best.fitted.values and effect not in best.names
            and best.fitted.values[field] < min(
                r.period_s for r in best.fitted.problem.group.recordings)]
    return (f'a delay of {1e3 * sum(late):.2g} ms, less than a sample, is taken for that of the '
            'recording') if late else None


def place_of_gap(best: Candidate) -> str | None:
    """Return the note on a constant force that is the place of a gap; None if there is none."""
    force = _constant_force(best)
    if force is None or DISTURBANCE in best.names or 'backlash' not in best.names:
        return None
    return (f'beside the backlash, a constant force of {force:.3g} N fits: it is taken for the '
            'place of the gap; a constant force on the load would look the same')


def _constant_force(candidate: Candidate) -> float | None:
    """Return the largest constant disturbance of a hypothesis, N; None if it has none."""
    for variant in candidate.variants:
        fields = [free.field for free in variant.free]
        if fields and all(field.partition('@')[0] in CONSTANT for field in fields):
            return max((float(candidate.fitted.record[field]) for field in fields), key=abs)
    return None


def _moved(weighed: Weighed, names: Names, effect: str, share: float) -> Weighed:
    """Return a group in which a share of a hypothesis belongs to the one without an effect."""
    chance, candidates = dict(weighed.probability), dict(weighed.candidates)
    rest = _without(names, effect)
    if rest not in candidates or share * chance[names] > chance.get(rest, 0.0):
        candidates[rest] = candidates[names]._replace(names=rest)
    for each in [n for n in chance if effect in n and set(names) == set(n) - {UNKNOWN}]:
        chance = with_moved(chance, each, _without(each, effect), share)
    return weighed._replace(candidates=candidates, probability=chance)


def _without(names: Names, effect: str) -> Names:
    return tuple(name for name in names if name != effect)


def _share_within(candidate: Candidate, tolerance: float) -> float:
    """Return the probability that the fitted gain is within its tolerance, where most are."""
    fitted = candidate.fitted
    group = fitted.problem.group
    field = GAIN_ERROR if GAIN_ERROR in {free.field for free in fitted.free} else SENSOR_GAIN
    value, *ends = (
        each if field == GAIN_ERROR else each / float(group.nominal[SENSOR_GAIN]) - 1.0
        for each in (float(fitted.record[field]), *interval(fitted, likelihood(fitted), field)))
    deviation = max((ends[1] - ends[0]) / (2.0 * LIMIT_95), 1e-9)
    inside = norm.cdf((tolerance - value) / deviation) - norm.cdf((-tolerance - value) / deviation)
    return float(inside / (inside + math.exp(-CONSTANTS.price) * (1.0 - inside)))
