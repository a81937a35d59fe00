"""F9: the describing function of the hysteresis alone meets the plant at Kp = 8, 130 Hz."""

from asi_analysis.paper.facts.fact import Fact, Stage, around
from asi_analysis.paper.facts.measures import predict_cycle
from asi_analysis.paper.facts.words import PREDICTION

FACT = Fact(
    'F9',
    (around('predicted_onset_gain', 'first intersection of the Nyquist plot, gain',
            '4.1, Fig. 9', 8.0, 'N/N', 0.05),
     around('predicted_onset_frequency_hz', 'first intersection, frequency', '4.1, Fig. 9',
            130.0, 'Hz', 0.05)),
    predict_cycle, lambda _: 'as section 4.1', PREDICTION, Stage.PREDICTION)
