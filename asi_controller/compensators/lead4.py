"""
Four equal leads, and a lag that is quicker than that of `lead_lag`.

The fourth-order lead of section 5 and Table 1 of the paper. Its gain is that above the corner of
the lag.
"""

from functools import partial

from asi_controller.compensators.lead2 import GAIN_AT, equal_leads, parameters
from asi_controller.design import Compensator

COMPENSATOR = Compensator('lead4', 1.875, 40, partial(equal_leads, 4),
                          parameters('four', 1.891, 132.8, 7.755, 0.1644), GAIN_AT)
