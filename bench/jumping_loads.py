"""
`python -m bench.jumping_loads [COUNT]`: sluggish PI loops whose load jumps, attributed by shape.

First-order processes without delay, which are not those of the training set (`valve_loops.py`).
The cause is a disturbance; a load that jumps looks most like a valve that sticks. Printed for each
wave: the mean and the largest probability of stiction, and how many of COUNT (20) loops are
attributed to stiction or to a disturbance with LEAST_PROBABILITY or more.
"""

import sys
from collections.abc import Callable
from typing import Final

import numpy as np
from scipy import signal

from asi_analysis.arrays import Array
from asi_analysis.errors import InputError
from asi_analysis.limit_cycle.attribution.classifier import LEAST_PROBABILITY
from asi_analysis.limit_cycle.attribution.recording import shape_probabilities
from asi_analysis.limit_cycle.attribution.shape import shape

Random = np.random.Generator

SAMPLES: Final = 3000


def _telegraph(turns: Array, random: Random) -> Array:
    """Return a square whose half periods scatter by a tenth."""
    ends = np.cumsum(0.5 * (1.0 + 0.1 * random.standard_normal(SAMPLES)))
    return np.where(np.searchsorted(ends, turns) % 2, 1.0, -1.0)


WAVES: Final[dict[str, Callable[[Array, Random], Array]]] = {
    'sawtooth': lambda turns, _: np.asarray(signal.sawtooth(2.0 * np.pi * turns)),
    'square': lambda turns, _: np.asarray(signal.square(2.0 * np.pi * turns)),
    'trapezoid': lambda turns, _: np.clip(
        4.0 * np.asarray(signal.sawtooth(2.0 * np.pi * turns, 0.5)), -1.0, 1.0),
    'telegraph': _telegraph,
    'step that decays': lambda turns, _: np.exp(-3.0 * (turns % 1.0)),
}


def record(wave: str, seed: int) -> tuple[Array, Array, Array]:
    """Return time (s), command and output of a loop; the sensor has noise."""
    random = np.random.default_rng(seed)
    lag, gain = random.uniform(5.0, 20.0), random.uniform(0.3, 1.0)
    integral, period = random.uniform(1.0, 3.0) * lag, random.uniform(60.0, 200.0)
    load = WAVES[wave](np.arange(SAMPLES) / period, random)
    level = total = 0.0
    rows = np.empty((SAMPLES, 2))
    for k in range(SAMPLES):
        measured = level + 0.01 * random.standard_normal()
        total -= gain / integral * measured
        command = total - gain * measured
        level += (command + load[k] - level) / lag
        rows[k] = command, measured
    return np.arange(SAMPLES, dtype=float), rows[:, 0], rows[:, 1]


def chances(wave: str, count: int) -> list[dict[str, float]]:
    """Return the probabilities of the causes of loops with a load; those refused are left out."""
    found = []
    for seed in range(count):
        try:
            found.append(shape_probabilities(shape(*record(wave, seed))))
        except InputError:
            continue
    return found


def main() -> None:
    """Print a line for each wave."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    print('| load | stiction, mean | largest | named stiction | named disturbance | loops |')
    print('|---|---|---|---|---|---|')
    for wave in WAVES:
        found = chances(wave, count)
        named = [sum(each[cause] >= LEAST_PROBABILITY for each in found)
                 for cause in ('stiction', 'disturbance')]
        stiction = [each['stiction'] for each in found]
        print(f'| {wave} | {np.mean(stiction):.2f} | {max(stiction):.2f} | {named[0]} | '
              f'{named[1]} | {len(found)} |', flush=True)


if __name__ == '__main__':
    main()
