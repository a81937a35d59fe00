"""Rows that were lost at regular intervals, in a recording whose times were numbered again."""

from typing import Final

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.measures.checks.rows import ORDER, Rows, fit, rows_of
from asi_analysis.measures.finding import Interval

# Largest difference of a step of the position from a whole number of steps by the velocity, and
# largest change of the velocity from sample to sample, both as a share.
REGULAR: Final = 0.05
# Least share of steps that are a whole number, and of those that are one; least number of others.
# Each third row lost leaves one half, and a velocity of another sensor no whole numbers.
WHOLE: Final = 0.95
ONE: Final = 0.4
FEWEST_LOST: Final = 5
# Fewest and most rows between two lost ones: fewer show no control law with a memory.
KEPT: Final = (3, 30)
# Rows per unknown of a fit, at least, so that it is exact for a reason; rows of a fit, at most.
ROWS_PER_UNKNOWN: Final = 2
MOST_ROWS: Final = 200
# Share of the rows at a place that satisfy the equation, others may be beside a limit of the
# command; of those that violate it, as others may be at rest.
NEARLY_ALL: Final = 0.98
MOSTLY: Final = 0.5


def skipped_in_motion(time: Array, position: Array, velocity: Array) -> tuple[Interval, ...]:
    """
    Return where the position moves by several steps of its velocity in one, of n samples.

    Empty unless nearly all other steps are one step of the velocity.
    """
    steps = 0.5 * (velocity[1:] + velocity[:-1]) * np.diff(time)
    even = np.abs(np.diff(velocity)) * np.diff(time) < REGULAR * np.abs(steps)
    ratio = np.diff(position)[even] / steps[even]
    number = np.round(ratio)
    whole = (np.abs(ratio - number) < REGULAR * number) & (number >= 1.0)
    lost = np.flatnonzero(even)[whole & (number > 1.0)]
    if len(lost) < FEWEST_LOST or np.mean(whole) < WHOLE or np.mean(number == 1.0) < ONE:
        return ()
    return tuple((float(time[k]), float(time[k + 1])) for k in lost)


def kept_between_lost(time: Array, command: Array, reference: Array, signal: Array
                      ) -> int | None:
    """
    Return how many rows of n lie between two lost ones; None if the command shows no such rows.

    A linear equation gives the command exactly from the rows before it, except after a lost one.
    """
    rows = rows_of(time, command, reference, signal)
    for kept in range(KEPT[0], KEPT[1] + 1):
        shorter = rows.of_order(min(ORDER, kept - 1))
        # One of these places is far enough behind a lost row.
        for place in range(0, kept, kept - shorter.order):
            if _is_exact_between(shorter, kept, place):
                return kept
    return None


def _is_exact_between(rows: Rows, kept: int, place: int) -> bool:
    """Return whether one equation is exact at this place of each `kept` rows, not at all."""
    places = rows.samples % kept
    chosen = np.flatnonzero(places == place)[:MOST_ROWS]
    if len(chosen) < ROWS_PER_UNKNOWN * rows.known.shape[1]:
        return False
    factors = fit(rows.known[chosen], rows.command[chosen])
    if np.abs(rows.command[chosen] - rows.known[chosen] @ factors).max() > rows.exact():
        return False
    met = np.abs(rows.command - rows.known @ factors) < 10.0 * rows.exact()
    share = np.array([np.mean(met[places == k]) if (places == k).any() else 0.0
                      for k in range(kept)])
    exact = share > NEARLY_ALL
    # Each window with a lost row in it violates the equation: places in a row.
    return bool(exact[place] and (share[~exact] < 1.0 - MOSTLY).all()
                and np.count_nonzero(exact != np.roll(exact, 1)) == 2)
