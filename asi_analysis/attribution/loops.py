"""Simulated control loops with a known fault: what the attribution by shape is calibrated on."""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from asi_actuator.model.jit import jit
from asi_analysis.run import Run

Array = npt.NDArray[np.float64]
Random = np.random.Generator

CAUSES: Final = ('stiction', 'backlash', 'hysteresis', 'saturation', 'tight_tuning',
                 'disturbance')


class Plant(NamedTuple):
    """A process (gain 1) and a PI controller: times in s, the lag infinite for an integrator."""

    lag: float
    second_lag: float
    delay: float
    integrating: bool
    gain: float
    integral: float


@jit
def _loop(count, step, lag, second, delay, integrating, gain, integral, static, slip, limit,
          disturbance, noise, command, output):
    ring = np.zeros(delay + 1)
    first = total = 0.0
    state = 3.0     # well off the set point, so that whatever can cycle begins to
    positions = np.zeros(static.size)
    for k in range(count):
        measured = state + disturbance[k] + noise[k]
        error = -measured
        total += gain / integral * error * step
        u = gain * error + total
        if abs(u) > limit:
            total -= gain / integral * error * step
            u = min(max(u, -limit), limit)
        for i in range(static.size):
            push = u - positions[i]
            if abs(push) > static[i]:
                positions[i] = u - np.sign(push) * slip * static[i]
        ring[k % (delay + 1)] = positions.mean()
        late = ring[(k + 1) % (delay + 1)]
        first += step / second * (late - first)
        if integrating:
            state += step / lag * first
        else:
            state += step / lag * (first - state)
        command[k] = u
        output[k] = measured


def _plant(random: Random, aggressive: float) -> Plant:
    """Return a process with a delay and its PI controller: SIMC's rules times `aggressive`."""
    lag = 10.0 ** random.uniform(-0.5, 1.5)
    delay = lag * 10.0 ** random.uniform(-0.7, 0.4)
    integrating = bool(random.random() < 0.3)
    gain = aggressive * 0.5 * lag / delay
    integral = (8.0 * delay if integrating else min(lag, 8.0 * delay)) * random.uniform(0.6, 1.6)
    return Plant(lag, 0.1 * delay + 0.02 * lag, delay, integrating, gain, integral)


def simulate(plant: Plant, random: Random, static: Array, slip: float, limit: float,
             disturbance_hz: float, noise: float, cycles_s: float, count: int) -> tuple[
                 Array, Array, Array]:
    """Return time, command and output of a loop after it has settled."""
    step = min(plant.delay / 10.0, plant.second_lag / 3.0, cycles_s / 400.0)
    total = int(2.0 * count * cycles_s / step)
    t = np.arange(total) * step
    # A load that no position reached by chance happens to balance.
    disturbance = np.full(total, random.uniform(-2.0, 2.0))
    if disturbance_hz > 0.0:
        angle = 2.0 * np.pi * disturbance_hz * t
        shape = random.integers(3)
        wave = (np.sin(angle), np.sin(angle) + 0.3 * np.sin(2 * angle + 1.0),
                np.tanh(3.0 * np.sin(angle)))[shape]
        disturbance += wave * random.uniform(0.5, 1.5)
    # Sensor noise, a new value every few steps, and a slow random walk of the load.
    hold = max(1, int(cycles_s / step / 60.0))
    hiss = np.repeat(random.standard_normal(total // hold + 1), hold)[:total] * noise
    walk = np.cumsum(random.standard_normal(total)) * noise * np.sqrt(step / cycles_s) * 0.3
    command, output = np.empty(total), np.empty(total)
    _loop(total, step, plant.lag, plant.second_lag, max(int(plant.delay / step), 1),
          plant.integrating, plant.gain, plant.integral, static, slip, limit,
          disturbance + walk, hiss, command, output)
    half = total // 2
    return t[half:] - t[half], command[half:], output[half:]


def loop(cause: str, random: Random) -> Run | None:
    """Return a recording of a loop that oscillates for a known cause; None if it does not."""
    aggressive = random.uniform(0.15, 0.9)
    static: Array = np.zeros(1)
    slip = 0.0
    limit, disturbance_hz = 1e9, 0.0
    noise = 10.0 ** random.uniform(-2.3, -0.9)
    plant = _plant(random, aggressive)
    if cause == 'stiction':
        static, slip = np.ones(1), random.uniform(0.0, 0.4)
    elif cause in ('backlash', 'hysteresis'):
        # Either lags only, so it cycles with two integrations in the loop, or nearly so.
        static = np.ones(1) if cause == 'backlash' else np.linspace(1.0, 11.0, 6) / 6.0
        slip = 1.0
        plant = plant._replace(integrating=True,
                               integral=plant.integral * random.uniform(0.15, 0.7))
        if not 0.1 < phase_margin(plant) < 0.7:
            return None
    elif cause == 'tight_tuning':
        plant = _tuned(plant, 10.0 ** random.uniform(-0.07, -0.003))
    elif cause == 'saturation':
        plant = _tuned(plant, random.uniform(1.2, 3.0))
        limit = 1.0
    elif cause == 'disturbance':
        period = plant.delay * 10.0 ** random.uniform(0.7, 1.6)
        disturbance_hz = 1.0 / period
    cycle = 1.0 / disturbance_hz if disturbance_hz else 6.0 * plant.delay
    for _ in range(3):
        t, u, y = simulate(plant, random, static, slip, limit, disturbance_hz, noise, cycle,
                           25)
        found = _cycle(t, y)
        if found is None:
            return None
        alike = 0.7 < found / cycle < 1.4
        if alike:
            break
        cycle = found
    size = float(np.std(y))
    if not alike or _crossings(y) < 10:
        return None
    if not np.isfinite(size) or size < 3.0 * noise or size > 1e6:
        return None
    every = max(1, int(cycle / (t[1] - t[0]) / random.uniform(15.0, 60.0)))
    return Run(t[::every], command_n=u[::every], force_n=y[::every], source=cause)


def _crossings(values: Array) -> int:
    """Return how often the values go through their mean by more than a third of their spread."""
    level = (values - values.mean()) / values.std()
    side = np.where(level > 0.33, 1, np.where(level < -0.33, -1, 0))
    side = side[side != 0]
    return int(np.sum(side[1:] != side[:-1]))


def _response(plant: Plant) -> npt.NDArray[np.complex128]:
    """Return the loop for a controller gain of 1, over frequencies about its delay's."""
    s = 1j * np.geomspace(0.005, 20.0, 6000) / plant.delay
    process = np.exp(-s * plant.delay) / (1.0 + plant.second_lag * s) / (
        plant.lag * s if plant.integrating else 1.0 + plant.lag * s)
    return process * (1.0 + 1.0 / (plant.integral * s))


def phase_margin(plant: Plant) -> float:
    """Return the phase margin (rad) of the loop without its nonlinearity; NaN if none."""
    response = plant.gain * _response(plant)
    crossing = np.flatnonzero((np.abs(response[:-1]) > 1.0) & (np.abs(response[1:]) <= 1.0))
    if not len(crossing):
        return float('nan')
    phase = np.unwrap(np.angle(response))
    return float(np.pi + phase[crossing[-1]])


def _tuned(plant: Plant, share: float) -> Plant:
    """Return the plant with its gain at a share of that at which the loop is unstable."""
    response = _response(plant)
    phase = np.unwrap(np.angle(response))
    crossing = np.flatnonzero((phase[:-1] > -np.pi) & (phase[1:] <= -np.pi))
    if not len(crossing):
        return plant
    return plant._replace(gain=share / float(abs(response[crossing[0]])))


def _cycle(t: Array, y: Array) -> float | None:
    from asi_analysis.limit_cycle.sinusoid import dominant_frequency
    every = max(1, len(t) // 4000)
    frequency = dominant_frequency(t[::every], y[::every], 3.0)
    return 1.0 / frequency if np.isfinite(frequency) and frequency > 0.0 else None
