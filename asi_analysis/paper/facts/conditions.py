"""
The conditions of the experiments, which the paper gives only in part.

What it does not give (loads, steps, gains of the lead compensators) is chosen here, once, and
stated with each row.
"""

from typing import Final, NamedTuple

from asi_analysis.experiments.step_tests import LEAD4, LOCKED, SPRING, StepTest
from asi_common.parameter import defaults
from asi_controller.parameters import COMPENSATOR_PARAMETERS

__all__ = ['LOCKED', 'PROPORTIONAL_GAIN', 'SPRING', 'Conditions', 'StepTest']

# Of Table 1 and of the closed-loop bandwidth.
PROPORTIONAL_GAIN: Final = 3.0
# The one load and the one step (N) of Table 1, all three columns: doc/explanation/reproduction.md.
LOAD: Final = {**SPRING, 'load.mass': 0.2579, 'load.stiffness': 3.274e6, 'load.damping': 30.28}
STEP_N: Final = 506.2


class Conditions(NamedTuple):
    """Everything about the experiments that is not the actuator."""

    proportional: StepTest = StepTest(
        {'compensator': 'proportional', 'gain': PROPORTIONAL_GAIN}, STEP_N, LOAD)
    lead_lag: StepTest = StepTest(
        {'compensator': 'lead_lag', 'gain': 18.3, 'lead_lag.centre_frequency': 100.0}, STEP_N,
        LOAD)
    # The setting that suits the locked piston: on this load it leaves no cycle at any step.
    lead4: StepTest = StepTest(LEAD4.controller, STEP_N, LOAD)
    feedforward: float = float(defaults(COMPENSATOR_PARAMETERS)['feedforward'])
    # Section 3.1 gives 0 to 600 N. A step of 0 N starts nothing: a step back from 100 N does.
    start_n: float = 100.0
    onset_steps_n: tuple[float, ...] = (0.0, 100.0, 200.0, 300.0, 400.0, 500.0, 600.0)
    onset_accuracy: float = 0.0005
    # Of an onset without one of the nonlinearities, over the onset with all of them.
    ratio_accuracy: float = 0.01
    # How long a loop is watched to decide whether its oscillation is sustained.
    onset_watched_s: float = 32.0
    # Fig. 6: a step of this size, at this multiple of the onset gain.
    cycle_step_n: float = 100.0
    cycle_gain: float = 1.1
    open_loop_amplitude_n: float = 300.0
    small_amplitude_n: float = 50.0
    # The largest sine that the actuator can follow: 90 % of its thrust.
    large_amplitude_n: float = 900.0
