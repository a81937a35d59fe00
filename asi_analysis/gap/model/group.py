"""What channels share: which nominal parameters are uncertain, and what no model explains."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from asi_analysis.gap.model.effects import EFFECTS, Effect, Free, Variant, in_each
from asi_analysis.gap.model.predict import for_recordings, measured, passed_on, predict
from asi_analysis.gap.prepare import Array, Recording
from asi_common.jit import FULL, LINEAR

Values = dict[str, float]
TOLERANCE = 0.2      # of the nominal parameters, where none is declared
NOISIER = 0.6        # of the noise that was found: a model that leaves less shows that it is less
MODEL_ERROR = 0.005  # share of a signal that no model of ours is trusted to explain
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
              Free('friction_presliding_stiffness', 0.5, 2.0, (1.0,), 'nominal'),
              Free('friction_stribeck_velocity', 0.5, 2.0, (1.0,), 'nominal')),
    'load': (),
}


@dataclass(frozen=True)
class Group:
    """
    Channels that share parameters, and so are fitted together.

    scale: what the bounds of the effects are multiples of; floor: mean square of what may be left
    in each channel by noise, by the small errors of any model and by `formulation`, that of the
    nominal nonlinearities; effects: those that may be at
    work.
    """

    nominal: np.void
    recordings: Sequence[Recording]
    channels: tuple[str, ...]
    nuisance: tuple[Free, ...]
    scale: Values = field(default_factory=dict)
    noise: Values = field(default_factory=dict)
    floor: Values = field(default_factory=dict)
    formulation: Values = field(default_factory=dict)
    effects: tuple[Effect, ...] = EFFECTS

    @property
    def held_out_s(self) -> float:
        """Return how many seconds are not fitted on: to choose or to report on."""
        return sum(float((r.held_out | r.report).sum()) * r.period_s for r in self.recordings)

    @property
    def measures_valve(self) -> bool:
        """Return whether every recording holds the valve position."""
        return all(recording.valve_position is not None for recording in self.recordings)


def moves(recording: Recording) -> bool:
    """Return whether a recording holds the motion of the piston."""
    return recording.velocity is not None or recording.motion is not None


def make_group(nominal: np.void, recordings: Sequence[Recording], channels: tuple[str, ...],
               tolerance: float = TOLERANCE, nuisance: tuple[Free, ...] | None = None,
               effects: tuple[Effect, ...] = EFFECTS,
               model_error: float = MODEL_ERROR) -> Group:
    """
    Return a group of channels, ready to be fitted.

    model_error: share of a signal that the model is not trusted to explain.
    """
    scale = scales(recordings)
    noise, floor, formulation = {}, {}, {}
    count = 1 + max(recording.number for recording in recordings)
    p = for_recordings(nominal.copy(), count)
    p['force_scale'], p['velocity_scale'] = scale['force'], scale['velocity']
    for channel in channels:
        noise[channel] = max(_noise(recording, channel, p) for recording in recordings)
        size = math.sqrt(float(np.mean([np.mean(measured(recording, channel) ** 2)
                                        for recording in recordings])))
        formulation[channel] = _formulation_error(recordings, channel, p)
        floor[channel] = noise[channel] ** 2 + (model_error * size) ** 2 + formulation[channel]
    if nuisance is None:
        hidden = 'force' in channels and any(r.valve_position is None for r in recordings)
        names = ('valve', *channels) if hidden else channels
        if not all(map(moves, recordings)):
            names = (*names, 'load')
        nuisance = _nuisance(p, names, tolerance, 'valve' in channels)
    effects = tuple(effect._replace(variants=tuple(
        variant._replace(free=in_each(variant.free, count)) for variant in effect.variants))
        for effect in effects)
    return Group(p, recordings, channels, in_each(nuisance, count), scale, noise, floor,
                 formulation, effects)


def less_noisy(group: Group, left: Values) -> Group:
    """
    Return a group whose noise is no more than what a model leaves of it (mean squares).

    Where a signal is sampled slowly, its own course looks like noise.
    """
    noise = {channel: min(level, math.sqrt(left[channel]))
             for channel, level in group.noise.items()}
    if all(noise[channel] > NOISIER * level for channel, level in group.noise.items()):
        return group
    return replace(group, noise=noise, floor={
        channel: floor - group.noise[channel] ** 2 + noise[channel] ** 2
        for channel, floor in group.floor.items()})


def _noise(recording: Recording, channel: str, p: np.void) -> float:
    """Return the standard deviation of what noise leaves in a channel, that of its input too."""
    noise, motion = recording.noise, recording.motion
    if channel == 'valve':
        return noise['valve_position']
    share = 1.0
    if channel == 'load':
        assert motion is not None
        share = math.sqrt(float(np.mean(motion.judge ** 2)))
    return math.hypot(share * noise['force'], math.sqrt(passed_on(recording, channel, p)))


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
        'drift_curve': force / duration ** 2, 'drift_bend': force / duration ** 3,
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


def _nuisance(nominal: np.void, channels: Sequence[str], tolerance: float,
              valve_by_itself: bool) -> tuple[Free, ...]:
    """Return the uncertain nominal parameters of these channels."""
    low, high = 1.0 - tolerance, 1.0 + tolerance
    chosen = {}
    for name in (name for channel in channels for name in UNCERTAIN[channel]):
        if nominal[name] != 0.0 and _is_modelled(name, nominal):
            # The valve position is known by the product of three uncertain parameters; of the
            # force that a command makes two of them cancel.
            wide = name == 'valve_characteristic_gain' and valve_by_itself
            chosen[name] = Free(name, low ** 2 / high if wide else low,
                                high ** 2 / low if wide else high, (1.0,), 'nominal')
    for free in (free for channel in channels for free in SHAPES[channel]):
        if _is_modelled(free.field, nominal) and (free.scale != 'nominal'
                                                  or nominal[free.field] != 0.0):
            chosen[free.field] = free
    if 'force' in channels:   # a real corner is never quite hard
        chosen['corner'] = Free('corner', 0.0, 0.1, (0.03,))
    return tuple(chosen.values())


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


def channels_of(variant: Variant, group: Group) -> set[str]:
    """Return the channels of a group that a variant shows in; none if it does not apply."""
    if any(group.nominal[name] == 0.0 for name in variant.needs):
        return set()
    shows = set(variant.channels)
    if 'valve' in shows and not group.measures_valve:
        shows.add('force')
    return shows & set(group.channels)


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
    field = field.partition('@')[0]
    through = channel == 'force' and not group.measures_valve and 'valve' in SHOWN[field]
    inert = (field in ('load_mass', 'piston_share')
             and group.nominal['force_sensor_mass_share'] != 0.0)
    carried = (channel == 'force' and field in UNCERTAIN['load']
               and not all(map(moves, group.recordings)))
    return channel in SHOWN[field] or through or inert or carried
