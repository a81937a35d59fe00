"""F12: friction and damping alone make no cycle but at extreme gains."""

from typing import Final

from asi_analysis.paper.facts.fact import INFINITE, Fact, Measured, Row, Setup, Stage
from asi_analysis.paper.facts.measures import HIGHEST_RATIO, onset_ratio
from asi_analysis.paper.facts.words import locked_loop

HYSTERESIS_AS_GAIN: Final = {'valve_hysteresis.model': 'linear',
                             'valve_characteristic.model': 'linear'}


def measure(setup: Setup) -> Measured:
    return {'linear_onset_ratio': onset_ratio(setup, HYSTERESIS_AS_GAIN)}


FACT = Fact(
    'F12',
    (Row('linear_onset_ratio', 'onset with friction and damping alone, over onset', '4.1, Fig. 8',
         2.0, '', 2.0, INFINITE),),
    measure,
    lambda setup: (f'{locked_loop(setup)}; hysteresis and static characteristic as gains, step '
                   f'of {setup.conditions.cycle_step_n:g} N'),
    f'least gain with a sustained cycle, up to {HIGHEST_RATIO:g} times', Stage.CYCLE)
