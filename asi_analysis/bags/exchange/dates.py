"""Convert columns of dates or times of day to seconds since the first."""

import re
import warnings
from datetime import date
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from asi_analysis.arrays import Array
from asi_analysis.bags.exchange.units import MISSING
from asi_analysis.errors import InputError, InputWarning

# Without a date, the hours of a duration may exceed a day.
_CLOCK: Final = (r'(?P<hour>\d{1,3}):(?P<minute>\d\d)(?::(?P<second>\d\d)(?:[.,](?P<part>\d+))?)?'
                 r'(?:\s*(?P<half>[AaPp])\.?[Mm]\.?)?(?P<zone>Z|[+-]\d\d:?\d\d)?')
_DAY: Final = (r'(?:(?P<year>\d{4})[-/.](?P<month>\d\d?)[-/.](?P<day>\d\d?)'
               r'|(?P<first>\d\d?)(?P<mark>[./-])(?P<second_>\d\d?)(?P=mark)(?P<last>\d{4}))')
_MOMENT: Final = re.compile(rf'(?:{_DAY}[T,\s]\s*)?{_CLOCK}')


def since_first(name: str, column: npt.NDArray, path: Path) -> Array | None:
    """
    Return the seconds since the first of a column of durations, dates with time, or times of day.

    None if it is none of these. Raises InputError where a date can be read in two ways, or does
    not exist.
    """
    if not holds_moments(column):
        return None
    if column.dtype.kind in 'mM':
        known = column[~np.isnat(column)]
        return (column - known[0]) / np.timedelta64(1, 's') if len(known) else None
    cells = [str(cell).strip() for cell in column]
    found = [_MOMENT.fullmatch(cell) for cell in cells]
    month_first = _month_first([each for each in found if each], name, path)
    times = np.full(len(column), np.nan)
    first: int | None = None
    for row, each in enumerate(found):
        if each is None:
            continue
        try:
            time_ns = _nanoseconds(each, month_first)
        except ValueError:
            raise InputError(f'{path}: column {name}, row {row + 1}: there is no date or time '
                             f'{cells[row]!r}') from None
        first = time_ns if first is None else first
        times[row] = (time_ns - first) / 1e9
    return times


def holds_moments(column: npt.NDArray) -> bool:
    """Return whether a column has dates, times of day or durations: its first cell tells."""
    if column.dtype.kind in 'mM' or np.issubdtype(column.dtype, np.number):
        return column.dtype.kind in 'mM'
    cells = (str(cell).strip() for cell in column)
    return is_moment(next((cell for cell in cells if cell.lower() not in MISSING), ''))


def is_moment(cell: str) -> bool:
    """Return whether a text is a date with time, or a time of day."""
    return ':' in cell and _MOMENT.fullmatch(cell) is not None


def _month_first(moments: list[re.Match[str]], name: str, path: Path) -> bool:
    """Return whether dates have the month first. Raises InputError if that is open."""
    zones = {each['zone'] or 'Z' for each in moments}
    if len(zones) > 1:
        raise InputError(f'{path}: column {name} has times of several zones: '
                         + ', '.join(sorted(zones)))
    short = (each[0] for each in moments if not (each['second'] or each['year'] or each['last']))
    if cell := next(short, ''):
        warnings.warn(f'{path}: column {name}: {cell!r} is read as hours and minutes',
                      InputWarning, stacklevel=3)
    # 3.4.2020 is the third of April; 3/4/2020 is ambiguous unless one number exceeds 12.
    days = {(int(each['first']), int(each['second_'])) for each in moments if each['first']}
    first, second = (max((pair[k] for pair in days), default=13) for k in (0, 1))
    dotted = bool(moments) and moments[0]['mark'] == '.'
    if not dotted and first <= 12 and second <= 12 and len(days) > 1:
        raise InputError(f'{path}: column {name}: {moments[0][0]!r} can be read with the day or '
                         'the month first: write dates as YYYY-MM-DD')
    return not dotted and first <= 12


def _nanoseconds(moment: re.Match[str], month_first: bool) -> int:
    """Return a moment in ns, since an arbitrary day. Raises ValueError if there is none such."""
    part = moment.groupdict()
    hour, minute, second = (int(part[each] or 0) for each in ('hour', 'minute', 'second'))
    if part['half']:
        hour = hour % 12 + (12 if part['half'] in 'Pp' else 0)
    year, month, day = part['year'] or part['last'], part['month'], part['day']
    if part['first']:
        day, month = part['first'], part['second_']
        if month_first:
            month, day = day, month
    if minute > 59 or second > 59 or (year and hour > 23):
        raise ValueError
    days = date(int(year), int(month), int(day)).toordinal() if year else 0
    whole = ((days * 24 + hour) * 60 + minute) * 60 + second
    return whole * 10 ** 9 + int((part['part'] or '')[:9].ljust(9, '0'))
