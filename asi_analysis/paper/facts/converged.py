"""A measured figure and its change at twice the resolution."""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple


class Converged(NamedTuple):
    """
    A figure at its setting and at twice the resolution, both in the unit of the figure.

    note: a remark on the figure, such as two methods that disagree; often empty.
    """

    value: float
    refined: float
    note: str = ''

    @property
    def change(self) -> float:
        """`refined` minus `value`; 0 if both are the same infinity, NaN if one is missing."""
        return 0.0 if self.value == self.refined else self.refined - self.value

    @property
    def relative_change(self) -> float:
        """The size of the change as a share of the refined figure; infinite against 0."""
        if self.change == 0.0:
            return 0.0
        if not math.isfinite(self.change) or self.refined == 0.0:
            return math.inf
        return abs(self.change / self.refined)


def converged(measure: Callable[[int], Mapping[str, float]]) -> dict[str, Converged]:
    """
    Return each figure of a measurement with its change at twice the resolution.

    measure: takes the refinement (1: nominal, 2: twice as fine) and returns figures by name.
    """
    coarse, fine = measure(1), measure(2)
    return {name: Converged(float(value), float(fine[name])) for name, value in coarse.items()}
