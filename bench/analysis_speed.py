"""
Processor time of the analyses, and its growth with the length of a recording.

Recordings of the loop in process at 1 kHz, the rate of a real-time run: steps of the reference, a
limit cycle, and a loop that only holds a force, with noise.
"""

import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from asi_actuator.parameters import as_record
from asi_analysis.bags.bag import read_bag, write_bag
from asi_analysis.bags.run import Run
from asi_analysis.gap.diagnose import diagnose
from asi_analysis.limit_cycle.detection.answer import detect_limit_cycles
from asi_analysis.loop.bench import RATE_HZ, Bench
from asi_analysis.loop.one_harmonic import COMMANDS_N, OneHarmonic, locus
from asi_analysis.loop.simulation import loop_of
from asi_analysis.measures.analysis import analyze
from asi_examiner.bags import as_run
from asi_examiner.cases import draw
from asi_examiner.joint import draw_machine, moved, with_suspect
from bench.result import Result, show

EVERY: Final = 5           # every 5th sample of the 5000 Hz at which the bench runs
LENGTHS_S: Final = (60, 200, 600)
NOISE_N: Final = 0.5
# Proportional gains: at rest below the onset, a cycle above it.
GAINS: Final = {'steps': 4.0, 'rest': 4.0, 'cycle': 12.0}


def recording(kind: str, length_s: int) -> Run:
    """Return a recording of a kind: 'steps', 'rest' or 'cycle'."""
    bench = Bench(as_record({'force_sensor.noise': NOISE_N}),
                  {'compensator': 'proportional', 'gain': GAINS[kind]})
    pieces = [bench.run(1.0, 300.0 * (k % 2 if kind == 'steps' else 1.0))
              for k in range(length_s)]
    signals = [np.concatenate(each)[::EVERY] for each in zip(*pieces, strict=True)]
    return Run(*signals)


def seconds(work: Callable[[], Any]) -> float:
    """Return the processor time of a piece of work."""
    begin = time.process_time()
    work()
    return time.process_time() - begin


def growth(quick: bool) -> list[Result]:
    """Return the time of step and limit-cycle analysis against the length of a recording."""
    results, lengths = [], (10, 20) if quick else LENGTHS_S
    for kind in GAINS:
        # The first call also imports modules.
        detect_limit_cycles([recording(kind, 5)])
        cost = {}
        for length_s in lengths:
            run = recording(kind, length_s)
            cost[length_s] = (seconds(partial(analyze, run))
                              + seconds(partial(detect_limit_cycles, [run])))
            results.append(Result(f'analysis.{kind}.{length_s}', f'analyze + limit-cycle, {kind}',
                                  1e3 * cost[length_s] / length_s, 'ms for a second of recording',
                                  at=float(length_s)))
        longest = lengths[-1]
        results.append(Result(f'analysis.{kind}', f'analyze + limit-cycle of {longest} s, {kind}',
                              cost[longest], 's', target='<= 2'))
        slope = np.polyfit(np.log(lengths), np.log([cost[n] for n in lengths]), 1)[0]
        results.append(Result(f'analysis.{kind}.power', f'growth with length: exponent, {kind}',
                              float(slope), '', target='<= 1.1'))
    return results


def reading(length_s: int) -> Result:
    """Return the time to read a bag of six signals into a run."""
    with tempfile.TemporaryDirectory() as folder:
        write_bag(recording('steps', length_s), Path(folder) / 'bag')
        return Result('analysis.read', f'to read the bag of {length_s} s at '
                      f'{RATE_HZ / EVERY:g} Hz before that',
                      seconds(partial(read_bag, Path(folder) / 'bag')), 's')


def long_joint(samples: int) -> Result:
    """Return the time to diagnose a long recording of a joint with friction, without a model."""
    machine, rng = draw_machine(1), np.random.default_rng(1)
    time_s = np.arange(samples) / machine.rate_hz
    course = 0.3 * machine.size * sum(np.sin(2.0 * np.pi * f * time_s + rng.uniform(0.0, 7.0))
                                      for f in np.geomspace(0.05, 1.0, 9))
    run = moved(machine, with_suspect(machine, 'coulomb_friction', rng), course, rng)
    assert run is not None
    diagnose([run[:2500]], {}, 'joint')
    return Result('analysis.gap.joint', f'gap diagnosis of a joint, {samples} samples',
                  seconds(partial(diagnose, [run], {}, 'joint')), 's', target='<= 20')


def measure(quick: bool) -> list[Result]:
    """Return the processor time of each analysis."""
    loop = loop_of({}, {'gain': 5.0, 'reference.amplitude': 100.0}, RATE_HZ)
    one = OneHarmonic(loop, held=True)
    locus(one, COMMANDS_N[:2])
    described = seconds(partial(locus, one, COMMANDS_N))
    case = draw(1)
    run = as_run(case.recording)
    half = run.between(run.time_s[0], run.time_s[0] + 0.5 * run.duration_s)
    diagnose([half], case.nominal)
    diagnosed, diagnosed_half = (seconds(partial(diagnose, [each], case.nominal))
                                 for each in (run, half))
    return [*growth(quick), reading(20 if quick else LENGTHS_S[-1]),
            Result('analysis.describing', 'describing-function map, '
                   f'{COMMANDS_N.size} amplitudes', described, 's'),
            Result('analysis.gap', 'gap diagnosis, for a second of recording',
                   diagnosed / run.duration_s, 's'),
            Result('analysis.gap.length', 'gap diagnosis, for a second of half the recording',
                   diagnosed_half / half.duration_s, 's'),
            long_joint(5000 if quick else 100_000)]


if __name__ == '__main__':
    show(measure('--quick' in sys.argv))
