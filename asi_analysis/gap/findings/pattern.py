"""
What a hypothesis leaves, if it is a function of recorded quantities: the model lacks something.

Residual analysis (Ljung, System Identification, 2nd ed., 16.6): no function of what was recorded
predicts what the right model leaves. It is fitted on one part of the data, judged on another.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from asi_analysis.arrays import Array, Mask
from asi_analysis.gap.inference.beyond_tolerance import LEAST_PROBABILITY
from asi_analysis.gap.inference.fit import comparable
from asi_analysis.gap.inference.hypotheses import NOISE_UNCERTAINTY, QUIET_RATIO, Weighed
from asi_analysis.gap.inference.probability import (
    CONSTANTS,
    Names,
    as_probability,
    has_one_law,
    with_moved,
)
from asi_analysis.gap.model.effects import UNKNOWN
from asi_analysis.gap.model.group import Group
from asi_analysis.gap.model.predict import compared, measured, unexplained
from asi_analysis.gap.prepare import Recording

# A pattern is expected of a right model, too: of its general error (mean squares) this share.
# EVEN times what is expected is as often unknown as not; SLOPE: of the log odds in its log.
OF_ERROR: Final = 0.25
EVEN: Final = 2.5
SLOPE: Final = 3.0
NEGLIGIBLE: Final = 0.1   # residual, in error floors, in which no effect hides that matters
KNOTS: Final = 10        # of a function: so many at equal distances, and so many quantiles
SLOW_KNOTS: Final = 4    # of a function of time
RIDGE: Final = 1e-3      # weight of its values, in mean squares of its columns
RARE: Final = 0.03       # of the rms of a column, what the fitted part holds of it at least
STANDS: Final = 0.05     # of the rms speed: below, the direction of a motion is not told
# The functions: of the first quantity, times the second.
OF_LOAD: Final = (('position', ''), ('velocity', ''), ('force', ''), ('position', 'way'),
                  ('position', 'velocity'), ('position', 'acceleration'), ('time', 'velocity'),
                  ('time', 'force'))
OF_OUTPUT: Final = (('input', ''), ('output', ''), ('velocity', ''), ('output', 'way'),
                    ('output', 'velocity'), ('time', 'input'), ('time', 'velocity'))
# Beside each of them, the linear terms of the nominal model.
LINEAR: Final = ('acceleration', 'velocity', 'position', 'input')


def leaves_more_than_noise(weighed: Weighed) -> bool:
    """Return whether the nominal model of a joint leaves more than can be noise, or be small."""
    group, left = weighed.group, weighed.candidates[()].fitted.held_out
    return not group.floor_measured and any(
        left[channel] > max(QUIET_RATIO * group.noise[channel] ** 2,
                            NEGLIGIBLE * group.error_floor[channel]) for channel in group.channels)


def with_pattern(weighed: Weighed) -> Weighed:
    """
    Return a group in which a hypothesis that leaves a pattern lacks something unknown.

    As far as that pattern explains more without its effects than they do, they are not named
    beside it; as a model they still serve (`closest`).
    """
    group, chance = weighed.group, dict(weighed.probability)
    likely = max(weighed.candidates, key=lambda names: _with_unknown(chance, names))
    nominal = _patterns(weighed, ())
    for names in weighed.candidates:
        if _with_unknown(chance, names) < LEAST_PROBABILITY:
            continue
        own, beside = _patterns(weighed, names), tuple(sorted((*names, UNKNOWN)))
        lacks = as_probability(max(_odds(weighed, names, channel, own[channel], nominal[channel])
                                   for channel in group.channels))
        alone = as_probability(min(_log_ratio(own[channel].left, nominal[channel].rest)
                                   for channel in group.channels)) if names else 0.0
        chance = with_moved(chance, beside, (UNKNOWN,), lacks * alone) if names else chance
        chance = with_moved(chance, names, (UNKNOWN,), lacks * alone)
        chance = with_moved(chance, names, beside, lacks * (1.0 - alone) / (1.0 - lacks * alone))
    return weighed._replace(probability=chance, closest=likely)


def _with_unknown(chance: Mapping[Names, float], names: Names) -> float:
    """Return the probability of effects, with or without something unknown."""
    return chance.get(names, 0.0) + chance.get(tuple(sorted((*names, UNKNOWN))), 0.0)


def _log_ratio(one: float, other: float) -> float:
    """Return the log odds that belong to the ratio of two mean squares: 0 if they are equal."""
    return SLOPE * math.log(max(one, 1e-300) / max(other, 1e-300))


class Pattern(NamedTuple):
    """Mean squares on the samples for model selection: what a model leaves, the rest of it."""

    left: float
    rest: float    # that the best function of recorded quantities does not predict

    @property
    def share(self) -> float:
        """Return the share that the function predicts: 0 of what is only noise."""
        return 1.0 - self.rest / max(self.left, 1e-300)


def _patterns(weighed: Weighed, names: Names) -> dict[str, Pattern]:
    """Return what a hypothesis leaves of each channel."""
    record = weighed.candidates[names].fitted.record
    return {channel: pattern(weighed.group, channel, record)
            for channel in weighed.group.channels}


def _odds(weighed: Weighed, names: Names, channel: str, own: Pattern, nominal: Pattern) -> float:
    """Return the log odds that what a hypothesis leaves of a channel is more than it should."""
    formulation = max((CONSTANTS.exact if has_one_law(name) else CONSTANTS.formulation
                       for name in names), default=0.0)
    noise = weighed.group.noise[channel] ** 2
    expected = (formulation ** 2 * max(nominal.left - own.left, 0.0) + NOISE_UNCERTAINTY * noise
                + OF_ERROR * (weighed.group.error_floor[channel] - noise))
    return _log_ratio(own.left - own.rest, EVEN * expected)


def pattern(group: Group, channel: str, p: np.void) -> Pattern:
    """Return how much of what a model leaves a function of recorded quantities predicts."""
    left = [unexplained(recording, channel, p) for recording in group.recordings]
    fit = [recording.fit for recording in group.recordings]
    others = [comparable(recording, group.recordings) for recording in group.recordings]
    known, target = _rows(left, fit), _rows(left, others)
    whole = rest = float(np.mean(target ** 2))
    for columns in _functions(group, channel, left):
        sizes = [np.sqrt(np.mean(np.square(each), axis=0)) for each in (
            _rows(columns, fit), np.concatenate(columns))]
        # What the fitted part hardly holds is not extrapolated.
        size = np.maximum(sizes[0], RARE * sizes[1]) + 1e-300
        before, after = (_rows(columns, part) / size for part in (fit, others))
        square = before.T @ before + RIDGE * len(before) * np.eye(size.size)
        error = target - after @ np.linalg.solve(square, before.T @ known)
        rest = min(rest, float(np.mean(error ** 2)))
    return Pattern(whole, rest)


def _rows(values: Sequence[Array], parts: Sequence[Mask]) -> Array:
    """Return the rows of all recordings that belong to a part of the data."""
    return np.concatenate([each[part] for each, part in zip(values, parts, strict=True)])


def _functions(group: Group, channel: str, left: Sequence[Array]) -> Iterator[list[Array]]:
    """Yield the columns of each function, as they are compared: of each recording n x columns."""
    of_recordings = [_quantities(recording, channel, rest)
                     for recording, rest in zip(group.recordings, left, strict=True)]
    known = set.intersection(*map(set, of_recordings))   # in each of them
    linear = [name for name in LINEAR if name in known]
    for name, times in OF_LOAD if channel == 'load' else OF_OUTPUT:
        if not {name, times} <= {*known, ''}:
            continue
        values = np.concatenate([each[name] for each in of_recordings])
        ends = float(values.min()), float(values.max())
        knots = np.linspace(*ends, SLOW_KNOTS) if name == 'time' else np.unique(
            [*np.linspace(*ends, KNOTS), *np.quantile(values, np.linspace(0.0, 1.0, KNOTS))])
        yield [np.column_stack([
            compared(recording, channel, column) for column in (
                *(np.interp(each[name], knots, hat) * each.get(times, 1.0)
                  for hat in np.eye(knots.size)),
                *(each[other] for other in linear))])
            for recording, each in zip(group.recordings, of_recordings, strict=True)]


def _quantities(recording: Recording, channel: str, left: Array) -> dict[str, Array]:
    """Return what a residual may be a function of, n samples each; left: the residual."""
    predicted = measured(recording, channel) - left
    if channel == 'load':
        motion = recording.moved
        found = {'velocity': motion.velocity[motion.inner], 'force': predicted,
                 'acceleration': motion.acceleration[motion.inner]}
        if motion.measured:
            found['position'] = motion.position[motion.inner]
    else:
        found = {'input': recording.input, 'output': predicted,
                 'velocity': np.gradient(predicted, recording.period_s)}
    speed = found['velocity']
    # Of a motion that stands, noise would tell it.
    way = speed / (np.abs(speed) + STANDS * math.sqrt(float(np.mean(speed ** 2))) + 1e-300)
    return {**found, 'way': way, 'time': recording.time_s}
