"""
The blocks driven by measured inputs, with every effect; long, as the simulator will replace it.

valve:   command -> valve position          (command path and valve)
force:   valve position, velocity -> force  (hydraulics and seals, then the sensor)
load:    motion -> force                    (mechanics, then the sensor)

The load is computed inversely, from the measured motion to the force: errors do not accumulate in
an integral, and feedback does not bias the fit. Its linear part is computed in the frequency
domain, where a derivative is exact. All parameters are one record: those of the actuator, and
those of the effects, which are null at zero.
"""

import math

import numpy as np

from asi_actuator.model.delay import delay, delay_steps
from asi_actuator.model.force_sensor import CARD_DAMPING
from asi_actuator.model.friction import SEALS_SHAPE, friction, settle
from asi_actuator.model.hydraulic_damping import hydraulic_damping
from asi_actuator.model.linear_lag import (
    first_order_or_none,
    second_order,
    second_order_step,
)
from asi_actuator.model.valve_characteristic import valve_position
from asi_actuator.model.valve_flexure import dead_zone
from asi_actuator.model.valve_hysteresis import (
    FURTHER,
    command_rate,
    half_width,
    magnet_step,
    play,
    saturated,
    valve_hysteresis,
    widened,
)
from asi_actuator.parameters import ACTUATOR_DTYPE, RING
from asi_analysis.arrays import Array, Complex
from asi_analysis.gap.model.servo.law import (
    OUTPUT,
    RATE,
    SERVO_FIELDS,
    disturbed,
    moving,
    servo_lags,
    servo_step,
    within,
)
from asi_common.jit import FULL, LINEAR, jit

EFFECT_FIELDS = (
    'command_delay',            # s
    'command_quantum',          # N
    'command_phase',            # of its steps: 0 rounds to the nearest, 0.5 has an edge at zero
    'command_truncated',        # 1: rounded towards zero, as a cast to integers is
    'command_bias',             # N
    'loop_width',               # N, largest half width of the plays
    'loop_share',               # of the command that passes the plays; above 1: see `loop`
    'loop_spread',              # 0: all plays have loop_width, 1: evenly from 0 to loop_width
    'loop_behind',              # 1: a single play between the flexure and what is measured
    'command_deadband',         # N, half width
    'valve_hysteresis_spread',  # of the widths of the nominal hysteresis: 0: all equal
    'valve_lag',                # s, of two lags in series
    'valve_lag_split',          # share of the second
    'valve_limit',              # m, 0: none
    *SERVO_FIELDS,
    'orifice_deadband',         # m, half width
    'orifice_bias',             # m
    'force_limit',              # N, 0: none
    'corner',                   # roundness of a saturation, see `clip_round`; 0: a hard corner
    'damping_viscous',          # N s/m
    'damping_quadratic',        # N s2/m2
    'damping_opening',          # N s/m at full opening
    'supply_drop',              # share of the force
    'supply_sag',               # share of the force when the valve has long been open
    'supply_time',              # s
    'leakage_linear',           # N/N
    'leakage_quadratic',        # N/N at force_scale
    'force_scale',              # N
    'air_time',                 # s, at no force
    'air_stiffening',           # at force_scale the time is divided by 1 + this
    'friction_slipping',        # share of the nominal friction that is a Maxwell slip instead
    'friction_level',           # N
    'friction_asymmetry',       # -1 to 1
    'friction_breakaway',       # breakaway over sliding friction, less one
    'friction_stribeck',        # m/s
    'friction_bristle',         # m, deflection of the seals at breakaway, without asymmetry
    'friction_rounding',        # 0: one slip element; 0.5: spread elements; 1: Dahl's bristle
    'friction_falling',         # 1 to 2: exponent of the fall from breakaway to sliding
    'friction_creep',           # m/s, about which friction rises with the velocity; 0: with strain
    'friction_inside',          # 1: between valve and force sensor, 0: beyond the sensor
    'viscous',                  # N s/m, at velocity_scale
    'viscous_exponent',         # of the velocity
    'velocity_scale',           # m/s
    'viscous_asymmetry',        # -1 to 1
    'backlash',                 # m, half width
    'backlash_memory',          # without contact: 1: the load stays, 0: it springs back
    'backlash_floating',        # 1: without contact the load moves by its own inertia
    'load_weight',              # N, part of load_offset that acts behind the backlash
    'contact_time',             # s, sets the contact's stiffness; 0: compliance and damping do
    'compliance',               # m/N
    'compliance_damping',       # s
    'swing_cosine',             # N, initial free oscillation of the load
    'swing_sine',               # N, the same in quadrature
    'piston_share',             # share of the mass before the compliance
    'damping_share',            # share of the load's damping before the compliance
    'disturbance',              # N
    'disturbance_wave',         # N
    'disturbance_frequency',    # Hz
    'disturbance_phase',        # turns
    'disturbance_pulse',        # N
    'disturbance_start',        # s
    'disturbance_end',          # s
    'sensor_offset',            # N
    'sensor_gain_error',        # N/N
    'sensor_lag',               # s, of two lags in series
    'sensor_lag_split',         # share of the second
    'sensor_drift',             # N/s
    'sensor_drift_curve',       # N/s2
    'sensor_drift_bend',        # N/s3
    'load_offset',              # N, constant force of a joint's nominal model
    'gravity_sine',             # N m sin q, gravity beyond that which was subtracted
    'gravity_cosine',           # N m cos q
    'drive_hold',               # s, delay of the command or force of a joint, at most a sample
    'drive_held',               # s2, square of the time for which it is held, the same
    'drive_delay',              # s, further delay
    'position_gain_error',      # share by which a joint's motion is read too large
    'drive_loss',               # share of the force that a joint's command no longer makes
    'drive_lag',                # s, of two lags in series
    'drive_lag_split',          # share of the second
)
EFFECT_DTYPE = np.dtype([(name, np.float64) for name in EFFECT_FIELDS])
PLANT_DTYPE = np.dtype(ACTUATOR_DTYPE.descr + EFFECT_DTYPE.descr)

# No default of an argument: numba does not find code of a default that is nan in its cache.
AT_REST = (math.nan, 0.0)
CONTACT_DAMPING = 0.8   # damping ratio of a contact: hardly any rebound
PLAYS = 4         # elements of a hysteresis, and of a friction
# The quantiles 1/8, 3/8, 5/8, 7/8 of a normal distribution are about -3, -1, 1, 3 times this.
QUARTILE = 0.38


@jit
def clip_round(x, corner):
    """Return x saturated at ±1 with a rounded corner: x / (1 + |x|^n)^(1/n), corner = 1/n."""
    size = abs(x)
    if corner <= 0.01 or size < 0.3:
        return min(max(x, -1.0), 1.0)
    if size > 3.0:
        return 1.0 if x > 0.0 else -1.0
    return x / (1.0 + size ** (1.0 / corner)) ** corner


@jit
def in_steps(u, quantum, phase, truncated):
    """Return a command, quantised; phase, truncated: see EFFECT_FIELDS."""
    if truncated > 0.5:
        return quantum * int(u / quantum)
    return quantum * (math.floor(u / quantum + 0.5 - phase) + phase)


@jit
def held_command(command, position, step):
    """
    Return the mean of a held command over `step` samples from `position` samples on.

    Before its first sample the command is constant. The mean, so that the result is a smooth
    function of a delay, which can then be fitted.
    """
    first = int(math.floor(position))
    last = int(math.floor(position + step))
    limit = command.shape[0] - 1
    here = command[min(max(first, 0), limit)]
    if first == last:
        return here
    share = (last - position) / step
    return share * here + (1.0 - share) * command[min(max(last, 0), limit)]


@jit
def valve(command, p, e, period, count, out, begins):
    """
    Put the valve position (m) at each sample into `out`.

    command: n valve commands, N, each held for `period` s; `count` sub-steps per sample; begins:
    position and rate of a servo, or AT_REST, where its first command is.
    """
    h = period / count
    wait = e.command_delay / period
    if p.valve_flexure_model == FULL:
        # All blocks behind are time-invariant, so the two delays can be one.
        wait += p.valve_flexure_delay / period
    decay = magnet_step(p, h).decay
    coil_decay = math.exp(-2.0 * math.pi * p.valve_flexure_coil_frequency * h)
    flexure = second_order(p.valve_flexure_natural_frequency, p.valve_flexure_damping_ratio, h)
    # For an input that is held over each step, as the command is.
    keep, _, _ = first_order_or_none(e.valve_lag * (1.0 - e.valve_lag_split), h)
    keep_2, old_2, new_2 = first_order_or_none(e.valve_lag * e.valve_lag_split, h)
    start = within(command[0] + e.command_bias, e)
    widths = spread(e.valve_hysteresis_spread)
    # Before the recording the plays were at rest.
    plays, fluxes, further = np.zeros(PLAYS), np.zeros(PLAYS), np.zeros(FURTHER)
    magnet = first_order_or_none(p.valve_hysteresis_lagged * p.valve_hysteresis_lag_time
                                 * (p.valve_hysteresis_model == FULL), h)
    filtered, flux, slow_flux = start, start, start
    rest = dead_zone(start, e.command_deadband)
    first, lagged, coil, pipe, pipe_rate = rest, rest, rest, rest, 0.0
    sent, after = math.nan, rest
    behind = valve_position(rest, p)
    serves, lags, servo = disturbed(e), servo_lags(e, h), moving(rest, 0.0, e)
    if begins[0] == begins[0]:
        servo = moving(begins[0], begins[1], e)
        pipe, pipe_rate = servo[OUTPUT], servo[RATE]
    for k in range(out.shape[0]):
        position = behind if e.loop_behind > 0.5 else valve_position(pipe, p)
        if e.valve_limit > 0.0:
            position = e.valve_limit * clip_round(position / e.valve_limit, e.corner)
        out[k] = position
        for j in range(count):
            u = held_command(command, k + j / count - wait, 1.0 / count)
            u = min(max(u, -p.command_limit), p.command_limit)
            if e.command_quantum > 0.0:
                u = in_steps(u, e.command_quantum, e.command_phase, e.command_truncated)
            u = within(u + e.command_bias, e)
            if u != sent or p.valve_hysteresis_model == FULL:   # that depends on the rate, too
                sent = u
                filtered = u + (filtered - u) * decay
                flux_before = flux
                flux = widened(magnetised(fluxes, widths, u, filtered, p), further, u, filtered, p)
                slow_flux = magnet[0] * slow_flux + magnet[1] * flux_before + magnet[2] * flux
                drive = loop(plays, saturated(slow_flux, p), e)
                after = dead_zone(drive, e.command_deadband)
            lagged_before = lagged
            first_before = first
            first = keep * first + (1.0 - keep) * after
            lagged = keep_2 * lagged + old_2 * first_before + new_2 * first
            if p.valve_flexure_model == FULL:
                mean = 0.5 * (lagged_before + lagged) if e.valve_lag > 0.0 else lagged
                coil_before = coil
                coil = mean + (coil - mean) * coil_decay
                # A servo has no coil: its command is held over the sub-step.
                drawn = 0.5 * (coil_before + coil) if coil_decay > 0.0 else coil
                if serves:
                    pipe = servo_step(servo, drawn, flexure, lags, e)
                else:
                    pipe, pipe_rate = second_order_step(pipe, pipe_rate, drawn, flexure)
            else:
                pipe = lagged
                if p.valve_flexure_model == LINEAR:
                    pipe *= p.valve_flexure_linear_gain
            if e.loop_behind > 0.5:
                behind = play(behind, valve_position(pipe, p), e.loop_width)


@jit
def magnetised(fluxes, widths, command, filtered, p):
    """
    Return the flux (N) of the nominal hysteresis with free shape parameters; updates its plays.

    The plays of asi_actuator/model/valve_hysteresis.py with spread widths. filtered: state of the
    rate filter, N.
    """
    if p.valve_hysteresis_model != FULL:
        return valve_hysteresis(0.0, command, filtered, p)
    grown = half_width(command_rate(command, filtered, p), p) - p.valve_hysteresis_radius
    flux = 0.0
    for i in range(PLAYS):
        width = p.valve_hysteresis_radius * widths[i] + grown
        fluxes[i] = play(fluxes[i], command, width)
        flux += fluxes[i] / PLAYS
    return flux


@jit
def spread(wide):
    """
    Return the relative sizes of the elements of the nominal hysteresis or friction, of mean 1.

    From a log-normal distribution: 0 gives one sharp corner, a large `wide` a smooth loop.
    """
    sizes = np.exp(QUARTILE * wide * np.arange(1.0 - PLAYS, PLAYS, 2.0))
    return sizes / np.mean(sizes)


@jit
def loop(plays, drive, e):
    """
    Return a drive (N) after the effects' hysteresis; updates its plays.

    A sum of plays of evenly spread widths (Prandtl, Ishlinskii), and a share that bypasses them.
    That share is negative for a loop whose output first moves back at a turn, as one of Bouc and
    Wen may.
    """
    if e.loop_width <= 0.0 or e.loop_behind > 0.5:
        return drive
    through = 0.0
    for i in range(PLAYS):
        radius = e.loop_width * (1.0 - e.loop_spread * (i + 0.5) / PLAYS)
        plays[i] = play(plays[i], drive, radius)
        through += plays[i] / PLAYS
    return (1.0 - e.loop_share) * drive + e.loop_share * through


@jit
def seized(e):
    """Return the elements of the effects' friction at rest, and the reach (m) of each slip."""
    apart = min(2.0 * e.friction_rounding, 1.0)
    places = (np.arange(PLAYS) + 0.5) / PLAYS
    return np.zeros(PLAYS + 1), e.friction_bristle * (1.0 + apart * (2.0 * places - 1.0))


@jit
def slide(elements, reach, moved, velocity, e):
    """
    Return friction (N) at a velocity (m/s) after a displacement (m); updates the elements.

    Generalised Maxwell slip: elements that deform (-1 to 1, in units of their reach, m) and then
    slide; the last element is a bristle of Dahl. The breakaway force falls to sliding friction
    over the Stribeck velocity.
    """
    rise = 1.0
    if e.friction_breakaway > 0.0:
        relative = abs(velocity) / e.friction_stribeck
        if relative < 20.0:
            rise += e.friction_breakaway * math.exp(-relative ** e.friction_falling)
    if e.friction_creep > 0.0:
        share = math.tanh(velocity / e.friction_creep)
        share *= 1.0 + math.copysign(e.friction_asymmetry, share)
    else:
        share = deflected(elements, reach, moved, e)
    return e.friction_level * rise * share


@jit
def deflected(elements, reach, moved, e):
    """
    Return friction as a share of its level after a displacement (m); updates the elements.

    They are as stiff one way as the other; an asymmetric friction slides at other deflections.
    """
    ahead, back = 1.0 + e.friction_asymmetry, e.friction_asymmetry - 1.0
    share = 0.0
    for i in range(PLAYS):
        elements[i] = min(max(elements[i] + moved / reach[i], back), ahead)
        share += elements[i] / PLAYS
    bristled = max(2.0 * e.friction_rounding - 1.0, 0.0)
    if bristled > 0.0:
        end = ahead if moved > 0.0 else back
        if moved != 0.0:
            distance = max(abs(end), 1e-6) * e.friction_bristle
            elements[PLAYS] = end + (elements[PLAYS] - end) * math.exp(-abs(moved) / distance)
        share += bristled * (elements[PLAYS] - share)
    return share


@jit
def slipping(elements, sizes, moved, velocity, p):
    """
    Return the nominal friction (N) in another formulation; updates the elements.

    Maxwell slip whose force, not whose deflection, follows the Stribeck curve: at a stop it is at
    once the breakaway force, while that of the bristle stays as it was in sliding.
    """
    reach = 0.5 * (p.friction_stiction_push + p.friction_stiction_pull) / (
        p.friction_presliding_stiffness)
    share = 0.0
    for i in range(PLAYS):
        elements[i] = min(max(elements[i] + moved / (reach * sizes[i]), -1.0), 1.0)
        share += elements[i] / PLAYS
    stiction = p.friction_stiction_push if share >= 0.0 else p.friction_stiction_pull
    coulomb = p.friction_coulomb * (
        1.0 + math.copysign(1.0, share) * p.friction_coulomb_asymmetry)
    fall = math.exp(-abs(velocity) / p.friction_stribeck_velocity)
    return share * (coulomb + (stiction - coulomb) * fall)


@jit
def inner_friction(seals, slips, sizes, extra, reach, v, mean, p, e, h):
    """
    Return the friction (N) before the force sensor.

    seals: the nominal ones, which are deflected further; slips, sizes: elements of the nominal
    friction in its other formulation; extra, reach: those of the effects' friction; v, mean:
    velocity (m/s) at the end of `h` s and its mean.
    """
    rub = friction(seals, mean, v, p, h)
    settle(seals, 0.0, p)
    total = rub.force
    if e.friction_slipping > 0.0:
        total += e.friction_slipping * (slipping(slips, sizes, mean * h, v, p) - rub.force)
    if e.friction_inside > 0.5:
        if e.friction_level > 0.0:
            total += slide(extra, reach, mean * h, v, e)
        total += viscous_force(v, e)
    return total


@jit
def viscous_force(v, e):
    """Return the viscous friction (N) that the effects add at a velocity (m/s)."""
    size = abs(v)
    bent = 1.0 if e.viscous_exponent == 1.0 or size == 0.0 else (
        (size / e.velocity_scale) ** (e.viscous_exponent - 1.0))
    return e.viscous * (bent * v + e.viscous_asymmetry * size)


@jit
def cylinder_friction(velocity, p, e, h, out):
    """Put the friction (N) before the force sensor into `out`; velocity: m/s, each `h` s."""
    seals, before = np.zeros(SEALS_SHAPE), velocity[0]
    extra, reach = seized(e)
    slips, sizes = np.zeros(PLAYS), spread(0.6)
    for i in range(out.shape[0]):
        v = velocity[i]
        out[i] = inner_friction(seals, slips, sizes, extra, reach, v, 0.5 * (before + v), p, e, h)
        before = v


@jit
def steady_state_force(position, velocity, p, e, h, out):
    """
    Put the steady-state hydraulic force (N) of valve position and motion into `out`.

    position: of the valve, m; velocity: of the piston, m/s; each `h` s.
    """
    keep = math.exp(-h / e.supply_time)
    opened = 0.0
    for i in range(out.shape[0]):
        out[i], opened = supplied(position[i], velocity[i], opened, p, e, keep if i > 0 else 0.0)


@jit
def fluid_time(p):
    """Return the time constant (s) of the nominal fluid dynamics."""
    if p.fluid_dynamics_model == FULL:
        return 1.0 / (2.0 * math.pi * p.fluid_dynamics_frequency)
    return 0.0


@jit
def pressed(hydraulic, before, after, oil, p, e, h):
    """
    Return the hydraulic force (N) after `h` s.

    before, after: steady-state force (N) at both ends, linear between; oil: its lag, with neither
    leakage nor air.
    """
    if e.leakage_linear == 0.0 and e.leakage_quadratic == 0.0 and e.air_time == 0.0:
        return oil[0] * hydraulic + oil[1] * before + oil[2] * after
    size = abs(hydraulic) / e.force_scale
    leak = 1.0 + e.leakage_linear + e.leakage_quadratic * size
    time = fluid_time(p) + e.air_time / (1.0 + e.air_stiffening * size)
    keep, old, new = first_order_or_none(time / leak, h)
    return keep * hydraulic + (old * before + new * after) / leak


@jit
def travel(position, p, e, damping, stiffness, period, count, out):
    """
    Put the simulated velocity (m/s) of piston and load at each sample into `out`.

    For recordings without a motion. position: n valve positions, m; damping N s/m, stiffness N/m
    of the load; `count` sub-steps per sample of `period` s, of half a time constant at most.
    """
    h = period / count
    oil = first_order_or_none(fluid_time(p), h)
    keep = math.exp(-h / e.supply_time)
    extra, reach = seized(e)
    slips, sizes = np.zeros(PLAYS), spread(0.6)
    seals = np.zeros(SEALS_SHAPE)
    x, v, v_before = 0.0, 0.0, 0.0
    wanted, opened = supplied(position[0], 0.0, 0.0, p, e, 0.0)
    hydraulic = 0.0
    for k in range(out.shape[0]):
        out[k] = v
        if k == out.shape[0] - 1:
            break
        for j in range(count):
            z = position[k] + (j + 1.0) / count * (position[k + 1] - position[k])
            before, hydraulic_before = wanted, hydraulic
            # The velocity is extrapolated to the middle and to the end of the step.
            wanted, opened = supplied(z, 2.0 * v - v_before, opened, p, e, keep)
            hydraulic = pressed(hydraulic, before, wanted, oil, p, e, h)
            middle = 1.5 * v - 0.5 * v_before
            rub = inner_friction(seals, slips, sizes, extra, reach, middle, middle, p, e, h)
            v_before = v
            v += h / p.load_mass * (0.5 * (hydraulic_before + hydraulic) - rub - damping * middle
                                    - stiffness * (x + 0.5 * h * middle))
            x += 0.5 * h * (v_before + v)


@jit
def force(wanted, rub, acceleration, p, e, period, count, out):
    """
    Put the measured force (N) at each sample into `out`.

    wanted, rub: steady-state hydraulic force and friction (N) at (n - 1) count + 1 sub-steps;
    acceleration: of the piston at n samples, m/s2; `count` sub-steps per sample of `period` s.
    """
    h = period / count
    ring = np.zeros(RING)
    # At such sub-steps the second-order filter of the sensor's card equals a delay.
    card = CARD_DAMPING / (math.pi * p.force_sensor_card_frequency)
    wait = delay_steps(p.force_sensor_delay + card, h)
    flexure = second_order(p.force_sensor_natural_frequency, p.force_sensor_damping_ratio, h)
    sensor_gain = p.force_sensor_linear_gain if p.force_sensor_model == LINEAR else 1.0

    oil = first_order_or_none(fluid_time(p), h)
    slow = first_order_or_none(e.sensor_lag * (1.0 - e.sensor_lag_split), h)
    slower = first_order_or_none(e.sensor_lag * e.sensor_lag_split, h)

    # The sensor does not measure the inertia of the mass before it.
    mass = p.force_sensor_mass_share * p.load_mass
    if e.compliance > 0.0:
        mass *= e.piston_share
    hydraulic = wanted[0]
    felt = hydraulic - rub[0] - mass * acceleration[0]
    sensor, sensor_rate, sensed = felt, 0.0, felt
    first, lagged = felt, felt
    ring[:] = felt
    index = 0
    for k in range(out.shape[0]):
        out[k] = reading(lagged, k * period, p, e)
        if k == out.shape[0] - 1:
            break
        for j in range(count):
            i = k * count + j + 1
            inertia = mass * (acceleration[k] + (j + 1.0) / count * (acceleration[k + 1]
                                                                     - acceleration[k]))
            hydraulic = pressed(hydraulic, wanted[i - 1], wanted[i], oil, p, e, h)
            felt_before = felt
            felt = hydraulic - rub[i] - inertia
            sensed_before = sensed
            if p.force_sensor_model == FULL:
                sensor, sensor_rate = second_order_step(
                    sensor, sensor_rate, 0.5 * (felt_before + felt), flexure)
                index = (index + 1) & (RING - 1)
                sensed = delay(ring, index, sensor, wait)
            else:
                sensed = sensor_gain * felt
            first_before = first
            first = slow[0] * first + slow[1] * sensed_before + slow[2] * sensed
            lagged = slower[0] * lagged + slower[1] * first_before + slower[2] * first


@jit
def supplied(z, v, opened, p, e, keep):
    """
    Return the steady-state hydraulic force (N) and the lagged opening, by which the supply sags.

    z: valve position, m; v: velocity, m/s; opened: the last lagged opening, of which the share
    `keep` remains.
    """
    opened_by = dead_zone(z + e.orifice_bias, e.orifice_deadband)
    relative = opened_by / p.valve_characteristic_full_opening
    opening = clip_round(relative, e.corner)
    if p.valve_characteristic_model == FULL:
        relative = opening
    elif p.valve_characteristic_model == LINEAR:
        relative *= p.valve_characteristic_linear_gain
    static = relative * p.valve_characteristic_maximum_force
    if e.force_limit > 0.0:
        static = e.force_limit * clip_round(static / e.force_limit, e.corner)
    if e.supply_sag != 0.0:
        opened = abs(opening) + keep * (opened - abs(opening))
    static *= max(1.0 - e.supply_drop - e.supply_sag * opened, 0.0)
    against = v * (e.damping_viscous + e.damping_opening * abs(opening)
                   + e.damping_quadratic * abs(v))
    if p.hydraulic_damping_model == FULL:
        against += hydraulic_damping(v, opening, p)
    elif p.hydraulic_damping_model == LINEAR:
        against += p.hydraulic_damping_linear_gain * v
    fluid_gain = p.fluid_dynamics_linear_gain if p.fluid_dynamics_model == LINEAR else 1.0
    return fluid_gain * (static - against), opened


@jit
def reading(sensed, time, p, e):
    """Return the reading (N) of the sensor for a sensed force (N) at a time (s)."""
    return (p.force_sensor_gain * (1.0 + e.sensor_gain_error) * sensed + p.force_sensor_offset
            + e.sensor_offset + drift(time, e))


@jit
def drift(time, e):
    """
    Return the drift (N) of the sensor's zero at a time (s).

    A cubic polynomial: for a sensor that warms up with a time constant of a third of the
    recording, its error is a hundredth.
    """
    return time * (e.sensor_drift + time * (e.sensor_drift_curve + time * e.sensor_drift_bend))


@jit
def load_nonlinear(position, velocity, damping, e, period, start, balance, out, slack):
    """
    Put into `out` the force (N) of the load that is not linear in its motion.

    Friction behind the sensor and disturbance; into `slack` the displacement (m) between piston
    and load by backlash. position m, velocity m/s: of the piston; damping N s/m of the load;
    start: time of the first sample, s. Friction and backlash start at time 0: before, the motion
    is extrapolated. balance: force (N) that is left for all of this where the load halts, as
    static friction balances any; nan where it moves; empty if it does not halt.
    """
    elements, reach = seized(e)
    left, before = position[0], position[0]
    pulse = e.disturbance_end > e.disturbance_start
    omega = 2.0 * math.pi * e.disturbance_frequency
    for k in range(out.shape[0]):
        x, v = position[k], velocity[k]
        if start + k * period < 0.5 * period:
            left, before = x, x
        total = e.load_offset - e.disturbance
        rub = 0.0
        if e.friction_inside < 0.5:
            if e.friction_level > 0.0:
                rub = slide(elements, reach, x - before, v, e)
            total += viscous_force(v, e) + damping * e.viscous_asymmetry * abs(v)
        if e.backlash > 0.0:
            left = play(left, x, e.backlash)
            seat = e.backlash_memory * left + (1.0 - e.backlash_memory) * dead_zone(x, e.backlash)
            slack[k] = x - seat
        if e.disturbance_frequency > 0.0:
            time = start + k * period
            total -= e.disturbance_wave * math.sin(omega * time
                                                   + 2.0 * math.pi * e.disturbance_phase)
        if pulse:
            time = start + k * period
            # Edges one sample wide, so that their times can be fitted.
            rise = min(max((time - e.disturbance_start) / period + 0.5, 0.0), 1.0)
            fall = min(max((time - e.disturbance_end) / period + 0.5, 0.0), 1.0)
            total -= e.disturbance_pulse * (rise - fall)
        before = x
        if k < balance.shape[0] and balance[k] == balance[k]:
            rub = held(balance[k] - total, e)
        out[k] = total + rub


@jit
def held(force, e):
    """Return the static friction (N) that balances a force, at most the breakaway friction."""
    most = e.friction_level * (1.0 + e.friction_breakaway)
    return min(max(force, -most * (1.0 - e.friction_asymmetry)),
               most * (1.0 + e.friction_asymmetry))


@jit
def floating(position, velocity, angle, load, gravity, e, period, count, out):
    """
    Put position (m) and velocity (m/s) of a load behind a backlash into `out`, 2 x n samples.

    Without contact it moves freely. position m, velocity m/s: of the piston, n samples of
    `period` s in `count` sub-steps; angle: of a joint at position 0, rad; load: its mass kg,
    damping N s/m, stiffness N/m; gravity: amplitudes of sine and cosine of the angle, N m. The
    contact is a spring and a damper; with a contact time it only pushes. By the implicit midpoint
    rule, which is stable for a stiff contact and does not dissipate.
    """
    mass, damping, stiffness = load
    h = period / count
    one_way = e.contact_time > 0.0
    if one_way:
        push = mass / e.contact_time ** 2
        brake = 2.0 * CONTACT_DAMPING * mass / e.contact_time
    else:
        push, brake = 1.0 / e.compliance, e.compliance_damping / e.compliance
    heavy = gravity[0] != 0.0 or gravity[1] != 0.0
    weight = e.load_weight
    x, v, y, w = position[0], velocity[0], position[0], velocity[0]
    for k in range(out.shape[1]):
        out[0, k], out[1, k] = y, w
        if k == out.shape[1] - 1:
            break
        if heavy:
            weight = (e.load_weight + gravity[0] * math.sin(angle + y)
                      + gravity[1] * math.cos(angle + y))
        for j in range(count):
            share = (j + 1.0) / count
            x_before, v_before = x, v
            v = velocity[k] + share * (velocity[k + 1] - velocity[k])
            # Interpolated between samples with constant acceleration.
            x = (position[k] + share * (position[k + 1] - position[k])
                 - 0.5 * share * (1.0 - share) * period * (velocity[k + 1] - velocity[k]))
            half, moved = 0.5 * (x_before + x), 0.5 * (v_before + v)
            ahead = half - y - 0.5 * h * w
            touch = min(max(ahead, -e.backlash), e.backlash)
            rest = -stiffness * y - weight
            free = (w + 0.5 * h / mass * rest) / (
                1.0 + 0.5 * h / mass * (damping + 0.5 * h * stiffness))
            middle = free
            if touch != ahead:
                pull, drag = stiffness + push, damping + brake
                rest += push * (half - touch - y) + brake * moved
                middle = ((w + 0.5 * h / mass * rest)
                          / (1.0 + 0.5 * h / mass * (drag + 0.5 * h * pull)))
                pressed_on = (push * (half - touch - y - 0.5 * h * middle)
                              + brake * (moved - middle))
                if one_way and pressed_on * (ahead - touch) < 0.0:
                    middle = free
            y, w = y + h * middle, 2.0 * middle - w


def parts(p: np.void) -> tuple[np.void, np.void]:
    """Return the actuator's and the effects' part of the plant's record, for compiled code."""
    raw = p.tobytes()
    return (np.frombuffer(raw, ACTUATOR_DTYPE, 1)[0],
            np.frombuffer(raw, EFFECT_DTYPE, 1, ACTUATOR_DTYPE.itemsize)[0])


def load_constants(p: np.void) -> tuple[float, float, float]:
    """Return mass kg (behind the sensor), damping N s/m and stiffness N/m of the load."""
    kind = int(p['load_type'])
    stiffness = (p['load_locked_stiffness'], p['load_stiffness'], 0.0, 0.0)[kind]
    damping = (p['load_locked_damping'], p['load_damping'], 0.0, 0.0)[kind]
    mass = (1.0 - p['force_sensor_mass_share']) * p['load_mass']
    return float(mass), float(damping), float(stiffness)


def sensor_response(omega: Array, p: np.void) -> Complex:
    """Return the frequency response of the sensor, gain and lag included; omega in rad/s."""
    s = 1j * omega
    response = np.ones_like(s)
    if p['sensor_lag'] != 0.0:
        split = p['sensor_lag_split']
        response = 1.0 / ((1.0 + s * p['sensor_lag'] * (1.0 - split))
                          * (1.0 + s * p['sensor_lag'] * split))
    if p['force_sensor_model'] == FULL:
        w = 2.0 * math.pi * p['force_sensor_natural_frequency']
        response = response * np.exp(-s * p['force_sensor_delay']) / (
            1.0 + 2.0 * p['force_sensor_damping_ratio'] * s / w + (s / w) ** 2)
        w = 2.0 * math.pi * p['force_sensor_card_frequency']
        response = response / (1.0 + 2.0 * CARD_DAMPING * s / w + (s / w) ** 2)
    elif p['force_sensor_model'] == LINEAR:
        response = response * p['force_sensor_linear_gain']
    return response * (p['force_sensor_gain'] * (1.0 + p['sensor_gain_error']))


def drive_inverse(omega: Array, p: np.void) -> Complex:
    """
    Return the frequency response from force to command of a joint's drive: its inverse.

    The fast part of a command is attenuated by holding it.
    """
    s = 1j * omega
    late = p['drive_hold'] + p['drive_delay']
    response = (np.exp(s * late) if late != 0.0 else np.ones_like(s)) / (1.0 - p['drive_loss'])
    if p['drive_held'] > 0.0:
        response /= np.sinc(0.5 * omega * math.sqrt(p['drive_held']) / np.pi)
    if p['drive_lag'] != 0.0:
        split = p['drive_lag_split']
        response *= (1.0 + s * p['drive_lag'] * (1.0 - split)) * (1.0 + s * p['drive_lag'] * split)
    return response


def impedance(omega: Array, p: np.void) -> Complex:
    """Return the mechanical impedance of the linear load without its spring, N s/m."""
    mass, damping, _ = load_constants(p)
    return mass * 1j * omega + damping


def transmitted(omega: Array, p: np.void, slope: float = 0.0) -> Complex:
    """
    Return the frequency response from a force on a load behind a compliance to that on the piston.

    slope: of the load's weight by its position, N/m.
    """
    _, damping, stiffness = load_constants(p)
    damping *= 1.0 - float(p['damping_share'])
    s = 1j * omega
    rest = p['load_mass'] * (1.0 - p['piston_share'])
    soft = p['compliance'] / (1.0 + s * p['compliance_damping'])
    return 1.0 / (1.0 + soft * (rest * s * s + damping * s + stiffness + slope))


def swing(time: Array, p: np.void, slope: float = 0.0) -> Array:
    """
    Return the force (N) of a load's free oscillation behind a compliance, at times (s) from 0.

    slope: of the load's weight by its position, N/m.
    """
    _, damping, stiffness = load_constants(p)
    rest = max(float(p['load_mass'] * (1.0 - p['piston_share'])), 1e-12)
    decay = 0.5 * ((1.0 - p['damping_share']) * damping
                   + p['compliance_damping'] / p['compliance']) / rest
    square = (stiffness + slope + 1.0 / p['compliance']) / rest - decay * decay
    rate = math.sqrt(abs(square))
    if square < 0.0:   # overdamped: both of its modes
        modes = (p['swing_cosine'] + p['swing_sine']), (p['swing_cosine'] - p['swing_sine'])
        return np.asarray(0.5 * (modes[0] * np.exp((rate - decay) * time)
                                 + modes[1] * np.exp(-(rate + decay) * time)))
    return np.asarray(np.exp(-decay * time) * (p['swing_cosine'] * np.cos(rate * time)
                                               + p['swing_sine'] * np.sin(rate * time)))


def behind(omega: Array, velocity: Complex, position: Complex, slack: Complex, p: np.void,
           slope: float = 0.0) -> Complex:
    """
    Return the spectrum of the force on the piston of a load behind backlash and compliance.

    velocity, position: spectra of the piston's motion; slack: spectrum of the displacement in the
    backlash; slope: of the load's weight by its position, N/m; the weight itself is left out.
    """
    mass, damping, stiffness = load_constants(p)
    s = 1j * omega
    before = mass * p['piston_share'] * s + p['damping_share'] * damping
    damping *= 1.0 - float(p['damping_share'])
    rest = p['load_mass'] * (1.0 - p['piston_share'])
    return before * velocity + transmitted(omega, p, slope) * (
        (rest * s + damping) * (velocity - s * slack) + stiffness * (position - slack))
