"""Uniform sampling of a run: missing samples, the noise of a signal, clipped samples."""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dtbtrs
from scipy.signal import lfilter

from asi_analysis.arrays import Array, Complex, Mask
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.gap.parts import BURN_OUT_S
from asi_analysis.measures.quality import check_size, check_time

SHORTEST_S = 1.0
MOST_MISSING = 0.05     # largest share of missing samples
LONGEST_BRIDGE = 3.0    # farther from a recorded sample, in periods, interpolation is not used
JUMPED = 0.1            # share of its range by which a command jumps: a lost sample then matters
MOST_JUMPED = 0.5       # largest share of a recording that is left out for that
SMALL = 0.1             # share of the median step below which a signal comes to rest
CLIPPED_SAMPLES = 4     # at an extreme, at least
CLIPPED = 0.005         # share of samples at an extreme above which a signal is clipped there
SHARED = 0.3            # a signal with fewer values than this share of its samples is quantised
CIRCLE = np.linspace(-0.5, 0.5, 4096, endpoint=False)   # frequencies, cycles per sample
SETTLING = 1000         # samples after which noise of a colour is in its steady state
CLOSED_FORM = 70.0      # sum of the squared binomial weights 1, 4, 6, 4, 1


def noise_of(signal: Array, time: Array | None = None) -> float:
    """
    Return the standard deviation of a signal's white noise.

    From the median of the fourth differences, in which a smooth signal vanishes and rare jumps do
    not count. At least the quantisation noise of a quantised signal. time: of the samples, if it
    is uneven: then of the divided differences.
    """
    differences = (np.diff(signal, 4) / math.sqrt(CLOSED_FORM) if time is None else
                   _divided_differences(signal, time))
    white = float(np.median(np.abs(differences)) / 0.6745)
    levels = np.unique(signal)
    if 1 < levels.size < SHARED * signal.size:   # of an encoder: each value many times
        white = max(white, float(np.median(np.diff(levels))) / math.sqrt(12.0))
    return white


def _divided_differences(signal: Array, time: Array) -> Array:
    """Return the fourth divided differences of a signal, in which white noise has its variance."""
    rows = np.arange(signal.size - 4)
    unit = float(np.median(np.diff(time)))
    at = [(time[rows + i] - time[rows]) / unit for i in range(5)]
    weights = [1.0 / np.prod([here - other for j, other in enumerate(at) if j != i], axis=0)
               for i, here in enumerate(at)]
    size = np.sqrt(np.sum(np.square(weights), axis=0))
    return sum(weight * signal[rows + i] for i, weight in enumerate(weights)) / size


def noise_spectrum(frequency: Array, colour: tuple[float, ...]) -> Array:
    """
    Return the power density of noise over that of white noise with the same variance.

    frequency: cycles per sample; colour: the coefficients of an autoregression, none if white.
    """
    return 1.0 / (gain_of_noise(colour) * np.abs(_whitener(frequency, colour)) ** 2)


@lru_cache(maxsize=16)
def gain_of_noise(colour: tuple[float, ...]) -> float:
    """Return the variance of autoregressive noise over that of the white noise that drives it."""
    return float(np.mean(np.abs(_whitener(CIRCLE, colour)) ** -2))


def noise_of_colour(count: int, colour: tuple[float, ...], random: np.random.Generator) -> Array:
    """Return autoregressive noise with the variance 1, from its steady state."""
    white = random.standard_normal(count + SETTLING)
    return lfilter([1.0], [1.0, *(-each for each in colour)], white)[SETTLING:] / math.sqrt(
        gain_of_noise(colour))


def whitened(error: Array, valid: Mask, colour: tuple[float, ...]) -> Array:
    """Return an error whose noise has this colour, with white noise of the same variance."""
    filtered = np.convolve(_over_gaps(error, valid), [1.0, *(-each for each in colour)])
    return math.sqrt(gain_of_noise(colour)) * filtered[:error.size]


def whitened_by(factor: Array, error: Array, valid: Mask) -> Array:
    """
    Return an error with white noise.

    factor: of the covariance over the variance of that white noise, the lower one by Cholesky, n
    rows with its bands.
    """
    return dtbtrs(factor.T, _over_gaps(error, valid), uplo='L')[0]


def _over_gaps(error: Array, valid: Mask) -> Array:
    """Return an error, interpolated where it is not valid."""
    if valid.all():
        return error
    index = np.arange(error.size)
    return np.interp(index, index[valid], error[valid])


def _whitener(frequency: Array, colour: tuple[float, ...]) -> Complex:
    """Return the response of the filter that makes autoregressive noise white."""
    return np.polynomial.polynomial.polyval(
        np.exp(-2j * np.pi * frequency), [1.0, *(-each for each in colour)])


def clipped(signal: Array) -> Mask:
    """
    Return the samples at which a signal is clipped at its largest or smallest value.

    A measured signal rarely repeats a value: many samples at its extreme are clipped, unless it
    reaches and leaves it in small steps, as at rest. A quantised signal cannot be checked.
    """
    cut = np.zeros(signal.size, bool)
    if np.unique(signal).size > SHARED * signal.size:
        steps = np.abs(np.diff(signal))
        least = SMALL * float(np.median(steps[steps > 0.0]))
        for extreme in (signal.max(), signal.min()):
            at = signal == extreme
            beside = steps[at[1:] != at[:-1]]
            often = at.sum() >= CLIPPED_SAMPLES and at.mean() > CLIPPED
            if often and beside.max(initial=0.0) > least:
                cut |= at
    return cut


def _bridged(name: str, values: Array, source: str) -> Array:
    """Return a signal with missing samples interpolated; raises InputError if too many miss."""
    missing = ~np.isfinite(values)
    if missing.mean() > MOST_MISSING:
        raise InputError(f'{source}: signal {name} misses {100 * missing.mean():.0f} % of its '
                         f'samples (NaN or infinite); at most {100 * MOST_MISSING:.0f} % can be '
                         'bridged')
    if not missing.any():
        return values
    index = np.arange(values.size)
    return np.interp(index, index[~missing], values[~missing])


def _held(time: Array, values: Array, even: Array) -> Array:
    """
    Return the mean, from each of other times to the next, of a signal that holds its values.

    The first value of each such interval would come early or late by up to a sample.
    """
    total = np.append(0.0, np.cumsum(values[:-1] * np.diff(time)))
    return np.append(np.diff(np.interp(even, time, total)) / np.diff(even), values[-1])


class Uniform(NamedTuple):
    """
    The signals of a run, `period_s` apart.

    time_s: of each sample; faded: by signal, `noise_of` what was recorded over that of what is
    here, since interpolation attenuates noise, but only the fast part of it.
    """

    period_s: float
    time_s: Array
    signals: dict[str, Array]
    faded: dict[str, float]


def uniform(run: Run, by_rows: bool = False) -> Uniform:
    """
    Return the signals of a run at equal distances in time.

    by_rows: each sample is a row, at whatever time, and only lost ones are interpolated. That
    suits what answers row by row, and steps between two of them.
    """
    time = run.time_s
    if len(run) < 2 or run.duration_s < SHORTEST_S * (1.0 - 1e-6):
        raise InputError(f'{run.source}: too short for a diagnosis: {run.duration_s:.2f} s, at '
                         f'least {SHORTEST_S:g} s are needed')
    back = np.flatnonzero(np.diff(time) <= 0.0)
    if back.size:
        raise InputError(f'{run.source}: time does not rise at sample {int(back[0]) + 2}')
    check_time(time, run.source)
    check_size(run)
    length = float(time[-1] - time[0])
    if by_rows:
        numbers = np.cumsum(np.maximum(np.rint(np.diff(time, prepend=time[0]) / run.period_s), 1))
        even = np.interp(np.arange(numbers[0], numbers[-1] + 1.0), numbers, time)
    else:
        even = np.linspace(time[0], time[-1], round(length / run.period_s) + 1)
    period = length / (even.size - 1)
    # If no sample is missing and each is late by less than a period, they are used unchanged.
    complete = len(run) == even.size and np.abs(time - even).max() < period
    signals, faded = {}, {}
    for name, values in run.signals().items():
        whole = _bridged(name, np.asarray(values, float), run.source)
        if complete:
            signals[name] = whole
        elif name in ('command', 'reference'):
            signals[name] = _held(time, whole, even)
        else:
            signals[name] = np.interp(even, time, whole)
            faded[name] = max(noise_of(whole, time) / (noise_of(signals[name]) or math.inf), 1.0)
    return Uniform(period, even, signals, dict.fromkeys(signals, 1.0) | faded)


def recorded(run: Run, drive: str, even: Array) -> Mask:
    """
    Return at which times (s, equally spaced) no signal has a long gap.

    Interpolation over a long gap holds no information. Where a command jumped in a single missing
    sample, the time of the jump is unknown: left out too, unless too little data would remain.
    """
    period = float(np.median(np.diff(even)))
    far, jumps = np.zeros((2, even.size), bool)
    for name, values in run.signals().items():
        known = run.time_s[np.isfinite(values)]
        if known.size > 1 and (name != 'reference' or drive == 'position'):
            after = np.clip(np.searchsorted(known, even), 1, known.size - 1)
            distance = np.minimum(np.abs(even - known[after - 1]), np.abs(known[after] - even))
            far |= distance > LONGEST_BRIDGE * max(period, run.period_s)
            if name in ('command', 'reference'):
                there = values[np.isfinite(values)]
                jumped = np.abs(np.diff(there)) > JUMPED * np.ptp(there)
                lost = np.diff(known) > 1.5 * max(period, run.period_s)
                jumps |= (jumped & lost)[after - 1] & (distance > 0.25 * period)
    about = np.ones(2 * int(BURN_OUT_S / period) + 1)
    plain, careful = (np.convolve(out, about)[about.size // 2:][:even.size] < 0.5
                      for out in (far, far | jumps))
    return careful if careful.mean() > 1.0 - MOST_JUMPED else plain


def independent(residual: Array, used: Array) -> float:
    """
    Return the effective sample size of a residual: of n samples, those with used = 1, else 0.

    The number of samples divided by the sum of the autocorrelation, which is truncated where the
    sum of two neighbours is no longer positive (Geyer 1992, initial positive sequence).
    """
    if not used.any():
        return 0.0
    size = 2 * residual.size
    products = np.fft.irfft(np.abs(np.fft.rfft(residual * used, size)) ** 2)[:residual.size]
    pairs = np.fft.irfft(np.abs(np.fft.rfft(used, size)) ** 2)[:residual.size]
    correlation = products / np.maximum(pairs, 1.0) * pairs[0] / max(products[0], 1e-300)
    pairs_sum = correlation[1:residual.size // 8 * 2 + 1].reshape(-1, 2).sum(axis=1)
    ends = int(np.argmax(np.append(pairs_sum, -1.0) <= 0.0))
    return float(used.sum()) / (1.0 + 2.0 * float(pairs_sum[:ends].sum()))
