"""
The conditions of the experiments, which the paper gives only in part.

What it does not give (loads, steps, gains of the lead compensators) is chosen here, once, and
stated with each row.
"""

from collections.abc import Mapping
from typing import Final, NamedTuple

from asi_common.parameter import Value, defaults
from asi_controller.parameters import COMPENSATOR_PARAMETERS

LOCKED: Final[Mapping[str, Value]] = {'load.type': 'locked'}
SPRING: Final[Mapping[str, Value]] = {'load.type': 'spring'}


class StepTest(NamedTuple):
    """A step of the desired force (N), what controls it, and what the piston pushes against."""

    controller: Mapping[str, Value]
    amplitude_n: float
    load: Mapping[str, Value]


class Conditions(NamedTuple):
    """Everything about the experiments that is not the actuator."""

    proportional: StepTest = StepTest(
        {'compensator': 'proportional', 'gain': 3.0}, 582.1,
        {**SPRING, 'load.mass': 6.0, 'load.stiffness': 26690.0,
         'load.damping': 1.0})
    lead_lag: StepTest = StepTest(
        {'compensator': 'lead_lag', 'gain': 26.6,
         'lead_lag.centre_frequency': 94.03}, 693.3, LOCKED)
    # The paper's lag of 0.5 s is that of the single lead; here it settles in the time of Table 1.
    lead4: StepTest = StepTest(
        {'compensator': 'lead4', 'gain': 3.389, 'lead4.zero_frequency': 120.4,
         'lead4.ratio': 1.973, 'lead4.lag_ratio': 108.2,
         'lead4.lag_time': 0.1257}, 266.9, LOCKED)
    feedforward: float = float(defaults(COMPENSATOR_PARAMETERS)['feedforward'])
    # Section 3.1 gives 0 to 600 N. A step of 0 N starts nothing: a step back from 100 N does.
    start_n: float = 100.0
    onset_steps_n: tuple[float, ...] = (0.0, 100.0, 200.0, 300.0, 400.0, 500.0, 600.0)
    onset_accuracy: float = 0.003
    # Fig. 6: a step of this size, at this multiple of the onset gain.
    cycle_step_n: float = 100.0
    cycle_gain: float = 1.1
    open_loop_amplitude_n: float = 300.0
    small_amplitude_n: float = 50.0
    # The largest sine that the actuator can follow: 90 % of its thrust.
    large_amplitude_n: float = 900.0
