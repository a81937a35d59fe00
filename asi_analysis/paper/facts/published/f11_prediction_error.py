"""F11: the prediction is within a factor of two in frequency and too large in amplitude."""

from asi_analysis.paper.facts.fact import INFINITE, Fact, Row, Stage
from asi_analysis.paper.facts.measures import prediction_error
from asi_analysis.paper.facts.words import locked_loop

FACT = Fact(
    'F11',
    (Row('prediction_frequency_ratio', 'predicted over simulated frequency, worst', '4.2', 1.0,
         '', 0.0, 2.0),
     Row('prediction_amplitude_ratio', 'predicted over simulated amplitude, Kp = 15', '4.2', 1.0,
         '', 1.0, INFINITE),
     Row('undamped_amplitude_ratio', 'simulated amplitude without over with damping, Kp = 15',
         '4.2', 1.0, '', 1.0, INFINITE)),
    prediction_error,
    lambda setup: (f'{locked_loop(setup)}; step of {setup.conditions.cycle_step_n:g} N, gains up '
                   'to 15'),
    'that prediction against simulated cycles; without: damping and friction off', Stage.CYCLE)
