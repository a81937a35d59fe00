"""
Frequency, amplitude and harmonics of an oscillation: maximum likelihood, with its uncertainty.

The model is a drifting mean, a fundamental and its harmonics, in noise; if asked for, growing or
decaying at a common rate with a frequency that moves. Everything but frequency, rate and sweep is
linear, so a Gauss-Newton search in those finds the least squares, which for white noise is the
maximum of the likelihood and reaches the Cramér-Rao bound (Rife and Boorstyn, IEEE Trans.
Information Theory 20, 1974; Stoica and Moses, Spectral Analysis of Signals, 2005, chapter 4).
Sample times may have holes.
"""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import fft, stats

from asi_analysis.limit_cycle.noise import triangle

Array = npt.NDArray[np.float64]

MOST_HARMONICS: Final = 15
# The highest that is looked for beyond half the sampling rate.
MOST_FOLDED: Final = 3
# Chance of taking one harmonic, or one term of the drift, that is not there.
FALSE_TERM: Final = 1e-3
STEPS: Final = 30
# A step that promises to lower the squares by less than this share of what noise has a degree of
# freedom is not made: it would move frequency and rate by 1e-4 of their deviations.
CLOSE: Final = 1e-8


class Oscillation(NamedTuple):
    """
    A sum of harmonics found in a signal; amplitudes have the unit of the signal.

    `harmonics` holds complex amplitudes: signal = Re(sum of harmonics[h-1] exp(2 pi i h f t)),
    with t counted from `origin_s`. `rate` is that of the envelope, 1/s, 0 unless it was fitted;
    so is `sweep`, that of the frequency, Hz/s.
    The `_sd` are standard deviations, `freedom` their degrees of freedom.
    """

    origin_s: float
    frequency_hz: float
    frequency_sd_hz: float
    amplitude: float
    amplitude_sd: float
    rate: float
    rate_sd: float
    sweep: float
    harmonics: npt.NDArray[np.complex128]
    thd: float
    mean: float
    noise: float
    cycles: float
    freedom: int
    residual: Array

    def interval(self, value: str, confidence: float = 0.95) -> tuple[float, float]:
        """Return the interval of 'frequency_hz', 'amplitude' or 'rate' at a confidence."""
        deviations = {'frequency_hz': self.frequency_sd_hz, 'amplitude': self.amplitude_sd,
                      'rate': self.rate_sd}
        half = stats.t.ppf(0.5 + 0.5 * confidence, max(self.freedom, 1)) * deviations[value]
        centre = getattr(self, value)
        return centre - half, centre + half


def known(time_s: Array, values: Array) -> tuple[Array, Array]:
    """Return the samples that are there: neither time nor value NaN."""
    there = np.isfinite(time_s) & np.isfinite(values)
    return time_s[there], values[there]


def on_grid(time_s: Array, values: Array) -> tuple[Array, float]:
    """Return the samples interpolated to an even grid, and its period (s)."""
    period = float(np.median(np.diff(time_s)))
    grid = np.arange(time_s[0], time_s[-1] + 0.5 * period, period)
    if len(grid) == len(time_s) and np.abs(grid - time_s).max() < 1e-6 * period:
        return values, period
    return np.interp(grid, time_s, values), period


def _drift(time_s: Array, order: int) -> Array:
    """Return the columns of a drifting mean: Legendre polynomials over the record."""
    relative = 2.0 * (time_s - time_s[0]) / (time_s[-1] - time_s[0]) - 1.0
    return np.polynomial.legendre.legvander(relative, order)


def dominant_frequency(time_s: Array, values: Array, lowest_cycles: float = 1.5) -> float:
    """
    Return the frequency (Hz) of the highest peak of the periodogram.

    The drift of the mean, to third order, is taken off first; fewer than `lowest_cycles` in the
    record do not count. NaN if there are too few samples.
    """
    time_s, values = known(time_s, values)
    if len(values) < 8:
        return np.nan
    even, period = on_grid(time_s, values)
    drift = _drift(np.arange(len(even), dtype=float), 3)
    even = even - drift @ _least_squares(drift, even)
    size = fft.next_fast_len(8 * len(even), real=True)
    power = np.abs(fft.rfft(even, size)) ** 2
    first = int(np.ceil(lowest_cycles * size / len(even)))
    if first >= len(power) - 1 or not power[first:].any():
        return np.nan
    return float((first + np.argmax(power[first:])) / (size * period))


def _normal(gram: Array, right: Array) -> Array:
    """Return the solution of normal equations: products of the columns, and with the values."""
    sizes = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    scaled = gram / np.outer(sizes, sizes)
    try:
        return np.linalg.solve(scaled, right / sizes) / sizes
    except np.linalg.LinAlgError:
        return np.linalg.lstsq(scaled, right / sizes, rcond=None)[0] / sizes


def _least_squares(columns: Array, values: Array) -> Array:
    """Return the coefficients of the columns; by the normal equations, which are fast."""
    return _normal(columns.T @ columns, columns.T @ values)


class _Solution(NamedTuple):
    nonlinear: Array   # frequency Hz, rate 1/s, sweep Hz/s
    coefficients: Array
    columns: Array
    gram: Array        # products of the columns
    residual: Array


def _columns(t: Array, drift: Array, nonlinear: Array, harmonics: int) -> Array:
    frequency, rate, sweep = nonlinear
    angle = 2.0 * np.pi * (frequency * t + 0.5 * sweep * t * t)
    turn = np.empty(len(t), np.complex128)
    turn.real, turn.imag = np.cos(angle), np.sin(angle)
    # Kept from overflowing: a fit that runs away there is refused by its residual.
    wave = np.exp(np.clip(rate * t, -30.0, 30.0)) * turn if rate else turn
    # Column by column in memory, as they are filled and used.
    columns = np.empty((len(t), drift.shape[1] + 2 * harmonics), order='F')
    columns[:, :drift.shape[1]] = drift
    for h in range(harmonics):
        columns[:, drift.shape[1] + h] = wave.real
        columns[:, drift.shape[1] + harmonics + h] = wave.imag
        wave = wave * turn
    return columns


def _solve(t: Array, values: Array, drift: Array, nonlinear: Array, harmonics: int,
           grows: bool) -> _Solution:
    """Return the least squares over everything: Gauss-Newton in frequency, rate and sweep."""
    span = t[-1] - t[0]
    most = np.array([0.2 / span, 2.0 / span, 1.0 / span**2])
    best: _Solution | None = None
    least = np.inf
    trial, damping, step, promise = nonlinear, 1.0, np.zeros(3), 0.0
    for _ in range(STEPS):
        columns = _columns(t, drift, trial, harmonics)
        gram = columns.T @ columns
        coefficients = _normal(gram, columns.T @ values)
        residual = values - columns @ coefficients
        squares = float(residual @ residual)
        if best is None or squares < least:
            least = squares
            best = _Solution(trial, coefficients, columns, gram, residual)
            step, promise = _step(t, best, drift.shape[1], harmonics, grows)
            damping = min(1.0, *(most / np.maximum(np.abs(step), 1e-300)))
        else:
            damping *= 0.3
        trial = best.nonlinear + damping * step
        if damping * (2.0 - damping) * promise <= CLOSE / len(t) * least or trial[0] <= 0.0:
            break
    assert best is not None
    return best


def _slopes(t: Array, solution: _Solution, drift: int, harmonics: int, grows: bool) -> Array:
    """Return the derivatives of the model with frequency and, if it grows, rate and sweep."""
    cosine = solution.columns[:, drift:drift + harmonics]
    sine = solution.columns[:, drift + harmonics:]
    a = solution.coefficients[drift:drift + harmonics]
    b = solution.coefficients[drift + harmonics:]
    order = np.arange(1, harmonics + 1)
    with_frequency = 2.0 * np.pi * t * (cosine @ (order * b) - sine @ (order * a))
    if not grows:
        return with_frequency[:, None]
    return np.column_stack([with_frequency, t * (cosine @ a + sine @ b),
                            0.5 * t * with_frequency])


def _step(t: Array, solution: _Solution, drift: int, harmonics: int, grows: bool
          ) -> tuple[Array, float]:
    """Return the step in frequency, rate and sweep, and how much lower it promises the squares."""
    slopes = _slopes(t, solution, drift, harmonics, grows)
    mixed = slopes.T @ solution.columns
    right = np.concatenate([slopes.T @ solution.residual, solution.columns.T @ solution.residual])
    change = _normal(np.block([[slopes.T @ slopes, mixed], [mixed.T, solution.gram]]), right)
    step = change[:3] if grows else np.array([change[0], 0.0, 0.0])
    return step, float(change @ right)


def _better(less: float, more: float, terms: int, freedom: int, chance: float) -> bool:
    """
    Return whether `terms` more terms lower the squares that are left for good (F test).

    less, more: sums of squares with the fewer and the more terms; freedom: of the latter.
    """
    if freedom < 2:
        return False
    gain = (less - more) / terms / max(more / freedom, 1e-300)
    return bool(stats.f.sf(gain, terms, freedom) < chance)


def _choose_drift(t: Array, values: Array, start: Array, grows: bool, most: int) -> int:
    """Return the order of the drift: raised as long as one of the next two orders helps."""
    squares: dict[int, float] = {}
    order = 0
    while order < most:
        for trial in range(order, min(order + 2, most) + 1):
            if trial not in squares:
                left = _solve(t, values, _drift(t, trial), start, 1, grows).residual
                squares[trial] = float(left @ left)
        for trial in range(order + 1, min(order + 2, most) + 1):
            if _better(squares[order], squares[trial], trial - order, len(t) - trial - 4,
                       FALSE_TERM):
                order = trial
                break
        else:
            break
    return order


def _told_apart(t: Array, frequency: float) -> int:
    """Return how many harmonics can be told apart, from each other and the mean, as sampled."""
    rate = 1.0 / float(np.median(np.diff(t)))
    apart = 3.0 / (t[-1] - t[0])
    shown = [0.0]
    for harmonic in range(1, MOST_HARMONICS + 1):
        seen = abs(harmonic * frequency - rate * round(harmonic * frequency / rate))
        # At half the rate its own image, as far beyond, must not be too near either.
        image = 2.0 * abs(0.5 * rate - seen)
        if min(image, *(abs(seen - other) for other in shown)) < apart:
            return max(harmonic - 1, 1)
        shown.append(seen)
    return MOST_HARMONICS


def _choose_harmonics(t: Array, values: Array, drift: Array, start: Array, grows: bool) -> int:
    """
    Return the highest harmonic that rises above the noise.

    Above half the sampling rate a harmonic shows at another frequency, but it shows.
    """
    below_half = int(0.49 / (start[0] * float(np.median(np.diff(t)))))
    # Not so the many high ones: some of them would always fall near the first.
    most = min(max(below_half, min(_told_apart(t, start[0]), MOST_FOLDED)), MOST_HARMONICS,
               (len(t) - drift.shape[1] - 4) // 6)
    highest = 1
    solution = _solve(t, values, drift, start, 1, grows)
    while highest < most:
        # Each against what is left: those that count make the rest stand out, so look again.
        left = solution.residual
        squares = float(left @ left)
        waves = _columns(t, drift[:, :0], solution.nonlinear, most)
        gram, right = waves.T @ waves, waves.T @ left
        for trial in range(most, highest, -1):
            pair = [trial - 1, most + trial - 1]
            gain = float(right[pair] @ _normal(gram[np.ix_(pair, pair)], right[pair]))
            # The low ones are the likely ones; the chances of all add up to FALSE_TERM.
            chance = FALSE_TERM / (trial * (trial - 1))
            if _better(squares, max(squares - gain, 0.0), 2,
                       len(t) - solution.columns.shape[1] - 3, chance):
                highest = trial
                break
        else:
            break
        solution = _solve(t, values, drift, solution.nonlinear, highest, grows)
    return highest


def _local_noise(t: Array, residual: Array, frequency: float, freedom: int) -> tuple[float, int]:
    """
    Return the variance of the noise that matters at `frequency`, and its degrees of freedom.

    White noise: that of the residual. Where the residual's spectrum stands above white on either
    side of the line, that of the spectrum there.
    """
    white = float(residual @ residual) / freedom
    span = t[-1] - t[0]
    near = [line for line in (-8, -7, -6, -5, -4, -3, -2, 2, 3, 4, 5, 6, 7, 8)
            if 1.0 < frequency * span + line < 0.5 * len(t)]
    if len(near) < 4 or len(t) < 40 or white == 0.0:
        return white, freedom
    carried = residual * np.exp(-2j * np.pi * frequency * t)
    turn = np.exp(-2j * np.pi / span * t)
    wave, power = turn, {}
    for line in range(2, 9):
        wave = wave * turn
        power[line], power[-line] = np.abs(carried @ wave) ** 2, np.abs(carried @ wave.conj()) ** 2
    local = float(np.mean([power[line] for line in near])) / len(t)
    if stats.f.sf(local / white, 2 * len(near), freedom) < 0.01:
        return local, 2 * len(near)
    return white, freedom


def fit(time_s: Array, values: Array, frequency_hz: float | None = None,
        grows: bool = False, rate: float = 0.0) -> Oscillation | None:
    """
    Return the oscillation in a signal, None if there are too few samples.

    frequency_hz: where to look, the highest peak of the spectrum if not given; grows: fit
    rate (from `rate` on, 1/s) and sweep too. NaN samples are left out.
    """
    time_s, values = known(np.asarray(time_s, float), np.asarray(values, float))
    if len(values) < 9:
        return None
    if frequency_hz is None:
        frequency_hz = dominant_frequency(time_s, values)
    if not np.isfinite(frequency_hz) or np.ptp(values) == 0.0:
        return None
    origin = 0.5 * (time_s[0] + time_s[-1])
    t = time_s - origin
    scale = float(np.std(values))
    scaled = values / scale

    cycles = frequency_hz * (t[-1] - t[0])
    most_drift = int(np.clip(cycles, 0, min(10, len(t) // 5)))
    start = np.array([frequency_hz, rate, 0.0])
    drift = _drift(t, _choose_drift(t, scaled, start, grows, most_drift))
    harmonics = _choose_harmonics(t, scaled, drift, start, grows)
    solution = _solve(t, scaled, drift, start, harmonics, grows)
    return _result(time_s, t, solution, drift.shape[1], harmonics, grows, scale)


def _result(time_s: Array, t: Array, solution: _Solution, drift: int, harmonics: int,
            grows: bool, scale: float) -> Oscillation:
    nonlinear = 3 if grows else 1
    frequency, rate, sweep = map(float, solution.nonlinear)
    freedom = max(len(t) - solution.columns.shape[1] - nonlinear, 1)
    jacobian = np.hstack([_slopes(t, solution, drift, harmonics, grows), solution.columns])
    variance, local_freedom = _local_noise(t, solution.residual, frequency, freedom)
    # Columns of very different size: scaled, so that the inverse is well conditioned.
    sizes = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
    spread = np.linalg.pinv(triangle(jacobian / sizes)) / sizes[:, None]
    covariance = variance * spread @ spread.T

    a = solution.coefficients[drift:drift + harmonics]
    b = solution.coefficients[drift + harmonics:]
    amplitudes = np.hypot(a, b)
    at_cosine, at_sine = nonlinear + drift, nonlinear + drift + harmonics
    pair = np.ix_([at_cosine, at_sine], [at_cosine, at_sine])
    direction = np.array([a[0], b[0]]) / max(amplitudes[0], 1e-300)
    deviations = np.sqrt(np.diag(covariance))
    # A harmonic that is only noise has its variance as mean power: taken off, lest THD be biased.
    power = np.array([max(amplitudes[h] ** 2 - covariance[at_cosine + h, at_cosine + h]
                          - covariance[at_sine + h, at_sine + h], 0.0)
                      for h in range(1, harmonics)])
    return Oscillation(
        origin_s=float(time_s[0] + time_s[-1]) / 2.0,
        frequency_hz=frequency, frequency_sd_hz=float(deviations[0]),
        amplitude=scale * float(amplitudes[0]),
        amplitude_sd=scale * float(np.sqrt(direction @ covariance[pair] @ direction)),
        rate=rate, rate_sd=float(deviations[1]) if grows else 0.0, sweep=sweep,
        harmonics=(scale * (a - 1j * b)).astype(np.complex128),
        thd=float(np.sqrt(power.sum()) / max(amplitudes[0], 1e-300)),
        mean=scale * float((solution.columns[:, :drift] @ solution.coefficients[:drift]).mean()),
        noise=scale * float(np.sqrt(solution.residual @ solution.residual / freedom)),
        cycles=float(frequency * (t[-1] - t[0]) * len(t) / (len(t) - 1)),
        freedom=local_freedom, residual=scale * solution.residual)
