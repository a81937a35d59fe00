"""
The verdict on each segment of a record: the kind of oscillation, if any, and the confidence.

The record is modelled, by minimum description length, as coloured noise, as one oscillation, or
as pieces of both. An oscillation is a limit cycle only if a linear loop close to its stability
limit is ruled out: by harmonics, which an undriven linear loop cannot produce, or by a decay rate
that is too small to be likely.
"""

from typing import Any, Final, NamedTuple

import numpy as np
from scipy import integrate, stats

from asi_analysis.arrays import Array
from asi_analysis.bags.run import OUTPUTS, Run
from asi_analysis.errors import InputError
from asi_analysis.limit_cycle.detection import drive
from asi_analysis.limit_cycle.detection import envelope as env
from asi_analysis.limit_cycle.detection import segments as seg
from asi_analysis.limit_cycle.detection.feedback import RELAY, levels_of
from asi_analysis.limit_cycle.detection.pieces import (
    FEWEST_CYCLES,
    NOISE_FLOOR_SHARE,
    Piece,
    cycle_figures,
    described,
    figures_of,
    pieces_of,
    remaining_line,
)
from asi_analysis.limit_cycle.detection.resolution import exceeds_rounding, one_of_each
from asi_analysis.limit_cycle.detection.steadiness import difference
from asi_analysis.measures.oscillation import MOST_DECAY
from asi_analysis.measures.quality import check_size, check_time
from asi_analysis.measures.sinusoids.record import reduce
from asi_analysis.measures.sinusoids.sinusoid import (
    dominant_frequency,
    fit,
    valid_samples,
)

TOO_SHORT: Final[tuple[str, float, str]] = (
    'unsteady', 0.5, f'fewer than {FEWEST_CYCLES:g} cycles')
AT_REST: Final = 'the signal does not move'
LINEAR: Final = ('steady over {:.3g} cycles, but a linear loop close to its stability limit is '
                 'not ruled out: record a longer or cleaner run')
# Least share of the variance that a single sine explains if its phase is regular.
REGULAR: Final = 0.95
# Range of the damping ratio of an oscillating linear loop; the prior is uniform in its logarithm.
# So a pure sine without visible decay is not yet a limit cycle.
LEAST_DAMPING: Final = 1e-8
MOST_DAMPING: Final = 0.1
# Prior odds of a linear loop against a limit cycle, given evidence of a nonlinearity.
LINEAR_ODDS: Final = 0.02
# Least probability of a verdict.
LEAST_PROBABILITY: Final = 0.9
# Cycles that an orbit must last after its approach to be called settled.
SETTLED_CYCLES: Final = 8.0
# Standard deviations of a growth rate that is clearly not 0.
CLEAR: Final = 5.0
# Least steadiness of an envelope, in standard deviations of the surrogates.
LEAST_STEADINESS: Final = 4.0
# Least change of the logarithm of the swing that is a decay, and its confidence.
LEAST_DECAY: Final = 0.2
SURE_DECAY: Final = 0.97


class Segment(NamedTuple):
    """
    A segment of a record and its verdict.

    Frequency, amplitude and envelope rate come with intervals at 95 %; the amplitude is that of
    the fundamental, in `unit`. `came_from`: 'inside', 'outside' or '' — how the orbit was
    reached; `isolated`: None until `isolation.judge` has looked at all segments; `reliable`:
    whether its samples can be trusted.
    """

    start_s: float
    end_s: float
    verdict: str
    confidence: float
    signal: str
    unit: str
    why: str
    frequency_hz: float = float('nan')
    frequency_interval_hz: tuple[float, float] = (float('nan'), float('nan'))
    amplitude: float = float('nan')
    amplitude_interval: tuple[float, float] = (float('nan'), float('nan'))
    thd: float = float('nan')
    harmonics: tuple[complex, ...] = ()
    mean: float = float('nan')
    cycles: float = 0.0
    envelope_rate_1_s: float = float('nan')
    envelope_rate_interval_1_s: tuple[float, float] = (float('nan'), float('nan'))
    return_map_slope: float = float('nan')
    orbit_closure: float = float('nan')
    came_from: str = ''
    isolated: bool | None = None
    source: str = ''
    reliable: bool = True


def response_of(run: Run, name: str | None = None) -> tuple[str, Array]:
    """Return name and values of the signal to analyse; default: the controlled, or of OUTPUTS."""
    present = run.signals()
    first = [] if run.reference_n is None else [run.controlled()]
    candidates = [name] if name else [*first, *OUTPUTS, 'reference']
    for candidate in candidates:
        if candidate in present and np.isfinite(present[candidate]).sum() > 1:
            return candidate, present[candidate]
    raise InputError(f'{run.source or "the run"}: no signal {" or ".join(candidates)}; there is '
                     + (', '.join(present) or 'none'))


def judge_once(run: Run, name: str | None = None) -> list[Segment]:
    """
    Return the segments of a run, each with its verdict, in chronological order, by one pass.

    name: signal to analyse, by default as `response_of`. Raises InputError if it is absent,
    or if the time jumps.
    """
    chosen, values = response_of(run, name)
    time_s, values = valid_samples(run.time_s, values)
    frequency = dominant_frequency(time_s, values)
    if np.isfinite(frequency):
        time_s, values = one_of_each(time_s, values, frequency)
    if len(values) < 9:
        raise InputError(f'{run.source or "the run"}: {chosen} has {len(values)} samples, '
                         'at least 9 are needed')
    check_size(run)
    check_time(time_s, run.source)
    cycle = 1.0 / frequency if np.isfinite(frequency) else time_s[-1] - time_s[0]
    cuts = sorted([*seg.reference_cuts(run.time_s, run.reference_n, cycle),
                   *time_s[seg.middle_cuts(values, _samples_a_cycle(time_s, values))]])
    edges = [time_s[0], *[c for c in cuts if time_s[0] < c < time_s[-1]], np.inf]
    found: list[Segment] = []
    for start, end in zip(edges[:-1], edges[1:], strict=True):
        part = slice(*np.searchsorted(time_s, [start, end]))
        if part.stop - part.start < 2:
            continue
        active = seg.active_part(values[part])
        first, last = part.start + active.start, part.start + active.stop
        whole = len(edges) == 2 and last - first == len(values)
        for one in (slice(part.start, first), slice(last, part.stop)):
            if one.start < one.stop:
                found.append(Segment(
                    float(time_s[one.start]), float(time_s[one.stop - 1]), 'noise', 1.0, chosen,
                    run.unit(chosen), AT_REST, source=run.source))
        found += _judge_stretch(run, chosen, time_s, values, slice(first, last),
                                frequency if whole else None)
    return merged(sorted(found, key=lambda segment: segment.start_s))


def _samples_a_cycle(time_s: Array, values: Array) -> float:
    """Return the samples of a cycle, in the differences of the values: a level has none."""
    frequency = dominant_frequency(time_s[1:], np.diff(values))
    return float(1.0 / (frequency * np.median(np.diff(time_s)))) if frequency > 0.0 else 0.0


def merged(found: list[Segment]) -> list[Segment]:
    """Return the segments; neighbours of one kind are joined, with the figures of the longer."""
    joined: list[Segment] = []
    for segment in found:
        before = joined[-1] if joined else None
        if before is None or not _one_kind(before, segment):
            joined.append(segment)
            continue
        longer = max(before, segment, key=lambda s: s.end_s - s.start_s)
        joined[-1] = longer._replace(start_s=before.start_s, end_s=segment.end_s,
                                     came_from=before.came_from)
    return joined


def _one_kind(a: Segment, b: Segment) -> bool:
    """Return whether two neighbours are one motion: the same verdict, cycles also within 5 %."""
    if a.verdict != b.verdict or a.verdict in ('forced', 'saturating'):
        return False
    return a.verdict != 'limit_cycle' or abs(a.amplitude - b.amplitude) < 0.05 * b.amplitude


def _judge_stretch(run: Run, name: str, all_times: Array, all_values: Array, part: slice,
                   frequency: float | None) -> list[Segment]:
    """Return the segments of a part of the record; frequency: initial guess (Hz), if known."""
    time_s, values = all_times[part], all_values[part]

    def segment(start: float, end: float, verdict: str, confidence: float, why: str,
                **more: Any) -> Segment:
        return Segment(float(start), float(end), verdict, round(confidence, 4), name,
                       run.unit(name), why, source=run.source, **more)

    whole = (time_s[0], time_s[-1])
    if np.ptp(values) == 0.0:
        return [segment(*whole, 'noise', 1.0, AT_REST)]
    if frequency is None:
        frequency = dominant_frequency(time_s, values)
    cycles = (time_s[-1] - time_s[0]) * frequency
    if not np.isfinite(frequency) or cycles < 0.9 * FEWEST_CYCLES:
        return [segment(time_s[0], time_s[-1], *TOO_SHORT)]
    t, y = reduce(time_s, values, frequency)
    pieces = pieces_of(t, y, frequency)
    if all(piece.kind == 'noise' for piece in pieces):
        verdict, confidence, why, more = (_forced(run, t, y, frequency)
                                          or _judge_noise(run, name, t, y, frequency))
        return [segment(*whole, verdict, confidence, why, **more)]
    found = []
    for index, piece in enumerate(pieces):
        start = time_s[0] if index == 0 else piece.time_s[0]
        end = time_s[-1] if index == len(pieces) - 1 else pieces[index + 1].time_s[0]
        if piece.kind == 'noise':
            part = slice(*np.searchsorted(time_s, [start, end]))
            piece = _at_own_frequency(time_s[part], values[part], piece)
        if piece.kind == 'noise':
            verdict, confidence, why, more = (
                _forced(run, piece.time_s, piece.values, piece.frequency_hz)
                or _noise_or_short(piece))
            found.append(segment(start, end, verdict, confidence, why, **more))
            continue
        earlier = slice(np.searchsorted(all_times, start))
        came_from = _came_from((all_times[earlier], all_values[earlier]), piece)
        verdict, confidence, why = _judge_line(run, name, piece, pieces[:index])
        if verdict in ('limit_cycle', 'unsteady'):
            why += remaining_line(piece)
        found.append(segment(start, end, verdict, confidence, why, came_from=came_from,
                             **figures_of(piece)))
    return found


def _noise_or_short(piece: Piece) -> tuple[str, float, str, dict[str, Any]]:
    """Return the verdict on a piece that is no oscillation: noise, or too short to tell."""
    if (piece.time_s[-1] - piece.time_s[0]) * piece.frequency_hz < 0.9 * FEWEST_CYCLES:
        return *TOO_SHORT, {}
    return 'noise', 0.9, 'coloured noise has the shorter description', {}


def _at_own_frequency(time_s: Array, values: Array, piece: Piece) -> Piece:
    """Return the oscillation of a piece at its own dominant frequency, or the piece as noise."""
    frequency = dominant_frequency(time_s, values)
    cycles = frequency * (time_s[-1] - time_s[0])
    if not cycles >= FEWEST_CYCLES or np.ptp(values) == 0.0:
        return piece
    t, y = reduce(time_s, values, frequency)
    own = described(t, y, frequency, NOISE_FLOOR_SHARE * float(np.std(y)))
    return own if own.steady and own.steady.amplitude > own.steady.noise else piece


def _forced(run: Run, t: Array, y: Array, frequency: float
            ) -> tuple[str, float, str, dict[str, Any]] | None:
    """Return the verdict on a motion that a linear response to a drive explains."""
    share, name = drive.explained_by_drive(run, t, y, frequency)
    if share < drive.FOLLOWS:
        return None
    return 'forced', float(np.clip(share, 0.5, 0.99)), (
        f'a linear response to {name} explains {100 * share:.0f} % of the motion about '
        f'{frequency:.5g} Hz'), {}


def _came_from(before: tuple[Array, Array], piece: Piece) -> str:
    """
    Return how the orbit was approached, from the record before it in the same bag.

    'inside' or 'outside': the swing was smaller, or larger, by a fifth just before it; with
    'disturbed' if the motion had been on the orbit earlier.
    """
    if piece.steady is None or len(before[0]) < 8:
        return ''
    frequency = piece.steady.frequency_hz
    t, y = reduce(*before, frequency)
    orbit = env.swings(piece.time_s, piece.values, frequency)
    if not len(orbit):
        return ''
    ratio = env.swings(t, y, frequency) / max(float(np.median(orbit)), 1e-300)
    # The last departure from the orbit, and on which side it was.
    off = np.flatnonzero((ratio < 0.8) | (ratio > 1.2))
    if not len(off):
        return ''
    # A single large cycle is a step of the mean force.
    jump = ratio[off[-1]] > 1.2 and (off[-1] == 0 or ratio[off[-1] - 1] < 1.2)
    if jump and len(off) < 2:
        return ''
    last = off[-2] if jump else off[-1]
    words = ['inside' if ratio[last] < 0.8 else 'outside']
    was_on_it = np.flatnonzero(np.abs(ratio[:last] - 1.0) < 0.1)
    return ' '.join(words + ['disturbed'] * (len(was_on_it) >= FEWEST_CYCLES))


def _settles(earlier: list[Piece], piece: Piece) -> bool:
    """
    Return whether an amplitude approached its orbit, in one motion that nothing drove.

    An undriven linear loop has one growth rate: it does not grow, or decay, for some cycles and
    then last. A step to the orbit, by a push or by a new mean, is no approach.
    """
    assert piece.steady is not None
    if piece.steady.cycles < SETTLED_CYCLES:
        return False
    change, orbit, mean = 0.0, piece.steady.amplitude, piece.values.mean()
    for before in reversed(earlier):
        if before.moving is None or abs(before.values.mean() - mean) > orbit:
            break
        rate, half = before.moving.rate, 0.5 * (before.time_s[-1] - before.time_s[0])
        first, last = before.moving.amplitude * np.exp(
            np.clip(rate * half * np.array([-1.0, 1.0]), -30.0, 30.0))
        if (before.kind == 'noise' or change * rate < 0.0
                or abs(rate) < CLEAR * before.moving.rate_sd
                or abs(rate) > before.moving.frequency_hz
                or abs(np.log(max(last, 1e-300) / orbit)) > LEAST_DECAY):
            break
        change, orbit = change + 2.0 * half * rate, first
    return abs(change) > LEAST_DECAY


def _judge_line(run: Run, name: str, piece: Piece, earlier: list[Piece]
                ) -> tuple[str, float, str]:
    """Return verdict, confidence and reason for a piece that oscillates, after earlier ones."""
    steady, moving = piece.steady, piece.moving
    assert steady is not None and moving is not None
    tied, follows = drive.follows_drive(run, steady, piece.time_s[0], piece.time_s[-1])
    if tied > 0.5:
        return 'forced', min(tied, 0.99), follows
    if forced := _forced(run, piece.time_s, piece.values, steady.frequency_hz):
        return forced[:3]
    change = abs(moving.rate) * (piece.time_s[-1] - piece.time_s[0])
    if change < 1.0 and (limit := drive.at_limit(run, piece.time_s[0], piece.time_s[-1])):
        return 'saturating', 0.95, limit
    evidence = _harmonics(run, name, piece) or (
        'an amplitude that settles' if _settles(earlier, piece) else '')
    limit_cycle, decaying, growing = _decay_probabilities(piece, bool(evidence))
    if decaying >= LEAST_PROBABILITY:
        return 'decaying', decaying, f'the envelope decays at {-moving.rate:.3g} 1/s'
    if growing >= LEAST_PROBABILITY:
        return 'growing', growing, f'the envelope grows at {moving.rate:.3g} 1/s'
    if limit_cycle >= LEAST_PROBABILITY and evidence:
        return 'limit_cycle', limit_cycle * (1.0 - tied), (
            f'steady over {steady.cycles:.3g} cycles, and a linear loop is ruled out by '
            + evidence + _drift(piece))
    if decay := _steady_decay(piece.time_s, piece.values, steady.frequency_hz):
        return decay
    return ('unsteady', 1.0 - 0.5 * max(limit_cycle, decaying, growing),
            LINEAR.format(steady.cycles))


def _drift(piece: Piece) -> str:
    """Return by how much the amplitude of a sustained oscillation drifts, if it clearly does."""
    moving = piece.moving
    if moving is None or abs(moving.rate) < CLEAR * moving.rate_sd:
        return ''
    change = np.expm1(moving.rate * (piece.time_s[-1] - piece.time_s[0]))
    return f'; its amplitude drifts by {100.0 * change:+.2g} %' if abs(change) > 0.01 else ''


def _steady_decay(t: Array, y: Array, frequency: float) -> tuple[str, float, str] | None:
    """
    Return the verdict on a motion whose swing decays or grows steadily.

    Also for a frequency that depends on the amplitude, which no single sine fits.
    """
    decay, p_value = env.decay_of_swing(t, y, frequency)
    if abs(decay) < LEAST_DECAY or p_value > 1.0 - SURE_DECAY:
        return None
    return ('decaying' if decay > 0.0 else 'growing', min(1.0 - p_value, 0.99),
            f'the swing changes steadily, by a factor {np.exp(-decay):.3g}')


def _harmonics(run: Run, name: str, piece: Piece) -> str:
    """Return which signal has significant harmonics, and their size; empty if none has."""
    assert piece.steady is not None
    inside = run.between(piece.time_s[0], piece.time_s[-1] + 0.5 * run.period_s)
    frequency = piece.steady.frequency_hz
    t, values = valid_samples(inside.time_s, inside.signal(name))
    if exceeds_rounding(piece.steady, t, values):
        return f'harmonics of {100 * piece.steady.thd:.2g} %'
    if inside.command_n is None:
        return ''
    t, values = one_of_each(*valid_samples(inside.time_s, inside.command_n), frequency)
    command = fit(*reduce(t, values, frequency), frequency)
    # The levels of a relay are no resolution of its record.
    if command is None or len(command.harmonics) < 2 or not (
            levels_of(values) == RELAY or exceeds_rounding(command, t, values)):
        return ''
    return f'harmonics of {100 * command.thd:.2g} % in the command'


def _decay_probabilities(piece: Piece, nonlinear: bool) -> tuple[float, float, float]:
    """
    Return the probabilities of a limit cycle, a decaying and a growing oscillation.

    Bayesian comparison by the measured damping ratio: zero, or from LEAST_DAMPING to MOST_DAMPING
    of either sign.
    """
    steady, moving = piece.steady, piece.moving
    if steady is None or moving is None:
        return 0.0, 0.5, 0.5
    pulsation = 2.0 * np.pi * steady.frequency_hz
    measured = -moving.rate / pulsation
    deviation = max(moving.rate_sd / pulsation, 1e-9)
    tolerance, prior = 0.0, 1.0
    if nonlinear:
        # Of the damping ratio; a conservative loop with little friction also has harmonics.
        tolerance = min(MOST_DECAY / (2.0 * np.pi),
                        LEAST_DECAY / (pulsation * (piece.time_s[-1] - piece.time_s[0])))
        prior = LINEAR_ODDS
    distribution = stats.t(max(moving.freedom, 3), scale=deviation)
    beyond = max(abs(measured) - tolerance, 0.0)
    most = max(MOST_DAMPING, 2.0 * abs(measured))
    damping = np.unique(np.concatenate([
        np.geomspace(LEAST_DAMPING, most, 400),
        np.clip(abs(measured) + deviation * np.linspace(-8, 8, 161), LEAST_DAMPING, most)]))
    logarithm = np.log(damping)

    def likelihood(sign: float) -> float:
        return float(integrate.trapezoid(distribution.pdf(measured - sign * damping), logarithm)
                     / np.ptp(logarithm))

    likelihoods = np.array([float(distribution.pdf(beyond)), prior * likelihood(1.0),
                            0.3 * prior * likelihood(-1.0)])
    limit_cycle, decaying, growing = likelihoods / max(likelihoods.sum(), 1e-300)
    return float(limit_cycle), float(decaying), float(growing)


def _is_regular(piece: Piece) -> bool:
    """Return whether a single sine explains the motion, so that no noise disturbs its phase."""
    return piece.steady is not None and (
        0.5 * piece.steady.amplitude ** 2 > REGULAR * float(np.var(piece.values)))


def _judge_noise(run: Run, name: str, t: Array, y: Array, frequency: float
                 ) -> tuple[str, float, str, dict[str, Any]]:
    """
    Return verdict, confidence, reason and figures of a segment that a noise model describes best.

    It may still be an oscillation whose frequency depends on its decaying amplitude: its swing
    decays more steadily than a random walk. Or one whose phase noise disturbs: its envelope is
    steadier than that of surrogates.
    """
    if decay := _steady_decay(t, y, frequency):
        return *decay, figures_of(described(t, y, frequency, 0.0))
    steadier, irregular = difference(t, y, frequency)
    if steadier > LEAST_STEADINESS:
        piece = described(t, y, frequency, 0.0)
        if _is_regular(piece) and not _harmonics(run, name, piece):
            return 'unsteady', 0.5, LINEAR.format(piece.steady.cycles if piece.steady else 0.0), (
                figures_of(piece))
        confidence = float(np.clip(stats.norm.cdf(steadier - 2.0), 0.5, 0.99))
        verdict = 'limit_cycle' if confidence >= LEAST_PROBABILITY else 'unsteady'
        figures = figures_of(piece) | cycle_figures(piece, frequency)
        return verdict, confidence, (
            f'irregular phase, but its envelope is {steadier:.1f} standard '
            'deviations steadier than that of noise with the same spectrum'), figures
    chance = float(np.clip(stats.norm.sf(max(steadier, irregular) - 3.0), 0.0, 0.99))
    if chance < 0.5 and irregular > steadier:
        return 'unsteady', 0.5, (
            'irregular, but no noise of a linear process: it rests and jumps, or its size '
            f'changes, by {irregular:.1f} standard deviations more than noise with the same '
            'spectrum'), {}
    if chance < 0.5:
        return 'unsteady', 0.5, (
            f'between noise and a cycle: its envelope is {steadier:.1f} standard deviations '
            'steadier than that of noise with the same spectrum'), {}
    return 'noise', chance, (
        'coloured noise with a resonance has a shorter description than any oscillation'), {}
