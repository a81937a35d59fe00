"""
Blind cases: effect, size, excitation and errors of the nominal model, drawn from a seed.

An effect is drawn large enough to be detectable: at least VISIBLE times the noise after errors of
the nominal parameters have explained as much of it as they can, computed with the examiner's own
plant (`visibility`).

A case of the world `foreign` differs from the conditions for which the diagnosis was developed:
another machine, loop gain and excitation, more and coloured noise, and a few additional effects
that are too small to detect.
"""

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import lsq_linear

from asi_examiner.plant import PERIOD_S, Bench, plant, simulate

Array = npt.NDArray[np.float64]
Values = dict[str, float]

DURATION_S = 10.0
ERROR = 0.2   # of a nominal parameter, at most: the tolerance of the diagnosis
VISIBLE, INVISIBLE = 2.0, 0.5
NOISE = np.array([1.0, 2e-8, 1e-6, 5e-4])   # N, m, m, m/s
SMALL_EFFECTS = 3   # number of additional undetectable effects of a foreign case

# The nominal parameters of the actuator: name in the user's model file, and value.
NOMINAL = {
    'gain': ('valve_characteristic.gain', 0.535),
    'coil': ('valve_flexure.coil_frequency', 26.1),
    'pipe': ('valve_flexure.natural_frequency', 890.0),
    'pipe_damping': ('valve_flexure.damping_ratio', 0.359),
    'delay': ('valve_flexure.delay', 1.003e-3),
    'full_opening': ('valve_characteristic.full_opening', 2e-5),
    'maximum_force': ('valve_characteristic.maximum_force', 1000.0),
    'fluid': ('fluid_dynamics.frequency', 1000.0),
    'mass': ('load.mass', 0.5),
}
SPRING = {'stiffness': ('load.stiffness', 2e5), 'damper': ('load.damping', 20.0)}
LOCKED = {'stiffness': ('load.locked_stiffness', 1.12e6), 'damper': ('load.locked_damping', 50.0)}
TEXTBOOK = {'damping': ('hydraulic_damping.linear_gain', 1000.0)}
FULL = {
    'damping': ('hydraulic_damping.viscous', 970.0),
    'family_force': ('hydraulic_damping.maximum_force', 1200.0),
    'family_velocity': ('hydraulic_damping.saturation_velocity', 0.452),
    'base_hysteresis': ('valve_hysteresis.radius', 14.0),
    'base_lag': ('valve_hysteresis.lag_time', 0.654e-3),
    'base_coulomb': ('friction.coulomb', 7.0),
    'base_push': ('friction.stiction_push', 27.0),
    'base_pull': ('friction.stiction_pull', 15.0),
    'sensor_corner': ('force_sensor.natural_frequency', 800.0),
    'sensor_delay': ('force_sensor.delay', 0.1e-3),
}
# Fixed properties of the full plant (plant.py) in the user's model.
FULL_MODEL = {
    'hydraulic_damping.centre_share': 0.021, 'hydraulic_damping.saturation_shift': 0.112,
    'hydraulic_damping.saturation_narrowing': 0.422, 'hydraulic_damping.velocity_width': 0.198,
    'hydraulic_damping.width_growth': 0.217, 'friction.stribeck_velocity': 0.005,
    'friction.presliding_stiffness': 2e5, 'force_sensor.damping_ratio': 0.7,
    'valve_hysteresis.rate_exponent': 0.0, 'valve_hysteresis.rate_filter': 1500.0,
    'valve_hysteresis.saturation': 1e6, 'friction.presliding_damping': 0.0,
    'force_sensor.mass_share': 0.0, 'force_sensor.card_frequency': 1e5,
}
TEXTBOOK_MODEL = {
    'force_sensor.mass_share': 0.0,
    'valve_hysteresis.model': 'off', 'valve_characteristic.model': 'off',
    'hydraulic_damping.model': 'linear', 'friction.model': 'off', 'force_sensor.model': 'off',
}
EXCITATIONS = ('loop', 'multisine', 'chirp', 'steps', 'triangle')
FOREIGN_EXCITATIONS = (*EXCITATIONS, 'tones', 'noise', 'binary')
# Ranges of the factors between a foreign machine and the nominal parameters above.
FOREIGN = {'gain': (0.5, 2.0), 'coil': (0.6, 2.5), 'pipe': (0.4, 1.2), 'full_opening': (0.1, 10.0),
           'fluid': (0.2, 1.5), 'mass': (0.4, 10.0), 'stiffness': (0.2, 4.0),
           'damper': (0.3, 10.0), 'damping': (0.5, 2.0)}

EFFECTS = {
    'transport_delay': 'command_path', 'command_quantisation': 'command_path',
    'valve_hysteresis': 'valve', 'valve_deadband': 'valve', 'valve_saturation': 'valve',
    'valve_bias': 'valve', 'valve_lag': 'valve', 'hydraulic_damping': 'hydraulics',
    'supply_pressure': 'hydraulics', 'internal_leakage': 'hydraulics',
    'entrained_air': 'hydraulics', 'coulomb_friction': 'mechanics', 'stiction': 'mechanics',
    'friction_asymmetry': 'mechanics', 'viscous_friction': 'mechanics', 'backlash': 'mechanics',
    'load_compliance': 'mechanics', 'disturbance_force': 'mechanics', 'sensor_offset': 'sensor',
    'sensor_gain': 'sensor', 'sensor_lag': 'sensor', 'sensor_drift': 'sensor',
}
OUTSIDE = ('slew_limit', 'one_sided_gain', 'cubic_spring', 'fading_gain', 'dropouts', 'ripple',
           'resonance', 'position_gain')
# Effects that a foreign case may have in addition, at a fiftieth of their size.
MAY_BE_SMALL = ('transport_delay', 'valve_hysteresis', 'valve_deadband', 'valve_bias', 'valve_lag',
            'hydraulic_damping', 'internal_leakage', 'coulomb_friction', 'viscous_friction',
            'disturbance_force', 'sensor_offset', 'sensor_lag', 'sensor_drift', 'one_sided_gain',
            'position_gain', 'cubic_spring', 'fading_gain')


# Effects that are the same as a nominal parameter of another value, beside the parameter itself.
SAME = {'coil': ('valve_lag',), 'pipe': ('valve_lag',), 'pipe_damping': ('valve_lag',),
        'delay': ('transport_delay',), 'damping': ('hydraulic_damping',),
        'maximum_force': ('supply_pressure',), 'base_hysteresis': ('valve_hysteresis',),
        'base_lag': ('valve_hysteresis',), 'base_coulomb': ('coulomb_friction',),
        'base_push': ('stiction',), 'base_pull': ('stiction',), 'sensor_corner': ('sensor_lag',),
        'sensor_delay': ('sensor_lag',), 'family_force': ('hydraulic_damping',),
        'family_velocity': ('hydraulic_damping',)}


class Case(NamedTuple):
    """One blind case: the recording and the true answer."""

    seed: int
    world: str                    # 'textbook', 'full' or 'foreign'
    excitation: str
    load: str
    effects: tuple[str, ...]      # the truth; () if there is none
    kind: str                     # 'effect', 'pair', 'none', 'small' or 'outside'
    visibility: float             # of the effect, in multiples of the noise
    nominal: dict[str, Any]       # the user's model file
    plant: np.void
    without: np.void              # the same plant without the effect
    reference: Array
    bench: Bench
    recording: Array              # 5 x n
    # What is there too: effects at a fiftieth of their size, parameters beyond the tolerance.
    small: tuple[str, ...] = ()


def _log(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(math.log(low), math.log(high))))


def _sign(rng: np.random.Generator) -> float:
    return 1.0 if rng.random() < 0.5 else -1.0


def draw_effect(name: str, rng: np.random.Generator, size: Values, world: str) -> Values:
    """Return the plant's parameters of an effect; size: amplitudes of the signals without it."""
    u, force, v, x, z = (size[key] for key in 'ufvxz')
    friction = {'slip_distance': _log(rng, 1e-5, 1e-4),
                'dahl': _log(rng, 0.5, 2.0) * float(rng.random() < 0.5)}
    push = _sign(rng) * _log(rng, 0.03, 0.2) * force
    choices: dict[str, Values] = {
        'transport_delay': {'extra_delay': _log(rng, 1e-3, 1e-2), 'jitter': rng.uniform(0, 0.3)},
        'command_quantisation': {'quantum': _log(rng, 0.03, 0.25) * u},
        'valve_hysteresis': {'loop_width': _log(rng, 0.02, 0.2) * u,
                             'loop_preisach': float(rng.random() < 0.5),
                             'loop_exponent': rng.uniform(1.0, 2.0)},
        'valve_deadband': ({'deadband': _log(rng, 0.02, 0.2) * u} if rng.random() < 0.7 else
                           {'orifice_deadband': _log(rng, 0.02, 0.2) * z}),
        'valve_saturation': ({'travel_limit': rng.uniform(0.4, 0.85) * z * size['full']}
                             if rng.random() < 0.5 else
                             {'force_limit': rng.uniform(0.4, 0.85) * force}),
        'valve_bias': {'bias': _sign(rng) * _log(rng, 0.01, 0.15) * u},
        'valve_lag': {'extra_lag': _log(rng, 2e-3, 2e-2)},
        'hydraulic_damping': {'turbulent': _log(rng, 0.05, 0.5) * force / v ** 2,
                              'turbulent_opening': rng.uniform(0.0, 0.1) * force / v},
        'supply_pressure': ({'supply_drop': rng.uniform(0.28, 0.55)} if rng.random() < 0.4 else
                            {'supply_sag': rng.uniform(0.2, 0.7) * 1000.0 / max(force, 300.0),
                             'supply_time': _log(rng, 0.08, 0.6)}),
        'internal_leakage': {'leak': _log(rng, 0.2, 1.5)},
        'entrained_air': {'air_time': _log(rng, 1e-3, 1e-2), 'air_force': _log(rng, 50, 500)},
        'coulomb_friction': {'friction': _log(rng, 0.02, 0.2) * force, 'breakaway': 1.0,
                             **friction},
        'stiction': {'friction': _log(rng, 0.02, 0.12) * force, 'breakaway': rng.uniform(1.8, 4.0),
                     'stribeck': _log(rng, 0.05, 0.3) * v, **friction, 'dahl': 0.0},
        'friction_asymmetry': {'friction': _log(rng, 0.02, 0.2) * force, 'breakaway': 1.0,
                               'asymmetry': _sign(rng) * rng.uniform(0.3, 0.8), **friction},
        'viscous_friction': {'viscous': _log(rng, 0.02, 0.2) * force / v},
        'backlash': {'gap': _log(rng, 0.01, 0.15) * x, 'piston_share': 0.4},
        'load_compliance': {'coupling': _log(rng, 0.3, 3.0) * size['k'], 'piston_share': 0.4},
        'disturbance_force': ({'push_constant': push} if rng.random() < 0.25 else
                              {'push_sine': push, 'push_frequency': _log(rng, 0.5, 30)}
                              if rng.random() < 0.6 else
                              {'push_burst': 2.0 * push, 'burst_start': rng.uniform(1.0, 4.0),
                               'burst_end': rng.uniform(5.0, 9.0)}),
        'sensor_offset': {'sensor_offset': push},
        'sensor_gain': {'sensor_scale': _sign(rng) * rng.uniform(0.25, 0.5)},
        'sensor_lag': {'sensor_lag': _log(rng, 1e-3, 1e-2)},
        'sensor_drift': {'drift': 2.0 * push, 'drift_time': _log(rng, 3.0, 15.0)},
        'slew_limit': {'slew': rng.uniform(1.5, 6.0) * u},
        'one_sided_gain': {'one_sided_gain': _sign(rng) * rng.uniform(0.2, 0.4)},
        'cubic_spring': {'cubic_spring': rng.uniform(0.3, 1.0) / (1e5 * x ** 2)},
        'fading_gain': {'fading_gain': rng.uniform(0.3, 0.6)},
        'dropouts': {'dropout': _log(rng, 0.002, 0.008)},
        'ripple': {'ripple': rng.uniform(0.05, 0.2) * force,
                   'ripple_pitch': rng.uniform(0.1, 0.4) * x},
        'resonance': {'resonance': _log(rng, 15.0, 60.0),
                      'resonance_share': rng.uniform(0.3, 0.8)},
        'position_gain': {'position_gain': _sign(rng) * rng.uniform(0.3, 0.6) / x},
    }
    values = choices[name]
    if world == 'full':   # the model has these effects; the plant has them with another size
        changed = {
            'valve_hysteresis': {'base_hysteresis': 14.0 * _log(rng, 3.0, 8.0)},
            'hydraulic_damping': {'damping': 970.0 * rng.choice([0.4, 1.8, 2.5])},
            'stiction': {'base_push': 27.0 * rng.uniform(2.0, 4.0),
                         'base_pull': 15.0 * rng.uniform(2.0, 4.0)},
            'coulomb_friction': {'base_coulomb': 7.0 * rng.uniform(2.5, 5.0),
                                 'base_push': 27.0 + 14.0, 'base_pull': 15.0 + 20.0},
        }
        return changed.get(name, values)
    return values


def excite(kind: str, rng: np.random.Generator, peak: float) -> Array:
    """Return n desired forces or valve commands of a kind of excitation; peak: its maximum."""
    t = np.arange(int(DURATION_S / PERIOD_S)) * PERIOD_S
    if kind == 'multisine':
        tones = np.geomspace(0.4, rng.uniform(30, 80), 25)
        signal = sum(np.sin(2 * np.pi * f * t + rng.uniform(0, 2 * np.pi)) / f ** 0.25
                     for f in tones)
    elif kind == 'chirp':
        rate = np.geomspace(0.3, rng.uniform(40, 90), t.size)
        signal = np.sin(2 * np.pi * np.cumsum(rate) * PERIOD_S) * rng.uniform(0.7, 1.0)
        signal = signal + 0.3 * np.sin(2 * np.pi * 0.31 * t)
    elif kind == 'tones':
        signal = sum(np.sin(2 * np.pi * _log(rng, 0.5, 20.0) * t + rng.uniform(0, 2 * np.pi))
                     for _ in range(int(rng.integers(1, 4))))
    elif kind in ('noise', 'binary'):
        length = int(0.5 / rng.uniform(10.0, 60.0) / PERIOD_S)
        levels = rng.standard_normal(t.size // length + 1)
        signal = np.repeat(np.sign(levels) if kind == 'binary' else levels, length)[:t.size]
    elif kind == 'triangle':
        f = rng.uniform(0.3, 0.8)
        signal = 2 / np.pi * np.arcsin(np.sin(2 * np.pi * f * t)) * (0.4 + 0.6 * t / t[-1])
    else:   # steps, and the reference of the closed loop: random constant levels
        signal = np.zeros(t.size)
        start = 0
        while start < t.size:
            length = int(rng.uniform(0.08, 0.6) / PERIOD_S)
            signal[start:start + length] = rng.uniform(-1, 1)
            start += length
        if kind == 'loop':
            signal = signal + 0.25 * sum(np.sin(2 * np.pi * f * t + rng.uniform(0, 6.3))
                                         for f in (3.1, 11.3, 37.0))
    return peak * np.asarray(signal) / np.abs(signal).max()


def visibility(p: np.void, without: np.void, nominal_values: Values, recording: Array,
               noise: Array) -> float:
    """
    Return the rms of the signal change due to an effect, in multiples of the noise.

    Both plants replay the recorded command, without noise. The part that errors of the nominal
    parameters explain (linearised, within ERROR of the nominal values `believed`) is subtracted;
    the result is the largest over the signals.
    """
    quiet = Bench(False, 0.0, 0.0, np.zeros(4), 0.0)
    command = recording[0]
    base = simulate(without, command, quiet, 0)
    change = simulate(p, command, quiet, 0) - base
    columns, low, high = [], [], []
    for name, value in nominal_values.items():
        low.append((1.0 - ERROR) * value / without[name] - 1.0)
        high.append((1.0 + ERROR) * value / without[name] - 1.0)
        varied = without.copy()
        varied[name] *= 1.02
        columns.append((simulate(varied, command, quiet, 0) - base) / 0.02)
    largest = 0.0
    for signal, level in ((1, noise[0]), (2, noise[1]), (4, noise[3])):
        matrix = np.array([column[signal] for column in columns]).T
        fit = lsq_linear(matrix / level, change[signal] / level, (low, high))
        largest = max(largest, math.sqrt(2.0 * fit.cost / change[signal].size))
    return largest


def foreign(rng: np.random.Generator, closed: bool, names: dict[str, tuple[str, float]]
            ) -> tuple[dict[str, tuple[str, float]], Bench]:
    """Return the nominal parameters of another machine, and its bench."""
    drawn = {key: (name, value * _log(rng, *FOREIGN[key]) if key in FOREIGN else value)
             for key, (name, value) in names.items()}
    noise = NOISE * [_log(rng, 0.3, 5.0) for _ in NOISE]
    noise[1] *= drawn['full_opening'][1] / names['full_opening'][1]
    return drawn, Bench(closed, rng.uniform(0.5, 3.0), 1.0 / drawn['gain'][1], noise,
                        rng.uniform(0.3, 0.95) if rng.random() < 0.5 else 0.0)


def scaled_down(effect: Values) -> Values:
    """Return an effect with a fiftieth of its size and the same shape."""
    return {key: value * (1.0 if key in (
        'slip_distance', 'dahl', 'breakaway', 'piston_share', 'drift_time') else 0.02)
        for key, value in effect.items()}


def draw(seed: int, world: str = 'textbook', load: str = 'spring', kind: str | None = None,
         effects: tuple[str, ...] | None = None, excitation: str | None = None,
         beyond: float | None = None) -> Case:
    """
    Return the case of a seed; arguments that are not given are drawn.

    beyond: every fifth nominal parameter is off by more than ERROR, up to this factor, and is
    part of the answer.
    """
    rng, world_rng = np.random.default_rng([seed, 7]), np.random.default_rng([seed, 13])
    excitation = excitation or EXCITATIONS[rng.choice(5, p=[0.3, 0.25, 0.2, 0.15, 0.1])]
    kind = kind or str(rng.choice(['effect', 'pair', 'none', 'small', 'outside'],
                                  p=[0.6, 0.12, 0.12, 0.04, 0.12]))
    model = world   # the user's model: textbook or full
    if world == 'foreign':
        model = str(world_rng.choice(['textbook', 'full']))
        excitation = str(world_rng.choice(FOREIGN_EXCITATIONS))
    names = {**NOMINAL, **(SPRING if load == 'spring' else LOCKED),
             **(TEXTBOOK if model == 'textbook' else FULL)}
    bench = Bench(excitation == 'loop', 3.0, 1.0 / 0.535, NOISE, 0.0)
    if world == 'foreign':
        names, bench = foreign(world_rng, bench.closed, names)
    nominal: dict[str, Any] = dict(names.values())
    nominal |= {'load.type': load} | (
        TEXTBOOK_MODEL if model == 'textbook' else FULL_MODEL)
    true = {key: value * (1.0 + ERROR * rng.uniform(-1, 1)) for key, (_, value) in names.items()}
    if beyond:
        far_rng = np.random.default_rng([seed, 17])
        for key, (_, value) in names.items():
            if far_rng.random() < 0.2:
                true[key] = value * _log(far_rng, 1.0 + ERROR, beyond) ** _sign(far_rng)
    true['friction_inside'] = float(rng.random() < 0.5) if model == 'textbook' else 1.0
    true['saturates'] = true['family'] = float(model == 'full')
    nominal_values = {key: value for key, (_, value) in names.items()}

    force = rng.uniform(250, 700)
    reference = excite(excitation, rng, force if bench.closed else force / true['gain'])
    clean = simulate(plant(true), reference, bench, seed)
    size = {name: float(np.quantile(np.abs(signal), 0.98))
            for name, signal in zip('ufzxv', clean, strict=True)}
    size |= {'z': size['z'] / true['full_opening'], 'k': true['stiffness'],
             'full': true['full_opening']}
    small = tuple(map(str, world_rng.choice(MAY_BE_SMALL, SMALL_EFFECTS, replace=False)
                      if world == 'foreign' else ()))
    for name in small:
        true |= scaled_down(draw_effect(name, world_rng, size, 'textbook'))
    small += tuple(cause for key, (name, value) in names.items()
                   if beyond and not 1.0 - ERROR <= true[key] / value <= 1.0 + ERROR
                   for cause in (f'parameter:{name}', *SAME.get(key, ())))
    without = plant(true)

    for _ in range(30):
        if effects is not None:
            chosen = effects
        elif kind == 'none':
            chosen = ()
        elif kind == 'outside':
            chosen = (str(rng.choice(OUTSIDE)),)
        else:
            chosen = tuple(map(str, rng.choice(list(EFFECTS), 2 if kind == 'pair' else 1,
                                               replace=False)))
        values, weakest = dict(true), math.inf
        changes = [draw_effect(name, rng, size, model) for name in chosen]
        if len(changes) == 2 and changes[0].keys() & changes[1].keys():
            continue   # both set the same parameter: only one effect would remain
        for change in changes:
            if kind == 'small':
                change = scaled_down(change)
            single = plant({**true, **change})
            recording = simulate(single, reference, bench, seed)
            if np.isfinite(recording).all():
                weakest = min(weakest, visibility(single, without, nominal_values, recording,
                                                  bench.noise))
            else:
                weakest = -1.0
            values |= change
        if not chosen:
            weakest = 0.0
            break
        if (kind == 'small' and 0.0 <= weakest <= INVISIBLE
                or kind != 'small' and weakest >= VISIBLE):
            break
    if small and kind in ('none', 'small'):   # detecting one of them is not a false alarm
        kind, chosen = 'small', (*chosen, *small)
    actual = plant(values)
    recording = simulate(actual, reference, bench, seed)
    return Case(seed, world, excitation, load, chosen, kind, weakest, nominal, actual, without,
                reference, bench, recording, small)
