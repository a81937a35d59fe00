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
from numpy.lib.stride_tricks import sliding_window_view
from scipy.optimize import brentq, minimize_scalar
from scipy.signal.windows import tukey

from asi_analysis.arrays import Array, Complex, Mask
from asi_analysis.gap.model.group import Group
from asi_analysis.gap.model.predict import judged_error, measured, predict
from asi_analysis.gap.prepare import Recording
from asi_analysis.gap.sampling import gain_of_noise, noise_spectrum

UNSURE = 0.1   # share of the power of noise whose spectrum is extrapolated to low frequencies
LOUDER = 1.2   # times the estimated power: less is its uncertainty
# Standard deviations by which what is tested of noise hardly ever differs from its mean; of the
# cumulative periodogram, but for the first and the last EDGE frequencies.
HARDLY_EVER, EDGE = 4.5, 10
# What is left of noise after a sample, at most: a slower course may be a disturbance.
STRONGEST = 0.99
LAGS = 32   # commands before, of which noise is independent
EARLIER = slice(LAGS // 4, LAGS // 4 + 1)   # the sample before, for the change of a signal
ORDERS = (1, 2, 4, 8, 16, LAGS)   # of autoregressions, one after the other
# White noise of this share of the residual (power) is added: what is weaker is not tested. What a
# filter of a sensor leaves far above its band would take an endless autoregression.
DITHER = 0.1
# If a residual is not noise alone, noise is sought above these shares of the band.
LOWEST = (1.0 / 16.0, 1.0 / 8.0, 1.0 / 4.0)
TAPERED = 0.1   # of the samples, at both ends together
COMMON = 0.3   # of the strongest course (principal component) of the commands before: others count
SMALL = 0.1    # of the largest value of a signal: below, its sign may be that of its noise
# Samples that are used: fewer hold too little, more of a recording take too much memory.
SHORTEST, MOST = 16 * EDGE, 2 ** 16
NOT_WHITE = ('the noise of the {} is not white: its level and spectrum are those of what the '
             'model leaves')
# The recorded signal of a channel, with its noise alone.
SIGNALS = {'valve': 'valve_position', 'force': 'force', 'velocity': 'velocity',
           'position': 'position'}


class Noise(NamedTuple):
    """
    Autoregressive noise: its coefficients, that of the sample before first, and variance.

    With DITHER, if it was found in the whole band. unsure: the share of its power that no effect
    may be named for.
    """

    colour: tuple[float, ...]
    variance: float
    unsure: float = 0.0


class Residual(NamedTuple):
    """What a model leaves of a signal, command and velocity of that time, where valid; n each."""

    error: Array
    command: Array
    velocity: Array
    valid: Mask


def noise_of_residual(residuals: Sequence[Residual]) -> Noise | None:
    """
    Return the noise that the residuals of recordings hold, or None if that is not noise.

    It is noise if it is autoregressive: without what follows from the samples before, it is

    - white, by its cumulative periodogram (Box, Jenkins, Reinsel, Time Series Analysis, 4th ed.,
      8.2.5), each frequency by its own standard deviation (Anderson and Darling 1952), which has
      neither lines, as of a periodic signal, nor is smooth, as of a chirp;
    - normal, by its fourth moment, as is the residual itself: a force that jumps now and then has
      the spectrum of noise, and what follows each jump that of coloured noise;
    - independent of the commands before (Ljung, System Identification, 2nd ed., 16.6), and as
      strong whatever command and velocity do.

    Nor does it resemble the command or the velocity.

    If it is not, noise of first order is sought above some frequency. Below, what a model fails to
    explain is added to the noise.
    """
    return _of_any_order(residuals) or _above_some_frequency(residuals)


def _of_any_order(residuals: Sequence[Residual]) -> Noise | None:
    """Return the noise that residuals are."""
    random = np.random.default_rng(733_103)   # not that of a simulator, whose seeds are small
    errors, commands, velocities = _before(LAGS, residuals)
    if len(errors) < SHORTEST or not np.ptp(errors):
        return None
    variance = errors[:, 0].var()
    errors = _before(LAGS, [each._replace(
        error=each.error + math.sqrt(DITHER * variance)
        * random.standard_normal(each.error.size)) for each in residuals])[0]
    powers = errors.T @ errors / len(errors)
    for order in ORDERS:
        colour = tuple(np.linalg.solve(powers[1:order + 1, 1:order + 1],
                                       powers[0, 1:order + 1]).tolist())
        fresh = errors[:, 0] - errors[:, 1:order + 1] @ np.array(colour)
        lasting = np.abs(np.roots([1.0, *(-each for each in colour)])).max() > STRONGEST
        if (not lasting and is_white(np.abs(np.fft.rfft(fresh)[1:]) ** 2)
                and _is_normal(fresh) and _is_normal(errors[:, 0], colour)
                and not _follows(fresh, commands[:, 1:])
                and not _varies(fresh, commands, velocities)
                and not _resembles(errors[:, 0], _causes(commands, velocities),
                                   fresh.var() * gain_of_noise(colour), colour)):
            return Noise(colour, float(variance))
    return None


def _above_some_frequency(residuals: Sequence[Residual]) -> Noise | None:
    """Return the noise of first order that residuals hold above some frequency."""
    errors, commands, _ = _before(1, residuals)
    count, taper = len(errors), tukey(len(errors), TAPERED)   # else the ends leak upwards
    if count < SHORTEST or not np.ptp(errors):
        return None
    signals = np.column_stack([errors[:, 1], errors[:, 0], commands[:, 1:]])
    spectra = np.fft.rfft(taper[:, None] * signals, axis=0).T
    turns = np.fft.rfftfreq(count)
    for low in LOWEST:
        band = turns > 0.5 * low
        most_likely, least = _correlation(spectra[:2, band], turns[band])
        fresh = spectra[1] - most_likely * spectra[0]
        signal, *drives = np.fft.irfft(np.where(band, [fresh, *spectra[2:]], 0.0), count)
        if (is_white(np.abs(fresh[band]) ** 2) and _is_normal(signal[taper == 1.0])
                and not _follows(signal, np.array(drives).T, band.mean())):
            # With the lower bound, as the power below the band grows fast with the correlation.
            power = np.abs(spectra[1] - least * spectra[0])[band] ** 2
            return Noise((least,), float(power.mean() / np.sum(taper ** 2) / (1.0 - least ** 2)),
                         UNSURE)
    return None


def _before(lags: int, residuals: Sequence[Residual]) -> tuple[Array, Array, Array]:
    """
    Return errors with those before, (n, 1 + lags), commands and velocities, (n, 1 + LAGS).

    At all samples that are valid, as are those before; without means.
    """
    rows = [[np.empty((0, lags + 1)), np.empty((0, LAGS + 1)), np.empty((0, LAGS + 1))]]
    for error, command, velocity, valid in residuals:
        count = error.size - LAGS
        if count > 0:
            known = sliding_window_view(valid[-count - lags:], lags + 1).all(axis=1)
            at = np.flatnonzero(known)[:MOST]
            windows = (sliding_window_view(signal[-count - before:], before + 1) for signal, before
                       in ((error, lags), (command, LAGS), (velocity, LAGS)))
            rows.append([np.array(each[at, ::-1]) for each in windows])
    joined = [np.concatenate(each) for each in zip(*rows, strict=True)]
    errors, commands, velocities = (each - each.sum() / max(each.size, 1) for each in joined)
    return errors, commands, velocities


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


def is_white(power: Array) -> bool:
    """Return whether a periodogram is that of white noise."""
    count, total = np.arange(1, power.size + 1), np.cumsum(power)
    white = count / power.size
    off = (total / total[-1] - white) / np.sqrt(np.maximum(white * (1.0 - white), 1e-9))
    # The mean amplitude over the rms of normal noise; of lines it is small, of a smooth course 1.
    uneven = (np.cumsum(np.sqrt(power)) / np.sqrt(total * count) - 0.5 * math.sqrt(math.pi)
              ) * np.sqrt(count / (1.0 - 5.0 * math.pi / 16.0))
    return bool(np.abs(off[EDGE:-EDGE]).max() * math.sqrt(power.size) < HARDLY_EVER
                and np.abs(uneven[EDGE:]).max() < HARDLY_EVER)


def _is_normal(signal: Array, colour: tuple[float, ...] = ()) -> bool:
    """
    Return whether noise of this colour has the fourth moment of a normal distribution.

    By its variance for a linear process (Lomnicki, Metrika 4, 1961).
    """
    correlation = np.fft.ifft(noise_spectrum(np.fft.fftfreq(signal.size), colour)).real
    spread = 24.0 / signal.size * float(np.sum((correlation / correlation[0]) ** 4))
    tails = float(np.mean(signal ** 4) / np.mean(signal ** 2) ** 2) - 3.0
    return abs(tails) < HARDLY_EVER * math.sqrt(spread)


def _follows(signal: Array, commands: Array, share: float = 1.0) -> bool:
    """Return whether a signal, with this share of its band, depends on the commands before."""
    weights, _, rank, _ = np.linalg.lstsq(commands, signal, rcond=1e-6)
    explained = float(np.mean((commands @ weights) ** 2) / np.mean(signal ** 2))
    return bool(explained * share * signal.size > rank + HARDLY_EVER * math.sqrt(2.0 * rank))


def _varies(fresh: Array, commands: Array, velocities: Array) -> bool:
    """Return whether a signal is stronger at some values or changes of command and velocity."""
    power = fresh ** 2 - np.mean(fresh ** 2)
    causes = np.hstack([size ** exponent for each in (commands, velocities)
                        for size in np.abs([each[:, :1], each[:, :1] - each[:, EARLIER]])
                        for exponent in (1, 2)])
    causes -= causes.mean(axis=0)
    chance = HARDLY_EVER * power.std() * np.sqrt(np.sum(causes ** 2, axis=0))
    return bool(np.any(np.abs(causes.T @ power) > chance))


def _causes(commands: Array, velocities: Array) -> Array:
    """Return what a residual that is no noise may resemble: (n, m), without means."""
    course, strength, _ = np.linalg.svd(commands, full_matrices=False)
    causes = [course[:, strength > COMMON * strength[0]]]
    for now, before in ((each[:, :1], each[:, EARLIER]) for each in (commands, velocities)):
        causes += [now, now ** 2, now * np.abs(now), _sign(now), _sign(now - before)]
    joined = np.hstack(causes)
    return joined - joined.mean(axis=0)


def _sign(signal: Array) -> Array:
    """Return the sign of a signal, without that of its noise about zero."""
    return np.clip(signal / (SMALL * np.abs(signal).max() + 1e-300), -1.0, 1.0)


def _resembles(signal: Array, causes: Array, variance: float, colour: tuple[float, ...]) -> bool:
    """
    Return whether noise of this variance and colour hardly ever resembles a cause so much.

    A periodic residual follows from its own past, but it resembles the command that is its cause,
    or what a law with a kink or a threshold makes of that or of the velocity.
    """
    twice = 2 * len(signal)   # without a period
    spectra = np.abs(np.fft.fft(causes, twice, axis=0)) ** 2
    power = variance * noise_spectrum(np.fft.fftfreq(twice), colour) @ spectra / twice
    return bool(np.any((causes.T @ signal) ** 2 > HARDLY_EVER ** 2 * power))


def with_coloured_noise(group: Group, p: np.void) -> Group:
    """
    Return a group with the noise that a hypothesis leaves, where that is more than was estimated.

    Or less, if what a worse hypothesis left was counted. p: the fitted record of the hypothesis.
    """
    noise, floor, recordings = dict(group.noise), dict(group.error_floor), list(group.recordings)
    only_noise = not (group.other_formulation or group.floor_measured)   # is in the error floor
    for channel in SIGNALS.keys() & {*group.channels}:
        name, left, before = SIGNALS[channel], _mean_square(group, channel, p), floor[channel]
        known = 0.0
        if name in recordings[0].colour and only_noise:
            known = recordings[0].noise[name] ** 2
            if left < before:
                floor[channel] = left
                noise[channel] *= math.sqrt(left / before)
        if left <= LOUDER * before and not known:
            continue
        # Of noise that is known, a worse hypothesis may have shown only what is above some
        # frequency.
        found = noise_of_residual([_residual(r, channel, p) for r in group.recordings])
        if found is None or (found.unsure and found.variance <= LOUDER * known):
            continue
        louder = [replace(r, noise=r.noise | {name: math.sqrt(found.variance)}, cache={},
                          colour=r.colour | {name: found.colour}) for r in recordings]
        level = min(_mean_square(replace(group, recordings=louder), channel, p),
                    max(found.variance, before))
        model_error = 0.0 if known else before - noise[channel] ** 2
        noise[channel] = math.sqrt(max((1.0 - found.unsure) * level - model_error,
                                       noise[channel] ** 2 * min(level / before, 1.0)))
        floor[channel], recordings = level, louder
    if (noise, floor) == (group.noise, group.error_floor):
        return group
    return replace(group, noise=noise, error_floor=floor, recordings=recordings)


def _mean_square(group: Group, channel: str, p: np.void) -> float:
    """Return the mean square that a hypothesis leaves of a channel, as of its whole band."""
    left = np.concatenate([judged_error(r, channel, p)[r.known] for r in group.recordings])
    return float(np.mean(left ** 2)) / group.judged_share.get(channel, 1.0)


def _residual(recording: Recording, channel: str, p: np.void) -> Residual:
    """Return the residual of a channel at all samples, as its noise is estimated from all."""
    error = measured(recording, channel) - predict(recording, channel, p)
    none = np.zeros_like(error)
    command, velocity = (none if each is None else each
                         for each in (recording.command, recording.velocity))
    return Residual(error, command, velocity, recording.valid)


def coloured(group: Group) -> list[str]:
    """Return the channels whose noise was sought in what a model leaves; it may be white."""
    return [channel for channel in group.channels
            if any(SIGNALS.get(channel) in r.colour for r in group.recordings)]


def not_white(group: Group) -> list[str]:
    """Return the channels whose noise is much stronger than the white noise that drives it."""
    return [channel for channel in coloured(group) if any(
        gain_of_noise(r.colour.get(SIGNALS[channel], ())) > LOUDER for r in group.recordings)]


def with_noise_of_valve(group: Group, valve: Group) -> Group:
    """Return a group whose recordings have the noise of the valve position that was found."""
    name = SIGNALS['valve']
    return replace(group, recordings=[
        replace(r, noise=r.noise | {name: found.noise[name]}, colour=found.colour, cache={})
        if name in found.colour else r
        for r, found in zip(group.recordings, valve.recordings, strict=True)])
