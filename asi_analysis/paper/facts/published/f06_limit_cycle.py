"""F6: an almost sinusoidal limit cycle of about 90 Hz at high gain."""

from asi_analysis.paper.facts.fact import Fact, Measured, Row, Setup, Stage
from asi_analysis.paper.facts.measures import high_gain_cycle, onset_gain
from asi_analysis.paper.facts.words import high_gain_cycle as conditions


def measure(setup: Setup) -> Measured:
    return high_gain_cycle(setup.actuator, setup.conditions, onset_gain(setup), setup.runner,
                           setup.refinement)


FACT = Fact(
    'F6',
    (Row('cycle_frequency_hz', 'frequency of the cycle at high gain', '3.1, Fig. 6', 90.0, 'Hz',
         86.0, 94.0),
     Row('cycle_thd_percent', 'its harmonic distortion', '3.1, Fig. 6', 0.0, '%', 0.0, 6.0)),
    measure, conditions, 'fundamental and harmonics 2 to 9 over whole periods', Stage.CYCLE,
    over_ros=measure)
