"""
The edges of a pulse that lie within a validation part of the data.

No fitted sample determines them. They are located with the validation samples after the
probabilities are computed, and a note says so.
"""

from dataclasses import replace
from typing import Final

import numpy as np
from scipy.optimize import minimize_scalar

from asi_analysis.gap.inference.fit import Fitted
from asi_analysis.gap.inference.hypotheses import Weighed
from asi_analysis.gap.model.effects import Free
from asi_analysis.gap.model.predict import measured, predict
from asi_analysis.gap.prepare import Recording

LEAST_PROBABILITY: Final = 0.05   # of a hypothesis whose pulses are located
LEAST_S: Final = 0.1              # shortest stretch without fitted samples
PLACED: Final = ('the disturbance begins or ends in samples that are kept for the report, and was '
                 'placed by them')


def placed(weighed: Weighed) -> Weighed:
    """
    Return a group in which the pulses of likely hypotheses are located with all samples.

    The same object if none of them moves.
    """
    likely = {name for names, chance in weighed.probability.items()
              if chance > LEAST_PROBABILITY for name in names}
    moved = {names: candidate._replace(fitted=fitted)
             for names, candidate in weighed.candidates.items() if likely.issuperset(names)
             and (fitted := _placed(candidate.fitted)) is not candidate.fitted}
    return weighed._replace(candidates={**weighed.candidates, **moved}) if moved else weighed


def _placed(fitted: Fitted) -> Fitted:
    """Return a fit whose pulses are located with all samples."""
    for free in fitted.free:
        field, _, number = free.field.partition('@')
        if field.endswith(('_start', '_end')) and free.scale.startswith('residual_'):
            recording = next(r for r in fitted.problem.group.recordings
                             if r.fit.any() and r.number == int(number or 1) - 1)
            fitted = _at_edge(fitted, free, recording)
    return fitted


def _at_edge(fitted: Fitted, free: Free, recording: Recording) -> Fitted:
    """Return a fit in which an edge of a pulse in one recording is located with all samples."""
    group, value = fitted.problem.group, float(fitted.record[free.field])
    first, last = _unknown(recording, value)
    if last - first < LEAST_S:
        return fitted

    def cost(edge: float) -> float:
        p = fitted.record.copy()
        p[free.field] = edge
        return sum(float(np.sum((measured(recording, channel) - predict(recording, channel, p))[
            recording.valid] ** 2)) / group.error_floor[channel] for channel in group.channels)

    found = minimize_scalar(cost, bounds=(first, last), method='bounded',
                            options={'xatol': 0.5 * recording.period_s})
    if cost(value) <= found.fun:
        return fitted
    record, theta = fitted.record.copy(), fitted.theta.copy()
    record[free.field] = found.x
    # The middle of its range, since its scale is the found value.
    theta[fitted.free.index(free)] = (1.0 - free.low) / (free.high - free.low)
    group = replace(group, scale=group.scale | {free.scale: float(found.x)})
    return fitted._replace(record=record, theta=theta,
                           problem=replace(fitted.problem, group=group))


def _unknown(recording: Recording, time: float) -> tuple[float, float]:
    """Return begin and end (s) of the stretch without fitted samples at or next to a time."""
    period, count = recording.period_s, recording.known.size
    near = np.clip(round(time / period) + np.arange(-2, 3), 0, count - 1)
    inside = near[~recording.known[near]]
    if not inside.size:
        return time, time
    known = np.flatnonzero(recording.known)
    before, after = known[known < inside[0]], known[known > inside[0]]
    return (period * (int(before[-1]) + 1 if before.size else 0),
            period * (int(after[0]) if after.size else count))
