"""What stands behind the node when there is no hardware: the compiled model."""

import math
from collections.abc import Mapping

import numpy as np

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

    def __init__(self, values: Mapping[str, Value], period_s: float):
        """Stand at rest. Raises ParameterError for physical parameters that are not allowed."""
        self.period_s = period_s
        self.zero_n = 0.0
        self.applied_n = 0.0
        self.configure(values)
        self.reset()
        # Compiled now, not in the first tick.
        self.advance(0.0)
        self.measure()
        self.reset()

    def configure(self, values: Mapping[str, Value]) -> None:
        """Take new physical parameters from the next tick on; the state stays."""
        self._p = physical(values)

    def reset(self) -> None:
        """Return to rest."""
        self._state = rest()
        self.applied_n = 0.0

    def measure(self) -> Measurement:
        """Return what the sensors tell, the force less its zero."""
        force, valve, position, velocity = measure(self._state, self._p)
        return Measurement(force - self.zero_n, valve, position, velocity)

    def advance(self, command_n: float) -> None:
        """Advance by one control period at a valve command (N)."""
        step(self._state, command_n, self._p, self.period_s)
        limit = float(self._p['command_limit'])
        self.applied_n = math.copysign(min(abs(command_n), limit), command_n)

    @property
    def saturated(self) -> bool:
        """Whether the valve is fully open or the command at its limit."""
        full = self._p['valve_characteristic_full_opening']
        return bool(abs(self._state['valve_position']) >= full
                    or abs(self.applied_n) >= self._p['command_limit'])
