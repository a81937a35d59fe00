"""A ripple of what a model leaves: teeth, poles or ribs that the position passes."""

from typing import NamedTuple

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.gap.model.group import Group
from asi_analysis.gap.model.predict import unexplained

BINS = 4096          # of the position's range
FEWEST, MOST = 2, 256   # periods in that range
PER_PERIOD = 4       # spatial frequencies tried in the width of a line


class Ripple(NamedTuple):
    """A sine of the position: its period (m, or rad) and the share of the power that it is."""

    period: float
    share: float


def ripple(group: Group, channel: str, p: np.void) -> Ripple | None:
    """
    Return the sine of the position that explains most of a channel's residual.

    Of any phase in each recording, as the origins of their positions may differ. None if the
    position was not measured. p: record of the model.
    """
    waves, spans = np.arange(FEWEST, MOST, 1.0 / PER_PERIOD), []
    explained, whole = np.zeros(waves.size), 0.0
    courses = []
    for recording in group.recordings:
        motion = recording.motion
        if motion is None or not motion.measured:
            return None
        position = motion.position[motion.inner][recording.valid]
        courses.append((position, unexplained(recording, channel, p)[recording.valid]))
        spans.append(float(np.ptp(position)))
    span = max(spans)
    if span == 0.0:
        return None
    for position, rest in courses:
        explained += _explained((position - position.min()) / span, rest - rest.mean(), waves)
        whole += float(rest @ rest)
    most = int(np.argmax(explained))
    return Ripple(span / float(waves[most]), float(explained[most]) / max(whole, 1e-300))


def _explained(place: Array, rest: Array, waves: Array) -> Array:
    """Return the power that a sine of each number of waves explains; place: from 0 to 1."""
    cell = np.minimum((place * BINS).astype(int), BINS - 1)
    count, total = np.bincount(cell, minlength=BINS), np.bincount(cell, rest, BINS)
    filled = count > 0
    centre, count, total = (np.arange(BINS) + 0.5)[filled] / BINS, count[filled], total[filled]
    power = np.empty(waves.size)
    for number, wave in enumerate(waves):
        shapes = np.array([np.ones(centre.size), np.cos(2.0 * np.pi * wave * centre),
                           np.sin(2.0 * np.pi * wave * centre)])
        push = shapes @ total
        power[number] = push @ np.linalg.lstsq((shapes * count) @ shapes.T, push)[0]
    return power
