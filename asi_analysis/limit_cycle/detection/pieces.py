"""
The descriptions of a stretch of a record: noise, one oscillation, or pieces of both.

The description of least length is chosen (Schwarz, Annals of Statistics 6, 1978).
"""

from typing import Any, Final, NamedTuple

import numpy as np
from scipy import stats

from asi_analysis.arrays import Array
from asi_analysis.limit_cycle.detection import envelope as env
from asi_analysis.limit_cycle.detection import segments as seg
from asi_analysis.measures.sinusoids.noise import Autoregression, autoregression
from asi_analysis.measures.sinusoids.sinusoid import HarmonicFit, analytic_signal, fits, on_grid

FEWEST_CYCLES: Final = 3.0
# Gain in description length (-2 ln likelihood) that an oscillation needs: prior odds of 1 to 20.
DESCRIPTION_MARGIN: Final = 6.0
# Noise floor relative to the signal, assumed for cleaner recordings (50 dB).
NOISE_FLOOR_SHARE: Final = 10.0 ** (-2.5)
# Above this THD the oscillation is at another frequency.
MOST_THD: Final = 3.0
# The highest line may be this harmonic; deviations by which a line is above the noise.
SUBHARMONICS: Final = (2, 3)
LINE: Final = 5.0
# A line in the residual is named if its power is this multiple of the median of so many lines on
# either side, and its size this share of the fundamental.
HIGH_LINE: Final = 40.0
BESIDE: Final = 20
LEAST_LINE: Final = 0.02


class Piece(NamedTuple):
    time_s: Array
    values: Array
    frequency_hz: float            # initial guess
    kind: str                      # 'noise' or 'line'
    steady: HarmonicFit | None     # fitted at constant amplitude
    moving: HarmonicFit | None     # fitted with a growth rate
    description: float
    noise: Autoregression


def pieces_of(t: Array, y: Array, frequency: float) -> list[Piece]:
    """Return the shortest description of a signal: noise, one oscillation, or pieces."""
    noise_floor = NOISE_FLOOR_SHARE * float(np.std(y))
    whole = described(t, y, frequency, noise_floor)
    cuts = seg.envelope_cuts(env.envelope(t, y, frequency))
    if not cuts:
        return [whole]
    edges = np.searchsorted(t, [-np.inf, *cuts, np.inf])
    pieces = [described(t[a:b], y[a:b], frequency, noise_floor)
              for a, b in zip(edges[:-1], edges[1:], strict=True)]
    penalty = len(cuts) * np.log(len(y))
    if sum(piece.description for piece in pieces) + penalty < whole.description:
        return pieces
    return [whole]


def described(t: Array, y: Array, frequency: float, noise_floor: float) -> Piece:
    """
    Return a piece as noise or as an oscillation, whichever has the shorter description.

    The highest line may be the second or third harmonic: the half and the third of its frequency
    are fundamentals if that is shorter.
    """
    best = _described_at(t, y, frequency, noise_floor, MOST_THD)
    if best.steady is None:
        return best
    line, residual = best.steady.frequency_hz, y - best.steady.at(t)
    least = LINE * float(np.std(residual)) * np.sqrt(2.0 / len(t))
    for divisor in SUBHARMONICS:
        fundamental = line / divisor
        size = 2.0 / len(t) * abs(residual @ np.exp(-2j * np.pi * fundamental * t))
        if size < least or fundamental * (t[-1] - t[0]) < FEWEST_CYCLES:
            continue
        # The harmonic that was the highest line may be much larger than the fundamental.
        other = _described_at(t, y, fundamental, noise_floor, np.inf)
        if (other.steady is not None and other.kind == 'line'
                and abs(other.steady.frequency_hz - fundamental) < 0.5 / (t[-1] - t[0])
                and other.steady.amplitude > LINE * other.steady.amplitude_sd
                and other.description < best.description - DESCRIPTION_MARGIN):
            best = other
    return best


def remaining_line(piece: Piece) -> str:
    """Return which line the residual of an oscillation has, if it is far above the noise."""
    if piece.steady is None:
        return ''
    even, period = on_grid(piece.time_s, piece.values - piece.steady.at(piece.time_s))
    count = len(even)
    power = np.abs(np.fft.rfft((even - even.mean()) * np.hanning(count))) ** 2
    power[:2] = 0.0
    # Beside the fundamental and its harmonics a slow change of the amplitude leaves lines.
    order = np.fft.rfftfreq(count, period) / piece.steady.frequency_hz
    power[np.abs(order - np.round(order)) * piece.steady.cycles < 4.0] = 0.0
    peak = int(np.argmax(power))
    near = power[max(peak - BESIDE, 0):peak + BESIDE + 1]
    near = near[near > 0.0]
    if len(near) < BESIDE or power[peak] < HIGH_LINE * np.median(near):
        return ''
    size = 4.0 * np.sqrt(power[peak]) / count   # of a Hann window
    if size < LEAST_LINE * piece.steady.amplitude:
        return ''
    return f'; beside it a line of {peak / (count * period):.4g} Hz with {size:.3g}'


def _described_at(t: Array, y: Array, frequency: float, noise_floor: float, most_thd: float
                  ) -> Piece:
    """Return a piece as noise or as an oscillation of a fundamental frequency."""
    added = noise_floor * np.random.default_rng(len(y)).standard_normal(len(y))

    def describe(residual: Array, parameters: int) -> Autoregression:
        return autoregression(on_grid(t, residual + added)[0], parameters)

    drift = np.polynomial.polynomial.Polynomial.fit(t, y, 1)(t)
    best = describe(y - drift, 2)
    kind = 'noise'
    steady, moving = fits(t, y, frequency) or (None, None)
    for oscillation, nonlinear in ((steady, 1), (moving, 3)):
        if oscillation is None or oscillation.cycles < 0.8 * FEWEST_CYCLES:
            continue
        if oscillation.thd > most_thd:
            continue
        # One parameter more, as the frequency was searched among as many as there are samples.
        parameters = len(oscillation.drift) + 2 * len(oscillation.harmonics) + nonlinear + 1
        noise = describe(y - oscillation.at(t), parameters)
        if noise.description < best.description - (DESCRIPTION_MARGIN if kind == 'noise' else 0.0):
            kind, best = 'line', noise
    if steady and moving and steady.cycles < 0.8 * FEWEST_CYCLES:
        steady = moving   # fast decay: the fit of constant amplitude is at a wrong frequency
    return Piece(t, y, frequency, kind, steady, moving, best.description, best)


def figures_of(piece: Piece) -> dict[str, Any]:
    """Return the figures of a segment that is an oscillation."""
    steady, moving = piece.steady, piece.moving
    assert steady is not None and moving is not None
    mean = piece.values.mean()
    peaks = env.peaks_by_cycle(piece.time_s, piece.values - mean, steady.frequency_hz)
    return {
        'frequency_hz': steady.frequency_hz,
        'frequency_interval_hz': steady.interval('frequency_hz'),
        'amplitude': steady.amplitude, 'amplitude_interval': steady.interval('amplitude'),
        'thd': steady.thd, 'harmonics': tuple(map(complex, steady.harmonics)),
        'mean': steady.mean, 'cycles': steady.cycles,
        'envelope_rate_1_s': moving.rate, 'envelope_rate_interval_1_s': moving.interval('rate'),
        'return_map_slope': env.return_map_slope(peaks),
        'orbit_closure': env.orbit_closure(piece.time_s, piece.values, steady.frequency_hz)}


def cycle_figures(piece: Piece, frequency: float) -> dict[str, Any]:
    """Return frequency and amplitude with intervals from the scatter of the cycles."""
    even, period = on_grid(piece.time_s, piece.values)
    analytic = analytic_signal(even, period, frequency)
    size = max(int(round(1.0 / (frequency * period))), 1)
    phase = np.unwrap(np.angle(analytic))[size:-size:size] / (2.0 * np.pi)
    amplitude = np.abs(analytic)[size:-size:size]
    if len(phase) < 4:
        return {}
    advance = np.diff(phase) / (size * period)
    half = stats.t.ppf(0.975, len(advance) - 1) / np.sqrt(len(advance))
    centre, spread = float(advance.mean()), float(advance.std(ddof=1) * half)
    size_mean = float(amplitude.mean())
    size_spread = float(amplitude.std(ddof=1) * half)
    return {'frequency_hz': centre, 'frequency_interval_hz': (centre - spread, centre + spread),
            'amplitude': size_mean,
            'amplitude_interval': (size_mean - size_spread, size_mean + size_spread)}
