"""The driver when there is no hardware: the compiled model."""

import math
from collections.abc import Mapping

import numpy as np

from asi_actuator.driver import Health
from asi_actuator.model.actuator import Measurement, measure, rest, step
from asi_actuator.parameters import ACTUATOR_PARAMETERS, Value, as_record

NAMES = frozenset(parameter.name for parameter in ACTUATOR_PARAMETERS)


def physical(values: Mapping[str, Value]) -> np.void:
    """
    Return the record of those of a node's values that belong to the physics.

    Raises ParameterError if they do not go together.
    """
    return as_record({name: value for name, value in values.items() if name in NAMES})


class SimulatedActuator:
    """The simulated actuator, one control period at a time."""

    hardware = False
    last_tick = None

    def __init__(self, values: Mapping[str, Value], period_s: float):
        """Stand at rest. Raises ParameterError for physical parameters that are not allowed."""
        self.period_s = period_s
        self.configure(values)
        self.reset()

    def open(self) -> None:
        # Compiled now, not in the first tick.
        self.exchange(0.0, True, 1)
        self.reset()

    def exchange(self, command_n: float, enabled: bool, periods: int) -> Measurement:
        """Advance by control periods at a valve command (N); return what the sensors tell then."""
        for _ in range(periods):
            step(self._state, command_n, self._p, self.period_s)
        limit = float(self._p['command_limit'])
        self.applied_n = math.copysign(min(abs(command_n), limit), command_n)
        return Measurement(*measure(self._state, self._p))

    def health(self) -> Health:
        full = self._p['valve_characteristic_full_opening']
        return Health(saturated=bool(abs(self._state['valve_position']) >= full
                                     or abs(self.applied_n) >= self._p['command_limit']))

    def configure(self, values: Mapping[str, Value]) -> None:
        """Take new physical parameters from the next tick on; the state stays."""
        self._p = physical(values)

    def reset(self) -> None:
        """Return to rest."""
        self._state = rest()
        self.applied_n = 0.0

    def close(self) -> None:
        pass
