"""
Bounded least squares: the Levenberg-Marquardt method with each step solved within the bounds.

In each step all parameters may leave their bounds. scipy's dogbox and trf ended with up to six
times the cost, since they hold parameters at a bound or move along it slowly.
"""

from collections.abc import Callable

import numpy as np
from scipy.optimize import lsq_linear

from asi_analysis.arrays import Array

LONGEST_STEP = 0.3    # step, as a share of the way between bounds
TRIES = 5        # of a step, with more damping each


def least_step(square: Array, slope: Array, low: Array, high: Array) -> tuple[Array, float]:
    """
    Return the step within bounds that lowers a quadratic cost most, and by how much it does.

    The cost is 0.5 step' square step + slope' step.
    """
    size = np.sqrt(np.diag(square)) + 1e-30
    # The same problem by its triangle: |triangle step + right| up to a constant.
    triangle = np.linalg.cholesky(square / np.outer(size, size) + 1e-9 * np.eye(size.size)).T
    right = -np.linalg.solve(triangle.T, slope / size)
    solution = lsq_linear(triangle, right, (low * size - 1e-12, high * size + 1e-12), 'bvls',
                          max_iter=20 * size.size)
    return solution.x / size, 0.5 * float(right @ right) - float(solution.cost)


def minimise(residual: Callable[[Array], Array], jacobian: Callable[[Array], Array], start: Array,
             prior_weight: float, rounds: int, tolerance: float) -> tuple[Array, float]:
    """
    Return parameters, each from 0 to 1, with the least squares, and their cost: half the sum.

    prior_weight: of a prior about the start, which keeps the problem regular when parameters
    have the same effect; rounds: at most; tolerance: relative gain of the last round.
    """
    def cost_of(theta: Array, value: Array) -> float:
        distance = float(np.sum((theta - start) ** 2))
        return 0.5 * float(value @ value) + 0.5 * prior_weight ** 2 * distance

    theta, value = start, residual(start)
    cost, damping = cost_of(theta, value), 1e-4
    for _ in range(rounds):
        slopes = jacobian(theta)
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
