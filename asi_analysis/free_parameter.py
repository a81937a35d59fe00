"""`FreeParameter`: a parameter that a search or fit varies, with bounds, scale and prior."""

import math
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import NamedTuple

import numpy as np

from asi_analysis.arrays import Array


class Scale(Enum):
    """How the range of a parameter is divided: equal differences, or equal ratios."""

    LINEAR = 'linear'
    LOG = 'log'


class FreeParameter(NamedTuple):
    """
    A parameter that a search or a fit may vary.

    nominal, low, high: in the parameter's unit; bounds of a logarithmic scale are above 0.
    prior: standard deviation of a normal prior about the nominal, as a share of the scaled range;
    infinite: no prior. source: of the bounds.

    >>> coil = FreeParameter('coil_frequency', 20.0, 10.0, 40.0, Scale.LOG)
    >>> coil.share(20.0), coil.value(0.5)
    (0.5, 20.0)
    """

    name: str
    nominal: float
    low: float
    high: float
    scale: Scale = Scale.LINEAR
    prior: float = math.inf
    source: str = ''

    def value(self, share: float) -> float:
        """Return the value at a share (0 to 1) of the way from `low` to `high`."""
        if self.scale is Scale.LOG:
            return float(self.low * (self.high / self.low) ** share)
        return float(self.low + (self.high - self.low) * share)

    def share(self, value: float) -> float:
        """Return the inverse of `value`; values outside the bounds are limited to them."""
        value = min(max(value, self.low), self.high)
        if self.scale is Scale.LOG:
            return math.log(value / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)


def to_vector(parameters: Sequence[FreeParameter], values: Mapping[str, float]) -> Array:
    """Return n shares, each 0 to 1, of values by name; of the nominal where there is none."""
    return np.array([each.share(values.get(each.name, each.nominal)) for each in parameters])


def to_values(parameters: Sequence[FreeParameter], vector: Array) -> dict[str, float]:
    """Return the values by name of n shares, which are limited to 0 ... 1."""
    return {each.name: each.value(share)
            for each, share in zip(parameters, np.clip(vector, 0.0, 1.0), strict=True)}
