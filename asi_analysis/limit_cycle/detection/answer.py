"""What `asi limit-cycle` says of bags, as one plain dictionary."""

import math
from collections.abc import Sequence
from typing import Any

from asi_analysis.bags.run import Run
from asi_analysis.limit_cycle.detection.isolation import judge
from asi_analysis.limit_cycle.detection.verdict import Segment, judge_run


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def segment_as_dict(segment: Segment) -> dict[str, Any]:
    """Return a segment with the keys of doc/reference/json.md; what does not apply is None."""
    first = segment.harmonics[0] if segment.harmonics else 1.0
    return {
        'source': segment.source, 'signal': segment.signal, 'unit': segment.unit,
        'start_s': segment.start_s, 'end_s': segment.end_s,
        'verdict': segment.verdict, 'confidence': segment.confidence, 'why': segment.why,
        'cycles': segment.cycles,
        'frequency_hz': _number(segment.frequency_hz),
        'frequency_low_hz': _number(segment.frequency_interval_hz[0]),
        'frequency_high_hz': _number(segment.frequency_interval_hz[1]),
        # The name is fixed; `unit` says when the signal is not a force.
        'amplitude_n': _number(segment.amplitude),
        'amplitude_low_n': _number(segment.amplitude_interval[0]),
        'amplitude_high_n': _number(segment.amplitude_interval[1]),
        'thd': _number(segment.thd),
        'harmonics': [abs(h / first) for h in segment.harmonics],
        'envelope_rate_1_s': _number(segment.envelope_rate_1_s),
        'envelope_rate_low_1_s': _number(segment.envelope_rate_interval_1_s[0]),
        'envelope_rate_high_1_s': _number(segment.envelope_rate_interval_1_s[1]),
        'return_map_slope': _number(segment.return_map_slope),
        'orbit_closure': _number(segment.orbit_closure),
        'came_from': segment.came_from, 'isolated': segment.isolated,
    }


def limit_cycle(runs: Sequence[Run], signal: str | None = None) -> dict[str, Any]:
    """
    Return all that `asi limit-cycle --json` prints of runs, judged together for isolation.

    Raises InputError if a run lacks the signal or has too few samples.
    """
    segments = judge([segment for run in runs for segment in judge_run(run, signal)])
    return {'segments': [segment_as_dict(segment) for segment in segments]}


def as_text(document: dict[str, Any]) -> str:
    """Return the answer for people: a line a segment, with its reason below."""
    lines = []
    for s in document['segments']:
        figures = ''
        if s['frequency_hz'] is not None:
            figures = (f'  {s["frequency_hz"]:.5g} Hz, {s["amplitude_n"]:.4g} {s["unit"]}, '
                       f'THD {100 * s["thd"]:.2g} %')
        lines += [f'{s["start_s"]:9.4g} to {s["end_s"]:9.4g} s  {s["verdict"]:<12}'
                  f'{100 * s["confidence"]:4.0f} %{figures}', f'    {s["why"]}']
    return '\n'.join(lines)
