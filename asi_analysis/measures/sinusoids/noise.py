"""
Coloured noise: autoregressive models, their description length, surrogates.

The description length (Schwarz, Annals of Statistics 6, 1978) distinguishes an oscillation from
noise with a sharp resonance, which looks like one in time and in the periodogram.
"""

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
from scipy import signal

from asi_analysis.arrays import Array

# Rows that are factored at a time.
BLOCK: Final = 8192
# Least ratio of pivots for which the products of lags are accurate enough.
LEAST_PIVOT: Final = 1e-4
ORDERS: Final = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24)


class Autoregression(NamedTuple):
    """values[k] = coefficients . values[k-1, k-2, ...] + innovation, of standard `deviation`."""

    coefficients: Array
    deviation: float
    description: float   # length: n ln(variance) + ln(n) per parameter; less is better


def triangle(rows: Array) -> Array:
    """
    Return the factor R of the QR decomposition of a tall matrix.

    Block by block, to limit the memory.
    """
    blocks = np.array_split(rows, max(1, len(rows) // BLOCK))
    return np.asarray(np.linalg.qr(np.vstack([np.asarray(np.linalg.qr(block, mode='r'))
                                              for block in blocks]), mode='r'))


def autoregression(values: Array, parameters: int = 0) -> Autoregression:
    """
    Return the autoregressive model of evenly sampled values with the least description length.

    parameters: number of those already fitted to the record, which count for the description.
    """
    n = len(values)
    best: Autoregression | None = None
    most = max(order for order in ORDERS if order <= n // 5)
    # Columns: the sample, then those before it. All orders share the factor of their common rows;
    # each has a few more rows.
    rows = np.lib.stride_tricks.sliding_window_view(
        np.concatenate([np.zeros(most), values]), most + 1)[:, ::-1]
    shared = _triangle_of_lags(values, most) if n > BLOCK else None
    if shared is None:
        shared = triangle(rows[most:])
    for order in [order for order in ORDERS if order <= most]:
        stacked = np.vstack([rows[order:most], shared])[:, :order + 1]
        coefficients = np.linalg.lstsq(stacked[:, 1:], stacked[:, 0],
                                       rcond=n * np.finfo(float).eps)[0]
        innovation = stacked[:, 0] - stacked[:, 1:] @ coefficients
        variance = float(innovation @ innovation) / max(n - 2 * order, 1)
        # For n samples in each order, so that orders are comparable.
        description = (n * np.log(max(variance, 1e-300))
                       + (order + 1 + parameters) * np.log(n))
        if best is None or description < best.description:
            best = Autoregression(coefficients, float(np.sqrt(variance)), description)
    assert best is not None
    return best


def _triangle_of_lags(values: Array, most: int) -> Array | None:
    """
    Return the factor R of the samples and the `most` before each; None if it would be inaccurate.

    From products of lags, which is much faster than from the rows, but squares the condition
    number.
    """
    n = len(values)
    gram = np.empty((most + 1, most + 1))
    gram[0] = gram[:, 0] = [values[most:] @ values[most - lag:n - lag] for lag in range(most + 1)]
    first, last = values[most - 1::-1], values[:n - most - 1:-1]
    for row in range(most):
        gram[row + 1, 1:] = gram[row, :-1] + first[row] * first - last[row] * last
    try:
        factor = np.linalg.cholesky(gram).T
    except np.linalg.LinAlgError:
        return None
    pivots = np.diag(factor)
    return np.asarray(factor) if pivots.min() > LEAST_PIVOT * pivots.max() else None


def stable(model: Autoregression) -> Autoregression:
    """Return the model with its roots inside the unit circle, by reflection."""
    if not len(model.coefficients):
        return model
    roots = np.roots(np.concatenate([[1.0], -model.coefficients]))
    size = np.abs(roots)
    roots = np.where(size >= 1.0, roots / np.maximum(size, 1e-12) ** 2, roots)
    roots = np.where(np.abs(roots) > 0.9995, roots / np.abs(roots) * 0.9995, roots)
    return model._replace(coefficients=-np.real(np.poly(roots))[1:])


def surrogates(model: Autoregression, shape: tuple[int, int], count: int, seed: int
               ) -> Iterator[Array]:
    """Yield `count` arrays (windows x samples) of Gaussian noise with the model's spectrum."""
    model = stable(model)
    windows, samples = shape
    random = np.random.default_rng(seed)
    denominator = np.concatenate([[1.0], -model.coefficients])
    roots = np.roots(denominator)
    settle = int(8.0 / (1.0 - np.abs(roots).max())) if len(roots) else 0
    for _ in range(count):
        innovations = random.standard_normal((windows, samples + settle))
        yield signal.lfilter([1.0], denominator, innovations)[:, settle:]
