"""
Valve static characteristic: force against valve opening (paper, section 2.2, Fig. 4).

Linear until the maximum opening is reached; then the actuator saturates. Null by default: an
overlap of the orifices (dead band), their distance from the sensor's zero, a limit of the flow,
and a supply pressure that is too low or falls while the valve is open (Merritt, Hydraulic Control
Systems, 1967, ch. 5 and 10).
"""

from asi_common.jit import FULL, LINEAR, jit


@jit
def valve_position(deflection, p):
    """Return the valve position (m) at a deflection of the flexure (N of valve command)."""
    opening = p.valve_characteristic_gain * deflection / p.valve_characteristic_maximum_force
    return opening * p.valve_characteristic_full_opening


@jit
def uncovered(position, p):
    """Return how far (m) the orifices are uncovered at a valve position (m)."""
    band = p.valve_characteristic_deadband
    off = position + p.valve_characteristic_bias
    if band == 0.0:
        return off
    return off - min(max(off, -band), band)


@jit
def valve_opening(position, p):
    """Return the opening, -1 to 1, at a valve position (m): the flow geometry saturates there."""
    return min(max(uncovered(position, p) / p.valve_characteristic_full_opening, -1.0), 1.0)


@jit
def valve_characteristic(position, p):
    """Return the static force (N) at a valve position (m), without the sag of the supply."""
    relative = uncovered(position, p) / p.valve_characteristic_full_opening
    if p.valve_characteristic_model == FULL:
        relative = valve_opening(position, p)
    elif p.valve_characteristic_model == LINEAR:
        relative = p.valve_characteristic_linear_gain * relative
    force = relative * p.valve_characteristic_maximum_force
    if p.valve_characteristic_flow_limit > 0.0:
        limit = p.valve_characteristic_flow_limit
        force = min(max(force, -limit), limit)
    if p.valve_characteristic_supply_drop != 0.0:
        force *= 1.0 - p.valve_characteristic_supply_drop
    return force


@jit
def sagged(static, load, p):
    """Return the static force (N) that is left of one when the supply has seen a load (0 to 1)."""
    return static * max(1.0 - p.valve_characteristic_supply_sag * load, 0.0)


@jit
def supplied(state, static, opening, keep, p):
    """
    Return the static force (N) that the sagging supply gives; updates how far it has sagged.

    opening: of the valve, -1 to 1; keep: share of the past that is left after the time.
    """
    state.supply_load = abs(opening) + keep * (state.supply_load - abs(opening))
    return sagged(static, state.supply_load, p)
