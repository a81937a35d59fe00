"""Conversion of a table of parameters to a NumPy record for compiled code."""

from collections.abc import Iterable, Mapping

import numpy as np

from asi_common.parameter import Parameter, Value, completed


def field_name(name: str) -> str:
    """Return the name of the field of a parameter."""
    return name.replace('.', '_')


def record_dtype(table: tuple[Parameter, ...]) -> np.dtype:
    """Return the dtype of a table: a float64 field for each parameter but texts."""
    return np.dtype([(field_name(p.name), np.float64) for p in table if _is_number(p)])


def _is_number(parameter: Parameter) -> bool:
    return bool(parameter.choices) or not isinstance(parameter.default, str)


def as_number(parameter: Parameter, value: Value) -> float:
    """Return the number for a value in the record; a choice is its index."""
    return float(parameter.choices.index(str(value)) if parameter.choices else value)


def copy_of(record: np.void) -> np.void:
    """Return a copy of a record, much faster than its own method: that copies field by field."""
    copied: np.void = np.frombuffer(bytearray(record.tobytes()), record.dtype)[0]
    return copied


def with_fields(record: np.void, names: Iterable[str]) -> np.void:
    """Return a record with further fields of type float64 at its end, all 0."""
    added = np.dtype([(name, np.float64) for name in names])
    wide: np.void = np.frombuffer(bytearray(record.tobytes() + bytes(added.itemsize)),
                                  np.dtype(record.dtype.descr + added.descr))[0]
    return wide


def record_of(values: Mapping[str, Value], table: tuple[Parameter, ...]) -> np.void:
    """
    Return the record for compiled code: a table's defaults, changed by `values`.

    Raises ParameterError for an unknown name, or a value or combination that is not allowed.
    """
    record = np.zeros(1, record_dtype(table))[0]
    complete = completed(values, table)
    for parameter in filter(_is_number, table):
        record[field_name(parameter.name)] = as_number(parameter, complete[parameter.name])
    return record
