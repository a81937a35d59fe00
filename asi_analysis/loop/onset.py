"""
Onset of the limit cycle: the least gain at which a step leads to one, and the fold below it.

Below the fold of harmonic balance no cycle exists. Above it a step leads to the cycle if its
transient exceeds the smaller, unstable cycle.
"""

import math
from typing import Any, Final, NamedTuple

from asi_analysis.loop import harmonic_balance as hb
from asi_analysis.loop.simulation import (
    FIRST_WATCHED_S,
    WATCHED_S,
    Values,
    as_balance,
    loop_of,
    step_run,
    step_runs,
    sustained,
    with_mean_friction,
)
from asi_analysis.measures.oscillation import Oscillation

# Factor between gains that are tried, up to MOST times the first.
GAIN_FACTOR: Final = 1.06
MOST: Final = 12.0
LEAST_GAIN: Final = 1e-100     # products of smaller ones are 0
# Gains that are simulated in parallel.
IN_PARALLEL: Final = 2
ACCURACY: Final = 0.0005
# The branch is continued from these multiples of the onset gain, in turn: at one of them Newton's
# method may fail at a corner of the friction.
START_ABOVE: Final = (1.02, 1.03, 1.045, 1.07)
# Largest relative difference of onset and fold without a note.
AGREED: Final = 0.005


class LeastGain(NamedTuple):
    """The least gain with a cycle, its frequency (Hz), and the amplitude of its force (N)."""

    gain: float
    frequency_hz: float
    amplitude_n: float


def with_gain(controller: Values, gain: float) -> dict[str, Any]:
    """Return the controller's parameters with another gain."""
    return {**controller, 'gain': float(gain)}


def onset(actuator: Values, controller: Values, rate_hz: float, start_gain: float,
          accuracy: float = ACCURACY, watched_s: float = WATCHED_S, most: float = MOST,
          first_s: float = FIRST_WATCHED_S) -> LeastGain | None:
    """
    Return the least gain at which the step of the controller's reference leads to a cycle.

    start_gain: of the search; the gain is raised until the loop cycles, up to `most` times it, or
    lowered first if it cycles there already. accuracy: relative, of the gain; watched_s: longest
    simulation (s) of a loop that has not settled; first_s: shortest of any. None if it cycles at
    no gain tried, or starts below LEAST_GAIN.
    """
    def cycles(gains: list[float]) -> list[Oscillation | None]:
        return [sustained(run) for run in step_runs(
            [actuator] * len(gains), [with_gain(controller, gain) for gain in gains], rate_hz,
            watched_s, first_s)]

    if start_gain < LEAST_GAIN:
        return None
    below, found = start_gain, cycles([start_gain])[0]
    high = start_gain
    while found is not None and below > start_gain / most:
        high, below = below, below / GAIN_FACTOR
        lower = cycles([below])[0]
        if lower is None:
            break
        found = lower
    while found is None:
        tried = [below * GAIN_FACTOR ** k for k in range(1, IN_PARALLEL + 1)]
        if below > most * start_gain:
            return None
        for gain, trial in zip(tried, cycles(tried), strict=True):
            if trial is not None:
                high, found = gain, trial
                break
            below = gain
    while high > below * (1.0 + accuracy):
        middle = math.sqrt(below * high)
        trial = cycles([middle])[0]
        if trial is None:
            below = middle
        else:
            high, found = middle, trial
    return LeastGain(high, found.frequency_hz, found.amplitude_n)


def user_gain(controller: Values, loop: hb.Loop) -> float:
    """Return the gain of the compensator's record for a gain of 1 in the user's parameters."""
    unit = loop_of({}, with_gain(controller, 1.0), 1.0 / loop.period_s)
    return float(unit.compensator['gain'])


def balanced_cycle(actuator: Values, controller: Values, rate_hz: float,
                   harmonics: int = hb.HARMONICS) -> tuple[hb.Loop, hb.Balance] | None:
    """Return the cycle after a step, by harmonic balance; None if there is none."""
    run = step_run(actuator, controller, rate_hz)
    oscillation = sustained(run)
    if oscillation is None:
        return None
    loop = with_mean_friction(
        loop_of(actuator, controller, rate_hz), run, oscillation.frequency_hz)
    gain = float(loop.compensator['gain'])
    found = hb.balance(loop, as_balance(run, oscillation, gain, harmonics))
    return None if found is None else (loop, found)


def branch(actuator: Values, controller: Values, rate_hz: float, first_gain: float,
           onset_only: bool = False, harmonics: int = hb.HARMONICS) -> list[hb.Balance]:
    """
    Return the branch of cycles by full harmonic balance, gains as in the parameters.

    From the highest gain down to the fold and beyond; onset_only: only from the first cycle found
    downwards. first_gain: raised until there is a cycle.
    """
    gain, first = first_gain, None
    while first is None and gain <= MOST * first_gain:
        first = balanced_cycle(actuator, with_gain(controller, gain), rate_hz, harmonics)
        gain *= GAIN_FACTOR
    if first is None:
        return []
    loop, start = first
    unit = user_gain(controller, loop)
    found = hb.continue_in_gain(loop, start, 1.35)
    upward = [] if onset_only else hb.continue_in_gain(loop, start, 1.3, rising=True)
    return [point._replace(gain=point.gain / unit) for point in [*upward[:0:-1], *found]]


def fold(actuator: Values, controller: Values, rate_hz: float, onset_gain: float,
         harmonics: int = hb.HARMONICS) -> LeastGain | None:
    """
    Return the fold of the branch of cycles above the onset; None if none is found.

    The mean friction of the seals is that of the cycle from which the branch is continued.
    """
    for above in START_ABOVE:
        points = branch(actuator, controller, rate_hz, above * onset_gain, True, harmonics)
        if points and 0 < min(range(len(points)), key=lambda k: points[k].gain) < len(points) - 1:
            return LeastGain(*hb.fold(points))
    return None


def disagreement(onset_gain: float, at: LeastGain | None) -> str:
    """Return a note if the gains of onset and fold differ by more than AGREED; else empty."""
    if at is None:
        return 'harmonic balance finds no fold'
    above = onset_gain / at.gain - 1.0
    if abs(above) <= AGREED:
        return ''
    return (f'the fold of harmonic balance is at gain {at.gain:.4g}, {at.frequency_hz:.4g} Hz: '
            + (f'the step leads to the cycle only {100.0 * above:.2g} % above it' if above > 0.0
               else f'the step leads to a cycle {-100.0 * above:.2g} % below it'))
