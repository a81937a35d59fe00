"""What the columns of a table are, by texts such as `force=CHANNEL1*9806.65[N]`."""

import re
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from asi_analysis.bags.exchange.table_file import Table, is_number
from asi_analysis.bags.exchange.units import UNITS
from asi_analysis.bags.run import SIGNALS, Array
from asi_analysis.errors import InputError

# A joint may turn; a servo's reference is in the unit of what it controls; a drive may be
# commanded by a voltage, a current or a share of what it has (PWM).
TAKES: Final = {'time': ('s',), **{signal.name: (signal.unit,) for signal in SIGNALS},
                'position': ('m', 'rad'), 'velocity': ('m/s', 'rad/s'), 'force': ('N', 'Nm'),
                'command': ('N', 'Nm', 'V', 'A', '1'),
                'reference': ('N', 'm', 'm/s', 'Nm', 'rad', 'rad/s')}
MISSING: Final = frozenset(('', 'na', 'n/a', '#n/a', 'null', 'none', '-'))
_NUMBER: Final = r'[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?'
_TERM: Final = re.compile(
    rf'(?P<column>.+?)(?:\*(?P<scale>{_NUMBER}|[A-Za-z_]\w*))?(?P<offset>[+-]{_NUMBER})?$')


class Assignment(NamedTuple):
    """One mapping: signal = (column * scale + offset) in a unit."""

    text: str
    signal: str
    term: str
    unit: str


def parse_mapping(text: str) -> Assignment:
    """Return the parts of a mapping. Raises InputError if it is none."""
    signal, equals, term = text.partition('=')
    signal, term, unit = signal.strip(), term.strip(), ''
    if not equals or not term:
        raise InputError(f'{text!r} is not a mapping: expected '
                         'SIGNAL=COLUMN[*SCALE][+OFFSET][UNIT]')
    if signal not in TAKES:
        raise InputError(f'{text!r}: there is no signal {signal}; there are {", ".join(TAKES)}')
    if found := re.fullmatch(r'(.*?)\s*\[([^\[\]]*)\]', term):
        term, unit = found[1], found[2].strip()
        allowed = [name for name, (si, _) in UNITS.items() if si in TAKES[signal]]
        if unit not in allowed:
            hint = ('a commanded motion is a reference' if signal == 'command' and UNITS.get(
                unit, ('',))[0] in ('m', 'rad', 'm/s', 'rad/s') else
                'scale other quantities, as in force=volts*250[N] or position=counts*0.088[deg]')
            raise InputError(f'{text!r}: {signal} takes {", ".join(allowed)}, not {unit!r}; '
                             + hint)
    return Assignment(text, signal, term, unit or TAKES[signal][0])


def own_mapping(table: Table) -> list[str]:
    """Return the mappings of the columns that `asi export` writes."""
    names = {f'{signal}_{unit.replace("/", "_").lower()}': f'{signal}={{}}[{unit}]'
             for signal, units in TAKES.items() for unit in units}
    return [names[column].format(column) for column in table if column in names]


def evaluate(mapping: Assignment, table: Table, path: Path) -> tuple[Array, str]:
    """Return the values of a mapping in SI units, and the unit. Raises InputError."""
    whole = mapping.text.partition('=')[2].strip()
    # The unit may stand in the header: `torque [Nm]`.
    term, scale, offset = whole if whole in table else mapping.term, 1.0, 0.0
    if term not in table:
        found = _TERM.fullmatch(term)
        if found is None or found['column'].strip() not in table:
            raise InputError(f'{path}: {mapping.text!r} names no column; there are '
                             + ', '.join(table))
        term = found['column'].strip()
        scale = _scale(found['scale'], table, mapping, path)
        offset = float(found['offset'] or 0.0)
    unit, factor = UNITS[mapping.unit]
    if mapping.signal == 'time' and (seconds := _since_first(table[term])) is not None:
        return seconds, 's'
    values = _numbers(term, table[term], path)
    if scale != 1.0 or offset != 0.0:
        values = values * scale + offset
    return (values if factor == 1.0 else values * factor), unit


def _scale(text: str | None, table: Table, mapping: Assignment, path: Path) -> float:
    if text is None:
        return 1.0
    if text in table:
        if np.size(table[text]) != 1:
            raise InputError(f'{path}: {mapping.text!r}: {text} holds {np.size(table[text])} '
                             'values, a scale is one')
        return float(_numbers(text, table[text], path)[0])
    try:
        return float(text)
    except ValueError:
        raise InputError(f'{path}: {mapping.text!r}: the scale {text!r} is neither a number nor '
                         'one of ' + ', '.join(table)) from None


def _since_first(column: npt.NDArray) -> Array | None:
    """Return the seconds since the first of a column of dates with time; None if it is none."""
    try:
        if not np.issubdtype(column.dtype, np.datetime64):
            if is_number(str(column[0])):
                return None
            # Of a time of day any date will do.
            day = '' if '-' in str(column[0]) else '1970-01-01T'
            column = np.array([day + str(cell).removesuffix('Z') for cell in column],
                              'datetime64[ns]')
        return (column - column[0]) / np.timedelta64(1, 's')
    except (ValueError, IndexError):
        return None


def _numbers(name: str, column: npt.NDArray, path: Path) -> Array:
    """Return a column as numbers, NaN where a cell is empty."""
    if np.issubdtype(column.dtype, np.number):
        values = np.ravel(column).astype(float)
    else:
        values = np.full(len(column), np.nan)
        for row, cell in enumerate(column):
            if str(cell).strip().lower() not in MISSING:
                try:
                    values[row] = float(cell)
                except ValueError:
                    raise InputError(f'{path}: column {name}, row {row + 1}: {cell!r} is not a '
                                     'number') from None
    if np.isinf(values).any():
        raise InputError(f'{path}: column {name}, row {int(np.argmax(np.isinf(values))) + 1}: '
                         'infinite')
    return values
