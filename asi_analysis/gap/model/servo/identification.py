"""
Identify the servo of a joint that follows a reference.

It is the nominal model if its residual is far smaller than that of a delay with a first-order lag.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import Final, NamedTuple

import numpy as np
from scipy.linalg import expm
from scipy.optimize import least_squares
from scipy.signal import lfilter

from asi_actuator.model.linear_lag import second_order as second_order_lag
from asi_analysis.arrays import Array
from asi_analysis.gap.model.servo.law import OUTPUT, SERVO_DTYPE, moving, servo_lags, servo_step
from asi_analysis.gap.prepare import Recording
from asi_analysis.gap.sampling import independent
from asi_analysis.parallel import in_threads
from asi_common.jit import jit

# Log odds against a servo of second order in place of a delay and a lag. Its limits are accepted
# if their residual power is below this share of that without limits.
AGAINST: Final = 7.0
LEFT_UNLIMITED: Final = 0.7
ALMOST: Final = 3.0           # a residual (rms) below this multiple of the noise is model error
# Natural frequency times sub-step, rad, of a servo with limits, and the most sub-steps of a
# sample. These are initial guesses: fits have a finer one.
SUB_STEP: Final = 0.05
MOST_SUB_STEPS: Final = 64
# Initial guesses: 1 / natural frequency, in samples; damping ratio, and its bounds.
TIMES: Final = (1.5, 5.0, 15.0, 50.0, 150.0)
DAMPING: Final = 0.8
DAMPINGS: Final = (0.05, 3.0)
LAG: Final = 20.0             # damping ratio at which a servo equals a lag of first order
LONGEST_DELAY: Final = 1.0    # s
LATE: Final = ('delay', 'lag')
LINEAR: Final = (*LATE, 'split')
# What is fitted of a servo with limits. Pulsation times period, rad, above which delays of whole
# samples are tried, and how many; a residual by which they are given up, relative to the best.
LIMITED: Final = ('pulsation', 'damping', 'rate', 'acceleration')
# Initial guesses, in multiples of what a fit without limits has: natural frequency, largest speed,
# acceleration over their product.
FASTER: Final = (1.0, 2.0, 4.0)
RATES: Final = (0.7, 1.0, 3.0)
RISES: Final = (0.3, 0.7, 2.0)
COARSE: Final = 0.05
MOST_LATE: Final = 12
WORSE: Final = 4.0
TOLERANCE: Final = 0.2        # of the gain
# Initial guesses: damping ratio of a servo with a lag; the lag, as a share of the mean delay of
# both, which is well known; share of its second pole. So many of the best are fitted.
LAG_DAMPINGS: Final = (0.55, 0.9)
LAG_SHARES: Final = (0.2, 0.4, 0.6, 0.8)
LAG_SPLIT: Final = 0.3
LEAST_SPLIT: Final = 0.05
FOLLOWED: Final = 3
HIDDEN: Final = (1.0, 8.0)    # natural frequencies of a hidden servo, by its lateness alone
# A recording begins amid a motion if it is so far off its reference, as a share of the motion
# (rms), or moves by this share of its speed (rms), in the mean of its first samples.
AWAY: Final = 0.1
MOVING: Final = 0.3
FIRST: Final = 5
# What was before has decayed after so many time constants, at most this share of a recording.
DECAYED: Final = 6.0
MOST_DECAYED: Final = 0.3
# The most samples of all recordings that are used: else every second, third ... of them.
MOST_SAMPLES: Final = 20_000


class Servo(NamedTuple):
    """
    Natural frequency rad/s, damping ratio, limits of rate and acceleration, delay s, lag s.

    Limits in units of the reference per s and per s2, 0: none. split: share of the lag that is
    its second pole, at most a half.
    """

    pulsation: float
    damping: float
    rate: float = 0.0
    acceleration: float = 0.0
    delay: float = 0.0
    lag: float = 0.0
    split: float = 0.0

    @property
    def limited(self) -> bool:
        """Return whether rate or acceleration are limited."""
        return self.rate > 0.0 or self.acceleration > 0.0

    @property
    def late_s(self) -> float:
        """Return its mean delay: that of a slow motion, s."""
        return self.delay + self.lag + 2.0 * self.damping / self.pulsation


@jit
def _follow(reference, begins, period, steps, pulsation, damping, e, out):
    h = period / steps
    lag, lags = second_order_lag(pulsation / (2.0 * math.pi), damping, h), servo_lags(e, h)
    state = moving(begins[0], begins[1], e)
    for k in range(reference.size):
        out[k] = state[OUTPUT]
        for _ in range(steps):
            servo_step(state, reference[k], lag, lags, e)


@jit
def _follow_unlimited(reference, begins, kept, drawn, out):
    position, rate = begins
    for k in range(reference.size):
        out[k] = position
        position, rate = (kept[0, 0] * position + kept[0, 1] * rate + drawn[0] * reference[k],
                          kept[1, 0] * position + kept[1, 1] * rate + drawn[1] * reference[k])


def follow(servo: Servo, reference: Array, start: float, period: float, rate: float = 0.0
           ) -> Array:
    """
    Return the response of a servo at `start` to a reference held for a period (s).

    Exact, if the servo has no limits.
    """
    time = period * np.arange(reference.size)
    late = np.interp(time - servo.delay, time, reference) if servo.delay else reference
    for time_constant in (servo.split * servo.lag, (1.0 - servo.split) * servo.lag):
        if time_constant <= 0.0:
            continue
        keep = math.exp(-period / time_constant)
        late = lfilter([1.0 - keep], [1.0, -keep], late, zi=[keep * start])[0]
    late, out = np.ascontiguousarray(late), np.empty(reference.size)
    stiffness = servo.pulsation ** 2
    if not servo.limited:
        moves = expm(period * np.array([
            [0.0, 1.0, 0.0], [-stiffness, -2.0 * servo.damping * servo.pulsation, stiffness],
            [0.0, 0.0, 0.0]]))
        _follow_unlimited(late, (start, rate), moves[:2, :2].copy(), moves[:2, 2].copy(), out)
        return out
    steps = min(max(math.ceil(period * servo.pulsation / SUB_STEP), 1), MOST_SUB_STEPS)
    limits = np.zeros(1, SERVO_DTYPE)[0]
    limits['servo_rate'], limits['servo_acceleration'] = servo.rate, servo.acceleration
    _follow(late, (start, rate), period, steps, servo.pulsation,
            servo.damping, limits, out)
    return out


def left_of(servo: Servo, recordings: Sequence[Recording], part: str) -> Array:
    """Return the residual of a servo's output on a part: 'fit' or 'held_out'."""
    return left_by([response_of(servo, r) for r in recordings], recordings, part)


def left_by(responses: Sequence[Array], recordings: Sequence[Recording], part: str) -> Array:
    """Return the residual of responses, with a gain near 1 and an offset from the fitted parts."""
    outputs = [r.output for r in recordings]
    x, y = (np.concatenate([each[r.fit] for each, r in zip(signals, recordings, strict=True)])
            for signals in (responses, outputs))
    power = float(np.var(x))
    gain = float(np.mean((x - x.mean()) * (y - y.mean()))) / power if power > 0.0 else 1.0
    gain = min(max(gain, 1.0 - TOLERANCE), 1.0 + TOLERANCE)
    offset = float(np.mean(y - gain * x))
    return np.concatenate([(output - gain * found - offset)[getattr(r, part)] for output, found, r
                           in zip(outputs, responses, recordings, strict=True)])


def _fitted(start: Servo, free: Sequence[str], recordings: Sequence[Recording]) -> Servo:
    """
    Return the servo with its `free` fields fitted, all but those of LINEAR on a logarithmic scale.

    A natural frequency above 1 rad per sample, or above that of the limits, is not identifiable.
    """
    period = min(r.period_s for r in recordings)
    bounds = {'pulsation': (-20.0, -math.log(period)), 'rate': (-40.0, 40.0),
              'damping': tuple(map(math.log, DAMPINGS)), 'acceleration': (-40.0, 40.0),
              'delay': (0.0, LONGEST_DELAY), 'lag': (0.0, LONGEST_DELAY), 'split': (0.0, 0.5)}
    if start.damping == LAG:    # of the time constant, 2 damping / pulsation
        bounds['pulsation'] = (-20.0, math.log(4.0 * LAG / period))

    def servo(x: Array) -> Servo:
        return start._replace(**{name: float(value) if name in LINEAR else math.exp(value)
                                 for name, value in zip(free, x, strict=True)})

    low, high = np.transpose([bounds[name] for name in free])
    x0 = [getattr(start, name) if name in LINEAR else math.log(getattr(start, name))
          for name in free]
    found = least_squares(
        lambda x: left_of(servo(x), recordings, 'fit'), np.clip(x0, low + 1e-9, high - 1e-9),
        bounds=(low, high), x_scale=[2.0 * period if name in LATE else 0.3 for name in free],
        diff_step=1e-3, max_nfev=40)
    return servo(found.x)


def _best_fitted(starts: Iterable[Servo], free: Sequence[str], recordings: Sequence[Recording]
                 ) -> Servo:
    """Return the best fit from several initial guesses."""
    return min(in_threads(lambda start: _fitted(start, free, recordings), starts),
               key=partial(_power, recordings=recordings, part='fit'))


def _power(servo: Servo, recordings: Sequence[Recording], part: str = 'held_out') -> float:
    """Return the mean square residual of a servo."""
    return float(np.mean(left_of(servo, recordings, part) ** 2))


def _best(recordings: Sequence[Recording], damping: float, free: Sequence[str]) -> Servo:
    """Return the best fit of a servo, from initial guesses without and with a delay."""
    period = max(r.period_s for r in recordings)
    faster = 2.0 * LAG if damping == LAG else 1.0
    power = partial(_power, recordings=recordings, part='fit')
    starts = [min((Servo(faster / (each * period), damping, delay=late * period)
                   for each in TIMES for late in lates), key=power)
              for lates in ((0.0,), (4.0, 20.0))]
    return _best_fitted(starts, free, recordings)


def slow_servo(recordings: Sequence[Recording]) -> Servo:
    """Return the fit of a delay with a lag of first order, as a servo."""
    return _best(recordings, LAG, ('pulsation', 'delay'))


def second_order(recordings: Sequence[Recording]) -> Servo:
    """Return the fit of a servo of second order with a delay."""
    return _best(recordings, DAMPING, ('pulsation', 'damping', 'delay'))


def error_of(servo: Servo, recordings: Sequence[Recording]) -> float:
    """Return a servo's residual on held-out parts (rms), if hardly more than noise; else inf."""
    left = math.sqrt(_power(servo, recordings))
    noise = max(r.noise['valve_position'] for r in recordings)
    return left if left < ALMOST * noise else math.inf


def servos_beside_an_effect(slow: Servo, recordings: Sequence[Recording]) -> list[Servo]:
    """
    Return servos of second order as late as one of first order that was fitted, and faster.

    What an effect hides may be late because of that effect, as friction delays a slow motion. One
    with limits that the recordings show is returned alone.
    """
    limited = _without_idle_limits(_limited(second_order(recordings), recordings), recordings)
    if limited.limited:
        return [limited]
    pulsation = 2.0 * DAMPING / slow.late_s
    return [Servo(faster * pulsation, DAMPING) for faster in HIDDEN]


def servo_of(recordings: Sequence[Recording], slow: Servo) -> list[Servo]:
    """
    Return servos of second order: with a delay, a lag of one pole, of two; the best one first.

    An empty list if following at once, or a delay with a lag of first order, explains the
    recordings about as well. slow: the fit of that.
    """
    recordings = thinned(recordings)
    power = partial(_power, recordings=recordings)
    left = [left_by([r.input for r in recordings], recordings, 'held_out'),
            left_of(slow, recordings, 'held_out')]
    simple = min(float(np.mean(each ** 2)) for each in left)
    delayed = second_order(recordings)
    one_pole = _lagging(delayed, recordings)
    two_poles = _lagging(delayed, recordings, one_pole)
    found = sorted((delayed, one_pole, two_poles), key=power)
    noise = max(r.noise['valve_position'] for r in recordings)
    if LEFT_UNLIMITED * power(found[0]) > noise ** 2:   # else there is nothing to explain
        limited = _without_idle_limits(_limited(delayed, recordings), recordings)
        if power(limited) < LEFT_UNLIMITED * power(found[0]):
            found = [limited]
    residual = left_of(found[0], recordings, 'held_out')
    ratio = simple / (float(np.mean(residual ** 2)) + 1e-300)
    gain = 0.5 * independent(residual, np.ones_like(residual)) * math.log(max(ratio, 1e-300))
    return found if gain > AGAINST else []


def _limited(delayed: Servo, recordings: Sequence[Recording]) -> Servo:
    """
    Return the best fit of a servo with limits and a delay.

    delayed: the fit of one without limits. Where a sample is long, the residual has a kink at each
    delay of whole samples, in which a fit stays: then each such delay is tried.
    """
    power = partial(_power, recordings=recordings, part='fit')
    period = max(r.period_s for r in recordings)
    speed = max(float(np.abs(np.diff(response_of(delayed, r))).max()) / r.period_s
                for r in recordings)
    starts = sorted((
        delayed._replace(pulsation=faster * delayed.pulsation, rate=rate * speed,
                         damping=damping, acceleration=rise * delayed.pulsation * speed)
        for faster in FASTER for damping in (delayed.damping, DAMPING)
        for rate in RATES for rise in RISES), key=power)[:FOLLOWED]
    best = _best_fitted(starts, (*LIMITED, 'delay'), recordings)
    if period * delayed.pulsation < COARSE:
        return best
    start = delayed._replace(pulsation=2.0 * delayed.pulsation, rate=0.7 * speed,
                             acceleration=0.5 * delayed.pulsation * speed)
    for late in range(MOST_LATE + 1):
        start = _fitted(start._replace(delay=late * period), LIMITED, recordings)
        if power(start) > WORSE * power(best):
            break
        best = min(best, start, key=power)
    return min(best, _fitted(best, (*LIMITED, 'delay'), recordings), key=power)


def _without_idle_limits(servo: Servo, recordings: Sequence[Recording]) -> Servo:
    """Return a servo without a limit that it hardly reaches: it tells nothing of its size."""
    power = partial(_power, recordings=recordings, part='fit')
    for name in ('acceleration', 'rate'):
        without = servo._replace(**{name: 0.0})
        free = [each for each in LIMITED if getattr(without, each) > 0.0]
        without = _fitted(without, (*free, 'delay'), recordings)
        if power(servo) >= LEFT_UNLIMITED * power(without):
            servo = without
    return servo


def _lagging(delayed: Servo, recordings: Sequence[Recording], one_pole: Servo | None = None
             ) -> Servo:
    """
    Return the best fit of a servo with a lag: of one pole, or of two, if the former is given.

    delayed: the fit of a servo with a delay, which has the same mean delay.
    """
    late = delayed.late_s
    split = LAG_SPLIT if one_pole else 0.0
    power = partial(_power, recordings=recordings, part='fit')
    starts = sorted((Servo(2.0 * damping / ((1.0 - share) * late), damping, lag=share * late,
                           split=split) for share in LAG_SHARES for damping in LAG_DAMPINGS),
                    key=power)[:FOLLOWED]
    if one_pole:
        starts.append(one_pole._replace(split=LEAST_SPLIT))
    free = ('pulsation', 'damping', 'lag', *['split'] * bool(split))
    return _best_fitted(starts, free, recordings)


def offset_of(recording: Recording) -> float:
    """Return by how much a servo's output is above its reference in the mean."""
    used = recording.known if recording.known.any() else recording.valid   # of one held out
    return float(np.mean((recording.output - recording.input)[used]))


def begins_moving(recording: Recording) -> bool:
    """Return whether a recording begins off its reference, or while the joint moves."""
    output = recording.output
    speed = np.gradient(output, recording.period_s)
    off = abs(float(output[0]) - float(recording.input[0]) - offset_of(recording))
    return bool(off > AWAY * np.std(output)
                or abs(float(speed[:FIRST].mean())) > MOVING * np.std(speed))


def settled(recording: Recording, servo: Servo) -> Recording:
    """
    Return a recording that begins where it is, if it begins amid a motion.

    Without the response to the reference before it, which is not known, and has decayed after a
    time.
    """
    if not begins_moving(recording):
        return recording
    slowest = max(servo.late_s, servo.delay + servo.lag + 1.0 / (servo.damping * servo.pulsation))
    count = min(math.ceil(DECAYED * slowest / recording.period_s),
                int(MOST_DECAYED * recording.fit.size))
    later = np.arange(recording.fit.size) >= count
    first = recording.output[:FIRST]
    _, rate, start = np.polyfit(recording.time_s[:first.size], first, 2)
    return replace(recording, begins=(float(start), float(rate)),
                   **{part: getattr(recording, part) & later
                      for part in ('fit', 'held_out', 'report')})


def thinned(recordings: Sequence[Recording], most: int = MOST_SAMPLES) -> list[Recording]:
    """Return recordings with at most so many samples, to fit a servo to."""
    every = math.ceil(sum(r.fit.size for r in recordings) / most)
    return [replace(r, period_s=every * r.period_s, command=r.input[::every],
                    valve_position=r.output[::every], fit=r.fit[::every],
                    held_out=r.held_out[::every], report=r.report[::every]) for r in recordings]


def response_of(servo: Servo, recording: Recording) -> Array:
    """Return the response of a servo to the command, from the measured initial state."""
    start, rate = recording.begins or (float(recording.output[0]), 0.0)
    # Of an offset there is no transient; `left_by` takes it off.
    return follow(servo, recording.input + offset_of(recording), start, recording.period_s, rate)
