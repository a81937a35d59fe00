"""
Many closed loops at once: computing time of a simulated second, by batch size and cores.

Each loop has its own parameters; only the last 10 ms are stored. The cost is the processor time of
all threads; the speed-up by the cores is measured in wall time.
"""

import os
import resource
import sys
import time
from functools import partial
from typing import Final

import numpy as np

from asi_analysis.loop.closed_loop import Loops, close_many, loops_of
from bench.result import Result, interleaved, ratios, show

DURATION_S: Final = 0.05
KEPT_S: Final = 0.01
SIZES: Final = (1, 10, 100, 1000, 10_000)
RATE_HZ: Final = 5000.0


def batch(size: int) -> Loops:
    """Return so many loops whose mass and gain differ."""
    loops = loops_of([{}], [{'gain': 3.0, 'reference.shape': 'step', 'reference.start': 0.0}],
                     RATE_HZ).subset(np.zeros(size, np.intp))
    loops.plants['load_mass'] = np.linspace(1.0, 4.0, size)
    loops.compensators['gain'] = np.linspace(1.0, 6.0, size)
    return loops


def on(cores: set[int], loops: Loops) -> None:
    """Run a batch on these cores only."""
    mine = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        close_many(loops, DURATION_S, KEPT_S)
    finally:
        os.sched_setaffinity(0, mine)


def measure(quick: bool) -> list[Result]:
    """Return cost against size, speed-up by the cores, and the memory of the largest batch."""
    sizes = SIZES[:3] if quick else SIZES
    results = []
    costs: dict[int, float] = {}
    for size in sizes:
        loops = batch(size)
        rounds = 3 if quick or size > 1000 else 15
        times = interleaved({'run': partial(close_many, loops, DURATION_S, KEPT_S)},
                            rounds, time.process_time)['run']
        costs[size] = float(np.median(times)) / (size * DURATION_S)
        results.append(Result(f'many.cost.{size}', 'closed loops, a simulated second',
                              1e3 * costs[size], 'ms of processor time', at=float(size)))
    largest, hundred = sizes[-1], sizes[2]
    results.append(Result('many.flat', f'a simulated second among {largest:,} runs',
                          1e3 * costs[largest], 'ms of processor time', 0.0, f'among {hundred}',
                          costs[largest] / costs[hundred], '<= 1.1'))
    cores = sorted(os.sched_getaffinity(0))
    loops = batch(sizes[-2])
    times = interleaved({'one': lambda: on({cores[0]}, loops),
                         'all': lambda: on(set(cores), loops)}, 3 if quick else 12)
    speedup, spread = ratios(times['one'], times['all'])
    results.append(Result('many.cores', f'times as fast on {len(cores)} cores, {sizes[-2]} runs',
                          1e3 * float(np.median(times['all'])) / (sizes[-2] * DURATION_S),
                          'ms for a simulated second', spread, 'one core', speedup,
                          f'>= {0.95 * len(cores):.2g}', speedup / len(cores)))
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    results.append(Result('many.memory', f'largest memory of the process, {largest:,} runs',
                          memory, 'MiB'))
    return results


if __name__ == '__main__':
    show(measure('--quick' in sys.argv))
