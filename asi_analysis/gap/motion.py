"""The motion of a load from its position and velocity, and the band in which it is compared."""

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np
from scipy.fft import next_fast_len
from scipy.ndimage import maximum_filter1d, minimum_filter1d
from scipy.signal import coherence, welch

from asi_analysis.arrays import Array, Complex, Mask
from asi_analysis.gap.sampling import SHARED

PAD_S = 0.6   # mirrored samples at both ends before a Fourier transform; their outer half fades
# The motion is low-pass filtered at this multiple of the compared band, or at the frequency where
# its power is this multiple of the noise, if that is higher: friction and backlash depend on all
# of the motion.
SMOOTHED_BAND, SIGNAL_TO_NOISE = 2.5, 4.0
# Noise is estimated at these multiples of a band's edge, with a spectrum that resolves an eighth
# of it; as a low quantile of the power there, since a load may ring.
NOISE_BAND, SEGMENTS, NOISE_QUANTILE = (1.5, 4.0), 8.0, 0.25
COHERENT = 0.95         # least coherence of motion and force in the compared band
LOWEST_BAND_HZ = 20.0
SPAN_HZ = 5.0           # one bin of a spectrum varies: those of this span count together
# An integrated velocity is high-pass filtered here. The filter rings at both ends for this time,
# at most this share of the recording.
LOWEST_INTEGRATED_HZ, RINGING_S, RINGING = 0.5, 1.0, 0.2
# A standstill lasts at least STANDS_S, in which a joint at SLOW times its usual speed would move
# by a step of its encoder. If they are more than MOST_STANDS of a recording, none is left out.
STANDS_S, SLOW, MOST_STANDS = 0.02, 0.1, 0.95
# Without an encoder: it stays within so many standard deviations of the noise for REST_S, or as
# long as a joint at SLOW times its usual speed takes for that, at most LONGEST_S. A shorter time
# would leave out the slow motion at each turn, from which a compliance is identified.
WITHIN, REST_S, LONGEST_S = 6.0, 0.1, 0.3
# A load halts if its speed is below HALTED standard deviations of its noise, and what smoothing
# makes of an acceleration that begins at once: LEAK times the usual change of speed in it.
HALTED, LEAK, FASTER = 4.0, 0.1, 8.0
LEAST_RATIO = 0.25      # of a velocity to the derivative of its position, or its inverse


@dataclass(frozen=True)
class Motion:
    """
    The measured motion of the piston, extended by PAD_S at both ends.

    spectra: of the whole extended length; smooth: gain of the low-pass filter that they passed;
    judge: gain of the band in which signals are compared; noise: of the velocity, at each
    frequency the variance of white noise with that spectral density.
    """

    omega: Array                 # rad/s
    position: Array              # m, smoothed
    velocity: Array              # m/s, smoothed
    acceleration: Array          # m/s2, of it
    position_spectrum: Complex
    velocity_spectrum: Complex
    smooth: Array
    judge: Array
    noise: Array                 # m2/s2
    pad: int                     # samples before the recording
    measured: bool               # false if the position was found by integration
    halts: Mask                  # samples in which the load halts for a moment, see `halts`

    @property
    def inner(self) -> slice:
        """Return the samples of the recording within those of the extended motion."""
        return slice(self.pad, -self.pad)

    def without_halts(self) -> 'Motion':
        """Return a motion of which the force is not that of its recording."""
        return replace(self, halts=np.zeros_like(self.halts))

    @property
    def edge_hz(self) -> float:
        """Return the upper end of the band in which signals are compared (-3 dB)."""
        inside = self.omega[self.judge > math.sqrt(0.5)]
        return float(inside.max(initial=self.omega[1])) / (2.0 * np.pi)


def extended(values: Array, pad: int, reflect_type: Literal['even', 'odd'] = 'odd') -> Array:
    """
    Return the values with `pad` mirrored ones at both ends, for a Fourier transform.

    odd: value and slope are continuous. The outer half of both ends fades to the same value,
    since a jump where they wrap round would ring in all derivatives.
    """
    longer = mirrored(values, pad, reflect_type)
    middle = 0.5 * (values[0] + values[-1])
    return np.asarray(middle + _fade(longer.size, pad // 2) * (longer - middle))


def mirrored(values: Array, pad: int, reflect_type: Literal['even', 'odd']) -> Array:
    """Return what np.pad does, which is slow, with 'reflect'."""
    if pad >= values.size or not pad:
        return np.pad(values, pad, 'reflect', reflect_type=reflect_type)
    before, after = values[pad:0:-1], values[-2:-pad - 2:-1]
    if reflect_type == 'odd':
        before, after = 2 * values[0] - before, 2 * values[-1] - after
    return np.concatenate([before, values, after])


@lru_cache(maxsize=16)
def _fade(size: int, outer: int) -> Array:
    """Return the weight of `size` samples, of which the `outer` ones at both ends fade."""
    fade = np.ones(size)
    fade[:outer] = 0.5 - 0.5 * np.cos(np.pi * np.arange(outer) / max(outer, 1))
    return fade * fade[::-1]


def first_of(motion: Motion, count: int, period: float) -> Motion:
    """Return the motion of the first samples of a recording; its filters are interpolated."""
    size = count + 2 * motion.pad
    omega = 2.0 * np.pi * np.fft.rfftfreq(size, period)
    position, velocity = motion.position[:size], motion.velocity[:size]
    smooth, judge, noise = (np.interp(omega, motion.omega, each)
                            for each in (motion.smooth, motion.judge, motion.noise))
    return Motion(omega, position, velocity, motion.acceleration[:size], np.fft.rfft(position),
                  np.fft.rfft(velocity), smooth, judge, noise, motion.pad, motion.measured,
                  motion.halts[:size])


def _fast_padding(size: int, least: int) -> int:
    """Return the samples to add at both ends, so that the sum has small prime factors only."""
    most = size - 2
    return next((pad for pad in range(min(least, most), most)
                 if next_fast_len(size + 2 * pad) == size + 2 * pad), min(least, most))


def low_pass(frequency: Array, corner: float) -> Array:
    """Return the gain of a fourth-order Butterworth filter run forwards and backwards."""
    return 1.0 / (1.0 + (frequency / corner) ** 8)


def common_band(motion: Array, force: Array, period: float) -> float:
    """
    Return the frequency (Hz) up to which the coherence of a motion and its force is COHERENT.

    Above it noise and the modes of a load that is not rigid prevail.
    """
    rate = 1.0 / period
    frequency, coherent = coherence(motion, force, rate, detrend='linear',
                                    nperseg=max(min(motion.size // 4, 2048), 2))
    width = min(max(1, int(SPAN_HZ / frequency[1])), coherent.size)
    smooth = np.convolve(coherent, np.ones(width) / width, 'same')
    above = frequency[smooth > COHERENT]
    return float(np.clip(above[-1] if above.size else 0.0, LOWEST_BAND_HZ, 0.2 * rate))


def clear_band(signal: Array, omega: Array, noise: Array, period: float, longest: int) -> float:
    """
    Return the frequency (Hz) up to which a signal is above its noise; 0 if nowhere.

    noise: at each omega (rad/s), the variance of white noise with that spectral density; longest:
    samples of a segment of the spectrum.
    """
    frequency, power = welch(signal, 1.0 / period, nperseg=min(signal.size // 4, longest))
    level = 2.0 * period * np.interp(2.0 * np.pi * frequency, omega, noise)
    above = frequency[power > SIGNAL_TO_NOISE * level]
    return float(above[-1]) if above.size else 0.0


def steady_band(signal: Array, noise: float, period: float) -> float:
    """
    Return the frequency (Hz) above which SPAN_HZ of a signal's power are nowhere above noise.

    noise: standard deviation of white noise. Single bins, which exceed it by chance, would move
    the band from one recording to the next.
    """
    frequency, power = welch(signal, 1.0 / period,
                             nperseg=max(min(signal.size // 4, 2048), 2))
    width = max(1, int(SPAN_HZ / frequency[1]))
    sums = np.cumsum(np.concatenate([[0.0], power]))
    last = np.minimum(np.arange(power.size) + width, power.size)
    mean = (sums[last] - sums[:-1]) / (last - np.arange(power.size))
    clear = np.flatnonzero(np.minimum(mean, power) > SIGNAL_TO_NOISE * 2.0 * period * noise ** 2)
    return float(frequency[clear[-1]]) if clear.size else 0.0


def noise_above(signal: Array, motion: Motion, period: float) -> float:
    """
    Return the rms of white noise with the spectral density of a signal just above its band.

    Noise that is not white has about that density in the band, where the motion hides it.
    """
    edge = motion.edge_hz
    frequency, power = welch(signal, 1.0 / period, nperseg=min(
        signal.size // 4, int(SEGMENTS / (edge * period))))
    beside = power[(frequency > NOISE_BAND[0] * edge) & (frequency < NOISE_BAND[1] * edge)]
    if not beside.size:
        return 0.0
    return math.sqrt(float(np.quantile(beside, NOISE_QUANTILE)) / (2.0 * period))


def agree(position: Array, velocity: Array, period: float) -> bool:
    """Return whether a velocity may be the derivative of a position, whatever its noise."""
    return LEAST_RATIO < velocity_over_derivative(position, velocity, period) < 1.0 / LEAST_RATIO


def velocity_over_derivative(position: Array, velocity: Array, period: float) -> float:
    """Return the ratio of a velocity to the derivative of a position; 1 if uncorrelated."""
    moved = np.gradient(position, period)
    if np.std(moved) == 0.0 or np.std(velocity) == 0.0:
        return 1.0
    rough = np.convolve(moved, np.ones(9) / 9, 'same')
    smooth = np.convolve(velocity, np.ones(9) / 9, 'same')
    if np.corrcoef(rough, smooth)[0, 1] ** 2 < 0.5:
        return 1.0
    return float(smooth @ smooth / (rough @ smooth))


def motion_of(position: Array | None, velocity: Array | None, noises: Mapping[str, float],
              band: float, period: float) -> tuple[Motion | None, Array | None]:
    """
    Return the motion of the load from its measured position, velocity or both.

    And the velocity (m/s) fused from both; None if the velocity was not measured. noises: standard
    deviation of each; band: frequency (Hz) up to which the motion is compared.
    """
    source = velocity if velocity is not None else position
    if source is None:
        return None, None
    pad = _fast_padding(source.size, max(int(PAD_S / period), 1))
    count = source.size + 2 * pad
    frequency = np.fft.rfftfreq(count, period)
    omega = 2.0 * np.pi * frequency
    if velocity is None:
        assert position is not None
        # If the ends differ, the extended signal jumps where it wraps round, which rings.
        line = np.linspace(position[0], position[-1], position.size)
        v = 1j * omega * np.fft.rfft(extended(position - line, pad))
        v[0] = count * (line[1] - line[0]) / period
        noise = (omega * noises['position']) ** 2
    else:
        v = np.fft.rfft(extended(velocity, pad, 'even'))
        noise = np.full_like(omega, noises['velocity'] ** 2)
        if position is not None:
            # Weighted by their noise: slow motion from the position, fast from the velocity.
            slow = noise / ((omega * noises['position']) ** 2 + noise + 1e-300)
            v += slow * np.fft.rfft(extended(np.gradient(position, period) - velocity, pad,
                                             'even'))
            noise = (1.0 - slow) * noise
    # The mean velocity is a line in position, extended like all other signals.
    x = np.fft.rfft(extended(v[0].real / count * period * np.arange(source.size), pad))
    x[1:] += v[1:] / (1j * omega[1:])
    found = np.fft.irfft(v, count)[pad:-pad]
    if position is not None:
        x[0] += count * np.mean(position - np.fft.irfft(x, count)[pad:-pad])
    fused = found if velocity is not None else None
    corner = max(SMOOTHED_BAND * band, clear_band(found, omega, noise, period, 1024))
    smooth = low_pass(frequency, min(corner, 0.45 / period))
    x, v = x * smooth, v * smooth
    judge = low_pass(frequency, band)
    if position is None:   # an integral drifts at low frequencies
        judge = judge * (1.0 - np.exp(-(frequency / LOWEST_INTEGRATED_HZ) ** 2))
    smoothed, acceleration = np.fft.irfft(v, count), np.fft.irfft(1j * omega * v, count)
    # An acceleration that begins at once is smoothed, too.
    halted = math.hypot(HALTED * math.sqrt(float(np.mean(smooth ** 2 * noise))),
                        LEAK * float(np.std(acceleration)) / (2.0 * np.pi * corner))
    return Motion(omega, np.fft.irfft(x, count), smoothed, acceleration, x, v, smooth, judge,
                  noise, pad, position is not None, halts(smoothed, halted)), fused


def judged(values: Array, motion: Motion) -> Array:
    """Return a recorded signal, filtered to the band in which the motion is compared."""
    spectrum = np.fft.rfft(extended(values, motion.pad)) * motion.judge
    count = values.size + 2 * motion.pad
    return np.fft.irfft(spectrum, count)[motion.inner]


def stands(position: Array, noise: float, period: float, band: float) -> Mask:
    """
    Return the samples in which a joint stands still, with half a period of the band (Hz) around.

    Static friction then balances any force, which the motion does not determine. No samples, if
    the encoder is too coarse, or the noise (standard deviation) too large, to tell a standstill
    from slow motion.
    """
    moves = np.diff(position)
    still = np.zeros(position.size, bool)
    steps = np.abs(moves[moves != 0.0])
    if not steps.size:
        return still
    if np.unique(position).size > SHARED * position.size:    # no encoder: values hardly repeat
        within = WITHIN * noise
        slow = SLOW * math.sqrt(max(float(np.var(moves)) - 2.0 * noise ** 2, 0.0)) / period
        if LONGEST_S * slow <= within:
            return still
        count = min(max(math.ceil(max(REST_S, within / slow) / period), 4), position.size)
        span = (maximum_filter1d(position, count) - minimum_filter1d(position, count)) < within
        still = maximum_filter1d(span, count)
        return _with_reach(still, period, band)
    if float(np.median(steps)) > SLOW * STANDS_S * float(np.std(moves)) / period:
        return still
    edges = np.concatenate([[0], np.flatnonzero(moves) + 1, [position.size]])
    for first, last in itertools.pairwise(edges):
        if (last - first) * period >= STANDS_S:
            still[first:last] = True
    return _with_reach(still, period, band)


def _with_reach(still: Mask, period: float, band: float) -> Mask:
    """Return samples with half a period of the band around; none if that is nearly all."""
    reach = round(0.5 / (band * period))
    near = np.convolve(still, np.ones(2 * reach + 1), 'same') > 0.0
    return near if near.mean() < MOST_STANDS else np.zeros_like(still)


def halts(velocity: Array, slow: float) -> Mask:
    """
    Return the samples in which a load may halt for a moment, as friction makes it.

    It is below a speed, and as long before and after that it is FASTER times as fast: more than at
    a turn of constant acceleration, where that is three times.
    """
    speed = np.abs(velocity)
    below = np.concatenate([[False], speed < slow, [False]])
    found = np.zeros(speed.size, bool)
    for first, last in np.flatnonzero(np.diff(below)).reshape(-1, 2):
        before, after = 2 * first - last, 2 * last - first - 1
        if (before >= 0 and after < speed.size
                and min(speed[before], speed[after]) > FASTER * slow):
            found[first:last] = True
    return found


def ends(count: int, period: float, band: float, integrated: bool) -> Mask:
    """
    Return the samples at both ends of a recording in which filters ring.

    band: Hz, of the low-pass filter; integrated: the motion, which passed a high-pass filter, too.
    """
    time = period * np.arange(count)
    ringing = max(1.0 / band, RINGING_S * integrated)
    return np.minimum(time, time[::-1]) < min(ringing, RINGING * time[-1])
