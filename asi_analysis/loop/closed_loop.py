"""Simulation of the closed loop in one process: compiled actuator, compensator and reference."""

import math
import threading
from collections.abc import Iterator, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from asi_actuator.model.actuator import STATE_DTYPE, advance, check_period, measure, prepare, rest
from asi_actuator.parameters import as_record
from asi_analysis.arrays import Array
from asi_analysis.parallel import cores, in_threads
from asi_common.jit import jit
from asi_common.parameter import Value
from asi_common.record import record_of
from asi_controller.compensator import compensate, compensator
from asi_controller.parameters import REFERENCE_PARAMETERS
from asi_controller.reference import reference_force

# Blocks of loops for each core: several, so that all cores finish at about the same time.
BLOCKS_A_CORE: Final = 8
# Ticks of compiled code after which a block checks whether it is to stop.
PIECE: Final = 1000

Values = Mapping[str, Value]


class LoopRun(NamedTuple):
    """A closed-loop run: arrays of n samples, one a control period."""

    time_s: Array
    reference_n: Array
    command_n: Array
    force_n: Array
    valve_position_m: Array
    position_m: Array
    velocity_m_s: Array


class Loops(NamedTuple):
    """
    Records of m closed loops with the same control period.

    The states persist from one `close_many` to the next; the other records may be changed
    in between.
    """

    states: npt.NDArray[np.void]        # STATE_DTYPE
    plants: npt.NDArray[np.void]        # ACTUATOR_DTYPE
    compensators: npt.NDArray[np.void]  # COMPENSATOR_DTYPE
    references: npt.NDArray[np.void]    # of REFERENCE_PARAMETERS
    period_s: float

    def subset(self, chosen: npt.NDArray[np.intp]) -> 'Loops':
        """Return a copy of the chosen loops."""
        return Loops(self.states[chosen], self.plants[chosen], self.compensators[chosen],
                     self.references[chosen], self.period_s)


@jit
def _close_piece(state, p, c, r, period, first, end, skipped, out):
    """Run a loop for the control periods first to end; fill `out`, which begins at `skipped`."""
    steady = prepare(p, period)
    for tick in range(first, end):
        force, valve, position, velocity = measure(state, p)
        reference = reference_force(tick * period, r)
        command = compensate(c, reference, force, velocity)
        k = tick - skipped
        if k >= 0:
            out[0, k] = reference
            out[1, k] = command
            out[2, k] = force
            out[3, k] = valve
            out[4, k] = position
            out[5, k] = velocity
        advance(state, command, p, steady)


@jit
def close_loop(state, p, c, r, period, first, out):
    """
    Run a loop and fill `out` (6 signals of LoopRun x control periods).

    state, p, c, r: records of the actuator, advanced in place, its parameters, compensator and
    reference; period: s; first: control periods so far, for the time of the reference.
    """
    _close_piece(state, p, c, r, period, first, first + out.shape[1], first, out)


@jit
def _close_block(states, plants, compensators, references, period, first, end, skipped, out):
    for i in range(states.size):
        _close_piece(states[i], plants[i], compensators[i], references[i], period, first, end,
                     skipped, out[i])


def close_many(loops: Loops, duration_s: float, last_s: float | None = None
               ) -> Array:
    """
    Run many loops on all cores; return m x 6 signals of LoopRun x control periods.

    last_s: return only this duration at the end (to save memory), by default all. Each row is bit
    for bit what `simulate_loop` returns: threads share no data, and compiled code releases the
    interpreter's lock. Ctrl-C stops all of them.
    """
    check_period(loops.period_s)
    ticks = math.ceil(duration_s / loops.period_s - 1e-9)
    last = ticks if last_s is None else min(ticks, math.ceil(last_s / loops.period_s - 1e-9))
    out = np.empty((loops.states.size, 6, last))

    size = max(1, loops.states.size // (cores() * BLOCKS_A_CORE))
    stopped = threading.Event()

    def block(first: int) -> None:
        part = slice(first, first + size)
        for begin in range(0, ticks, PIECE):
            if stopped.is_set():
                return
            _close_block(loops.states[part], loops.plants[part], loops.compensators[part],
                         loops.references[part], loops.period_s, begin,
                         min(begin + PIECE, ticks), ticks - last, out[part])

    try:
        list(in_threads(block, range(0, loops.states.size, size)))
    except KeyboardInterrupt:
        stopped.set()
        raise
    return out


def loops_of(actuators: Sequence[Values], controllers: Sequence[Values], rate_hz: float) -> Loops:
    """
    Return loops at rest, each with parameters by name as `simulate_loop` takes them.

    Raises ParameterError for one that is not allowed.
    """
    rows = [records(actuator, controller, rate_hz)
            for actuator, controller in zip(actuators, controllers, strict=True)]
    plants, compensators, references = (np.array(column) for column in zip(*rows, strict=True))
    return Loops(np.zeros(len(rows), STATE_DTYPE), plants, compensators, references, 1.0 / rate_hz)


def records(actuator: Values, controller: Values, rate_hz: float
            ) -> tuple[np.void, np.void, np.void]:
    """
    Return the records of plant, compensator and reference, from parameters by name.

    Raises ParameterError for one that is not allowed.
    """
    names = {parameter.name for parameter in REFERENCE_PARAMETERS}
    reference = {name: value for name, value in controller.items() if name in names}
    gains = {name: value for name, value in controller.items() if name not in names}
    return (as_record(actuator), compensator(gains, rate_hz),
            record_of(reference, REFERENCE_PARAMETERS))


def simulate_loop(actuator: Values, controller: Values, duration_s: float,
                  rate_hz: float = 5000.0) -> LoopRun:
    """
    Return the run of the two nodes in lock-step, computed in this process by the same code.

    actuator, controller: parameters by name, the rest at their defaults; the controller's are
    those of compensator and reference. Raises ParameterError for one that is not allowed.
    """
    ticks = math.ceil(duration_s * rate_hz - 1e-9)
    return next(loop_pieces(actuator, controller, ticks, rate_hz, ticks))


def loop_pieces(actuator: Values, controller: Values, ticks: int, rate_hz: float, length: int
                ) -> Iterator[LoopRun]:
    """Yield the run of `simulate_loop` in pieces of up to `length` control periods."""
    check_period(1.0 / rate_hz)
    state, loop = rest(), records(actuator, controller, rate_hz)
    for first in range(0, max(ticks, 1), max(length, 1)):
        out = np.empty((6, min(length, ticks - first)))
        close_loop(state, *loop, 1.0 / rate_hz, first, out)
        yield LoopRun((first + np.arange(out.shape[1])) / rate_hz, *out)


if __name__ == '__main__':
    # `make setup` runs this once to fill the cache of compiled code.
    simulate_loop({}, {'reference.shape': 'step'}, 0.01)
