"""Prepare runs for the diagnosis: the signals that it compares, and parts of the data."""

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.fft import next_fast_len
from scipy.signal import resample_poly

from asi_analysis.arrays import Array, Mask
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.gap.motion import (
    Motion,
    agree,
    common_band,
    ends,
    first_of,
    judged,
    motion_of,
    stands,
    steady_band,
)
from asi_analysis.gap.parts import balanced_split, reported, split
from asi_analysis.gap.sampling import clipped, noise_of, recorded, uniform
from asi_analysis.parallel import cores

LEAST_BAND_HZ = 5.0     # of a joint whose motion is hardly above its noise
# A rigid model of a joint is compared below this: gears and belts have their modes above.
RIGID_BAND_HZ = 40.0
JOINT_RATE_HZ = 1000.0  # sufficient for a rigid joint: faster recordings are resampled
SAME_COMMAND = 1e-6         # of its range: how far commands that are the same may differ
MEASURED = frozenset(('force', 'valve_position', 'position', 'velocity'))
REST = ('force', 'velocity', 'valve_position')   # signals that are 0 at rest
AT_REST = 5.0           # a signal is 0 within so many standard deviations of its noise
START_S = 0.02          # length of the beginning of a recording
LEAST_PART_S = 1.0      # of a recording that is fitted by itself
# The most parts of predictions that are cached, of each kind (two for each thread), and bytes.
CACHE_SIZE, CACHE_BYTES = 2 + 2 * cores(), 2 ** 28


@dataclass(frozen=True)
class Recording:
    """One bag, ready: arrays of n samples, `period_s` apart; None for signals not recorded."""

    source: str
    period_s: float
    command: Array | None        # N, or the unit of the position servo's reference
    force: Array | None          # N
    valve_position: Array | None   # m; of a position servo: its position
    velocity: Array | None       # m/s, measured; below some frequency from the position
    motion: Motion | None
    force_judged: Array | None   # N, force, filtered to the band of the motion
    noise: dict[str, float]      # standard deviation of each signal's noise, by signal
    fit: Mask                    # samples to fit on
    held_out: Mask               # samples for model selection
    report: Mask                 # validation samples; only the reported result uses them
    number: int = 0              # of the values of `OF_A_RECORDING` that belong to it
    at_rest: bool = True         # begins at rest
    begins: tuple[float, float] | None = None   # position and rate of a servo that does not
    origin_m: float | None = None   # piston position at rest, subtracted; None: not at rest
    raw_velocity: Array | None = None   # m/s, as measured
    raw_position: Array | None = None   # m, as measured, from `origin_m`
    valve_estimate: Array | None = None   # m, measured valve position with less noise
    # Of noise that is not white, the coefficients of its autoregression, by signal.
    colour: dict[str, tuple[float, ...]] = field(default_factory=dict)
    # Of the valve's errors, if the delay of the command is uneven: their mean, m, and what makes
    # their noise white.
    uneven_mean: Array | None = None
    uneven_delay: Array | None = None
    # Integration error of the simulator's predictions, by channel: to be added to those with this
    # sub-step.
    corrections: dict[str, Array] = field(default_factory=dict)
    corrected_substep_s: float = 0.0
    # What each error of the valve's fit, of a standard deviation, changes of the simulator's
    # predictions behind it: n x k, by channel.
    valve_errors: dict[str, Array] = field(default_factory=dict)
    # What was removed: reference of a servo m; by the nominal model of a joint gravity_sine and
    # gravity_cosine Nm, constant N.
    taken: Mapping[str, float] = field(default_factory=dict)
    cache: dict[str, dict[Hashable, Array]] = field(default_factory=dict)   # by kind and key

    def sub_steps(self, longest_s: float) -> int:
        """Return the number of equal sub-steps of a period, each at most `longest_s` s."""
        return max(1, math.ceil(self.period_s / longest_s - 1e-9))

    def cached(self, kind: str, key: Hashable, make: Callable[[], Array]) -> Array:
        """Return a part of a prediction; from the cache, if it was made with this key before."""
        parts = self.cache.setdefault(kind, {})   # several threads use it: each step is atomic
        part: Array | None = parts.pop(key, None)
        if part is None:
            part = make()
        parts[key] = part   # the latest last
        for old in list(parts)[:-min(CACHE_SIZE, max(CACHE_BYTES // part.nbytes, 1))]:
            parts.pop(old, None)
        return part

    @property
    def input(self) -> Array:
        """Return the command, of a recording that holds one."""
        assert self.command is not None
        return self.command

    @property
    def output(self) -> Array:
        """Return the valve position: of a servo or a characteristic, what it answers."""
        assert self.valve_position is not None
        return self.valve_position

    @property
    def moved(self) -> Motion:
        """Return the motion, of a recording that holds one."""
        assert self.motion is not None
        return self.motion

    @cached_property
    def known(self) -> Mask:
        """Return the samples for fits and model selection: all but the validation samples."""
        return self.fit | self.held_out

    @cached_property
    def valid(self) -> Mask:
        """Return the samples at which all signals are valid, for whatever use."""
        return self.known | self.report

    @property
    def time_s(self) -> Array:
        """Return the time of each sample."""
        return self.period_s * np.arange(self.fit.size)


def first_of_recording(recording: Recording, share: float) -> Recording:
    """Return the first share of a recording; at least LEAST_PART_S, if it is that long."""
    size, motion = recording.fit.size, recording.motion
    count = min(max(int(share * size), int(LEAST_PART_S / recording.period_s)), size)
    if motion is not None:   # a Fourier transform of few prime factors is fast
        pads = 2 * motion.pad
        count = min(next_fast_len(count + pads, real=True) - pads, size)

    def first(values: Any) -> Any:
        return values[:count] if isinstance(values, np.ndarray) else values

    cut = {each.name: first(getattr(recording, each.name)) for each in fields(recording)}
    return replace(
        recording, **cut | {
            'cache': {}, 'motion': motion and first_of(motion, count, recording.period_s),
            **{name: {channel: first(each) for channel, each in getattr(recording, name).items()}
               for name in ('corrections', 'valve_errors')}})


def velocity_of(recording: Recording) -> Array | None:
    """Return the velocity (m/s), measured or from the position; None without either."""
    motion = recording.motion
    if recording.velocity is not None or motion is None:
        return recording.velocity
    return motion.velocity[motion.inner]


def _origin(signals: Mapping[str, Array]) -> float | None:
    """
    Return the position (m) at which a piston starts at rest; None if it starts in motion.

    0 within the noise. The zero of a position sensor is arbitrary; at rest and without force, the
    load's spring is relaxed.
    """
    if 'position' not in signals:
        return None
    others = [signals[name] for name in REST if name in signals]
    position = signals['position']
    moves = [np.abs(values - values[0]) > math.sqrt(2.0) * AT_REST * noise_of(values)
             for values in (*others, position)]
    still = int(np.argmax(np.any(moves, axis=0)))   # samples before the first that moves
    count = max(still // 2, 1)
    # In their mean: a force below the noise of a sample may have displaced the load already.
    if not others or not _within_noise(signals, count):
        return None
    origin = float(position[:count].mean())
    return origin if abs(origin) > AT_REST * noise_of(position) else 0.0


def _within_noise(signals: Mapping[str, Array], count: int) -> bool:
    """Return whether force, velocity and valve position are 0 in the mean of `count` samples."""
    return all(abs(values[:count].mean()) <= AT_REST * noise_of(values) / math.sqrt(count)
               for name, values in signals.items() if name in REST)


def _begins_at_rest(signals: Mapping[str, Array], period: float) -> bool:
    """Return whether valve, piston and force are at rest at the start, within their noise."""
    count = max(int(START_S / period), 2)
    position = signals.get('position')
    if position is not None and np.ptp(position[:count]) > 2.0 * AT_REST * noise_of(position):
        return False
    return _within_noise(signals, count)


def middle_of(run: Run) -> float:
    """Return the mean of a servo's reference if that is a position, of any origin; else 0."""
    if run.controlled() != 'position' or run.reference_n is None:
        return 0.0
    return float(np.nanmean(run.reference_n))


def _with_centred_origin(signals: dict[str, Array], drive: str, middle: float) -> None:
    """Move the arbitrary origin of a joint's coordinate to the middle of its motion, in place."""
    if drive == 'position':
        for name in {'reference', 'position'} & signals.keys():
            signals[name] = signals[name] - middle
    elif drive == 'force' and 'position' in signals:
        signals['position'] = signals['position'] - signals['position'].mean()


class _Signals(NamedTuple):
    """The signals of a run that move, under the names of the diagnosis, `period_s` apart."""

    period_s: float
    time_s: Array
    moving: dict[str, Array]
    noise: dict[str, float]    # standard deviation, by signal
    origin_m: float | None     # at which a piston starts at rest: its position counts from there


def _sources(run: Run, drive: str) -> dict[str, str]:
    """Return which signal of a run the diagnosis knows under which name."""
    if drive == 'force':
        return {'force': 'command' if run.force_n is None else 'force',
                'position': 'position', 'velocity': 'velocity'}
    if drive == 'position':
        return {'command': 'reference', 'valve_position': run.controlled()}
    if drive == 'drive':
        return {'command': 'command', 'valve_position': 'force'}
    return {name: name for name in ('command', 'force', 'valve_position', 'position', 'velocity')}


def _signals(run: Run, drive: str, middle: float = 0.0) -> _Signals:
    """
    Return the signals of a run that move; raises InputError if there is nothing to compare.

    middle: of a position servo, from which its reference and position count, m or rad.
    """
    period, time, signals, faded = uniform(run, by_rows=drive == 'drive')
    thinned = int(1.0 / (JOINT_RATE_HZ * period) + 0.5) if drive == 'force' else 1
    if thinned > 1:
        # The fast noise is filtered out.
        faded = dict.fromkeys(signals, 1.0)
        signals = {name: resample_poly(values, 1, thinned, padtype='line')
                   for name, values in signals.items()}
        period, time = period * thinned, time[::thinned]
    origin = _origin(signals) if drive == 'valve' else None
    if origin is not None:
        signals['position'] = signals['position'] - origin
    _with_centred_origin(signals, drive, middle)
    sources = _sources(run, drive)
    moving = {name: signals[source] for name, source in sources.items()
              if source in signals and np.ptp(signals[source]) > 0.0}
    if {'position', 'velocity'} <= set(moving) and not agree(
            moving['position'], moving['velocity'], period):
        del moving['velocity']   # it belongs to another motion
    if not {'command', 'valve_position'} <= set(moving) and (
            'force' not in moving or len(moving) < 2):
        raise InputError(f'{run.source}: nothing to compare: a diagnosis needs a command and what '
                         'follows from it, or a force and a motion; signals that move here: '
                         + (', '.join(name for name, values in signals.items()
                                      if np.ptp(values) > 0.0) or 'none'))
    noise = {name: noise_of(values) * faded[sources[name]] for name, values in moving.items()}
    return _Signals(period, time, moving, noise, origin)


def shared_band(runs: Sequence[Run], drive: str) -> float:
    """
    Return the frequency (Hz) up to which recordings are compared, if they are prepared together.

    drive: as in `prepare`. What is fitted to some of them holds for others in the same band only.
    """
    return _band([_signals(run, drive) for run in runs], drive, RIGID_BAND_HZ)


def _band(read: Sequence[_Signals], drive: str, most_hz: float) -> float:
    """Return the frequency (Hz) up to which motion and force of all recordings are compared."""
    bands = [most_hz] if drive == 'force' else []
    for period, _, moving, noise, _ in read:
        name = 'velocity' if 'velocity' in moving else 'position'
        if name not in moving or 'force' not in moving:
            continue
        motion = moving[name]
        bands.append(common_band(motion, moving['force'], period))
        if drive == 'force':
            # Above, a controller amplifies the noise of the motion: coherent with the force.
            bands.append(max(steady_band(motion, noise[name], period), LEAST_BAND_HZ))
    return min(bands, default=most_hz)


def prepare(runs: Sequence[Run], drive: str = 'valve', held_out: Sequence[bool] | None = None,
            band_hz: float = RIGID_BAND_HZ) -> list[Recording]:
    """
    Return runs ready for the diagnosis; those with `held_out` are not used in fits.

    drive: what the command is: 'valve' (the hydraulic actuator), 'force' (a joint whose force or
    torque is commanded or measured), 'position' (a joint that follows a position, velocity or
    force), 'drive' (the drive that turns a joint's command into its force). band_hz: the highest
    frequency that is compared, of a joint whose force is commanded.
    Raises InputError if one is too short, misses too many samples or holds nothing to compare.
    """
    middle = middle_of(runs[0])   # one for all, as limits of the reference are
    read = [_signals(run, drive, middle) for run in runs]
    band = _band(read, drive, band_hz)
    recordings: list[Recording] = []
    whole = held_out if held_out is not None and any(held_out) else None
    for number, (run, signals) in enumerate(zip(runs, read, strict=True)):
        period, time, moving, noise, origin = signals
        motion, velocity = None, moving.get('velocity')
        if 'force' in moving:
            motion, velocity = motion_of(moving.get('position'), velocity, noise, band, period)
        force = moving.get('force')
        driving = next(iter(moving.values()))
        fit, held = (split(driving.size, period) if drive == 'valve' else
                     balanced_split(driving, period))
        valid = recorded(run, drive, time)
        if motion is not None and (drive == 'force' or not motion.measured):
            valid = valid & ~ends(fit.size, period, band, not motion.measured)
        if drive == 'force' and motion is not None and 'position' in moving:
            valid = valid & ~stands(moving['position'], noise['position'], period, band)
        # Clipped samples are not measurements; a valve, however, may rest against a stop.
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
            noise=noise, taken={'reference': middle} if drive == 'position' else {},
            fit=fit, held_out=held, report=report,
            number=sum(bool(r.fit.any()) for r in recordings) if fit.any() else 0))
    if not all(any(part(each).any() for each in recordings)
               for part in (lambda r: r.fit, lambda r: r.held_out, lambda r: r.report)):
        raise InputError(f'{", ".join(each.source for each in recordings)}: too few samples are '
                         'left: the others are lost or clipped, or next to such ones')
    return _with_noise_of_repeats(recordings)


def _with_noise_of_repeats(recordings: list[Recording]) -> list[Recording]:
    """
    Return recordings whose noise is at least that of the difference of runs of one command.

    No model explains that difference, which includes slow noise; each run has half its variance.
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
            and bool(np.abs(a - b).max() <= SAME_COMMAND * np.ptp(a)))
