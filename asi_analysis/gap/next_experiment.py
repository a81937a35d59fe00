"""The experiment that would separate the hypotheses which are left, from how they predict it."""

import itertools
import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from asi_actuator.parameters import as_record
from asi_analysis.gap import blocks
from asi_analysis.gap.fit import Group, Values, predict
from asi_analysis.gap.prepare import Recording, prepare
from asi_analysis.gap.verdict import Names, Weighed
from asi_analysis.run import Run
from asi_controller.parameters import REFERENCE_PARAMETERS
from asi_controller.reference import reference_force

PERIOD_S, DURATION_S = 1e-3, 6.0


class Experiment(NamedTuple):
    """An excitation of the catalogue: parameters of the reference that the controller plays."""

    name: str
    reference: dict[str, str | float]
    options: str     # of `asi run`; {force}, {small}, {part}, {rest}: forces, N


CATALOGUE = (
    Experiment('slow triangle through zero', {'shape': 'triangle', 'frequency': 0.2},
               '--reference triangle --frequency 0.2 --amplitude {force}'),
    Experiment('small slow triangle', {'shape': 'triangle', 'frequency': 0.5, 'size': 0.2},
               '--reference triangle --frequency 0.5 --amplitude {small}'),
    Experiment('chirp to 150 Hz', {'shape': 'chirp', 'frequency': 0.5, 'end_frequency': 150.0,
                                   'duration': DURATION_S},
               '--reference chirp --frequency 0.5 --end-frequency 150 --amplitude {force}'),
    Experiment('small chirp to 150 Hz', {'shape': 'chirp', 'frequency': 0.5, 'size': 0.2,
                                         'end_frequency': 150.0, 'duration': DURATION_S},
               '--reference chirp --frequency 0.5 --end-frequency 150 --amplitude {small}'),
    Experiment('multisine to 60 Hz', {'shape': 'multisine', 'frequency': 0.5,
                                      'end_frequency': 60.0, 'tones': 30},
               '--reference multisine --frequency 0.5 --end-frequency 60 --amplitude {force}'),
    Experiment('steps that are held', {'shape': 'prbs', 'frequency': 1.5},
               '--reference prbs --frequency 1.5 --amplitude {force}'),
    Experiment('sine about a bias', {'shape': 'sine', 'frequency': 5.0, 'size': 0.4,
                                     'offset': 0.6},
               '--reference sine --frequency 5 --amplitude {part} --offset {rest}'),
)


def played(experiment: Experiment, force: float) -> npt.NDArray[np.float64]:
    """Return the desired force (N) of an experiment."""
    values = dict(experiment.reference)
    size, offset = float(values.pop('size', 1.0)), float(values.pop('offset', 0.0))
    named = {f'reference.{name}': value for name, value in values.items()}
    named |= {'reference.amplitude': size * force, 'reference.offset': offset * force,
              'reference.start': 0.0}
    record = as_record(named, REFERENCE_PARAMETERS)
    return np.array([reference_force(k * PERIOD_S, record)
                     for k in range(int(DURATION_S / PERIOD_S))])


def separation(group: Group, recording: Recording, first: np.void, second: np.void) -> float:
    """Return how differently two hypotheses predict a recording, in multiples of the floor."""
    kept = recording.fit | recording.held_out
    apart = 0.0
    for channel in group.channels:
        difference = (predict(recording, channel, first) - predict(recording, channel, second))
        apart += float(np.mean(difference[kept] ** 2)) / group.floor[channel]
    return math.sqrt(apart)


def imagined(experiment: Experiment, nominal: np.void, force: float) -> Recording:
    """Return what the nominal chain would record in an experiment, open loop, without noise."""
    gain = float(nominal['valve_characteristic_gain'])
    command = np.divide(played(experiment, force), gain)
    valve = np.empty(command.size)
    blocks.valve(command, *blocks.parts(nominal), PERIOD_S, 10, valve)
    time = np.arange(command.size, dtype=np.float64) * PERIOD_S
    static = (valve / nominal['valve_characteristic_full_opening']
              * nominal['valve_characteristic_maximum_force'])
    omega = 2.0 * np.pi * np.fft.rfftfreq(command.size, PERIOD_S)
    stiffness = blocks.load_constants(nominal)[2]
    whole = blocks.impedance(omega, nominal) * 1j * omega + stiffness
    whole[0] = whole[0] or 1.0
    position = np.fft.irfft(np.fft.rfft(static) / whole, command.size)
    return prepare([Run(time, command_n=command, force_n=static, valve_position_m=valve,
                        position_m=position, velocity_m_s=np.gradient(position, PERIOD_S),
                        source=experiment.name)])[0]


def choose(groups: list[Weighed], left: list[Names], nominal: np.void, force: float,
           load: str) -> dict[str, object] | None:
    """
    Return the experiment of the catalogue that separates the hypotheses `left` best.

    Each pair counts by the group in which it differs; the experiment is judged by the pair that it
    separates worst. None if fewer than two hypotheses with a prediction are left.
    """
    pairs = []
    for weighed in groups:
        own = {tuple(name for name in names if (name,) in weighed.candidates or any(
            name in key for key in weighed.candidates)) for names in left}
        records = [weighed.candidates[names].fitted.record for names in own
                   if names in weighed.candidates]
        pairs += [(weighed.group, a, b) for a, b in itertools.combinations(records, 2)]
    if not pairs:
        return None
    worst: Values = {}
    for experiment in CATALOGUE:
        recording = imagined(experiment, nominal, force)
        worst[experiment.name] = min(separation(group, recording, a, b) for group, a, b in pairs)
    best = max(CATALOGUE, key=lambda experiment: worst[experiment.name])
    options = best.options.format(force=f'{force:.0f}', small=f'{0.2 * force:.0f}',
                                  part=f'{0.4 * force:.0f}', rest=f'{0.6 * force:.0f}')
    return {'excitation': best.name, 'separation': worst[best.name],
            'separations': worst,
            'command': f'asi run {options} --load {load} --duration {DURATION_S:.0f}'}
