"""Map columns of a table to signals by texts such as `force=CHANNEL1*9806.65[N]`."""

import math
import re
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from asi_analysis.arrays import Array
from asi_analysis.bags.exchange.dates import since_first
from asi_analysis.bags.exchange.table_file import Table
from asi_analysis.bags.exchange.units import (
    BRACKETS,
    MISSING,
    SI_NUMBER,
    SI_PREFIX,
    conversion,
    unit_in,
)
from asi_analysis.bags.run import SIGNALS
from asi_analysis.errors import InputError, InputWarning

# Units allowed for each signal. A joint may be rotary, a reference has the unit of the controlled
# signal, and a command may be a voltage, a current or a duty cycle.
UNITS_OF: Final = {'time': ('s',), **{signal.name: (signal.unit,) for signal in SIGNALS},
                'position': ('m', 'rad'), 'velocity': ('m/s', 'rad/s'), 'force': ('N', 'Nm'),
                'command': ('N', 'Nm', 'V', 'A', 'Pa', '1'),
                'reference': ('N', 'm', 'm/s', 'Nm', 'rad', 'rad/s', 'Pa')}
STATED: Final = re.compile(r'(.+) \[[^\[\]]+\]')
MOST_LISTED: Final = 40     # columns named in a message
_UNSIGNED: Final = r'(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?'
_NUMBER: Final = rf'[+-]?{_UNSIGNED}'
_TERM: Final = re.compile(
    rf'(?P<column>.+?)(?:\*(?P<scale>{_NUMBER}|[A-Za-z_]\w*))?(?P<offset>[+-]{_UNSIGNED})?$')


# Scales that read an unsigned number as the signed one with the same bits, as registers hold it.
SIGNED: Final = {'int16': 2.0 ** 16, 'int32': 2.0 ** 32}
DATE: Final = 'date'     # in place of the unit of a time that needs none
LEAST_WRAPPED: Final = 5    # samples near 0 and near the end of the range


class Assignment(NamedTuple):
    """One mapping: signal = (column * scale + offset) in a unit, '' if it has none."""

    text: str
    signal: str
    term: str
    unit: str


def parse_mapping(text: str) -> Assignment:
    """Parse the text of a mapping. Raises InputError if it has another form."""
    signal, equals, term = text.partition('=')
    signal, term, unit = signal.strip(), term.strip(), ''
    if not equals or not term:
        raise InputError(f'{text!r} is not a mapping: expected '
                         'SIGNAL=COLUMN[*SCALE][+OFFSET][UNIT]')
    if signal not in UNITS_OF:
        raise InputError(f'{text!r}: there is no signal {signal}; there are {", ".join(UNITS_OF)}')
    if found := re.fullmatch(r'(.*?)\s*\[([^\[\]]*)\]', term):
        term, unit = found[1], found[2].strip()
        converted = conversion(unit)
        if converted is None or converted[0] not in UNITS_OF[signal]:
            si = converted[0] if converted else ''
            hint = ('a commanded motion is a reference'
                    if signal == 'command' and si in ('m', 'rad', 'm/s', 'rad/s') else
                    'a pressure times an area is a force, as in force=p*12.5[bar*cm^2]'
                    if signal == 'force' and si == 'Pa' else
                    'scale other quantities, as in force=volts*250[N] or '
                    'position=counts*0.088[deg]')
            raise InputError(f'{text!r}: {signal} takes {", ".join(UNITS_OF[signal])} and their '
                             f'multiples, not {unit!r}; {hint}')
    return Assignment(text, signal, term, unit)


def listed(names: Iterable[str]) -> str:
    """Return names for a message; of many, the first."""
    known = list(names)
    more = len(known) - MOST_LISTED
    return ', '.join(known[:MOST_LISTED]) + (f' and {more} more' if more > 0 else '')


def own_mapping(table: Table) -> list[str]:
    """Return the mappings of the columns that `asi export` writes."""
    names = {f'{signal}_{unit.replace("/", "_").lower()}': f'{signal}={{}}[{unit}]'
             for signal, units in UNITS_OF.items() for unit in units}
    return [names[column].format(column) for column in table if column in names]


def column_of(mapping: Assignment, table: Table) -> str | None:
    """Return the name of the column of a mapping; None if the table has none such."""
    whole = mapping.text.partition('=')[2].strip()
    # The header may contain the unit: `torque [Nm]`.
    term = whole if whole in table else mapping.term
    column = column_part(mapping)
    found = next((each for each in (term, column) if each in table), None)
    if found is None:   # a line of units below the header is part of the name: `torque [Nm]`
        stated = [name for name in table if (each := STATED.fullmatch(name)) and (
            each[1] in (term, column))]
        found = stated[0] if len(stated) == 1 else None
    return found


def column_part(mapping: Assignment) -> str:
    """Return the column of a mapping without scale and offset."""
    found = _TERM.fullmatch(mapping.term)
    return found['column'].strip() if found else ''


def evaluate(mapping: Assignment, table: Table, path: Path) -> tuple[Array, str]:
    """Return the values of a mapping in SI units, and the unit, or DATE. Raises InputError."""
    term, scale, offset = column_of(mapping, table), 1.0, 0.0
    if term is None:
        raise InputError(f'{path}: {mapping.text!r} names no column{_other_form(mapping, table)}; '
                         f'there are {listed(table)}')
    found = _TERM.fullmatch(mapping.term)
    span = 0.0
    if found and term not in (mapping.term, mapping.text.partition('=')[2].strip()):
        span = 0.0 if found['scale'] in table else SIGNED.get(found['scale'] or '', 0.0)
        scale = 1.0 if span else _scale(found['scale'], table, mapping, path)
        offset = float(found['offset'] or 0.0)
    if mapping.signal == 'time' and (
            seconds := since_first(term, table[term], path)) is not None:
        if mapping.unit not in ('', 's') or scale != 1.0:
            raise InputError(f'{path}: {mapping.text!r}: {term} holds dates or durations, which '
                             'have their unit: leave scale and unit out')
        return seconds + offset, DATE
    values = numbers_of(term, table[term], path)
    if span:
        values = (values + 0.5 * span) % span - 0.5 * span
    elif mapping.signal != 'time' and (kind := wrapped(values)):
        warnings.warn(f'{path}: column {term} has values near 0 and near the largest of '
                      f'u{kind}, and none between: it looks like a signed number that was read as '
                      f'an unsigned one; if so, map {mapping.signal}={term}*{kind}', InputWarning,
                      stacklevel=2)
    scaled = scale != 1.0 or offset != 0.0
    if scaled:
        values = values * scale + offset
    unit, factor = conversion(mapping.unit or _stated(mapping, term, scaled, path)) or ('', 1.0)
    return (values if factor == 1.0 else values * factor), unit


def with_stated_unit(text: str, table: Table) -> str:
    """Return a mapping with the unit in brackets in the name of its column, if it has none."""
    mapping = parse_mapping(text)
    column = column_of(mapping, table)
    scaled = column not in (mapping.term, text.partition('=')[2].strip()) and (
        column_part(mapping) != mapping.term)
    if column is None or mapping.unit or mapping.signal == 'time' or scaled:
        return text
    unit = unit_in(column) if BRACKETS.search(column) else ''
    known = conversion(unit)
    return f'{text}[{unit}]' if known and known[0] in UNITS_OF[mapping.signal] else text


def _other_form(mapping: Assignment, table: Table) -> str:
    """Return how to write x/1000, -x and 2*x, if that is what a mapping has."""
    found = re.fullmatch(rf'-(?P<negative>.+)|(?P<factor>{_NUMBER})\*(?P<scaled>.+)'
                         rf'|(?P<divided>.+?)/(?P<by>{_UNSIGNED})', mapping.term)
    column = found and (found['negative'] or found['scaled'] or found['divided'])
    if not found or not column or column.strip() not in table:
        return ''
    if not (by := float(found['by'] or 1.0)):
        return ''
    scale = found['factor'] or f'{1.0 / by:.12g}'
    return f': write {column.strip()}*{"-1" if found["negative"] else scale}'


def _stated(mapping: Assignment, column: str, scaled: bool, path: Path) -> str:
    """
    Return the unit of a mapping without one: that in brackets in the name of the column.

    Otherwise, and after a scale or an offset, it is the SI unit. Warns unless that is the unit
    in the name, too.
    """
    unit, si = unit_in(column), UNITS_OF[mapping.signal][0]
    found = conversion(unit)
    if found is None or found == (si, 1.0) or unit.isdigit():
        return si
    fits = found[0] in UNITS_OF[mapping.signal]
    bracketed = BRACKETS.search(column) is not None
    if bracketed and fits and not scaled:
        warnings.warn(f'{path}: {mapping.text!r} is read in {unit}, which the column {column!r} '
                      f'states; write {mapping.text}[{unit}] to say so', InputWarning,
                      stacklevel=3)
        return unit
    if fits if scaled else fits or bracketed:
        write = f'; if it is in {unit}, write {mapping.text}[{unit}]' if fits else ''
        warnings.warn(f'{path}: {mapping.text!r} has no unit and is taken in {si}, though the '
                      f'name of the column {column!r} suggests {unit}{write}', InputWarning,
                      stacklevel=3)
    return si


def wrapped(values: Array) -> str:
    """Return the kind of signed number that values seem to be, read as unsigned; '' if none."""
    known = values[np.isfinite(values)]
    for kind, span in SIGNED.items():
        near = [int(np.sum(known < 0.25 * span)), int(np.sum(known >= 0.75 * span))]
        if (min(near) >= LEAST_WRAPPED and sum(near) == known.size and known.min() >= 0.0
                and known.max() < span and np.all(known == np.round(known))):
            return kind
    return ''


def _scale(text: str | None, table: Table, mapping: Assignment, path: Path) -> float:
    if text is None:
        return 1.0
    if text in table:
        if np.size(table[text]) != 1:
            raise InputError(f'{path}: {mapping.text!r}: {text} holds {np.size(table[text])} '
                             'values, a scale is one')
        return float(numbers_of(text, table[text], path)[0])
    try:
        scale = float(text)
        if math.isfinite(scale):
            return scale
        raise ValueError
    except ValueError:
        raise InputError(f'{path}: {mapping.text!r}: the scale {text!r} is neither a number nor '
                         'one of ' + listed(table)) from None


def numbers_of(name: str, column: npt.NDArray, path: Path) -> Array:
    """Return a column as numbers, NaN where a cell is empty."""
    if np.iscomplexobj(column):
        raise InputError(f'{path}: column {name} has complex numbers')
    if np.issubdtype(column.dtype, np.number):
        values = np.ravel(column).astype(float)
    else:
        values = np.full(len(column), np.nan)
        with_prefix = 0
        for row, cell in enumerate(map(str, column)):
            try:
                values[row] = float(cell)
            except ValueError:
                if cell.strip().lower() in MISSING:
                    continue
                found = SI_NUMBER.fullmatch(cell.strip())
                if found is None:
                    hint = ('; is that a decimal comma, or does it separate thousands? Write '
                            'numbers with a point and without separators of thousands'
                            if ',' in cell else '')
                    raise InputError(f'{path}: column {name}, row {row + 1}: {cell[:60]!r} is '
                                     f'not a number{hint}') from None
                values[row] = float(found[1]) * SI_PREFIX[found[2]]
                with_prefix += 1
        if with_prefix:
            warnings.warn(f'{path}: column {name}: {with_prefix} cells such as -19m are read with '
                          'their SI prefix', InputWarning, stacklevel=2)
    if np.isinf(values).any():
        raise InputError(f'{path}: column {name}, row {int(np.argmax(np.isinf(values))) + 1}: '
                         'infinite')
    return values
