"""
Joints of the examiner: arms that turn and axes under a torque or a force, and servos.

Semi-implicit Euler at 50 us; other formulations than the diagnosis: LuGre friction or a smooth
Stribeck curve, two masses with a contact for backlash and compliance, a fractional delay, lags of
one or two poles, an encoder. Half of the arms have gravity, a quarter of all a spring. The user
gives no model: the nominal joint is what the recording shows.
"""

import math
from typing import Final, NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from asi_analysis.bags.run import Run

Array = npt.NDArray[np.float64]
Values = dict[str, float]

STEP_S: Final = 5e-5
DURATION_S: Final = 12.0
RATES_HZ: Final = (250.0, 500.0, 1000.0)
RING: Final = 4096
MOST_DRAWS: Final = 60
VISIBLE: Final = 0.06    # share of the signal that nothing nominal explains
ENCODER_BITS: Final = (14, 16, 18)
FIELDS: Final = (
    'inertia', 'damping', 'gravity', 'gravity_zero', 'spring', 'offset',
    # effects
    'friction', 'breakaway', 'stribeck', 'bristle', 'asymmetry', 'lugre', 'delay', 'lag', 'split',
    'gap',
    'coupling', 'load_share', 'push_sine', 'push_frequency', 'push_burst', 'burst_start',
    'burst_end', 'quantum', 'deadband',
    # outside the vocabulary
    'ripple', 'teeth', 'cubic_spring', 'fading_gain', 'varying_inertia',
    # servo
    'pulsation', 'ratio')

FORCED = {'coulomb_friction': 'mechanics', 'stiction': 'mechanics',
          'friction_asymmetry': 'mechanics', 'backlash': 'mechanics',
          'load_compliance': 'mechanics', 'disturbance_force': 'mechanics',
          'transport_delay': 'command_path', 'valve_lag': 'valve'}
FOLLOWING = {'transport_delay': 'command_path', 'valve_lag': 'valve',
             'command_quantisation': 'command_path', 'backlash': 'mechanics'}
OUTSIDE = {'forced': ('ripple', 'cubic_spring', 'fading_gain', 'varying_inertia'),
           'servo': ('ripple', 'fading_gain')}
# A servo has a response of its own, which the user has not told: it is one of these.
OF_A_SERVO = ('transport_delay', 'valve_lag')


class JointCase(NamedTuple):
    """A blind case of a joint: the recordings and the true answer."""

    kind: str
    effects: tuple[str, ...]
    blocks: tuple[str, ...]
    excitation: str
    visibility: float   # rms of what nothing nominal explains, as a share of the signal
    rate_hz: float
    runs: tuple[Run, ...]
    plant: np.void
    also: tuple[str, ...]   # what is there too


def _record(values: Values) -> np.void:
    p = np.zeros(1, [(name, np.float64) for name in FIELDS])[0]
    for name, value in values.items():
        p[name] = value
    return p


@numba.njit(cache=True)
def friction(p, speed, bristle):
    """Return the friction at a speed, and the slope of LuGre's bristle."""
    if p.friction == 0.0:
        return 0.0, 0.0
    level = p.friction * (1.0 + (p.breakaway - 1.0) * math.exp(-(speed / p.stribeck) ** 2))
    level *= 1.0 + p.asymmetry * (1.0 if speed > 0.0 else -1.0)
    if p.lugre < 0.5:
        return level * math.tanh(speed / (0.05 * p.stribeck)), 0.0
    stiffness = p.friction / p.bristle
    slope = speed - stiffness * abs(speed) / level * bristle
    return stiffness * bristle + 0.3 * math.sqrt(stiffness * p.inertia) * slope * math.exp(
        -(speed / p.stribeck) ** 2), slope


@numba.njit(cache=True)
def delayed(p, first, lag, wanted):
    """Return the two states of a lag after a sub-step: its time is split between them."""
    if p.split > 0.0:
        first += STEP_S / (p.split * p.lag) * (wanted - first)
    else:
        first = wanted
    return first, lag + STEP_S / ((1.0 - p.split) * p.lag) * (first - lag)


@numba.njit(cache=True)
def forced(p, course, stiffness, substeps, out):
    """
    Put command and position (of the motor) of a joint under a PD loop into out (2 x n).

    stiffness: of the loop; its damping is a half of critical.
    """
    ring, at = np.zeros(RING), 0
    angle, speed, load, load_speed, bristle = course[0], 0.0, course[0], 0.0, 0.0
    two = p.gap > 0.0 or p.coupling > 0.0
    mass = p.inertia * (1.0 - p.load_share) if two else p.inertia
    far = p.inertia * p.load_share
    contact = p.coupling if p.coupling > 0.0 else 4e5 * p.inertia
    contact_damping = 0.3 * math.sqrt(contact * far) if two else 0.0
    damping = math.sqrt(stiffness * p.inertia)
    held = p.gravity * math.sin(course[0] - p.gravity_zero) + p.spring * course[0] + p.offset
    ring[:] = held
    first, lag = held, held
    for k in range(course.size):
        out[0, k] = held + stiffness * (course[k] - angle) - damping * speed
        out[1, k] = angle
        for j in range(substeps):
            at = (at + 1) % RING
            ring[at] = out[0, k]
            back = p.delay / STEP_S
            whole = int(back)
            part = back - whole
            torque = ((1.0 - part) * ring[(at - whole) % RING]
                      + part * ring[(at - whole - 1) % RING])
            if p.lag > 0.0:
                first, lag = delayed(p, first, lag, torque)
                torque = lag
            time = (k + j / substeps) * substeps * STEP_S
            torque *= 1.0 - p.fading_gain * time / DURATION_S
            torque -= p.offset - p.push_sine * math.sin(2.0 * math.pi * p.push_frequency * time)
            if p.burst_start < time < p.burst_end:
                torque += p.push_burst
            x = load if two else angle
            pull = (p.gravity * math.sin(x - p.gravity_zero) + p.spring * x
                    + p.cubic_spring * x ** 3 + p.ripple * math.sin(p.teeth * x))
            rub, slope = friction(p, speed, bristle)
            bristle += STEP_S * slope
            if two:
                apart = angle - load
                over = 0.0
                if apart > p.gap:
                    over = apart - p.gap
                elif apart < -p.gap:
                    over = apart + p.gap
                push = 0.0
                if over != 0.0 or p.gap == 0.0:
                    push = contact * over + contact_damping * (speed - load_speed)
                speed += STEP_S / mass * (torque - rub - push)
                load_speed += STEP_S / far * (push - pull - p.damping * load_speed)
                load += STEP_S * load_speed
            else:
                own = mass * (1.0 + p.varying_inertia * math.cos(2.0 * angle))
                speed += STEP_S / own * (torque - rub - pull - p.damping * speed)
            angle += STEP_S * speed


@numba.njit(cache=True)
def following(p, course, substeps, out):
    """Put the reference and the position of a servo into out (2 x n)."""
    ring, at = np.full(RING, course[0]), 0
    position, speed, play = course[0], 0.0, course[0]
    first, lag = course[0], course[0]
    for k in range(course.size):
        out[0, k] = course[k]
        out[1, k] = (1.0 - p.fading_gain * k / course.size) * play + p.ripple * math.sin(
            p.teeth * play)
        reference = course[k]
        if p.quantum > 0.0:
            reference = p.quantum * math.floor(reference / p.quantum + 0.5)
        for _ in range(substeps):
            at = (at + 1) % RING
            ring[at] = reference
            wanted = ring[(at - int(p.delay / STEP_S)) % RING]
            if p.lag > 0.0:
                first, lag = delayed(p, first, lag, wanted)
                wanted = lag
            push = p.pulsation ** 2 * (wanted - position) - 2.0 * p.ratio * p.pulsation * speed
            speed += STEP_S * push
            position += STEP_S * speed
            play = min(max(play, position - p.gap), position + p.gap)


def _log(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(math.log(low), math.log(high))))


def _course(rng: np.random.Generator, period: float, size: float, kind: str) -> Array:
    """Return a course of a kind, of this size."""
    time = np.arange(round(DURATION_S / period)) * period
    if kind == 'waves':
        waves = [np.sin(2.0 * np.pi * _log(rng, 0.15, 4.0) * time + rng.uniform(0.0, 6.3))
                 for _ in range(int(rng.integers(3, 7)))]
        course = np.sum([wave * _log(rng, 0.2, 1.0) for wave in waves], axis=0)
    elif kind == 'rests':
        course = (np.sin(2.0 * np.pi * rng.uniform(0.2, 0.4) * time) ** 3
                  + 0.25 * np.sin(2.0 * np.pi * rng.uniform(1.2, 2.5) * time))
    else:   # from level to level, smoothly
        levels = np.repeat(rng.uniform(-1.0, 1.0, 60), round(rng.uniform(0.3, 0.9) / period))
        width = round(0.12 / period)
        course = np.convolve(np.resize(levels, time.size + 2 * width), np.hanning(width) / np.sum(
            np.hanning(width)), 'same')[width:width + time.size]
    return size * np.asarray(course) / float(np.abs(course).max())


def _unexplained(shapes: Array, signal: Array) -> float:
    """Return the residual of linear least squares, as a share of the signal (rms)."""
    columns = np.column_stack([shapes.T, np.ones(signal.size)])
    size = np.sqrt(np.mean(columns ** 2, axis=0)) + 1e-30
    residual = signal - columns @ (np.linalg.lstsq(columns / size, signal)[0] / size)
    return float(residual.std() / signal.std())


def _visibility(servo: bool, without: Values, course: Array, stiffness: float, substeps: int,
                recorded: Array) -> float:
    """Return the share of a signal that the joint without its effect does not explain."""
    if servo:
        own = np.empty_like(recorded)
        following(_record(without), course, substeps, own)
        return float(np.std(recorded[1] - own[1]) / np.std(recorded[1]))
    x = recorded[1]
    speed = np.gradient(x, substeps * STEP_S)
    shapes = np.array([np.gradient(speed, substeps * STEP_S), speed, x, np.sin(x), np.cos(x)])
    window = np.hanning(max(round(0.02 / (substeps * STEP_S)), 3))
    window /= window.sum()
    inner = slice(2 * window.size, -2 * window.size)
    smooth = [np.convolve(each, window, 'same')[inner] for each in (*shapes, recorded[0])]
    return _unexplained(np.array(smooth[:-1]), smooth[-1])


def _effect(name: str, rng: np.random.Generator, servo: bool, size: float, speed: float,
            torque: float, inertia: float) -> Values:
    """Return the plant's parameters of an effect; size of motion, speed and torque as they are."""
    rub = {'friction': _log(rng, 0.1, 0.6) * torque, 'breakaway': 1.0, 'stribeck': 0.1 * speed,
           'bristle': _log(rng, 3e-4, 1e-2) * size, 'lugre': float(rng.random() < 0.7)}
    sign = 1.0 if rng.random() < 0.5 else -1.0
    choices: dict[str, Values] = {
        'coulomb_friction': rub,
        'stiction': rub | {'breakaway': rng.uniform(1.8, 3.5), 'lugre': 1.0,
                           'stribeck': _log(rng, 0.05, 0.3) * speed},
        # An offset is the same as more friction one way.
        'friction_asymmetry': rub | {'asymmetry': sign * rng.uniform(0.3, 0.7), 'offset': 0.0},
        'backlash': {'gap': _log(rng, 0.003, 0.05) * size, 'load_share': rng.uniform(0.4, 0.8)},
        'load_compliance': {'load_share': rng.uniform(0.4, 0.8),
                            'coupling': inertia * (2.0 * math.pi * _log(rng, 6.0, 20.0)) ** 2},
        'disturbance_force': ({'push_sine': _log(rng, 0.1, 0.5) * torque,
                               'push_frequency': _log(rng, 0.5, 12.0)} if rng.random() < 0.6 else
                              {'push_burst': sign * _log(rng, 0.3, 1.0) * torque,
                               'burst_start': rng.uniform(1.0, 4.0),
                               'burst_end': rng.uniform(5.0, 9.0)}),
        'transport_delay': {'delay': _log(rng, 0.006, 0.04)},
        'valve_lag': {'lag': _log(rng, 0.008, 0.06), 'split': rng.choice([0.0, 0.3, 0.5])},
        'command_quantisation': {'quantum': _log(rng, 0.05, 0.3) * size},
        'ripple': {'ripple': _log(rng, 0.1, 0.5) * (0.3 * size if servo else torque),
                   'teeth': rng.uniform(12.0, 40.0) / size},
        'cubic_spring': {'cubic_spring': _log(rng, 0.5, 2.0) * torque / size ** 3},
        'fading_gain': {'fading_gain': rng.uniform(0.3, 0.6)},
        'varying_inertia': {'varying_inertia': sign * rng.uniform(0.4, 0.8)},
    }
    return choices[name]


def draw_joint(seed: int, recordings: int = 1, mixed: bool = False) -> JointCase:
    """
    Return the case of a seed, with so many recordings.

    mixed: every joint has an effect, and beside it something outside the vocabulary; each of them
    can be seen alone.
    """
    rng = np.random.default_rng([seed, 21])
    servo, turns = rng.random() < 0.3, bool(rng.random() < 0.7)
    rate = float(rng.choice(RATES_HZ))
    substeps = round(1.0 / rate / STEP_S)
    size = _log(rng, 0.3, 1.5) * (1.0 if turns else 0.2)
    inertia = _log(rng, 0.01, 3.0) if turns else _log(rng, 0.5, 50.0)
    kinds = ('waves', 'rests', 'levels')
    excitation = str(rng.choice(kinds))
    values: Values = {'inertia': inertia, 'stribeck': 1.0, 'bristle': 1.0}
    course = _course(rng, substeps * STEP_S, size, excitation)
    moved = np.gradient(course, substeps * STEP_S)
    speed = 1.5 * float(moved.std())
    values['damping'] = inertia * _log(rng, 0.3, 3.0)
    # Torque (or force) that the motion takes.
    usual = float(np.std(inertia * np.gradient(moved, substeps * STEP_S)
                         + values['damping'] * moved))
    if servo:
        values |= {'pulsation': _log(rng, 30.0, 150.0), 'ratio': rng.uniform(0.5, 1.0)}
    else:
        if turns and rng.random() < 0.5:
            values |= {'gravity': _log(rng, 0.3, 3.0) * usual,
                       'gravity_zero': rng.uniform(-3.1, 3.1)}
        if rng.random() < 0.25:
            values['spring'] = _log(rng, 0.3, 2.0) * usual / size
        values['offset'] = rng.uniform(-0.2, 0.2) * usual
    stiffness = inertia * _log(rng, 40.0, 90.0) ** 2
    effects = FOLLOWING if servo else FORCED
    outside = OUTSIDE['servo' if servo else 'forced']
    kind = 'mixed' if mixed else str(rng.choice(['effect', 'none', 'outside'],
                                                p=[0.65, 0.18, 0.17]))
    if servo and kind == 'none':
        kind = 'effect'
    for _ in range(MOST_DRAWS):
        drawn = [str(rng.choice(outside if kind == 'outside' else list(effects)))]
        if mixed:
            drawn.append(str(rng.choice(outside)))
        chosen = () if kind == 'none' else tuple(drawn)
        changes = [_effect(name, rng, servo, size, speed, usual, inertia) for name in chosen]
        plant = _record({key: value for change in (values, *changes)
                         for key, value in change.items()})
        recorded = _simulated(servo, plant, course, stiffness, substeps)
        if not np.abs(recorded[1]).max() < 5.0 * size:   # not a number, or unstable
            continue
        alone = [recorded] if len(changes) < 2 else [
            _simulated(servo, _record(values | change), course, stiffness, substeps)
            for change in changes]
        share = min(_visibility(servo, values, course, stiffness, substeps, each)
                    for each in alone)
        if kind == 'none' or share > VISIBLE:
            break
    else:
        raise ValueError(f'seed {seed}: no {kind} can be seen')
    runs = [_run(servo, turns, rate, recorded, size, rng)]
    for _ in range(recordings - 1):
        course = _course(rng, substeps * STEP_S, size * rng.uniform(0.6, 1.0),
                         str(rng.choice(kinds)))
        runs.append(_run(servo, turns, rate, _simulated(servo, plant, course, stiffness, substeps),
                         size, rng))
    return JointCase(kind, chosen, tuple(effects[each] for each in chosen if each in effects),
                     excitation, share, rate, tuple(runs), plant, OF_A_SERVO * servo)


def _simulated(servo: bool, plant: np.void, course: Array, stiffness: float, substeps: int
               ) -> Array:
    """Return the recorded signals (2 x n) without noise: command or reference, position."""
    out = np.empty((2, course.size))
    if servo:
        following(plant, course, substeps, out)
    else:
        forced(plant, course, stiffness, substeps, out)
    return out


def _run(servo: bool, turns: bool, rate: float, recorded: Array, size: float,
         rng: np.random.Generator) -> Run:
    """Return a recording as a user has it: an encoder, a little noise of the current."""
    count = (2.0 * np.pi if turns else 10.0 * size) / 2 ** int(rng.choice(ENCODER_BITS))
    position = count * np.round(recorded[1] / count)
    driving = recorded[0]
    if not servo:
        driving = driving + rng.uniform(0.002, 0.01) * driving.std() * rng.standard_normal(
            driving.size)
    units = {'position': 'rad' if turns else 'm',
             'reference' if servo else 'command': ('rad' if turns else 'm') if servo
             else ('Nm' if turns else 'N')}
    time = 1.0 + np.arange(position.size) / rate
    return Run(time, position_m=position, information={'signals': units}, **{
        'reference_n' if servo else 'command_n': driving})


class Machine(NamedTuple):
    """
    A joint that turns under a PD loop, without any effect, and what it may do.

    values: its parameters; size: half of its travel, rad; speed: its largest, rad/s; torque: what
    a usual motion takes (rms), Nm; stiffness: of the loop, Nm/rad.
    """

    values: Values
    size: float
    speed: float
    torque: float
    stiffness: float
    rate_hz: float = 250.0


def draw_machine(seed: int) -> Machine:
    """Return the machine of a seed, without gravity and spring."""
    rng = np.random.default_rng([seed, 22])
    size, inertia = _log(rng, 0.3, 1.5), _log(rng, 0.01, 3.0)
    speed = 2.0 * math.pi * size * _log(rng, 0.5, 1.2)
    damping = inertia * _log(rng, 0.3, 3.0)
    torque = math.hypot(inertia * speed ** 2 / size, damping * speed) / math.sqrt(2.0)
    return Machine({'inertia': inertia, 'damping': damping, 'stribeck': 1.0, 'bristle': 1.0},
                   size, speed, torque, inertia * _log(rng, 40.0, 90.0) ** 2)


def with_suspect(machine: Machine, name: str, rng: np.random.Generator) -> Values:
    """Return the parameters of a machine with a suspect, whose size is drawn."""
    own = machine.values
    sign = 1.0 if rng.random() < 0.5 else -1.0
    also: dict[str, Values] = {
        'viscous_friction': {'damping': own['damping'] + _log(rng, 0.2, 0.6) * machine.torque
                             / machine.speed},
        'gravity': {'gravity': _log(rng, 0.3, 3.0) * machine.torque,
                    'gravity_zero': rng.uniform(-3.1, 3.1)},
        'spring': {'spring': _log(rng, 0.3, 2.0) * machine.torque / machine.size},
        'mass': {'inertia': own['inertia'] * (1.0 + sign * rng.uniform(0.35, 0.5))}}
    return own | (also[name] if name in also else _effect(
        name, rng, False, machine.size, machine.speed, machine.torque, own['inertia']))


def moved(machine: Machine, values: Values, course: Array, rng: np.random.Generator) -> Run | None:
    """Return the recording of a joint that follows a course (rad); None if it is unstable."""
    substeps = round(1.0 / machine.rate_hz / STEP_S)
    recorded = _simulated(False, _record(values), course, machine.stiffness, substeps)
    if not np.abs(recorded[1]).max() < 2.0 * np.abs(course).max():
        return None
    return _run(False, True, machine.rate_hz, recorded, machine.size, rng)
