"""
Drivers of the actuator node: the model, hardware on a CAN bus, or a recording.

A driver is a class that is a `Driver`, and a Python entry point of the group
`asi_actuator.drivers`. Any package can add one: in its pyproject.toml

    [project.entry-points."asi_actuator.drivers"]
    name = "package.module:Class"

or `entry_points` in its setup.py. Its name is then a value of the parameter `driver`.
"""

from collections.abc import Mapping
from typing import NamedTuple, Protocol

from asi_actuator.model.actuator import Measurement
from asi_actuator.node_parameters import DRIVERS
from asi_common.parameter import ParameterError, Value


class Health(NamedTuple):
    """State of the link to the actuator; counts are since it was opened."""

    state_age_s: float = 0.0  # since the newest state came
    lost_states: int = 0      # gaps in the counter of the states
    bad_frames: int = 0       # wrong checksum or length, or not readable
    problem: str = ''         # an error of the link or of the hardware itself
    saturated: bool = False   # the valve is fully open, or the drive at its limit


class Driver(Protocol):
    """
    An actuator, one control period at a time.

    It is made as Class(values, period_s): the parameters of the node by name, and the control
    period, s. Raises ParameterError for values that it cannot work with.
    """

    hardware: bool
    """Whether a real actuator moves: then the node powers up disabled."""
    last_tick: int | None
    """Number of periods after which there are no more states; None: no end."""

    @property
    def health(self) -> Health:
        """The present state of the link."""

    def open(self) -> None:
        """Connect. A link that is not there yet is reported by health(), and retried."""

    def exchange(self, command_n: float, enabled: bool, periods: int) -> Measurement | None:
        """
        Give a valve command (N) and return the newest state; None if there is no new one.

        enabled: whether the valve may be driven; periods: control periods since the last call.
        """

    def configure(self, values: Mapping[str, Value]) -> None:
        """Take new parameters; what is read-only has not changed."""

    def reset(self) -> None:
        """Begin anew: the model at rest, a recording from its start; errors are cleared."""

    def close(self) -> None:
        """Leave the valve closed and the link free."""


def make_driver(values: Mapping[str, Value], period_s: float) -> Driver:
    """
    Return the driver that the parameter `driver` names, not yet open.

    Raises ParameterError for values that it cannot work with, and for a driver that is not
    installed or cannot be imported.
    """
    entry = DRIVERS.get(name := str(values['driver']))
    if entry is None:
        raise ParameterError(f'driver = {name!r} is not installed: there are '
                             f'{", ".join(DRIVERS) or "none"}')
    try:
        make = entry.load()
    except (ImportError, AttributeError) as error:
        raise ParameterError(f'driver = {name!r} cannot be imported from {entry.value}: {error}'
                             ) from error
    driver: Driver = make(values, period_s)
    return driver
