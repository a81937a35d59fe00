"""F5: a closed-loop bandwidth of about 100 Hz that falls with the amplitude."""

from functools import partial
from typing import Final

from asi_analysis.paper.facts.bandwidth import bandwidth_hz, closed_loop_gain
from asi_analysis.paper.facts.conditions import LOCKED, PROPORTIONAL_GAIN
from asi_analysis.paper.facts.fact import INFINITE, Fact, Measured, Row, Setup, Stage
from asi_analysis.paper.facts.words import locked_loop

SMALL_HZ: Final = (50.0, 70.0, 80.0, 90.0, 100.0, 110.0, 125.0, 150.0, 200.0)
LARGE_HZ: Final = (10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0, 90.0, 100.0, 120.0, 150.0)


def measure(setup: Setup) -> Measured:
    conditions = setup.conditions
    small, large = (
        bandwidth_hz(partial(closed_loop_gain, setup.record(LOCKED),
                             setup.proportional(PROPORTIONAL_GAIN), amplitude,
                             refinement=setup.refinement),
                     5.0, frequencies, setup.refinement)
        for amplitude, frequencies in ((conditions.small_amplitude_n, SMALL_HZ),
                                       (conditions.large_amplitude_n, LARGE_HZ)))
    return {'closed_loop_bandwidth_hz': small,
            'closed_loop_bandwidth_fall_percent': 100.0 * (1.0 - large / small)}


FACT = Fact(
    'F5',
    (Row('closed_loop_bandwidth_hz', 'closed-loop bandwidth, small sine', '2.2', 100.0, 'Hz',
         90.0, 110.0),
     Row('closed_loop_bandwidth_fall_percent', 'its fall at the largest sine', '2.2', 10.0, '%',
         10.0, INFINITE)),
    measure,
    lambda setup: (f'{locked_loop(setup)}; Kp = 3, sines of '
                   f'{setup.conditions.small_amplitude_n:g} and '
                   f'{setup.conditions.large_amplitude_n:g} N'),
    'gain of the fundamental, 3 dB below that at 5 Hz', Stage.BANDWIDTH)
