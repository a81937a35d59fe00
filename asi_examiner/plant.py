"""
The examiner's own plant: the actuator of the paper with one or two withheld effects.

Semi-implicit Euler at 10 us; the steps of the diagnosis are 100 us or longer. Formulations that
differ from those of the diagnosis: hysteresis by Bouc and Wen, or a Preisach sum of relays,
instead of play operators; friction by generalised Maxwell slip with geometrically spaced slip
distances and an exponential Stribeck curve, or by Dahl's law with an exponent of 0.5 to 2, instead
of evenly spaced slip distances and an exponent of 1; extra lags of second order; a delay with
jitter; quadratic corners; quadratic leakage; oil whose stiffness grows with the square of the
pressure; backlash and compliance with two masses and a contact; warm-up drift; steps and bursts
of disturbance.
"""

import math
from typing import NamedTuple

import numba
import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter

STEP_S = 1e-5
SUBSTEPS = 100
PERIOD_S = 1e-3
RELAYS = 240          # thresholds of the Preisach plane, for each width
WIDTHS = 5
SLIPS = 6             # elements of the Maxwell-slip friction
RING = 4096           # sub-steps of delay: 40 ms

FIELDS = (
    # nominal
    'gain', 'coil', 'pipe', 'pipe_damping', 'delay', 'full_opening', 'maximum_force',
    'saturates', 'damping', 'family', 'family_force', 'family_velocity', 'fluid', 'mass',
    'stiffness', 'damper', 'base_hysteresis', 'base_lag', 'base_coulomb', 'base_push',
    'base_pull', 'sensor_corner', 'sensor_delay', 'friction_inside',
    # effects
    'extra_delay', 'jitter', 'quantum', 'bias', 'loop_width', 'loop_preisach', 'loop_exponent',
    'deadband', 'orifice_deadband', 'travel_limit', 'force_limit', 'extra_lag',
    'turbulent', 'turbulent_opening', 'supply_drop', 'supply_sag', 'supply_time', 'leak',
    'air_time', 'air_force', 'friction', 'breakaway', 'stribeck', 'asymmetry', 'dahl',
    'slip_distance', 'viscous', 'gap', 'coupling', 'piston_share',
    'push_constant', 'push_sine', 'push_frequency', 'push_phase', 'push_burst',
    'burst_start', 'burst_end', 'sensor_offset', 'sensor_scale', 'sensor_lag', 'drift',
    'drift_time',
    # outside the vocabulary
    'slew', 'one_sided_gain', 'cubic_spring', 'fading_gain', 'dropout', 'ripple', 'ripple_pitch',
    'resonance', 'resonance_share', 'position_gain',
)


class Bench(NamedTuple):
    """Loop and measurement noise of an experiment."""

    closed: bool
    gain: float           # of the closed loop
    feed_forward: float
    noise: npt.NDArray[np.float64]   # of force N, valve position m, position m, velocity m/s
    colour: float         # correlation of the noise from sample to sample


PLANT = np.dtype([(name, np.float64) for name in FIELDS])
STATE = np.dtype([
    *((name, np.float64) for name in (
        'held', 'slewed',                                         # command path
        'base_input', 'base_bouc', 'base_lagged',                 # valve: loops
        'loop_input', 'looped', 'bouc',
        'lag1', 'lag2', 'coil', 'resonant', 'resonant_rate', 'pipe', 'pipe_rate',
        'opened', 'hydraulic',                                    # hydraulics
        'x', 'v', 'load_x', 'load_v',                             # mechanics
        'sensed', 'sensed_rate', 'slow1', 'slow2')),              # sensor
    ('hold_until', np.int64), ('at', np.int64),
    ('command_ring', np.float64, RING), ('sensor_ring', np.float64, RING),
    ('relays', np.float64, (WIDTHS, RELAYS)),
    ('slips', np.float64, SLIPS), ('base_slips', np.float64, SLIPS),
])
# Inlined: a sub-step takes a fifth longer with calls.
jit = numba.njit(cache=True, forceinline=True)


@jit
def soft_clip(x, limit):
    """Return x clipped at the limit, with a parabolic corner of a tenth of the limit."""
    size = abs(x)
    width = 0.1 * limit
    if size <= limit - width:
        return x
    if size >= limit + width:
        return math.copysign(limit, x)
    rest = size - (limit - width)
    return math.copysign(size - rest * rest / (4.0 * width), x)


@jit
def soft_dead(x, width):
    """Return x with a dead zone whose corners are rounded over a twentieth of its width."""
    size = abs(x)
    corner = 0.05 * width
    rest = size - width
    if rest <= -corner:
        return 0.0
    if rest >= corner:
        return math.copysign(rest, x)
    return math.copysign((rest + corner) ** 2 / (4.0 * corner), x)


@jit
def maxwell_slip(elements, v, forward, backward, forward_break, backward_break, stribeck,
                 distance, dahl, h):
    """
    Return the friction force (N) after `h` s at velocity v; updates the elements.

    elements: forces of SLIPS springs, as shares of their slip forces; if the exponent `dahl` is
    not zero, a single state of Dahl's law. Forward or backward is the sign of an element's
    deflection: with the sign of the velocity the force of a sticking element would jump at every
    reversal.
    """
    fall = math.exp(-abs(v) / stribeck) if stribeck > 0.0 else 0.0
    ahead = forward + (forward_break - forward) * fall
    back = backward + (backward_break - backward) * fall
    if dahl > 0.0:
        s = elements[0]
        rest = max(1.0 - s * (1.0 if v >= 0.0 else -1.0), 0.0)
        elements[0] = min(max(s + h * v / distance * rest ** dahl, -1.0), 1.0)
        return (ahead if s >= 0.0 else back) * elements[0]
    total = 0.0
    for i in range(SLIPS):
        slip = 0.3 * 1.5 ** i * distance
        s = min(max(elements[i] + h * v / slip, -1.0), 1.0)
        elements[i] = s
        total += (ahead if s >= 0.0 else back) * s / SLIPS
    return total


@jit
def preisach(relays, u, top, width):
    """Return the output of the Preisach relays at an input u; updates them."""
    total = 0.0
    for j in range(WIDTHS):
        half = width * (0.2 + 0.4 * j)
        for i in range(RELAYS):
            centre = top * (2.0 * (i + (j + 0.5) / WIDTHS) / RELAYS - 1.0)
            if u > centre + half:
                relays[j, i] = 1.0
            elif u < centre - half:
                relays[j, i] = -1.0
            total += relays[j, i]
    return top * total / (RELAYS * WIDTHS)


@jit
def transmitted(p, s, k, command, chance):
    """Return the command (N) after dropouts and quantisation, and its delay in sub-steps."""
    if p.dropout > 0.0 and k > s.hold_until and chance < p.dropout:
        s.hold_until = k + 40
    if k > s.hold_until:
        s.held = command
    applied = s.held
    if p.quantum > 0.0:
        applied = p.quantum * math.floor(applied / p.quantum) + 0.5 * p.quantum
    delay_s = p.delay + p.extra_delay * (1.0 + p.jitter * (2.0 * chance - 1.0))
    return applied, int(delay_s / STEP_S)


@jit
def received(p, s, applied, delay):
    """Return the command (N) at the valve after a sub-step; delay: in sub-steps."""
    s.at = (s.at + 1) % RING
    s.command_ring[s.at] = applied
    u = s.command_ring[(s.at - delay) % RING] + p.bias
    if p.slew > 0.0:
        s.slewed += min(max(u - s.slewed, -p.slew * STEP_S), p.slew * STEP_S)
        u = s.slewed
    return u


@jit
def hysteresis(p, s, u, top):
    """Return the command (N) after the nominal hysteresis and that of the effect."""
    # Nominal in the full model: a rounded loop, and a lag that widens it with the rate.
    if p.base_hysteresis > 0.0:
        du = u - s.base_input
        s.base_input = u
        s.base_bouc += (du - abs(du) * s.base_bouc) / p.base_hysteresis
        s.base_bouc = min(max(s.base_bouc, -1.0), 1.0)
        s.base_lagged += (STEP_S / p.base_lag
                          * (u - p.base_hysteresis * s.base_bouc - s.base_lagged))
        u = s.base_lagged
    if p.loop_width <= 0.0:
        return u
    du = u - s.loop_input
    s.loop_input = u
    if p.loop_preisach > 0.5:
        if du != 0.0:
            s.looped = preisach(s.relays, u, top, p.loop_width)
        return s.looped
    power = abs(s.bouc) ** p.loop_exponent
    direction = 1.0 if s.bouc * du >= 0.0 else -1.0
    s.bouc += du / p.loop_width * (1.0 - power * (0.5 + 0.5 * direction))
    s.bouc = min(max(s.bouc, -1.0), 1.0)
    return u - p.loop_width * s.bouc


@jit
def advance_valve(p, s, u):
    """Advance coil and jet pipe by a sub-step under a command (N)."""
    if p.deadband > 0.0:
        u = soft_dead(u, p.deadband)
    if p.one_sided_gain != 0.0 and u > 0.0:
        u *= 1.0 + p.one_sided_gain
    if p.extra_lag > 0.0:
        s.lag1 += STEP_S / (0.7 * p.extra_lag) * (u - s.lag1)
        s.lag2 += STEP_S / (0.3 * p.extra_lag) * (s.lag1 - s.lag2)
        u = s.lag2
    s.coil += STEP_S * 2.0 * math.pi * p.coil * (u - s.coil)
    drive = s.coil
    if p.resonance > 0.0:
        w = 2.0 * math.pi * p.resonance
        s.resonant_rate += STEP_S * (w * w * (s.coil - s.resonant) - 0.1 * w * s.resonant_rate)
        s.resonant += STEP_S * s.resonant_rate
        drive = s.coil + p.resonance_share * (s.resonant - s.coil)
    w = 2.0 * math.pi * p.pipe
    s.pipe_rate += STEP_S * (w * w * (drive - s.pipe) - 2.0 * p.pipe_damping * w * s.pipe_rate)
    s.pipe += STEP_S * s.pipe_rate


@jit
def valve_position(p, s):
    """Return the position (m) of the jet pipe's tip."""
    z = s.pipe * p.gain / p.maximum_force * p.full_opening
    return soft_clip(z, p.travel_limit) if p.travel_limit > 0.0 else z


@jit
def static_force(p, s, relative, opening, t):
    """Return the force (N) at rest for a valve opening; the supply sags with use."""
    static = relative * p.maximum_force
    if p.saturates > 0.5:
        static = soft_clip(static, p.maximum_force)
    if p.force_limit > 0.0:
        static = soft_clip(static, p.force_limit)
    if p.supply_sag > 0.0:
        s.opened += STEP_S / p.supply_time * (abs(opening) - s.opened)
    return static * ((1.0 - p.supply_drop - p.supply_sag * s.opened)
                     * (1.0 - p.fading_gain * t / 10.0) * (1.0 + p.position_gain * s.x))


@jit
def damping_force(p, v, opening):
    """Return the hydraulic damping force (N) at a velocity v (m/s)."""
    against = (p.damping * v + p.turbulent * abs(v) * v
               + p.turbulent_opening * abs(opening) * v)
    if p.family <= 0.5:
        return against
    size = abs(opening)
    width = 0.198 * (1.0 + 0.217 * size)
    out_v = p.family_velocity - 0.422 * size + 0.112 * opening
    back_v = p.family_velocity - 0.422 * size - 0.112 * opening
    scale = 0.5 * p.family_force * (0.021 + 0.979 * size) * 2.0 / math.pi
    c = 0.5 * math.pi
    curve = (math.atan(c * (v - out_v) / width) + math.atan(c * (v + back_v) / width)
             + math.atan(c * out_v / width) - math.atan(c * back_v / width))
    return p.family_force * math.tanh((against + scale * curve) / p.family_force)


@jit
def advance_hydraulics(p, s, t):
    """Advance the hydraulic force by a sub-step."""
    relative = valve_position(p, s) / p.full_opening
    if p.orifice_deadband > 0.0:
        relative = soft_dead(relative, p.orifice_deadband)
    opening = soft_clip(relative, 1.0)
    static = static_force(p, s, relative, opening, t)
    against = damping_force(p, s.v, opening)
    loss = p.leak * s.hydraulic * (0.3 + 0.7 * abs(s.hydraulic) / 1000.0)
    rate = 2.0 * math.pi * p.fluid
    if p.air_time > 0.0:
        stiff = 1.0 + abs(s.hydraulic) / p.air_force
        rate = 1.0 / (1.0 / rate + p.air_time / (stiff * stiff))
    s.hydraulic += STEP_S * rate * (static - against - loss - s.hydraulic)


@jit
def friction(p, s):
    """Return the friction forces (N) of the nominal model and of the effects."""
    added = p.viscous * s.v
    if p.friction > 0.0:
        forward = p.friction * (1.0 + p.asymmetry)
        backward = p.friction * (1.0 - p.asymmetry)
        added += maxwell_slip(s.slips, s.v, forward, backward, forward * p.breakaway,
                              backward * p.breakaway, p.stribeck, p.slip_distance, p.dahl, STEP_S)
    base = 0.0
    if p.base_push > 0.0:
        base = maxwell_slip(s.base_slips, s.v, p.base_coulomb, p.base_coulomb, p.base_push,
                            p.base_pull, 0.005, 1.2e-4, 0.0, STEP_S)
    return base, added


@jit
def disturbance(p, s, t):
    """Return the disturbance force (N) at a time (s)."""
    push = p.push_constant
    if p.push_frequency > 0.0:
        push += p.push_sine * math.sin(2.0 * math.pi * p.push_frequency * t + p.push_phase)
    if p.push_burst != 0.0 and p.burst_start <= t < p.burst_end:
        push += p.push_burst
    if p.ripple != 0.0:
        push += p.ripple * math.sin(2.0 * math.pi * s.x / p.ripple_pitch)
    return push


@jit
def advance_mechanics(p, s, total):
    """Advance piston and load by a sub-step under a force (N)."""
    if p.gap > 0.0 or p.coupling > 0.0:
        stretch = s.x - s.load_x
        if p.gap > 0.0:
            contact = 0.0
            if abs(stretch) > p.gap:
                contact = (4e6 * (stretch - math.copysign(p.gap, stretch))
                           + 300.0 * (s.v - s.load_v))
        else:
            contact = p.coupling * stretch + 20.0 * (s.v - s.load_v)
        spring = p.stiffness * s.load_x + p.damper * s.load_v
        m1 = p.mass * p.piston_share
        s.v += STEP_S * (total - contact) / m1
        s.load_v += STEP_S * (contact - spring) / (p.mass - m1)
        s.load_x += STEP_S * s.load_v
    else:
        spring = (p.stiffness * s.x + p.damper * s.v
                  + p.cubic_spring * p.stiffness * s.x * s.x * s.x * 1e5)
        s.v += STEP_S * (total - spring) / p.mass
    s.x += STEP_S * s.v


@jit
def advance_sensor(p, s, force):
    """Advance the force sensor by a sub-step under a force (N)."""
    s.sensor_ring[s.at] = force
    delayed = s.sensor_ring[(s.at - int(p.sensor_delay / STEP_S)) % RING]
    if p.sensor_corner > 0.0:
        w = 2.0 * math.pi * p.sensor_corner
        s.sensed_rate += STEP_S * (w * w * (delayed - s.sensed) - 1.4 * w * s.sensed_rate)
        s.sensed += STEP_S * s.sensed_rate
    else:
        s.sensed = force
    if p.sensor_lag > 0.0:
        s.slow1 += STEP_S / (0.6 * p.sensor_lag) * (s.sensed - s.slow1)
        s.slow2 += STEP_S / (0.4 * p.sensor_lag) * (s.slow1 - s.slow2)


@jit
def sensor_output(p, s, t):
    """Return the force (N) at the output of the sensor, without noise."""
    force = s.sensed if p.sensor_lag <= 0.0 else s.slow2
    return (force * (1.0 + p.sensor_scale) + p.sensor_offset
            + p.drift * (1.0 - math.exp(-t / p.drift_time)))


@jit
def run(p, s, reference, bench, random, top, out):
    """
    Simulate; writes command N, force N, valve position m, position m, velocity m/s to out (5 x n).

    s: the state at rest; reference: n desired forces N if the loop is closed, else n valve
    commands N; random: 4 x n standard normal numbers for the noise, a fifth row of uniform ones
    for jitter and dropouts; top: the largest command, N.
    """
    for k in range(out.shape[1]):
        t = k * PERIOD_S
        force = sensor_output(p, s, t) + bench.noise[0] * random[0, k]
        command = reference[k]
        if bench.closed:
            command = bench.gain * (reference[k] - force) + reference[k] * bench.feed_forward
            command = min(max(command, -4000.0), 4000.0)
        out[0, k] = command
        out[1, k] = force
        out[2, k] = valve_position(p, s) + bench.noise[1] * random[1, k]
        out[3, k] = s.x + bench.noise[2] * random[2, k]
        out[4, k] = s.v + bench.noise[3] * random[3, k]
        applied, delay = transmitted(p, s, k, command, random[4, k])
        for _ in range(SUBSTEPS):
            advance_valve(p, s, hysteresis(p, s, received(p, s, applied, delay), top))
            advance_hydraulics(p, s, t)
            base, added = friction(p, s)
            measured = s.hydraulic - base - (added if p.friction_inside > 0.5 else 0.0)
            advance_mechanics(p, s, s.hydraulic - base - added + disturbance(p, s, t))
            advance_sensor(p, s, measured)


def rest() -> np.void:
    """Return the state of the plant at rest, with half of the relays up."""
    state = np.zeros(1, STATE)[0]
    state['hold_until'] = -1
    threshold = np.arange(RELAYS) + np.arange(WIDTHS)[:, None] / WIDTHS
    state['relays'] = np.where(threshold + 0.5 / WIDTHS < RELAYS / 2, 1.0, -1.0)
    return state


def plant(values: dict[str, float]) -> np.void:
    """Return the record of the plant's parameters; those not given are zero or neutral."""
    record = np.zeros(1, PLANT)[0]
    record['drift_time'] = record['supply_time'] = record['ripple_pitch'] = 1.0
    record['base_lag'] = 1e-3
    record['slip_distance'] = 5e-5
    for name, value in values.items():
        record[name] = value
    return record


def simulate(p: np.void, reference: npt.NDArray[np.float64], bench: Bench, seed: int
             ) -> npt.NDArray[np.float64]:
    """Return command, force, valve position, position and velocity: 5 x n samples at 1 kHz."""
    rng = np.random.default_rng(seed)
    random = np.vstack([rng.standard_normal((4, reference.size)), rng.random(reference.size)])
    if bench.colour:
        fresh = math.sqrt(1.0 - bench.colour ** 2)   # so that the noise stays as strong
        random[:4] = lfilter([fresh], [1.0, -bench.colour], random[:4])
    out = np.empty((5, reference.size))
    top = 4000.0 if bench.closed else 1.2 * float(np.abs(reference).max())
    run(p, rest(), reference, bench, random, top, out)
    return out
