"""F13: the cycle is due to the hysteresis: without it, there is none near the onset."""

from asi_analysis.paper.facts.fact import INFINITE, Fact, Measured, Role, Row, Setup
from asi_analysis.paper.facts.measures import HIGHEST_RATIO, onset_ratio
from asi_analysis.paper.facts.words import locked_loop


def measure(setup: Setup) -> Measured:
    return {'no_hysteresis_onset_ratio': onset_ratio(
        setup, {'valve_hysteresis.model': 'off'})}


FACT = Fact(
    'F13',
    (Row('no_hysteresis_onset_ratio', 'onset without hysteresis, over onset', '4.2', 1.5, '', 1.5,
         INFINITE, Role.HELD_OUT),),
    measure,
    lambda setup: f'{locked_loop(setup)}; hysteresis off, step of '
                  f'{setup.conditions.cycle_step_n:g} N',
    f'least gain with a sustained cycle, up to {HIGHEST_RATIO:g} times')
