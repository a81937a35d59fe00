"""
Choose the motion of a joint that best separates the remaining hypotheses.

The controller of a joint is not known, so a course is suggested: of the joint, or of the command
of its drive. Range, speed and acceleration stay within those of the recording.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.signal import chirp, sawtooth

from asi_analysis.arrays import Array
from asi_analysis.bags.run import Run
from asi_analysis.gap.experiment.next_experiment import pairs_of, separation, suggestion
from asi_analysis.gap.inference.hypotheses import Weighed
from asi_analysis.gap.inference.probability import Names
from asi_analysis.gap.model.group import Group
from asi_analysis.gap.prepare import Recording, prepare
from asi_analysis.gap.words import digits

DURATION_S, LEAST_SAMPLES = 20.0, 2000
Course = Callable[[Array, float], Array]


def _triangle(time: Array, frequency: float) -> Array:
    return np.asarray(sawtooth(2.0 * np.pi * frequency * (time + 0.25 / frequency), 0.5))


def _sine(time: Array, frequency: float) -> Array:
    return np.sin(2.0 * np.pi * frequency * time)


def _sweep(time: Array, frequency: float) -> Array:
    return np.asarray(chirp(time, 0.1 * frequency, time[-1], frequency, 'logarithmic', -90.0))


def _steps(time: Array, frequency: float) -> Array:
    """Return motion to and fro at a constant speed, with a rest after each stroke."""
    return np.clip(1.5 * _triangle(time, frequency / 1.5), -1.0, 1.0)


# A course and its size, as a share of the range, and its speed, as a share of the highest.
CATALOGUE: dict[str, tuple[Course, float, float]] = {
    'slow triangle over the whole range': (_triangle, 1.0, 0.1),
    'small slow triangle': (_triangle, 0.1, 0.05),
    'triangle at full speed': (_triangle, 1.0, 1.0),
    'sine over the whole range': (_sine, 1.0, 1.0),
    'small quick sine': (_sine, 0.1, 1.0),
    'sweep over the whole range': (_sweep, 1.0, 1.0),
    'small sweep': (_sweep, 0.1, 1.0),
    'to and fro with rests': (_steps, 1.0, 0.5),
}


def choose_motion(groups: list[Weighed], ambiguous: list[Names], missing: Sequence[str] = (),
                  unit: str = '') -> dict[str, object] | None:
    """
    Return the course of the catalogue that separates the hypotheses `ambiguous` best.

    The score is that of the worst pair. missing: signals that were not recorded. None if fewer
    than two hypotheses can be predicted. unit: of the motion.
    """
    pairs = pairs_of(groups, ambiguous)
    if not pairs:
        return None
    worst = {name: min(separation(group, simulated(group, name)[0], a, b) for group, a, b in pairs)
             for name in CATALOGUE}
    best = max(worst, key=lambda name: worst[name])
    _, size, frequency = simulated(pairs[0][0], best)
    duration = _duration(pairs[0][0])
    return suggestion(
        f'{best}: {digits(size, unit)} to each side at {frequency:.3g} Hz, for {duration:.0f} s',
        None, worst[best], worst, ambiguous, missing)


def _duration(group: Group) -> float:
    """Return the duration (s) of a course: longer for a slowly sampled recording."""
    return max(DURATION_S, LEAST_SAMPLES * group.recordings[0].period_s)


def rounded(position: Array, sharpest: float) -> Array:
    """Return a course whose corners are rounded to second differences of about `sharpest`."""
    bend = bend_of(position)
    # The mean over n samples divides a second difference by n.
    spread = int(np.clip(np.ceil(bend / max(sharpest, 1e-300)), 1, position.size // 20))
    return np.asarray(uniform_filter1d(position, spread, mode='nearest'))


def bend_of(position: Array) -> float:
    """Return the 99.9 % quantile of the second differences of a course."""
    return float(np.quantile(np.abs(np.diff(position, 2)), 0.999))


def steepest(course: Course, time: Array) -> float:
    """Return the largest slope of a course of size 1 at 1 Hz, 1/s, over these times (s)."""
    return float(np.abs(np.gradient(course(time, 1.0), time[1] - time[0])).max())


def simulated(group: Group, name: str) -> tuple[Recording, float, float]:
    """Return a recording of a course, its size (in the unit of the motion) and frequency (Hz)."""
    known = group.recordings[0]
    course, share, speed = CATALOGUE[name]
    follows = known.motion is None
    moved = np.asarray(known.command if known.motion is None else known.motion.position, float)
    size = share * 0.5 * float(np.ptp(moved))
    fastest = float(np.quantile(np.abs(np.gradient(moved, known.period_s)), 0.999))
    time: Array = np.arange(round(_duration(group) / known.period_s)) * np.float64(known.period_s)
    # At this frequency the highest speed of the course is `speed * fastest`.
    frequency = speed * fastest / (size * steepest(course, time))
    position = rounded(size * course(time, frequency), bend_of(moved))
    if follows:
        run = Run(time, reference_n=position, force_n=position, source=name)
        return prepare([run], 'position')[0], size, frequency
    force = np.asarray(np.gradient(position, known.period_s))   # only the motion is used
    run = Run(time, position_m=position, force_n=force, source=name)
    made, = prepare([run], 'force')
    return replace(made, taken=known.taken, motion=made.moved.without_halts()), size, frequency
