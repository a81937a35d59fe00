"""The types `Compensator`, which each file in `compensators/` declares, and `Design`."""

from collections.abc import Callable
from typing import Final, NamedTuple

from asi_common.parameter import Parameter

# The discrete compensator has the response of the design at this frequency: the phase is most
# important at that of the limit cycle.
PREWARP_HZ: Final = 90.0
# Capacity of the record for compiled code.
MOST_POLES: Final = 16


class Design(NamedTuple):
    """A compensator in continuous time: zeros and poles in rad/s, gain at zero frequency."""

    zeros: tuple[complex, ...]
    poles: tuple[complex, ...]
    gain: float


class Compensator(NamedTuple):
    """
    A compensator of the controller.

    name: its value of the parameter `compensator`, and the block of its own parameters.
    gain: the gain in use while the parameter `gain` is 0.
    order: position in lists, the smallest first.
    design: called with the gain, and its own parameters by keyword, as `ratio` for
    `lead_lag.ratio`; raises ParameterError for a combination that is not allowed.
    parameters: their names without the block.
    gain_at: frequencies at which the gain applies, if not at zero frequency.
    """

    name: str
    gain: float
    order: int
    design: Callable[..., Design]
    parameters: tuple[Parameter, ...] = ()
    gain_at: str = ''

    @property
    def table(self) -> tuple[Parameter, ...]:
        """Its parameters with their full names."""
        return tuple(each._replace(name=f'{self.name}.{each.name}') for each in self.parameters)
