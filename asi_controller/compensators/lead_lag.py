"""
A lead at the frequency of the limit cycle, and a lag that holds the force.

The lead is K(aTs + 1)/(Ts + 1) of section 5 of the paper.
"""

import math

from asi_common.parameter import Parameter
from asi_controller.design import Compensator, Design

RATIO = Parameter('ratio', 130.0, '', 'a of K(aTs+1)/(Ts+1)', 1.0, 1e3, source='paper, section 5')
CENTRE = Parameter('centre_frequency', 72.0, 'Hz',
                   'Where the lead is largest: 1/(2 pi T sqrt(a))', 0.1, 1e4,
                   source='paper, section 5: 60 to 100 Hz')
LAG_TIME = Parameter('lag_time', 0.5, 's', 'Time constant of the lag', 1e-3, 100.0,
                     source='paper, section 5')


def design(gain: float, ratio: float, centre_frequency: float, lag_time: float) -> Design:
    """Return the lead about its centre, and the lag."""
    centre = 2.0 * math.pi * centre_frequency
    spread = math.sqrt(ratio)
    return Design((-centre / spread,), (-centre * spread, -1.0 / lag_time), gain)


COMPENSATOR = Compensator('lead_lag', gain=13.0, order=20, design=design,
                          parameters=(RATIO, CENTRE, LAG_TIME))
