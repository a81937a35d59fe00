"""
Whether a cycle is isolated, as a limit cycle must be, from segments of one or more bags.

A closed orbit could be one of a continuous family (a linear loop at its stability limit). It is
isolated if the same orbit is reached from inside and from outside, or again after a disturbance
(Khalil, Nonlinear Systems, 2002, section 2.4).
"""

from collections.abc import Sequence
from typing import Final

from asi_analysis.limit_cycle.detection.verdict import Segment

# Two orbits are the same if they differ by less than these shares, or than their half widths.
SAME_FREQUENCY: Final = 0.02
SAME_AMPLITUDE: Final = 0.05
MISSING_RUN: Final = ('closed orbit, isolation not shown: record the loop once from a smaller '
                      'and once from a larger oscillation, or disturb it '
                      '(asi run --experiment isolation)')


def _agree(a: float, b: float, first: tuple[float, float], second: tuple[float, float],
           share: float) -> bool:
    spread = 0.5 * (first[1] - first[0]) + 0.5 * (second[1] - second[0])
    return abs(a - b) <= max(share * max(abs(a), abs(b)), spread)


def same_orbit(a: Segment, b: Segment) -> bool:
    """Return whether two segments show the same orbit."""
    return a.signal == b.signal and _agree(
        a.frequency_hz, b.frequency_hz, a.frequency_interval_hz, b.frequency_interval_hz,
        SAME_FREQUENCY) and _agree(
        a.amplitude, b.amplitude, a.amplitude_interval, b.amplitude_interval, SAME_AMPLITUDE)


def judge(segments: Sequence[Segment]) -> list[Segment]:
    """
    Return segments with `isolated` set and the reason extended, for limit cycles.

    Segments of a bag must be in chronological order.
    """
    judged = []
    for segment in segments:
        if segment.verdict != 'limit_cycle' or not segment.reliable:
            judged.append(segment._replace(isolated=False))
            continue
        family = [other for other in segments
                  if other.verdict == 'limit_cycle' and other.reliable
                  and same_orbit(segment, other)]
        evidence = _evidence(segments, family)
        judged.append(segment._replace(
            isolated=bool(evidence),
            why=f'{segment.why}; ' + (f'isolated: {evidence}' if evidence else MISSING_RUN)))
    return judged


def _evidence(segments: Sequence[Segment], family: Sequence[Segment]) -> str:
    origins = {origin for member in family for origin in member.came_from.split()}
    if {'inside', 'outside'} <= origins:
        return 'the same orbit is reached from inside and from outside'
    for member in family:
        if 'disturbed' in member.came_from.split():
            earlier = [other for other in family if other.source == member.source
                       and other.end_s <= member.start_s]
            if earlier:
                return 'the same orbit is reached again after a disturbance'
    return ''
