"""
Work spread over processes and over a Dask cluster of this machine, against one process.

The work is that of `asi ensemble`: one task computes all facts of a parameter set. Each worker of
the cluster is a process. Starting the cluster and importing its modules are not timed.
"""

import os
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from asi_analysis.paper.calibration.ensemble import problem_of
from asi_analysis.paper.calibration.quantities import Candidate
from asi_analysis.paper.calibration.search import Problem
from asi_analysis.paper.facts.conditions import Conditions
from asi_analysis.parallel import each, workers
from bench.local_cluster import cluster
from bench.result import Result, interleaved, ratios, show

PIECES: Final = 6


def piece(problem: Problem, number: int) -> str:
    """Return all facts of a parameter set near the defaults: one task."""
    point = problem.start[list(problem.free)]
    point = np.clip(point + 0.01 * np.random.default_rng(number).normal(size=point.size), 0.0, 1.0)
    return repr(sorted(problem.measure(point).items()))


def all_pieces(problem: Problem, count: int, **where: Any) -> list[str]:
    """Return the results of all tasks."""
    with workers(**where):
        return list(each(piece, ((problem, number) for number in range(count))))


def measure(quick: bool) -> list[Result]:
    """Return the speed-up; raises RuntimeError if a result differs."""
    cores = len(os.sched_getaffinity(0))
    problem, count = problem_of(Candidate({}, Conditions())), 2 if quick else PIECES
    with tempfile.TemporaryDirectory() as folder, cluster(cores, Path(folder)) as address:
        ways = {'alone': partial(all_pieces, problem, count),
                'processes': partial(all_pieces, problem, count, jobs=cores),
                'cluster': partial(all_pieces, problem, count, dask=address)}
        expected = ways['alone']()
        for name in ('processes', 'cluster'):
            if ways[name]() != expected:
                raise RuntimeError(f'the results of {name} differ from those of one process')
        times = interleaved(ways, 1 if quick else 2)
    results = []
    for name, what in (('processes', f'--jobs {cores}'),
                       ('cluster', f'--dask, {cores} worker processes')):
        speedup, deviation = ratios(times['alone'], times[name])
        results.append(Result(f'cluster.{name}', f'times as fast: {what}',
                              float(np.median(times[name])) / count, 's for a parameter set',
                              deviation, '--jobs 1', speedup, '', speedup / cores))
    return results


if __name__ == '__main__':
    show(measure('--quick' in sys.argv))
