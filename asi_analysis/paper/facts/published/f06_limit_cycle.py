"""F6: an almost sinusoidal limit cycle of about 90 Hz at high gain."""

from asi_analysis.paper.facts.fact import Fact, Row, Stage
from asi_analysis.paper.facts.measures import high_gain_cycle
from asi_analysis.paper.facts.words import high_gain_cycle as conditions

FACT = Fact(
    'F6',
    (Row('cycle_frequency_hz', 'frequency of the cycle at high gain', '3.1, Fig. 6', 90.0, 'Hz',
         86.0, 94.0),
     Row('cycle_thd_percent', 'its harmonic distortion', '3.1, Fig. 6', 0.0, '%', 0.0, 6.0)),
    high_gain_cycle, conditions, 'fundamental and harmonics 2 to 9 over whole periods',
    Stage.CYCLE, over_ros=high_gain_cycle)
