"""The step tests of the paper's Table 1, with our choices where the paper gives no value."""

from collections.abc import Mapping
from typing import Final, NamedTuple

from asi_common.parameter import Value

LOCKED: Final[Mapping[str, Value]] = {'load.type': 'locked'}
SPRING: Final[Mapping[str, Value]] = {'load.type': 'spring'}


class StepTest(NamedTuple):
    """A step of the desired force (N), with its controller and its load."""

    controller: Mapping[str, Value]
    amplitude_n: float
    load: Mapping[str, Value]


PROPORTIONAL: Final = StepTest(
    {'compensator': 'proportional', 'gain': 3.0}, 196.6,
    {**SPRING, 'load.mass': 12.3, 'load.stiffness': 19400.0, 'load.damping': 1.462})
LEAD_LAG: Final = StepTest(
    {'compensator': 'lead_lag', 'gain': 26.6, 'lead_lag.centre_frequency': 94.03}, 693.3, LOCKED)
# The paper's lag of 0.5 s is that of the single lead; here it settles in the time of Table 1.
LEAD4: Final = StepTest(
    {'compensator': 'lead4', 'gain': 3.389, 'lead4.zero_frequency': 120.4, 'lead4.ratio': 1.973,
     'lead4.lag_ratio': 108.2, 'lead4.lag_time': 0.1257}, 266.9, LOCKED)
