"""
`python -m torture.clean RUNS SEED`: false alarms of the data quality, on undamaged runs.

Runs of the simulator with different loads, compensators, additions, references, rates and noise:
as they are, and without the record of their controller, as if they came from another system.
"""

import sys
from collections.abc import Iterator
from dataclasses import replace
from random import Random
from typing import Any, Final

from rich.console import Console
from rich.progress import track

from asi_analysis.bags.run import Run
from asi_analysis.loop.in_process import simulate
from asi_analysis.measures.quality import findings

ADDITIONS: Final[tuple[dict[str, Any], ...]] = (
    {'hysteresis_inverse.size': 20.0}, {'friction_feedforward.level': 10.0},
    {'gain_schedule.velocity': 0.1}, {'velocity_feedforward.share': 0.5},
    {'reference_model.bandwidth': 50.0}, {'integrator.rate': 5.0}, {'saturation': 110.0},
    {'notch.frequency': 90.0, 'notch.depth': 0.1}, {'disturbance_observer.bandwidth': 5.0})
SHAPES: Final = ('step', 'step', 'sine', 'multisine', 'chirp', 'prbs', 'ramp', 'triangle')


def runs(count: int, random: Random) -> Iterator[Run]:
    """Yield so many runs."""
    for _ in range(count):
        actuator = {'load.type': random.choice(('spring', 'locked', 'free', 'prescribed')),
                    'force_sensor.noise': random.choice((0.0, 0.1, 0.5, 2.0))}
        controller: dict[str, Any] = {
            'compensator': random.choice(('proportional', 'lead_lag', 'lead2', 'lead4')),
            'reference.shape': random.choice(SHAPES),
            'reference.amplitude': random.choice((30.0, 100.0, 200.0))}
        if random.random() < 0.3:
            controller['feedforward'] = random.choice((0.5, 1.0))
        if random.random() < 0.4:
            controller |= random.choice(ADDITIONS)
        yield simulate(actuator, controller, random.choice((0.6, 1.0, 2.0)),
                       random.choice((500.0, 1000.0, 2000.0, 5000.0)))


def main() -> None:
    """Print the number of runs with a finding."""
    count, seed = int(sys.argv[1]), int(sys.argv[2])
    noted = {'controller recorded': 0, 'controller not recorded': 0}
    for run in track(runs(count, Random(seed)), 'clean runs', count, console=Console(stderr=True)):
        for name, each in zip(noted, (run, replace(run, information={})), strict=True):
            if found := findings(each):
                noted[name] += 1
                print(f'{name}: {found[0].text}', file=sys.stderr)
    for name, number in noted.items():
        print(f'{name}: {number} of {count} runs with a finding')


if __name__ == '__main__':
    main()
