"""Checks for parameters outside their physically plausible range or on a bound of the search."""

import math
from collections.abc import Callable, Mapping
from typing import Final, NamedTuple

from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_analysis.paper.calibration.quantities import FREE, OFF, Candidate, quantities
from asi_common.parameter import completed

# Distance from a bound, as a share of the range, that counts as on the bound.
ON_BOUND: Final = 0.01
# Frequency (Hz) of the limit cycle, at which the loss factor of the seals is computed.
CYCLE_HZ: Final = 90.0
PACKAGE_KG: Final = 0.5

Numbers = Mapping[str, float]


class Range(NamedTuple):
    """The plausible range of a quantity derived from several parameters, and its source."""

    name: str
    unit: str
    low: float
    high: float
    source: str
    value: Callable[[Numbers], float]     # of the actuator, with the load of Table 1


class Finding(NamedTuple):
    """A quantity outside its plausible range or on a bound; figures in `unit`."""

    name: str
    value: float
    low: float
    high: float
    unit: str
    problem: str
    source: str


def _ratio(damping: float, stiffness: float, mass: float) -> float:
    return damping / (2.0 * math.sqrt(stiffness * mass))


DERIVED: Final = (
    Range('damping ratio of the locked structure', '', 0.005, 0.05,
          'steel structures with joints: 0.01 to 0.05',
          lambda p: _ratio(p['load.locked_damping'], p['load.locked_stiffness'], p['load.mass'])),
    Range('loss factor of the seals at 90 Hz', '', 0.05, 1.0, 'elastomers: 0.05 to 1',
          lambda p: 2.0 * math.pi * CYCLE_HZ * p['friction.presliding_damping']
          / p['friction.presliding_stiffness']),
    Range('locked mass that the sensor does not feel', 'kg', 0.0, PACKAGE_KG,
          'section 2.1: the package weighs 0.5 kg',
          lambda p: p['force_sensor.mass_share'] * p['load.mass']),
)
# Of the load of Table 1, if it is a spring.
OF_SPRING: Final = (
    Range('damping ratio of the load of Table 1', '', 0.005, 0.05,
          'steel spring: 0.005 to 0.05',
          lambda p: _ratio(p['load.damping'], p['load.stiffness'], p['load.mass'])),
    Range('mass of Table 1 that the sensor does not feel', 'kg', 0.0, PACKAGE_KG,
          'section 2.1: the package weighs 0.5 kg',
          lambda p: p['force_sensor.mass_share'] * p['load.mass']),
)


def derived(one: Candidate) -> list[tuple[Range, float]]:
    """Return the derived quantities of a candidate, each with its range."""
    def numbers(values: Mapping[str, object]) -> Numbers:
        return {name: value for name, value in values.items() if isinstance(value, float)}

    locked = numbers(completed(one.actuator, ACTUATOR_PARAMETERS))
    load = one.conditions.proportional.load
    found = [(each, each.value(locked)) for each in DERIVED]
    if load['load.type'] == 'spring':
        found += [(each, each.value({**locked, **numbers(load)})) for each in OF_SPRING]
    return found


def findings(one: Candidate) -> list[Finding]:
    """Return the quantities of a candidate that are implausible or on a bound of the search."""
    found = [Finding(each.name, value, each.low, each.high, each.unit, 'outside its range',
                     each.source)
             for each, value in derived(one) if not each.low <= value <= each.high]
    known = quantities(one)
    locked = one.conditions.proportional.load['load.type'] == 'locked'
    for free in FREE:
        value = known[free.name]
        if (locked and free.name.startswith('conditions.load.')
                or value == OFF.get(free.name)):
            continue
        if not free.low <= value <= free.high:
            found.append(Finding(free.name, value, free.low, free.high, '', 'outside its range',
                                 free.source))
        elif not ON_BOUND <= free.share(value) <= 1.0 - ON_BOUND:
            found.append(Finding(free.name, value, free.low, free.high, '',
                                 'on a bound of the search', free.source))
    return found


def penalty(one: Candidate) -> float:
    """Return the cost of derived quantities outside their ranges: 1 for each factor of e."""
    return sum(abs(math.log(max(value, 1e-9) / min(max(value, each.low), each.high)))
               for each, value in derived(one) if not each.low <= value <= each.high)
