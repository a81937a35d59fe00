"""`Finding`: what is wrong with the samples of a signal."""

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

from asi_analysis.arrays import Array

Interval = tuple[float, float]

DOUBTFUL: Final = 'doubtful'
NOTE: Final = 'note'
# Intervals listed in JSON for one finding.
LISTED: Final = 20


class Finding(NamedTuple):
    """A defect of the samples of a signal."""

    kind: str       # gap, clock_step, time_order, jitter, missing, clipping, spike, jump, ...
    signal: str     # of the run, or 'time'
    severity: str   # doubtful: figures from these samples are; note: no figure is affected
    intervals_s: tuple[Interval, ...]
    text: str

    def to_dict(self) -> dict[str, Any]:
        """Return the finding for JSON: the first LISTED intervals, and their number."""
        return {'kind': self.kind, 'signal': self.signal, 'severity': self.severity,
                'text': self.text, 'count': len(self.intervals_s),
                'intervals': [{'start_s': start, 'end_s': end}
                              for start, end in self.intervals_s[:LISTED]]}


def whole_run(time_s: Array) -> tuple[Interval, ...]:
    """Return the intervals of a finding that concerns all of n samples."""
    return ((float(time_s[0]), float(time_s[-1])),)


def name_of(name: str) -> str:
    """Return the name of a signal in words."""
    return name.replace('_', ' ')


def place_of(intervals: Sequence[Interval]) -> str:
    """Return, as text, the time from the first to the last of some intervals."""
    start, end = intervals[0][0], intervals[-1][1]
    return f'at {start:.6g} s' if end - start < 1e-9 else f'between {start:.6g} and {end:.6g} s'
