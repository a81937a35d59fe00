"""
The conditions of the experiments: loads, steps and compensator gains.

The paper gives them only in part. The others are chosen here and stated with each row.
"""

from typing import Final, NamedTuple

from asi_analysis.experiments.step_tests import LOCKED, SPRING, StepTest
from asi_analysis.loop.describing_functions import SAMPLES
from asi_analysis.loop.simulation import FIRST_WATCHED_S
from asi_common.parameter import defaults
from asi_controller.parameters import COMPENSATOR_PARAMETERS

__all__ = ['LOCKED', 'PROPORTIONAL_GAIN', 'SPRING', 'Conditions', 'StepTest']

# Gain of the proportional controller in Table 1 and for the closed-loop bandwidth.
PROPORTIONAL_GAIN: Final = 3.0
# The one load and the one step (N) of Table 1, all three columns: doc/explanation/reproduction.md.
LOAD: Final = {**SPRING, 'load.mass': 0.2391, 'load.stiffness': 3.319e6, 'load.damping': 35.64}
STEP_N: Final = 517.0


class Conditions(NamedTuple):
    """The conditions of all experiments; the actuator's parameters are not among them."""

    proportional: StepTest = StepTest(
        {'compensator': 'proportional', 'gain': PROPORTIONAL_GAIN}, STEP_N, LOAD)
    lead_lag: StepTest = StepTest(
        {'compensator': 'lead_lag', 'gain': 19.62, 'lead_lag.centre_frequency': 100.0}, STEP_N,
        LOAD)
    # Near the setting that suits the locked piston: on this load it leaves no cycle at any step.
    lead4: StepTest = StepTest(
        {'compensator': 'lead4', 'gain': 3.094, 'lead4.zero_frequency': 112.6,
         'lead4.ratio': 2.102, 'lead4.lag_ratio': 91.53, 'lead4.lag_time': 0.134}, STEP_N, LOAD)
    feedforward: float = float(defaults(COMPENSATOR_PARAMETERS)['feedforward'])
    # Section 3.1 gives 0 to 600 N. A step of 0 N excites nothing, so it is a step from 100 N to 0.
    start_n: float = 100.0
    onset_steps_n: tuple[float, ...] = (0.0, 100.0, 200.0, 300.0, 400.0, 500.0, 600.0)
    onset_accuracy: float = 0.0005
    # Relative accuracy of the ratio of an onset without one nonlinearity to that with all.
    ratio_accuracy: float = 0.01
    # Longest simulation to decide whether an oscillation is sustained.
    onset_watched_s: float = 32.0
    # First duration of the simulation, before it is decided whether to continue.
    first_watched_s: float = FIRST_WATCHED_S
    # Highest gain at which an onset is looked for.
    highest_gain: float = 80.0
    # Simulated time at an onset, where a cycle settles slowly, s.
    onset_cycle_s: float = 8.0
    # Samples a period, of the describing function of the hysteresis.
    describing_samples: int = SAMPLES
    # Fig. 6: a step of this size, at this multiple of the onset gain.
    cycle_step_n: float = 100.0
    cycle_gain: float = 1.1
    open_loop_amplitude_n: float = 300.0
    small_amplitude_n: float = 50.0
    # The largest sine that the actuator can follow: 90 % of its thrust.
    large_amplitude_n: float = 900.0
