"""
Search for conditions under which a compensator's loop cycles: random, then by mutation.

Varied are reference, load (or a constant velocity at which the piston is moved), an external force
that ends (so that the motion starts away from rest), parameter errors of ±20 % and the control
rate. Each condition excites the loop and then removes
the excitation; an oscillation that persists is sustained. A condition consists of parameters only,
so that it can be run over ROS.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_analysis.loop.closed_loop import close_many, loops_of
from asi_analysis.loop.simulation import Values, run_until_settled
from asi_analysis.measures.oscillation import FLOOR_N, Oscillation, of_samples
from asi_analysis.parallel import each
from asi_analysis.terminal import Progress, silent
from asi_common.parameter import Value

# Duration of the excitation, of the simulation after it, and half of the part that is measured.
EXCITED_S: Final = 0.25
FREE_S: Final = 0.45
WATCHED_S: Final = 0.12
VARIED: Final = (
    'valve_hysteresis.radius', 'valve_hysteresis.lag_time', 'valve_flexure.coil_frequency',
    'valve_flexure.natural_frequency', 'valve_flexure.damping_ratio', 'valve_flexure.delay',
    'valve_characteristic.gain', 'hydraulic_damping.viscous', 'fluid_dynamics.frequency',
    'friction.coulomb', 'friction.stiction_push', 'load.locked_stiffness',
    'force_sensor.natural_frequency', 'force_sensor.delay')
SHAPES: Final = ('step', 'sine', 'prbs', 'chirp', 'triangle')
LOADS: Final = ('locked', 'spring', 'free', 'prescribed')
# Largest velocity (m/s) at which the piston is moved: the gain of the command grows with it.
FASTEST_M_S: Final = 0.6
# Share of the trials that are random; the others are mutations of the worst found so far.
RANDOM_SHARE: Final = 0.4
# Conditions in a generation, and in a piece of work of one process.
GENERATION: Final = 32
PIECE: Final = 8


class Condition(NamedTuple):
    """A condition, as numbers from 0 to 1 by name (NAMES); `settings` maps them to parameters."""

    numbers: Mapping[str, float]

    def settings(self, rates_hz: tuple[float, ...], actuator: Values) -> dict[str, Any]:
        """Return parameters of actuator (errors about its own) and reference, and rate (Hz)."""
        n = self.numbers
        actuator = with_errors(actuator, n)
        actuator['load.type'] = _choice(LOADS, n['load'])
        if actuator['load.type'] != 'locked':
            actuator['load.mass'] = 0.3 * 30.0 ** n['mass']
            actuator['load.stiffness'] = 1e4 * 50.0 ** n['stiffness']
        actuator['load.velocity'] = 2.0 * FASTEST_M_S * (n['motion'] - 0.5)
        actuator['load.frequency'] = 0.0
        actuator['load.external_force'] = 900.0 * (n['push'] - 0.5)
        actuator['load.external_force_end'] = EXCITED_S
        frequency = 3.0 * 60.0 ** n['speed']
        reference: dict[str, Value] = {
            'reference.shape': _choice(SHAPES, n['shape']), 'reference.start': 0.0,
            'reference.amplitude': 900.0 * n['amplitude'] ** 2,
            'reference.offset': 800.0 * (n['offset'] - 0.5), 'reference.frequency': frequency,
            'reference.end_frequency': 2.0 * frequency, 'reference.duration': EXCITED_S,
            'reference.end': EXCITED_S}
        return {'actuator': actuator, 'reference': reference,
                'rate_hz': _choice(rates_hz, n['rate'])}


NAMES: Final = (*VARIED, 'load', 'mass', 'stiffness', 'rate', 'shape', 'amplitude', 'offset',
                'speed', 'push', 'motion')


def with_errors(actuator: Values, numbers: Mapping[str, float]) -> dict[str, Value]:
    """
    Return the parameters VARIED of an actuator with errors of up to 20 %.

    numbers: from 0 (20 % less) to 1 (20 % more), by name.
    """
    found: dict[str, Value] = {}
    for parameter in ACTUATOR_PARAMETERS:
        if parameter.name in VARIED:
            value = float(actuator.get(parameter.name, parameter.default)) * (
                0.8 + 0.4 * numbers[parameter.name])
            found[parameter.name] = min(max(value, parameter.low), parameter.high)
    return found


class Trial(NamedTuple):
    """
    A condition and the oscillation at its end.

    growth_1_s: growth rate of the amplitude just after the excitation, -inf without oscillation.
    """

    condition: Condition
    found: Oscillation
    growth_1_s: float

    @property
    def sustained(self) -> bool:
        return bool(self.found.sustained)

    @property
    def amplitude_n(self) -> float:
        """Amplitude of the oscillation (N); infinite if it diverges, 0 if there is none."""
        if self.sustained and not math.isfinite(self.found.amplitude_n):
            return math.inf
        return 0.0 if math.isnan(self.found.amplitude_n) else self.found.amplitude_n


def _choice(options: tuple, number: float) -> Any:
    return options[min(int(number * len(options)), len(options) - 1)]


def run_trials(conditions: Sequence[Condition], actuator: Values, controller: Values,
               rates_hz: tuple[float, ...]) -> list[Trial]:
    """Return a trial of each condition; those of one rate run in parallel."""
    settings = [condition.settings(rates_hz, actuator) for condition in conditions]
    found: dict[int, Trial] = {}
    for rate in {s['rate_hz'] for s in settings}:
        chosen = [k for k, s in enumerate(settings) if s['rate_hz'] == rate]
        measured = _measured([settings[k] for k in chosen], actuator, controller, rate)
        found |= {k: Trial(conditions[k], *one) for k, one in zip(chosen, measured, strict=True)}
    return [found[k] for k in range(len(conditions))]


def _measured(settings: Sequence[dict[str, Any]], actuator: Values, controller: Values,
              rate: float) -> list[tuple[Oscillation, float]]:
    """Return the oscillation at the end of each setting, and the early growth rate, 1/s."""
    loops = loops_of(
        [{**actuator, **s['actuator']} for s in settings],
        [{**controller, **s['reference']} for s in settings], rate)
    watched = 2 * int(WATCHED_S * rate)
    forces = close_many(loops, EXCITED_S + FREE_S, FREE_S)[:, 2]
    found = [of_samples(force[-watched:], rate) for force in forces]
    growth = [_growth(of_samples(force[:watched], rate)) for force in forces]
    # The time of the next run starts at 0: without this the reference would be repeated.
    loops.references['reference_amplitude'] = 0.0
    # In so short a time a slow decay can look sustained: these are simulated until settled.
    candidates = np.array([k for k, each in enumerate(found)
                         if each.sustained and math.isfinite(each.amplitude_n)], np.intp)
    for k, run in zip(candidates, run_until_settled(loops.subset(candidates)), strict=True):
        found[k] = of_samples(run.force_n, rate)
    return list(zip(found, growth, strict=True))


def _growth(early: Oscillation) -> float:
    if early.sustained and not math.isfinite(early.amplitude_n):
        return math.inf
    return early.growth_1_s if early.amplitude_n > FLOOR_N else -math.inf


def _severity(trial: Trial) -> tuple[float, float]:
    # Oscillations that are not sustained are ranked by their growth rate.
    return (trial.amplitude_n if trial.sustained else 0.0, trial.growth_1_s)


def search(actuator: Values, controller: Values, rates_hz: tuple[float, ...], count: int,
           seed: int, report: Progress = silent) -> list[Trial]:
    """Return `count` trials, the most severe first."""
    random = np.random.default_rng(seed)
    trials: list[Trial] = []
    while len(trials) < count:
        report(f'{sum(t.sustained for t in trials)} sustained in {len(trials)} conditions',
               len(trials) / count)
        worst = sorted(trials, key=_severity)[-8:]
        conditions = [_condition(random, worst if number >= RANDOM_SHARE * count else [])
                      for number in range(len(trials), min(len(trials) + GENERATION, count))]
        for done in each(run_trials, ((conditions[k:k + PIECE], actuator, controller, rates_hz)
                                    for k in range(0, len(conditions), PIECE))):
            trials += done
    return sorted(trials, key=_severity, reverse=True)


def _condition(random: np.random.Generator, parents: Sequence[Trial]) -> Condition:
    """Return a condition near one of the parents, or anywhere if there are none."""
    if not parents:
        return Condition(dict(zip(NAMES, map(float, random.random(len(NAMES))), strict=True)))
    parent = parents[int(random.integers(len(parents)))]
    step = 0.3 * random.random() * random.standard_normal(len(NAMES))
    return Condition({name: float(np.clip(value + d, 0.0, 1.0)) for (name, value), d in zip(
        parent.condition.numbers.items(), step, strict=True)})
