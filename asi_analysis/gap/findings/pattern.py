"""
What a hypothesis leaves, if it is a function of recorded quantities: the model lacks something.

Residual analysis (Ljung, System Identification, 2nd ed., 16.6): no function of what was recorded
predicts what the right model leaves. It is fitted on one part of the data, judged on the others.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from asi_analysis.arrays import Array, Mask
from asi_analysis.gap.inference.beyond_tolerance import LEAST_PROBABILITY
from asi_analysis.gap.inference.hypotheses import NOISE_UNCERTAINTY, Weighed
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
KNOTS: Final = 10        # of a function: so many at equal distances, and so many quantiles
SLOW_KNOTS: Final = 4    # of a function of time
RIDGE: Final = 1e-3      # weight of its values, in mean squares of its columns
STANDS: Final = 0.05     # of the rms speed: below, the direction of a motion is not told
# The functions: of the first quantity, times the second.
OF_LOAD: Final = (('position', ''), ('velocity', ''), ('force', ''), ('position', 'way'),
                  ('position', 'velocity'), ('position', 'acceleration'), ('time', 'velocity'),
                  ('time', 'force'))
OF_OUTPUT: Final = (('input', ''), ('output', ''), ('velocity', ''), ('output', 'way'),
                    ('output', 'velocity'), ('time', 'input'), ('time', 'velocity'))
# Beside each of them, the linear terms of the nominal model.
LINEAR: Final = ('acceleration', 'velocity', 'position', 'input')


def with_pattern(weighed: Weighed) -> Weighed:
    """
    Return a group in which a hypothesis that leaves a pattern lacks something unknown.

    If that pattern explains more without the effects than they do, they are not needed beside it.
    """
    group, chance = weighed.group, dict(weighed.probability)
    nominal = weighed.candidates[()].fitted
    without = {channel: (1.0 - patterned(group, channel, nominal.record)) * left
               for channel, left in nominal.held_out.items()}
    for names, candidate in weighed.candidates.items():
        beside = tuple(sorted((*names, UNKNOWN)))
        if chance.get(names, 0.0) + chance.get(beside, 0.0) < LEAST_PROBABILITY:
            continue
        lacks = as_probability(max(_odds(weighed, names, channel) for channel in group.channels))
        if names and all(without[channel] < left
                         for channel, left in candidate.fitted.held_out.items()):
            chance = with_moved(chance, beside, (UNKNOWN,), lacks)
            beside = (UNKNOWN,)
        chance = with_moved(chance, names, beside, lacks)
    return weighed._replace(probability=chance)


def _odds(weighed: Weighed, names: Names, channel: str) -> float:
    """Return the log odds that what a hypothesis leaves of a channel is more than it should."""
    group, fitted = weighed.group, weighed.candidates[names].fitted
    found = patterned(group, channel, fitted.record) * fitted.held_out[channel]
    explained = weighed.candidates[()].fitted.held_out[channel] - fitted.held_out[channel]
    formulation = max((CONSTANTS.exact if has_one_law(name) else CONSTANTS.formulation
                       for name in names), default=0.0)
    noise = group.noise[channel] ** 2
    expected = (formulation ** 2 * max(explained, 0.0) + NOISE_UNCERTAINTY * noise
                + OF_ERROR * (group.error_floor[channel] - noise))
    return SLOPE * math.log(max(found, 1e-300) / (EVEN * max(expected, 1e-300)))


def patterned(group: Group, channel: str, p: np.void) -> float:
    """
    Return the share of what a model leaves that a function of recorded quantities predicts.

    Of the mean square on the parts that were not fitted; of the functions, that which predicts
    most. 0 of what is only noise.
    """
    left = [unexplained(recording, channel, p) for recording in group.recordings]
    fit = [recording.fit for recording in group.recordings]
    others = [recording.held_out | recording.report for recording in group.recordings]
    known, target = _rows(left, fit), _rows(left, others)
    most = 0.0
    for columns in _functions(group, channel, left):
        size = np.sqrt(np.mean(_rows(columns, fit) ** 2, axis=0)) + 1e-300
        before, after = (_rows(columns, part) / size for part in (fit, others))
        square = before.T @ before + RIDGE * len(before) * np.eye(size.size)
        error = target - after @ np.linalg.solve(square, before.T @ known)
        most = max(most, 1.0 - float(error @ error) / max(float(target @ target), 1e-300))
    return most


def _rows(values: Sequence[Array], parts: Sequence[Mask]) -> Array:
    """Return the rows of all recordings that belong to a part of the data."""
    return np.concatenate([each[part] for each, part in zip(values, parts, strict=True)])


def _functions(group: Group, channel: str, left: Sequence[Array]) -> Iterator[list[Array]]:
    """Yield the columns of each function, as they are compared: of each recording n x columns."""
    of_recordings = [_quantities(recording, channel, rest)
                     for recording, rest in zip(group.recordings, left, strict=True)]
    for name, times in OF_LOAD if channel == 'load' else OF_OUTPUT:
        if not all({name, times} <= {*each, ''} for each in of_recordings):
            continue
        values = np.concatenate([each[name] for each in of_recordings])
        ends = float(values.min()), float(values.max())
        knots = np.linspace(*ends, SLOW_KNOTS) if name == 'time' else np.unique(
            [*np.linspace(*ends, KNOTS), *np.quantile(values, np.linspace(0.0, 1.0, KNOTS))])
        yield [np.column_stack([
            compared(recording, channel, column) for column in (
                *(np.interp(each[name], knots, hat) * each.get(times, 1.0)
                  for hat in np.eye(knots.size)),
                *(each[other] for other in LINEAR if other in each))])
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
    way = speed / (np.abs(speed) + STANDS * float(np.std(speed)) + 1e-300)
    return {**found, 'way': way, 'time': recording.time_s}
