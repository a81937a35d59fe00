"""
Least squares of a long simulation: the examiner's own, not that of the diagnosis.

A free load drifts, so that over the whole recording a small error of a parameter leaves thousands
of times the noise, and the minimum lies at the end of a narrow valley. Over a short time it does
not. So the beginning is fitted first, then twice as much, until the whole is.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.optimize import lsq_linear

from asi_analysis.arrays import Array

BEGINNINGS = (0.125, 0.25, 0.5, 1.0)   # shares of the recording that are fitted, in this order
STEP = 5e-4         # of the central differences
ROUNDS, TRIES = 8, 6
# Levenberg and Marquardt's damping: at first, the least, and the factor by which it is changed.
DAMPING, LEAST_DAMPING, CHANGE = 1e-6, 1e-9, 10.0
ENOUGH, GAIN = 0.7, 0.01   # shares of the cost: gained by a step that is taken, by the last one


def refitted(missed: Callable[..., Array], count: int, tolerance: float) -> Array:
    """
    Return the factors, within 1 - tolerance and 1 + tolerance, with the least sum of squares.

    missed: gives the residual of `count` factors over a share (`share`) of the recording. By the
    Levenberg-Marquardt method with bounds, from 1.
    """
    factors: Array = np.ones(count)
    for share in BEGINNINGS:
        factors = _least(partial(missed, share=share), factors, tolerance)
    return factors


def _least(missed: Callable[[Array], Array], factors: Array, tolerance: float) -> Array:
    """Return the factors of the least sum of squares, from a start."""
    low, high = 1.0 - tolerance, 1.0 + tolerance
    left, damping = missed(factors), DAMPING
    for _ in range(ROUNDS):
        cost, slopes = float(left @ left), _slopes(missed, factors)
        scale = np.linalg.norm(slopes, axis=0) + 1e-9
        best: tuple[Array, Array, float] | None = None
        for _ in range(TRIES):
            step = lsq_linear(np.vstack([slopes, np.diag(np.sqrt(damping) * scale)]),
                              np.append(-left, np.zeros(factors.size)),
                              (low - factors - 1e-9, high - factors + 1e-9)).x
            there = np.clip(factors + step, low, high)
            tried = missed(there)
            if tried @ tried < (cost if best is None else best[1] @ best[1]):
                best = there, tried, damping
                if tried @ tried < (1.0 - ENOUGH) * cost:
                    break
                damping /= CHANGE
            elif best is not None:
                break
            else:
                damping *= CHANGE
        if best is None:
            break
        factors, left, damping = best
        damping = max(damping / CHANGE, LEAST_DAMPING)
        if left @ left > (1.0 - GAIN) * cost:
            break
    return factors


def _slopes(missed: Callable[[Array], Array], factors: Array) -> Array:
    """Return the Jacobian of the residual, samples by factors."""
    return np.array([(missed(factors + move) - missed(factors - move)) / (2.0 * STEP)
                     for move in STEP * np.eye(factors.size)]).T
