"""Units of imported recordings, their conversion to SI, and what cells are numbers."""

import functools
import math
import re
from typing import Final

# What stands for a missing value; those with # are the errors of Excel.
MISSING: Final = frozenset((
    '', 'na', 'n/a', 'null', 'none', '-', 'nan', '#n/a', '#div/0!', '#num!', '#value!', '#ref!',
    '#name?', '#null!', '#spill!', '#calc!', '#getting_data'))
# unit → SI unit, factor
UNITS: Final = {
    's': ('s', 1.0), 'ms': ('s', 1e-3), 'us': ('s', 1e-6), 'ns': ('s', 1e-9),
    'N': ('N', 1.0), 'MN': ('N', 1e6), 'mN': ('N', 1e-3), 'kN': ('N', 1e3),
    'kgf': ('N', 9.80665), 'tf': ('N', 9806.65), 'lbf': ('N', 4.4482216152605),
    'm': ('m', 1.0), 'cm': ('m', 1e-2), 'mm': ('m', 1e-3), 'um': ('m', 1e-6), 'in': ('m', 0.0254),
    'ft': ('m', 0.3048),
    'm/s': ('m/s', 1.0), 'cm/s': ('m/s', 1e-2), 'mm/s': ('m/s', 1e-3),
    'Nm': ('Nm', 1.0), 'kNm': ('Nm', 1e3), 'mNm': ('Nm', 1e-3), 'Ncm': ('Nm', 1e-2),
    'kgfcm': ('Nm', 0.0980665),
    'rad': ('rad', 1.0), 'mrad': ('rad', 1e-3), 'urad': ('rad', 1e-6),
    'mdeg': ('rad', math.pi / 180e3), 'deg': ('rad', math.pi / 180.0),
    '°': ('rad', math.pi / 180.0), 'rev': ('rad', 2.0 * math.pi),
    'rad/s': ('rad/s', 1.0), 'deg/s': ('rad/s', math.pi / 180.0),
    '°/s': ('rad/s', math.pi / 180.0),
    'rev/s': ('rad/s', 2.0 * math.pi), 'rpm': ('rad/s', math.pi / 30.0),
    'V': ('V', 1.0), 'mV': ('V', 1e-3), 'A': ('A', 1.0), 'mA': ('A', 1e-3),
    'Pa': ('Pa', 1.0), 'kPa': ('Pa', 1e3), 'MPa': ('Pa', 1e6), 'bar': ('Pa', 1e5),
    'psi': ('Pa', 6894.757293168361),
    '1': ('1', 1.0), '%': ('1', 1e-2)}
# LabVIEW writes -19m for -0.019.
SI_NUMBER: Final = re.compile(r'([+-]?(?:\d+\.?\d*|\.\d+))([pnuµmkMG])')
SI_PREFIX: Final = {'p': 1e-12, 'n': 1e-9, 'u': 1e-6, 'µ': 1e-6, 'm': 1e-3, 'k': 1e3, 'M': 1e6,
                    'G': 1e9}
# A number with one comma.
WITH_COMMA: Final = re.compile(r'[+-]?\d*,\d+(?:[eE][+-]?\d+)?[pnuµmkMG]?')
# A list in a cell: [1, 2], (1; 2), [1 2] of numpy, or array('d', [1, 2]) of a ROS message.
_LIST: Final = re.compile(r"(?:\w+\((?:'\w', *)?)?[\[(]([^\[\]()]*)[\])](?:, *\w+=[\w.]+)?\)?")
# Units that are the whole name of a column.
WHOLE: Final = ('mm', 'deg', 'rad', 'rpm', 'kN', 'Nm', 'bar', 'psi', 'MPa')
# Ends of names, as in force_kip; of the name of a time, since pos_min is a least position.
ENDS: Final = {'sec': 's', 'msec': 'ms', 'usec': 'us', 'nsec': 'ns', 'kip': 'kip', 'inch': 'in',
               'yard': 'yard'}
TIME_ENDS: Final = {'min': 'min', 'h': 'h', 'hr': 'h', 'hours': 'h'}
TIMES: Final = ('t', 'time', 'elapsed', 'timestamp')
# What stands in brackets after a name.
BRACKETS: Final = re.compile(r'[\[(]\s*([^\])]+?)\s*[\])]\s*$')
# SI unit → its name in pint. Angles have no dimension in pint: UNITS lists all of theirs.
_PINT: Final = {'s': 's', 'N': 'N', 'm': 'm', 'm/s': 'm/s', 'Nm': 'N*m', 'V': 'V', 'A': 'A',
                'Pa': 'Pa'}
_WHOLE: Final = re.compile(r'(?<![\w.])\d+(?![\w.])')
_NOT_DECIMAL: Final = re.compile(r'\d[_xXoObB]')


@functools.cache
def conversion(unit: str) -> tuple[str, float] | None:
    """
    Return the SI unit and the factor of a unit; None if it is unknown.

    Other units than those of UNITS are looked up in pint, such as kip, ft, psi or bar*cm^2.
    """
    if unit in UNITS:
        return UNITS[unit]
    if _NOT_DECIMAL.search(unit):
        return None
    # Powers of whole numbers, such as 10**10**8, take pint for ever; those of floats overflow.
    in_floats = _WHOLE.sub(r'\g<0>.0', unit)
    import pint
    try:
        quantity = pint.get_application_registry().Quantity(1.0, in_floats)
        return next(((si, factor) for si, name in _PINT.items()
                     if quantity.is_compatible_with(name)
                     and 0.0 < (factor := float(quantity.to(name).magnitude)) < math.inf), None)
    except Exception:  # noqa: B902 - pint raises anything for a text that is no unit
        return None


def unit_in(name: str) -> str:
    """Return the unit in a name, as in force [kN], force (kN) or force_kN; '' without one."""
    found = BRACKETS.search(name)
    candidates = [found[1]] if found else []
    head, _, last = name.replace(' ', '_').rpartition('_')
    ends = ENDS | (TIME_ENDS if head.lower() in TIMES else {})
    if head and last.lower() in ends:
        return ends[last.lower()]
    candidates += [f'{head.rpartition("_")[2]}/s'] if last == 's' and '_' in head else []
    candidates += [last] if head or last in WHOLE else []
    candidates += [last] if (last := name.rpartition('.')[2]) in WHOLE else []
    by_case = {unit.lower(): unit for unit in UNITS}
    for each in candidates:
        if each in UNITS or (found and conversion(each)):
            return each
        if each.lower() in by_case and not each.isdigit():
            return by_case[each.lower()]
    return ''


def is_number(cell: str) -> bool:
    """Return whether a cell is a number, also one with a decimal comma, or empty."""
    try:
        float(cell or 'nan')
    except ValueError:
        return bool(SI_NUMBER.fullmatch(cell) or WITH_COMMA.fullmatch(cell))
    return True


def numbers_in(cell: str) -> int:
    """Return how many numbers a cell holds: of a list its elements."""
    elements = elements_in(cell)
    return int(is_number(cell)) if elements is None else len(elements)


def elements_in(cell: str) -> list[float] | None:
    """
    Return the numbers of a list in a cell; None if it holds no list of numbers.

    Between semicolons, a comma is a decimal comma.
    """
    found = _LIST.fullmatch(cell) if cell[-1:] in tuple('])') else None
    if found is None:
        return None
    inner = found[1].strip()
    mark = next((each for each in ';,' if each in inner), None)
    elements = [each.strip() for each in inner.split(mark)] if inner else []
    try:
        return [float('nan' if each.lower() in MISSING else each.replace(',', '.'))
                for each in elements]
    except ValueError:
        return None
