"""
Cases of the simulator itself: unchanged, with one of its parameters changed, or an effect on.

Recorded by the code of the two nodes, at 1, 2 and 5 kHz, with every load and several excitations,
with and without noise. The true parameters are within the model that a diagnosis fits, so that no
difference of formulation can cause a wrong answer.
"""

import math
from typing import NamedTuple

import numpy as np

from asi_actuator.model.actuator import simulate
from asi_actuator.model.effects import EFFECT, EFFECTS
from asi_actuator.parameters import ACTUATOR_PARAMETERS, as_record
from asi_analysis.arrays import Array
from asi_analysis.bags.run import Run
from asi_analysis.loop.closed_loop import simulate_loop
from asi_common.parameter import Value
from asi_common.record import field_name
from asi_examiner.refit import refitted

RATES_HZ = (1000.0, 2000.0, 5000.0)
LOADS = ('locked', 'spring', 'free')
DURATION_S = 8.0
UNCHANGED = 0.3        # share of cases of the unchanged simulator
SMALLER = (0.6, 1.0)   # shares of the first recording's excitation, of further recordings
FACTOR = (1.4, 2.5)    # range of the factor, or its reciprocal, by which a parameter is changed
VISIBLE = 2.0          # times the noise; what a refit leaves less of counts as too small
TOLERANCE = 0.2        # within which the nominal parameters are refitted
NOISE = {'force_n': 1.0, 'valve_position_m': 1e-7, 'position_m': 2e-6, 'velocity_m_s': 5e-4}
PROPORTIONAL: dict[str, Value] = {'compensator': 'proportional', 'gain': 3.0}
OPEN: dict[str, Value] = {'compensator': 'proportional', 'gain': 1e-6}
EXCITATIONS: dict[str, dict[str, Value]] = {
    'loop': {**PROPORTIONAL, 'reference.shape': 'multisine', 'reference.frequency': 0.5,
             'reference.end_frequency': 60.0},
    'multisine': {**OPEN, 'reference.shape': 'multisine', 'reference.frequency': 0.5,
                  'reference.end_frequency': 60.0},
    'chirp': {**OPEN, 'reference.shape': 'chirp', 'reference.frequency': 0.5,
              'reference.end_frequency': 100.0, 'reference.duration': DURATION_S - 0.05},
    'steps': {**PROPORTIONAL, 'reference.shape': 'prbs', 'reference.frequency': 1.5},
    'triangle': {**PROPORTIONAL, 'reference.shape': 'triangle', 'reference.frequency': 0.5},
}
# Parameters that are changed: the name of the right answer (an effect of the vocabulary, if it has
# one for it), and the block.
CHANGED = {
    'valve_hysteresis.radius': ('valve_hysteresis', 'valve'),
    'valve_flexure.coil_frequency': ('valve_lag', 'valve'),
    'valve_flexure.delay': ('transport_delay', 'command_path'),
    'valve_characteristic.gain': ('parameter:valve_characteristic.gain', 'valve'),
    'valve_characteristic.maximum_force': ('parameter:valve_characteristic.maximum_force',
                                           'hydraulics'),
    'hydraulic_damping.maximum_force': ('hydraulic_damping', 'hydraulics'),
    'hydraulic_damping.saturation_velocity': ('hydraulic_damping', 'hydraulics'),
    'fluid_dynamics.frequency': ('parameter:fluid_dynamics.frequency', 'hydraulics'),
    'friction.coulomb': ('coulomb_friction', 'mechanics'),
    'friction.stiction_push': ('stiction', 'mechanics'),
    'load.mass': ('parameter:load.mass', 'mechanics'),
    'load.locked_stiffness': ('parameter:load.locked_stiffness', 'mechanics'),
    'load.stiffness': ('parameter:load.stiffness', 'mechanics'),
    'load.damping': ('parameter:load.damping', 'mechanics'),
}
ONLY_OF = {'load.locked_stiffness': 'locked', 'load.stiffness': 'spring', 'load.damping': 'spring'}
# The other parameters that are uncertain, and so are refitted.
UNCERTAIN = (
    'valve_hysteresis.lag_time', 'valve_hysteresis.saturation', 'valve_flexure.natural_frequency',
    'valve_flexure.damping_ratio', 'valve_characteristic.full_opening',
    'hydraulic_damping.viscous', 'hydraulic_damping.velocity_width',
    'hydraulic_damping.centre_share', 'hydraulic_damping.width_growth',
    'hydraulic_damping.saturation_shift', 'hydraulic_damping.saturation_narrowing',
    'friction.stiction_pull', 'friction.stribeck_velocity',
    'friction.presliding_stiffness', 'load.locked_damping', 'force_sensor.natural_frequency',
    'force_sensor.delay', 'force_sensor.mass_share', 'force_sensor.gain')
REFIT_SUBSTEP_S = 1e-4   # of both simulations


# Effects that are switched on, at this range of factors of their example; not what is random.
EFFECTS_ON = tuple(effect for effect in EFFECTS if effect.name != 'sensor_dropout')
SIZE = (0.5, 1.5)


class OwnCase(NamedTuple):
    """One case: what was changed (a parameter, an effect, None) and its factor; recordings."""

    changed: str | None
    factor: float
    sizes: dict[str, float]   # of what is changed: its true values, by field
    visibility: float       # rms that refitted nominal parameters leave, in multiples of the noise
    excitation: str
    rate_hz: float
    nominal: dict[str, Value]
    run: Run
    fresh: Run
    more: tuple[Run, ...] = ()


def draw_own(seed: int, recordings: int = 1) -> OwnCase:
    """Return the case of a seed, with so many recordings besides the fresh one."""
    rng = np.random.default_rng([seed, 14])
    rate, load = float(rng.choice(RATES_HZ)), str(rng.choice(LOADS))
    excitation = str(rng.choice(list(EXCITATIONS)))
    nominal: dict[str, Value] = {'load.type': load}
    size = float(rng.choice([120.0, 250.0]))
    changed, factor, machine = None, 1.0, dict(nominal)
    kind = rng.random()
    if kind > 0.5 * (1.0 + UNCHANGED):
        effect = EFFECTS_ON[rng.integers(len(EFFECTS_ON))]
        changed, factor = effect.name, float(rng.uniform(*SIZE))
        highest = {p.name: p.high for p in ACTUATOR_PARAMETERS}
        machine |= {name: min(factor * value, highest[name]) if isinstance(value, float) else value
                    for name, value in effect.example.items()}
    elif kind > UNCHANGED:
        changed = str(rng.choice([name for name in CHANGED
                                    if ONLY_OF.get(name, load) == load]))
        factor = math.exp(rng.uniform(*np.log(FACTOR))) ** (1.0 if rng.random() < 0.5 else -1.0)
        default = next(p.default for p in ACTUATOR_PARAMETERS if p.name == changed)
        machine[changed] = float(default) * factor
    noise = float(rng.random() < 0.7)
    run, fresh = (_recorded(machine, excitation, size, rate, [seed, number], noise, number + 1)
                  for number in (0, 1))
    assert run.command_n is not None
    visibility = 0.0 if changed is None else _visibility(machine, nominal, run.command_n, rate)
    more = tuple(_recorded(machine, str(rng.choice(list(EXCITATIONS))),
                           float(rng.uniform(*SMALLER)) * size, rate, [seed, number], noise,
                           number)
                 for number in range(4, 3 + recordings))
    sizes = {field_name(name): value for name, value in machine.items()
             if isinstance(value, float)}
    return OwnCase(changed, factor, sizes, visibility, excitation, rate, nominal, run, fresh, more)


def _visibility(machine: dict[str, Value], nominal: dict[str, Value], command: Array,
                rate_hz: float) -> float:
    """
    Return the largest rms change of a signal that the nominal model, refitted, does not explain.

    In multiples of the noise. Both simulate the recorded command, without noise; the nominal
    parameters are refitted within their tolerance.
    """
    load, step = nominal['load.type'], max(1, int(rate_hz / RATES_HZ[0]))
    names = [field_name(name) for name in (*CHANGED, *UNCERTAIN)
             if ONLY_OF.get(name, load) == load]

    def signals(p: np.void, count: int) -> Array:
        p['maximum_substep'] = REFIT_SUBSTEP_S
        run = simulate(p, command[:count], 1.0 / rate_hz)
        return np.array([getattr(run, name)[::step] / level for name, level in NOISE.items()])

    real = signals(as_record(machine), command.size)

    def missed(factors: Array, share: float) -> Array:
        p = as_record(nominal)
        for name, factor in zip(names, factors, strict=True):
            p[name] *= factor
        found = signals(p, int(share * command.size))
        return (found - real[:, :found.shape[1]]).ravel()

    largest = _largest_rms(missed(np.ones(len(names)), 1.0))
    if largest < VISIBLE:
        return largest
    return _largest_rms(missed(refitted(missed, len(names), TOLERANCE), 1.0))


def _largest_rms(missed: Array) -> float:
    """Return the largest rms of the signals in a residual, one after the other."""
    return float(np.sqrt(np.mean(missed.reshape(len(NOISE), -1) ** 2, axis=1)).max())


def _recorded(actuator: dict[str, Value], excitation: str, size: float, rate_hz: float,
              seed: list[int], noise: float, reference: int) -> Run:
    """Return the recording of the nodes; reference: the seed of a random one."""
    controller = {**EXCITATIONS[excitation], 'reference.amplitude': size,
                  'reference.start': 0.05, 'reference.seed': reference}
    signals = simulate_loop(actuator, controller, DURATION_S, rate_hz)._asdict()
    rng = np.random.default_rng(seed)
    for name, level in NOISE.items():
        signals[name] = signals[name] + noise * level * rng.standard_normal(signals[name].size)
    del signals['reference_n']
    return Run(**signals)


def truth(case: OwnCase) -> tuple[str, list[str], list[str]]:
    """Return kind, effects and blocks of the right answer."""
    if case.changed is None:
        return 'none', [], []
    effect, block = (CHANGED[case.changed] if case.changed in CHANGED else
                     (case.changed, EFFECT[case.changed].block))
    return 'effect' if case.visibility > VISIBLE else 'small', [effect], [block]
