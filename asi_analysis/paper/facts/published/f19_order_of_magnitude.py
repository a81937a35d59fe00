"""F19: section 5 and the abstract: the rise time improves by more than an order of magnitude."""

from asi_analysis.paper.facts.fact import INFINITE, Fact, Measured, Role, Row, Setup
from asi_analysis.paper.facts.table_1 import load_in_words, step_test

FASTEST, SLOWEST = 'lead4', 'proportional'


def measure(setup: Setup) -> Measured:
    rise = {}
    for column in (SLOWEST, FASTEST):
        name = f'{column}_rise_s'
        found = setup.measured if name in setup.measured else step_test(
            setup, getattr(setup.conditions, column), column)
        rise[column] = found[name]
    return {'rise_improvement': rise[SLOWEST] / rise[FASTEST]}


FACT = Fact(
    'F19',
    # Table 1 itself gives 0.04 s / 0.007 s = 5.7.
    (Row('rise_improvement', 'rise time of P over that of the fourth-order lead', 'abstract, 5',
         10.0, '', 10.0, INFINITE, Role.HELD_OUT),),
    measure,
    lambda setup: (f'{load_in_words(setup, setup.conditions.lead4)}; step of '
                   f'{setup.conditions.lead4.amplitude_n:g} N'),
    'ratio of the rise times of F14 and F16')
