"""
Four equal leads, and a lag that is quicker than that of `lead_lag`.

The fourth-order lead of section 5 and Table 1 of the paper. Its gain is that above the corner of
the lag.
"""

from functools import partial

from asi_controller.compensators.lead2 import GAIN_AT, equal_leads, parameters
from asi_controller.design import Compensator

COMPENSATOR = Compensator('lead4', 1.92, 40, partial(equal_leads, 4),
                          parameters('four', 1.9, 124.0, 7.2, 0.19), GAIN_AT)
