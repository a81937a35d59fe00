"""
What a step in the reference did: rise, overshoot, settling, steady-state error.

Levels are measured from the force before the step to the force at the end, as MATLAB's stepinfo
does; how far that end is from what was asked is the steady-state error.
"""

import math
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import signal

from asi_analysis.bags.run import Run

# Shares of the plateau after a step: its end is the steady value.
STEADY_SHARE: Final = 0.2
# Before and after a step the reference holds for at least this many samples.
FEWEST_SAMPLES: Final = 5
# A reference takes at most this many samples for a jump; what takes longer is a ramp.
LONGEST_JUMP: Final = 3
# Share of the step that the force may fall back during a rise that still counts as one.
DIP: Final = 0.05
# 90 % comes this many times later after 50 % than 50 % after 10 %, or the reverse: not a rise but
# a jump and a creep. A first-order lag has 2.7.
CREEP: Final = 5.0
# Standard deviations of noise that must fit into the settling band.
NOISE_MARGIN: Final = 4.0

Array = npt.NDArray[np.float64]


class Step(NamedTuple):
    """One step. What could not be measured is None, and `notes` says why."""

    time_s: float                       # when the reference jumps
    initial_n: float                    # reference before
    final_n: float                      # reference after
    rise_time_s: float | None           # 10 to 90 %
    overshoot_percent: float | None     # beyond the steady value, share of the step
    settling_time_2_s: float | None     # from the jump until it stays within 2 % of the step
    settling_time_5_s: float | None
    steady_state_error_n: float | None  # reference less the mean force at the end
    rise_shape: str | None              # monotone, dip, spike or creep
    notes: tuple[str, ...]

    @property
    def monotone_rise(self) -> bool | None:
        """Whether the rise time tells of a rise; a spike, dip or creep hides behind one too."""
        return None if self.rise_shape is None else self.rise_shape == 'monotone'


class _Jump(NamedTuple):
    """Sample numbers: the plateau before begins, ends; that after begins, ends (exclusive)."""

    begin: int
    before: int
    after: int
    end: int


def _jumps(reference: Array) -> list[_Jump]:
    """Return the steps of a reference: it holds still (to 2 % of the jump) before and after."""
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
            and all(_still(reference[begins[k]:ends[k]],
                           abs(reference[begins[i + 1]] - reference[ends[i] - 1]))
                    for k in (i, i + 1))]


def _still(plateau: Array, jump: float) -> bool:
    return plateau.size >= FEWEST_SAMPLES and bool(np.ptp(plateau) <= 0.02 * jump)


def noise_level(values: Array) -> float:
    """
    Return the standard deviation of white noise on a signal that is smooth.

    From its sixth difference, which is nearly blind to what moves slower than a tenth of the
    sampling rate; the median, so that a jump does not count.
    """
    if values.size < 7:
        return 0.0
    return float(1.4826 * np.median(np.abs(np.diff(values, 6))) / math.sqrt(math.comb(12, 6)))


def _windowed_mean(values: Array) -> float:
    """Return the mean that an oscillation about it does not shift; nan if all are missing."""
    weights = signal.windows.hann(values.size + 2)[1:-1] * np.isfinite(values)
    return float(np.sum(weights * np.nan_to_num(values)) / np.sum(weights))


def _crossing(time: Array, share: Array, level: float) -> float | None:
    """Return when `share` first rises through `level`, between the samples."""
    above = np.flatnonzero(share >= level)
    if not above.size:
        return None
    k = int(above[0])
    if k == 0:
        return float(time[0])
    before, after = share[k - 1], share[k]
    return float(time[k - 1] + (level - before) / (after - before) * (time[k] - time[k - 1]))


def _settling(time: Array, share: Array, band: float) -> float | None:
    """Return when `share` enters 1 -+ band for good, between the samples; None if it does not."""
    outside = np.flatnonzero(np.abs(share - 1.0) > band)
    if not outside.size:
        return float(time[0])
    k = int(outside[-1])
    # Still outside in the steady part: it may leave the band again at any time.
    if k >= share.size - max(1, int(STEADY_SHARE * share.size)):
        return None
    edge = 1.0 + band * np.sign(share[k] - 1.0)
    part = (edge - share[k]) / (share[k + 1] - share[k])
    return float(time[k] + part * (time[k + 1] - time[k]))


def _shape(time: Array, share: Array, ten: float, ninety: float) -> str:
    """Return whether the way from 10 to 90 % is one rise, or what it is instead."""
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
    """Return the response with less noise, and how much of it is left (shares of the step)."""
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


def _measure(time: Array, reference: Array, force: Array, jump_: _Jump) -> Step:
    begin, before, after, end = jump_
    initial, final = float(reference[before]), float(reference[after])
    notes: list[str] = []
    start = float(time[after])
    nothing = Step(start, initial, final, None, None, None, None, None, None, ())
    held = max(1, min(before + 1 - begin, int(STEADY_SHARE * (end - after))))
    low = float(np.nanmean(force[before + 1 - held:before + 1]))
    tail = max(1, int(STEADY_SHARE * (end - after)))
    high = _windowed_mean(force[end - tail:end])
    earlier = _windowed_mean(force[end - 2 * tail:end - tail])
    jump = final - initial
    if abs(high - earlier) > 0.05 * abs(jump):
        return nothing._replace(notes=('the force has not come to rest before the reference '
                                       'changes again or the run ends',))
    error = final - high
    if (high - low) * jump <= 0.0 or abs(high - low) < 0.1 * abs(jump):
        return nothing._replace(steady_state_error_n=error,
                                notes=('the force does not follow the step',))
    share = (force[after:end] - low) / (high - low)
    valid = np.isfinite(share)
    t, share = time[after:end][valid], share[valid]
    noise = noise_level(share)
    share, noise = _smoothed(share, noise)
    ten, ninety = _crossing(t, share, 0.1), _crossing(t, share, 0.9)
    assert ten is not None and ninety is not None  # the mean of the end is 1
    shape = _shape(t, share, ten, ninety)
    if shape != 'monotone':
        notes.append(f'the rise from 10 to 90 % is not one rise but a {shape}: '
                     'its time says little')
    settled = []
    for band in (0.02, 0.05):
        moment = _settling(t, share, band)
        if moment is None:
            reason = ('noise' if NOISE_MARGIN * noise > band else 'an oscillation or a drift')
            notes.append(f'the force does not stay within {100 * band:.0f} % of the step '
                         f'({reason})')
        settled.append(None if moment is None else moment - start)
    return Step(start, initial, final, ninety - ten,
                max(0.0, 100.0 * float(share.max() - 1.0)), settled[0], settled[1], error, shape,
                tuple(notes))


def held(values: Array) -> Array:
    """Return a signal whose missing samples keep the value before them (the first, the next)."""
    known = np.isfinite(values)
    if not known.any():
        return np.zeros_like(values)
    last = np.maximum.accumulate(np.where(known, np.arange(values.size), 0))
    return values[np.maximum(last, np.argmax(known))]


def step_responses(run: Run) -> list[Step]:
    """
    Return each step that the reference of a run makes, in order of time.

    Empty if there is none (or no force, or a reference that does not ask for one). With noise on
    the force the response is smoothed by a cubic Savitzky-Golay filter a third of the rise long.
    """
    if run.reference_n is None or run.force_n is None or run.controlled() != 'force':
        return []
    reference = held(run.reference_n)
    return [_measure(run.time_s, reference, run.force_n, jump) for jump in _jumps(reference)]


def headline(steps: list[Step]) -> Step | None:
    """Return the step that stands for a run: the largest, the first of equals; None of none."""
    if not steps:
        return None
    return max(steps, key=lambda step: round(abs(step.final_n - step.initial_n), 6))
