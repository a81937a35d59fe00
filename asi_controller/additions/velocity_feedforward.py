"""
The damping of the actuator compensated from its measured velocity, for a motion that feels light.

Added to the command is a share of the command at which the actuator, moved at that velocity, gives
no force. For the default actuator it is proportional to the velocity within 10 %, although the
damping is not: the more it compensates, the further the valve opens, and the damping changes with
the opening. The share is at most 1, since with more the actuator would push in the direction in
which it is moved and would not be passive. The force loop around it has its own limit, which
`asi tune` checks.

The valve follows the command late, and what is compensated late acts as a mass, which the
integrator of the force turns into a negative damping. So the velocity is taken ahead, by a lead
whose gain rises to LEAD at high frequencies: by little, since a heavy load on a stiff spring is
fast, and too much compensation there makes a limit cycle (doc/explanation/force_control.md).
"""

import math
from typing import Final

from asi_common.jit import jit
from asi_common.parameter import Parameter
from asi_controller.additions.reference_model import approach

PARAMETERS = (
    Parameter('share', 0.0, '', 'Share of the damping that is compensated; 0: none', 0.0, 1.0),
    Parameter('damping', 1450.0, 'N s/m', 'Command per velocity at which the actuator gives no '
              'force', 0.0, 1e5, source='default hydraulic_damping'),
    Parameter('lead_time', 0.0, 's', 'Time by which the velocity is taken ahead; 0: none',
              0.0, 0.05),
)
LEAD: Final = 1.1   # pole over zero of the lead


@jit
def compensation(velocity, share, damping):
    """Return the command (N) at a velocity (m/s)."""
    return share * damping * velocity


@jit
def followed(slow, velocity, lead_time, period):
    """Return the state of the lead (m/s) after a control period (s): a lag of the velocity."""
    if lead_time == 0.0 or math.isnan(slow):
        return velocity
    return approach(slow, velocity, (LEAD - 1.0) / lead_time, period)


@jit
def advanced(slow, velocity):
    """Return the velocity (m/s) taken ahead; slow: the state of the lead."""
    return velocity + (LEAD - 1.0) * (velocity - slow)
