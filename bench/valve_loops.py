"""
Simulated control loops with a known fault: the data for the attribution by shape.

Two families of models with different equations, one for training and one for validation; both
with PI, PID and cascade control. 'learn': first-order processes with a lag and a delay or an
integrator; stiction of Choudhury and Kano, play, sum of plays, smooth saturation. 'judge':
processes of third order, also with inverse response; stiction of He with random friction and a lag
of the stem, compliant play, hysteresis of Duhem (Coleman and Hodgdon), a valve of short stroke.

Half of the disturbances jump: sawtooth, square and trapezoid in 'learn'; in 'judge' a step that
decays, a stair, and levels of random size.

The fault is the cause by construction: without noise the loop oscillates with it and comes to rest
without it. Unit of time: the controller's period; unit of valve position: the width of the fault.
"""

from typing import Final, NamedTuple

import numpy as np
from scipy import signal

from asi_actuator.model.valve_hysteresis import play as play_step
from asi_analysis.arrays import Array
from asi_analysis.bags.run import Run
from asi_analysis.limit_cycle.attribution.shape import prominent_frequency
from asi_analysis.limit_cycle.attribution.valves import Stem, stick_step
from asi_analysis.measures.oscillation import of_samples
from asi_common.jit import jit

Random = np.random.Generator

# Largest ratio of the measured frequency to that of the simulated oscillation.
VISIBLE: Final = 1.5
# Share of the disturbances that jump.
JUMPING: Final = 0.5
# Share of the loops that are inner loops of a cascade.
CASCADED: Final = 0.35
# Amplitude below which a simulated loop is at rest.
NOISE_FLOOR: Final = 5e-5
# Steps of the simulation in a period of the controller, and the least lag in such periods.
SUBSTEPS: Final = 4
LEAST_LAG: Final = 1e-3
# Kinds of valve, as numbers for compiled code.
LINEAR, KANO, PLAY, PLAYS, HE, SOFT_PLAY, DUHEM, SHORT, SOFT_END = range(9)
VALVES: Final = {
    'learn': {'stiction': KANO, 'backlash': PLAY, 'hysteresis': PLAYS, 'saturation': SOFT_END},
    'judge': {'stiction': HE, 'backlash': SOFT_PLAY, 'hysteresis': DUHEM,
              'saturation': SHORT}}


class Plant(NamedTuple):
    """
    A process of gain 1 and its controller; times in periods of the controller.

    lags: three; the first is the integral time if the process integrates; inverse: time of a zero
    in the right half plane; derivative and filter time of the controller's input. In a cascade the
    set point comes from an outer loop: an integrator of time `tank` under PI control.
    """

    lags: tuple[float, float, float]
    delay: float
    integrating: bool
    inverse: float
    gain: float
    integral: float
    derivative: float
    filter: float
    tank: float = 0.0             # 0: no outer loop
    tank_gain: float = 0.0
    tank_integral: float = 1.0


class Valve(NamedTuple):
    """A valve: its kind, stick band or width, slip jump, scatter of the band, lag of the stem."""

    kind: int = LINEAR
    band: float = 0.0
    slip_jump: float = 0.0
    scatter: float = 0.0
    lag: float = 0.0


@jit
def _moved(kind, u, before, stem, plays, band, slip_jump):
    """Return the valve after the command went from `before` to `u`; plays: changed in place."""
    position = stem.position
    push = u - position
    if kind == KANO:
        return stick_step(stem, u, before, band, slip_jump)
    if kind == PLAY:
        position = play_step(position, u, 0.5 * band)
    elif kind == PLAYS:
        total = 0.0
        for i in range(plays.size):
            plays[i] = play_step(plays[i], u, 0.5 * band * (i + 0.5) / 3.0)
            total += plays[i]
        position = total / plays.size
    elif kind == HE:
        if abs(push) > 0.5 * (band + slip_jump):
            position = u - np.sign(push) * 0.5 * (band - slip_jump)
    elif kind == SOFT_PLAY:
        beyond = abs(push) - 0.5 * band
        if beyond > 0.0:
            position += 0.6 * np.sign(push) * beyond
    elif kind == DUHEM:
        position += 2.0 / band * abs(u - before) * push + 0.1 * (u - before)
    elif kind == SHORT:
        position = min(max(u, -band), band)
    elif kind == SOFT_END:
        position = band * np.tanh(u / band)
    else:
        position = u
    return Stem(position, stem.direction, stem.stopped_at, stem.stuck)


class Lags(NamedTuple):
    """State of a process: its three lags, in the direction of the signal."""

    first: float
    second: float
    third: float


@jit
def _after(lags, entered, keep, plant):
    """Return the process after a step with input `entered`; keep: decay of each lag in a step."""
    x0, x1, x2 = lags
    if plant.integrating:
        # The first is the integrator, which comes last.
        x2 = keep[2] * x2 + (1.0 - keep[2]) * entered
        x1 = keep[1] * x1 + (1.0 - keep[1]) * x2
        x0 += 1.0 / SUBSTEPS / plant.lags[0] * (x1 - plant.inverse * (x2 - x1) / plant.lags[1])
    else:
        x0 = keep[0] * x0 + (1.0 - keep[0]) * entered
        x1 = keep[1] * x1 + (1.0 - keep[1]) * x0
        x2 = keep[2] * x2 + (1.0 - keep[2]) * x1
    return Lags(x0, x1, x2)


@jit
def _run(plant, valve, limit, start, inputs, command, output):
    """Simulate a loop; fill in command and output, one value a period of the controller."""
    keep = np.exp(-1.0 / SUBSTEPS / np.array(plant.lags))
    stem_keep = np.exp(-1.0 / SUBSTEPS / max(valve.lag, LEAST_LAG))
    smooth = np.exp(-1.0 / max(plant.filter, LEAST_LAG))
    ring = np.zeros(max(int(plant.delay * SUBSTEPS), 1) + 1)
    at = 0
    lags = Lags(start, 0.0, 0.0) if plant.integrating else Lags(start, start, start)
    stem, plays = Stem(0.0, 1.0, 0.0, False), np.zeros(6)
    position = total = filtered = error_before = before = level = level_total = 0.0
    direction, band = 1.0, valve.band
    for k in range(command.size):
        measured = inputs.noise[k] + (
            lags.first if plant.integrating
            else lags.third - plant.inverse * (lags.second - lags.third) / plant.lags[2])
        filtered = smooth * filtered + (1.0 - smooth) * measured
        set_point = inputs.reference[k]
        if plant.tank > 0.0:
            level += measured / plant.tank
            level_total -= plant.tank_gain / plant.tank_integral * level
            set_point += level_total - plant.tank_gain * level
        error = set_point - filtered
        total += plant.gain / plant.integral * error
        u = plant.gain * (error + plant.derivative * (error - error_before)) + total
        error_before = error
        if abs(u) > limit:
            total -= plant.gain / plant.integral * error
            u = min(max(u, -limit), limit)
        if valve.scatter > 0.0 and np.sign(u - before) != direction:
            direction = np.sign(u - before)
            band = valve.band * max(1.0 + valve.scatter * inputs.scatter[k], 0.3)
        for _ in range(SUBSTEPS):
            stem = _moved(valve.kind, u, before, stem, plays, band, valve.slip_jump)
            position = stem_keep * position + (1.0 - stem_keep) * stem.position
            before = u
            ring[at % ring.size] = position + inputs.load[k]
            at += 1
            lags = _after(lags, ring[at % ring.size], keep, plant)
        command[k], output[k] = u, measured


class Inputs(NamedTuple):
    """Inputs of a loop, a value each period: set point, load, noise, random share of friction."""

    reference: Array
    load: Array
    noise: Array
    scatter: Array


def run_loop(plant: Plant, valve: Valve, limit: float, inputs: Inputs, start: float = 3.0
             ) -> tuple[Array, Array]:
    """Return command and output of a loop, one sample a period of the controller."""
    command, output = np.empty(len(inputs.load)), np.empty(len(inputs.load))
    _run(plant, valve, limit, start, inputs, command, output)
    return command, output


def run_without_noise(plant: Plant, valve: Valve, limit: float, count: int
                      ) -> tuple[Array, Array]:
    """Return command and output without noise, from an initial error."""
    none = np.zeros(count)
    return run_loop(plant, valve, limit, Inputs(none, none + 0.37, none, none))


def _oscillates(values: Array) -> bool:
    """Return whether the second half of a record, in units of the valve's stroke, oscillates."""
    return bool(of_samples(values[len(values) // 2:], 1.0, NOISE_FLOOR).sustained)


def ultimate_gain(plant: Plant, count: int) -> float:
    """Return the largest gain at which the linear loop comes to rest."""
    low, high = 1e-3, 1e3
    for _ in range(24):
        middle = float(np.sqrt(low * high))
        _, y = run_without_noise(plant._replace(gain=middle), Valve(), 1e12, count)
        low, high = (low, middle) if _oscillates(y) else (middle, high)
    return low


def _plant(world: str, random: Random) -> Plant:
    """Return a random process and controller, of gain 1."""
    delay = 10.0 ** random.uniform(-0.3, 1.4)
    lag = delay * 10.0 ** random.uniform(-0.6, 1.2)
    integrating = bool(random.random() < 0.35)
    second = lag * random.uniform(0.02, 0.6) + 0.05
    third = second * random.uniform(0.3, 1.0) if world == 'judge' else 0.05
    inverse = second * random.uniform(0.2, 0.8) * (random.random() < 0.3) * (world == 'judge')
    usual = 8.0 * delay if integrating else min(lag + second, 8.0 * delay)
    integral = usual * 10.0 ** random.uniform(-0.5, 0.6)
    derivative = random.uniform(0.1, 0.5) * delay * (random.random() < 0.3)
    return Plant((lag, second, third), delay, integrating, float(inverse), 1.0, integral,
                 float(derivative), float(random.choice([0.0, 1.0, 3.0])) * (delay > 2.0))


def _valve(world: str, cause: str, random: Random) -> Valve:
    kind = VALVES[world].get(cause, LINEAR)
    # Usually it is the controller that saturates, not the valve: this shows in the command.
    if cause == 'saturation' and random.random() < 0.6:
        kind = LINEAR
    if cause == 'stiction':
        return Valve(kind, 1.0, random.uniform(0.05, 1.0),
                     0.2 * random.random() * (world == 'judge'),
                     2.0 * random.random() * (world == 'judge'))
    return Valve(kind, 1.0)


def _outside(cause: str, world: str, period: float, count: int, random: Random) -> Array:
    """Return an oscillating load disturbance, of random shape and regularity."""
    if cause != 'disturbance':
        return np.zeros(count)
    # Phase, by up to a turn a period, and amplitude vary randomly.
    wander = 10.0 ** random.uniform(-3.0, 0.0)
    turns = (np.arange(count) / period
             + np.cumsum(random.standard_normal(count)) * wander / np.sqrt(period))
    wave = _jumping if random.random() < JUMPING else _smooth
    size = np.exp(10.0 ** random.uniform(-2.5, -0.2) * _drift(count, 3.0 * period, random))
    return wave(turns, world, random) * size


def _smooth(turns: Array, _: str, random: Random) -> Array:
    """Return a wave without jumps."""
    angle = 2.0 * np.pi * turns
    return (np.sin(angle), np.sin(angle) + 0.4 * np.sin(2.0 * angle + 1.0),
            np.tanh(random.uniform(1.0, 8.0) * np.sin(angle)), np.arcsin(0.98 * np.sin(angle))
            )[random.integers(4)]


def _jumping(turns: Array, world: str, random: Random) -> Array:
    """
    Return a wave that jumps, or nearly so, once or twice a turn.

    'learn': sawtooth, square, trapezoid; 'judge': a step that decays, a stair, alternating levels
    of random size. With a phase that wanders, the square is an almost regular telegraph signal.
    """
    turns = np.maximum.accumulate(turns)   # the phase does not go back and forth over a jump
    share, number = turns % 1.0, np.floor(2.0 * turns).astype(int)
    sign = random.choice([-1.0, 1.0])
    if world == 'learn':
        duty, steep = random.uniform(0.25, 0.75), 10.0 ** random.uniform(0.1, 1.3)
        waves = (2.0 * share - 1.0, np.where(share < duty, 1.0, -1.0),
                 np.clip(steep * (4.0 * np.abs(share - 0.5) - 1.0), -1.0, 1.0))
    else:
        levels = random.uniform(0.4, 1.6, number.max() - number.min() + 1)
        waves = (np.exp(-random.uniform(1.0, 6.0) * share),
                 np.floor(random.integers(3, 6) * share),
                 np.where(number % 2, 1.0, -1.0) * levels[number - number.min()])
    wave = waves[random.integers(len(waves))]
    return sign * (wave - wave.mean()) / np.std(wave)


def _drift(count: int, time: float, random: Random) -> Array:
    """Return noise of variance 1 through a lag of `time` samples."""
    keep = np.exp(-1.0 / time)
    values = signal.lfilter([np.sqrt(1.0 - keep * keep)], [1.0, -keep],
                     random.standard_normal(count + int(4 * time)))
    return values[-count:]


def _cascaded(plant: Plant, random: Random) -> Plant:
    """Return the plant as inner loop of a level control, tuned roughly by SIMC's rules."""
    inner = plant.delay + plant.lags[1] + plant.integral
    slow = inner * random.uniform(1.5, 6.0)
    tank = slow * 10.0 ** random.uniform(0.0, 1.0)
    return plant._replace(tank=tank, tank_gain=random.uniform(0.3, 1.0) * tank / slow,
                          tank_integral=slow * random.uniform(2.0, 8.0))


def loop(cause: str, random: Random, world: str = 'learn') -> Run | None:
    """Return a recording of a loop that oscillates for a known cause; None if it comes to rest."""
    plant, valve = _plant(world, random), _valve(world, cause, random)
    horizon = min(int(60.0 * (plant.delay + plant.lags[1] + plant.integral)), 8000)
    limit_gain = ultimate_gain(plant, horizon)
    usual = 10.0 ** random.uniform(-1.7, -0.2)      # sluggish loops too
    share = {'tight_tuning': 10.0 ** random.uniform(-0.1, -0.005),
             'saturation': random.uniform(1.15, 3.0)}.get(cause, usual)
    plant = plant._replace(gain=share * limit_gain)
    limit = 1.0 if cause == 'saturation' and valve.kind == LINEAR else 1e9
    if cause != 'saturation' and not plant.integrating and random.random() < CASCADED:
        plant = _cascaded(plant, random)
        horizon = min(int(horizon + 30.0 * plant.tank_integral), 15_000)
        if _oscillates(run_without_noise(plant, Valve(), limit, horizon)[1]):
            return None
    if cause == 'disturbance':
        period = (plant.delay + plant.lags[1]) * 10.0 ** random.uniform(0.6, 1.7)
    else:
        gain = limit_gain if cause == 'tight_tuning' else plant.gain
        _, y = run_without_noise(plant._replace(gain=gain), valve, limit, horizon)
        if cause != 'tight_tuning' and not _oscillates(y):
            return None
        period = _period(y)
    if not 4.0 < period < 2000.0:
        return None
    count = int(period * 10.0 ** random.uniform(0.7, 1.7))
    settle = int(8.0 * period + 4.0 * plant.integral)
    total = count + settle
    outside = _outside(cause, world, period, total, random)
    by_reference = random.random() < 0.3
    load = 10.0 ** random.uniform(-3.0, -0.4) * _drift(
        total, period * 10.0 ** random.uniform(-0.7, 1.0), random) + random.uniform(-0.7, 0.7)
    # In a cascade the outer loop changes the set point.
    set_point = np.zeros(total)
    if plant.tank != 0.0:
        set_point = 10.0 ** random.uniform(-1.5, 0.0) * _drift(
            total, period * 10.0 ** random.uniform(-0.3, 1.0), random)
    inputs = Inputs(outside * by_reference + set_point, load + outside * (not by_reference),
                      np.zeros(total), random.standard_normal(total))
    # A limit cycle starts from an initial error; a loop driven by noise from rest.
    start = 0.0 if cause in ('tight_tuning', 'disturbance') else 3.0
    _, noise_free = run_loop(plant, valve, limit, inputs, start)
    # Sensor noise alone can make a tightly tuned loop oscillate.
    most = 0.7 if cause == 'tight_tuning' else -0.5
    noise = float(np.std(noise_free[settle:])) * 10.0 ** random.uniform(-3.0, most)
    command, output = run_loop(plant, valve, limit, inputs._replace(
        noise=noise * random.standard_normal(total)), start)
    return _recorded(command[settle:], output[settle:], period, random, cause)


def _period(values: Array) -> float:
    """Return the mean time between upward crossings of the mean, in the second half; 0 if none."""
    half = values[len(values) // 2:] - values[len(values) // 2:].mean()
    up = np.flatnonzero((half[:-1] < 0.0) & (half[1:] >= 0.0))
    return float(up[-1] - up[0]) / (len(up) - 1) if len(up) > 2 else 0.0


def _recorded(command: Array, output: Array, period: float, random: Random, cause: str
              ) -> Run | None:
    """Return the signals as archived by a plant: downsampled and rounded."""
    if not np.isfinite(output).all() or np.ptp(output) < 1e-6 or np.ptp(command) < 1e-6:
        return None
    stride = max(1, int(period / random.uniform(10.0, 120.0)))
    rounded = [np.round(values / step) * step if step > 0.0 else values
               for values in (command, output)
               for step in [np.ptp(values) * 10.0 ** random.uniform(-3.5, -1.4)
                            * (random.random() < 0.5)]]
    t = np.arange(len(output), dtype=np.float64)[::stride]
    ratio = prominent_frequency(t, rounded[1][::stride]) * period
    # Left out: an oscillation that is not the most prominent peak of the record.
    if not 1.0 / VISIBLE < ratio < VISIBLE:
        return None
    return Run(t, command_n=rounded[0][::stride], force_n=rounded[1][::stride], source=cause)
