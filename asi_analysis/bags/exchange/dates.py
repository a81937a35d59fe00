"""Convert columns of dates or times of day to seconds since the first."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from asi_analysis.arrays import Array
from asi_analysis.errors import InputError

_CLOCK: Final = (r'(?P<hour>\d{1,2}):(?P<minute>\d\d)(?::(?P<second>\d\d)(?:[.,](?P<part>\d+))?)?'
                 r'(?:\s*(?P<half>[AaPp])\.?[Mm]\.?)?(?P<zone>Z|[+-]\d\d:?\d\d)?')
_DAY: Final = (r'(?:(?P<year>\d{4})[-/.](?P<month>\d\d?)[-/.](?P<day>\d\d?)'
               r'|(?P<first>\d\d?)(?P<mark>[./-])(?P<second_>\d\d?)(?P=mark)(?P<last>\d{4}))')
_MOMENT: Final = re.compile(rf'(?:{_DAY}[T,\s]\s*)?{_CLOCK}')


def since_first(name: str, column: npt.NDArray, path: Path) -> Array | None:
    """
    Return the seconds since the first of a column of durations, dates with time, or times of day.

    None if it is none of these. Raises InputError where a date can be read in two ways.
    """
    if np.issubdtype(column.dtype, np.timedelta64) or np.issubdtype(column.dtype, np.datetime64):
        known = column[~np.isnat(column)]
        return (column - known[0]) / np.timedelta64(1, 's') if len(known) else None
    if np.issubdtype(column.dtype, np.number) or not len(column):
        return None
    if not _MOMENT.fullmatch(str(column[0]).strip()):
        return None
    days: set[tuple[int, int]] = set()      # day and month in the order of the text, year last
    zones: set[str] = set()
    for each in _moments(column):
        if each is not None:
            zones.add(each['zone'] or 'Z')
            if each['first']:
                days.add((int(each['first']), int(each['second_'])))
    if len(zones) > 1:
        raise InputError(f'{path}: column {name} has times of several zones: '
                         + ', '.join(sorted(zones)))
    # 3.4.2020 is the third of April; 3/4/2020 is ambiguous unless one number exceeds 12.
    first, second = (max((pair[k] for pair in days), default=13) for k in (0, 1))
    dotted = '.' in str(column[0]).partition(':')[0]
    if not dotted and first <= 12 and second <= 12 and len(days) > 1:
        raise InputError(f'{path}: column {name}: {str(column[0])!r} can be read with the day or '
                         'the month first: write dates as YYYY-MM-DD')
    month_first = not dotted and first <= 12
    times = np.full(len(column), 'NaT', 'datetime64[ns]')
    for row, each in enumerate(_moments(column)):
        if each is not None:
            times[row] = np.datetime64(_iso(each, month_first))
    return (times - times[0]) / np.timedelta64(1, 's')


def is_moment(cell: str) -> bool:
    """Return whether a text is a date with time, or a time of day."""
    return ':' in cell and _MOMENT.fullmatch(cell.lstrip('-')) is not None


def _moments(column: npt.NDArray) -> Iterator[re.Match[str] | None]:
    return (_MOMENT.fullmatch(str(cell).strip()) for cell in column)


def _iso(moment: re.Match[str], month_first: bool) -> str:
    """Return a moment as ISO 8601."""
    part = moment.groupdict()
    hour = int(part['hour'])
    if part['half']:
        hour = hour % 12 + (12 if part['half'] in 'Pp' else 0)
    year, month, day = part['year'] or part['last'], part['month'], part['day']
    if part['first']:
        day, month = part['first'], part['second_']
        if month_first:
            month, day = day, month
    # A time of day without a date gets an arbitrary one.
    date = f'{year}-{int(month):02}-{int(day):02}' if year else '1970-01-01'
    return f'{date}T{hour:02}:{part["minute"]}:{part["second"] or "00"}.{part["part"] or "0"}'
