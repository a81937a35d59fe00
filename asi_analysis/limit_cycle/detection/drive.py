"""Other causes of an oscillation than the loop itself: a drive from outside, or a limit."""

from collections.abc import Iterator
from typing import Final

import numpy as np
from scipy import stats

from asi_analysis.arrays import Array
from asi_analysis.bags.run import Run
from asi_analysis.limit_cycle.detection.resolution import quantisation
from asi_analysis.measures.drives import drives
from asi_analysis.measures.sinusoids.record import reduce
from asi_analysis.measures.sinusoids.sinusoid import (
    HarmonicFit,
    analytic_signal,
    fit,
    on_grid,
    valid_samples,
)

# Ratios (divisor, multiple) at which a nonlinear loop may answer a periodic drive; prior odds of
# the drive's own frequency, and of each other ratio, against an oscillation of its own.
RATIOS: Final = tuple((divisor, multiple) for divisor in (1, 2, 3) for multiple in (1, 2, 3, 5)
                      if divisor == 1 or multiple % divisor)
PRIOR_SAME: Final = 1.0
PRIOR_RATIO: Final = 0.05
# Error of a frequency by a transient that no fit describes, over the inverse duration.
TRANSIENT: Final = 0.02
# Delays, in cycles, of the copies of a drive to which the motion is fitted.
DELAYS: Final = np.arange(-1, 9) / 4.0
# Least share of the motion that a drive must explain.
FOLLOWS: Final = 0.5
# Least share of the time at a limit for the limit to determine the amplitude: a sine clipped for
# that time keeps 0.96 of its fundamental.
AT_LIMIT: Final = 0.25


def moving(run: Run, start_s: float, end_s: float) -> Iterator[tuple[str, tuple[Array, Array]]]:
    """Yield name, times and values of each drive that moves from start to end."""
    part = (run.time_s >= start_s) & (run.time_s <= end_s)
    for drive in drives(run):
        t, values = valid_samples(run.time_s[part], drive.values[part])
        if len(values) >= 9 and np.ptp(values) >= 1e-9 * max(np.abs(values).max(), 1e-300):
            yield drive.name, (t, values)


def follows_drive(run: Run, steady: HarmonicFit, start_s: float, end_s: float
                  ) -> tuple[float, str]:
    """
    Return the probability that the frequency of an oscillation is that of a drive, and the reason.

    Two hypotheses (Bayes): the frequency is a ratio times that of the drive, but for the errors of
    both, or it is any frequency of the same order. A coincidence is likelier in a short record,
    and at one of the many ratios other than 1.
    """
    tied, reason = 0.0, ''
    for name, values in moving(run, start_s, end_s):
        found = fit(*reduce(*values, steady.frequency_hz))
        if found is None or found.amplitude < found.noise:
            continue
        for divisor, multiple in RATIOS:
            ratio = multiple / divisor
            deviation = np.hypot(np.hypot(ratio * found.frequency_sd_hz, steady.frequency_sd_hz),
                                 TRANSIENT / (end_s - start_s))
            apart = steady.frequency_hz - ratio * found.frequency_hz
            # The density of a free frequency is 1 over the frequency.
            odds = (PRIOR_SAME if ratio == 1.0 else PRIOR_RATIO) * steady.frequency_hz * float(
                stats.norm.pdf(apart, scale=deviation))
            if odds > tied:
                word = '' if ratio == 1.0 else f' times {multiple}/{divisor}'
                tied, reason = odds, f'{name} moves at {found.frequency_hz:.5g} Hz{word} as well'
    return tied / (1.0 + tied), reason


def explained_by_drive(run: Run, time_s: Array, values: Array, frequency_hz: float
                       ) -> tuple[float, str]:
    """
    Return the share of a motion that a linear response to a drive explains, and its name.

    The response is a sum of delayed copies of the drive, which may have any shape, also a
    chirp or noise. The share is adjusted for the number of copies, as an adjusted R².
    """
    even, period = on_grid(time_s, values)
    grid = time_s[0] + period * np.arange(len(even))
    # The bandwidth is about the frequency: one independent sample a cycle.
    independent = (time_s[-1] - time_s[0]) * frequency_hz
    delays = DELAYS[:max(1, min(len(DELAYS), int(independent / 3.0)))]
    found = [(0.0, 'the reference')]
    for name, drive in moving(run, time_s[0], time_s[-1]):
        motion = analytic_signal(even, period, frequency_hz)
        driver = analytic_signal(np.interp(grid, *drive), period, frequency_hz)
        columns = np.column_stack([np.interp(grid - delay / frequency_hz, grid, driver)
                                   for delay in delays])
        # Copies of a sine are linearly dependent: minimum-norm solution.
        gram = columns.conj().T @ columns
        residual = motion - columns @ np.linalg.lstsq(gram, columns.conj().T @ motion,
                                                      rcond=1e-9)[0]
        share = 1.0 - float(np.vdot(residual, residual).real / np.vdot(motion, motion).real)
        found.append((1.0 - ((1.0 - share) * max(independent - 1.0, 0.0)
                             / max(independent - 1.0 - len(delays), 1.0)), name))
    return max(found)


def at_limit(run: Run, start_s: float, end_s: float) -> str:
    """Return which limit determines the amplitude; empty if none does."""
    inside = run.between(start_s, end_s + 0.5 * run.period_s)
    if inside.command_n is not None:
        share = flat_share(inside.command_n[np.isfinite(inside.command_n)])
        if share > AT_LIMIT:
            return f'the command is at its limit for {100 * share:.0f} % of the time'
    actuator = run.information.get('actuator', {})
    full = actuator.get('valve_characteristic.full_opening')
    if full and inside.valve_position_m is not None:
        share = float(np.mean(np.abs(inside.valve_position_m) >= 0.999 * full))
        if share > AT_LIMIT:
            return f'the valve is fully open for {100 * share:.0f} % of the time'
    return ''


def flat_share(values: Array) -> float:
    """
    Return the share of samples that are clipped at an extreme.

    0 for a signal that switches between two levels (a relay), and for one with no more samples at
    its extremes than a sine, or than its quantisation explains.
    """
    span = float(np.ptp(values)) if len(values) else 0.0
    if span == 0.0:
        return 0.0
    if len(np.unique(values)) < 8:
        return 0.0
    width = 1e-4 * span + quantisation(values)
    sine = np.arccos(1.0 - 2.0 * min(width / span, 0.5)) / np.pi
    top = float(np.mean(values >= values.max() - width))
    bottom = float(np.mean(values <= values.min() + width))
    if top + bottom > 0.95:
        return 0.0
    return sum(share for share in (top, bottom) if share > 2.5 * sine + 0.02)
