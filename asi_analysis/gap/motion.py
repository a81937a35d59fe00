"""The motion of a load from its position and velocity, and the band in which it is judged."""

import itertools
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.signal import coherence, welch

from asi_analysis.arrays import Array, Complex, Mask
from asi_analysis.gap.sampling import noise_of

PAD_S = 0.6             # mirrored on at both ends before a Fourier transform; half of it fades
# The motion is smoothed at this multiple of the band that is judged, or where its power is no more
# than this multiple of the noise's: friction and backlash act on all of the motion that there is.
SMOOTHING, OUTSTANDING = 2.5, 4.0
ABOVE, RESOLVED = (1.5, 4.0), 8.0   # multiples of a band: just above it; segments to resolve it
QUIET = 0.25            # quantile of the power there, since a load may ring
COHERENT = 0.95         # share of the power that motion and force have in common
LOWEST_BAND_HZ = 20.0
# A position that is an integral is judged above this, so gently that it does not ring for longer
# at the ends; nor for more than a share of a short recording.
LOWEST_INTEGRATED_HZ, RINGING_S, RINGING = 0.5, 1.0, 0.2
# How long a joint stands still at least, in which it would else move by a step of its encoder at
# this share of its usual speed; and most of a recording that is left out for that.
STANDS_S, SLOW, MOST_STANDS = 0.02, 0.1, 0.95
LEAST_RATIO = 0.25      # of a velocity to the derivative of its position, or its inverse


@dataclass(frozen=True)
class Motion:
    """
    The measured motion of the piston, for the load: extended by PAD_S at both ends.

    spectra are of the whole extended length; `smooth` is the gain by which they were smoothed,
    `judge` that of the band that is judged; `noise` is what white noise as strong everywhere as
    the velocity's is at each frequency would vary by.
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


def extended(values: Array, pad: int, reflect_type: Literal['even', 'odd'] = 'odd') -> Array:
    """
    Return the values with `pad` mirrored ones at both ends, without a jump where these wrap round.

    odd: value and slope go on. The outer half of both ends fades to the same value: a jump there
    rings in all derivatives.
    """
    longer = np.pad(values, pad, 'reflect', reflect_type=reflect_type)
    fade = np.ones(longer.size)
    outer = pad // 2
    fade[:outer] = 0.5 - 0.5 * np.cos(np.pi * np.arange(outer) / max(outer, 1))
    fade *= fade[::-1]
    middle = 0.5 * (values[0] + values[-1])
    return np.asarray(middle + fade * (longer - middle))


def low_pass(frequency: Array, corner: float) -> Array:
    """Return the gain of a fourth-order Butterworth filter run forwards and backwards."""
    return 1.0 / (1.0 + (frequency / corner) ** 8)


def common_band(motion: Array, force: Array, period: float) -> float:
    """
    Return the frequency (Hz) up to which a motion and its force belong together.

    There their coherence is above COHERENT; beyond, noise prevails and what no rigid load does.
    """
    rate = 1.0 / period
    frequency, shared = coherence(motion, force, rate, nperseg=max(min(motion.size // 4, 2048), 2),
                                  detrend='linear')
    width = min(max(1, int(5.0 / frequency[1])), shared.size)
    smooth = np.convolve(shared, np.ones(width) / width, 'same')
    above = frequency[smooth > COHERENT]
    return float(np.clip(above[-1] if above.size else 0.0, LOWEST_BAND_HZ, 0.2 * rate))


def clear_band(signal: Array, omega: Array, noise: Array, period: float, longest: int) -> float:
    """
    Return the frequency (Hz) up to which a signal stands out of its noise; 0 if nowhere.

    noise: its variance, if it were as strong everywhere, at each omega (rad/s); longest: samples
    of a segment of the spectrum.
    """
    frequency, power = welch(signal, 1.0 / period, nperseg=min(signal.size // 4, longest))
    level = 2.0 * period * np.interp(2.0 * np.pi * frequency, omega, noise)
    above = frequency[power > OUTSTANDING * level]
    return float(above[-1]) if above.size else 0.0


def noise_above(signal: Array, motion: Motion, period: float) -> float:
    """
    Return the rms of white noise as strong as a signal just above the band that is judged.

    There noise that is not white is as it is in the band, where the motion hides it.
    """
    gain = np.sqrt(0.5)
    edge = float(motion.omega[motion.judge > gain].max(initial=motion.omega[1])) / (2.0 * np.pi)
    frequency, power = welch(signal, 1.0 / period, nperseg=min(
        signal.size // 4, int(RESOLVED / (edge * period))))
    beside = power[(frequency > ABOVE[0] * edge) & (frequency < ABOVE[1] * edge)]
    return math.sqrt(float(np.quantile(beside, QUIET)) / (2.0 * period)) if beside.size else 0.0


def agree(position: Array, velocity: Array, period: float) -> bool:
    """Return whether a velocity may be the derivative of a position, whatever its noise."""
    return LEAST_RATIO < velocity_over_derivative(position, velocity, period) < 1.0 / LEAST_RATIO


def velocity_over_derivative(position: Array, velocity: Array, period: float) -> float:
    """Return a velocity over the derivative of a position; 1 if uncorrelated."""
    moved = np.gradient(position, period)
    if np.std(moved) == 0.0 or np.std(velocity) == 0.0:
        return 1.0
    rough = np.convolve(moved, np.ones(9) / 9, 'same')
    smooth = np.convolve(velocity, np.ones(9) / 9, 'same')
    if np.corrcoef(rough, smooth)[0, 1] ** 2 < 0.5:
        return 1.0
    return float(smooth @ smooth / (rough @ smooth))


def motion_of(position: Array | None, velocity: Array | None, band: float,
            period: float) -> tuple[Motion | None, Array | None]:
    """
    Return the motion of the load from its measured position, velocity or both.

    band: frequency (Hz) up to which it is judged.

    Also the velocity (m/s) whose integral is the measured position; None if not measured.
    """
    source = velocity if velocity is not None else position
    if source is None:
        return None, None
    pad = min(max(int(PAD_S / period), 1), source.size - 2)
    count = source.size + 2 * pad
    frequency = np.fft.rfftfreq(count, period)
    omega = 2.0 * np.pi * frequency
    if velocity is None:
        assert position is not None
        # If the ends differ, the extended signal jumps where it wraps round, which rings.
        line = np.linspace(position[0], position[-1], position.size)
        v = 1j * omega * np.fft.rfft(extended(position - line, pad))
        v[0] = count * (line[1] - line[0]) / period
        noise = (omega * noise_of(position)) ** 2
    else:
        v = np.fft.rfft(extended(velocity, pad, 'even'))
        noise = np.full_like(omega, noise_of(velocity) ** 2)
        if position is not None:
            # Each by its noise: slow motion from the position, fast motion from the velocity.
            slow = noise / ((omega * noise_of(position)) ** 2 + noise + 1e-300)
            v += slow * np.fft.rfft(extended(np.gradient(position, period) - velocity, pad,
                                             'even'))
            noise = (1.0 - slow) * noise
    # The mean velocity is a line, extended at both ends as the force of a spring is.
    x = np.fft.rfft(extended(v[0].real / count * period * np.arange(source.size), pad))
    x[1:] += v[1:] / (1j * omega[1:])
    found = np.fft.irfft(v, count)[pad:-pad]
    if position is not None:
        x[0] += count * np.mean(position - np.fft.irfft(x, count)[pad:-pad])
    fused = found if velocity is not None else None
    corner = max(SMOOTHING * band, clear_band(found, omega, noise, period, 1024))
    smooth = low_pass(frequency, min(corner, 0.45 / period))
    x, v = x * smooth, v * smooth
    judge = low_pass(frequency, band)
    if position is None:   # what an integral adds up at low frequency says nothing
        judge = judge * (1.0 - np.exp(-(frequency / LOWEST_INTEGRATED_HZ) ** 2))
    return Motion(omega, np.fft.irfft(x, count), np.fft.irfft(v, count),
                  np.fft.irfft(1j * omega * v, count), x, v, smooth, judge, noise, pad,
                  position is not None), fused


def judged(values: Array, motion: Motion) -> Array:
    """Return a recorded signal within the band of the motion that is judged."""
    spectrum = np.fft.rfft(extended(values, motion.pad)) * motion.judge
    count = values.size + 2 * motion.pad
    return np.fft.irfft(spectrum, count)[motion.pad:motion.pad + values.size]


def stands(position: Array, period: float, band: float) -> Mask:
    """
    Return the samples in which a joint stands still, and those near them by the band (Hz).

    Friction then holds any force up to its level, which no motion tells. None, if its encoder is
    too coarse to tell a standstill from a slow motion.
    """
    moves = np.diff(position)
    still = np.zeros(position.size, bool)
    steps = np.abs(moves[moves != 0.0])
    if not steps.size or float(np.median(steps)) > SLOW * STANDS_S * float(np.std(moves)) / period:
        return still
    edges = np.concatenate([[0], np.flatnonzero(moves) + 1, [position.size]])
    for first, last in itertools.pairwise(edges):
        if (last - first) * period >= STANDS_S:
            still[first:last] = True
    reach = round(0.5 / (band * period))
    near = np.convolve(still, np.ones(2 * reach + 1), 'same') > 0.0
    return near if near.mean() < MOST_STANDS else np.zeros_like(still)


def ends(count: int, period: float) -> Mask:
    """Return the samples at both ends of a recording in which a high-pass still rings."""
    time = period * np.arange(count)
    return np.minimum(time, time[::-1]) < min(RINGING_S, RINGING * time[-1])
