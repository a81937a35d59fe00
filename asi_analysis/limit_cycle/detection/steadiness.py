"""
Surrogate test: whether an envelope is steadier than that of noise with the same spectrum.

The surrogates are Gaussian noise of that spectrum (Theiler et al., Physica D 58, 1992).
"""

from typing import Final

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.measures.sinusoids.noise import autoregression, surrogates
from asi_analysis.measures.sinusoids.sinusoid import analytic_signal, on_grid

SURROGATES: Final = 200
FIRST: Final = 40
CLEARLY_NOISE: Final = 1.5
# Samples that are compared with surrogates; in a longer record in WINDOWS windows.
COMPARED: Final = 8192
WINDOWS: Final = 4


def steadiness(t: Array, y: Array, frequency: float) -> float:
    """
    Return how much steadier the envelope is than those of the surrogates.

    In standard deviations of the surrogates. FIRST of them suffice where it is clearly noise.
    """
    even, period = on_grid(t, y)
    model = autoregression(even - even.mean(), 1)
    windows = _windows(even)
    skip = min(int(0.5 / (frequency * period)), windows.shape[1] // 8)
    own = _evenness(windows, period, frequency, skip)
    others: list[float] = []
    for rows in surrogates(model, windows.shape, SURROGATES, len(even)):
        # Each at its own highest peak, like the record, whose peak can be a random burst.
        others.append(_evenness(rows, period, _highest_peak(rows, period), skip))
        if len(others) == FIRST and _deviation(own, others) < CLEARLY_NOISE:
            break
    return _deviation(own, others)


def _deviation(own: float, others: list[float]) -> float:
    """Return the distance from the mean of the others, in their standard deviations."""
    return (own - float(np.mean(others))) / max(float(np.std(others)), 1e-12)


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
