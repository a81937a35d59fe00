"""Whether a machine is within the simulator's own laws, or of other books; its hypotheses then."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.gap.inference.evidence import equal_below
from asi_analysis.gap.inference.posterior import Best, Found, mean_squares, most_probable
from asi_analysis.gap.inference.probability import Names
from asi_analysis.gap.other_books import (
    of_books,
    with_tolerance_of_books,
    with_usual_shapes,
)

# Of the log posterior: farther from the best a fit is not completed, or laws are other ones.
REACH = 50.0
LIGHTER = 8         # times that the weight of the data is halved at most


def judged(found: Mapping[Names, Found]) -> dict[Names, Found]:
    """
    Return hypotheses with the error floor of the simulator's own laws, or of those of other books.

    Of other books is a machine of which the best hypothesis leaves more than the first, or which
    it only explains by other shapes of the laws. A baseline has measured the floor.
    """
    if next(iter(found.values())).problem.group.floor_measured:
        return dict(found)
    best = _of_books(min(found.values(), key=lambda each: each.best.cost), False)
    other = best.left or _needs_other_shapes(best)
    return all_of_books(found, other)


def _of_books(found: Found, other: bool) -> Found:
    """Return a hypothesis with the error floor of the simulator's own laws, or of `other` ones."""
    group = of_books(found.problem.group, other)
    free = with_tolerance_of_books(found.problem.free, found.problem.group, group)
    problem = replace(found.problem, group=group, free=free)
    theta, residual = found.best.theta, problem.residual(found.best.theta)
    return found._replace(problem=problem, best=Best(theta, problem.cost(theta, residual),
                                                     residual))


def all_of_books(found: Mapping[Names, Found], other: bool) -> dict[Names, Found]:
    """Return the hypotheses with that error floor; fitted anew, if it is another than before."""
    moved = {names: _of_books(each, other) for names, each in found.items()}
    if next(iter(found.values())).problem.group.other_books != other:
        moved = {names: each._replace(best=most_probable(each.problem, each.best.theta))
                 for names, each in moved.items()}
    if not other:
        return moved
    best = min(moved.values(), key=lambda each: each.best.cost)
    equal = equal_below(best)
    return {names: _nearest(each, equal) for names, each in moved.items()}


def _nearest(found: Found, equal: Array) -> Found:
    """
    Return a hypothesis with parameters as near to the nominal ones as the model error allows.

    equal: mean squares, in error floors, below which residuals are equal. The weight of the data
    is lowered while less than that is left (the discrepancy principle, Morozov 1966).
    """
    problem, theta = found.problem, found.best.theta
    for _ in range(LIGHTER):
        group = problem.group
        problem = replace(problem, group=replace(group, weight={
            channel: 0.5 * weight for channel, weight in group.weight.items()}))
        near = most_probable(problem, theta)
        if (mean_squares(problem, near.residual) > equal).any():
            break
        theta = near.theta
    residual = found.problem.residual(theta)
    return found._replace(best=Best(theta, found.problem.cost(theta, residual), residual))


def _needs_other_shapes(found: Found) -> bool:
    """Return whether the simulator's own laws, fitted anew, leave far more."""
    group, free = found.problem.group, with_usual_shapes(found.problem.group, found.problem.free)
    if free == found.problem.free:
        return False
    values, problem = found.problem.record(found.best.theta), replace(found.problem, free=free)
    theta = np.array([problem.parameter(each).share(float(
        (values if each in found.problem.free else group.nominal)[each.field])) for each in free])
    goal = found.best.cost + REACH
    return most_probable(problem, theta, goal=goal).cost > goal
