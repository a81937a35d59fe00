"""Random numbers that depend on nothing but a seed and a number: a run can be repeated."""

import math
from typing import Final

import numpy as np

from asi_common.jit import jit

# What is random beside noise: seeds of its own, derived from the one that is given.
LOST: Final = np.uint64(0x2545F4914F6CDD1D)    # readings of the force sensor
LATE: Final = np.uint64(0x9FB21C651E98DF25)    # commands
STEP: Final = np.uint64(0x9E3779B97F4A7C15)


@jit
def _mix(number):
    """Return a well-mixed number (SplitMix64; Steele, Lea, Flood 2014)."""
    number = (number ^ (number >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    number = (number ^ (number >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return number ^ (number >> np.uint64(31))


@jit
def normal(seed, sample):
    """Return a standard normal number of a seed and a sample."""
    start = _mix(np.uint64(seed)) + np.uint64(2 * sample) * STEP
    first = _mix(start) >> np.uint64(11)
    second = _mix(start + STEP) >> np.uint64(11)
    # 53 random bits each, the first never 0; Box and Muller 1958.
    radius = math.sqrt(-2.0 * math.log((first + 1.0) / 9007199254740993.0))
    return radius * math.cos(2.0 * math.pi * second / 9007199254740992.0)


@jit
def uniform(seed, sample, what):
    """Return a number from 0 to below 1 of a seed and a sample; what: LOST or LATE."""
    start = _mix(np.uint64(seed) + what) + np.uint64(2 * sample + 1) * STEP
    return (_mix(start) >> np.uint64(11)) / 9007199254740992.0
