"""
Fit the nominal model, and each effect on top of it, to recordings.

The uncertain nominal parameters stay within their declared tolerance by hard bounds: let
loose, they swallow the effect. What is fitted on one part of the data is judged on another.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from asi_actuator.model.jit import FULL, LINEAR
from asi_actuator.parameters import Value, as_record
from asi_analysis.gap import blocks
from asi_analysis.gap.bounded import least_step, minimise
from asi_analysis.gap.effects import EFFECTS, Effect, Free, Variant
from asi_analysis.gap.prepare import Array, Recording, low_pass

Values = dict[str, float]

TOLERANCE = 0.2      # of the nominal parameters, where none is declared
MODEL_ERROR = 0.005  # share of a signal that no model of ours is trusted to explain
STEP = 1e-3          # of a parameter's range, for the derivatives
# Valve position and velocity come sampled, and lags are exact for what moves straight, so finer
# steps than the first tell nothing new of the force; delays and a solid friction of the nominal
# model take the second; the hysteresis of the full model, whose width follows the rate of the
# command and so jumps within a sample, the third.
FORCE_STEP_S = 5e-4
STEP_S = 2.5e-4
HYSTERESIS_STEP_S = 2e-4
PULL = 1.0           # of the start, on a parameter that is a whole range away
ROUNDS = 15          # of the optimiser
ROUGHLY, CLOSELY = 1e-3, 1e-4   # relative gain of a round that is not worth another
POLISHING = 6        # of those, with all derivatives
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
              *(f'hydraulic_damping_{name}' for name in (
                  'velocity_width', 'width_growth', 'saturation_shift', 'saturation_narrowing',
                  'centre_share')), 'fluid_dynamics_frequency',
              'friction_linear_gain', 'friction_coulomb', 'friction_stiction_push',
              'friction_stiction_pull', 'force_sensor_natural_frequency', 'force_sensor_delay'),
    'load': ('load_mass', 'load_stiffness', 'load_damping', 'load_locked_stiffness',
             'load_locked_damping', 'force_sensor_natural_frequency', 'force_sensor_delay'),
}


# Share of what a nonlinearity of the nominal model does (with these fields and without) that its
# formulation is not trusted to explain; set, as MODEL_ERROR is, on blind cases without effects.
FORMULATION_ERROR = {
    'valve': ((('valve_hysteresis_radius',), 0.1),),
    'force': ((('friction_coulomb', 'friction_stiction_push', 'friction_stiction_pull'), 0.2),),
    'load': (),
}
# What the formulation of a nonlinearity leaves open, whatever the tolerance of its size: two that
# agree in their size need not agree in the last turn of their curve.
SHAPES = {
    'valve': (Free('valve_hysteresis_spread', 0.0, 1.5, (0.3,)),
              Free('valve_hysteresis_lagged', 0.0, 1.0, (0.3,))),
    'force': (Free('friction_slipping', 0.0, 1.0, (0.3,)),
              Free('friction_presliding_stiffness', 0.3, 3.0, (1.0,), 'nominal'),
              Free('friction_stribeck_velocity', 0.3, 3.0, (1.0,), 'nominal')),
    'load': (),
}


def plant_record(nominal: Mapping[str, Value]) -> np.void:
    """Return the plant's record of nominal actuator parameters, every effect null."""
    record = np.zeros(1, blocks.PLANT_DTYPE)[0]
    actuator = as_record(nominal)
    for name in actuator.dtype.names or ():
        record[name] = actuator[name]
    for name, value in (('force_scale', 1.0), ('friction_bristle', 1e-4), ('supply_time', 0.3),
                        ('friction_stribeck', 1.0), ('friction_falling', 1.0)):
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
    stiff = FULL in (p['force_sensor_model'], p['friction_model'])
    blocks.force(position, _velocity(recording, p), *blocks.parts(p), recording.period_s,
                 recording.sub_steps(STEP_S if stiff else FORCE_STEP_S), out)
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
        'compliance': position / force, 'drift': force / duration,
        'drift_curve': force / duration ** 2,
    }


def _is_modelled(name: str, nominal: np.void) -> bool:
    """Return whether the nominal model has the block, or the load, that a parameter is of."""
    if name.startswith('load_locked') or name in ('load_stiffness', 'load_damping'):
        kind = ('locked', 'spring', 'free', 'prescribed')[int(nominal['load_type'])]
        return kind == ('locked' if name.startswith('load_locked') else 'spring')
    block = next((block for block in ('valve_flexure', 'valve_hysteresis', 'hydraulic_damping',
                                      'fluid_dynamics', 'friction', 'force_sensor')
                  if name.startswith(block)), None)
    model = LINEAR if name.endswith('linear_gain') else FULL
    return block is None or nominal[f'{block}_model'] == model


def _nuisance(nominal: np.void, channels: Sequence[str], tolerance: float) -> tuple[Free, ...]:
    """Return the uncertain nominal parameters of these channels."""
    low, high = 1.0 - tolerance, 1.0 + tolerance
    chosen = {}
    for name in (name for channel in channels for name in UNCERTAIN[channel]):
        if nominal[name] != 0.0 and _is_modelled(name, nominal):
            # The valve position is known by the product of three uncertain parameters.
            wide = name == 'valve_characteristic_gain' and 'valve' in channels
            chosen[name] = Free(name, low ** 2 / high if wide else low,
                                high ** 2 / low if wide else high, (1.0,), 'nominal')
    for free in (free for channel in channels for free in SHAPES[channel]):
        if _is_modelled(free.field, nominal) and (free.scale != 'nominal'
                                                  or nominal[free.field] != 0.0):
            chosen[free.field] = free
    if 'force' in channels:   # a real corner is never quite hard
        chosen['corner'] = Free('corner', 0.0, 0.1, (0.03,))
    return tuple(chosen.values())


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


def independent_samples(group: Group, p: np.void) -> Values:
    """
    Return how many independent samples the held-out parts are worth, by channel.

    Their number over the time, in samples, that what is left goes on for: the sum of its
    autocorrelation up to where neighbours no longer agree (Geyer 1992).
    """
    worth = {}
    for channel in group.channels:
        worth[channel] = 0.0
        for recording in group.recordings:
            kept = recording.held_out.astype(float)
            left = (measured(recording, channel) - predict(recording, channel, p)) * kept
            size = 2 * left.size
            products = np.fft.irfft(np.abs(np.fft.rfft(left, size)) ** 2)[:left.size]
            pairs = np.fft.irfft(np.abs(np.fft.rfft(kept, size)) ** 2)[:left.size]
            alike = products / np.maximum(pairs, 1.0) * pairs[0] / max(products[0], 1e-300)
            twos = alike[1:left.size // 8 * 2 + 1].reshape(-1, 2).sum(axis=1)
            ends = int(np.argmax(np.append(twos, -1.0) <= 0.0))
            worth[channel] += kept.sum() / (1.0 + 2.0 * float(twos[:ends].sum()))
    return worth


def _shown() -> dict[str, set[str]]:
    """Return the channels that each parameter acts on, by field."""
    shown: dict[str, set[str]] = {'load_offset': {'load'}, 'drive_hold': {'load'},
                                  'drive_delay': {'load'}, 'drive_lag': {'load'},
                                  'corner': {'valve', 'force'}}
    for channel, names in UNCERTAIN.items():
        for name in names:
            shown.setdefault(name, set()).add(channel)
        for free in SHAPES[channel]:
            shown.setdefault(free.field, set()).add(channel)
    for effect in EFFECTS:
        for variant in effect.variants:
            for free in variant.free:
                shown.setdefault(free.field, set()).update(variant.channels)
    return shown


SHOWN = _shown()


def shows_in(field: str, channel: str, group: Group) -> bool:
    """Return whether a parameter acts on a channel."""
    through = channel == 'force' and not group.measures_valve and 'valve' in SHOWN[field]
    inert = field == 'load_mass' and group.nominal['force_sensor_mass_share'] != 0.0
    return channel in SHOWN[field] or through or inert


def fit(group: Group, free: Sequence[Free], starts: Sequence[Array],
        fixed: Sequence[tuple[str, float]] = (), rounds: int = ROUNDS,
        known: Mapping[str, Array] = MappingProxyType({}), followed: int = STARTS) -> Fitted:
    """
    Return the best fit of the free parameters, from the best few of the starts.

    starts: parameter vectors, as shares of the way between bounds; the best `followed` of them
    are followed; known: derivatives, by field, that are taken for granted.
    """
    problem = Problem(group, tuple(free), tuple(fixed))
    ranked = sorted(starts, key=lambda theta: float(np.sum(problem.residual(theta) ** 2)))
    best_cost, best_theta = math.inf, ranked[0]
    for start in ranked[:followed if len(starts) > 3 else 1]:
        theta, cost = minimise(problem.residual, lambda theta: problem.jacobian(theta, known),
                               start, PULL, rounds, ROUGHLY if known else CLOSELY)
        if cost < best_cost:
            best_cost, best_theta = cost, theta
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

    def jacobian(self, theta: Array, known: Mapping[str, Array] = MappingProxyType({})) -> Array:
        """
        Return its derivatives, by differences; only of channels that a parameter acts on.

        known: those that are not worked out, by field.
        """
        base = self._by_channel(theta)
        columns = np.zeros((sum(part.size for part in base), theta.size))
        for i, parameter in enumerate(self.free):
            if parameter.field in known:
                columns[:, i] = known[parameter.field]
                continue
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


def _formulation_error(recordings: Sequence[Recording], channel: str, p: np.void) -> float:
    """Return the mean square that the formulation of the nominal nonlinearities may leave."""
    error = 0.0
    for fields, share in FORMULATION_ERROR[channel]:
        if _is_modelled(fields[0], p):
            without = p.copy()
            for name in fields:
                without[name] = 0.0
            error += max(float(np.mean((share * (predict(recording, channel, p)
                                                 - predict(recording, channel, without))) ** 2))
                         for recording in recordings)
    return error


def make_group(nominal: np.void, recordings: Sequence[Recording], channels: tuple[str, ...],
               tolerance: float = TOLERANCE, nuisance: tuple[Free, ...] | None = None,
               effects: tuple[Effect, ...] = EFFECTS,
               model_error: float = MODEL_ERROR) -> Group:
    """
    Return a group of channels, ready to be fitted.

    model_error: share of a signal that the model is not trusted to explain.
    """
    scale = scales(recordings)
    noise, floor = {}, {}
    p = nominal.copy()
    p['force_scale'] = scale['force']
    for channel in channels:
        noise[channel] = max(_noise(recording, channel, nominal) for recording in recordings)
        size = math.sqrt(float(np.mean([np.mean(measured(recording, channel) ** 2)
                                        for recording in recordings])))
        floor[channel] = (noise[channel] ** 2 + (model_error * size) ** 2
                          + _formulation_error(recordings, channel, p))
    if nuisance is None:
        hidden = 'force' in channels and any(r.valve_position is None for r in recordings)
        names = ('valve', *channels) if hidden else channels
        nuisance = _nuisance(p, names, tolerance)
    return Group(p, recordings, channels, nuisance, scale, noise, floor, effects)


def with_known_gain(group: Group, valve: Fitted, tolerance: float) -> Group:
    """
    Return a group whose valve passes as much as the fit of the valve channel leaves possible.

    Command to valve position and valve position to force share the full opening: by itself each
    may be off by the tolerance of several parameters, together by that of the gain alone.
    """
    name = 'valve_characteristic_full_opening'
    if group.nominal['valve_characteristic_model'] == FULL or not any(
            free.field == name for free in group.nuisance):
        return group
    gain = float(valve.record['valve_characteristic_gain']
                 / valve.problem.group.nominal['valve_characteristic_gain'])
    low, high = 1.0 - tolerance, 1.0 + tolerance
    opening = Free(name, max(gain / high, low / high), min(gain / low, high / low), (gain,),
                   'nominal')
    if opening.low >= opening.high:
        return group
    return replace(group, nuisance=tuple(
        opening if free.field == name else free for free in group.nuisance
        if free.field != 'valve_characteristic_maximum_force'))


def fit_null(group: Group) -> Fitted:
    """
    Return the nominal model with its uncertain parameters refitted.

    To the end: a fit that is stuck here would make any effect look like an explanation.
    """
    theta = np.array([_share(_start(free, group), *_bounds(free, group))
                      for free in group.nuisance])
    return fit(group, group.nuisance, [theta], rounds=3 * ROUNDS)


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


def fit_variants(group: Group, promise: 'Promise', variants: Sequence[Variant],
                 followed: int = STARTS) -> Fitted:
    """
    Return the fit of one variant each of one or more effects, all together, nearly.

    promise: of the fit to start from (nested warm start): its parameters stay, those of the
    variants are added. Their derivatives change little, and are taken from there.
    followed: how many of the best starts are followed.
    """
    problem, starts = _added(group, promise.base, variants)
    return fit(group, problem.free, starts, problem.fixed, known=promise.derivatives,
               followed=followed)


def polish(group: Group, fitted: Fitted) -> Fitted:
    """Return a fit that is nearly there, fitted to the end with all derivatives."""
    return fit(group, fitted.free, [fitted.theta], fitted.problem.fixed, rounds=POLISHING)


class Promise:
    """
    How much an effect on top of a fit could explain, from a few simulations of it.

    At each of its starts: the least squares of what is left over the change that the effect
    makes, at any size up to LARGEST times, and over the parameters that are fitted already, all
    of it linear and within the bounds.
    """

    def __init__(self, base: Fitted) -> None:
        self.base = base
        self._left = base.problem.residual(base.theta)
        self._jacobian = base.problem.jacobian(base.theta)
        self.derivatives = {free.field: column for free, column
                            in zip(base.free, self._jacobian.T, strict=True)}
        self._square = self._jacobian.T @ self._jacobian
        self._right = self._jacobian.T @ self._left

    def cost(self, group: Group, variants: Sequence[Variant]) -> float:
        """Return the cost that a fit of these variants may be expected to reach."""
        problem, starts = _added(group, self.base, variants)
        return min(self._linear(problem.residual(start) - self._left) for start in starts)

    def _linear(self, change: Array) -> float:
        cross = self._jacobian.T @ change
        square = np.block([[self._square, cross[:, None]], [cross[None], change @ change]])
        _, gain = least_step(square, np.append(self._right, change @ self._left),
                             np.append(-self.base.theta, 0.0),
                             np.append(1.0 - self.base.theta, LARGEST))
        return 0.5 * float(self._left @ self._left) - gain
