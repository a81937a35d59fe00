"""
Frequency, amplitude and harmonics of an oscillation by maximum likelihood, with uncertainty.

The model is a drifting mean, a fundamental and its harmonics, in noise; optionally with a common
growth rate and a linear sweep of the frequency. All other parameters are linear, so least squares
needs a Gauss-Newton search in frequency, rate and sweep only. For white noise it is the maximum of
the likelihood and reaches the Cramér-Rao bound (Rife and Boorstyn, IEEE Trans.
Information Theory 20, 1974; Stoica and Moses, Spectral Analysis of Signals, 2005, chapter 4).
Samples may be missing. Long records are compressed first (`record.py`).
"""

from typing import Final, NamedTuple

import numpy as np
from scipy import fft, signal, stats

from asi_analysis.arrays import Array, Complex
from asi_analysis.measures.sinusoids.noise import triangle
from asi_analysis.measures.sinusoids.record import Record, compressed, legendre

MOST_HARMONICS: Final = 15
# Highest harmonic that may be above half the sampling rate (aliased).
MOST_FOLDED: Final = 3
# Probability of a false harmonic, or of a false term of the drift.
FALSE_TERM: Final = 1e-3
STEPS: Final = 30
LONG_SPECTRUM: Final = 2**18
# Periods of an even grid that are still filled: 1 GB in double precision.
MOST_PERIODS: Final = 1e8
# Convergence: predicted decrease of the sum of squares, over the noise variance. The last step is
# then below 1e-4 standard deviations of frequency and rate.
TOLERANCE: Final = 1e-8


class HarmonicFit(NamedTuple):
    """
    A sum of harmonics found in a signal; amplitudes have the unit of the signal.

    `harmonics` holds complex amplitudes: signal = Re(sum of harmonics[h-1] exp(2 pi i h f t)),
    with t counted from `origin_s`. `rate` (1/s) is the growth rate of the envelope and `sweep`
    (Hz/s) that of the frequency, both 0 unless fitted. `drift` holds the coefficients of the mean,
    Legendre polynomials over `span_s` about the origin.
    The `_sd` are standard deviations, `freedom` their degrees of freedom.
    """

    origin_s: float
    span_s: float
    frequency_hz: float
    frequency_sd_hz: float
    amplitude: float
    amplitude_sd: float
    rate: float
    rate_sd: float
    sweep: float
    harmonics: Complex
    thd: float
    drift: Array
    noise: float
    cycles: float
    freedom: int

    @property
    def mean(self) -> float:
        """The mean of the drift."""
        return float(self.drift[0])

    def at(self, time_s: Array) -> Array:
        """Return the oscillation and its mean at times (s)."""
        t = time_s - self.origin_s
        waves = _waves(t, np.array([self.frequency_hz, self.rate, self.sweep]),
                       len(self.harmonics))
        return np.polynomial.legendre.legval(2.0 * t / self.span_s, self.drift) + sum(
            amplitude.real * wave.real - amplitude.imag * wave.imag
            for amplitude, wave in zip(self.harmonics, waves, strict=True))

    def interval(self, value: str, confidence: float = 0.95) -> tuple[float, float]:
        """Return the interval of 'frequency_hz', 'amplitude' or 'rate' at a confidence."""
        deviations = {'frequency_hz': self.frequency_sd_hz, 'amplitude': self.amplitude_sd,
                      'rate': self.rate_sd}
        half = stats.t.ppf(0.5 + 0.5 * confidence, max(self.freedom, 1)) * deviations[value]
        centre = getattr(self, value)
        return centre - half, centre + half


def valid_samples(time_s: Array, values: Array) -> tuple[Array, Array]:
    """Return the samples with finite time and value, each later than all before."""
    valid = np.isfinite(time_s) & np.isfinite(values)
    time_s, values = time_s[valid], values[valid]
    later = np.diff(np.maximum.accumulate(time_s), prepend=-np.inf) > 0.0
    return time_s[later], values[later]


def on_grid(time_s: Array, values: Array) -> tuple[Array, float]:
    """Return the samples interpolated to an even grid, and its period (s)."""
    period = float(np.median(np.diff(time_s)))
    grid = np.arange(time_s[0], time_s[-1] + 0.5 * period, period)
    if len(grid) == len(time_s) and np.abs(grid - time_s).max() < 1e-6 * period:
        return values, period
    return np.interp(grid, time_s, values), period


def analytic_signal(values: Array, period: float, frequency: float) -> Complex:
    """Return the analytic signal of values (along the last axis), band-passed at a frequency."""
    band = np.clip(2.0 * period * frequency * np.array([0.6, 1.6]), (1e-3, 2e-3), (0.9, 0.98))
    filtered = signal.sosfiltfilt(signal.butter(2, band, 'bandpass', output='sos'),
                                  values - values.mean(-1, keepdims=True),
                                  padlen=min(15, values.shape[-1] - 1))
    return np.asarray(signal.hilbert(filtered))


def dominant_frequency(time_s: Array, values: Array, lowest_cycles: float = 1.5, drift: int = 3
                       ) -> float:
    """
    Return the frequency (Hz) of the highest peak of the periodogram.

    A polynomial drift of an order is removed first; frequencies of fewer than `lowest_cycles` in
    the record are ignored. NaN if there are too few samples, or over too many periods. The
    resolution is an eighth of the inverse duration, in long records half of it.
    """
    time_s, values = valid_samples(time_s, values)
    if len(values) < 8 or np.ptp(time_s) > MOST_PERIODS * np.median(np.diff(time_s)):
        return np.nan
    even, period = on_grid(time_s, values)
    slow = legendre(np.linspace(-0.5, 0.5, len(even)), 1.0, drift)
    even = even - slow @ least_squares(slow, even)
    size = fft.next_fast_len(max(min(8 * len(even), LONG_SPECTRUM), 2 * len(even)), real=True)
    power = np.abs(fft.rfft(even, size)) ** 2
    first = int(np.ceil(lowest_cycles * size / len(even)))
    # At half the sampling rate amplitude and phase are not distinguishable.
    power = power[first:int(0.99 * len(power))]
    if not power.any():
        return np.nan
    return float((first + np.argmax(power)) / (size * period))


def _normal(gram: Array, right: Array) -> Array:
    """Return the solution of normal equations: Gram matrix and right-hand side."""
    sizes = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    scaled = gram / np.outer(sizes, sizes)
    try:
        return np.linalg.solve(scaled, right / sizes) / sizes
    except np.linalg.LinAlgError:
        return np.linalg.lstsq(scaled, right / sizes, rcond=None)[0] / sizes


def least_squares(columns: Array, values: Array) -> Array:
    """Return the coefficients of the columns, by the normal equations."""
    return _normal(columns.T @ columns, columns.T @ values)


class _Solution(NamedTuple):
    nonlinear: Array   # frequency Hz, rate 1/s, sweep Hz/s
    waves: list[Complex]
    coefficients: Array
    columns: Array
    gram: Array        # products of the columns
    residual: Array
    squares: float     # sum of squares of the residuals of the samples


def _waves(t: Array, nonlinear: Array, harmonics: int) -> list[Complex]:
    """Return the harmonics of unit amplitude at times about the middle."""
    frequency, rate, sweep = nonlinear
    angle = 2.0 * np.pi * (frequency * t + 0.5 * sweep * t * t)
    turn = np.empty(len(t), np.complex128)
    turn.real, turn.imag = np.cos(angle), np.sin(angle)
    # Clipped against overflow; a fit that diverges is rejected by its residual.
    waves = [np.exp(np.clip(rate * t, -30.0, 30.0)) * turn if rate else turn]
    for _ in range(harmonics - 1):
        waves.append(waves[-1] * turn)
    return waves


def _columns(record: Record, drift: Array, waves: list[Complex]) -> Array:
    """Return the columns of the linear part: drift, cosines, sines."""
    harmonics = len(waves)
    columns = np.empty((len(record.values), drift.shape[1] + 2 * harmonics), order='F')
    columns[:, :drift.shape[1]] = drift
    for h, wave in enumerate(waves):
        made = record.rows(h + 1, wave)
        columns[:, drift.shape[1] + h] = made.real
        columns[:, drift.shape[1] + harmonics + h] = made.imag
    return columns


def _solve(record: Record, drift: Array, nonlinear: Array, harmonics: int, grows: bool
           ) -> _Solution:
    """Return the least-squares solution, by Gauss-Newton in frequency, rate and sweep."""
    span = record.span_s
    most = np.array([0.2 / span, 2.0 / span, 1.0 / span**2])
    best: _Solution | None = None
    step: Array = np.zeros(3)
    trial, damping, decrease = nonlinear, 1.0, 0.0
    for _ in range(STEPS):
        waves = _waves(record.t, trial, harmonics)
        columns = _columns(record, drift, waves)
        gram = columns.T @ columns
        coefficients = _normal(gram, columns.T @ record.values)
        residual = record.values - columns @ coefficients
        squares = record.beyond + float(residual @ residual)
        if best is None or squares < best.squares:
            best = _Solution(trial, waves, coefficients, columns, gram, residual, squares)
            step, decrease = _step(record, best, drift.shape[1], grows)
            damping = min(1.0, *(most / np.maximum(np.abs(step), 1e-300)))
        else:
            damping *= 0.3
        trial = best.nonlinear + damping * step
        if (damping * (2.0 - damping) * decrease <= TOLERANCE / record.samples * best.squares
                or trial[0] <= 0.0):
            break
    assert best is not None
    return best


def _amplitudes(solution: _Solution, drift: int) -> Complex:
    """Return the complex amplitudes of the harmonics."""
    cosines, sines = np.split(solution.coefficients[drift:], 2)
    return cosines - 1j * sines


def _slopes(record: Record, solution: _Solution, drift: int, grows: bool) -> Array:
    """Return the derivatives of the model with frequency and, if it grows, rate and sweep."""
    t = record.t
    slopes = np.zeros((len(record.values), 3 if grows else 1))
    for h, (amplitude, wave) in enumerate(zip(
            _amplitudes(solution, drift), solution.waves, strict=True), 1):
        moved = amplitude * t * wave
        turned = 2j * np.pi * h * moved
        given = np.column_stack([turned, moved, 0.5 * t * turned]) if grows else turned[:, None]
        slopes += record.rows(h, given).real
    return slopes


def _step(record: Record, solution: _Solution, drift: int, grows: bool
          ) -> tuple[Array, float]:
    """Return the step in frequency, rate and sweep, and the predicted decrease of the squares."""
    slopes = _slopes(record, solution, drift, grows)
    mixed = slopes.T @ solution.columns
    right = np.concatenate([slopes.T @ solution.residual, solution.columns.T @ solution.residual])
    change = _normal(np.block([[slopes.T @ slopes, mixed], [mixed.T, solution.gram]]), right)
    step = change[:3] if grows else np.array([change[0], 0.0, 0.0])
    return step, float(change @ right)


def _better(fewer: float, more: float, terms: int, freedom: int, chance: float) -> bool:
    """
    Return whether `terms` more terms reduce the residual significantly (F test).

    fewer, more: sums of squares with fewer and with more terms; freedom: of the latter.
    """
    if freedom < 2:
        return False
    gain = (fewer - more) / terms / max(more / freedom, 1e-300)
    return bool(stats.f.sf(gain, terms, freedom) < chance)


def _choose_drift(record: Record, start: Array, grows: bool, most: int) -> int:
    """Return the order of the drift, raised while one of the next two orders is significant."""
    squares: dict[int, float] = {}
    order = 0
    while order < most:
        for trial in range(order, min(order + 2, most) + 1):
            if trial not in squares:
                squares[trial] = _solve(record, record.drift(trial), start, 1, grows).squares
        for trial in range(order + 1, min(order + 2, most) + 1):
            if _better(squares[order], squares[trial], trial - order,
                       record.samples - trial - 4, FALSE_TERM):
                order = trial
                break
        else:
            break
    return order


def _distinguishable(t: Array, frequency: float) -> int:
    """Return how many aliased harmonics can be distinguished from each other and the mean."""
    rate = 1.0 / float(np.median(np.diff(t)))
    apart = 3.0 / (t[-1] - t[0])
    aliases = [0.0]
    for harmonic in range(1, MOST_HARMONICS + 1):
        apparent = abs(harmonic * frequency - rate * round(harmonic * frequency / rate))
        # Distance to its own image about half the sampling rate.
        image = 2.0 * abs(0.5 * rate - apparent)
        if min(image, *(abs(apparent - other) for other in aliases)) < apart:
            return max(harmonic - 1, 1)
        aliases.append(apparent)
    return MOST_HARMONICS


def _most_harmonics(t: Array, frequency: float) -> int:
    """Return the highest harmonic of the search; above half the sampling rate, aliased ones."""
    below_half = int(0.49 / (frequency * float(np.median(np.diff(t)))))
    # Of many aliases some would coincide with the fundamental.
    folded = min(_distinguishable(t, frequency), MOST_FOLDED)
    return max(min(max(below_half, folded), MOST_HARMONICS, (len(t) - 5) // 6), 1)


def _choose_harmonics(record: Record, drift: Array, start: Array, grows: bool, most: int) -> int:
    """Return the highest significant harmonic."""
    most = min(most, (record.samples - drift.shape[1] - 4) // 6)
    highest = 1
    solution = _solve(record, drift, start, 1, grows)
    while highest < most:
        # Repeated, because each harmonic found lowers the residual.
        waves = _columns(record, drift[:, :0],
                         _waves(record.t, solution.nonlinear, most))
        gram, right = waves.T @ waves, waves.T @ solution.residual
        for trial in range(most, highest, -1):
            pair = [trial - 1, most + trial - 1]
            gain = float(right[pair] @ _normal(gram[np.ix_(pair, pair)], right[pair]))
            # Low harmonics are more probable; the probabilities add up to FALSE_TERM.
            chance = FALSE_TERM / (trial * (trial - 1))
            if _better(solution.squares, max(solution.squares - gain, 0.0), 2,
                       record.samples - solution.columns.shape[1] - 3, chance):
                highest = trial
                break
        else:
            break
        solution = _solve(record, drift, solution.nonlinear, highest, grows)
    return highest


def _local_noise(record: Record, solution: _Solution, freedom: int) -> tuple[float, int]:
    """
    Return the variance of the noise at the frequency of the oscillation, and its freedom.

    That of the residual; but if the residual's spectrum beside the oscillation is significantly
    above that of white noise, the variance from this spectrum.
    """
    white = solution.squares / freedom
    cycles = solution.nonlinear[0] * record.span_s
    near = [line for line in (-8, -7, -6, -5, -4, -3, -2, 2, 3, 4, 5, 6, 7, 8)
            if 1.0 < cycles + line < 0.5 * record.samples]
    if len(near) < 4 or record.samples < 40 or white == 0.0:
        return white, freedom
    lines = (cycles + np.array(near)) / record.span_s
    waves = record.rows(1, np.exp(2j * np.pi * record.t[:, None] * lines))
    local = float(np.mean(np.abs(solution.residual @ waves) ** 2)) / record.samples
    if stats.f.sf(local / white, 2 * len(near), freedom) < 0.01:
        return local, 2 * len(near)
    return white, freedom


def fit(time_s: Array, values: Array, frequency_hz: float | None = None) -> HarmonicFit | None:
    """
    Return the oscillation of constant amplitude in a signal, None if there are too few samples.

    frequency_hz: initial guess, by default the highest peak of the spectrum. NaN samples are
    omitted.
    """
    found = fits(time_s, values, frequency_hz, (False,))
    return found[0] if found else None


def fits(time_s: Array, values: Array, frequency_hz: float | None = None,
         grows: tuple[bool, ...] = (False, True)) -> list[HarmonicFit]:
    """
    Return a fit of the oscillation for each of `grows`; none if there are too few samples.

    grows: whether growth rate and sweep of the frequency are fitted too.
    """
    time_s, values = valid_samples(np.asarray(time_s, float), np.asarray(values, float))
    if len(values) < 9:
        return []
    if frequency_hz is None:
        frequency_hz = dominant_frequency(time_s, values)
    if not np.isfinite(frequency_hz) or np.ptp(values) == 0.0:
        return []
    origin = float(0.5 * (time_s[0] + time_s[-1]))
    harmonics = _most_harmonics(time_s, frequency_hz)
    record = compressed(time_s - origin, values, frequency_hz, harmonics)
    return [fit_record(record, frequency_hz, harmonics, each)._replace(origin_s=origin)
            for each in grows]


def fit_record(record: Record, frequency_hz: float, most: int, grows: bool) -> HarmonicFit:
    """Return the oscillation in a record, with up to `most` harmonics; times as in the record."""
    most_drift = int(np.clip(frequency_hz * record.span_s, 0, min(10, record.samples // 5)))
    start = np.array([frequency_hz, 0.0, 0.0])
    drift = record.drift(_choose_drift(record.first(1), start, grows, most_drift))
    harmonics = _choose_harmonics(record, drift, start, grows, most)
    solution = _solve(record, drift, start, harmonics, grows)
    return _result(record, solution, drift.shape[1], harmonics, grows)


def _result(record: Record, solution: _Solution, drift: int, harmonics: int, grows: bool
            ) -> HarmonicFit:
    nonlinear = 3 if grows else 1
    frequency, rate, sweep = map(float, solution.nonlinear)
    freedom = max(record.samples - solution.columns.shape[1] - nonlinear, 1)
    jacobian = np.hstack([_slopes(record, solution, drift, grows), solution.columns])
    variance, local_freedom = _local_noise(record, solution, freedom)
    # Scaled columns, for a well-conditioned inverse.
    sizes = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
    spread = np.linalg.pinv(triangle(jacobian / sizes)) / sizes[:, None]
    covariance = variance * spread @ spread.T

    amplitudes = _amplitudes(solution, drift)
    sizes = np.abs(amplitudes)
    at_cosine, at_sine = nonlinear + drift, nonlinear + drift + harmonics
    pair = np.ix_([at_cosine, at_sine], [at_cosine, at_sine])
    direction = np.array([amplitudes[0].real, -amplitudes[0].imag]) / max(sizes[0], 1e-300)
    deviations = np.sqrt(np.diag(covariance))
    # Without the power expected from noise, which would bias the THD.
    power = np.array([max(sizes[h] ** 2 - covariance[at_cosine + h, at_cosine + h]
                          - covariance[at_sine + h, at_sine + h], 0.0)
                      for h in range(1, harmonics)])
    return HarmonicFit(
        origin_s=0.0, span_s=record.span_s,
        frequency_hz=frequency, frequency_sd_hz=float(deviations[0]),
        amplitude=float(sizes[0]),
        amplitude_sd=float(np.sqrt(direction @ covariance[pair] @ direction)),
        rate=rate, rate_sd=float(deviations[1]) if grows else 0.0, sweep=sweep,
        harmonics=amplitudes, thd=float(np.sqrt(power.sum()) / max(sizes[0], 1e-300)),
        drift=solution.coefficients[:drift], noise=float(np.sqrt(solution.squares / freedom)),
        cycles=frequency * record.span_s * record.samples / (record.samples - 1),
        freedom=local_freedom)
