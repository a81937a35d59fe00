"""
Least squares within bounds: Levenberg and Marquardt's method, each step solved within the bounds.

Parameters that rest on a bound may leave it again in any step, all together, which trust-region
methods that freeze them (dogbox) or creep along them (trf) were seen to miss by a factor of six in
the cost. The steps are small problems of as many unknowns as there are parameters.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import lsq_linear

Array = npt.NDArray[np.floating[Any]]

LONGEST = 0.3    # step, as a share of the way between bounds
TRIES = 5        # of a step, each more careful than the last


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
             pull: float, rounds: int, tolerance: float) -> tuple[Array, float]:
    """
    Return parameters, each from 0 to 1, with the least squares, and their cost: half the sum.

    pull: weight of a prior about the start, so that parameters which do the same do not make it
    singular; rounds: at most; tolerance: relative gain of a round below which it ends.
    """
    def cost_of(theta: Array, left: Array) -> float:
        return 0.5 * float(left @ left) + 0.5 * pull ** 2 * float(np.sum((theta - start) ** 2))

    theta, left = start, residual(start)
    cost, careful = cost_of(theta, left), 1e-4
    for _ in range(rounds):
        slopes = jacobian(theta)
        square = slopes.T @ slopes + pull ** 2 * np.eye(theta.size)
        slope = slopes.T @ left + pull ** 2 * (theta - start)
        before = cost
        for _ in range(TRIES):
            step, _ = least_step(square + careful * np.diag(np.diag(square)), slope,
                                 np.maximum(-theta, -LONGEST), np.minimum(1.0 - theta, LONGEST))
            there = np.clip(theta + step, 0.0, 1.0)
            left_there = residual(there)
            if (cost_there := cost_of(there, left_there)) < cost:
                theta, left, cost = there, left_there, cost_there
                careful = max(0.1 * careful, 1e-7)
                break
            careful = 10.0 * max(careful, 1e-3)
        if before - cost <= tolerance * before:
            break
    return theta, cost
