"""Choose the experiment of a catalogue that best separates the remaining hypotheses."""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.gap.inference.hypotheses import Weighed
from asi_analysis.gap.inference.probability import Names
from asi_analysis.gap.model.effects import MOTIONS
from asi_analysis.gap.model.group import Group, Values
from asi_analysis.gap.model.predict import predict
from asi_analysis.gap.prepare import Recording, prepare
from asi_analysis.loop.closed_loop import simulate_loop
from asi_common.parameter import Value
from asi_controller.parameters import REFERENCE_PARAMETERS

RATE_HZ, DURATION_S = 1000.0, 6.0
LOADS = next(p for p in ACTUATOR_PARAMETERS if p.name == 'load.type').choices
LARGEST_N = next(p for p in REFERENCE_PARAMETERS if p.name == 'reference.amplitude').high
# With so small a gain only the feedforward of the reference acts: open loop.
OPEN: dict[str, Value] = {'compensator': 'proportional', 'gain': 1e-6}
LOOP: dict[str, Value] = {'compensator': 'proportional', 'gain': 3.0}
# Options of `asi run` by the parameter that they set; other parameters go by --set.
OPTIONS = {'compensator': '--compensator', 'gain': '--gain', 'reference.shape': '--reference',
           'reference.amplitude': '--amplitude', 'reference.offset': '--offset',
           'reference.frequency': '--frequency', 'reference.end_frequency': '--end-frequency'}

# Least rms difference of two predictions that separates them, in error floors.
LEAST_SEPARATION = 1.0
# Signals in the order of their information.
SENSORS = ('position', 'valve_position', 'velocity', 'force')
# Quantities to measure in addition, by the effects that they separate.
MEASURE = (
    (('sensor_offset', 'sensor_drift'), 'the force with no load, before and after the run'),
    (('sensor_gain',), 'a known weight or a calibrated spring with the force sensor'),
    (('supply_pressure', 'internal_leakage'), 'the supply pressure and the flow of oil'),
    (('entrained_air', 'sensor_lag'), 'the pressure in the cylinder'),
    (('transport_delay', 'command_quantisation', 'valve_lag', 'valve_bias', 'valve_deadband'),
     'the current in the coil or motor of the drive'),
    (('backlash', 'load_compliance', 'disturbance_force'), 'the position of the load itself'),
    (('coulomb_friction', 'stiction', 'friction_asymmetry', 'viscous_friction',
      'hydraulic_damping'), 'the force on the load beside that of the sensor'),
)


class Experiment(NamedTuple):
    """
    An excitation of the catalogue.

    controller: parameters of the controller, but for the size; size, offset: shares of the largest
    force; load: its type, None for that of the recordings.
    """

    name: str
    controller: Mapping[str, Value]
    size: float = 1.0
    offset: float = 0.0
    load: str | None = None


def _reference(shape: str, frequency: float, **more: Value) -> dict[str, Value]:
    return {'reference.shape': shape, 'reference.frequency': frequency,
            **{f'reference.{name}': value for name, value in more.items()}}


_TRIANGLE = _reference('triangle', 0.25)
_CHIRP = _reference('chirp', 0.5, end_frequency=150.0)
_SINES = _reference('multisine', 0.5, end_frequency=60.0, tones=30)
_STEPS = _reference('prbs', 1.5)
CATALOGUE = (
    Experiment('slow triangle through zero', {**OPEN, **_TRIANGLE}),
    Experiment('small slow triangle', {**OPEN, **_TRIANGLE}, 0.2),
    Experiment('chirp to 150 Hz', {**OPEN, **_CHIRP}),
    Experiment('small chirp to 150 Hz', {**OPEN, **_CHIRP}, 0.2),
    Experiment('multisine to 60 Hz', {**OPEN, **_SINES}),
    Experiment('steps that are held', {**OPEN, **_STEPS}),
    Experiment('sine about a bias', {**OPEN, **_reference('sine', 5.0)}, 0.4, 0.6),
    Experiment('steps in a closed loop', {**LOOP, **_STEPS}),
    Experiment('multisine in a closed loop', {**LOOP, **_SINES}),
    Experiment('slow triangle in a closed loop', {**LOOP, **_TRIANGLE}),
    Experiment('steps against a locked piston', {**LOOP, **_STEPS}, load='locked'),
)


def settings(experiment: Experiment, force: float) -> dict[str, Value]:
    """
    Return the controller's parameters of an experiment.

    force: the largest, N; at most what the controller allows is used.
    """
    force = min(force, LARGEST_N)
    return {**experiment.controller, 'reference.amplitude': experiment.size * force,
            'reference.offset': experiment.offset * force, 'reference.start': 0.05} | (
        {'reference.duration': DURATION_S - 0.05}
        if experiment.controller['reference.shape'] == 'chirp' else {})


def command_line(experiment: Experiment, force: float, load: str) -> str:
    """Return the `asi run` command of an experiment."""
    words = ['asi run']
    for name, value in settings(experiment, force).items():
        if name in ('reference.start', 'reference.duration') or value == 0.0:
            continue   # the defaults of asi run
        text = f'{value:g}' if isinstance(value, float) else str(value)
        if name in OPTIONS:
            words.append(f'{OPTIONS[name]} {text}')
        else:
            words.append(f'--set controller.{name}={text}')
    return ' '.join([*words, f'--load {experiment.load or load}', f'--rate {RATE_HZ:g}',
                     f'--duration {DURATION_S:g}'])


def simulated(experiment: Experiment, nominal: Mapping[str, Value], force: float) -> Recording:
    """
    Return the simulated recording of the nominal actuator in an experiment.

    Raises InputError if it would not move.
    """
    load = {'load.type': experiment.load} if experiment.load else {}
    run = simulate_loop({**nominal, **load}, settings(experiment, force), DURATION_S, RATE_HZ)
    return prepare([Run(**run._asdict(), source=experiment.name)])[0]


def separation(group: Group, recording: Recording, first: np.void, second: np.void) -> float:
    """Return the rms difference of two predictions of a recording, in error floors."""
    valid = recording.valid
    apart = 0.0
    for channel in group.channels:
        if channel in ('load', *MOTIONS) and recording.motion is None:   # a locked piston
            continue
        difference = (predict(recording, channel, first) - predict(recording, channel, second))
        apart += float(np.mean(difference[valid] ** 2)) / group.error_floor[channel]
    return math.sqrt(apart)


def pairs_of(groups: list[Weighed], ambiguous: list[Names]
             ) -> list[tuple[Group, np.void, np.void]]:
    """
    Return the pairs of records whose predictions are compared, with their group.

    If all but `unknown` share one record of a group, the next most probable one is added.
    """
    pairs = []
    effects = set().union(*map(set, ambiguous))
    for weighed in groups:
        own = {tuple(name for name in names if any(name in key for key in weighed.candidates))
               for names in ambiguous}
        known = [names for names in own if names in weighed.candidates]
        if len(known) == 1 and effects & {'unknown'}:
            others = sorted((names for names in weighed.candidates if names not in known),
                            key=lambda names: -weighed.probability[names])
            known += others[:1]
        records = [weighed.candidates[names].fitted.record for names in sorted(known)]
        pairs += [(weighed.group, a, b) for a, b in itertools.combinations(records, 2)]
    return pairs


def suggestion(excitation: str, command: str | None, separation_: float,
               separations: Mapping[str, float], ambiguous: Sequence[Names],
               missing: Sequence[str]) -> dict[str, object]:
    """
    Return the next experiment as in the document, with `advice` in words.

    separation_: rms difference of the predictions of `ambiguous`, in error floors; below
    LEAST_SEPARATION no experiment is suggested. missing: signals that were not recorded.
    """
    separates = separation_ >= LEAST_SEPARATION
    sensor = next((signal for signal in SENSORS if signal in missing), None)
    steps = [f'record the {sensor.replace("_", " ")} too'] if sensor else []
    if separates:
        steps.append(f'record this: {excitation}' + (f' ({command})' if command else ''))
    elif not steps:
        everywhere = [name for name in ambiguous[0] if all(name in names for names in ambiguous)]
        uncertain = {name for names in ambiguous for name in names if name not in everywhere}
        quantity = next((text for names, text in MEASURE if uncertain & set(names)), None)
        steps = ['no recording of these signals separates them'
                 + (f': measure {quantity}' if quantity else '')]
    return {'excitation': excitation, 'separation': separation_, 'separations': dict(separations),
            'command': command if separates else None, 'separates': separates,
            'advice': '; '.join(steps)}


def choose(groups: list[Weighed], ambiguous: list[Names], model: Mapping[str, Value], force: float,
           missing: Sequence[str] = ()) -> dict[str, object] | None:
    """
    Return the experiment of the catalogue that separates the hypotheses `ambiguous` best.

    The score is that of the worst pair; experiments in which the nominal actuator would not
    move are skipped. model: the actuator's nominal parameters; force: the largest, N; missing:
    signals that were not recorded. None if fewer than two hypotheses can be predicted.
    """
    pairs = pairs_of(groups, ambiguous)
    own = str(model.get('load.type', LOADS[0]))
    worst: Values = {}
    for experiment in CATALOGUE if pairs else ():
        try:
            recording = simulated(experiment, model, force)
        except InputError:   # too small to overcome the nominal friction
            continue
        load = LOADS.index(experiment.load or own)
        worst[experiment.name] = min(
            separation(group, recording, _with_load(a, load), _with_load(b, load))
            for group, a, b in pairs)
    if not worst:
        return None
    best = max((experiment for experiment in CATALOGUE if experiment.name in worst),
               key=lambda experiment: worst[experiment.name])
    return suggestion(best.name, command_line(best, force, own), worst[best.name], worst,
                      ambiguous, missing)


def _with_load(record: np.void, load: int) -> np.void:
    """Return a record with another type of load."""
    changed = record.copy()
    changed['load_type'] = load
    return changed
