"""
Response of a signal to a step of its reference: rise, overshoot, settling, steady-state error.

Levels are relative to the change from the signal before the step to its steady state, as in
MATLAB's stepinfo. The steady-state error is the reference less the steady state. A step of a
position, velocity or pressure is measured as one of a force.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
from scipy import signal

from asi_analysis.arrays import Array
from asi_analysis.bags.run import Run, hold_last
from asi_analysis.errors import InputError
from asi_analysis.measures.checks.recomputed import generated
from asi_analysis.measures.correlation import correlation_delay
from asi_analysis.measures.quality import (
    MARKING,
    Finding,
    Trust,
    check_rate,
    findings,
    trust,
    without_spikes,
)
from asi_analysis.reporting.result import Pictures, Result, Table, number

# The mean over this share of the time after a step, at its end, is the steady-state force.
STEADY_SHARE: Final = 0.2
# Largest movement in such a share of the time of a signal that is at rest, and of one whose
# figures are doubtful, as shares of the step.
AT_REST: Final = 0.01
RESTLESS: Final = 0.05
# Samples for which the reference is constant before and after a step, at least.
FEWEST_SAMPLES: Final = 5
# Samples of a jump at most; a longer one is a ramp.
LONGEST_JUMP: Final = 3
# Largest fall of the force during a monotone rise, as a share of the step.
DIP: Final = 0.05
# Least ratio of the time from 50 to 90 % to that from 10 to 50 % for a creep (a first-order lag
# has 2.7).
CREEP: Final = 5.0
# A settling band below this many standard deviations of the noise is missed because of noise; an
# overshoot below it may be noise.
NOISE_MARGIN: Final = 4.0
ROUNDING_PERCENT: Final = 1e-9     # of a step: a smaller noise is the computer's rounding


class Step(NamedTuple):
    """One step. A measure that could not be taken is None; `notes` says why."""

    time_s: float                       # when the reference jumps
    initial_n: float                    # reference before
    final_n: float                      # reference after
    rise_time_s: float | None           # 10 to 90 %
    overshoot_percent: float | None     # beyond the steady-state force, share of the step
    settling_time_2_s: float | None     # from the jump until it stays within 2 % of the step
    settling_time_5_s: float | None
    steady_state_error_n: float | None  # reference less the mean force at the end
    rise_shape: str | None              # monotone, dip, spike or creep
    notes: tuple[str, ...]
    overshoot_noise_percent: float | None = None    # overshoot that noise alone may give
    restless_percent: float = 0.0   # movement left before the step or at its end, share of it

    @property
    def monotone_rise(self) -> bool | None:
        """Whether the rise is monotone; with a dip, spike or creep the rise time misleads."""
        return None if self.rise_shape is None else self.rise_shape == 'monotone'


class _Jump(NamedTuple):
    """Indices: first and last sample before the jump; first after it, and end (exclusive)."""

    begin: int
    before: int
    after: int
    end: int


def _jumps(reference: Array) -> list[_Jump]:
    """Return the jumps of a reference that is constant (to 2 % of the jump) before and after."""
    span = np.ptp(reference)
    if not span > 0.0:
        return []
    moving = np.flatnonzero(np.abs(np.diff(reference)) > 0.01 * span)
    if not moving.size:
        return []
    groups = np.split(moving, np.flatnonzero(np.diff(moving) > 1) + 1)
    begins = [0] + [int(group[-1]) + 1 for group in groups]
    ends = [int(group[0]) + 1 for group in groups] + [reference.size]
    return [_Jump(begins[i], ends[i] - 1, begins[i + 1], ends[i + 1])
            for i, group in enumerate(groups)
            if group.size <= LONGEST_JUMP
            and all(_is_constant(reference[begins[k]:ends[k]],
                           abs(reference[begins[i + 1]] - reference[ends[i] - 1]))
                    for k in (i, i + 1))]


def _is_constant(plateau: Array, jump: float) -> bool:
    return plateau.size >= FEWEST_SAMPLES and bool(np.ptp(plateau) <= 0.02 * jump)


def noise_level(values: Array) -> float:
    """
    Return the standard deviation of white noise on a smooth signal.

    From its sixth difference, which suppresses frequencies below a tenth of the sampling rate; by
    the median absolute value, so that jumps do not count.
    """
    if values.size < 7:
        return 0.0
    return float(1.4826 * np.median(np.abs(np.diff(values, 6))) / math.sqrt(math.comb(12, 6)))


def _windowed_mean(values: Array) -> float:
    """Return the mean by a Hann window, which suppresses oscillations; nan if all are missing."""
    weights = signal.windows.hann(values.size + 2)[1:-1] * np.isfinite(values)
    total = float(np.sum(weights))
    return float(np.sum(weights * np.nan_to_num(values))) / total if total else math.nan


def _restless(values: Array, noise: float) -> tuple[float, float]:
    """
    Return how far a signal moves from its last fifth but one to its last, and has yet to move.

    What is left is extrapolated from the last three fifths as an exponential, by as much as it
    moved at most. 0 within the noise, a standard deviation.
    """
    tail = max(1, int(STEADY_SHARE * values.size))
    earliest, earlier, last = (_windowed_mean(values[values.size - end - tail:values.size - end])
                               for end in (2 * tail, tail, 0))
    moved = last - earlier
    if not abs(moved) > NOISE_MARGIN * noise * math.sqrt(3.0 / tail):
        return 0.0, 0.0
    before = earlier - earliest
    ratio = moved / before if before else 0.0
    # An oscillation turns back, and creep may move evenly: their end is not known.
    return abs(moved), abs(moved) * (ratio / (1.0 - ratio) if 0.0 < ratio < 0.5 else 1.0)


def _crossing(time: Array, share: Array, level: float) -> float | None:
    """Return when `share` first reaches `level`, interpolated."""
    above = np.flatnonzero(share >= level)
    if not above.size:
        return None
    k = int(above[0])
    if k == 0:
        return float(time[0])
    before, after = share[k - 1], share[k]
    return float(time[k - 1] + (level - before) / (after - before) * (time[k] - time[k - 1]))


def _settling(time: Array, share: Array, band: float) -> float | None:
    """Return when `share` enters 1 ± band and stays, interpolated; None if it does not."""
    outside = np.flatnonzero(np.abs(share - 1.0) > band)
    if not outside.size:
        return float(time[0])
    k = int(outside[-1])
    # Outside the band in the steady part: not settled.
    if k >= share.size - max(1, int(STEADY_SHARE * share.size)):
        return None
    edge = 1.0 + band * np.sign(share[k] - 1.0)
    part = (edge - share[k]) / (share[k + 1] - share[k])
    return float(time[k] + part * (time[k + 1] - time[k]))


def _shape(time: Array, share: Array, ten: float, ninety: float) -> str:
    """Return the shape of the rise from 10 to 90 %: monotone, dip, spike or creep."""
    rise = share[(time >= ten) & (time <= ninety)]
    if rise.size and np.max(np.maximum.accumulate(rise) - rise) > DIP:
        return 'dip'
    after = share[time >= ninety]
    fall = 1.0 - after[int(np.argmax(after)):].min()
    # The undershoot of a damped oscillation is smaller than the overshoot before it.
    if fall > max(after.max() - 1.0, 0.0) + DIP:
        return 'spike'
    middle = _crossing(time, share, 0.5)
    assert middle is not None
    slow, fast = sorted((ninety - middle, middle - ten), reverse=True)
    return 'creep' if slow > CREEP * fast and ninety - ten > 4 * np.diff(time).mean() \
        else 'monotone'


def _smoothed(share: Array, noise: float) -> tuple[Array, float]:
    """Return the smoothed response and its remaining noise (shares of the step)."""
    if noise < 2e-3:
        return share, noise
    rise = np.flatnonzero(share >= 0.9)[:1] - np.flatnonzero(share >= 0.1)[:1]
    # A cubic over a third of the rise follows it; the noise falls with the root of the window.
    window = 2 * min(int(rise[0] // 6) if rise.size else 3, 50) + 1
    if window < 5:
        return share, noise
    kernel = signal.savgol_coeffs(window, 3)
    return (signal.savgol_filter(share, window, 3),
            noise * float(np.sqrt(np.sum(kernel**2))))


def _late(reference: Array, output: Array) -> float:
    """Return by how many samples an output follows its reference, 0 if that is not clear."""
    known = np.isfinite(output)
    if not known.any():
        return 0.0
    places = np.arange(output.size)
    whole = np.interp(places, places[known], output[known])
    return max(correlation_delay(reference, whole, 1.0) or 0.0, 0.0)


def _measure(time: Array, reference: Array, output: Array, jump_: _Jump, words: str, late: float,
             noise: float) -> Step:
    """Return the response to a jump of a signal with noise that is `late`, in samples."""
    begin, before, after, end = jump_
    initial, final = float(reference[before]), float(reference[after])
    notes: list[str] = []
    start = float(time[after])
    nothing = Step(start, initial, final, None, None, None, None, None, None, ())
    # All of the time before the first step is at rest, but not that after another.
    calm = before + 1 - begin if begin == 0 else int(STEADY_SHARE * (before + 1 - begin))
    if late >= min(end - after, before + 1 - begin if begin else math.inf):
        return nothing._replace(notes=(
            f'the {words} follows {1e3 * late * float(np.diff(time).mean()):.4g} ms late, after '
            'the reference has changed again',))
    before_count = max(1, min(calm, int(STEADY_SHARE * (end - after))))
    rest = output[before + 1 - before_count:before + 1]
    tail = max(1, int(STEADY_SHARE * (end - after)))
    if not (np.isfinite(rest).any() and np.isfinite(output[end - tail:end]).any()):
        return nothing._replace(notes=(f'the {words} is missing before the step or at its end',))
    low, high = float(np.nanmean(rest)), _windowed_mean(output[end - tail:end])
    jump = final - initial
    (moved_before, left_before), (moved, left) = (
        _restless(output[begin:before + 1], noise), _restless(output[after:end], noise))
    if moved > RESTLESS * abs(jump):
        return nothing._replace(notes=(f'the {words} has not come to rest before the reference '
                                       'changes again or the run ends',))
    if moved_before > RESTLESS * abs(jump):
        return nothing._replace(notes=(f'the {words} has not come to rest before the step',))
    error = final - high
    if (high - low) * jump <= 0.0 or abs(high - low) < 0.1 * abs(jump):
        return nothing._replace(steady_state_error_n=error,
                                notes=(f'the {words} does not follow the step',))
    share = (output[after:end] - low) / (high - low)
    valid = np.isfinite(share)
    t, share = time[after:end][valid], share[valid]
    share, noise = _smoothed(share, noise_level(share))
    ten, ninety = _crossing(t, share, 0.1), _crossing(t, share, 0.9)
    assert ten is not None and ninety is not None  # the mean of the end is 1
    shape = _shape(t, share, ten, ninety)
    if shape != 'monotone':
        notes.append(f'the rise from 10 to 90 % has a {shape} and is not a single rise: '
                     'the rise time is not meaningful')
    settled = []
    for band in (0.02, 0.05):
        moment = _settling(t, share, band)
        if moment is None:
            reason = ('noise' if NOISE_MARGIN * noise > band else 'an oscillation or a drift')
            notes.append(f'the {words} does not stay within {100 * band:.0f} % of the step '
                         f'({reason})')
        settled.append(None if moment is None else moment - start)
    return Step(start, initial, final, ninety - ten,
                max(0.0, 100.0 * float(share.max() - 1.0)), settled[0], settled[1], error, shape,
                tuple(notes), 100.0 * NOISE_MARGIN * noise,
                100.0 * max(left_before, left) / abs(jump))


def _settings(reference: Array) -> Array:
    """Return a reference without gaps and spikes."""
    return hold_last(without_spikes(hold_last(reference)))


def step_responses(run: Run, signal: str | None = None) -> list[Step]:
    """
    Return the response to each step of the reference of a run, in order of time.

    signal: by default the controlled one. Empty without a step, a reference, or if the reference
    is of another signal. A noisy signal is smoothed by a cubic Savitzky-Golay filter over a third
    of the rise.
    """
    output = run.followed(signal)
    if run.reference_n is None or output is None:
        return []
    reference, words = _settings(run.reference_n), run.controlled()
    jumps = _jumps(reference)
    late = _late(reference, output) if len(jumps) > 1 else 0.0
    noise = noise_level(output[np.isfinite(output)])
    return [_measure(run.time_s, reference, output, jump, words, late, noise)
            for jump in jumps]


def largest_step(steps: Sequence[Step]) -> Step | None:
    """Return the largest step, of equal ones the first; None if there is none."""
    return max(steps, key=lambda step: round(abs(step.final_n - step.initial_n), 6), default=None)


# Keys of the largest step in the documents of `step_response` and `analyze`.
HEADLINE: Final = ('rise_time_s', 'overshoot_percent', 'settling_time_2_s', 'settling_time_5_s',
                   'steady_state_error_n', 'rise_shape', 'monotone_rise')


TRANSIENT: Final = ('rise_time_s', 'overshoot_percent', 'settling_time_2_s', 'settling_time_5_s')
# A response is assumed not to leave its band again after this multiple of the settling time.
RETURNS: Final = 2.0
# Largest share of missing samples in the steady part.
LOST_SHARE: Final = 0.1
# A rise in fewer sampling periods is mostly interpolated.
RESOLVED: Final = 2.0
# Values that differ by less than this share of a step are rounded numbers, not those of a sensor.
ROUNDING: Final = 1e-9


class StepResponse(Result):
    """
    The result of `step_response`, with the keys of `asi analyze` that concern steps.

    `run` is the recording, `measured` the list of its `Step`s.
    """

    title = 'Step response'
    rows = 'steps'
    run: Run
    measured: list[Step]

    def measures(self) -> list[tuple[str, str]]:
        """Return name and value of each measure of the largest step that is not None."""
        return [(name, number(self[key] * scale, unit, 3)) for name, key, unit, scale in (
            ('rise time 10-90 %', 'rise_time_s', 'ms', 1e3),
            ('overshoot', 'overshoot_percent', '%', 1.0),
            ('settling time 2 %', 'settling_time_2_s', 'ms', 1e3),
            ('settling time 5 %', 'settling_time_5_s', 'ms', 1e3),
            ('steady-state error', 'steady_state_error_n', self.unit, 1.0))
            if self[key] is not None]

    def parts(self) -> Iterator[str | Table]:
        yield Table(('', ''), self.measures())
        yield from (f'note: {note}' for note in self.notes)

    def pictures(self) -> Pictures:
        from asi_analysis.reporting import figures
        step = largest_step(self.measured)
        if step is None or step.final_n == step.initial_n:
            raise InputError(self.notes[0])
        later = [each.time_s for each in self.measured if each.time_s > step.time_s]
        end = min(later[0] if later else self.run.time_s[-1],
                  step.time_s + 3.0 * (step.settling_time_2_s or np.inf)) - step.time_s
        percent = 100.0 / (step.final_n - step.initial_n)
        output = percent * (self.run.signal(self.signal) - step.initial_n)
        same_unit = self.run.unit('command') == self.unit
        command = (percent * (self.run.command_n - step.initial_n)
                   if self.run.command_n is not None and same_unit else None)
        what = self.signal.capitalize()
        return {'step': (figures.step_responses(
            {self.run.source or 'run': (self.run.time_s - step.time_s, output, command)}, end,
            self.signal), f'{what}{"" if command is None else " and command"} after the step of '
                          f'{step.final_n - step.initial_n:g} {self.unit}')}


def _why_no_step(run: Run, name: str) -> str:
    if run.reference_n is None:
        return 'step: the run has no reference'
    if name != run.controlled():
        return f'step: the reference is that of a {run.controlled()}, not of the {name}'
    return 'step: the reference has no step'


def _with_trust(step: Step, run: Run, name: str, found: Sequence[Finding],
                reliable: dict[float, dict[str, bool]]) -> Step:
    """Return a step without figures that rest on doubtful samples; fill `reliable`."""
    time, reference = run.time_s, _settings(run.signal('reference'))
    first = int(np.searchsorted(time, step.time_s, side='right')) - 1
    changed = np.flatnonzero(np.abs(reference[first:] - step.final_n)
                             > 0.02 * abs(step.final_n - step.initial_n))
    end = float(time[first + changed[0] - 1] if changed.size else time[-1])
    # The step ends at the first sample with another reference, if there is one.
    ended = float(time[first + changed[0]]) if changed.size else end
    settled = step.settling_time_2_s or step.settling_time_5_s
    signals = (name, 'reference')
    # In lost samples soon after the response has entered the band it may have left it again.
    # The last response of a recording that was cut goes on in the samples that it lacks, perhaps
    # to another level.
    last = ended == time[-1]
    moving = trust(found, run, signals, float(time[max(first - 1, 0)]),
                   min(step.time_s + RETURNS * settled, end) if settled else end, whole=last)
    steady = trust(found, run, signals, end - STEADY_SHARE * (end - step.time_s), ended,
                   LOST_SHARE, whole=last)
    # Findings other than lost samples affect the levels, and so every figure.
    begin = step.time_s - STEADY_SHARE * (end - step.time_s)
    levels = trust([each for each in found if each.kind not in MARKING], run, signals, begin,
                   ended)
    if levels.withheld:
        moving = steady = levels
    resolution = float(np.diff(np.unique(run.signal(name)[first:])).min(initial=np.inf))
    error, size = step.steady_state_error_n, abs(step.final_n - step.initial_n)
    if steady.reliable and error is not None and max(abs(error), ROUNDING * size) < resolution:
        steady = Trust(False, False, f'the {name} has a resolution of {resolution:.3g} '
                                     f'{run.unit(name)}')
    if moving.reliable and step.rise_time_s == 0.0:
        moving = Trust(False, False, f'the {name} has risen within the sample at which the '
                                     'reference jumps: are rows missing there?')
    if moving.reliable and step.restless_percent > 100.0 * AT_REST:
        reason = (f'the {name} still moves before the step or at its end, by '
                  f'{step.restless_percent:.2g} % of the step')
        moving = steady = Trust(False, False, reason)
    rise = moving
    if moving.reliable and (step.rise_time_s or np.inf) < RESOLVED * run.period_s:
        rise = Trust(False, False, f'the samples are {1e3 * run.period_s:.4g} ms apart')
    above = moving
    noise, over = step.overshoot_noise_percent or 0.0, step.overshoot_percent or 0.0
    if moving.reliable and 0.0 < over < noise and noise > ROUNDING_PERCENT:
        above = Trust(False, False, f'the noise of the {name} alone gives up to {noise:.2g} %')
    reliable[step.time_s] = dict.fromkeys(TRANSIENT, moving.reliable) | {
        'rise_time_s': rise.reliable, 'overshoot_percent': above.reliable,
        'steady_state_error_n': steady.reliable}
    if moving.withheld:
        step = step._replace(rise_time_s=None, overshoot_percent=None, settling_time_2_s=None,
                             settling_time_5_s=None, rise_shape=None)
    if steady.withheld:
        step = step._replace(steady_state_error_n=None)
    notes = moving.note('rise, overshoot and settling') + steady.note('steady-state error')
    if rise is not moving:
        notes = rise.note('rise') + notes
    if above is not moving:
        notes = above.note('overshoot') + notes
    return step._replace(notes=(*step.notes, *notes))


def _lacks_a_larger(run: Run, largest: Step, found: Sequence[Finding]) -> bool:
    """Return whether samples that the recording lacks may hold what counts as the largest step."""
    cut = [each for each in found if each.kind == 'cut']
    if not cut:
        return False
    whole = generated(run, len(run) + run.lacking)
    size = abs(largest.final_n - largest.initial_n)
    return whole is None or len(cut[0].intervals_s) > 1 or float(
        np.abs(np.diff(whole)).max()) > (1.0 + ROUNDING) * size


def step_response(run: Run, signal: str | None = None) -> StepResponse:
    """
    Return rise, overshoot, settling and steady-state error after each step of the reference.

    run: a recording with a reference and what follows it: a force, position, velocity or pressure,
    in the unit of `Run.unit`; signal: its name, by default the controlled one. The keys outside
    `steps` are those of the largest step. What cannot be measured is None; `notes` says why.
    Raises InputError for a signal that was not recorded.

    Rise time and settling time as in MATLAB's stepinfo: from the level before the step to the mean
    over the last fifth of the time after it.

    >>> import asi_analysis as asi
    >>> run = asi.simulate({}, {'compensator': 'lead4', 'reference.amplitude': 100.0}, 0.4)
    >>> step = asi.step_response(run)
    >>> print(step)
    rise time 10-90 %   6.2 ms
    overshoot           0 %
    settling time 2 %   21.1 ms
    settling time 5 %   13.4 ms
    steady-state error  -1.72 N
    >>> step.steps[0]['final_n']
    100.0
    """
    check_rate(run.time_s, run.source)
    found = findings(run)
    reliable: dict[float, dict[str, bool]] = {}
    name = run.output(signal)
    steps = [_with_trust(step, run, name, found, reliable) for step in step_responses(run, name)]
    largest = largest_step(steps)
    notes = list(largest.notes) if largest else [_why_no_step(run, name)]
    of_largest = reliable.get(largest.time_s, {}) if largest else {}
    if largest and len(steps) > 1 and _lacks_a_larger(run, largest, found):
        of_largest = dict.fromkeys(of_largest, False)
        notes.append('step: doubtful, as the samples that are not in the recording may hold a '
                     'larger one, or one as large before it')
    return StepResponse({
        'signal': name,
        'unit': run.unit(name),
        **{key: getattr(largest, key) if largest else None for key in HEADLINE},
        'steps': [step._asdict() | {'monotone_rise': step.monotone_rise,
                                    'notes': list(step.notes)} for step in steps],
        'notes': notes,
        'quality': [each.to_dict() for each in found],
        'reliable': of_largest},
        run=run, measured=steps)
