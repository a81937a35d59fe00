"""
Bounded least squares: the Levenberg-Marquardt method with each step solved within the bounds.

In each step any parameter may leave its bound again. scipy's dogbox and trf ended with up to six
times the cost, since they hold parameters at a bound or move away from it slowly.
"""

from collections.abc import Callable

import numpy as np
from scipy.optimize import lsq_linear

from asi_analysis.arrays import Array

LONGEST_STEP = 0.3   # as a share of a parameter's range
TRIES = 5            # of a step, each with more damping


def least_step(square: Array, slope: Array, low: Array, high: Array) -> tuple[Array, float]:
    """
    Return the step within bounds that minimises a quadratic cost, and by how much it lowers it.

    The cost is 0.5 step' square step + slope' step.
    """
    size = np.sqrt(np.diag(square)) + 1e-30
    # By Cholesky factorisation, the same as the least squares of `triangle step - right`.
    triangle = np.linalg.cholesky(square / np.outer(size, size) + 1e-9 * np.eye(size.size)).T
    right = -np.linalg.solve(triangle.T, slope / size)
    solution = lsq_linear(triangle, right, (low * size - 1e-12, high * size + 1e-12), 'bvls',
                          max_iter=20 * size.size)
    # The slack of the bounds would be a huge step of a parameter that nothing depends on.
    return (np.clip(solution.x / size, low, high),
            0.5 * float(right @ right) - float(solution.cost))


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
