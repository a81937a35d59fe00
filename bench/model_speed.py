"""
The model's inner loop against the same equations written by hand in C.

Every load with every combination of effects on and off. The trajectories must be equal; then the
processor time of a sub-step is measured, alternating between both.
"""

import ctypes
import itertools
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from asi_actuator.model.actuator import STATE_DTYPE, rest, simulate
from asi_actuator.parameters import ACTUATOR_DTYPE, RING, as_record
from asi_common.parameter import Value
from bench.result import Result, deviation, interleaved, ratios, show

Array = npt.NDArray[np.float64]
Model = Callable[[np.void], Array]

PERIOD_S: Final = 2e-4
# Half a second near the limit cycle, with noise, so that no branch is always taken.
TIME_S: Final = np.arange(2500) * PERIOD_S
COMMANDS: Final = (1000.0 * np.sin(2.0 * np.pi * 90.0 * TIME_S)
                   + np.random.default_rng(1).normal(0.0, 50.0, TIME_S.size))
LOADS: Final = ('locked', 'spring', 'free', 'prescribed')
EFFECTS: Final = ('valve_hysteresis', 'valve_flexure', 'valve_characteristic',
                  'hydraulic_damping', 'fluid_dynamics', 'friction', 'force_sensor')
# Every effect that is null by default, switched on.
WITHHELD: Final[dict[str, Value]] = {
    'command_path.delay': 0.00131, 'command_path.quantum': 5.0, 'valve_flexure.bias': 20.0,
    'valve_flexure.deadband': 10.0, 'valve_flexure.lag_time': 0.001,
    'valve_flexure.second_lag_time': 0.0004, 'valve_flexure.travel_limit': 1.5e-5,
    'valve_characteristic.deadband': 1e-6,
    'valve_characteristic.bias': -5e-7, 'valve_characteristic.flow_limit': 800.0,
    'valve_characteristic.supply_drop': 0.1, 'valve_characteristic.supply_sag': 0.2,
    'hydraulic_damping.tail': 1.4, 'hydraulic_damping.quadratic': 50.0,
    'hydraulic_damping.opening_viscous': 80.0,
    'fluid_dynamics.leakage': 0.1, 'fluid_dynamics.leakage_growth': 1e-4,
    'fluid_dynamics.air_time': 0.001, 'friction.coulomb_asymmetry': 0.3, 'friction.viscous': 40.0,
    'friction.location': 'load', 'friction.presliding_slip': 0.6,
    'friction.softening': 0.5, 'friction.element_ratio': 1.8,
    'friction.presliding_exponent': 1.4,
    'load.external_force': 30.0, 'load.external_force_start': 0.05,
    'load.external_force_frequency': 7.0, 'coupling.stiffness': 2e6, 'coupling.damping': 100.0,
    'backlash.gap': 2e-5, 'backlash.centre': 5e-6, 'force_sensor.lag_time': 0.0005,
    'force_sensor.second_lag_time': 0.0002, 'force_sensor.drift': 3.0,
    'force_sensor.drift_curve': -1.0}
# The slowest combinations are measured again, as the first maximum is biased by noise.
AGAIN: Final = 8
TARGET: Final = '<= 1.1'


class Case(NamedTuple):
    """A load, and the effects that are on."""

    load: str
    on: tuple[str, ...]
    withheld: bool = False

    def record(self) -> np.void:
        """Return the parameters."""
        values: dict[str, Value] = {'load.type': self.load, 'load.velocity': 0.2,
                                    'load.frequency': 5.0} | (WITHHELD if self.withheld else {})
        return as_record(values | {f'{effect}.model': 'full' if effect in self.on else 'off'
                                   for effect in EFFECTS})

    def name(self) -> str:
        """Return it in words."""
        off = [effect for effect in EFFECTS if effect not in self.on]
        if self.withheld:
            return f'{self.load}, all effects, and all that are null by default'
        if not off:
            return f'{self.load}, all effects'
        if not self.on:
            return f'{self.load}, no effect'
        return (f'{self.load}, without {", ".join(off)}' if len(off) < 4
                else f'{self.load}, only {", ".join(self.on)}').replace('_', ' ')


CASES: Final = [Case(load, tuple(itertools.compress(EFFECTS, on))) for load in LOADS
                for on in itertools.product((True, False), repeat=len(EFFECTS))]
ALL_ON: Final = [Case(load, EFFECTS, True) for load in LOADS]


def header() -> str:
    """Return the records that the Python code uses, as C structures."""
    text = f'#define RING {RING}\n'
    for name, dtype in (('parameters', ACTUATOR_DTYPE), ('state', STATE_DTYPE)):
        fields = ''.join(
            f'    {"long" if field.base.kind == "i" else "double"} {field_name}'
            f'{"".join(f"[{size}]" for size in field.shape)};\n'
            for field_name, field in ((n, dtype[n]) for n in dtype.names or ()))
        text += f'struct {name} {{\n{fields}}};\n'
    return text


def compiled(*flags: str) -> Model:
    """Return the C model as a function of the parameters' record, compiled with `flags`."""
    folder = Path(tempfile.mkdtemp(prefix='asi_bench_'))
    (folder / 'model_parameters.h').write_text(header())
    library = folder / 'model.so'
    subprocess.run(['cc', '-O3', '-march=native', *flags, '-fPIC', '-shared', f'-I{folder}', '-o',
                    library, Path(__file__).with_name('model.c'), '-lm'], check=True)
    function = ctypes.CDLL(str(library)).simulate

    def run(p: np.void) -> Array:
        out, state, record = np.empty((4, COMMANDS.size)), rest(), p.copy()
        function(*(ctypes.c_void_p(a.ctypes.data) for a in (np.atleast_1d(record), COMMANDS)),
                 ctypes.c_long(COMMANDS.size), ctypes.c_double(PERIOD_S),
                 *(ctypes.c_void_p(a.ctypes.data) for a in (np.atleast_1d(state), out)))
        return out
    return run


def ours(p: np.void) -> Array:
    """Return force, valve position, position and velocity of our model."""
    return np.stack(simulate(p, COMMANDS, PERIOD_S)[2:])


def substeps(p: np.void) -> int:
    """Return how many sub-steps a run takes."""
    return COMMANDS.size * round(PERIOD_S / float(p['maximum_substep']))


def difference(one: Array, other: Array) -> float:
    """Return the largest difference of two trajectories, relative to the largest value."""
    largest = np.maximum(np.abs(one).max(1), 1e-300)
    return float((np.abs(one - other).max(1) / largest).max())


def timed(case: Case, models: Mapping[str, Model], rounds: int) -> dict[str, list[float]]:
    """Return nanoseconds a sub-step of each model."""
    p = case.record()
    times = interleaved({name: partial(model, p) for name, model in models.items()}, rounds,
                        time.thread_time)
    return {name: [1e9 * second / substeps(p) for second in each]
            for name, each in times.items()}


def against(name: str, what: str, times: Mapping[str, list[float]], rival: str) -> Result:
    """Return how our time compares with a rival's."""
    ratio, spread = ratios(times['ours'], times[rival])
    strict = rival == 'C'
    return Result(f'model.{name}', what, float(np.median(times['ours'])), 'ns a sub-step', spread,
                  rival, ratio, TARGET if strict else '', 1.0 / ratio if strict else None)


def measure(quick: bool) -> list[Result]:
    """Compare our inner loop with C; raises RuntimeError if the two differ."""
    models: dict[str, Model] = {'ours': ours, 'C': compiled()}
    cases = CASES[::37] if quick else CASES
    worst = max(difference(ours(p), models['C'](p))
                for p in (case.record() for case in (*cases, *ALL_ON)))
    if worst > 1e-9:
        raise RuntimeError(f'model.c and the model differ by {worst:.2g}: a change of the '
                           'equations goes into both')
    results = [Result('model.difference', f'largest difference of a signal, over {len(cases)} '
                      'combinations of load and effects', worst, 'of its size', rival='C',
                      target='<= 1e-9')]
    rounds = 3 if quick else 40
    fast = models | {'C, -ffast-math': compiled('-ffast-math')}
    for load in LOADS:
        times = timed(Case(load, EFFECTS), fast, rounds)
        results.append(against(load, f'{load}, all effects', times, 'C'))
        results.append(against(f'{load}.fast_math', f'{load}, all effects', times,
                               'C, -ffast-math'))
    for case in ALL_ON:
        results.append(against(f'{case.load}.withheld', case.name(), timed(case, models, rounds),
                               'C'))
    first = {case: ratios(*timed(case, models, 1 if quick else 5).values())[0] for case in cases}
    middle = float(np.median(list(first.values())))
    results.append(Result('model.median', f'median of {len(cases)} combinations', middle,
                          'times C', deviation(list(first.values())), 'C', middle, TARGET))
    slowest = sorted(cases, key=lambda case: -first[case])[:AGAIN]
    again = [against('worst', f'the slowest of them: {case.name()}', timed(case, models, rounds),
                     'C') for case in slowest]
    return [*results, max(again, key=lambda result: result.ratio or 0.0)]


if __name__ == '__main__':
    show(measure('--quick' in sys.argv))
