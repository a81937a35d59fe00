"""
The cost function of a search: the deviations of the fitted rows from their limits.

A row has no cost in the inner part of its limits, so that no row is improved at the expense of
another that is met. Far outside the cost grows more slowly, so that a row that cannot be met does
not dominate the fit. A waveform with a spike, a dip or a creep costs as much as a missed row.
"""

import math
from collections.abc import Iterable
from typing import Final

from asi_analysis.paper.facts.fact import Measured, Row
from asi_analysis.paper.facts.table import FITTED_ROWS

# Share of a row's half width, from the middle, in which the cost is zero.
INNER: Final = 0.85
# A miss of more than FAR half widths grows with FAR_SHARE of its slope, as in a Huber loss.
FAR: Final = 1.0
FAR_SHARE: Final = 0.3
# Deviation, in half widths, of a row without a value: the force does not settle, or no cycle.
WORST: Final = 9.0
# Cost of a waveform that is not a single rise.
WRONG_SHAPE: Final = 1.5


def position(row: Row, value: float) -> float:
    """
    Return the position of a value in the limits of a row; the row is met from -1 to 1.

    In half widths from the middle of the limits. With a single limit: in fifths of the limit (in
    the row's unit if it is 0), 1 at the limit, above 1 if missed.
    """
    if not row.one_sided:
        return (value - 0.5 * (row.low + row.high)) / (0.5 * (row.high - row.low))
    limit = row.low if math.isinf(row.high) else row.high
    beyond = limit - value if math.isinf(row.high) else value - limit
    return 1.0 + beyond / (0.2 * abs(limit) or 1.0)


def miss(row: Row, value: float) -> float:
    """Return the distance of a value from the inner part of a row's limits, in half widths."""
    if row.low == row.high:
        return 0.0 if value == row.low else WRONG_SHAPE
    at = bounded(row, value)
    return max(0.0, (at if row.one_sided else abs(at)) - INNER)


def bounded(row: Row, value: float) -> float:
    """Return the position of a value, limited to +-WORST; WORST if it is not finite."""
    if not math.isfinite(value):
        return WORST
    return min(max(position(row, value), -WORST), WORST)


def cost(misses: Iterable[float]) -> float:
    """Return the cost of misses."""
    return float(sum(min(m, FAR + FAR_SHARE * (m - FAR)) for m in misses))


def misses(measured: Measured, rows: Iterable[Row] = FITTED_ROWS) -> list[float]:
    """Return the misses of the rows measured so far, by default of the fitted ones."""
    return [miss(row, measured[row.name]) for row in rows if row.name in measured]
