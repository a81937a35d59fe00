"""The units that a recording may be in."""

import math
from typing import Final

# unit → SI unit, factor
UNITS: Final = {
    's': ('s', 1.0), 'ms': ('s', 1e-3), 'us': ('s', 1e-6), 'ns': ('s', 1e-9),
    'N': ('N', 1.0), 'kN': ('N', 1e3), 'kgf': ('N', 9.80665), 'tf': ('N', 9806.65),
    'lbf': ('N', 4.4482216152605),
    'm': ('m', 1.0), 'cm': ('m', 1e-2), 'mm': ('m', 1e-3), 'um': ('m', 1e-6), 'in': ('m', 0.0254),
    'm/s': ('m/s', 1.0), 'cm/s': ('m/s', 1e-2), 'mm/s': ('m/s', 1e-3),
    'Nm': ('Nm', 1.0), 'mNm': ('Nm', 1e-3), 'Ncm': ('Nm', 1e-2), 'kgfcm': ('Nm', 0.0980665),
    'rad': ('rad', 1.0), 'mrad': ('rad', 1e-3), 'deg': ('rad', math.pi / 180.0),
    'rev': ('rad', 2.0 * math.pi),
    'rad/s': ('rad/s', 1.0), 'deg/s': ('rad/s', math.pi / 180.0),
    'rev/s': ('rad/s', 2.0 * math.pi), 'rpm': ('rad/s', math.pi / 30.0),
    'V': ('V', 1.0), 'mV': ('V', 1e-3), 'A': ('A', 1.0), 'mA': ('A', 1e-3),
    '1': ('1', 1.0), '%': ('1', 1e-2)}
