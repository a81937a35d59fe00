"""Prepare runs for the diagnosis: uniform sampling, noise, motion, and parts of the data."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from scipy.signal import coherence, resample_poly, welch

from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.gap.parts import BURN_OUT_S, balanced_split, reported, split
from asi_analysis.measures.quality import check_size, check_time

Array = npt.NDArray[np.floating[Any]]
Mask = npt.NDArray[np.bool_]

SHORTEST_S = 1.0
MOST_MISSING = 0.05     # share of missing samples that is still bridged
LONGEST_BRIDGE = 3.0    # samples to the nearest one that was recorded: what is farther is left out
JUMPED = 0.1            # of its range: what a command changes by where a lost sample matters
MOST_JUMPED = 0.5       # share of a recording that is left out for that
PAD_S = 0.6             # mirrored on at both ends before a Fourier transform; half of it fades
# The motion is smoothed at this multiple of the band that is judged, or where its power is no more
# than this multiple of the noise's: friction and backlash act on all of the motion that there is.
SMOOTHING, OUTSTANDING = 2.5, 4.0
COHERENT = 0.95         # share of the power that motion and force have in common
LOWEST_BAND_HZ = 20.0
LEAST_BAND_HZ = 5.0     # of a joint whose motion hardly stands out of its noise
# A position that is an integral is judged above this, so gently that it does not ring for longer
# at the ends; nor for more than a share of a short recording.
LOWEST_INTEGRATED_HZ, RINGING_S, RINGING = 0.5, 1.0, 0.2
# A joint that is modelled as rigid is judged below this: gears and belts have their modes above.
RIGID_BAND_HZ = 40.0
JOINT_RATE_HZ = 1000.0  # a rigid joint's motion needs no more
REPEATED = 1e-6         # of its range: how far commands that are the same may differ
SMALL = 0.1             # of the usual step of a signal: with those it comes to rest
CLIPPED_SAMPLES = 4
CLIPPED = 0.005         # share of samples at an extreme, above which a signal is cut off there
SHARED = 0.3            # a signal with fewer values than this share of its samples is quantised
MEASURED = frozenset(('force', 'valve_position', 'position', 'velocity'))
AT_REST = 5.0           # standard deviations of a signal's noise: more is not 0
START_S = 0.02          # of a recording: its beginning
# How long a joint stands still at least, in which it would else move by a step of its encoder at
# this share of its usual speed; and most of a recording that is left out for that.
STANDS_S, SLOW, MOST_STANDS = 0.02, 0.1, 0.95
LEAST_RATIO = 0.25      # of a velocity to the derivative of its position, or its inverse
CLOSED_FORM = 70.0      # sum of the squared binomial weights 1, 4, 6, 4, 1


@dataclass(frozen=True)
class Motion:
    """
    The measured motion of the piston, for the load: extended by PAD_S at both ends.

    spectra are of the whole extended length; `smooth` is the gain by which they were smoothed,
    `judge` that of the band that is judged; `noise` is what white noise as strong everywhere as
    the velocity's is at each frequency would vary by.
    """

    omega: Array                 # rad/s
    position: Array              # m, smoothed
    velocity: Array              # m/s, smoothed
    acceleration: Array          # m/s2, of it
    position_spectrum: npt.NDArray[np.complexfloating[Any, Any]]
    velocity_spectrum: npt.NDArray[np.complexfloating[Any, Any]]
    smooth: Array
    judge: Array
    noise: Array                 # m2/s2
    pad: int                     # samples before the recording
    measured: bool               # false if the position was found by integration


@dataclass(frozen=True)
class Recording:
    """One bag, ready: arrays of n samples, `period_s` apart; None for signals not recorded."""

    source: str
    period_s: float
    command: Array | None        # N, or the unit of the position servo's reference
    force: Array | None          # N
    valve_position: Array | None   # m; of a position servo: its position
    velocity: Array | None       # m/s, measured, its slow part by the measured position
    motion: Motion | None
    force_judged: Array | None   # N, force within the band of the motion
    noise: dict[str, float]      # standard deviation of each signal's noise, by signal
    fit: Mask                    # samples to fit on
    held_out: Mask               # samples for model selection
    report: Mask                 # validation samples; only the reported result uses them
    number: int = 0              # whose values the fields of a recording have
    at_rest: bool = True     # begins at rest
    origin_m: float | None = None   # of the piston's position, if it starts at rest; taken off
    raw_velocity: Array | None = None   # m/s, as measured
    raw_position: Array | None = None   # m, as measured, from `origin_m`
    valve_estimate: Array | None = None   # m, measured valve position with less noise
    # By channel: what a shorter sub-step adds to the simulator's predictions with a longer one.
    corrections: dict[str, Array] = field(default_factory=dict)
    corrected_substep_s: float = 0.0
    # What the nominal model of a joint took off: gravity_sine and gravity_cosine Nm, constant N;
    # or the fields of its `Servo`.
    taken: Mapping[str, float] = field(default_factory=dict)
    cache: dict[Any, Any] = field(default_factory=dict)   # parts of predictions

    def sub_steps(self, longest_s: float) -> int:
        """Return into how many steps, none longer than `longest_s` s, a period is cut."""
        return max(1, math.ceil(self.period_s / longest_s - 1e-9))

    @property
    def known(self) -> Mask:
        """Return the samples that fits and choices may use: all but those of the report."""
        return self.fit | self.held_out

    @property
    def valid(self) -> Mask:
        """Return the samples at which the signals are valid, whatever they are used for."""
        return self.known | self.report

    @property
    def time_s(self) -> Array:
        """Return the time of each sample."""
        return self.period_s * np.arange(self.fit.size)


def noise_of(signal: Array) -> float:
    """
    Return the standard deviation of a signal's white noise.

    From the fourth differences, in which a smooth signal vanishes; the median, because jumps and
    corners are rare. At least that of the steps in which the signal comes.
    """
    white = float(np.median(np.abs(np.diff(signal, 4))) / 0.6745 / math.sqrt(CLOSED_FORM))
    levels = np.unique(signal)
    if 1 < levels.size < SHARED * signal.size:   # of an encoder: each value many times
        white = max(white, float(np.median(np.diff(levels))) / math.sqrt(12.0))
    return white


def clipped(signal: Array) -> Mask:
    """
    Return where a signal stands still at its largest or smallest value.

    A measured signal rarely repeats a value: frequent samples at its extreme are clipped, unless
    it comes there and leaves in small steps, as from rest to rest. A quantised signal cannot be
    checked.
    """
    cut = np.zeros(signal.size, bool)
    if np.unique(signal).size > SHARED * signal.size:
        steps = np.abs(np.diff(signal))
        least = SMALL * float(np.median(steps[steps > 0.0]))
        for extreme in (signal.max(), signal.min()):
            at = signal == extreme
            beside = steps[at[1:] != at[:-1]]
            often = at.sum() >= CLIPPED_SAMPLES and at.mean() > CLIPPED
            if often and beside.max(initial=0.0) > least:
                cut |= at
    return cut


def _bridged(name: str, values: Array, source: str) -> Array:
    """Return a signal with its missing samples bridged; refuse one that misses too many."""
    missing = ~np.isfinite(values)
    if missing.mean() > MOST_MISSING:
        raise InputError(f'{source}: signal {name} misses {100 * missing.mean():.0f} % of its '
                         f'samples (NaN or infinite); at most {100 * MOST_MISSING:.0f} % can be '
                         'bridged')
    if not missing.any():
        return values
    index = np.arange(values.size)
    return np.interp(index, index[~missing], values[~missing])


def uniform(run: Run) -> tuple[float, dict[str, Array]]:
    """Return the period (s) and the signals at equal distances in time."""
    time = run.time_s
    if len(run) < 2 or run.duration_s < SHORTEST_S * (1.0 - 1e-6):
        raise InputError(f'{run.source}: too short for a diagnosis: {run.duration_s:.2f} s, it '
                         f'takes at least {SHORTEST_S:g} s')
    back = np.flatnonzero(np.diff(time) <= 0.0)
    if back.size:
        raise InputError(f'{run.source}: time does not rise at sample {int(back[0]) + 2}')
    check_time(time, run.source)
    check_size(run)
    steps = round((time[-1] - time[0]) / run.period_s)
    period = float((time[-1] - time[0]) / steps)
    even = time[0] + period * np.arange(steps + 1)
    # Samples that are all there, late by a little at most, are taken as they come.
    complete = len(run) == steps + 1 and np.abs(time - even).max() < period
    signals = {}
    for name, values in run.signals().items():
        whole = _bridged(name, np.asarray(values, float), run.source)
        if complete:
            signals[name] = whole
        elif name in ('command', 'reference'):   # held from sample to sample
            before = np.searchsorted(time, even + 1e-6 * period, side='right') - 1
            signals[name] = whole[np.clip(before, 0, None)]
        else:
            signals[name] = np.interp(even, time, whole)
    return period, signals


def recorded(run: Run, drive: str, period: float, count: int) -> Mask:
    """
    Return at which of `count` samples, `period` s apart, no signal has a long gap.

    Interpolation over a long gap holds no information. Where a command jumped in a single missing
    sample, the time of the jump is unknown: left out too, unless too little data would remain.
    """
    even = run.time_s[0] + period * np.arange(count)
    far, jumps = np.zeros((2, count), bool)
    for name, values in run.signals().items():
        known = run.time_s[np.isfinite(values)]
        if known.size > 1 and (name != 'reference' or drive == 'position'):
            after = np.clip(np.searchsorted(known, even), 1, known.size - 1)
            distance = np.minimum(np.abs(even - known[after - 1]), np.abs(known[after] - even))
            far |= distance > LONGEST_BRIDGE * max(period, run.period_s)
            if name in ('command', 'reference'):
                there = values[np.isfinite(values)]
                jumped = np.abs(np.diff(there)) > JUMPED * np.ptp(there)
                lost = np.diff(known) > 1.5 * max(period, run.period_s)
                jumps |= (jumped & lost)[after - 1] & (distance > 0.25 * period)
    about = np.ones(2 * int(BURN_OUT_S / period) + 1)
    plain, careful = (np.convolve(out, about)[about.size // 2:][:count] < 0.5
                      for out in (far, far | jumps))
    return careful if careful.mean() > 1.0 - MOST_JUMPED else plain


def extended(values: Array, pad: int, reflect_type: Literal['even', 'odd'] = 'odd') -> Array:
    """
    Return the values with `pad` mirrored ones at both ends, without a jump where these wrap round.

    odd: value and slope go on. The outer half of both ends fades to the same value: a jump there
    rings in all derivatives.
    """
    longer = np.pad(values, pad, 'reflect', reflect_type=reflect_type)
    fade = np.ones(longer.size)
    outer = pad // 2
    fade[:outer] = 0.5 - 0.5 * np.cos(np.pi * np.arange(outer) / max(outer, 1))
    fade *= fade[::-1]
    middle = 0.5 * (values[0] + values[-1])
    return np.asarray(middle + fade * (longer - middle))


def low_pass(frequency: Array, corner: float) -> Array:
    """Return the gain of a fourth-order Butterworth filter run forwards and backwards."""
    return 1.0 / (1.0 + (frequency / corner) ** 8)


def _band(motion: Array, force: Array, period: float) -> float:
    """
    Return the frequency (Hz) up to which a motion and its force belong together.

    There their coherence is above COHERENT; beyond, noise prevails and what no rigid load does.
    """
    rate = 1.0 / period
    frequency, shared = coherence(motion, force, rate, nperseg=max(min(motion.size // 4, 2048), 2),
                                  detrend='linear')
    width = min(max(1, int(5.0 / frequency[1])), shared.size)
    smooth = np.convolve(shared, np.ones(width) / width, 'same')
    above = frequency[smooth > COHERENT]
    return float(np.clip(above[-1] if above.size else 0.0, LOWEST_BAND_HZ, 0.2 * rate))


def _told(motion: Array, period: float) -> float:
    """
    Return the frequency (Hz) up to which a measured motion of a joint stands out of its noise.

    Beyond, a controller makes the force of that noise: both are coherent, but the joint has not
    moved so.
    """
    frequency, power = welch(motion, 1.0 / period, nperseg=min(motion.size // 4, 2048))
    level = 2.0 * period * noise_of(motion) ** 2
    above = frequency[power > OUTSTANDING * level]
    return max(float(above[-1]) if above.size else 0.0, LEAST_BAND_HZ)


def _clear(velocity: Array, omega: Array, noise: Array, period: float) -> float:
    """
    Return the frequency (Hz) up to which a velocity (m/s) stands out of its noise.

    noise: its variance, if it were as strong everywhere, at each omega (rad/s).
    """
    frequency, power = welch(velocity, 1.0 / period, nperseg=min(velocity.size // 4, 1024))
    level = 2.0 * period * np.interp(2.0 * np.pi * frequency, omega, noise)
    above = frequency[power > OUTSTANDING * level]
    return float(above[-1]) if above.size else 0.0


def agree(position: Array, velocity: Array, period: float) -> bool:
    """Return whether a velocity may be the derivative of a position, whatever its noise."""
    return LEAST_RATIO < velocity_over_derivative(position, velocity, period) < 1.0 / LEAST_RATIO


def velocity_over_derivative(position: Array, velocity: Array, period: float) -> float:
    """Return a velocity over the derivative of a position; 1 if uncorrelated."""
    moved = np.gradient(position, period)
    if np.std(moved) == 0.0 or np.std(velocity) == 0.0:
        return 1.0
    rough = np.convolve(moved, np.ones(9) / 9, 'same')
    smooth = np.convolve(velocity, np.ones(9) / 9, 'same')
    if np.corrcoef(rough, smooth)[0, 1] ** 2 < 0.5:
        return 1.0
    return float(smooth @ smooth / (rough @ smooth))


def _motion(position: Array | None, velocity: Array | None, band: float,
            period: float) -> tuple[Motion | None, Array | None]:
    """
    Return the motion of the load from its measured position, velocity or both.

    band: frequency (Hz) up to which it is judged.

    Also the velocity (m/s) whose integral is the measured position; None if not measured.
    """
    source = velocity if velocity is not None else position
    if source is None:
        return None, None
    pad = min(int(PAD_S / period), source.size - 2)
    count = source.size + 2 * pad
    frequency = np.fft.rfftfreq(count, period)
    omega = 2.0 * np.pi * frequency
    if velocity is None:
        assert position is not None
        # If the ends differ, the extended signal jumps where it wraps round, which rings.
        line = np.linspace(position[0], position[-1], position.size)
        v = 1j * omega * np.fft.rfft(extended(position - line, pad))
        v[0] = count * (line[1] - line[0]) / period
        noise = (omega * noise_of(position)) ** 2
    else:
        v = np.fft.rfft(extended(velocity, pad, 'even'))
        noise = np.full_like(omega, noise_of(velocity) ** 2)
        if position is not None:
            # Each by its noise: slow motion from the position, fast motion from the velocity.
            slow = noise / ((omega * noise_of(position)) ** 2 + noise + 1e-300)
            v += slow * np.fft.rfft(extended(np.gradient(position, period) - velocity, pad,
                                             'even'))
            noise = (1.0 - slow) * noise
    # The mean velocity is a line, extended at both ends as the force of a spring is.
    x = np.fft.rfft(extended(v[0].real / count * period * np.arange(source.size), pad))
    x[1:] += v[1:] / (1j * omega[1:])
    found = np.fft.irfft(v, count)[pad:-pad]
    if position is not None:
        x[0] += count * np.mean(position - np.fft.irfft(x, count)[pad:-pad])
    fused = found if velocity is not None else None
    corner = max(SMOOTHING * band, _clear(found, omega, noise, period))
    smooth = low_pass(frequency, min(corner, 0.45 / period))
    x, v = x * smooth, v * smooth
    judge = low_pass(frequency, band)
    if position is None:   # what an integral adds up at low frequency says nothing
        judge = judge * (1.0 - np.exp(-(frequency / LOWEST_INTEGRATED_HZ) ** 2))
    return Motion(omega, np.fft.irfft(x, count), np.fft.irfft(v, count),
                  np.fft.irfft(1j * omega * v, count), x, v, smooth, judge, noise, pad,
                  position is not None), fused


def judged(values: Array, motion: Motion) -> Array:
    """Return a recorded signal within the band of the motion that is judged."""
    spectrum = np.fft.rfft(extended(values, motion.pad)) * motion.judge
    count = values.size + 2 * motion.pad
    return np.fft.irfft(spectrum, count)[motion.pad:motion.pad + values.size]


def velocity_of(recording: Recording) -> Array | None:
    """Return the velocity (m/s), measured or from the position; None without either."""
    motion = recording.motion
    if recording.velocity is not None or motion is None:
        return recording.velocity
    return motion.velocity[motion.pad:motion.pad + recording.fit.size]


def _stands(position: Array, period: float, band: float) -> Mask:
    """
    Return the samples in which a joint stands still, and those near them by the band (Hz).

    Friction then holds any force up to its level, which no motion tells. None, if its encoder is
    too coarse to tell a standstill from a slow motion.
    """
    moves = np.diff(position)
    still = np.zeros(position.size, bool)
    steps = np.abs(moves[moves != 0.0])
    if not steps.size or float(np.median(steps)) > SLOW * STANDS_S * float(np.std(moves)) / period:
        return still
    edges = np.concatenate([[0], np.flatnonzero(moves) + 1, [position.size]])
    for first, last in itertools.pairwise(edges):
        if (last - first) * period >= STANDS_S:
            still[first:last] = True
    reach = round(0.5 / (band * period))
    near = np.convolve(still, np.ones(2 * reach + 1), 'same') > 0.0
    return near if near.mean() < MOST_STANDS else np.zeros_like(still)


def _ends(count: int, period: float) -> Mask:
    """Return the samples at both ends of a recording in which a high-pass still rings."""
    time = period * np.arange(count)
    return np.minimum(time, time[::-1]) < min(RINGING_S, RINGING * time[-1])


def _origin(signals: Mapping[str, Array], period: float) -> float | None:
    """
    Return the position (m) at which a piston starts at rest, 0 within the noise; None if it moves.

    A sensor may count from anywhere: at rest and without force, the load's spring is relaxed.
    """
    if 'position' not in signals:
        return None
    position = signals['position']
    level = AT_REST * noise_of(position)
    # Not whether the position changes at once: a push from outside may begin with the recording.
    rests = [np.abs(signals[name]) <= AT_REST * noise_of(signals[name])
             for name in ('force', 'velocity', 'valve_position') if name in signals]
    if not rests or not all(rest[0] for rest in rests):
        return None
    rests.append(np.abs(position - position[0]) <= level)
    still = int(np.argmin(np.all(rests, axis=0)))   # samples before the first that moves
    origin = float(position[:max(still // 2, 1)].mean())
    return origin if abs(origin) > level else 0.0


def _begins_at_rest(signals: Mapping[str, Array], period: float) -> bool:
    """Return whether valve, piston and force stand still at the start, within their noise."""
    count = max(int(START_S / period), 2)
    position = signals.get('position')
    if position is not None and np.ptp(position[:count]) > 2.0 * AT_REST * noise_of(position):
        return False
    return all(abs(values[:count].mean()) <= AT_REST * noise_of(values) / math.sqrt(count)
               for name, values in signals.items() if name in ('force', 'velocity',
                                                               'valve_position'))


def _centre(signals: dict[str, Array], drive: str, run: Run) -> None:
    """Move the origin of a joint's coordinate, which is arbitrary, to the middle of its motion."""
    if drive == 'position' and run.controlled() == 'position' and 'reference' in signals:
        origin = signals['reference'].mean()
        for name in {'reference', 'position'} & signals.keys():
            signals[name] = signals[name] - origin
    elif drive == 'force' and 'position' in signals:
        signals['position'] = signals['position'] - signals['position'].mean()


def _signals(run: Run, drive: str) -> tuple[float, dict[str, Array], float | None]:
    """
    Return the period (s) and the signals that move, under the names of the diagnosis.

    And the position (m) at which a piston starts at rest, from which its position then counts.
    """
    period, signals = uniform(run)
    thinned = int(1.0 / (JOINT_RATE_HZ * period) + 0.5)
    if drive == 'force' and thinned > 1:
        signals = {name: resample_poly(values, 1, thinned, padtype='line')
                   for name, values in signals.items()}
        period *= thinned
    origin = _origin(signals, period) if drive == 'valve' else None
    if origin is not None:
        signals['position'] = signals['position'] - origin
    _centre(signals, drive, run)
    named = {name: signals.get(name)
             for name in ('command', 'force', 'valve_position', 'position', 'velocity')}
    if drive == 'force':
        driving = named['command'] if named['force'] is None else named['force']
        named = {**named, 'force': driving, 'command': None, 'valve_position': None}
    elif drive == 'position':
        named = {'command': signals.get('reference'),
                 'valve_position': signals.get(run.controlled())}
    elif drive == 'drive':
        named = {'command': named['command'], 'valve_position': named['force']}
    moving = {name: values for name, values in named.items()
              if values is not None and np.ptp(values) > 0.0}
    if {'position', 'velocity'} <= set(moving) and not agree(
            moving['position'], moving['velocity'], period):
        del moving['velocity']   # it is of something else
    if not {'command', 'valve_position'} <= set(moving) and (
            'force' not in moving or len(moving) < 2):
        raise InputError(f'{run.source}: nothing to compare: it takes a command and what follows '
                         'from it, or a force and a motion; signals that move here: '
                         + (', '.join(name for name, values in signals.items()
                                      if np.ptp(values) > 0.0) or 'none'))
    return period, moving, origin


def prepare(runs: Sequence[Run], drive: str = 'valve',
            held_out: Sequence[bool] | None = None) -> list[Recording]:
    """
    Return runs ready for the diagnosis; those with `held_out` are not used in fits.

    drive: what the command is: 'valve' (the hydraulic actuator), 'force' (a joint whose force or
    torque is commanded or measured), 'position' (a joint that follows a position, velocity or
    force), 'drive' (what makes a joint's force of its command).
    Raises InputError if one is too short, misses too many samples or holds nothing to compare.
    """
    read = [_signals(run, drive) for run in runs]
    moved = [(moving['velocity' if 'velocity' in moving else 'position'], moving['force'], period)
             for period, moving, _ in read
             if 'force' in moving and ('velocity' in moving or 'position' in moving)]
    bands = [_band(motion, force, period) for motion, force, period in moved]
    if drive == 'force':
        bands += [RIGID_BAND_HZ, *(_told(motion, period) for motion, _, period in moved)]
    recordings: list[Recording] = []
    whole = held_out if held_out is not None and any(held_out) else None
    for number, (run, (period, moving, origin)) in enumerate(zip(runs, read, strict=True)):
        motion, velocity = None, moving.get('velocity')
        if moved and 'force' in moving:
            motion, velocity = _motion(moving.get('position'), velocity, min(bands), period)
        force = moving.get('force')
        driving = next(iter(moving.values()))
        fit, held = (split(driving.size, period) if drive == 'valve' else
                     balanced_split(driving, period))
        valid = recorded(run, drive, period, fit.size)
        if motion is not None and not motion.measured:
            valid = valid & ~_ends(fit.size, period)
        if drive == 'force' and motion is not None and 'position' in moving:
            valid = valid & ~_stands(moving['position'], period, min(bands))
        # What is cut off was not measured; but a valve may rest against a stop.
        for name in (MEASURED - {'valve_position'}) & moving.keys():
            valid = valid & ~clipped(moving[name])
        # Where whole recordings are held out, the result is reported on those alone.
        report = (np.zeros_like(fit) if whole else reported(held)) & valid
        fit, held = fit & valid, held & valid & ~report
        if whole and whole[number]:
            fit, held, report = np.zeros_like(fit), np.zeros_like(fit), fit | held
        recordings.append(Recording(
            source=run.source, period_s=period, command=moving.get('command'), force=force,
            valve_position=moving.get('valve_position'), velocity=velocity,
            raw_velocity=moving.get('velocity'), raw_position=moving.get('position'),
            motion=motion, at_rest=_begins_at_rest(moving, period), origin_m=origin,
            force_judged=judged(force, motion) if force is not None and motion else None,
            noise={name: noise_of(values) for name, values in moving.items()},
            fit=fit, held_out=held, report=report,
            number=sum(bool(r.fit.any()) for r in recordings) if fit.any() else 0))
    if not all(any(part(each).any() for each in recordings)
               for part in (lambda r: r.fit, lambda r: r.held_out, lambda r: r.report)):
        raise InputError(f'{", ".join(each.source for each in recordings)}: too few samples are '
                         'left: the others are lost or clipped, or next to such ones')
    return _with_repeats(recordings)


def _with_repeats(recordings: list[Recording]) -> list[Recording]:
    """
    Return recordings whose noise is at least that between runs with the same command.

    No model explains their difference, which holds slow noise too; each run has half its power.
    """
    noisier = list(recordings)
    for i, first in enumerate(recordings):
        for second in recordings[:i]:
            if not _same_command(first, second):
                continue
            valid = first.valid & second.valid
            for name in ('force', 'valve_position', 'velocity'):
                one, other = getattr(first, name), getattr(second, name)
                if one is not None and other is not None:
                    level = float(np.std((one - other)[valid])) / math.sqrt(2.0)
                    noisier = [replace(r, noise=r.noise | {name: max(r.noise[name], level)})
                               if name in r.noise else r for r in noisier]
    return noisier


def _same_command(first: Recording, second: Recording) -> bool:
    a, b = first.command, second.command
    return (a is not None and b is not None and a.size == b.size
            and bool(np.abs(a - b).max() <= REPEATED * np.ptp(a)))
