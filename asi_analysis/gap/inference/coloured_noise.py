"""
Noise that is not white, as a residual shows it.

`sampling.noise_of` takes the noise of a signal for white. Noise that has passed a filter of a
sensor is stronger at low frequencies than that estimate, and would count as a gap.
"""

import math
from dataclasses import replace

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.gap.model.group import Group
from asi_analysis.gap.model.predict import judged_error, measured, predict

# Of the power of coloured noise, which no effect may be named for: its spectrum below the band of
# the excitation is extrapolated.
UNSURE = 0.1
# Standard deviations by which the cumulative periodogram of white noise (but for the first and the
# last EDGE frequencies) and its fourth moment hardly ever differ from their means.
HARDLY_EVER, EDGE = 4.5, 10
# The recorded signal of a channel, with its noise alone.
SIGNALS = {'valve': 'valve_position', 'force': 'force', 'velocity': 'velocity',
           'position': 'position'}


def correlation_of(before: Array, after: Array) -> float | None:
    """
    Return the correlation from sample to sample of a residual that is noise; else None.

    before, after: n samples of it, and those that follow them. It is noise if it is first-order
    autoregressive: without what follows from the sample before, it is white and normal. White by
    its cumulative periodogram (Box, Jenkins, Reinsel, Time Series Analysis, 4th ed., 8.2.5), each
    frequency by its own standard deviation (Anderson and Darling 1952), since what a model fails
    to explain lies in the band of the excitation; normal by its fourth moment, since a force that
    jumps now and then has the spectrum of such noise.
    """
    before, after = before - before.mean(), after - after.mean()
    power = float(before @ before)
    if power == 0.0 or before.size < 8 * EDGE:
        return None
    correlation = float(after @ before) / power
    fresh = after - correlation * before
    tails = np.mean(fresh ** 4) / np.mean(fresh ** 2) ** 2 - 3.0
    periodogram = np.abs(np.fft.rfft(fresh)[1:]) ** 2
    share = np.cumsum(periodogram) / periodogram.sum()
    white = np.arange(1, share.size + 1) / share.size
    off = (share - white)[EDGE:-EDGE] / np.sqrt((white * (1.0 - white))[EDGE:-EDGE] / share.size)
    noise = max(np.abs(off).max(), abs(tails) / math.sqrt(24.0 / fresh.size)) < HARDLY_EVER
    return correlation if noise else None


def with_coloured_noise(group: Group, p: np.void) -> Group:
    """
    Return a group whose noise is what a hypothesis leaves, where that is noise, but more.

    p: the fitted record of the hypothesis.
    """
    noise, floor, recordings = dict(group.noise), dict(group.error_floor), list(group.recordings)
    for channel in SIGNALS.keys() & {*group.channels}:
        level = float(np.mean(np.concatenate(
            [judged_error(r, channel, p)[r.known] for r in group.recordings]) ** 2)
            / group.judged_share.get(channel, 1.0))
        if level <= floor[channel]:
            continue
        error = [measured(r, channel) - predict(r, channel, p) for r in group.recordings]
        pairs = [r.known[:-1] & r.known[1:] for r in group.recordings]
        before, after = (np.concatenate([each[part][both] for each, both in zip(
            error, pairs, strict=True)]) for part in (slice(-1), slice(1, None)))
        correlation = correlation_of(before, after)
        if correlation is None:
            continue
        noise[channel] = math.sqrt(noise[channel] ** 2 + (1.0 - UNSURE) * (level - floor[channel]))
        floor[channel] = level
        name = SIGNALS[channel]
        recordings = [replace(r, noise=r.noise | {name: float(np.std(before))}, cache={},
                              colour=r.colour | {name: correlation}) for r in recordings]
    if floor == group.error_floor:
        return group
    return replace(group, noise=noise, error_floor=floor, recordings=recordings)


def has_coloured_noise(group: Group) -> bool:
    """Return whether noise that is not white was found in a group's recordings."""
    return any(r.colour for r in group.recordings)


def with_noise_of_valve(group: Group, valve: Group) -> Group:
    """Return a group whose recordings have the noise of the valve position that was found."""
    name = SIGNALS['valve']
    return replace(group, recordings=[
        replace(r, noise=r.noise | {name: found.noise[name]}, colour=found.colour, cache={})
        if name in found.colour else r
        for r, found in zip(group.recordings, valve.recordings, strict=True)])
