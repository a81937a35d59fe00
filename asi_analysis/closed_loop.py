"""The whole loop in one process: the compiled actuator, compensator and reference, no ROS."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from asi_actuator.model.actuator import advance, check_period, measure, prepare, rest
from asi_actuator.model.jit import jit
from asi_actuator.parameters import Value, as_record
from asi_controller.compensator import compensate, compensator
from asi_controller.parameters import REFERENCE_PARAMETERS
from asi_controller.reference import reference_force


class LoopRun(NamedTuple):
    """A closed-loop run: arrays of n samples, one a control period."""

    time_s: npt.NDArray[np.float64]
    reference_n: npt.NDArray[np.float64]
    command_n: npt.NDArray[np.float64]
    force_n: npt.NDArray[np.float64]
    valve_position_m: npt.NDArray[np.float64]
    position_m: npt.NDArray[np.float64]
    velocity_m_s: npt.NDArray[np.float64]


@jit
def _close(state, p, c, r, period, out):
    steady = prepare(p, period)
    for k in range(out.shape[1]):
        force, valve, position, velocity = measure(state, p)
        reference = reference_force(k * period, r)
        command = compensate(c, reference, force)
        out[0, k] = reference
        out[1, k] = command
        out[2, k] = force
        out[3, k] = valve
        out[4, k] = position
        out[5, k] = velocity
        advance(state, command, p, steady)


def simulate_loop(actuator: Mapping[str, Value], controller: Mapping[str, Value],
                  duration_s: float, rate_hz: float = 5000.0) -> LoopRun:
    """
    Return what the two nodes do in lock-step, computed in this process by the same code.

    actuator, controller: parameters by name, the rest at their defaults; the controller's are
    those of compensator and reference. Raises ParameterError for one that is not allowed.
    """
    check_period(1.0 / rate_hz)
    names = {parameter.name for parameter in REFERENCE_PARAMETERS}
    reference = {name: value for name, value in controller.items() if name in names}
    gains = {name: value for name, value in controller.items() if name not in names}
    out = np.empty((6, math.ceil(duration_s * rate_hz - 1e-9)))
    _close(rest(), as_record(actuator), compensator(gains, rate_hz),
           as_record(reference, REFERENCE_PARAMETERS), 1.0 / rate_hz, out)
    return LoopRun(np.arange(out.shape[1]) / rate_hz, *out)


if __name__ == '__main__':
    # `make setup` runs this once, so that no first run has to wait for the compiler.
    simulate_loop({}, {'reference.shape': 'step'}, 0.01)
