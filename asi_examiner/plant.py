"""
The examiner's own plant: the actuator of the paper with one or two effects that are withheld.

Semi-implicit Euler at 10 us, while the diagnosis never takes steps below 100 us. Formulations
that differ from the diagnosis': hysteresis by Bouc and Wen, or a Preisach sum of relays, against
plays; friction by generalised Maxwell slip with an exponential Stribeck curve, or by Dahl, against
an elasto-plastic bristle; extra lags of second order; a delay that jitters; quadratic corners;
quadratic leakage; oil whose stiffness grows with the square of the pressure; backlash and
compliance with two masses and a contact; warm-up drift; steps and bursts of disturbance.
"""

import math
from typing import NamedTuple

import numba
import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter

STEP_S = 1e-5
PERIOD_S = 1e-3
RELAYS = 240          # thresholds of the Preisach plane, for each width
WIDTHS = 5
SLIPS = 4             # elements of the Maxwell-slip friction
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
    'push_constant', 'push_sine', 'push_frequency', 'push_burst', 'burst_start', 'burst_end',
    'sensor_offset', 'sensor_scale', 'sensor_lag', 'drift', 'drift_time',
    # outside the vocabulary
    'slew', 'one_sided_gain', 'cubic_spring', 'fading_gain', 'dropout', 'ripple', 'ripple_pitch',
    'resonance', 'resonance_share', 'position_gain',
)


class Bench(NamedTuple):
    """How a machine is run and measured."""

    closed: bool
    gain: float           # of the closed loop
    feed_forward: float
    noise: npt.NDArray[np.float64]   # of force N, valve position m, position m, velocity m/s
    colour: float         # correlation of the noise from sample to sample


PLANT = np.dtype([(name, np.float64) for name in FIELDS])
jit = numba.njit(cache=True)


@jit
def soft_clip(x, limit):
    """Return x clipped at the limit, with a corner that is a parabola over a tenth of it."""
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
    """Return x less a dead zone whose corners are rounded by a twentieth of it."""
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

    elements: SLIPS springs, as shares of their own slip force; or a single state after Dahl.
    Forward or backward is which way an element is bent: by the sign of the velocity, the force of
    one that sticks would jump with every tremor, and push.
    """
    fall = math.exp(-abs(v) / stribeck) if stribeck > 0.0 else 0.0
    ahead = forward + (forward_break - forward) * fall
    back = backward + (backward_break - backward) * fall
    if dahl > 0.5:
        s = elements[0]
        elements[0] = s + h * v / distance * (1.0 - s * (1.0 if v >= 0.0 else -1.0))
        return (ahead if s >= 0.0 else back) * elements[0]
    total = 0.0
    for i in range(SLIPS):
        reach = distance * (0.4 + 0.4 * i)
        s = min(max(elements[i] + h * v / reach, -1.0), 1.0)
        elements[i] = s
        total += (ahead if s >= 0.0 else back) * s / SLIPS
    return total


@jit
def preisach(relays, u, top, width):
    """Return the output of the relays at an input u; updates them."""
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
def run(p, reference, closed, kp, feed_forward, random, noise, top, out):
    """
    Put command N, force N, valve position m, position m and velocity m/s into out (5 x n).

    reference: n desired forces N if closed, else n valve commands N; random: n x 4 standard
    normal numbers for the noise, n more (last row) uniform ones for jitter and dropouts.
    """
    n = out.shape[1]
    inner = int(round(PERIOD_S / STEP_S))
    h = STEP_S
    ring = np.zeros(RING)
    relays = np.empty((WIDTHS, RELAYS))
    for j in range(WIDTHS):
        for i in range(RELAYS):
            relays[j, i] = 1.0 if (i + (j + 0.5) / WIDTHS) < RELAYS / 2 else -1.0
    slips = np.zeros(SLIPS)
    base_slips = np.zeros(SLIPS)
    bouc, base_bouc, u_old, looped_u, base_u = 0.0, 0.0, 0.0, 0.0, 0.0
    slewed, base_lagged, lag1, lag2, coil, pipe, pipe_rate = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    resonant, resonant_rate = 0.0, 0.0
    opened, hydraulic = 0.0, 0.0
    x, v, load_x, load_v = 0.0, 0.0, 0.0, 0.0
    sensed, sensed_rate, slow1, slow2 = 0.0, 0.0, 0.0, 0.0
    sensor_ring = np.zeros(RING)
    at = 0
    held = 0.0
    hold_until = -1
    two_masses = p.gap > 0.0 or p.coupling > 0.0
    w_pipe = 2.0 * math.pi * p.pipe
    w_sensor = 2.0 * math.pi * p.sensor_corner
    w_res = 2.0 * math.pi * p.resonance
    for k in range(n):
        t = k * PERIOD_S
        z = pipe * p.gain / p.maximum_force * p.full_opening
        if p.travel_limit > 0.0:
            z = soft_clip(z, p.travel_limit)
        reading = (sensed if p.sensor_lag <= 0.0 else slow2)
        reading = (reading * (1.0 + p.sensor_scale) + p.sensor_offset
                   + p.drift * (1.0 - math.exp(-t / p.drift_time)))
        force = reading + noise[0] * random[0, k]
        command = reference[k]
        if closed:
            command = kp * (reference[k] - force) + reference[k] * feed_forward
            command = min(max(command, -4000.0), 4000.0)
        out[0, k] = command
        out[1, k] = force
        out[2, k] = z + noise[1] * random[1, k]
        out[3, k] = x + noise[2] * random[2, k]
        out[4, k] = v + noise[3] * random[3, k]
        if p.dropout > 0.0 and k > hold_until and random[4, k] < p.dropout:
            hold_until = k + 40
        if k > hold_until:
            held = command
        applied = held
        if p.quantum > 0.0:
            applied = p.quantum * math.floor(applied / p.quantum) + 0.5 * p.quantum
        wait = p.delay + p.extra_delay * (1.0 + p.jitter * (2.0 * random[4, k] - 1.0))
        whole = int(wait / h)
        for _ in range(inner):
            at = (at + 1) % RING
            ring[at] = applied
            u = ring[(at - whole) % RING] + p.bias
            if p.slew > 0.0:
                slewed += min(max(u - slewed, -p.slew * h), p.slew * h)
                u = slewed
            # What is in both worlds of the full model: a rounded loop, and a lag for its growth.
            if p.base_hysteresis > 0.0:
                du = u - base_u
                base_u = u
                base_bouc += (du - abs(du) * base_bouc) / p.base_hysteresis
                base_bouc = min(max(base_bouc, -1.0), 1.0)
                base_lagged += h / p.base_lag * (u - p.base_hysteresis * base_bouc - base_lagged)
                u = base_lagged
            if p.loop_width > 0.0:
                if p.loop_preisach > 0.5:
                    if u != u_old:
                        looped_u = preisach(relays, u, top, p.loop_width)
                        u_old = u
                    u = looped_u
                else:
                    du = u - u_old
                    u_old = u
                    grip = abs(bouc) ** p.loop_exponent
                    side = 1.0 if bouc * du >= 0.0 else -1.0
                    bouc += du / p.loop_width * (1.0 - grip * (0.5 + 0.5 * side))
                    bouc = min(max(bouc, -1.0), 1.0)
                    u -= p.loop_width * bouc
            if p.deadband > 0.0:
                u = soft_dead(u, p.deadband)
            if p.one_sided_gain != 0.0 and u > 0.0:
                u *= 1.0 + p.one_sided_gain
            if p.extra_lag > 0.0:
                lag1 += h / (0.7 * p.extra_lag) * (u - lag1)
                lag2 += h / (0.3 * p.extra_lag) * (lag1 - lag2)
                u = lag2
            coil += h * 2.0 * math.pi * p.coil * (u - coil)
            drive = coil
            if p.resonance > 0.0:
                resonant_rate += h * (w_res * w_res * (coil - resonant)
                                      - 0.1 * w_res * resonant_rate)
                resonant += h * resonant_rate
                drive = coil + p.resonance_share * (resonant - coil)
            pipe_rate += h * (w_pipe * w_pipe * (drive - pipe)
                              - 2.0 * p.pipe_damping * w_pipe * pipe_rate)
            pipe += h * pipe_rate

            z = pipe * p.gain / p.maximum_force * p.full_opening
            if p.travel_limit > 0.0:
                z = soft_clip(z, p.travel_limit)
            relative = z / p.full_opening
            if p.orifice_deadband > 0.0:
                relative = soft_dead(relative, p.orifice_deadband)
            static = relative * p.maximum_force
            opening = soft_clip(relative, 1.0)
            if p.saturates > 0.5:
                static = soft_clip(static, p.maximum_force)
            if p.force_limit > 0.0:
                static = soft_clip(static, p.force_limit)
            if p.supply_sag > 0.0:
                opened += h / p.supply_time * (abs(opening) - opened)
            static *= ((1.0 - p.supply_drop - p.supply_sag * opened)
                       * (1.0 - p.fading_gain * t / 10.0) * (1.0 + p.position_gain * x))
            against = (p.damping * v + p.turbulent * abs(v) * v
                       + p.turbulent_opening * abs(opening) * v)
            if p.family > 0.5:
                size = abs(opening)
                width = 0.198 * (1.0 + 0.217 * size)
                out_v = p.family_velocity - 0.422 * size + 0.112 * opening
                back_v = p.family_velocity - 0.422 * size - 0.112 * opening
                scale = 0.5 * p.family_force * (0.021 + 0.979 * size) * 2.0 / math.pi
                c = 0.5 * math.pi
                curve = (math.atan(c * (v - out_v) / width) + math.atan(c * (v + back_v) / width)
                         + math.atan(c * out_v / width) - math.atan(c * back_v / width))
                against += scale * curve
                against = p.family_force * math.tanh(against / p.family_force)
            loss = p.leak * hydraulic * (0.3 + 0.7 * abs(hydraulic) / 1000.0)
            rate = 2.0 * math.pi * p.fluid
            if p.air_time > 0.0:
                stiff = 1.0 + abs(hydraulic) / p.air_force
                rate = 1.0 / (1.0 / rate + p.air_time / (stiff * stiff))
            hydraulic += h * rate * (static - against - loss - hydraulic)

            rub = p.viscous * v
            if p.friction > 0.0:
                forward = p.friction * (1.0 + p.asymmetry)
                backward = p.friction * (1.0 - p.asymmetry)
                rub += maxwell_slip(slips, v, forward, backward, forward * p.breakaway,
                                    backward * p.breakaway, p.stribeck, p.slip_distance, p.dahl, h)
            base = 0.0
            if p.base_push > 0.0:
                base = maxwell_slip(base_slips, v, p.base_coulomb, p.base_coulomb, p.base_push,
                                    p.base_pull, 0.005, 1.2e-4, 0.0, h)
            sensed_force = hydraulic - base - (rub if p.friction_inside > 0.5 else 0.0)
            push = p.push_constant
            time = t + 0.0
            if p.push_frequency > 0.0:
                push += p.push_sine * math.sin(2.0 * math.pi * p.push_frequency * time)
            if p.push_burst != 0.0 and p.burst_start <= time < p.burst_end:
                push += p.push_burst
            if p.ripple != 0.0:
                push += p.ripple * math.sin(2.0 * math.pi * x / p.ripple_pitch)
            total = hydraulic - base - rub + push
            if two_masses:
                stretch = x - load_x
                if p.gap > 0.0:
                    contact = 0.0
                    if abs(stretch) > p.gap:
                        contact = (4e6 * (stretch - math.copysign(p.gap, stretch))
                                   + 300.0 * (v - load_v))
                else:
                    contact = p.coupling * stretch + 20.0 * (v - load_v)
                spring = p.stiffness * load_x + p.damper * load_v
                m1 = p.mass * p.piston_share
                v += h * (total - contact) / m1
                load_v += h * (contact - spring) / (p.mass - m1)
                load_x += h * load_v
            else:
                spring = (p.stiffness * x + p.damper * v
                          + p.cubic_spring * p.stiffness * x * x * x * 1e5)
                v += h * (total - spring) / p.mass
            x += h * v

            sensor_ring[at] = sensed_force
            late = sensor_ring[(at - int(p.sensor_delay / h)) % RING]
            if p.sensor_corner > 0.0:
                sensed_rate += h * (w_sensor * w_sensor * (late - sensed)
                                    - 1.4 * w_sensor * sensed_rate)
                sensed += h * sensed_rate
            else:
                sensed = sensed_force
            if p.sensor_lag > 0.0:
                slow1 += h / (0.6 * p.sensor_lag) * (sensed - slow1)
                slow2 += h / (0.4 * p.sensor_lag) * (slow1 - slow2)


def plant(values: dict[str, float]) -> np.void:
    """Return the record of the plant's parameters; what is not given is zero."""
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
    run(p, reference, bench.closed, bench.gain, bench.feed_forward, random, bench.noise, top, out)
    return out
