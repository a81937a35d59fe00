"""
Compensation of the actuator's damping from the measured velocity, to reduce the felt force.

It adds a share of the command at which the force of the actuator, moved at that velocity, is zero.
For the default actuator this command is proportional to the velocity within 10 %, although the
damping is not: the damping changes with the opening of the valve. The share is at most 1; with
more the actuator would push in the direction of motion and would not be passive. The passivity of
the whole force loop has a lower limit, which `asi tune` checks.

The valve has a lag. A lagging compensation acts as a mass, which the integrator of the force turns
into a negative damping. A lead on the velocity compensates the lag. Its gain rises to LEAD only at
high frequencies, since overcompensation causes a limit cycle with a heavy load on a stiff spring
(doc/explanation/force_control.md).
"""

import math
from typing import Final

from asi_common.jit import jit
from asi_common.parameter import Parameter
from asi_controller.additions.reference_model import approach

PARAMETERS = (
    Parameter('share', 0.0, '', 'Share of the damping that is compensated; 0: none', 0.0, 1.0),
    Parameter('damping', 1600.0, 'N s/m', 'Command per velocity at which the actuator gives no '
              'force', 0.0, 1e5, source='default hydraulic_damping'),
    Parameter('lead_time', 0.0, 's', 'Time constant of the lead on the velocity; 0: none',
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
