"""F10: with the gain, the predicted frequency falls and the amplitude rises."""

from asi_analysis.paper.facts.fact import INFINITE, Fact, Measured, Row, Setup, Stage
from asi_analysis.paper.facts.measures import predict_cycle
from asi_analysis.paper.facts.words import PREDICTION


def measure(setup: Setup) -> Measured:
    # F9 has measured the same.
    known = setup.measured if 'predicted_monotone' in setup.measured else predict_cycle(setup)
    return {row.name: known[row.name] for row in FACT.rows}


FACT = Fact(
    'F10',
    (Row('predicted_frequency_fall_percent', 'fall of that frequency to Kp = 15', '4.1', 10.0,
         '%', 10.0, INFINITE),
     Row('predicted_highest_gain', 'gain up to which a stable cycle is predicted', '4.1', 15.0,
         'N/N', 15.0, INFINITE),
     Row('predicted_monotone', 'frequency falls and amplitude rises all the way', '4.1', 1.0, '',
         1.0, 1.0)),
    measure, lambda _: 'as section 4.1, gains up to 15', PREDICTION, Stage.PREDICTION)
