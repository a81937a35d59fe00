"""The driver when there is no hardware: the compiled model."""

from collections.abc import Mapping

import numpy as np

from asi_actuator.driver import Health
from asi_actuator.model.actuator import Measurement, measure, rest, step
from asi_actuator.parameters import ACTUATOR_PARAMETERS, as_record
from asi_common.jit import compiled_for, jit
from asi_common.parameter import Value

NAMES = frozenset(parameter.name for parameter in ACTUATOR_PARAMETERS)
HEALTHY, SATURATED = Health(), Health(saturated=True)


def physical(values: Mapping[str, Value]) -> np.void:
    """
    Return the record of those of a node's values that belong to the physics.

    Raises ParameterError if they do not go together.
    """
    return as_record({name: value for name, value in values.items() if name in NAMES})


@jit
def _exchange(states, parameters, command, period, periods):
    """
    Advance by control periods, and return what is measured then.

    states, parameters: arrays of one record.
    """
    for _ in range(periods):
        step(states[0], command, parameters[0], period)
    return measure(states[0], parameters[0])


class SimulatedActuator:
    """The simulated actuator, one control period at a time."""

    hardware = False
    last_tick = None

    def __init__(self, values: Mapping[str, Value], period_s: float):
        """Stand at rest. Raises ParameterError for physical parameters that are not allowed."""
        self.period_s = period_s
        self.configure(values)
        self.reset()
        self._exchange = compiled_for(
            _exchange, self._states, self._parameters, 0.0, period_s, 1)

    def open(self) -> None:
        pass

    def exchange(self, command_n: float, enabled: bool, periods: int) -> Measurement:
        """Advance by control periods at a valve command (N); return the sensor readings then."""
        measured: Measurement = self._exchange(
            self._states, self._parameters, command_n, self.period_s, periods)
        saturated = (abs(measured[1]) >= self._full_opening_m
                     or abs(command_n) >= self._drive_limit_n)
        self.health = SATURATED if saturated else HEALTHY
        return measured

    def configure(self, values: Mapping[str, Value]) -> None:
        """Take new physical parameters from the next tick on; the state stays."""
        self._parameters = np.array([physical(values)])
        self._full_opening_m = float(values['valve_characteristic.full_opening'])
        self._drive_limit_n = float(values['command_limit'])

    def reset(self) -> None:
        """Return to rest."""
        self._states = np.array([rest()])
        self.health = HEALTHY

    def close(self) -> None:
        pass
