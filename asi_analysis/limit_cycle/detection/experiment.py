"""
`asi run --experiment isolation`: the two runs that show whether a limit cycle is isolated.

From inside: a step from rest, after which the cycle grows. From outside: a sine about the same
force for DRIVEN_S, slower than the cycle, because at the frequency of the cycle the actuator
cannot be driven much beyond its amplitude.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final

from asi_analysis.bags.bag import read_bag
from asi_analysis.experiments.experiment import Experiment, checked
from asi_analysis.experiments.running import run_experiment
from asi_analysis.limit_cycle.detection.answer import LimitCycles, detect_limit_cycles
from asi_analysis.terminal import Progress, silent
from asi_common.parameter import Value

DRIVEN_N: Final = 900.0
DRIVEN_HZ: Final = 60.0
DRIVEN_S: Final = 0.3


def isolation(experiment: Experiment, out: Path, report: Progress = silent,
              run: Callable[[Experiment, Path, Progress], Path] = run_experiment) -> LimitCycles:
    """
    Return the bags of both runs and their segments, analysed together.

    experiment: its reference is a step; both runs hold the force of that step. run: runs one.
    """
    held = float(experiment.controller.get('reference.amplitude', 100.0))
    sine: dict[str, Value] = {
        'reference.shape': 'sine', 'reference.amplitude': DRIVEN_N, 'reference.offset': held,
        'reference.frequency': DRIVEN_HZ, 'reference.end': DRIVEN_S}
    runs = {'inside': experiment,
            'outside': replace(experiment, controller={**experiment.controller, **sine},
                               duration_s=experiment.duration_s + DRIVEN_S)}
    bags = [run(checked(each), out / name, report) for name, each in runs.items()]
    found = detect_limit_cycles([read_bag(bag) for bag in bags])
    return LimitCycles({'bags': list(map(str, bags)), **found}, **vars(found))
