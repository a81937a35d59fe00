"""F7: the same cycle after pushes and from other starts, away from saturation."""

import math
from typing import Final

from asi_analysis.loop.bench import RATE_HZ
from asi_analysis.measures.oscillation import Oscillation, of_samples
from asi_analysis.paper.facts.conditions import LOCKED
from asi_analysis.paper.facts.fact import Fact, Measured, Role, Row, Setup, Stage
from asi_analysis.paper.facts.measures import high_gain_cycle, onset_gain
from asi_analysis.paper.facts.words import high_gain_cycle as conditions

PUSHES_N: Final = (400.0, -400.0, 800.0)
STARTS_N: Final = (600.0, -600.0)
SETTLING_S: Final = 1.0


def _spread(setup: Setup) -> Measured:
    """Return the largest changes (%) of the cycle of Fig. 6 after pushes and from other starts."""
    gain, step = setup.conditions.cycle_gain * onset_gain(setup), setup.conditions.cycle_step_n
    if not math.isfinite(gain):
        return {'cycle_frequency_spread_percent': math.inf,
                'cycle_amplitude_spread_percent': math.inf}

    def cycle(before_n: float = 0.0, push_n: float = 0.0) -> Oscillation:
        bench = setup.loop(setup.record(LOCKED), gain)
        bench.run(0.3, before_n)
        bench.run(0.3, step)
        bench.run(0.03, step, push_n=push_n)
        bench.run(setup.refinement * SETTLING_S, step)
        return of_samples(bench.run(setup.refinement * 0.3, step).force_n, RATE_HZ)

    base = cycle()
    others = [*(cycle(push_n=push) for push in PUSHES_N),
              *(cycle(before_n=before) for before in STARTS_N)]
    return {
        'cycle_frequency_spread_percent': 100.0 * max(
            abs(other.frequency_hz / base.frequency_hz - 1.0) for other in others),
        'cycle_amplitude_spread_percent': 100.0 * max(
            abs(other.amplitude_n / base.amplitude_n - 1.0) for other in others)}


def measure(setup: Setup) -> Measured:
    name = 'cycle_peak_valve_percent'
    known = setup.measured if name in setup.measured else high_gain_cycle(setup)
    return {name: known[name], **({} if setup.fitted_only else _spread(setup))}


FACT = Fact(
    'F7',
    (Row('cycle_frequency_spread_percent', 'same cycle after pushes and from other starts: '
         'frequency', '3.1', 0.0, '%', 0.0, 1.0, Role.HELD_OUT),
     Row('cycle_amplitude_spread_percent', 'same cycle after pushes and from other starts: '
         'amplitude', '3.1', 0.0, '%', 0.0, 3.0, Role.HELD_OUT),
     Row('cycle_peak_valve_percent', 'largest valve opening in the cycle', '4.2', 0.0,
         '% of full', 0.0, 90.0)),
    measure,
    lambda setup: (f'{conditions(setup)}; pushes of +-400 and 800 N for 30 ms, starts from '
                   '+-600 N'),
    'fundamental over whole periods', Stage.CYCLE)
