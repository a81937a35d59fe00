"""
Noise with a spectrum of its own: autoregressive models, their description length, surrogates.

An oscillation is believed only if it shortens the description of the record beyond what coloured
noise does (Schwarz, Annals of Statistics 6, 1978); a noise with a sharp resonance looks like an
oscillation to the eye and to the periodogram, but not to this comparison.
"""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import signal

Array = npt.NDArray[np.float64]

ORDERS: Final = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24)


class Autoregression(NamedTuple):
    """values[k] = coefficients . values[k-1, k-2, ...] + innovation of deviation `deviation`."""

    coefficients: Array
    deviation: float
    description: float   # n ln(variance) + ln(n) per parameter: less is better


def autoregression(values: Array, parameters: int = 0) -> Autoregression:
    """
    Return the autoregressive model of shortest description for evenly sampled `values`.

    parameters: how many have been fitted already to what was taken off, for the description.
    """
    n = len(values)
    best: Autoregression | None = None
    lags = np.column_stack([np.concatenate([np.zeros(k), values[:n - k]])
                            for k in range(1, max(ORDERS) + 1) if k < n])
    for order in ORDERS:
        if order > n // 5:
            break
        coefficients = np.linalg.lstsq(lags[order:, :order], values[order:], rcond=None)[0]
        innovation = values[order:] - lags[order:, :order] @ coefficients
        variance = float(innovation @ innovation) / max(n - 2 * order, 1)
        # As if each of the n samples had been predicted, so that orders can be compared.
        description = (n * np.log(max(variance, 1e-300))
                       + (order + 1 + parameters) * np.log(n))
        if best is None or description < best.description:
            best = Autoregression(coefficients, float(np.sqrt(variance)), description)
    assert best is not None
    return best


def stable(model: Autoregression) -> Autoregression:
    """Return the model with roots on or outside the unit circle moved inside, by reflection."""
    if not len(model.coefficients):
        return model
    roots = np.roots(np.concatenate([[1.0], -model.coefficients]))
    size = np.abs(roots)
    roots = np.where(size >= 1.0, roots / np.maximum(size, 1e-12) ** 2, roots)
    roots = np.where(np.abs(roots) > 0.9995, roots / np.abs(roots) * 0.9995, roots)
    return model._replace(coefficients=-np.real(np.poly(roots))[1:])


def surrogates(model: Autoregression, samples: int, count: int, seed: int) -> Array:
    """Return `count` records (count x samples) of Gaussian noise with the model's spectrum."""
    model = stable(model)
    random = np.random.default_rng(seed)
    roots = np.roots(np.concatenate([[1.0], -model.coefficients]))
    settle = int(8.0 / (1.0 - np.abs(roots).max())) if len(roots) else 0
    innovations = random.standard_normal((count, samples + settle))
    denominator = np.concatenate([[1.0], -model.coefficients])
    return signal.lfilter([1.0], denominator, innovations, axis=1)[:, settle:]
