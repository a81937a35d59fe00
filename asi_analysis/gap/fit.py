"""
Fit the nominal model, and each effect on top of it, to recordings.

The uncertain nominal parameters stay within their declared tolerance by hard bounds: let
loose, they swallow the effect. What is fitted on one part of the data is judged on another.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares, lsq_linear
from scipy.signal import welch

from asi_actuator.model.jit import FULL
from asi_actuator.parameters import Value, as_record
from asi_analysis.gap import blocks
from asi_analysis.gap.effects import EFFECTS, Effect, Free, Variant
from asi_analysis.gap.prepare import Array, Recording, low_pass

Values = dict[str, float]

TOLERANCE = 0.2      # of the nominal parameters, where none is declared
MODEL_ERROR = 0.01   # share of a signal that no model of ours is trusted to explain
STEP = 1e-3          # of a parameter's range, for the derivatives
# Valve position and velocity come sampled, so finer steps than this tell nothing new; but the
# hysteresis of the full model, whose width follows the rate of the command, jumps within a sample.
STEP_S = 2.5e-4
HYSTERESIS_STEP_S = 1e-4
PULL = 1.0           # of the start, on a parameter that is a whole range away
ROUNDS = 15          # of the optimiser
LARGEST = 3.0        # times a start that an effect is taken to be
STARTS = 2           # of the best starting points that are followed

# Nominal parameters that are uncertain, by the channel that they act on; of a block that is 'off'
# they have no effect, and are left out.
UNCERTAIN = {
    'valve': ('valve_characteristic_gain', 'valve_flexure_coil_frequency',
              'valve_flexure_natural_frequency', 'valve_flexure_damping_ratio',
              'valve_flexure_delay', 'valve_hysteresis_radius', 'valve_hysteresis_lag_time'),
    'force': ('valve_characteristic_full_opening', 'valve_characteristic_maximum_force',
              'hydraulic_damping_linear_gain', 'hydraulic_damping_maximum_force',
              'hydraulic_damping_viscous', 'hydraulic_damping_saturation_velocity',
              'hydraulic_damping_velocity_width', 'fluid_dynamics_frequency',
              'friction_linear_gain', 'friction_coulomb', 'friction_stiction_push',
              'friction_stiction_pull', 'force_sensor_natural_frequency', 'force_sensor_delay'),
    'load': ('load_mass', 'load_stiffness', 'load_damping', 'load_locked_stiffness',
             'load_locked_damping', 'force_sensor_natural_frequency', 'force_sensor_delay'),
}


def plant_record(nominal: Mapping[str, Value]) -> np.void:
    """Return the plant's record of nominal actuator parameters, every effect null."""
    record = np.zeros(1, blocks.PLANT_DTYPE)[0]
    actuator = as_record(nominal)
    for name in actuator.dtype.names or ():
        record[name] = actuator[name]
    for name, value in (('force_scale', 1.0), ('friction_bristle', 1e-4), ('supply_time', 0.3)):
        record[name] = value
    return record




@dataclass(frozen=True)
class Group:
    """
    Channels that share parameters, and so are fitted together.

    scale: what the bounds of the effects are multiples of; floor: mean square of what may be left
    in each channel by noise and by the small errors of any model; effects: those that may be at
    work.
    """

    nominal: np.void
    recordings: Sequence[Recording]
    channels: tuple[str, ...]
    nuisance: tuple[Free, ...]
    scale: Values = field(default_factory=dict)
    noise: Values = field(default_factory=dict)
    floor: Values = field(default_factory=dict)
    effects: tuple[Effect, ...] = EFFECTS

    @property
    def held_out_s(self) -> float:
        """Return how many seconds are held out."""
        return sum(float(r.held_out.sum()) * r.period_s for r in self.recordings)

    @property
    def measures_valve(self) -> bool:
        """Return whether every recording holds the valve position."""
        return all(recording.valve_position is not None for recording in self.recordings)


class Fitted(NamedTuple):
    """One hypothesis, fitted: its record, its parameters and what it leaves."""

    record: np.void
    free: tuple[Free, ...]
    theta: Array
    cost: float                  # on the fitted parts, weighed by the floors
    held_out: Values             # mean square left on the held-out parts, by channel
    problem: 'Problem'

    @property
    def values(self) -> Values:
        """Return the fitted parameters."""
        return {free.field: float(self.record[free.field]) for free in self.free}


def predict(recording: Recording, channel: str, p: np.void) -> Array:
    """Return what a channel should have measured: n samples, in the channel's unit."""
    if channel == 'load':
        return _load(recording, p)
    if channel == 'valve':
        return _valve(recording, p)
    out = np.empty(recording.fit.size)
    position = recording.valve_position
    if position is None:
        position = _valve(recording, p)
    blocks.force(position, _velocity(recording, p), *blocks.parts(p), recording.period_s,
                 recording.sub_steps(STEP_S), out)
    return out


def _valve(recording: Recording, p: np.void) -> Array:
    """Return the valve position (m) that the recorded command should have made."""
    out = np.empty(recording.fit.size)
    longest = HYSTERESIS_STEP_S if p['valve_hysteresis_model'] == FULL else STEP_S
    blocks.valve(recording.command, *blocks.parts(p), recording.period_s,
                 recording.sub_steps(longest), out)
    return out


def _velocity(recording: Recording, p: np.void) -> Array:
    """Return the velocity (m/s) of the piston; not measured, what the nominal load would do."""
    if recording.velocity is not None:
        return recording.velocity
    motion = recording.motion
    if motion is not None:
        return motion.velocity[motion.pad:motion.pad + recording.fit.size]
    mass, damping, stiffness = blocks.load_constants(p)
    count = recording.fit.size
    if mass == 0.0 or stiffness == 0.0 or recording.force is None:
        return np.zeros(count)
    frequency = np.fft.rfftfreq(count, recording.period_s)
    s = 2j * np.pi * frequency
    velocity = s / (mass * s * s + damping * s + stiffness) * np.fft.rfft(recording.force)
    return np.fft.irfft(velocity * low_pass(frequency, 0.1 / recording.period_s), count)


def _load(recording: Recording, p: np.void) -> Array:
    """Return the force (N) that the measured motion takes, as the sensor reads it, in band."""
    motion = recording.motion
    assert motion is not None
    _, damping, stiffness = blocks.load_constants(p)
    linear = (blocks.impedance(motion.omega, p) * motion.velocity_spectrum
              + stiffness * motion.position_spectrum)
    extra = np.zeros(motion.velocity.size)
    blocks.load_nonlinear(motion.position, motion.velocity, stiffness, damping,
                          blocks.parts(p)[1], recording.period_s,
                          -motion.pad * recording.period_s, extra)
    if p['compliance'] > 0.0:
        linear = blocks.compliant(motion.omega, motion.velocity_spectrum,
                                  motion.position_spectrum, p)
    total = ((linear + np.fft.rfft(extra)) * blocks.sensor_response(motion.omega, p)
             * blocks.drive_inverse(motion.omega, p) * motion.judge)
    count = recording.fit.size
    inner = np.fft.irfft(total, extra.size)[motion.pad:motion.pad + count]
    if not motion.measured:   # the offset is outside the band
        return inner
    time = recording.time_s
    return inner + (p['force_sensor_offset'] + p['sensor_offset'] + p['sensor_drift'] * time
                    + p['sensor_drift_curve'] * time * time)


def measured(recording: Recording, channel: str) -> Array:
    """Return what a channel has measured."""
    signal = {'valve': recording.valve_position, 'force': recording.force,
              'load': recording.force_judged}[channel]
    assert signal is not None
    return signal


def _noise(recording: Recording, channel: str, p: np.void) -> float:
    """Return the standard deviation of what noise leaves in a channel, that of its input too."""
    noise = recording.noise
    if channel == 'valve':
        return noise['valve_position']
    if channel == 'force':
        slope = p['valve_characteristic_maximum_force'] / p['valve_characteristic_full_opening']
        damping = p['hydraulic_damping_viscous'] if p['hydraulic_damping_model'] == FULL else (
            p['hydraulic_damping_linear_gain'] if p['hydraulic_damping_model'] else 0.0)
        return math.hypot(noise['force'], slope * noise.get('valve_position', 0.0),
                          damping * noise.get('velocity', 0.0))
    motion = recording.motion
    assert motion is not None
    _, _, stiffness = blocks.load_constants(p)
    moved = blocks.impedance(motion.omega, p) * motion.judge
    if 'velocity' not in noise:
        moved = moved * 1j * motion.omega * noise['position']
    else:
        moved = moved * noise['velocity']
    stretched = stiffness * noise.get('position', 0.0) * motion.judge
    return math.sqrt(float(np.mean((noise['force'] * motion.judge) ** 2 + np.abs(moved) ** 2
                                   + stretched ** 2)))


def _range(signals: Sequence[Array | None]) -> float:
    """Return the largest size of a signal over recordings, rare peaks left out."""
    present = [np.quantile(np.abs(signal), 0.999) for signal in signals if signal is not None]
    return float(max(present, default=0.0)) or 1.0


def scales(recordings: Sequence[Recording]) -> Values:
    """Return what the bounds of the effects are multiples of."""
    motions = [recording.motion for recording in recordings if recording.motion]
    command = _range([recording.command for recording in recordings])
    force = _range([recording.force for recording in recordings])
    velocity = _range([motion.velocity for motion in motions])
    position = _range([motion.position for motion in motions])
    duration = max(recording.fit.size * recording.period_s for recording in recordings)
    return {
        '': 1.0, 'command': command, 'force': force, 'velocity': velocity, 'position': position,
        'valve_position': _range([r.valve_position for r in recordings]),
        'damping': force / velocity, 'damping_quadratic': force / velocity ** 2,
        'compliance': position / force, 'duration': duration, 'drift': force / duration,
        'drift_curve': force / duration ** 2, 'residual_frequency': 1.0,
    }


def _nuisance(nominal: np.void, channels: Sequence[str], tolerance: float) -> tuple[Free, ...]:
    """Return the uncertain nominal parameters of these channels."""
    kinds = ('locked', 'spring', 'free', 'prescribed')
    kind = kinds[int(nominal['load_type'])]
    fields = dict.fromkeys(name for channel in channels for name in UNCERTAIN[channel])
    chosen = []
    for name in fields:
        block = next((b for b in ('valve_flexure', 'valve_hysteresis', 'hydraulic_damping',
                                  'fluid_dynamics', 'friction', 'force_sensor')
                      if name.startswith(b)), None)
        if block is not None:
            model = nominal[f'{block}_model']
            if model != (1.0 if name.endswith('linear_gain') else FULL):
                continue
        if name.startswith('load_locked') and kind != 'locked':
            continue
        if name in ('load_stiffness', 'load_damping') and kind != 'spring':
            continue
        if nominal[name] != 0.0:
            # The valve position is known by the product of three uncertain parameters.
            wide = name == 'valve_characteristic_gain' and 'valve' in channels
            low, high = 1.0 - tolerance, 1.0 + tolerance
            chosen.append(Free(name, low ** 2 / high if wide else low,
                               high ** 2 / low if wide else high, (1.0,), 'nominal'))
    if 'force' in channels:   # a real corner is never quite hard
        chosen.append(Free('corner', 0.0, 0.1, (0.03,)))
    return tuple(chosen)


def _residual(group: Group, channel: str, p: np.void) -> Array:
    """Return what a channel leaves on the fitted parts, weighed by its floor."""
    parts = [(measured(recording, channel) - predict(recording, channel, p))[recording.fit]
             for recording in group.recordings if recording.fit.any()]
    return np.concatenate(parts) / math.sqrt(group.floor[channel])


def _bounds(free: Free, group: Group) -> tuple[float, float]:
    unit = float(group.nominal[free.field]) if free.scale == 'nominal' else group.scale[free.scale]
    return free.low * unit, free.high * unit


def _is_logarithmic(low: float, high: float) -> bool:
    return low > 0.0 and high > 50.0 * low


def _value(share: float, low: float, high: float) -> float:
    """Return the value at a share, 0 to 1, of the way between bounds."""
    if _is_logarithmic(low, high):
        return low * (high / low) ** share
    return low + share * (high - low)


def _share(value: float, low: float, high: float) -> float:
    """Return the inverse of `_value`, within 0.001 to 0.999."""
    if _is_logarithmic(low, high):
        share = math.log(value / low) / math.log(high / low)
    else:
        share = (value - low) / (high - low)
    return min(max(share, 0.001), 0.999)


def _record(group: Group, free: Sequence[Free], theta: Array,
            fixed: Sequence[tuple[str, float]]) -> np.void:
    """Return the plant's record at a parameter vector (shares of the way between bounds)."""
    p = group.nominal.copy()
    for name, value in fixed:
        p[name] = value
    for parameter, share in zip(free, theta, strict=True):
        p[parameter.field] = _value(float(share), *_bounds(parameter, group))
    return p


def _comparable(recording: Recording, fit_on: Sequence[Recording]) -> npt.NDArray[np.bool_]:
    """Return the held-out samples whose inputs lie within the range that the fits have seen."""
    inside = recording.held_out.copy()
    for name in ('command', 'valve_position', 'velocity'):
        here = getattr(recording, name)
        seen = [getattr(other, name)[other.fit] for other in fit_on
                if other.fit.any() and getattr(other, name) is not None]
        if here is not None and seen:
            low, high = min(s.min() for s in seen), max(s.max() for s in seen)
            slack = 0.02 * (high - low)
            inside &= (here >= low - slack) & (here <= high + slack)
    return inside if inside.sum() > 0.2 * recording.held_out.sum() else recording.held_out


def held_out_error(group: Group, p: np.void) -> Values:
    """Return the mean square left on the held-out parts, by channel."""
    left = {}
    for channel in group.channels:
        total, count = 0.0, 0
        for recording in group.recordings:
            mask = _comparable(recording, group.recordings)
            error = (measured(recording, channel) - predict(recording, channel, p))[mask]
            total += float(error @ error)
            count += error.size
        left[channel] = total / count
    return left


def _shown() -> dict[str, set[str]]:
    """Return the channels that each parameter acts on, by field."""
    shown: dict[str, set[str]] = {'load_offset': {'load'}, 'drive_hold': {'load'},
                                  'drive_delay': {'load'}, 'drive_lag': {'load'},
                                  'corner': {'valve', 'force'}}
    for channel, names in UNCERTAIN.items():
        for name in names:
            shown.setdefault(name, set()).add(channel)
    for effect in EFFECTS:
        for variant in effect.variants:
            for free in variant.free:
                shown.setdefault(free.field, set()).update(variant.channels)
    return shown


SHOWN = _shown()


def shows_in(field: str, channel: str, group: Group) -> bool:
    """Return whether a parameter acts on a channel."""
    through = channel == 'force' and not group.measures_valve and 'valve' in SHOWN[field]
    return channel in SHOWN[field] or through


def fit(group: Group, free: Sequence[Free], starts: Sequence[Array],
        fixed: Sequence[tuple[str, float]] = (), method: str = 'dogbox',
        rounds: int = ROUNDS) -> Fitted:
    """
    Return the best fit of the free parameters, from the best few of the starts.

    starts: parameter vectors, as shares of the way between bounds; the best STARTS are followed.
    """
    problem = Problem(group, tuple(free), tuple(fixed))
    ranked = sorted(starts, key=lambda theta: float(np.sum(problem.residual(theta) ** 2)))
    best_cost, best_theta = math.inf, ranked[0]
    for start in ranked[:STARTS if len(starts) > 3 else 1]:
        # A touch of a prior, so that parameters which do the same do not make it singular.
        pull = PULL * np.eye(start.size)

        def residual(theta: Array, start: Array = start) -> Array:
            return np.concatenate([problem.residual(theta), PULL * (theta - start)])

        def jacobian(theta: Array, pull: Array = pull) -> Array:
            return np.vstack([problem.jacobian(theta), pull])

        # dogbox: it lets parameters rest on their bounds, where trf creeps along them.
        solution = least_squares(residual, start, jacobian, bounds=(0.0, 1.0), method=method,
                                 x_scale='jac', max_nfev=rounds, ftol=1e-4, xtol=1e-5, gtol=1e-9)
        if solution.cost < best_cost:
            best_cost, best_theta = float(solution.cost), solution.x
    record = problem.record(best_theta)
    return Fitted(record, problem.free, best_theta, best_cost, held_out_error(group, record),
                  problem)


@dataclass
class Problem:
    """A least-squares problem: which parameters of a group are free, and what is fixed."""

    group: Group
    free: tuple[Free, ...]
    fixed: tuple[tuple[str, float], ...] = ()
    _key: bytes = b''
    _last: list[Array] = field(default_factory=list)

    def record(self, theta: Array) -> np.void:
        """Return the plant's record at a parameter vector."""
        return _record(self.group, self.free, theta, self.fixed)

    def _by_channel(self, theta: Array) -> list[Array]:
        if self._key != theta.tobytes():
            p = self.record(theta)
            self._last = [_residual(self.group, channel, p) for channel in self.group.channels]
            self._key = theta.tobytes()
        return self._last

    def residual(self, theta: Array) -> Array:
        """Return what is left on the fitted parts, channel after channel, in floors."""
        return np.concatenate(self._by_channel(theta))

    def jacobian(self, theta: Array) -> Array:
        """Return its derivatives, by differences; only of channels that a parameter acts on."""
        base = self._by_channel(theta)
        columns = np.zeros((sum(part.size for part in base), theta.size))
        for i, parameter in enumerate(self.free):
            step = STEP if theta[i] < 0.5 else -STEP
            moved = theta.copy()
            moved[i] += step
            p = self.record(moved)
            begin = 0
            for channel, part in zip(self.group.channels, base, strict=True):
                end = begin + part.size
                if shows_in(parameter.field, channel, self.group):
                    columns[begin:end, i] = (_residual(self.group, channel, p) - part) / step
                begin = end
        return columns


def make_group(nominal: np.void, recordings: Sequence[Recording], channels: tuple[str, ...],
               tolerance: float = TOLERANCE, nuisance: tuple[Free, ...] | None = None,
               effects: tuple[Effect, ...] = EFFECTS) -> Group:
    """Return a group of channels, ready to be fitted."""
    scale = scales(recordings)
    noise, floor = {}, {}
    for channel in channels:
        noise[channel] = max(_noise(recording, channel, nominal) for recording in recordings)
        size = math.sqrt(float(np.mean([np.mean(measured(recording, channel) ** 2)
                                        for recording in recordings])))
        floor[channel] = noise[channel] ** 2 + (MODEL_ERROR * size) ** 2
    p = nominal.copy()
    p['force_scale'] = scale['force']
    if nuisance is None:
        hidden = 'force' in channels and any(r.valve_position is None for r in recordings)
        names = ('valve', *channels) if hidden else channels
        nuisance = _nuisance(p, names, tolerance)
    return Group(p, recordings, channels, nuisance, scale, noise, floor, effects)


def fit_null(group: Group) -> Fitted:
    """
    Return the nominal model with its uncertain parameters refitted.

    By two optimisers: one that is stuck here would make any effect look like an explanation.
    """
    theta = np.array([_share(_start(free, group), *_bounds(free, group))
                      for free in group.nuisance])
    quick = fit(group, group.nuisance, [theta])
    slow = fit(group, group.nuisance, [theta], method='trf', rounds=3 * ROUNDS)
    return min(quick, slow, key=lambda fitted: fitted.cost)


def refit(group: Group, fitted: Fitted, others: Sequence[Fitted]) -> Fitted:
    """Return a fit, tried again from where richer hypotheses took its parameters."""
    best = fitted
    for other in others:
        theta = np.array([_share(float(other.record[free.field]), *_bounds(free, group))
                          for free in fitted.free])
        again = fit(group, fitted.free, [theta], fitted.problem.fixed)
        best = min(best, again, key=lambda each: each.cost)
    return best


def _start(free: Free, group: Group, index: int = 0) -> float:
    low, _ = _bounds(free, group)
    unit = low / free.low if free.low else (
        float(group.nominal[free.field]) if free.scale == 'nominal' else group.scale[free.scale])
    return free.starts[index] * unit


def channels_of(variant: Variant, group: Group) -> set[str]:
    """Return the channels of a group that a variant shows in; none if it does not apply."""
    if any(group.nominal[name] == 0.0 for name in variant.needs):
        return set()
    shows = set(variant.channels)
    if 'valve' in shows and not group.measures_valve:
        shows.add('force')
    return shows & set(group.channels)


def _added(group: Group, base: Fitted, variants: Sequence[Variant]
           ) -> tuple[Problem, list[Array]]:
    """Return the problem of a fit with the parameters of variants added, and its starts."""
    fixed = tuple(pair for variant in variants for pair in variant.fixed)
    known = {free.field for free in base.free}
    new: dict[str, Free] = {}
    for variant in variants:
        for free in variant.free:
            old = new.get(free.field)   # where both hold a field the wider bounds win
            new[free.field] = free if old is None else free._replace(
                low=min(free.low, old.low), high=max(free.high, old.high))
    frees = [free for free in base.free if free.field not in new] + list(new.values())
    warm = {free.field: _share(float(base.record[free.field]), *_bounds(free, group))
            for free in frees if free.field in known}
    fresh = [free for free in new.values() if free.field not in known]
    starts = []
    for count, free in enumerate(fresh):
        for index in range(len(free.starts)):
            if index == 0 and count > 0:
                continue
            begin = warm | {
                other.field: _share(_start(other, group, index if other is free else 0),
                                    *_bounds(other, group)) for other in fresh}
            starts.append(np.array([begin[other.field] for other in frees]))
    if not fresh:
        starts.append(np.array([warm[free.field] for free in frees]))
    return Problem(group, tuple(frees), fixed), starts


def fit_variants(group: Group, base: Fitted, variants: Sequence[Variant]) -> Fitted:
    """
    Return the fit of one variant each of one or more effects, all together.

    base: the fit to start from (nested warm start): its parameters stay, those of the variants
    are added.
    """
    problem, starts = _added(group, base, variants)
    return fit(group, problem.free, starts, problem.fixed)


class Promise:
    """
    How much an effect on top of a fit could explain, from a few simulations of it.

    At each of its starts: the least squares of what is left over the change that the effect
    makes, at any size up to LARGEST times, and over the parameters that are fitted already, all
    of it linear and within the bounds.
    """

    def __init__(self, base: Fitted) -> None:
        self._base = base
        self._left = base.problem.residual(base.theta)
        self._jacobian = base.problem.jacobian(base.theta)
        self._square = self._jacobian.T @ self._jacobian
        self._right = self._jacobian.T @ self._left

    def cost(self, group: Group, variants: Sequence[Variant]) -> float:
        """Return the cost that a fit of these variants may be expected to reach."""
        problem, starts = _added(group, self._base, variants)
        return min(self._linear(problem.residual(start) - self._left) for start in starts)

    def _linear(self, change: Array) -> float:
        cross = self._jacobian.T @ change
        gram = np.block([[self._square, cross[:, None]], [cross[None], change @ change]])
        size = np.sqrt(np.diag(gram)) + 1e-30
        # The same small problem by its triangle: |triangle x + right| up to a constant.
        triangle = np.linalg.cholesky(gram / np.outer(size, size)
                                      + 1e-9 * np.eye(len(size))).T
        slope = np.append(self._right, change @ self._left) / size
        right = -np.linalg.solve(triangle.T, slope)
        low = np.append(-self._base.theta, 0.0) * size
        high = np.append(1.0 - self._base.theta, LARGEST) * size
        solution = lsq_linear(triangle, right, (low - 1e-12, high + 1e-12), 'bvls')
        return 0.5 * (float(self._left @ self._left) - float(right @ right)) + solution.cost


def residual_frequency(group: Group, fitted: Fitted) -> float:
    """Return the strongest frequency (Hz) in what a fit leaves of the last channel."""
    recording = group.recordings[0]
    channel = group.channels[-1]
    left = measured(recording, channel) - predict(recording, channel, fitted.record)
    frequency, power = welch(left, 1.0 / recording.period_s, nperseg=min(left.size, 1 << 13),
                             detrend='linear')
    return float(frequency[1 + np.argmax(power[1:])])
