"""The driver when there is no hardware: the compiled model, of the actuator or of a joint."""

import math
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from asi_actuator import joint_parameters, parameters
from asi_actuator.driver import Health
from asi_actuator.joint import joint
from asi_actuator.model.actuator import Measurement, measure, rest, step
from asi_actuator.node_parameters import PHYSICS
from asi_common.jit import compiled_for, jit
from asi_common.parameter import Value

NAMES = {plant: frozenset(p.name for p in table) for plant, table in PHYSICS.items()}
HEALTHY, SATURATED = Health(), Health(saturated=True)


@jit
def _exchange(states, parameters, command, period, periods):
    """
    Advance by control periods, and return what is measured then.

    states, parameters: arrays of one record.
    """
    for _ in range(periods):
        step(states[0], command, parameters[0], period)
    return measure(states[0], parameters[0])


@jit
def _exchange_joint(states, parameters, command, period, periods):
    """Do the same for a joint."""
    for _ in range(periods):
        joint.step(states[0], command, parameters[0], period)
    return joint.measure(states[0], parameters[0])


class Plant(NamedTuple):
    """
    What is simulated.

    record: of its parameters, for compiled code; rest: its state then; exchange: see above;
    full: the measurement that is full at its limit, by the number in Measurement, and the name of
    that limit, of which 0 is none.
    """

    record: Callable[[Mapping[str, Value]], np.void]
    rest: Callable[[np.void], np.void]
    exchange: Any
    full: tuple[int, str]


PLANTS: Final = {
    'actuator': Plant(parameters.as_record, lambda p: rest(), _exchange,
                      (1, 'valve_characteristic.full_opening')),
    'joint': Plant(joint_parameters.as_record, joint.rest, _exchange_joint,
                   (0, 'drive.force_limit'))}


def plant_of(values: Mapping[str, Value]) -> str:
    """Return the plant of a node's values; of others, the actuator."""
    return str(values.get('plant', 'actuator'))


def physical(values: Mapping[str, Value]) -> np.void:
    """
    Return the record of those of a node's values that belong to the physics.

    Raises ParameterError if they do not go together.
    """
    plant = plant_of(values)
    return PLANTS[plant].record({
        name: value for name, value in values.items() if name in NAMES[plant]})


class SimulatedActuator:
    """The simulated actuator, or joint, one control period at a time."""

    hardware = False
    last_tick = None

    def __init__(self, values: Mapping[str, Value], period_s: float):
        """Stand at rest. Raises ParameterError for physical parameters that are not allowed."""
        self.period_s = period_s
        self._plant = PLANTS[plant_of(values)]
        self.configure(values)
        self.reset()
        self._exchange = compiled_for(
            self._plant.exchange, self._states, self._parameters, 0.0, period_s, 1)

    def open(self) -> None:
        pass

    def exchange(self, command_n: float, enabled: bool, periods: int) -> Measurement:
        """Advance by control periods at a command (N); return the sensor readings then."""
        measured: Measurement = self._exchange(
            self._states, self._parameters, command_n, self.period_s, periods)
        saturated = (abs(measured[self._full]) >= self._full_value
                     or abs(command_n) >= self._drive_limit_n)
        self.health = SATURATED if saturated else HEALTHY
        return measured

    def configure(self, values: Mapping[str, Value]) -> None:
        """Take new physical parameters from the next tick on; the state stays."""
        if plant_of(values) == 'joint':
            joint_parameters.check_delay(values, self.period_s)
        self._parameters = np.array([physical(values)])
        self._full, limit = self._plant.full
        self._full_value = float(values[limit]) or math.inf
        self._drive_limit_n = float(values['command_limit'])

    def reset(self) -> None:
        """Return to rest."""
        self._states = np.array([self._plant.rest(self._parameters[0])])
        self.health = HEALTHY

    def close(self) -> None:
        pass
