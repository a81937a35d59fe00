"""
What it costs a search to miss the rows that it aims at: those of `facts.table` that are fitted.

A row costs nothing inside the inner part of its limits, so that no row is bettered at the expense
of another that is met; far outside the cost grows more slowly, so that a row that cannot be met
does not bend all the others. A waveform with a spike, a dip or a creep pays as well as a row that
is missed.
"""

import math
from collections.abc import Iterable
from typing import Final

from asi_analysis.paper.facts.fact import Measured, Row
from asi_analysis.paper.facts.table import AIMS

# Share of a row's half width, from the middle, that costs nothing.
INNER: Final = 0.85
# Half widths beyond which a row only costs this share more: it shall not bend all the others.
FAR: Final = 1.0
FAR_SHARE: Final = 0.3
# Half widths of a row that does not exist: the force does not settle, there is no cycle.
WORST: Final = 9.0
# Cost of a waveform that is not one rise.
WRONG_SHAPE: Final = 1.5


def position(row: Row, value: float) -> float:
    """
    Return where a value is: beyond -1 to 1 it misses the row; above 1 if the limit is one-sided.

    In half widths of the limits from their middle; of a single limit, in fifths of it (as it is,
    if it is 0), 1 at the limit.
    """
    if not row.one_sided:
        return (value - 0.5 * (row.low + row.high)) / (0.5 * (row.high - row.low))
    limit = row.low if math.isinf(row.high) else row.high
    beyond = limit - value if math.isinf(row.high) else value - limit
    return 1.0 + beyond / (0.2 * abs(limit) or 1.0)


def miss(row: Row, value: float) -> float:
    """Return how far a value is outside the inner part of a row's limits, in half widths."""
    if row.low == row.high:
        return 0.0 if value == row.low else WRONG_SHAPE
    where = bounded(row, value)
    return max(0.0, (where if row.one_sided else abs(where)) - INNER)


def bounded(row: Row, value: float) -> float:
    """Return the position of a value, WORST at most; WORST if it does not exist."""
    if not math.isfinite(value):
        return WORST
    return min(max(position(row, value), -WORST), WORST)


def cost(misses: Iterable[float]) -> float:
    """Return the cost of misses."""
    return float(sum(min(m, FAR + FAR_SHARE * (m - FAR)) for m in misses))


def misses(measured: Measured) -> list[float]:
    """Return the misses of the rows that have been measured so far."""
    return [miss(row, measured[row.name]) for row in AIMS if row.name in measured]
