"""
Surrogate tests: how a motion differs from noise with the same spectrum.

Its envelope is steadier if it is a cycle. Its slope is more often near zero or steep if a valve
rests and slips, however irregularly. The surrogates are Gaussian noise of that spectrum (Theiler
et al., Physica D 58, 1992).
"""

from typing import Final, NamedTuple

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.limit_cycle.detection.resolution import quantisation
from asi_analysis.measures.sinusoids.noise import autoregression, surrogates
from asi_analysis.measures.sinusoids.sinusoid import analytic_signal, on_grid

SURROGATES: Final = 200
FIRST: Final = 40
CLEARLY_NOISE: Final = 1.5
# Time over which the slope is taken, in cycles.
SLOPE: Final = 0.1
# Samples that are compared with surrogates; in a longer record in WINDOWS windows.
COMPARED: Final = 8192
WINDOWS: Final = 4


class Difference(NamedTuple):
    """
    How a motion differs from the surrogates, in their standard deviations.

    steadier: of the envelope; irregular: how much more the motion jumps, or its envelope varies.
    """

    steadier: float
    irregular: float


def difference(t: Array, y: Array, frequency: float) -> Difference:
    """
    Return how a motion differs from the surrogates.

    FIRST of them suffice where it is clearly noise. The surrogates are rounded like the record.
    White noise of any distribution is noise: `irregular` is 0.
    """
    even, period = on_grid(t, y)
    model = autoregression(even - even.mean(), 1)
    step, offset = quantisation(even), even.mean() - even[0]
    windows = _windows(even)
    skip = min(int(0.5 / (frequency * period)), windows.shape[1] // 8)
    hop = max(1, round(SLOPE / (frequency * period)))
    coloured = len(model.coefficients) > 0
    own = (_evenness(windows, period, frequency, skip),
           _jumps(windows, hop) if coloured else 0.0)
    others: list[tuple[float, float]] = []
    for rows in surrogates(model, windows.shape, SURROGATES, len(even)):
        if step:
            rows = even[0] + np.round((rows + offset) / step) * step
        # Each at its own highest peak, like the record, whose peak can be a random burst.
        others.append((_evenness(rows, period, _highest_peak(rows, period), skip),
                       _jumps(rows, hop) if coloured else 0.0))
        if len(others) == FIRST and max(np.abs(_deviations(own, others))) < CLEARLY_NOISE:
            break
    steadier, jumps = _deviations(own, others)
    return Difference(steadier, max(jumps, -steadier) if coloured else 0.0)


def _deviations(own: tuple[float, float], others: list[tuple[float, float]]) -> list[float]:
    """Return the distances from the means of the others, in their standard deviations."""
    table = np.array(others)
    return list((own - table.mean(0)) / np.maximum(table.std(0), 1e-12))


def _jumps(windows: Array, hop: int) -> float:
    """Return the kurtosis of the steps between samples `hop` apart; large if few are steep."""
    if hop >= windows.shape[1]:
        return 0.0
    steps = windows[:, hop:] - windows[:, :-hop]
    return float(np.mean(steps ** 4) / max(float(np.mean(steps ** 2)), 1e-300) ** 2)


def _windows(even: Array) -> Array:
    """Return windows of a record as rows; a short record as one row."""
    if len(even) <= COMPARED:
        return even[None]
    size = COMPARED // WINDOWS
    starts = np.linspace(0, len(even) - size, WINDOWS).astype(int)
    return even[starts[:, None] + np.arange(size)]


def _evenness(windows: Array, period: float, frequency: float, skip: int) -> float:
    """Return the steadiness of the power about a frequency; skip: samples omitted at each end."""
    inner = slice(skip, windows.shape[1] - skip)
    power = np.abs(analytic_signal(windows, period, frequency)[:, inner]) ** 2
    return -float(np.log(power.var() / power.mean() ** 2))


def _highest_peak(windows: Array, period: float) -> float:
    """Return the frequency (Hz) of the highest peak of the spectrum above 1.5 cycles."""
    centred = windows - windows.mean(1, keepdims=True)
    power = (np.abs(np.fft.rfft(centred)) ** 2).sum(0)
    return float(2 + np.argmax(power[2:])) / (windows.shape[1] * period)
