"""Groups of channels that share parameters: uncertain parameters, noise and error floor."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from asi_analysis.gap.model import forms, simulator
from asi_analysis.gap.model.blocks import EFFECT_FIELDS
from asi_analysis.gap.model.effects import EFFECTS, MOTIONS, Effects, Free, Variant, freed, in_each
from asi_analysis.gap.model.predict import for_recordings, measured, predict, propagated_noise
from asi_analysis.gap.model.start import (
    FLUX,
    START_FIELDS,
    start_parameters,
    with_start_fields,
)
from asi_analysis.gap.motion import noise_above
from asi_analysis.gap.prepare import Recording
from asi_analysis.gap.scales import scales, with_motion, with_valve, with_valve_force
from asi_common.jit import FULL, LINEAR

Values = dict[str, float]
TOLERANCE = 0.2      # of the nominal parameters, where none is declared
NOISIER = 0.6        # of the estimated noise: a smaller residual shows that the noise is lower
MODEL_ERROR = 0.005  # rms error of any model, as a share of the signal's rms
RIGID_ERROR = 0.02   # the same of a rigid model of gears, belts and cables
SIMULATOR_ERROR = 0.001   # the same of the simulator
LINEAR_ERROR = 0.0005   # the same if its laws are linear: integrated in another way
LEAST_ERROR = 1e-5      # the same that a fit finds
VALVE_GAIN = 'valve_characteristic_gain'
# The valve position is proportional to gain * full opening / maximum force.
OF_VALVE_GAIN = (VALVE_GAIN, 'valve_characteristic_full_opening',
                 'valve_characteristic_maximum_force')
PASS_S = 1.0   # that a pass of the input of a static characteristic counts for
# Uncertain nominal parameters, by the channel that they act on. Those of a block that is 'off' are
# left out.
UNCERTAIN = {
    'valve': ('valve_characteristic_gain', 'valve_flexure_coil_frequency',
              'valve_flexure_natural_frequency', 'valve_flexure_damping_ratio',
              'valve_flexure_delay', 'valve_hysteresis_radius', 'valve_hysteresis_lag_time',
              'valve_hysteresis_saturation'),
    'force': ('valve_characteristic_full_opening', 'valve_characteristic_maximum_force',
              'hydraulic_damping_linear_gain', 'hydraulic_damping_maximum_force',
              'hydraulic_damping_viscous', 'hydraulic_damping_saturation_velocity',
              *(f'hydraulic_damping_{name}' for name in (
                  'velocity_width', 'width_growth', 'saturation_shift', 'saturation_narrowing',
                  'centre_share')), 'fluid_dynamics_frequency',
              'friction_linear_gain', 'friction_coulomb', 'friction_stiction_push',
              'friction_stiction_pull', 'force_sensor_natural_frequency', 'force_sensor_delay'),
    'load': ('load_mass', 'load_stiffness', 'load_damping', 'load_locked_stiffness',
             'load_locked_damping', 'force_sensor_mass_share', 'force_sensor_natural_frequency',
             'force_sensor_delay'),
}
# Formulation error (rms) of a nonlinearity of the nominal model, as a share of its contribution:
# the change of the output if these fields are 0. Set, as MODEL_ERROR, on blind cases without
# effects.
FORMULATION_ERROR = {
    'valve': ((('valve_hysteresis_radius',), 0.1),),
    'force': ((('friction_coulomb', 'friction_stiction_push', 'friction_stiction_pull'), 0.2),),
    'load': (),
}
# Free shape parameters of the nominal nonlinearities: two formulations of the same law differ in
# shape, even if their size is the same.
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

    scale: units of the bounds of effects. By channel: noise: standard deviation; error_floor:
    expected mean square residual of the right hypothesis, from noise, the general model error and
    `formulation`, the mean square formulation error of the nominal nonlinearities. effects: the
    candidates.
    """

    nominal: np.void
    recordings: Sequence[Recording]
    channels: tuple[str, ...]
    nuisance: tuple[Free, ...]
    scale: Values = field(default_factory=dict)
    noise: Values = field(default_factory=dict)
    error_floor: Values = field(default_factory=dict)
    formulation: Values = field(default_factory=dict)
    effects: Effects = field(default_factory=lambda: EFFECTS)
    given: np.void | None = None   # the nominal record, if `nominal` was changed by another group
    valve: np.void | None = None   # the fit of the valve, from which the force gets its position
    # Of the simulator, if the valve was fitted before: its position per command, m/N. It ties the
    # valve's gain to full opening and maximum force, which the force shows.
    valve_gain: float | None = None
    only_noise_of_valve: bool = False   # is left by its fit: its position is the simulated one
    exact_substep_s: float = 0.0   # sub-step of the simulator that needs no correction
    floor_measured: bool = False   # the error floor is the residual of healthy recordings
    floor_by_best: bool = False    # the best residual limits the model error
    other_formulation: bool = False   # the machine's laws are not formulated as the simulator's
    hides_effects: bool = False   # so that the nominal model explains it only with a model error
    # By channel: the share of white noise's power within the band of the residual; the weight of
    # each sample; the mean square model error of laws that are formulated in another way.
    judged_share: Values = field(default_factory=dict)
    weight: Values = field(default_factory=dict)
    other_error: Values = field(default_factory=dict)
    # Free shape parameters of the simulator's laws, and the same, held near to its own shapes.
    shapes: tuple[Free, ...] = ()
    usual_shapes: tuple[Free, ...] = ()
    other_shapes: tuple[Free, ...] = ()   # free as well if the laws are formulated in another way
    passes: int = 0    # of the input of a static characteristic, in one direction

    def band(self, channel: str) -> float:
        """Return the share of white noise's power in the band in which a channel is compared."""
        return self.judged_share.get(channel, 1.0)

    def judged_floor(self, channel: str) -> float:
        """Return the error floor (mean square) of a channel in that band."""
        return self.error_floor[channel] * self.band(channel)

    @property
    def held_out_s(self) -> float:
        """
        Return the length of the held-out data (validation and test), s.

        A pass of a static characteristic counts as PASS_S, since its duration is arbitrary.
        """
        if self.passes:
            return PASS_S * self.passes
        return sum(float((r.held_out | r.report).sum()) * r.period_s for r in self.recordings)

    def fit_unit(self, channel: str) -> float:
        """
        Return the mean square by which residuals are divided in fits: the error floor.

        If the best residual limits the model error, the noise, since the right hypothesis may
        leave no more: in larger units, the Tikhonov regularisation would end the fit before.
        """
        if not self.floor_by_best:
            return self.error_floor[channel]
        return max(self.noise[channel] ** 2, least_error(self, channel))

    @property
    def as_given(self) -> np.void:
        """Return the nominal record without changes that come from another group."""
        return self.nominal if self.given is None else self.given

    @property
    def may_differ(self) -> bool:
        """Return whether a machine's laws may be formulated in another way than these."""
        return any(self.other_error.values())

    @property
    def measures_valve(self) -> bool:
        """Return whether every recording holds the valve position."""
        return all(recording.valve_position is not None for recording in self.recordings)


def has_motion(recording: Recording) -> bool:
    """Return whether a recording holds the motion of the piston."""
    return recording.velocity is not None or recording.motion is not None


def make_group(nominal: np.void, recordings: Sequence[Recording], channels: tuple[str, ...],
               tolerance: float = TOLERANCE, nuisance: tuple[Free, ...] | None = None,
               effects: Effects = EFFECTS,
               model_error: float = MODEL_ERROR, floor_by_best: bool = False) -> Group:
    """
    Return a group of channels, ready to be fitted.

    model_error: general model error (rms) as a share of the signal's rms; floor_by_best: it is
    smaller if the residual of a hypothesis is.
    """
    noise, error_floor, formulation = {}, {}, {}
    count = 1 + max(recording.number for recording in recordings)
    p = for_recordings(nominal.copy(), count)
    scale = with_valve(scales(recordings), recordings, p)
    p['force_scale'], p['velocity_scale'] = scale['force'], scale['velocity']
    for channel in channels:
        noise[channel] = max(_noise(recording, channel, p) for recording in recordings)
        size = math.sqrt(float(np.mean([np.mean(measured(recording, channel) ** 2)
                                        for recording in recordings])))
        formulation[channel] = _formulation_error(recordings, channel, p)
        error_floor[channel] = (noise[channel] ** 2 + (model_error * size) ** 2
                                + formulation[channel])
    if nuisance is None:
        measured_valve = all(r.valve_position is not None for r in recordings)
        names = channels if measured_valve or 'force' not in channels else ('valve', *channels)
        if not all(map(has_motion, recordings)):
            names = (*names, 'load')
        nuisance = _nuisance(p, names, tolerance, 'valve' in channels)
    effects = freed(effects, partial(in_each, count=count))
    return Group(p, recordings, channels, in_each(nuisance, count), scale, noise, error_floor,
                 formulation, effects, floor_by_best=floor_by_best)


def simulator_group(nominal: np.void, recordings: Sequence[Recording], channels: tuple[str, ...],
                    tolerance: float = TOLERANCE, linear: bool = False) -> Group:
    """
    Return a group of channels that the simulator itself predicts, ready to be fitted.

    linear: the nominal laws are, so a machine's are not formulated in another way. The gain of the
    force sensor is uncertain only if they are not: of few laws, it would be most of what is free.
    """
    own_error, any_error = (LINEAR_ERROR, LINEAR_ERROR) if linear else (
        SIMULATOR_ERROR, MODEL_ERROR)
    count = 1 + max(recording.number for recording in recordings)
    p = for_recordings(with_start_fields(nominal.copy(), recordings), count)
    recordings = [replace(r, valve_estimate=r.valve_position) for r in recordings]
    scale = with_valve(scales(recordings), recordings, nominal)
    if 'force' in channels:
        scale = with_motion(scale, recordings, p)
    scale = with_valve_force(scale, nominal)
    # The units of a coupling: with them the load's mass oscillates at 100 Hz, damped critically.
    mass, pulsation = float(nominal['load_mass']), 200.0 * math.pi
    scale |= {'stiffness': mass * pulsation ** 2, 'coupling': 2.0 * mass * pulsation,
              'inverse_force': 1.0 / scale['force']}
    noise = {channel: max(_judged_noise(recording, channel, p) for recording in recordings)
             for channel in channels}
    size = {channel: float(np.mean([np.mean(measured(recording, channel) ** 2)
                                    for recording in recordings])) for channel in channels}
    error_floor = {channel: noise[channel] ** 2 + own_error ** 2 * size[channel]
                   for channel in channels}
    judged_share = dict.fromkeys(channels, 1.0) | {
        channel: float(np.mean([np.mean(r.motion.judge ** 2) for r in recordings if r.motion]))
        for channel in channels if channel in MOTIONS}
    exact = float(p['maximum_substep'])
    recordings, p['maximum_substep'] = simulator.with_corrections(
        recordings, channels, p, error_floor, exact)
    kinds = [kind for kind in ('valve', 'force') if kind in channels or (
        kind == 'valve' and any(r.valve_position is None for r in recordings))]
    names = [name for kind in kinds for name in forms.UNCERTAIN[kind]
             if not (linear and name == 'force_sensor_gain')]
    nuisance = tuple(Free(name, 0.05, 5.0, (1.0,), 'nominal', prior=0.5 * tolerance)
                     for name in dict.fromkeys(names)
                     if nominal[name] != 0.0 and _is_modelled(name, nominal))
    shapes = {free.field: free for free in _shapes(forms.SHAPES, kinds, nominal)}
    usual = tuple(free for free in nuisance if free.field in shapes)
    nuisance = (*(free for free in nuisance if free not in usual), *shapes.values(),
                *start_parameters(nominal, recordings, channels))
    effects = freed(forms.EFFECTS, partial(in_each, count=count))
    other_error = {channel: (any_error ** 2 - own_error ** 2) * size[channel]
                   + (_formulation_error(recordings, channel, p) if channel == 'valve' else 0.0)
                   for channel in channels}
    return Group(p, recordings, channels, nuisance, scale, noise, error_floor,
                 dict.fromkeys(channels, 0.0), effects, exact_substep_s=exact,
                 judged_share=judged_share, weight=dict.fromkeys(channels, 1.0),
                 other_error=other_error, shapes=tuple(shapes.values()), usual_shapes=usual,
                 other_shapes=_shapes(forms.OTHER_SHAPES, kinds, nominal))


def with_tolerances(group: Group, own: Mapping[str, float]) -> Group:
    """Return a group in which nominal parameters have tolerances of their own, by field."""
    def tolerated(free: Free) -> Free:
        share = own.get(free.field) if free.scale == 'nominal' else None
        if share is None:
            return free
        return (free._replace(low=1.0 - share, high=1.0 + share) if free.prior == math.inf else
                free._replace(prior=0.5 * share))

    return replace(group, nuisance=tuple(map(tolerated, group.nuisance)),
                   usual_shapes=tuple(map(tolerated, group.usual_shapes)))


def with_valve_gain(group: Group, p: np.void) -> np.void:
    """Return a record with the gain of the valve that gives the position which was measured."""
    if group.valve_gain is None:
        return p
    p = p.copy()
    p[VALVE_GAIN] *= group.valve_gain / simulator.metres_per_newton(p)
    return p


def with_less_noisy_valve(group: Group, valve: np.void) -> Group:
    """
    Return a group whose valve position is estimated from its measurement and a fit of the valve.

    The noise of the measured position would mask small changes of the force.
    """
    if 'force' not in group.channels or not group.measures_valve:
        return group
    recordings = [_with_less_noisy_valve(recording, valve) for recording in group.recordings]
    noise = max(_noise(recording, 'force', group.nominal) for recording in recordings)
    floor = group.error_floor['force'] + noise ** 2 - group.noise['force'] ** 2
    return replace(group, recordings=recordings, noise={**group.noise, 'force': noise},
                   error_floor={**group.error_floor, 'force': floor}, valve=valve)


def _with_less_noisy_valve(recording: Recording, valve: np.void) -> Recording:
    estimate, left = simulator.less_noisy_valve(recording, predict(recording, 'valve', valve))
    return replace(recording, valve_estimate=estimate, cache={}, noise={
        **recording.noise, 'valve_position': min(left, recording.noise['valve_position'])})


def with_fitted_start(group: Group, p: np.void) -> Group:
    """Return a group whose recordings have the initial states of a record."""
    def begun(record: np.void) -> np.void:
        record = record.copy()
        for name in record.dtype.names or ():
            if name.partition('@')[0] in START_FIELDS:
                record[name] = p[name]
        return record

    return replace(group, nominal=begun(group.nominal), given=begun(group.as_given))


def prepared_for(group: Group, recording: Recording) -> Recording:
    """Return a recording with the valve position from which a group predicts it."""
    if group.valve is not None:
        return _with_less_noisy_valve(recording, group.valve)
    if not simulator.of_simulator(group.nominal):
        return recording
    position = (simulator.simulated_valve if group.only_noise_of_valve else
                simulator.estimated_valve)
    return replace(recording, valve_estimate=position(
        recording, exact(group, with_valve_gain(group, group.nominal))))


def exact(group: Group, p: np.void) -> np.void:
    """Return a record with the sub-step of the simulator that needs no correction."""
    if not group.exact_substep_s:
        return p
    p = p.copy()
    p['maximum_substep'] = group.exact_substep_s
    return p


def recorrected(group: Group, p: np.void) -> Group:
    """Return a group with the integration error of the sub-step corrected at a record."""
    return replace(group, recordings=simulator.corrected(
        group.recordings, group.channels, p, float(p['maximum_substep']), group.exact_substep_s))


def least_error(group: Group, channel: str) -> float:
    """Return the least mean square error of a model that a fit finds."""
    return LEAST_ERROR ** 2 * float(np.mean(np.concatenate(
        [measured(r, channel)[r.known] for r in group.recordings]) ** 2))


def with_lower_noise(group: Group, residual: Values) -> Group:
    """
    Return a group whose noise is at most the residual of a model, down to LEAST_ERROR.

    residual: mean square by channel. The noise estimate of a slowly sampled signal is too high.
    """
    noise = {channel: min(level, math.sqrt(max(residual[channel], least_error(group, channel))))
             for channel, level in group.noise.items()}
    if all(noise[channel] >= NOISIER * level for channel, level in group.noise.items()):
        return group
    return replace(group, noise=noise, error_floor={
        channel: error_floor - group.noise[channel] ** 2 + noise[channel] ** 2
        for channel, error_floor in group.error_floor.items()})


def _noise(recording: Recording, channel: str, p: np.void) -> float:
    """Return the standard deviation of a channel's noise, with that of the measured inputs."""
    noise = recording.noise
    if channel == 'valve':
        return noise['valve_position']
    if channel in MOTIONS:
        return noise[channel]
    share = 1.0
    if channel == 'load':
        share = math.sqrt(float(np.mean(recording.moved.judge ** 2)))
    return math.hypot(share * noise['force'], math.sqrt(propagated_noise(recording, channel, p)))


def _judged_noise(recording: Recording, channel: str, p: np.void) -> float:
    """Return the rms noise of a channel; of a motion, at least that just above its band."""
    noise = _noise(recording, channel, p)
    if channel not in MOTIONS or recording.motion is None:
        return noise
    return max(noise, noise_above(measured(recording, channel), recording.motion,
                                  recording.period_s))


def _is_modelled(name: str, nominal: np.void) -> bool:
    """Return whether a parameter belongs to a block, or load, of the nominal model."""
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
            # The valve position is proportional to gain * full opening / maximum force. Only the
            # gain is free there, so it gets the tolerance of all three.
            wide = name == 'valve_characteristic_gain' and valve_by_itself
            chosen[name] = Free(name, low ** 2 / high if wide else low,
                                high ** 2 / low if wide else high, (1.0,), 'nominal')
    chosen |= {free.field: free for free in _shapes(SHAPES, channels, nominal)}
    if 'force' in channels:   # a real saturation is rounded
        chosen['corner'] = Free('corner', 0.0, 0.1, (0.03,))
    return tuple(chosen.values())


def _shapes(shapes: Mapping[str, tuple[Free, ...]], channels: Sequence[str], nominal: np.void
            ) -> tuple[Free, ...]:
    """Return the free shape parameters of the blocks of the nominal model."""
    return tuple(free for channel in channels for free in shapes.get(channel, ())
                 if _is_modelled(free.field, nominal)
                 and (free.scale != 'nominal' or nominal[free.field] != 0.0))


def _formulation_error(recordings: Sequence[Recording], channel: str, p: np.void) -> float:
    """Return a channel's mean square formulation error of the nominal nonlinearities."""
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


def is_of_valve(field: str) -> bool:
    """Return whether the simulated position of the valve depends on a parameter."""
    return field in simulator.VALVE_FIELDS or field.partition('@')[0] == FLUX


def channels_of(variant: Variant, group: Group) -> set[str]:
    """Return the channels of a group that a form of an effect acts on; none if not applicable."""
    if not variant.applies(group.nominal):
        return set()
    if simulator.of_simulator(group.nominal):
        return {channel for channel in group.channels
                if any(acts_on(free.field, channel, group) for free in variant.free)}
    shows = set(variant.channels)
    if 'valve' in shows and not group.measures_valve:
        shows.add('force')
    return shows & set(group.channels)


OF_SERVO = ('servo_',)
OF_MECHANICS = ('load_offset', 'load_weight', 'drive_', 'position_gain', 'gravity_', 'swing_',
                'damping_share', 'contact_time', 'friction_creep')


def _channels_by_field() -> dict[str, set[str]]:
    """Return the channels that each parameter acts on, by field."""
    acts_on: dict[str, set[str]] = {'command_phase': {'valve'}, 'corner': {'valve', 'force'}}
    for name in EFFECT_FIELDS:   # of a joint alone
        if name.startswith(OF_SERVO):
            acts_on[name] = {'valve'}
        elif name.startswith(OF_MECHANICS):
            acts_on[name] = {'load'}
    for channel, names in UNCERTAIN.items():
        for name in names:
            acts_on.setdefault(name, set()).add(channel)
        for free in SHAPES[channel]:
            acts_on.setdefault(free.field, set()).add(channel)
    for variant in itertools.chain(*EFFECTS.values()):
        for name in variant.fields:
            acts_on.setdefault(name, set()).update(variant.channels)
    return acts_on


ACTS_ON = _channels_by_field()


def acts_on(field: str, channel: str, group: Group) -> bool:
    """Return whether a parameter acts on a channel."""
    if channel == 'static':
        return True
    field = field.partition('@')[0]
    if simulator.of_simulator(group.nominal):
        if field == VALVE_GAIN and group.valve_gain is not None:
            return channel == 'force'
        if is_of_valve(field) and field not in forms.UNCERTAIN['force']:
            return channel == 'valve' or not group.measures_valve
        return channel == 'force' or (channel in MOTIONS and (
            not field.startswith('force_sensor_')))
    through = channel == 'force' and not group.measures_valve and 'valve' in ACTS_ON[field]
    inert = (field in ('load_mass', 'piston_share', 'force_sensor_mass_share')
             and group.nominal['force_sensor_mass_share'] != 0.0)
    carried = (channel == 'force' and field in UNCERTAIN['load']
               and not all(map(has_motion, group.recordings)))
    return channel in ACTS_ON[field] or through or inert or carried
