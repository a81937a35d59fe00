"""
The servo of a joint that follows a reference: second order, with limits of speed and acceleration.

    a = clip(w^2 (r - x) - 2 d w v, ± acceleration),  v = clip(v, ± rate)

It is the nominal model where it leaves far less than what a delay and a lag of first order leave.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import lfilter

from asi_analysis.arrays import Array
from asi_analysis.gap.prepare import Recording
from asi_common.jit import jit

# Share of the held-out power that a delay and a lag leave, below which a second order is taken;
# and of that of the unlimited servo, below which its limits are.
LEFT_BY_LAG: Final = 0.5
LEFT_UNLIMITED: Final = 0.7
ALMOST: Final = 3.0           # times the noise (rms) of the output
NOISE: Final = 1.5            # of the output's noise power: what is below it needs no model
# Angle of the fastest motion in one sub-step, rad, and most sub-steps of a sample.
SUB_STEP: Final = 0.02
MOST_SUB_STEPS: Final = 64
# Starts: times of the response, in samples, and damping ratio.
TIMES: Final = (1.5, 5.0, 15.0, 50.0, 150.0)
DAMPING: Final = 0.8
DAMPINGS: Final = (0.05, 3.0)
LAG: Final = 20.0             # a damping ratio at which a servo is a lag of first order
LONGEST_DELAY: Final = 1.0    # s
LATE: Final = ('delay', 'lag')
TOLERANCE: Final = 0.2        # of the gain
LAG_SPLIT: Final = 0.35       # share of the second pole of a lag
FASTER: Final = (2.0, 4.0)    # times as fast as beside a delay is a servo beside a lag
# Samples of all recordings that are used; of longer ones every second, third ...
MOST_SAMPLES: Final = 20_000


class Servo(NamedTuple):
    """
    Frequency rad/s, damping ratio, largest rate and acceleration (inf: none), delay and lag s.

    Rate and acceleration in units of the reference over s and s2. The lag has two poles.
    """

    pulsation: float
    damping: float
    rate: float = math.inf
    acceleration: float = math.inf
    delay: float = 0.0
    lag: float = 0.0

    @property
    def limited(self) -> bool:
        """Return whether rate or acceleration are limited."""
        return math.isfinite(self.rate) or math.isfinite(self.acceleration)


@jit
def _follow(reference, start, period, steps, pulsation, damping, rate, acceleration, out):
    step = period / steps
    position, speed = start, 0.0
    for k in range(reference.size):
        out[k] = position
        for _ in range(steps):
            push = pulsation * pulsation * (reference[k] - position)
            # The damping is implicit, so that no sub-step overshoots.
            wanted = (speed + step * push) / (1.0 + 2.0 * step * damping * pulsation)
            change = min(max(wanted - speed, -step * acceleration), step * acceleration)
            speed = min(max(speed + change, -rate), rate)
            position += step * speed


def follow(servo: Servo, reference: Array, start: float, period: float) -> Array:
    """Return what a servo makes of a reference held for a period (s), from rest at `start`."""
    time = period * np.arange(reference.size)
    late = np.interp(time - servo.delay, time, reference) if servo.delay else reference
    for share in (LAG_SPLIT, 1.0 - LAG_SPLIT) if servo.lag else ():
        keep = math.exp(-period / (share * servo.lag))
        late = lfilter([1.0 - keep], [1.0, -keep], late, zi=[keep * start])[0]
    steps = min(max(math.ceil(period * servo.pulsation / SUB_STEP), 1), MOST_SUB_STEPS)
    out = np.empty_like(reference)
    _follow(np.ascontiguousarray(late), start, period, steps, *servo[:4], out)
    return out


def left_of(servo: Servo, recordings: Sequence[Recording], part: str) -> Array:
    """Return what a servo leaves of the output."""
    return left_by([_response(servo, r) for r in recordings], recordings, part)


def left_by(responses: Sequence[Array], recordings: Sequence[Recording], part: str) -> Array:
    """Return what responses leave, but for a gain near 1 and an offset, by the fitted parts."""
    outputs = [r.valve_position for r in recordings if r.valve_position is not None]
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
    Return the servo with its `free` fields fitted, all but the delay by their logarithm.

    Above a natural frequency of a radian a sample, or of the limits, nothing is told apart.
    """
    period = min(r.period_s for r in recordings)
    bounds = {'pulsation': (-20.0, -math.log(period)), 'rate': (-40.0, 40.0),
              'damping': tuple(map(math.log, DAMPINGS)), 'acceleration': (-40.0, 40.0),
              'delay': (0.0, LONGEST_DELAY), 'lag': (0.0, LONGEST_DELAY)}
    if start.damping == LAG:    # of the time constant, 2 damping / pulsation
        bounds['pulsation'] = (-20.0, math.log(4.0 * LAG / period))

    def servo(x: Array) -> Servo:
        return start._replace(**{name: float(value) if name in LATE else math.exp(value)
                                 for name, value in zip(free, x, strict=True)})

    low, high = np.transpose([bounds[name] for name in free])
    x0 = [getattr(start, name) if name in LATE else math.log(getattr(start, name))
          for name in free]
    found = least_squares(
        lambda x: left_of(servo(x), recordings, 'fit'), np.clip(x0, low + 1e-9, high - 1e-9),
        bounds=(low, high), x_scale=[2.0 * period if name in LATE else 0.3 for name in free],
        diff_step=1e-3, max_nfev=40)
    return servo(found.x)


def _power(servo: Servo, recordings: Sequence[Recording], part: str = 'held_out') -> float:
    return float(np.mean(left_of(servo, recordings, part) ** 2))


def _best(recordings: Sequence[Recording], damping: float, free: Sequence[str]) -> Servo:
    """Return the servo fitted from the best of fast and slow ones, without a delay and with."""
    period = max(r.period_s for r in recordings)
    faster = 2.0 * LAG if damping == LAG else 1.0

    def power(each: Servo) -> float:
        return _power(each, recordings, 'fit')

    starts = [min((Servo(faster / (each * period), damping, delay=late * period)
                   for each in TIMES for late in lates), key=power)
              for lates in ((0.0,), (4.0, 20.0))]
    return min((_fitted(each, free, recordings) for each in starts), key=power)


def slow_servo(recordings: Sequence[Recording]) -> Servo:
    """Return a delay and a lag of first order, as a servo, fitted."""
    return _best(recordings, LAG, ('pulsation', 'delay'))


def second_order(recordings: Sequence[Recording]) -> Servo:
    """Return a servo of second order with a delay, fitted."""
    return _best(recordings, DAMPING, ('pulsation', 'damping', 'delay'))


def error_of(servo: Servo, recordings: Sequence[Recording]) -> float:
    """Return what a servo leaves of held-out parts (rms), if that is hardly more than noise."""
    left = math.sqrt(_power(servo, recordings))
    noise = max(r.noise['valve_position'] for r in recordings)
    return left if left < ALMOST * noise else math.inf


def servo_of(recordings: Sequence[Recording], slow: Servo) -> list[Servo]:
    """
    Return servos of second order: the one that recordings need, and others much like it.

    Some have a delay and some a lag; none if these alone leave about as little. slow: these,
    fitted.
    """
    recordings = thinned(recordings)
    at_once = float(np.mean(left_by([r.command for r in recordings if r.command is not None],
                                     recordings, 'held_out') ** 2))
    simple = min(at_once, _power(slow, recordings))
    if simple < NOISE * max(r.noise['valve_position'] for r in recordings) ** 2:
        return []
    delayed = second_order(recordings)
    lagging = [_fitted(each, ('pulsation', 'damping', 'lag'), recordings)
               for each in _with_lag(delayed)]
    behind = min(lagging, key=lambda each: _power(each, recordings))
    second, other = sorted((delayed, behind), key=lambda each: _power(each, recordings))
    speed = max(float(np.abs(np.diff(_response(delayed, r))).max()) / r.period_s
                for r in recordings)
    limited = _fitted(delayed._replace(rate=0.7 * speed,
                                       acceleration=0.5 * delayed.pulsation * speed),
                      [name for name in Servo._fields if name != 'lag'], recordings)
    unlimited = _power(second, recordings)
    found = ([limited] if _power(limited, recordings) < LEFT_UNLIMITED * unlimited else
             [second, other, *_with_lag(delayed)])
    return found if _power(found[0], recordings) < LEFT_BY_LAG * simple else []


def _with_lag(delayed: Servo) -> Iterator[Servo]:
    """Yield servos with a lag that are much like one with a delay."""
    for faster in FASTER:
        yield delayed._replace(pulsation=faster * delayed.pulsation, delay=0.0,
                               lag=delayed.delay + 1.0 / delayed.pulsation)
    if delayed.damping > 1.0:   # its slow pole is the lag; the other and the delay are the servo
        root = math.sqrt(delayed.damping ** 2 - 1.0)
        slow, fast = ((delayed.damping + way * root) / delayed.pulsation for way in (1.0, -1.0))
        yield delayed._replace(pulsation=2.0 * DAMPING / (fast + delayed.delay), damping=DAMPING,
                               delay=0.0, lag=slow)


def thinned(recordings: Sequence[Recording]) -> list[Recording]:
    """Return the samples of recordings that a servo is fitted to."""
    every = math.ceil(sum(r.fit.size for r in recordings) / MOST_SAMPLES)
    return [_thinned(r, every) for r in recordings]


def _thinned(r: Recording, every: int) -> Recording:
    """Return every so many samples of what a servo is fitted to."""
    assert r.command is not None and r.valve_position is not None
    return replace(r, period_s=every * r.period_s, command=r.command[::every],
                   valve_position=r.valve_position[::every], fit=r.fit[::every],
                   held_out=r.held_out[::every])


def _response(servo: Servo, recording: Recording) -> Array:
    assert recording.command is not None and recording.valve_position is not None
    return follow(servo, recording.command, float(recording.valve_position[0]),
                  recording.period_s)


def with_servo(recordings: list[Recording], unit: str, servo: Servo | None
               ) -> tuple[list[Recording], list[str]]:
    """
    Return recordings whose command is what a servo with limits makes of it, and notes.

    Its delay is left to the effects. servo: None, if a delay and a lag do. One without limits is
    left to the fit.
    """
    if servo is None:
        return recordings, []
    note = (f'the servo is of second order: {servo.pulsation / (2.0 * math.pi):.4g} Hz, damping '
            f'ratio {servo.damping:.3g}')
    if not servo.limited:
        return recordings, [f'{note}, where the fit begins']
    at_once = servo._replace(delay=0.0, lag=0.0)
    limits = [f'{word} of at most {value:.4g} {unit}/{seconds}' for word, value, seconds in (
        ('a rate', servo.rate, 's'), ('an acceleration', servo.acceleration, 's2'))
        if math.isfinite(value)]
    # A command acts from its sample on: at the next one the ideal servo has it.
    moved = [np.append((found := _response(at_once, r))[1:], found[-1]) for r in recordings]
    return ([replace(r, command=each, taken=at_once._asdict())
             for r, each in zip(recordings, moved, strict=True)], [', '.join((note, *limits))])
