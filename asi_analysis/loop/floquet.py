"""
Floquet multipliers of a simulated cycle: how much of a small push remains after one period.

By finite differences of the sampled state map, delays and compensator included. A cycle and the
control clock have no common period, so the map differs from turn to turn; the multipliers are
geometric means over many turns, that is exp(Lyapunov exponent times period) (Benettin et al.,
Meccanica 15, 1980). The one along the orbit is 1: nothing restores the phase.
"""

from typing import Final

import numpy as np
import numpy.typing as npt

from asi_actuator.model.actuator import STATE_DTYPE, rest
from asi_actuator.parameters import RING
from asi_analysis.loop.closed_loop import close_loop, records
from asi_analysis.loop.simulation import Values

SETTLING_S: Final = 1.0
TURNS: Final = 60
FOLLOWED: Final = 3      # pushes that are followed: the slowest to die
PUSH: Final = 1e-6      # of each coordinate's swing over the cycle
MEMORIES: Final = ('memory', 'lag_memory', 'bias')
RINGS: Final = ('flexure_ring', 'sensor_ring')


class _Clocked:
    """The loop at one control period, as a map of its state over ticks."""

    def __init__(self, actuator: Values, controller: Values, period_s: float) -> None:
        step = {**controller, 'reference.shape': 'step', 'reference.start': 0.0}
        self.plant, self.compensator, self.reference = records(actuator, step, 1.0 / period_s)
        self.period_s = period_s
        self.state = rest()
        substeps = np.ceil(period_s / self.plant['maximum_substep'] * (1.0 - 1e-12))
        longest = max(self.plant['valve_flexure_delay'], self.plant['force_sensor_delay'])
        self.depth = min(int(longest / (period_s / substeps)) + 3, RING)
        self.fields: list[str] = []

    def run(self, ticks: int) -> npt.NDArray[np.float64]:
        """Advance by so many ticks; return the measured force."""
        out = np.empty((6, ticks))
        close_loop(self.state, self.plant, self.compensator, self.reference, self.period_s, out)
        return out[2]

    def vector(self) -> npt.NDArray[np.float64]:
        """Return the state: what the blocks, the delays (by age) and the compensator hold."""
        ages = (int(self.state['ring_index']) - np.arange(self.depth)) % RING
        # The states of effects that are off stay at zero; as directions they would never decay.
        self.fields = self.fields or [
            name for name in STATE_DTYPE.names or () if name != 'time'
            and STATE_DTYPE[name] == np.float64 and self.state[name] != 0.0]
        parts = [[self.state[name] for name in self.fields],
                 *[self.state[ring][ages] for ring in RINGS],
                 *[np.ravel(self.compensator[name]) for name in MEMORIES]]
        return np.concatenate([np.asarray(part, float) for part in parts])

    def put(self, vector: npt.NDArray[np.float64]) -> None:
        """Set the state."""
        ages = (int(self.state['ring_index']) - np.arange(self.depth)) % RING
        for name, value in zip(self.fields, vector, strict=False):
            self.state[name] = value
        place = len(self.fields)
        for ring in RINGS:
            self.state[ring][ages] = vector[place:place + self.depth]
            place += self.depth
        for name in MEMORIES:
            shape = np.shape(self.compensator[name])
            size = int(np.prod(shape))
            self.compensator[name] = vector[place:place + size].reshape(shape)
            place += size


def multipliers(actuator: Values, controller: Values, rate_hz: float, frequency_hz: float
                ) -> npt.NDArray[np.float64]:
    """
    Return sizes of the largest Floquet multipliers of the cycle that the loop settles to.

    The largest is that along the orbit, about 1; the cycle attracts if the second is below 1.
    """
    loop = _Clocked(actuator, controller, 1.0 / rate_hz)
    loop.run(round(SETTLING_S * rate_hz))
    ticks = round(rate_hz / frequency_hz)
    states = np.empty((ticks, len(loop.vector())))
    for k in range(ticks):
        loop.run(1)
        states[k] = loop.vector()
    swing = np.ptp(states, axis=0)
    moves = np.flatnonzero(swing > 0.0)
    basis = np.linalg.qr(np.random.default_rng(1).standard_normal((len(moves), FOLLOWED)))[0]
    logarithms = np.zeros(FOLLOWED)
    for turn in range(TURNS):
        start, index = loop.vector(), int(loop.state['ring_index'])
        loop.run(ticks)
        end, after = loop.vector(), int(loop.state['ring_index'])
        for column in range(FOLLOWED):
            pushed = start.copy()
            pushed[moves] += PUSH * swing[moves] * basis[:, column]
            loop.state['ring_index'] = index
            loop.put(pushed)
            loop.run(ticks)
            basis[:, column] = (loop.vector() - end)[moves] / swing[moves] / PUSH
        loop.state['ring_index'] = after
        loop.put(end)
        basis, triangle = np.linalg.qr(basis)
        if turn >= TURNS // 6:      # the first turns only find the directions
            logarithms += np.log(np.maximum(np.abs(np.diag(triangle)), 1e-300))
    turns = TURNS - TURNS // 6
    # Turns are whole ticks; the multipliers are for a period.
    return np.sort(np.exp(logarithms / turns * rate_hz / frequency_hz / ticks))[::-1]
