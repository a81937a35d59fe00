"""F8: onset of the cycle against the input (Fig. 7): 95 Hz falls to 75 Hz, the gain rises."""

from asi_analysis.paper.facts.conditions import Conditions
from asi_analysis.paper.facts.fact import INFINITE, Fact, Measured, Role, Row, Setup, Stage
from asi_analysis.paper.facts.measures import (
    onset_frequencies,
    onset_gains,
    onset_name,
    onset_notes,
    onset_rise,
)
from asi_analysis.paper.facts.words import locked_loop


def _row(step_n: float) -> Row:
    # A straight line between the two frequencies that section 3.1 gives.
    published = 95.0 - 20.0 * step_n / 600.0
    return Row(onset_name(step_n, 'frequency_hz'), f'cycle frequency at onset, {step_n:.0f} N',
               '3.1, Fig. 7', published, 'Hz', published - 3.0, published + 3.0,
               Role.HELD_OUT if step_n in (400.0, 500.0) else Role.FITTED)


def measure(setup: Setup) -> Measured:
    onset_gains(setup, setup.conditions.onset_steps_n)
    return {**onset_rise(setup), **onset_frequencies(setup)}


FACT = Fact(
    'F8',
    (*(_row(step_n) for step_n in Conditions().onset_steps_n),
     Row('onset_least_rise_percent', 'least rise of the onset gain from step to step',
         '3.1, Fig. 7', 0.0, '%', 0.0, INFINITE),
     Row('onset_rise_percent', 'rise of the onset gain from 0 to 600 N', '3.1, Fig. 7', 8.0, '%',
         8.0, INFINITE)),
    measure,
    lambda setup: (f'{locked_loop(setup)}; steps from rest; to 0 N, a step back from '
                   f'{setup.conditions.start_n:g} N'),
    f'least gain with a sustained cycle, by bisection to '
    f'{100.0 * Conditions().onset_accuracy:g} %', Stage.ONSET, over_ros=onset_frequencies,
    notes=onset_notes)
