"""
The verdict on a recording that its parts agree on.

A single pass over a record (`verdict.py`) depends on where the record happens to begin and end. So
overlapping parts of it, and every second sample of it, are judged as well. The confidence of a
segment is the mean of the probabilities that all these give to its verdict, as in bagging
(Breiman, Machine Learning 24, 1996).
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import groupby
from typing import Final

import numpy as np

from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.limit_cycle.detection import drive, feedback
from asi_analysis.limit_cycle.detection.envelope import swings
from asi_analysis.limit_cycle.detection.pieces import FEWEST_CYCLES
from asi_analysis.limit_cycle.detection.verdict import AT_REST, Segment, judge_once, merged
from asi_analysis.measures.oscillation import oscillation
from asi_analysis.measures.sinusoids.sinusoid import valid_samples

# Parts of the record, or of what is between two rests, that are judged beside the whole: start
# and end as shares of the samples.
PARTS: Final = ((0.0, 0.9), (0.1, 1.0), (0.0, 0.8), (0.2, 1.0), (0.05, 0.95), (0.1, 0.9))
# Least mean probability at which a verdict stands.
AGREED: Final = 0.5
# Largest confidence in a limit cycle if no reference or no load is recorded, which could drive the
# motion, and if neither reference nor command is. By the prior odds of `asi attribute` a
# nonlinearity is twice as likely as a disturbance; of these, half have harmonics too.
UNDRIVEN: Final = {True: 0.8, False: 0.5}
# Least growth of a motion that excites itself, and its largest swing in the middle of the growth
# over the mean of first and last: at a constant rate it is 0.75 or less, by constant steps 1.
SELF_EXCITED: Final = 5.0
CONVEX: Final = 0.85
# Share of its amplitude that an oscillation keeps without the response to a drive, if the drive
# does not explain it.
UNEXPLAINED: Final = 0.9


def judge_run(run: Run, name: str | None = None, undriven: bool = False) -> list[Segment]:
    """
    Return the segments of a run, each with its verdict, in chronological order.

    name: signal to analyse, by default as `response_of`. undriven: nothing drove the run
    from outside, although no reference shows it. Raises InputError if the signal is absent.
    """
    if run.reference_n is not None and not np.isfinite(run.reference_n).any():
        run = replace(run, reference_n=None)
    found = judge_once(run, name)
    passes = [found]
    for block in _blocks(found):
        for part in _parts(run.between(block[0].start_s, block[-1].end_s + 0.5 * run.period_s)):
            with suppress(InputError):   # too few samples
                passes.append(judge_once(part, name))
    found = [_with_unforced(run, segment) if segment.verdict == 'forced' else segment
             for segment in merged([_agreed(segment, passes) for segment in found])]
    return found if undriven else [_unless_driven(run, found, at) for at in range(len(found))]


def _blocks(found: list[Segment]) -> Iterator[list[Segment]]:
    """Yield the segments between two rests of the signal: each block is a record of its own."""
    for resting, block in groupby(found, lambda segment: segment.why == AT_REST):
        if not resting:
            yield list(block)


def _parts(run: Run) -> Iterator[Run]:
    """Yield the overlapping parts of a run, and every second sample of it."""
    count = len(run)
    for start, end in PARTS:
        yield run[int(start * count):int(np.ceil(end * count))]
    yield run[::2]


def _agreed(segment: Segment, passes: list[list[Segment]]) -> Segment:
    """Return a segment with the mean confidence of all passes; below AGREED it is unsteady."""
    if segment.why == AT_REST:
        return segment
    votes = [each for each in (_votes(segment, judged) for judged in passes) if each]
    mean = {word: sum(vote.get(word, 0.0) for vote in votes) / len(votes)
            for word in {word for vote in votes for word in vote}}
    confidence = round(mean[segment.verdict], 4)
    if confidence >= AGREED or segment.verdict == 'unsteady':
        return segment._replace(confidence=max(confidence, AGREED))
    words = sorted(mean, key=lambda word: -mean[word])
    shares = ', '.join(f'{word.replace("_", " ")} {100 * mean[word]:.0f} %' for word in words)
    return segment._replace(
        verdict='unsteady', confidence=AGREED,
        why=f'parts of the record disagree: {shares}: record a longer or cleaner run')


def _votes(segment: Segment, judged: list[Segment]) -> dict[str, float]:
    """Return the probability of each verdict, averaged over a segment; empty without overlap."""
    votes: dict[str, float] = {}
    covered = 0.0
    for other in judged:
        shared = min(segment.end_s, other.end_s) - max(segment.start_s, other.start_s)
        if shared > 0.0:
            covered += shared
            votes[other.verdict] = votes.get(other.verdict, 0.0) + shared * other.confidence
    return {word: vote / covered for word, vote in votes.items()}


def _with_unforced(run: Run, segment: Segment) -> Segment:
    """Return a forced segment whose reason names an oscillation that no drive explains, if any."""
    other = oscillation(run.between(segment.start_s, segment.end_s), segment.signal)
    if other.sustained is False or not np.isfinite(other.frequency_hz):
        return segment
    if (abs(other.frequency_hz - segment.frequency_hz) < 1.0 / (segment.end_s - segment.start_s)
            and other.amplitude_n > UNEXPLAINED * segment.amplitude):
        return segment._replace(verdict='unsteady', confidence=AGREED, why=(
            f'{segment.why}, but without the response to it the oscillation of '
            f'{other.frequency_hz:.4g} Hz remains: locked to it, or a limit cycle'))
    course = 'sustained' if other.sustained else other.reason
    return segment._replace(why=(
        f'{segment.why}; in addition an oscillation of {other.frequency_hz:.4g} Hz and '
        f'{other.amplitude_n:.3g} {segment.unit}, {course}'))


def _unless_driven(run: Run, found: list[Segment], at: int) -> Segment:
    """
    Return a limit cycle whose confidence allows for a drive that was not recorded.

    A reference at rest does not exclude that the command came from elsewhere: the loop was open.
    A periodic load on a linear loop has the harmonics of a limit cycle.
    """
    segment = found[at]
    if segment.verdict != 'limit_cycle':
        return segment
    place = (segment.signal, segment.start_s, segment.end_s, segment.frequency_hz)
    ask = 'if nothing drove it from outside, say --undriven'
    known = 'no reference is recorded' if run.reference_n is None else 'the reference rests'
    share = feedback.explained_by_output(run, *place)
    answers = share is not None and share > feedback.CLOSED
    switches = feedback.switches(run, segment.start_s, segment.end_s)
    if run.reference_n is None or not any(drive.moving(run, segment.start_s, segment.end_s)):
        if share is not None and not answers and not feedback.follows_a_law(run, *place):
            return segment._replace(verdict='unsteady', confidence=AGREED, why=(
                f'driven open loop, or a limit cycle: {known}, and nothing shows that the command '
                f'answers the output, which explains {100 * share:.0f} % of its innovation; '
                f'{ask}'))
    if switches and not answers:
        known = 'its command switches as regularly as a recorded course'
    if run.reference_n is None:
        return _at_most(segment, UNDRIVEN[share is not None], known, ask)
    if switches and not answers:
        return _at_most(segment, UNDRIVEN[True], known, ask)
    # A relay in a closed loop cycles whatever the load. The metadata of a bag name the load.
    if switches or 'actuator' in run.information or _grew(run, found[:at], segment):
        return segment
    return _at_most(segment, UNDRIVEN[True], 'no load is recorded', ask)


def _at_most(segment: Segment, confidence: float, known: str, ask: str) -> Segment:
    return segment._replace(confidence=min(segment.confidence, confidence),
                            why=f'{segment.why}; unless it is driven, since {known}: {ask}')


def _grew(run: Run, earlier: list[Segment], segment: Segment) -> bool:
    """
    Return whether a motion grew to its cycle as only an unstable loop does: ever faster.

    A load that starts moves a linear loop by less from cycle to cycle.
    """
    if not earlier or earlier[-1].verdict != 'growing':
        return False
    before = earlier[-1]
    part = run.between(before.start_s, segment.start_s)
    swing = swings(*valid_samples(part.time_s, part.signal(segment.signal)), segment.frequency_hz)
    if len(swing) < FEWEST_CYCLES:
        return False
    first, middle, last = (float(np.median(each)) for each in np.array_split(swing, 3))
    return last > SELF_EXCITED * first and middle < CONVEX * 0.5 * (first + last)
