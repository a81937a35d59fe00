"""
Bounded least squares: the Levenberg-Marquardt method with each step solved within the bounds.

In each step any parameter may leave its bound again. scipy's dogbox and trf ended with up to six
times the cost, since they hold parameters at a bound or move away from it slowly.
"""

import math
from collections.abc import Callable

import numpy as np
from scipy.optimize import lsq_linear

from asi_analysis.arrays import Array
from asi_common.jit import jit

LONGEST_STEP = 0.3   # as a share of a parameter's range
TRIES = 5            # of a step, each with more damping
ACTIVE_SETS = 12     # that are tried: nearly always less than half of them are enough


def least_step(square: Array, slope: Array, low: Array, high: Array) -> tuple[Array, float]:
    """
    Return the step within bounds that minimises a quadratic cost, and by how much it lowers it.

    The cost is 0.5 step' square step + slope' step. If that is not finite, as of an impossible
    plant, there is no step, and it lowers nothing.
    """
    if not (np.isfinite(square).all() and np.isfinite(slope).all()):
        return np.zeros_like(slope), -math.inf
    size = np.sqrt(np.diag(square)) + 1e-30
    scaled = square / np.outer(size, size) + 1e-9 * np.eye(size.size)
    bounds = low * size - 1e-12, high * size + 1e-12
    step, ends = _by_active_sets(scaled, slope / size, *bounds)
    if not ends:
        # By Cholesky factorisation, the same as the least squares of `triangle step - right`.
        triangle = np.linalg.cholesky(scaled).T
        step = lsq_linear(triangle, -np.linalg.solve(triangle.T, slope / size), bounds, 'bvls',
                          max_iter=20 * size.size).x
    gain = -float(step @ (slope / size + 0.5 * scaled @ step))
    # The slack of the bounds would be a huge step of a parameter that nothing depends on.
    return np.clip(step / size, low, high), gain


@jit
def _by_active_sets(square, slope, low, high):
    """
    Return the step of `least_step`, and whether it was found.

    Each round holds all that is beyond its bound and frees all that does not press on it
    (Hintermueller, Ito, Kunisch, SIAM J. Optim. 13, 2002): rarely it comes back to a set.
    """
    held = np.zeros(slope.size)   # at its low bound: -1, at its high one: 1
    step = np.zeros(slope.size)
    for _ in range(ACTIVE_SETS):
        free = held == 0.0
        step = np.where(held < 0.0, low, np.where(held > 0.0, high, 0.0))
        push = -(slope + square @ step)
        if free.any():
            step[free] = np.linalg.solve(square[free][:, free], push[free])
            push = -(slope + square @ step)
        before = held
        held = np.where((step < low) | ((before < 0.0) & (push < 0.0)), -1.0, np.where(
            (step > high) | ((before > 0.0) & (push > 0.0)), 1.0, 0.0))
        if (held == before).all():
            return step, True
    return step, False


def minimise(residual: Callable[[Array], Array], jacobian: Callable[[Array, Array], Array],
             start: Array, prior_weight: float, rounds: int, tolerance: float
             ) -> tuple[Array, float]:
    """
    Return parameters (each from 0 to 1) of least squares, and their cost: half the sum of squares.

    jacobian: of parameters and their residual; prior_weight: of the deviation from the start
    (Tikhonov regularisation), for parameters that are not identifiable apart; rounds: the most;
    tolerance: relative gain that ends the rounds.
    """
    def cost_of(theta: Array, value: Array) -> float:
        distance = float(np.sum((theta - start) ** 2))
        return 0.5 * float(value @ value) + 0.5 * prior_weight ** 2 * distance

    theta, value = start, residual(start)
    cost, damping = cost_of(theta, value), 1e-4
    for _ in range(rounds):
        slopes = jacobian(theta, value)
        square = slopes.T @ slopes + prior_weight ** 2 * np.eye(theta.size)
        slope = slopes.T @ value + prior_weight ** 2 * (theta - start)
        before = cost
        for _ in range(TRIES):
            step, _ = least_step(
                square + damping * np.diag(np.diag(square)), slope,
                np.maximum(-theta, -LONGEST_STEP), np.minimum(1.0 - theta, LONGEST_STEP))
            there = np.clip(theta + step, 0.0, 1.0)
            value_there = residual(there)
            if (cost_there := cost_of(there, value_there)) < cost:
                theta, value, cost = there, value_there, cost_there
                damping = max(0.1 * damping, 1e-7)
                break
            damping = 10.0 * max(damping, 1e-3)
        if before - cost <= tolerance * before:
            break
    return theta, cost
