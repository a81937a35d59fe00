"""
Floquet multipliers of a simulated cycle: decay of a small perturbation in one period.

By finite differences of the sampled state map, delays and compensator included. The cycle and the
control clock have no common period, so the map differs from period to period; the multipliers are
geometric means over many periods, that is exp(Lyapunov exponent times period) (Benettin et al.,
Meccanica 15, 1980). The one along the orbit is 1, because the phase is free.
"""

from collections.abc import Iterable
from typing import Final

import numpy as np

from asi_actuator.model.actuator import STATE_DTYPE, rest
from asi_actuator.parameters import RING
from asi_analysis.arrays import Array
from asi_analysis.loop.closed_loop import close_loop, records
from asi_analysis.loop.simulation import Values

SETTLING_S: Final = 1.0
TURNS: Final = 60
DIRECTIONS: Final = 3         # perturbations: those that decay slowest
PERTURBATION: Final = 1e-6    # over the range of each state over the cycle
MEMORIES: Final = ('memory', 'lag_memory', 'bias')
RINGS: Final = ('flexure_ring', 'sensor_ring')


class _SampledLoop:
    """The loop as a map of its state over control periods."""

    def __init__(self, actuator: Values, controller: Values, period_s: float) -> None:
        step = {**controller, 'reference.shape': 'step', 'reference.start': 0.0}
        self.plant, self.compensator, self.reference = records(actuator, step, 1.0 / period_s)
        self.period_s = period_s
        self.state = rest()
        substeps = np.ceil(period_s / self.plant['maximum_substep'] * (1.0 - 1e-12))
        longest = max(self.plant['valve_flexure_delay'], self.plant['force_sensor_delay'])
        self.depth = min(int(longest / (period_s / substeps)) + 3, RING)
        self.fields: list[str] = []

    def run(self, ticks: int) -> Array:
        """Advance by control periods; return the measured force."""
        out = np.empty((6, ticks))
        close_loop(self.state, self.plant, self.compensator, self.reference, self.period_s, 0, out)
        return out[2]

    def vector(self) -> Array:
        """Return the state of the blocks, the delays (by age) and the compensator."""
        ages = (int(self.state['ring_index']) - np.arange(self.depth)) % RING
        # Unused states stay at zero; perturbations of them would never decay.
        self.fields = self.fields or [
            name for name in STATE_DTYPE.names or () if name != 'time'
            and not name.endswith('ring') and STATE_DTYPE[name].base == np.float64
            and np.any(self.state[name] != 0.0)]
        parts = [*[np.ravel(self.state[name]) for name in self.fields],
                 *[self.state[ring][ages] for ring in RINGS],
                 *[np.ravel(self.compensator[name]) for name in MEMORIES]]
        return np.concatenate([np.asarray(part, float) for part in parts])

    def put(self, vector: Array) -> None:
        """Set the state."""
        ages = (int(self.state['ring_index']) - np.arange(self.depth)) % RING
        start = 0

        def restore(record: np.void, names: Iterable[str]) -> None:
            nonlocal start
            for name in names:
                shape = np.shape(record[name])
                size = int(np.prod(shape))
                record[name] = vector[start:start + size].reshape(shape)
                start += size

        restore(self.state, self.fields)
        for ring in RINGS:
            self.state[ring][ages] = vector[start:start + self.depth]
            start += self.depth
        restore(self.compensator, MEMORIES)


def multipliers(actuator: Values, controller: Values, rate_hz: float, frequency_hz: float
                ) -> Array:
    """
    Return the largest Floquet multipliers (absolute values) of the cycle after a step.

    The largest, about 1, belongs to the direction along the orbit; the cycle is stable if the
    second is below 1.
    """
    loop = _SampledLoop(actuator, controller, 1.0 / rate_hz)
    loop.run(round(SETTLING_S * rate_hz))
    ticks = round(rate_hz / frequency_hz)
    states = np.empty((ticks, len(loop.vector())))
    for k in range(ticks):
        loop.run(1)
        states[k] = loop.vector()
    size = np.ptp(states, axis=0)
    moves = np.flatnonzero(size > 0.0)
    basis = np.linalg.qr(np.random.default_rng(1).standard_normal((len(moves), DIRECTIONS)))[0]
    logarithms = np.zeros(DIRECTIONS)
    for turn in range(TURNS):
        start, index = loop.vector(), int(loop.state['ring_index'])
        loop.run(ticks)
        end, after = loop.vector(), int(loop.state['ring_index'])
        for column in range(DIRECTIONS):
            perturbed = start.copy()
            perturbed[moves] += PERTURBATION * size[moves] * basis[:, column]
            loop.state['ring_index'] = index
            loop.put(perturbed)
            loop.run(ticks)
            basis[:, column] = (loop.vector() - end)[moves] / size[moves] / PERTURBATION
        loop.state['ring_index'] = after
        loop.put(end)
        basis, triangle = np.linalg.qr(basis)
        if turn >= TURNS // 6:      # the first turns align the directions
            logarithms += np.log(np.maximum(np.abs(np.diag(triangle)), 1e-300))
    turns = TURNS - TURNS // 6
    # A turn is a whole number of ticks; the multipliers are for the exact period.
    return np.sort(np.exp(logarithms / turns * rate_hz / frequency_hz / ticks))[::-1]
