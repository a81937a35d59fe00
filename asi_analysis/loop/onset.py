"""
The onset of the limit cycle: the least gain at which a step leaves one, and the fold below it.

The fold of harmonic balance is where the cycle is born: below it none exists. A step starts the
cycle at the fold or above it, where it is strong enough a kick to pass the smaller, unstable one.
"""

import math
from typing import Any, Final, NamedTuple

from asi_analysis.loop import harmonic_balance as hb
from asi_analysis.loop.simulation import (
    WATCHED_S,
    Values,
    as_balance,
    loop_of,
    remembering,
    step_run,
    step_runs,
    sustained,
)
from asi_analysis.measures.oscillation import Oscillation

# The gain is changed by this factor until the loop cycles, up to MOST times the first.
RAISE: Final = 1.06
MOST: Final = 12.0
# Gains that are tried at a time.
SIDE_BY_SIDE: Final = 4
ACCURACY: Final = 0.0005
# The branch is followed down from these multiples of the onset gain: corners of the friction may
# stop Newton's rule on one of them.
START_ABOVE: Final = (1.02, 1.03, 1.045, 1.07)
# Onset and fold that differ by less agree.
AGREED: Final = 0.005


class Onset(NamedTuple):
    """The cycle at the least gain at which a step leaves one: Hz, N; the gain's bracket."""

    gain: float
    frequency_hz: float
    amplitude_n: float
    gain_below: float       # a gain just below, at which the step leaves none


class Fold(NamedTuple):
    """Where the branch of cycles begins: gain, frequency (Hz), amplitude of the force (N)."""

    gain: float
    frequency_hz: float
    amplitude_n: float


def with_gain(controller: Values, gain: float) -> dict[str, Any]:
    """Return the controller's parameters with another gain."""
    return {**controller, 'gain': float(gain)}


def onset(actuator: Values, controller: Values, rate_hz: float, start_gain: float,
          accuracy: float = ACCURACY, watched_s: float = WATCHED_S, most: float = MOST
          ) -> Onset | None:
    """
    Return the least gain at which the step of the controller's reference leaves a cycle.

    start_gain: where the search begins; gains are raised from there until the loop cycles, up to
    `most` times it, or lowered first if it cycles there already. accuracy: of the gain, a share;
    watched_s: how long (s) a doubtful loop is watched. None if no gain tried makes a cycle.
    """
    def cycles(gains: list[float]) -> list[Oscillation | None]:
        return [sustained(run) for run in step_runs(
            [actuator] * len(gains), [with_gain(controller, gain) for gain in gains], rate_hz,
            watched_s)]

    below, found = start_gain, cycles([start_gain])[0]
    high = start_gain
    while found is not None and below > start_gain / most:
        high, below = below, below / RAISE
        lower = cycles([below])[0]
        if lower is None:
            break
        found = lower
    while found is None:
        tried = [below * RAISE ** k for k in range(1, SIDE_BY_SIDE + 1)]
        if below > most * start_gain:
            return None
        for gain, swing in zip(tried, cycles(tried), strict=True):
            if swing is not None:
                high, found = gain, swing
                break
            below = gain
    while high > below * (1.0 + accuracy):
        middle = math.sqrt(below * high)
        trial = cycles([middle])[0]
        if trial is None:
            below = middle
        else:
            high, found = middle, trial
    return Onset(high, found.frequency_hz, found.amplitude_n, below)


def user_gain(controller: Values, loop: hb.Loop) -> float:
    """Return the gain of the compensator's record for a gain of 1 in the user's parameters."""
    unit = loop_of({}, with_gain(controller, 1.0), 1.0 / loop.period_s)
    return float(unit.compensator['gain'])


def balanced_cycle(actuator: Values, controller: Values, rate_hz: float,
                   harmonics: int = hb.HARMONICS) -> tuple[hb.Loop, hb.Balance] | None:
    """Return the cycle that a step leaves, by harmonic balance; None if there is none."""
    run = step_run(actuator, controller, rate_hz)
    swing = sustained(run)
    if swing is None:
        return None
    loop = remembering(loop_of(actuator, controller, rate_hz), run, swing.frequency_hz)
    found = hb.balance(loop, as_balance(run, swing, float(loop.compensator['gain']), harmonics))
    return None if found is None else (loop, found)


def branch(actuator: Values, controller: Values, rate_hz: float, first_gain: float,
           onset_only: bool = False, harmonics: int = hb.HARMONICS) -> list[hb.Balance]:
    """
    Return the branch of cycles by full harmonic balance, gains as in the parameters.

    From the highest gain down and round the fold; onset_only: without what lies above its begin.
    first_gain: where a cycle is looked for; it is raised until there is one.
    """
    gain, begin = first_gain, None
    while begin is None and gain <= MOST * first_gain:
        begin = balanced_cycle(actuator, with_gain(controller, gain), rate_hz, harmonics)
        gain *= RAISE
    if begin is None:
        return []
    loop, start = begin
    unit = user_gain(controller, loop)
    found = hb.continue_in_gain(loop, start, 0.3 * start.gain, 1.35 * start.gain)
    upward = [] if onset_only else hb.continue_in_gain(
        loop, start, 0.3 * start.gain, 1.3 * start.gain, rising=True)
    return [point._replace(gain=point.gain / unit) for point in [*upward[:0:-1], *found]]


def fold(actuator: Values, controller: Values, rate_hz: float, onset_gain: float,
         harmonics: int = hb.HARMONICS) -> Fold | None:
    """
    Return the fold of the cycle that a step leaves above its onset; None if none is found.

    The seals keep the friction of the cycle from which the branch is followed.
    """
    for above in START_ABOVE:
        points = branch(actuator, controller, rate_hz, above * onset_gain, True, harmonics)
        if points and 0 < min(range(len(points)), key=lambda k: points[k].gain) < len(points) - 1:
            return Fold(*hb.fold(points))
    return None


def disagreement(found: Onset, at: Fold | None) -> str:
    """Return a note on an onset whose gain is not the fold's within AGREED; empty if it is."""
    if at is None:
        return 'harmonic balance finds no fold'
    above = found.gain / at.gain - 1.0
    if abs(above) <= AGREED:
        return ''
    return (f'the fold of harmonic balance is at gain {at.gain:.4g}, {at.frequency_hz:.4g} Hz: '
            + (f'the step starts the cycle only {100.0 * above:.2g} % above it' if above > 0.0
               else f'the step leaves a cycle {-100.0 * above:.2g} % below it'))
