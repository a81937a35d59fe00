"""
`python -m bench.plan [--machines 5 --seed 0]`: whether a plan helps a diagnosis.

Joints of the examiner, each with one effect, are moved by the plan of `asi gap --plan` and by
simple references of the same length within the same limits; each recording is diagnosed with the
same nominal model. Printed: how often the effect is named first.
"""

import argparse
import json
import warnings
from collections.abc import Mapping
from typing import Final

import numpy as np
from scipy.signal import chirp

from asi_analysis import parallel
from asi_analysis.arrays import Array
from asi_analysis.errors import InputError, InputWarning
from asi_analysis.gap.diagnose import diagnose
from asi_analysis.gap.diagnosis import Diagnosis
from asi_analysis.gap.experiment.plan import Limits, plan_courses
from asi_common.parameter import Value
from asi_examiner.joint import Machine, draw_machine, moved, with_suspect

SUSPECTS: Final = ('coulomb_friction', 'stiction', 'friction_asymmetry', 'viscous_friction',
                   'backlash', 'load_compliance', 'transport_delay', 'valve_lag', 'gravity',
                   'spring', 'mass', 'none')
ALSO_RIGHT: Final = {'viscous_friction': {'viscous_friction', 'parameter:load.damping'},
                     'mass': {'parameter:load.mass'}, 'none': {'no_gap'}}
TRIES: Final = 20


def references(machine: Machine, given: Mapping[str, Value], tolerance: float
               ) -> dict[str, Array]:
    """Return the planned reference of a machine and others, rad."""
    period = 1.0 / machine.rate_hz
    force = 6.0 * machine.torque
    limits = Limits(-machine.size, machine.size, machine.speed, force)
    plan = plan_courses(('command', 'position'), limits, period, given, tolerance)
    time = period * np.arange(plan.position.size)
    reach, often = limits.reach, machine.speed / (2.0 * np.pi * limits.reach)
    return {'plan': plan.position,
            'sine, half the speed': reach * np.sin(np.pi * often * time),
            'small chirp': 0.1 * reach * chirp(time, 0.1 * often, time[-1], 5.0 * often,
                                               'logarithmic', -90.0)}


def first(diagnosis: Diagnosis) -> str:
    """Return what a diagnosis names first; gravity and spring are of the nominal joint."""
    verdict = '+'.join(diagnosis.verdict) or 'no_gap'
    notes = ' '.join(diagnosis.notes)
    found = [name for name, words in (('gravity', 'the joint has gravity'),
                                      ('spring', 'a spring holds')) if words in notes]
    return '+'.join(([] if verdict == 'no_gap' and found else [verdict]) + found)


def one(seed: int) -> list[dict[str, object]]:
    """Return what was found of each suspect by each reference."""
    machine, tolerance = draw_machine(seed), 0.2
    given: dict[str, Value] = {'load.mass': machine.values['inertia'],
                               'load.damping': machine.values['damping']}
    rows: list[dict[str, object]] = []
    played = references(machine, given, tolerance)
    for number, name in enumerate(SUSPECTS):
        for attempt in range(TRIES):
            rng = np.random.default_rng([seed, number, attempt])
            values = machine.values if name == 'none' else with_suspect(machine, name, rng)
            runs = {kind: moved(machine, values, course, rng) for kind, course in played.items()}
            if all(run is not None for run in runs.values()):
                break
        for kind, run in runs.items():
            with warnings.catch_warnings():
                warnings.simplefilter('ignore', InputWarning)
                try:
                    assert run is not None
                    found = first(diagnose([run], given, 'joint', tolerance))
                except InputError as error:
                    found = f'refused: {error}'
            right = ALSO_RIGHT.get(name, {name})
            rows.append({'seed': seed, 'suspect': name, 'reference': kind, 'first': found,
                         'right': found in right})
    return rows


def main() -> None:
    """Print how often each suspect is named first, by reference."""
    parser = argparse.ArgumentParser(description=__doc__, prog='python -m bench.plan')
    parser.add_argument('--machines', type=int, default=5)
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--jobs', type=int, default=1)
    parser.add_argument('--rows', action='store_true', help='each diagnosis as a line of JSON')
    options = parser.parse_args()
    seeds = range(options.seed, options.seed + options.machines)
    rows: list[dict[str, object]] = []
    with parallel.workers(options.jobs):
        for each in parallel.each(one, [(seed,) for seed in seeds]):
            rows += each
            if options.rows:
                print('\n'.join(map(json.dumps, each)), flush=True)
    kinds = list(dict.fromkeys(str(row['reference']) for row in rows))
    print(f'{"named first of " + str(options.machines):<22}', *(f'{kind:>22}' for kind in kinds))
    for name in (*SUSPECTS, ''):
        counts = [[row['right'] for row in rows if row['reference'] == kind
                   and name in (row['suspect'], '')] for kind in kinds]
        print(f'{name or "all":<22}', *(f'{sum(each):>15} of {len(each):>3}' for each in counts),
              flush=True)


if __name__ == '__main__':
    main()
