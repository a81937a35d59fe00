"""
The definition of a sustained oscillation, and its measure.

An oscillation is sustained if its amplitude is above the noise floor and does not decay: the 95 %
interval of its growth rate, 1/s, is not entirely below -MOST_DECAY times its frequency. The only
criterion is `is_sustained`. The growth rate is estimated by maximum likelihood from recordings
(`sinusoid.fits`), and faster, from the amplitude of each period, from simulations (`of_samples`).
A test compares the two.
"""

import itertools
import math
from typing import Any, Final, NamedTuple

import numpy as np
from scipy import optimize, signal, special

from asi_analysis.arrays import Array
from asi_analysis.bags.run import Run, hold_last
from asi_analysis.measures.bursts import FEWEST_DRIVEN, bursts
from asi_analysis.measures.drives import drives
from asi_analysis.measures.sinusoids.sinusoid import dominant_frequency, fits, least_squares
from asi_analysis.reporting.result import finite
from asi_common.jit import jit

# Relative decrease of the amplitude in a period, above which it decays (damping ratio 3e-4).
MOST_DECAY: Final = 0.002
# Noise floor of simulated forces (N), above creep and rounding.
FLOOR_N: Final = 0.5
# Share of the time after the last jump of the reference that counts as steady.
STEADY_SHARE: Final = 0.5
FEWEST_PERIODS: Final = 5
# Noise floor, as a share of the range of the force, and least share of the variance in the steady
# part that the sine must explain.
LEAST_SHARE: Final = 1e-3
LEAST_EXPLAINED: Final = 0.3
HARMONICS: Final = 9
# Least distance from a harmonic of a drive, as a share of the frequency resolution.
LOCKED: Final = 0.1
# Periods from which a growth rate can be estimated.
FEWEST_RATED: Final = 3


class Oscillation(NamedTuple):
    """
    An oscillation and whether it is sustained; figures are NaN where nothing oscillates.

    sustained: None if undecidable, with the `reason`. amplitude_n: of the fundamental, in the unit
    of the signal; thd: rms of the harmonics over that of the fundamental; growth_1_s: rate
    of the amplitude's logarithm. The `_sd` are standard deviations.
    """

    sustained: bool | None = False
    frequency_hz: float = math.nan
    amplitude_n: float = math.nan
    thd: float = math.nan
    growth_1_s: float = math.nan
    frequency_sd_hz: float = math.nan
    amplitude_sd_n: float = math.nan
    growth_sd_1_s: float = math.nan
    reason: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the keys of `asi analyze --json`, None for missing values."""
        return {'sustained': self.sustained, 'frequency_hz': finite(self.frequency_hz),
                'amplitude_n': finite(self.amplitude_n)}


def is_sustained(growth_1_s: float, growth_sd_1_s: float, freedom: float, frequency_hz: float,
                 amplitude: float, noise_floor: float) -> bool:
    """
    Return whether an oscillation is sustained: the definition.

    growth_1_s, growth_sd_1_s: growth rate of the amplitude and its standard deviation, 1/s, with
    `freedom` degrees of freedom; amplitude and noise_floor in one unit.
    """
    if not amplitude > noise_floor:
        return False
    half = special.stdtrit(max(freedom, 1.0), 0.975) * growth_sd_1_s
    return bool(growth_1_s + half >= -MOST_DECAY * frequency_hz)


@jit
def _amplitude(values, mean, slope, begin, end, period):
    """Return the complex amplitude at a period, between the fractional samples begin and end."""
    total, weights = 0.0 + 0.0j, 0.0
    for k in range(math.ceil(begin), math.floor(end) + 1):
        weight = min(1.0, k - begin + 0.5) * min(1.0, end - k + 0.5)
        angle = 2.0 * math.pi * k / period
        value = values[k] - mean - slope * (k - 0.5 * (values.size - 1))
        total += weight * value * complex(math.cos(angle), -math.sin(angle))
        weights += weight
    return 2.0 * total / weights


@jit
def _periods(values, harmonics, sizes, middles):
    """
    Measure the periods of a signal, in samples, after linear detrending.

    Fills in the rms value and the middle of each period; returns their number, the mean period,
    the amplitude of the fundamental and the THD.
    """
    n = values.size
    # Linear trend: a slow drift of the mean is no oscillation.
    slope = mean = 0.0
    for k in range(n):
        mean += values[k] / n
        slope += (k - 0.5 * (n - 1)) * values[k]
    slope *= 12.0 / (n * (n * n - 1.0))
    first = last = -1.0
    count = 0
    for k in range(1, n):
        before = values[k - 1] - mean - slope * (k - 1 - 0.5 * (n - 1))
        after = values[k] - mean - slope * (k - 0.5 * (n - 1))
        if not before < 0.0 <= after:
            continue
        crossing = k - 1 - before / (after - before)
        if count == 0:
            first = crossing
        elif count <= sizes.size:
            total = squares = weights = 0.0
            for j in range(math.ceil(last), math.floor(crossing) + 1):
                weight = min(1.0, j - last + 0.5) * min(1.0, crossing - j + 0.5)
                value = values[j] - mean - slope * (j - 0.5 * (n - 1))
                total += weight * value
                squares += weight * value * value
                weights += weight
            sizes[count - 1] = math.sqrt(max(squares / weights - (total / weights) ** 2, 0.0))
            middles[count - 1] = 0.5 * (last + crossing)
        last = crossing
        count += 1
    if count < 3:
        return 0, 0.0, 0.0, 0.0
    period = (last - first) / (count - 1)
    # Correction of the period by the phase difference between the two halves.
    half = (count - 1) // 2 * period
    turned = np.angle(_amplitude(values, mean, slope, first + half, first + 2.0 * half, period)
                      / _amplitude(values, mean, slope, first, first + half, period))
    period /= 1.0 + turned / (2.0 * math.pi) * period / half
    base = abs(_amplitude(values, mean, slope, first, last, period))
    power = 0.0
    for h in range(2, harmonics + 1):
        power += abs(_amplitude(values, mean, slope, first, last, period / h)) ** 2
    return min(count - 1, sizes.size), period, base, math.sqrt(power) / base


def of_samples(values: Array, rate_hz: float, noise_floor: float = FLOOR_N) -> Oscillation:
    """
    Return the oscillation of an evenly sampled signal without noise, such as a simulated force.

    Periods begin at upward crossings of the linear trend; the growth rate is the slope of the
    logarithm of their rms values. Fewer than FEWEST_RATED periods are no oscillation; a signal
    that diverges (not finite) is sustained, without figures.
    """
    if not np.isfinite(values).all():
        return Oscillation(True, reason='the signal diverges')
    if values.size < 4:
        return Oscillation()
    sizes, middles = np.empty(values.size // 2), np.empty(values.size // 2)
    count, period, amplitude, thd = _periods(
        np.ascontiguousarray(values), HARMONICS, sizes, middles)
    if count < FEWEST_RATED or not amplitude > 0.0:
        return Oscillation()
    time = middles[:count] / rate_hz
    time -= time.mean()
    level = np.log(np.maximum(sizes[:count], 1e-300))
    moment = float(time @ time)
    growth = float(time @ level) / moment
    residual = level - level.mean() - growth * time
    deviation = math.sqrt(float(residual @ residual) / (count - 2) / moment)
    frequency = float(rate_hz / period)
    return Oscillation(
        is_sustained(growth, deviation, count - 2, frequency, amplitude, noise_floor), frequency,
        amplitude, thd, growth, math.nan, math.nan, deviation)


def fit_sine(time: Array, values: Array, frequency_hz: float) -> tuple[complex, Array]:
    """Return the complex amplitude of a sine at a frequency (Hz), and the residual."""
    angle = 2.0 * np.pi * frequency_hz * time
    basis = np.column_stack([np.cos(angle), np.sin(angle), np.ones_like(time)])
    weights, *_ = np.linalg.lstsq(basis, values, rcond=None)
    return complex(weights[0], -weights[1]), values - basis @ weights


def sine_frequency(time: Array, values: Array) -> float:
    """Return the frequency (Hz) of the sine that is nearest to a signal (least squares)."""
    guess, resolution = dominant_frequency(time, values, 0.5, 0), 1.0 / (time[-1] - time[0])
    return float(optimize.minimize_scalar(
        lambda f: float(np.sum(fit_sine(time, values, f)[1]**2)),
        bounds=(max(guess - resolution, 0.1 * resolution), guess + resolution), method='bounded',
        options={'xatol': 1e-4 * resolution}).x)


def amplitude_at(values: Array, frequency_hz: float, rate_hz: float) -> complex:
    """Return the complex amplitude of n samples, whole periods, at a frequency, by projection."""
    angle = 2.0 * np.pi * frequency_hz * np.arange(len(values)) / rate_hz
    return complex(2.0 * np.mean(values * np.exp(-1j * angle)))


def _steady_part(run: Run) -> slice:
    """Return the samples of the second half of the time after the last jump of the reference."""
    n = run.time_s.size
    start = 0
    if run.reference_n is not None:
        reference = hold_last(run.reference_n)
        least = 0.2 * max(float(np.ptp(reference)), 1e-12)
        large = np.flatnonzero(np.abs(np.diff(reference)) > least)
        start = int(large[-1]) + 1 if large.size else 0
    return slice(start + int((1.0 - STEADY_SHARE) * (n - start)), n)


def _period(time: Array, drive: Array, noise_floor: float) -> float | None:
    """
    Return the period (s) of a drive, 0 if it moves less than its noise floor.

    None if it has more than one frequency: any oscillation may be forced.
    """
    drive = drive - drive.mean()
    if np.ptp(drive) <= noise_floor:
        return 0.0
    frequency = sine_frequency(time, drive)
    _, residual = fit_sine(time, drive, frequency)
    # The residual of a triangle has 1.4 % of its power; of a chirp or a PRBS most of it.
    return None if np.var(residual) > 0.05 * np.var(drive) else 1.0 / frequency


def _without_period(time: Array, output: Array, period: float) -> tuple[Array, float]:
    """
    Return a signal without its linear trend and its periodic part, and one amplitude of that part.

    It is the largest amplitude of the harmonics from the second on.
    """
    angle = 2.0 * np.pi / period * np.outer(time - time.mean(), np.arange(1, HARMONICS + 1))
    columns = np.column_stack([np.ones_like(time), time - time.mean(), np.cos(angle),
                               np.sin(angle)])
    weights = least_squares(columns, output)
    sizes = np.hypot(*np.split(weights[2:], 2))
    return output - columns @ weights, float(sizes[1:].max())


def _combined(frequency_hz: float, span: float, drives_hz: list[float]) -> bool:
    """Return whether a frequency is a sum or difference of multiples of two drive frequencies."""
    multiples = np.arange(-HARMONICS, HARMONICS + 1)
    return any(bool((np.abs(np.add.outer(multiples * one, multiples * other) - frequency_hz)
                     < LOCKED / span).any())
               for one, other in itertools.combinations(drives_hz, 2))


def oscillation(run: Run, name: str | None = None) -> Oscillation:
    """
    Return the self-sustained oscillation of a signal in the steady part of a run.

    name: of the signal, by default the controlled one or the first that was recorded.

    The steady part is the second half of the time after the last jump of the reference. The
    response to a periodic drive (its frequency and harmonics) is removed first. An oscillation in
    bursts, at the same phases of each period of the drive, has figures and `sustained` None.
    """
    whole = run.signals().get(run.output(name))
    if whole is None:
        return Oscillation(None, reason='the run has no signal')
    part = _steady_part(run)
    time, output = run.time_s[part], whole[part]
    valid = np.isfinite(output)
    time, output = time[valid], output[valid]
    if time.size < 50:
        return Oscillation(None, reason='the steady part is shorter than 50 samples')
    noise_floor = LEAST_SHARE * float(np.ptp(whole[np.isfinite(whole)]))
    if noise_floor == 0.0:
        return Oscillation()
    output, periods = signal.detrend(output), []
    for drive in drives(run):
        period = _period(time, hold_last(drive.values)[part][valid],
                         0.0 if drive.exact else 1e-3 * float(np.ptp(output)))
        if period is None:
            return Oscillation(
                None, reason=f'{drive.name} moves at many frequencies until the end of the run')
        if period:
            output, harmonic = _without_period(time, output, period)
            periods.append((drive, period, harmonic))
    found = _steady(time, output, noise_floor)
    span = float(time[-1] - time[0])
    if found.sustained and len(periods) > 1 and _combined(found.frequency_hz, span, [
            1.0 / period for _, period, _ in periods]):
        names = ' and '.join(drive.name for drive, _, _ in periods)
        return Oscillation(None, reason=(
            f'the residual oscillates at {found.frequency_hz:.4g} Hz, a sum of multiples of the '
            f'frequencies of {names}: a nonlinear response to both, or an oscillation there'))
    for drive, period, harmonic in periods:
        if found.sustained is not False:
            cycles = found.frequency_hz * period
            apart = abs(cycles - round(cycles)) / period   # Hz, from the next harmonic
            if apart < max(LOCKED / span, 3.0 * found.frequency_sd_hz):
                if found.amplitude_n <= harmonic:   # a further harmonic of the drive
                    return Oscillation()
                return Oscillation(None, reason=(
                    f'the residual oscillates at {found.frequency_hz:.4g} Hz, {round(cycles)} '
                    f'times the frequency of {drive.name}: its harmonic, or an oscillation locked '
                    'to it'))
        elif np.std(output) > noise_floor:
            burst = bursts(time, output, period)
            if burst is not None and burst.amplitude > noise_floor:
                return Oscillation(None, burst.frequency_hz, burst.amplitude, reason=(
                    f'in bursts of {burst.cycles:.1f} cycles that follow the phase of '
                    f'{drive.name}, of {1.0 / period:.3g} Hz'))
            if drive.exact and span < FEWEST_DRIVEN * period:
                return Oscillation(None, reason=(
                    f'the steady part is shorter than {FEWEST_DRIVEN:g} periods of {drive.name}'))
    return found


def _steady(time: Array, output: Array, noise_floor: float) -> Oscillation:
    """Return the oscillation of an undriven signal, fitted with a growth rate."""
    found = fits(time, output, dominant_frequency(time, output, FEWEST_PERIODS), (True,))
    if not found:
        return Oscillation()
    fit = found[0]
    explained = 1.0 - np.var(fit_sine(time, output, fit.frequency_hz)[1]) / np.var(output)
    if fit.amplitude < noise_floor or explained < LEAST_EXPLAINED:
        return Oscillation()
    return Oscillation(
        is_sustained(fit.rate, fit.rate_sd, fit.freedom, fit.frequency_hz, fit.amplitude,
                     noise_floor),
        fit.frequency_hz, fit.amplitude, fit.thd, fit.rate, fit.frequency_sd_hz,
        fit.amplitude_sd, fit.rate_sd)
