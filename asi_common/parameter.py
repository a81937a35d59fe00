"""
The parameter type and tables of parameters.

YAML files, ROS descriptors, documentation and the records for compiled code are generated from
these tables.
"""

import math
import sys
from collections.abc import Mapping
from difflib import get_close_matches
from typing import NamedTuple, TypeGuard

Value = bool | int | float | str


class Parameter(NamedTuple):
    """
    One parameter.

    Its name is that of the ROS parameter, with dots; the part before the first dot is the block.
    """

    name: str
    default: Value
    unit: str
    description: str
    low: float = -math.inf
    high: float = math.inf
    choices: tuple[str, ...] = ()
    read_only: bool = False
    source: str = ''

    @property
    def allowed(self) -> str:
        """Description of the allowed values."""
        if self.choices:
            return 'one of ' + ', '.join(self.choices)
        if isinstance(self.default, bool):
            return 'true or false'
        if isinstance(self.default, str):
            return 'a text'
        kind = 'a whole number' if isinstance(self.default, int) else 'a number'
        if math.isinf(self.low) and math.isinf(self.high):
            return kind
        unit = f' {self.unit}' if self.unit else ''
        return f'{kind} from {self.low:g} to {self.high:g}{unit}'

    def problem(self, value: object) -> str | None:
        """Return why `value` is not allowed, naming parameter, value and range; None if it is."""
        if self._accepts(value):
            return None
        return f'{self.name} = {value!r} is not allowed: it takes {self.allowed}'

    def _accepts(self, value: object) -> bool:
        if isinstance(self.default, bool) or isinstance(value, bool):
            return isinstance(self.default, bool) and isinstance(value, bool)
        if isinstance(self.default, str):
            return isinstance(value, str) and (not self.choices or value in self.choices)
        if isinstance(self.default, int) and not isinstance(value, int):
            return False
        # A whole number may be too large to be a float.
        return (is_number(value) and self.low <= value <= self.high
                and abs(value) <= sys.float_info.max)


class ParameterError(ValueError):
    """The value, type or name of a parameter is not allowed; the text says which and why."""


class Table(tuple[Parameter, ...]):
    """Parameters with constraints on their combination."""

    def check(self, values: Mapping[str, Value]) -> None:
        """Raise ParameterError for a combination of values that is not allowed."""


def is_number(value: object) -> TypeGuard[int | float]:
    """Return whether a value is a number; `true` is none, though Python counts with it."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def with_its_type(parameter: Parameter, value: Value) -> Value:
    """Return 8 as 8.0 where the parameter is a float, and any other value as it is."""
    return float(value) if isinstance(parameter.default, float) and type(value) is int else value


def defaults(table: tuple[Parameter, ...]) -> dict[str, Value]:
    """Return the default of each parameter of a table, by name."""
    return {parameter.name: parameter.default for parameter in table}


def completed(values: Mapping[str, Value], table: tuple[Parameter, ...]) -> dict[str, Value]:
    """
    Return the defaults of a table, changed by `values`.

    Raises ParameterError for an unknown name, or a value or combination that is not allowed.
    """
    by_name = {parameter.name: parameter for parameter in table}
    for name, value in values.items():
        if name not in by_name:
            near = get_close_matches(name, by_name)
            raise ParameterError(f'{name} is not a parameter' + (
                f': did you mean {" or ".join(near)}?' if near else
                '; see doc/reference/parameters.md'))
        if problem := by_name[name].problem(value):
            raise ParameterError(problem)
    complete = defaults(table) | dict(values)
    if isinstance(table, Table):
        table.check(complete)
    return complete
