"""How far the gap shrinks, on data that no fit has seen, with an interval."""

import math
from typing import NamedTuple

import numpy as np
from scipy.stats import t as student

from asi_analysis.gap.fit import Group, measured, predict
from asi_analysis.gap.prepare import PARTS, Array

# How much a fresh recording differs beyond what the parts of this one tell, set by hand on blind
# cases with seeds below 10 000: the interval is to cover the shrink on a fresh recording.
WIDENED, LEAST = 1.5, 0.01


class Shrink(NamedTuple):
    """
    The gap of one channel before and after, as a share of the signal's rms.

    nominal: the model as it was given; refitted: its uncertain parameters fitted; after: with the
    effects of the verdict. shrink = 1 - after / nominal, with a 95 % interval.
    """

    channel: str
    nominal: float
    refitted: float
    after: float
    noise_floor: float
    shrink: float
    low: float
    high: float


def parts_error(group: Group, channel: str, p: np.void) -> Array:
    """Return the mean square left in each held-out part of each recording."""
    errors = []
    for recording in group.recordings:
        left = (measured(recording, channel) - predict(recording, channel, p)) ** 2
        part = np.arange(left.size) * PARTS // left.size
        errors += [left[chosen].mean() for number in range(PARTS)
                   if (chosen := (part == number) & recording.held_out).any()]
    return np.array(errors)


def shrink_of(group: Group, channel: str, refitted: np.void, after: np.void) -> Shrink:
    """Return how far the gap of a channel shrinks."""
    square = np.concatenate([measured(r, channel)[r.held_out] ** 2 for r in group.recordings])
    size = math.sqrt(float(square.mean())) or 1.0
    errors = {name: parts_error(group, channel, p)
              for name, p in (('nominal', group.nominal), ('refitted', refitted),
                              ('after', after))}
    rms = {name: math.sqrt(float(error.mean())) for name, error in errors.items()}
    shrink = 1.0 - rms['after'] / rms['nominal'] if rms['nominal'] else 0.0
    half = LEAST + WIDENED * _jackknife(errors['nominal'], errors['after'])
    return Shrink(channel, rms['nominal'] / size, rms['refitted'] / size, rms['after'] / size,
                  group.noise[channel] / size, shrink, shrink - half, min(shrink + half, 1.0))


def _jackknife(nominal: Array, after: Array) -> float:
    """Return half the 95 % interval of the shrink, from leaving out one part at a time."""
    count = nominal.size
    if count < 2:
        return 1.0
    without = 1.0 - np.sqrt((after.sum() - after) / np.maximum(nominal.sum() - nominal, 1e-300))
    spread = math.sqrt((count - 1) / count * float(np.sum((without - without.mean()) ** 2)))
    return float(student.ppf(0.975, count - 1)) * spread
