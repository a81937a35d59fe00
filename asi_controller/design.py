"""What a file in `compensators/` declares: the type of a compensator, and of what it designs."""

from collections.abc import Callable
from typing import Final, NamedTuple

from asi_common.parameter import Parameter

# As many as the record that compiled code reads has room for.
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
    order: its place in lists, the smallest first.
    design: called with the gain, and its own parameters by keyword, as `ratio` for
    `lead_lag.ratio`; raises ParameterError if they do not go together.
    parameters: their names without the block.
    gain_at: where the gain is that of the compensator, if not at zero frequency.
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
