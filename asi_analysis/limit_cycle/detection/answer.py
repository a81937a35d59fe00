"""`asi limit-cycle`: the segments of recordings, each with its verdict."""

from collections.abc import Iterator, Sequence
from typing import Any, Final

from asi_analysis.bags.run import Run
from asi_analysis.limit_cycle.detection.agreement import judge_run
from asi_analysis.limit_cycle.detection.isolation import judge
from asi_analysis.limit_cycle.detection.verdict import Segment
from asi_analysis.measures.quality import check_rate, findings, quality_of, trust
from asi_analysis.reporting.result import Pictures, Result, Table, finite, table_of

# Largest confidence in a verdict that rests on doubtful samples.
DOUBTFUL_CONFIDENCE: Final = 0.5


def segment_as_dict(segment: Segment) -> dict[str, Any]:
    """Return a segment with the keys of doc/reference/json.md, None where one does not apply."""
    first = segment.harmonics[0] if segment.harmonics else 1.0
    return {
        'source': segment.source, 'signal': segment.signal, 'unit': segment.unit,
        'start_s': segment.start_s, 'end_s': segment.end_s,
        'verdict': segment.verdict, 'confidence': segment.confidence, 'why': segment.why,
        'cycles': segment.cycles,
        'frequency_hz': finite(segment.frequency_hz),
        'frequency_low_hz': finite(segment.frequency_interval_hz[0]),
        'frequency_high_hz': finite(segment.frequency_interval_hz[1]),
        # The key is fixed; `unit` gives the unit of other signals.
        'amplitude_n': finite(segment.amplitude),
        'amplitude_low_n': finite(segment.amplitude_interval[0]),
        'amplitude_high_n': finite(segment.amplitude_interval[1]),
        'thd': finite(segment.thd),
        'harmonics': [abs(h / first) for h in segment.harmonics],
        'envelope_rate_1_s': finite(segment.envelope_rate_1_s),
        'envelope_rate_low_1_s': finite(segment.envelope_rate_interval_1_s[0]),
        'envelope_rate_high_1_s': finite(segment.envelope_rate_interval_1_s[1]),
        'return_map_slope': finite(segment.return_map_slope),
        'orbit_closure': finite(segment.orbit_closure),
        'came_from': segment.came_from, 'isolated': segment.isolated,
        'reliable': segment.reliable,
    }


def trusted(run: Run, signal: str | None = None, undriven: bool = False) -> list[Segment]:
    """Return the segments of a run; those that rest on doubtful samples are marked."""
    segments = judge_run(run, signal, undriven)
    check_rate(run.time_s, run.source)
    found, marked = findings(run), []
    for segment in segments:
        samples = trust(found, run, (segment.signal, 'reference'), segment.start_s, segment.end_s)
        marked.append(segment if samples.reliable else segment._replace(
            reliable=False, confidence=min(segment.confidence, DOUBTFUL_CONFIDENCE),
            why=f'{segment.why}; doubtful, because {samples.reason}'))
    return marked


class LimitCycles(Result):
    """
    Segments of recordings, each with its verdict: `detect_limit_cycles`.

    The keys are those of `asi limit-cycle --json`; `runs` are the recordings.
    """

    title = 'Limit cycles'
    rows = 'segments'
    runs: list[Run]

    def parts(self) -> Iterator[str | Table]:
        yield table_of(self.segments, {
            'from s': '{start_s:.4g}', 'to s': '{end_s:.4g}', 'verdict': '{verdict}',
            'confidence': '{confidence:.0%}', 'Hz': '{frequency_hz:.5g}',
            'amplitude': '{amplitude_n:.4g}', 'unit': '{unit}', 'THD': '{thd:.1%}',
            'reliable': '{reliable}'})
        yield from (f'{s["start_s"]:.4g} to {s["end_s"]:.4g} s: {s["why"]}'
                    for s in self.segments)

    def pictures(self) -> Pictures:
        from asi_analysis.limit_cycle.detection.figure import drawn
        return drawn(self.runs, self)


def detect_limit_cycles(runs: Run | Sequence[Run], signal: str | None = None,
                        undriven: bool = False) -> LimitCycles:
    """
    Classify the segments of recordings: limit cycle, forced, decaying, noise, …, with confidence.

    runs: one recording, or several of the same loop, which together show whether a cycle is
    isolated (reached from inside and from outside). signal: name of the signal to analyse; by
    default the one that the reference controls, else the force, or the first other that was
    recorded. undriven: nothing drove the runs from outside; to be said where no reference or
    no load is recorded. Raises InputError if a run lacks the signal or has too few samples.

    >>> import asi_analysis as asi
    >>> run = asi.simulate({}, {'gain': 10.0, 'reference.amplitude': 100.0}, 1.0)
    >>> cycles = asi.detect_limit_cycles(run)
    >>> last = cycles.segments[-1]
    >>> print(last['verdict'], f'{last["frequency_hz"]:.1f} Hz')
    limit_cycle 88.2 Hz
    """
    runs = [runs] if isinstance(runs, Run) else list(runs)
    segments = judge([segment for run in runs
                      for segment in trusted(run, signal, undriven)])
    return LimitCycles({'segments': [segment_as_dict(segment) for segment in segments],
                        'quality': quality_of(runs)}, runs=runs)
