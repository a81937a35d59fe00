"""A table of parameters as the record that compiled code reads."""

from collections.abc import Mapping

import numpy as np

from asi_common.parameter import Parameter, Value, completed


def field_name(name: str) -> str:
    """Return the field of the record that holds the parameter `name`."""
    return name.replace('.', '_')


def record_dtype(table: tuple[Parameter, ...]) -> np.dtype:
    """Return the record type of a table: one float64 field a parameter, texts left out."""
    return np.dtype([(field_name(p.name), np.float64) for p in table if _is_number(p)])


def _is_number(parameter: Parameter) -> bool:
    return bool(parameter.choices) or not isinstance(parameter.default, str)


def as_number(parameter: Parameter, value: Value) -> float:
    """Return the number that stands for `value` in the record: a choice becomes its index."""
    return float(parameter.choices.index(str(value)) if parameter.choices else value)


def record_of(values: Mapping[str, Value], table: tuple[Parameter, ...]) -> np.void:
    """
    Return the record that compiled code reads: a table's defaults, changed by `values`.

    Raises ParameterError for an unknown name, or a value or combination that is not allowed.
    """
    record = np.zeros(1, record_dtype(table))[0]
    complete = completed(values, table)
    for parameter in filter(_is_number, table):
        record[field_name(parameter.name)] = as_number(parameter, complete[parameter.name])
    return record
