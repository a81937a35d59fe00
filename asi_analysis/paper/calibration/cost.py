"""
What a search aims at, and what it costs to miss it: the rows of `facts.table` that are fitted.

A row costs nothing inside the inner part of its limits, so that no row is bettered at the expense
of another that is met; far outside the cost grows more slowly, so that a row that cannot be met
does not bend all the others. A waveform with a spike, a dip or a creep pays as well as a row that
is missed.
"""

import math
from collections.abc import Iterable
from typing import Final

from asi_analysis.paper.facts.measures import Measured
from asi_analysis.paper.facts.table import FACTS, FITTED, Fact

AIMS: Final = tuple(fact for fact in FACTS if fact.role == FITTED)
# Share of a row's half width, from the middle, that costs nothing.
INNER: Final = 0.85
# Half widths beyond which a row only costs this share more: it shall not bend all the others.
FAR: Final = 1.0
FAR_SHARE: Final = 0.3
# Half widths of a row that does not exist: the force does not settle, there is no cycle.
WORST: Final = 9.0
# Cost of a waveform that is not one rise.
WRONG_SHAPE: Final = 1.5


def one_sided(fact: Fact) -> bool:
    """Return whether a fact only has a limit: at least, or at most from a published 0."""
    return math.isinf(fact.high) or fact.low == 0.0


def position(fact: Fact, value: float) -> float:
    """
    Return where a value is: beyond -1 to 1 it misses the fact; above 1 if the limit is one-sided.

    In half widths of the limits from their middle; of a single limit, in fifths of it (as it is,
    if it is 0), 1 at the limit.
    """
    if not one_sided(fact):
        return (value - 0.5 * (fact.low + fact.high)) / (0.5 * (fact.high - fact.low))
    limit = fact.low if math.isinf(fact.high) else fact.high
    beyond = limit - value if math.isinf(fact.high) else value - limit
    return 1.0 + beyond / (0.2 * abs(limit) or 1.0)


def miss(fact: Fact, value: float) -> float:
    """Return how far a value is outside the inner part of a fact's limits, in half widths."""
    if fact.low == fact.high:
        return 0.0 if value == fact.low else WRONG_SHAPE
    where = bounded(fact, value)
    return max(0.0, (where if one_sided(fact) else abs(where)) - INNER)


def bounded(fact: Fact, value: float) -> float:
    """Return the position of a value, WORST at most; WORST if it does not exist."""
    if not math.isfinite(value):
        return WORST
    return min(max(position(fact, value), -WORST), WORST)


def cost(misses: Iterable[float]) -> float:
    """Return the cost of misses."""
    return float(sum(min(m, FAR + FAR_SHARE * (m - FAR)) for m in misses))


def misses(measured: Measured) -> list[float]:
    """Return the misses of the rows that have been measured so far."""
    return [miss(fact, measured[fact.value]) for fact in AIMS if fact.value in measured]
