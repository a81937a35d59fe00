"""F18: hysteresis and friction together hide the error that Table 1 gives for Kp = 3."""

from asi_analysis.paper.facts.conditions import PROPORTIONAL_GAIN
from asi_analysis.paper.facts.fact import Fact, Measured, Row, Setup, Stage
from asi_analysis.paper.facts.static import hysteresis_loop, loop_half_width


def measure(setup: Setup) -> Measured:
    """Return the error (N) that the hysteresis hides at Kp = 3: (1 + Kp G) e = half width, N."""
    width = loop_half_width(hysteresis_loop(
        setup.actuator, setup.conditions.open_loop_amplitude_n, refinement=setup.refinement))
    gain = float(setup.record()['valve_characteristic_gain'])
    return {'error_within_loop_n': width / (1.0 + PROPORTIONAL_GAIN * gain)}


FACT = Fact(
    'F18',
    (Row('error_within_loop_n', 'error at Kp = 3 that hysteresis and friction can hide',
         '2.2, Table 1', 6.0, 'N', 4.8, 12.0),),
    measure,
    lambda setup: ('piston locked, open loop, slow triangle of '
                   f'{setup.conditions.open_loop_amplitude_n:g} N'),
    'half width of the loop over 1 + Kp G at Kp = 3', Stage.BANDWIDTH)
