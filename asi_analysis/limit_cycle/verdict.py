"""
The verdict on each stretch of a record: what kind of oscillation, if any, with what confidence.

First the record is described, in the fewest bits, as coloured noise, as one oscillation, or as
pieces of both; then each oscillation is told apart by what a linear loop could not do. A limit
cycle is claimed only if a linear loop close to its stability limit is ruled out: by harmonics,
which a linear loop left alone cannot make, or by a decay that must be smaller than chance allows.
"""

from typing import Any, Final, NamedTuple

import numpy as np
from scipy import integrate, signal, stats

from asi_analysis.errors import InputError
from asi_analysis.limit_cycle import envelope as env
from asi_analysis.limit_cycle import segments as seg
from asi_analysis.limit_cycle.noise import Autoregression, autoregression, surrogates
from asi_analysis.limit_cycle.record import Array, ComplexArray
from asi_analysis.limit_cycle.sinusoid import (
    Oscillation,
    dominant_frequency,
    fit,
    fits,
    known,
    on_grid,
)
from asi_analysis.run import Run

RESPONSES: Final = ('force', 'position', 'velocity', 'valve_position', 'command')
FEWEST_CYCLES: Final = 3.0
SAMPLES_A_CYCLE: Final = 32
# A recording cleaner than this share of its size is treated as if it had that noise (50 dB).
CLEANEST: Final = 10.0 ** (-2.5)
# A linear loop that oscillates visibly may be as close to its limit as this, or this far: prior
# of its damping ratio, even in the logarithm. So a pure sine that merely does not decay visibly
# is not yet a limit cycle.
LEAST_DAMPING: Final = 1e-8
MOST_DAMPING: Final = 0.1
# Prior odds of a linear loop, against a limit cycle, once it did what a linear loop cannot.
LINEAR_AFTER_ALL: Final = 0.02
# Change of the amplitude over a nonlinear record that does not count as decay.
STEADY_CHANGE: Final = 0.03
CLAIM: Final = 0.9
# Share of the time at a stop from which the stop, not the loop, sets the amplitude: a sine cut so
# far passes with 0.96 of its fundamental.
STOPPED: Final = 0.25
SURROGATES: Final = 200
# Samples of a record that are compared with surrogates; of a longer one, windows spread over it.
COMPARED: Final = 8192
WINDOWS: Final = 4
# Standard deviations of the surrogates by which an envelope must stand out.
TELLING: Final = 4.0
# Share of the scatter of an envelope's logarithm that a straight line must explain to be a decay.
STRAIGHT: Final = 0.85


class Segment(NamedTuple):
    """
    A stretch of a record and the verdict on it.

    Frequency, amplitude and envelope rate come with intervals at 95 %; the amplitude is that of
    the fundamental, in `unit`. `came_from`: 'inside', 'outside' or '' — how the orbit was
    reached; `isolated`: None until `isolation.judge` has looked at all segments.
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


class _Piece(NamedTuple):
    time_s: Array
    values: Array
    kind: str                      # 'noise' or 'line'
    steady: Oscillation | None     # fitted at constant amplitude
    moving: Oscillation | None     # fitted with a rate of its envelope
    description: float
    noise: Autoregression


def response_of(run: Run, name: str | None = None) -> tuple[str, Array]:
    """Return name and values of the signal to judge: the first of RESPONSES that is there."""
    present = run.signals()
    wanted = [name] if name else [*RESPONSES, 'reference']
    for candidate in wanted:
        if candidate in present and np.isfinite(present[candidate]).sum() > 1:
            return candidate, present[candidate]
    raise InputError(f'{run.source or "the run"}: no signal {" or ".join(wanted)}; there is '
                     + (', '.join(present) or 'none'))


def judge_run(run: Run, name: str | None = None) -> list[Segment]:
    """
    Return the segments of a run, each with its verdict, in the order of time.

    name: signal to judge, by default the first of RESPONSES. Raises InputError if it is absent.
    """
    chosen, values = response_of(run, name)
    time_s, values = known(run.time_s, values)
    if len(values) < 9:
        raise InputError(f'{run.source or "the run"}: {chosen} has {len(values)} samples, '
                         'at least 9 are needed')
    frequency = dominant_frequency(time_s, values)
    cycle = 1.0 / frequency if np.isfinite(frequency) else time_s[-1] - time_s[0]
    cuts = seg.reference_cuts(run.time_s, run.reference_n, cycle)
    edges = [time_s[0], *[c for c in cuts if time_s[0] < c < time_s[-1]], np.inf]
    found: list[Segment] = []
    for start, end in zip(edges[:-1], edges[1:], strict=True):
        part = slice(*np.searchsorted(time_s, [start, end]))
        if part.stop - part.start > 1:
            found += _judge_stretch(run, chosen, time_s, values, part,
                                    frequency if len(edges) == 2 else None)
    return _merge(found)


def _merge(found: list[Segment]) -> list[Segment]:
    """Return the segments with neighbours of one kind joined, under the figures of the longer."""
    merged: list[Segment] = []
    for segment in found:
        before = merged[-1] if merged else None
        if before is None or not _one_kind(before, segment):
            merged.append(segment)
            continue
        longer = max(before, segment, key=lambda s: s.end_s - s.start_s)
        merged[-1] = longer._replace(start_s=before.start_s, end_s=segment.end_s,
                                     came_from=before.came_from)
    return merged


def _one_kind(a: Segment, b: Segment) -> bool:
    """Return whether two neighbours are one motion; a limit cycle keeps its size within 5 %."""
    if a.verdict != b.verdict or a.verdict in ('forced', 'saturating'):
        return False
    return a.verdict != 'limit_cycle' or abs(a.amplitude - b.amplitude) < 0.05 * b.amplitude


def reduce(time_s: Array, values: Array, frequency_hz: float) -> tuple[Array, Array]:
    """Return means over blocks, about SAMPLES_A_CYCLE or more of them a cycle."""
    period = float(np.median(np.diff(time_s)))
    size = int(1.0 / (frequency_hz * period * SAMPLES_A_CYCLE))
    if size < 2:
        return time_s, values
    whole = len(values) // size * size
    return (time_s[:whole].reshape(-1, size).mean(1), values[:whole].reshape(-1, size).mean(1))


def _judge_stretch(run: Run, name: str, all_times: Array, all_values: Array, part: slice,
                   frequency: float | None) -> list[Segment]:
    time_s, values = all_times[part], all_values[part]

    def segment(start: float, end: float, verdict: str, confidence: float, why: str,
                **more: Any) -> Segment:
        return Segment(float(start), float(end), verdict, round(confidence, 4), name,
                       run.unit(name), why, source=run.source, **more)

    whole = (time_s[0], time_s[-1])
    if np.ptp(values) == 0.0:
        return [segment(*whole, 'noise', 1.0, 'the signal does not move')]
    if frequency is None:
        frequency = dominant_frequency(time_s, values)
    cycles = (time_s[-1] - time_s[0]) * frequency
    if not np.isfinite(frequency) or cycles < 0.9 * FEWEST_CYCLES:
        return [segment(*whole, 'unsteady', 0.5, f'fewer than {FEWEST_CYCLES:g} cycles')]
    t, y = reduce(time_s, values, frequency)
    pieces = _pieces(t, y, frequency)
    if all(piece.kind == 'noise' for piece in pieces):
        verdict, confidence, why, more = _judge_noise(t, y, frequency)
        return [segment(*whole, verdict, confidence, why, **more)]
    found = []
    for index, piece in enumerate(pieces):
        start = time_s[0] if index == 0 else piece.time_s[0]
        end = time_s[-1] if index == len(pieces) - 1 else pieces[index + 1].time_s[0]
        if piece.kind == 'noise':
            found.append(segment(start, end, 'noise', 0.9,
                                 'coloured noise describes it in fewer bits'))
            continue
        earlier = slice(np.searchsorted(all_times, start))
        came_from = _came_from((all_times[earlier], all_values[earlier]), piece)
        verdict, confidence, why = _judge_line(run, piece, came_from)
        found.append(segment(start, end, verdict, confidence, why, came_from=came_from,
                             **_figures(piece)))
    return found


def _pieces(t: Array, y: Array, frequency: float) -> list[_Piece]:
    """Return the shortest description of a stretch: noise, one oscillation, or pieces."""
    floor = CLEANEST * float(np.std(y))
    whole = _describe(t, y, frequency, floor)
    cuts = seg.envelope_cuts(env.envelope(t, y, frequency))
    if not cuts:
        return [whole]
    edges = np.searchsorted(t, [-np.inf, *cuts, np.inf])
    pieces = [_describe(t[a:b], y[a:b], frequency, floor)
              for a, b in zip(edges[:-1], edges[1:], strict=True)]
    price = len(cuts) * np.log(len(y))
    if sum(piece.description for piece in pieces) + price < whole.description:
        return pieces
    return [whole]


def _describe(t: Array, y: Array, frequency: float, floor: float) -> _Piece:
    """Return a piece as noise or as an oscillation, whichever takes fewer bits."""
    hiss = floor * np.random.default_rng(len(y)).standard_normal(len(y))

    def describe(residual: Array, parameters: int) -> Autoregression:
        return autoregression(on_grid(t, residual + hiss)[0], parameters)

    drift = np.polynomial.polynomial.Polynomial.fit(t, y, 1)(t)
    best = describe(y - drift, 2)
    kind = 'noise'
    steady, moving = fits(t, y, frequency) or (None, None)
    for oscillation, nonlinear in ((steady, 1), (moving, 3)):
        if oscillation is None or oscillation.cycles < 0.8 * FEWEST_CYCLES:
            continue
        # The frequency was searched for among as many as there are samples: ln n once more.
        parameters = 2 + 2 * len(oscillation.harmonics) + nonlinear + 1
        noise = describe(y - oscillation.at(t), parameters)
        if noise.description < best.description:
            kind, best = 'line', noise
    return _Piece(t, y, kind, steady, moving, best.description, best)


def _figures(piece: _Piece) -> dict[str, Any]:
    """Return the figures of a segment that is an oscillation."""
    steady, moving = piece.steady, piece.moving
    assert steady is not None and moving is not None
    mean = piece.values.mean()
    peaks = env.peaks_by_cycle(piece.time_s, piece.values - mean, steady.frequency_hz)
    return {
        'frequency_hz': steady.frequency_hz,
        'frequency_interval_hz': steady.interval('frequency_hz'),
        'amplitude': steady.amplitude, 'amplitude_interval': steady.interval('amplitude'),
        'thd': steady.thd, 'harmonics': tuple(map(complex, steady.harmonics)),
        'mean': steady.mean, 'cycles': steady.cycles,
        'envelope_rate_1_s': moving.rate, 'envelope_rate_interval_1_s': moving.interval('rate'),
        'return_map_slope': env.return_map_slope(peaks),
        'orbit_closure': env.orbit_closure(piece.time_s, piece.values, steady.frequency_hz)}


def _came_from(before: tuple[Array, Array], piece: _Piece) -> str:
    """
    Return how the orbit was reached, from the record before it in the same bag.

    Words of 'inside', 'outside' and 'disturbed': the swing was smaller, or larger, by a fifth and
    came to it without a break; 'disturbed' if the orbit had been left.
    """
    if piece.steady is None or len(before[0]) < 8:
        return ''
    frequency = piece.steady.frequency_hz
    t, y = reduce(*before, frequency)
    orbit = env.swings(piece.time_s, piece.values, frequency)
    ratio = env.swings(t, y, frequency) / max(float(np.median(orbit)), 1e-300)
    # The last departure from the orbit, and on which side it was.
    off = np.flatnonzero((ratio < 0.8) | (ratio > 1.2))
    if not len(off):
        return ''
    # Only one cycle that is large is a jump of the force from one level to another.
    jump = ratio[off[-1]] > 1.2 and (off[-1] == 0 or ratio[off[-1] - 1] < 1.2)
    if jump and len(off) < 2:
        return ''
    last = off[-2] if jump else off[-1]
    words = ['inside' if ratio[last] < 0.8 else 'outside']
    was_on_it = np.flatnonzero(np.abs(ratio[:last] - 1.0) < 0.1)
    return ' '.join(words + ['disturbed'] * (len(was_on_it) >= FEWEST_CYCLES))


def _judge_line(run: Run, piece: _Piece, came_from: str) -> tuple[str, float, str]:
    """Return verdict, confidence and reason for a piece that oscillates."""
    steady, moving = piece.steady, piece.moving
    assert steady is not None and moving is not None
    if follows := _follows_reference(run, piece):
        return 'forced', 0.99, follows
    change = abs(moving.rate) * (piece.time_s[-1] - piece.time_s[0])
    if change < 1.0 and (stop := _at_stop(run, piece)):
        return 'saturating', 0.95, stop
    evidence = _harmonics(run, piece) or ('an amplitude that settles' if came_from else '')
    limit_cycle, decaying, growing = _decay_probabilities(piece, bool(evidence))
    if decaying >= CLAIM:
        return 'decaying', decaying, f'the envelope falls at {-moving.rate:.3g} 1/s'
    if growing >= CLAIM:
        return 'growing', growing, f'the envelope grows at {moving.rate:.3g} 1/s'
    if limit_cycle >= CLAIM:
        return 'limit_cycle', limit_cycle, (
            f'steady over {steady.cycles:.3g} cycles, and a linear loop is ruled out by '
            + (evidence or 'a decay smaller than any linear loop would have by chance'))
    if change > 0.5 and _straight(piece):
        # Its frequency follows its amplitude, so that no one sine fits it; the envelope is plain.
        verdict = 'decaying' if moving.rate < 0.0 else 'growing'
        return verdict, CLAIM, (f'the envelope changes by a factor '
                                f'{np.exp(np.copysign(change, moving.rate)):.3g}, evenly')
    return 'unsteady', 1.0 - 0.5 * max(limit_cycle, decaying, growing), (
        f'steady as far as {steady.cycles:.3g} cycles show, but so might a linear loop close to '
        'its stability limit be: a longer or cleaner record would tell')


def _straight(piece: _Piece) -> bool:
    """Return whether the envelope of a piece is a straight line in its logarithm."""
    assert piece.steady is not None
    level = np.log(np.maximum(env.envelope(piece.time_s, piece.values,
                                           piece.steady.frequency_hz).amplitude, 1e-300))
    if len(level) < 6:
        return False
    return float(np.corrcoef(np.arange(len(level)), level)[0, 1] ** 2) > STRAIGHT


def _harmonics(run: Run, piece: _Piece) -> str:
    """Return which signal has harmonics, and how much; empty if none has."""
    assert piece.steady is not None
    if len(piece.steady.harmonics) > 1:
        return f'harmonics of {100 * piece.steady.thd:.2g} %'
    inside = run.between(piece.time_s[0], piece.time_s[-1] + 0.5 * run.period_s)
    if inside.command_n is None:
        return ''
    command = fit(*reduce(*known(inside.time_s, inside.command_n), piece.steady.frequency_hz),
                  piece.steady.frequency_hz)
    if command is None or len(command.harmonics) < 2:
        return ''
    return f'harmonics of {100 * command.thd:.2g} % in the command'


def _decay_probabilities(piece: _Piece, nonlinear: bool) -> tuple[float, float, float]:
    """
    Return the probabilities of a limit cycle, a decaying and a growing oscillation.

    Bayes with the measured damping ratio: exactly steady, or of any size between LEAST_DAMPING
    and MOST_DAMPING on either side.
    """
    steady, moving = piece.steady, piece.moving
    if steady is None or moving is None:
        return 0.0, 0.5, 0.5
    pulsation = 2.0 * np.pi * steady.frequency_hz
    measured = -moving.rate / pulsation
    deviation = max(moving.rate_sd / pulsation, 1e-9)
    tolerance, prior = 0.0, 1.0
    if nonlinear:
        tolerance = STEADY_CHANGE / (pulsation * (piece.time_s[-1] - piece.time_s[0]))
        prior = LINEAR_AFTER_ALL
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


def _follows_reference(run: Run, piece: _Piece) -> str:
    """Return why the oscillation follows the reference, empty if it does not."""
    if run.reference_n is None or piece.steady is None:
        return ''
    start, end = piece.time_s[0], piece.time_s[-1]
    part = (run.time_s >= start) & (run.time_s <= end)
    t, r = known(run.time_s[part], run.reference_n[part])
    if len(r) < 9 or np.ptp(r) < 1e-9 * max(np.abs(r).max(), 1e-300):
        return ''
    reference = fit(*reduce(t, r, piece.steady.frequency_hz))
    if reference is None or reference.amplitude < reference.noise:
        return ''
    deviation = np.hypot(reference.frequency_sd_hz, piece.steady.frequency_sd_hz)
    tolerance = max(4.0 * deviation, 0.2 / (end - start))
    for divisor in (1, 2, 3):
        for multiple in (1, 2, 3, 5):
            if abs(piece.steady.frequency_hz
                   - reference.frequency_hz * multiple / divisor) < tolerance:
                ratio = '' if multiple == divisor == 1 else f' times {multiple}/{divisor}'
                return f'the reference moves at {reference.frequency_hz:.5g} Hz{ratio} as well'
    return ''


def _at_stop(run: Run, piece: _Piece) -> str:
    """Return which stop sets the amplitude, empty if none does."""
    start, end = piece.time_s[0], piece.time_s[-1]
    inside = run.between(start, end + 0.5 * run.period_s)
    if inside.command_n is not None:
        share = flat_share(inside.command_n[np.isfinite(inside.command_n)])
        if share > STOPPED:
            return f'the command is at its limit for {100 * share:.0f} % of the time'
    actuator = run.information.get('actuator', {})
    full = actuator.get('valve_characteristic.full_opening')
    if full and inside.valve_position_m is not None:
        share = float(np.mean(np.abs(inside.valve_position_m) >= 0.999 * full))
        if share > STOPPED:
            return f'the valve is fully open for {100 * share:.0f} % of the time'
    return ''


def flat_share(values: Array) -> float:
    """
    Return the share of samples at a stop: flat at an extreme, yet moving in between.

    0 for a signal that only switches between two levels (a relay), and for one whose extremes
    hold no more samples than a sine's or what its quantisation explains.
    """
    span = float(np.ptp(values)) if len(values) else 0.0
    if span == 0.0:
        return 0.0
    levels = np.unique(values)
    if len(levels) < 8:
        return 0.0
    width = 1e-4 * span + float(np.median(np.diff(levels))) * (len(levels) < 0.05 * len(values))
    sine = np.arccos(1.0 - 2.0 * min(width / span, 0.5)) / np.pi
    top = float(np.mean(values >= values.max() - width))
    bottom = float(np.mean(values <= values.min() + width))
    if top + bottom > 0.95:
        return 0.0
    return sum(share for share in (top, bottom) if share > 2.5 * sine + 0.02)


def _judge_noise(t: Array, y: Array, frequency: float
                 ) -> tuple[str, float, str, dict[str, Any]]:
    """
    Return verdict, confidence, reason and figures of a stretch that a noise model describes best.

    An oscillation that noise keeps out of step, or whose frequency follows its amplitude, ends up
    here too. Its envelope is steadier, or has more of a trend, than that of Gaussian noise of the
    same spectrum, which the surrogates show.
    """
    steadiness, fall, trend = _surrogate_scores(t, y, frequency)
    if max(steadiness, abs(trend)) > TELLING:
        piece = _describe(t, y, frequency, 0.0)
        if steadiness > TELLING and piece.steady is not None:
            confidence = float(np.clip(stats.norm.cdf(steadiness - 2.0), 0.5, 0.99))
            verdict = 'limit_cycle' if confidence >= CLAIM else 'unsteady'
            figures = _figures(piece) | _cycle_figures(piece, frequency)
            return verdict, confidence, (
                f'out of step from cycle to cycle, but its envelope is {steadiness:.1f} standard '
                'deviations steadier than that of noise with the same spectrum'), figures
        if abs(trend) > TELLING and piece.moving is not None:
            return *_trend_verdict(fall, trend), _figures(piece)
    return 'noise', float(np.clip(1.0 - np.exp(-2.0 * (4.0 - steadiness)), 0.5, 0.99)), (
        'coloured noise with a resonance describes it in fewer bits than any oscillation'), {}


def _surrogate_scores(t: Array, y: Array, frequency: float) -> tuple[float, float, float]:
    """
    Return what sets the envelope apart from that of noise of the same spectrum.

    As (how much steadier it is, the fall of its logarithm, how much more of a trend it has,
    negative if up); the first and last in standard deviations of the surrogates.
    """
    even, period = on_grid(t, y)
    model = autoregression(even - even.mean(), 1)
    windows, at = _windows(even)
    skip = min(int(0.5 / (frequency * period)), windows.shape[1] // 8)
    spread, fall, trend = _envelope_scores(windows, at, period, frequency, skip)
    others: list[tuple[float, float]] = []
    for rows in surrogates(model, windows.shape, SURROGATES, len(even)):
        # Each at its own highest peak: that of a record stands out where a burst happens to be.
        other, _, other_trend = _envelope_scores(rows, at, period, _highest_peak(rows, period),
                                                 skip)
        others.append((other, abs(other_trend)))
        # Once a surrogate stands out as much, in both, the others can no longer change a score.
        if all(max(column) >= own for column, own in zip(
                zip(*others, strict=True), (spread, abs(trend)), strict=True)):
            break
    steadiness, size = (_score(own, np.array(column)) for own, column in zip(
        (spread, abs(trend)), zip(*others, strict=True), strict=True))
    return steadiness, fall, float(np.copysign(size, trend))


def _windows(even: Array) -> tuple[Array, Array]:
    """Return windows of a record (rows), all of it if it is short, and where each sample is."""
    at = np.linspace(-1.0, 1.0, len(even))
    if len(even) <= COMPARED:
        return even[None], at[None]
    size = COMPARED // WINDOWS
    starts = np.linspace(0, len(even) - size, WINDOWS).astype(int)
    samples = starts[:, None] + np.arange(size)
    return even[samples], at[samples]


def _trend_verdict(fall: float, trend: float) -> tuple[str, float, str]:
    return ('decaying' if trend > 0.0 else 'growing',
            float(np.clip(stats.norm.cdf(abs(trend) - 2.0), 0.5, 0.99)),
            f'the envelope changes by a factor {np.exp(-fall):.3g}, {abs(trend):.1f} standard '
            'deviations more than that of noise with the same spectrum')


def _score(own: float, others: Array) -> float:
    """Return how far a statistic stands above all others, in their standard deviations."""
    if own <= others.max():
        return 0.0
    return float((own - others.mean()) / max(others.std(), 1e-12))


def _envelope_scores(windows: Array, at: Array, period: float, frequency: float, skip: int
                     ) -> tuple[float, float, float]:
    """
    Return how steady the envelope about a frequency is, the fall of its logarithm, its trend.

    windows: of the record, a row each; at: where their samples are in the record, -1 to 1; skip:
    samples at either end that are left out; trend: of a straight line, negative if up.
    """
    kept = slice(skip, windows.shape[1] - skip)
    power = (np.abs(_analytic(windows, period, frequency)) ** 2)[:, kept].ravel()
    level = 0.5 * np.log(np.maximum(power, 1e-12 * power.max()))
    x = at[:, kept].ravel()
    slope = float(level @ x / (x @ x))
    # A straight line, not a jump: the share of the level's variance that the slope explains.
    explained = slope * np.sqrt((x * x).mean()) / max(float(level.std()), 1e-12)
    return (-float(np.log(power.var() / power.mean() ** 2)), -2.0 * slope,
            -slope * abs(explained))


def _highest_peak(windows: Array, period: float) -> float:
    """Return the frequency (Hz) of the highest peak of the spectrum above 1.5 cycles."""
    centred = windows - windows.mean(1, keepdims=True)
    power = (np.abs(np.fft.rfft(centred)) ** 2).sum(0)
    return float(2 + np.argmax(power[2:])) / (windows.shape[1] * period)


def _analytic(values: Array, period: float, frequency: float) -> ComplexArray:
    """Return the analytic signal of what values (along the last axis) hold about a frequency."""
    band = np.clip(2.0 * period * frequency * np.array([0.6, 1.6]), 1e-3, 0.98)
    around = signal.sosfiltfilt(signal.butter(2, band, 'bandpass', output='sos'),
                                values - values.mean(-1, keepdims=True))
    return np.asarray(signal.hilbert(around))


def _cycle_figures(piece: _Piece, frequency: float) -> dict[str, Any]:
    """Return frequency and amplitude with intervals from the scatter of the cycles."""
    even, period = on_grid(piece.time_s, piece.values)
    analytic = _analytic(even, period, frequency)
    size = max(int(round(1.0 / (frequency * period))), 1)
    phase = np.unwrap(np.angle(analytic))[size:-size:size] / (2.0 * np.pi)
    amplitude = np.abs(analytic)[size:-size:size]
    if len(phase) < 4:
        return {}
    advance = np.diff(phase) / (size * period)
    half = stats.t.ppf(0.975, len(advance) - 1) / np.sqrt(len(advance))
    centre, spread = float(advance.mean()), float(advance.std(ddof=1) * half)
    size_mean = float(amplitude.mean())
    size_spread = float(amplitude.std(ddof=1) * half)
    return {'frequency_hz': centre, 'frequency_interval_hz': (centre - spread, centre + spread),
            'amplitude': size_mean,
            'amplitude_interval': (size_mean - size_spread, size_mean + size_spread)}
