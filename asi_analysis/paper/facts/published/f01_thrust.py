"""F1: thrust of about 1,000 N, linear until it saturates."""

import numpy as np

from asi_analysis.paper.facts.fact import Fact, Measured, Role, Row, Setup, around
from asi_analysis.paper.facts.static import static_characteristic


def measure(setup: Setup) -> Measured:
    thrust = static_characteristic(setup.actuator, setup.refinement)
    full = float(setup.record()['valve_characteristic_full_opening'])
    inside = np.abs(thrust.x) < 0.97 * full
    slope = np.polyfit(thrust.x[inside], thrust.y[inside], 1)
    bend = np.abs(np.polyval(slope, thrust.x[inside]) - thrust.y[inside]).max()
    return {'thrust_push_n': float(thrust.y.max()), 'thrust_pull_n': float(-thrust.y.min()),
            'characteristic_bend_percent': 100.0 * bend / float(thrust.y.max())}


FACT = Fact(
    'F1',
    (around('thrust_push_n', 'maximum thrust, pushing', '2.1, Fig. 4', 1000.0, 'N', 0.02,
            Role.GIVEN),
     around('thrust_pull_n', 'maximum thrust, pulling', '2.1, Fig. 4', 1000.0, 'N', 0.02,
            Role.GIVEN),
     Row('characteristic_bend_percent', 'bend of the characteristic before it saturates',
         '2.2, Fig. 4', 0.0, '% of thrust', 0.0, 1.0, Role.GIVEN)),
    measure,
    lambda _: 'piston locked, friction off; slow ramp of the valve command',
    'force against valve position; straight line fitted below 97 % of the opening')
