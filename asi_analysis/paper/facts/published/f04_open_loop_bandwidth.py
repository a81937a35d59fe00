"""F4: an open-loop bandwidth of 20 Hz."""

from functools import partial
from typing import Final

from asi_analysis.paper.facts.bandwidth import bandwidth_hz, open_loop_gain
from asi_analysis.paper.facts.conditions import LOCKED
from asi_analysis.paper.facts.fact import Fact, Measured, Row, Setup, Stage

FREQUENCIES_HZ: Final = (12.0, 16.0, 20.0, 24.0, 30.0, 40.0, 60.0)


def measure(setup: Setup) -> Measured:
    return {'open_loop_bandwidth_hz': bandwidth_hz(
        partial(open_loop_gain, setup.record(LOCKED), setup.conditions.open_loop_amplitude_n,
                refinement=setup.refinement),
        2.0, FREQUENCIES_HZ, setup.refinement)}


FACT = Fact(
    'F4',
    (Row('open_loop_bandwidth_hz', 'open-loop bandwidth', '2.2', 20.0, 'Hz', 18.0, 22.0),),
    measure,
    lambda setup: ('piston locked, open loop, sines of '
                   f'{setup.conditions.open_loop_amplitude_n:g} N'),
    'gain of the fundamental, 3 dB below that at 2 Hz', Stage.BANDWIDTH)
