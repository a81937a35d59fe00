"""
Noise that is not white, as a residual shows it.

`sampling.noise_of` takes the noise of a signal for white. Noise that has passed a filter of a
sensor is stronger at low frequencies than that estimate, and would count as a gap.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq, minimize_scalar
from scipy.signal.windows import tukey

from asi_analysis.arrays import Array, Complex
from asi_analysis.gap.model.effects import MOTIONS
from asi_analysis.gap.model.group import Group
from asi_analysis.gap.model.predict import judged_error, measured, predict
from asi_analysis.gap.prepare import Recording
from asi_analysis.gap.sampling import noise_spectrum

# Of the power of coloured noise, which no effect may be named for: its spectrum in the band of the
# excitation is extrapolated.
UNSURE = 0.1
LOUDER = 1.2   # times the estimated power: less is its uncertainty
# Standard deviations by which what is tested of noise hardly ever differs from its mean; of the
# cumulative periodogram, but for the first and the last EDGE frequencies.
HARDLY_EVER, EDGE = 4.5, 10
# Noise is sought above these shares of the band; the first with nothing but noise counts.
LOWEST = (0.0, 1.0 / 16.0, 1.0 / 8.0, 1.0 / 4.0)
STRONGEST = 0.99   # correlation from sample to sample
TAPERED = 0.1   # of the samples, at both ends together
LAGS = 32   # samples of the command before, which noise does not follow
MOST = 2 ** 16   # samples of a recording that are used, for the sake of memory
NOT_WHITE = ('the noise of the {} is not white: its correlation from sample to sample is {:.2f}. '
             'Its level is that of what the model leaves')
# The recorded signal of a channel, with its noise alone.
SIGNALS = {'valve': 'valve_position', 'force': 'force', 'velocity': 'velocity',
           'position': 'position'}


class Noise(NamedTuple):
    """First-order autoregressive noise: its correlation from sample to sample, and variance."""

    correlation: float
    variance: float


class _Samples(NamedTuple):
    """n samples of a residual, those that follow them, and LAGS commands before each (n, LAGS)."""

    before: Array
    after: Array
    commands: Array


def noise_of_residual(before: Array, after: Array, commands: Array) -> Noise | None:
    """
    Return the noise that a residual holds above some frequency, or None if that is not noise.

    before, after: n samples of it, and those that follow them; commands: the commands before each,
    (n, m). Above that frequency the residual is noise if it is first-order autoregressive: without
    what follows from the sample before, it is

    - white, by its cumulative periodogram (Box, Jenkins, Reinsel, Time Series Analysis, 4th ed.,
      8.2.5), each frequency by its own standard deviation (Anderson and Darling 1952);
    - normal, by its fourth moment: a force that jumps now and then has the spectrum of noise;
    - independent of the commands before (Ljung, System Identification, 2nd ed., 16.6).

    Below, what a model fails to explain is added to the noise.
    """
    if before.size < 16 * EDGE or not np.ptp(before):
        return None
    count, taper = before.size, tukey(before.size, TAPERED)   # else the ends leak upwards
    signals = np.column_stack([before, after, commands])
    spectra = np.fft.rfft(taper[:, None] * (signals - signals.mean(axis=0)), axis=0).T
    turns = np.fft.rfftfreq(count)
    for low in LOWEST:
        band = turns > 0.5 * low
        correlation, least = _correlation(spectra[:2, band], turns[band])
        fresh = spectra[1] - correlation * spectra[0]
        power = np.abs(fresh[band]) ** 2
        signal, *drives = np.fft.irfft(np.where(band, [fresh, *spectra[2:]], 0.0), count)
        if (_is_white(power) and _is_normal(signal[taper == 1.0])
                and not _follows(signal, np.array(drives).T, band.mean())):
            if low > 0.0:   # the power below grows fast with the correlation
                correlation = least
            power = np.abs(spectra[1] - correlation * spectra[0])[band] ** 2
            return Noise(correlation, float(power.mean() / np.sum(taper ** 2)
                                            / (1.0 - correlation ** 2)))
    return None


def _correlation(spectra: Complex, turns: Array) -> tuple[float, float]:
    """
    Return the most likely correlation of noise with a spectrum (Whittle 1953), and a lower bound.

    spectra: of the samples and of those that follow them, (2, m); turns: cycles per sample, m.
    """
    lag = np.exp(-2j * np.pi * turns)

    def unlikely(correlation: float) -> float:
        power = np.abs(spectra[1] - correlation * spectra[0]) ** 2
        return float(turns.size * np.log(power.sum() + 1e-300)
                     - 2.0 * np.log(np.abs(1.0 - correlation * lag)).sum())

    best = minimize_scalar(unlikely, bounds=(-STRONGEST, STRONGEST), method='bounded')
    most = best.fun + 0.5 * HARDLY_EVER ** 2
    if best.x <= 0.0 or unlikely(0.0) < most:
        return float(best.x), min(float(best.x), 0.0)
    return float(best.x), float(brentq(lambda each: unlikely(each) - most, 0.0, best.x))


def _is_white(power: Array) -> bool:
    """Return whether a periodogram is that of white noise."""
    share, white = np.cumsum(power) / power.sum(), np.arange(1, power.size + 1) / power.size
    off = (share - white) / np.sqrt(np.maximum(white * (1.0 - white), 1e-9) / power.size)
    return bool(np.abs(off[EDGE:-EDGE]).max() < HARDLY_EVER)


def _is_normal(signal: Array) -> bool:
    """Return whether a signal has the fourth moment of a normal distribution."""
    tails = float(np.mean(signal ** 4) / np.mean(signal ** 2) ** 2) - 3.0
    return abs(tails) < HARDLY_EVER * math.sqrt(24.0 / signal.size)


def _follows(signal: Array, commands: Array, share: float) -> bool:
    """Return whether a signal, with this share of its band, depends on the commands before."""
    weights, _, rank, _ = np.linalg.lstsq(commands, signal, rcond=1e-6)
    explained = float(np.mean((commands @ weights) ** 2) / np.mean(signal ** 2))
    return bool(explained * share * signal.size > rank + HARDLY_EVER * math.sqrt(2.0 * rank))


def with_coloured_noise(group: Group, p: np.void) -> Group:
    """
    Return a group with the noise that a hypothesis leaves, where that is more than was estimated.

    p: the fitted record of the hypothesis.
    """
    noise, floor, recordings = dict(group.noise), dict(group.error_floor), list(group.recordings)
    for channel in SIGNALS.keys() & {*group.channels}:
        left = _mean_square(group, channel, p)
        if left <= LOUDER * floor[channel]:
            continue
        found = noise_of_residual(*_samples(group.recordings, channel, p))
        if found is None:
            continue
        level = min(left, found.variance * _share_in_band(group, channel, found.correlation))
        if level <= LOUDER * floor[channel]:
            continue
        noise[channel] = math.sqrt(noise[channel] ** 2 + (1.0 - UNSURE) * (level - floor[channel]))
        floor[channel] = level
        name = SIGNALS[channel]
        recordings = [replace(r, noise=r.noise | {name: math.sqrt(found.variance)}, cache={},
                              colour=r.colour | {name: found.correlation}) for r in recordings]
    if floor == group.error_floor:
        return group
    return replace(group, noise=noise, error_floor=floor, recordings=recordings)


def _mean_square(group: Group, channel: str, p: np.void) -> float:
    """Return the mean square that a hypothesis leaves of a channel, as of its whole band."""
    left = np.concatenate([judged_error(r, channel, p)[r.known] for r in group.recordings])
    return float(np.mean(left ** 2)) / group.judged_share.get(channel, 1.0)


def _share_in_band(group: Group, channel: str, correlation: float) -> float:
    """Return the power of noise in the band of a channel, over that of white noise."""
    if channel not in group.judged_share:
        return 1.0
    passed = [float(np.mean(r.motion.judge ** 2 * noise_spectrum(
        r.motion.omega * r.period_s / (2.0 * np.pi), correlation)))
        for r in group.recordings if r.motion and channel in MOTIONS]
    return float(np.mean(passed or [1.0])) / group.judged_share[channel]


def _samples(recordings: Sequence[Recording], channel: str, p: np.void) -> _Samples:
    """Return the residual of a channel, where it was recorded with LAGS commands before."""
    parts: list[_Samples] = []
    for r in recordings:
        error = measured(r, channel) - predict(r, channel, p)
        drive = r.command if r.command is not None else np.zeros_like(error)
        at = np.flatnonzero(r.valid[:-1] & r.valid[1:])   # noise is estimated from all samples
        at = at[at >= LAGS][:MOST]
        parts.append(_Samples(error[at], error[at + 1],
                              drive[at[:, None] - np.arange(LAGS)[None, :]]))
    return _Samples(*map(np.concatenate, zip(*parts, strict=True)))


def colours(group: Group) -> dict[str, float]:
    """Return the correlation from sample to sample of noise that was found, by channel."""
    return {channel: r.colour[name] for r in group.recordings
            for channel, name in SIGNALS.items()
            if channel in group.channels and name in r.colour}


def with_noise_of_valve(group: Group, valve: Group) -> Group:
    """Return a group whose recordings have the noise of the valve position that was found."""
    name = SIGNALS['valve']
    return replace(group, recordings=[
        replace(r, noise=r.noise | {name: found.noise[name]}, colour=found.colour, cache={})
        if name in found.colour else r
        for r, found in zip(group.recordings, valve.recordings, strict=True)])
