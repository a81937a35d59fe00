"""
Valve static characteristic: force against valve opening (paper, section 2.2, Fig. 4).

Linear until the maximum opening is reached; then the actuator saturates.
"""

from asi_common.jit import FULL, LINEAR, jit


@jit
def valve_position(deflection, p):
    """Return the valve position (m) at a deflection of the flexure (N of valve command)."""
    opening = p.valve_characteristic_gain * deflection / p.valve_characteristic_maximum_force
    return opening * p.valve_characteristic_full_opening


@jit
def valve_opening(position, p):
    """Return the opening, -1 to 1, at a valve position (m): the flow geometry saturates there."""
    return min(max(position / p.valve_characteristic_full_opening, -1.0), 1.0)


@jit
def valve_characteristic(position, p):
    """Return the static force (N) at a valve position (m)."""
    relative = position / p.valve_characteristic_full_opening
    if p.valve_characteristic_model == FULL:
        relative = valve_opening(position, p)
    elif p.valve_characteristic_model == LINEAR:
        relative = p.valve_characteristic_linear_gain * relative
    return relative * p.valve_characteristic_maximum_force
