"""
`asi run --experiment isolation`: the two runs that show whether a limit cycle is isolated.

From inside: a step from rest, so that the cycle has to grow. From outside: a chirp through the
usual frequencies of the cycle about the same force, much larger than it, that ends by itself.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from asi_actuator.parameters import Value
from asi_analysis.bag import read_bag
from asi_analysis.experiment import Experiment, checked, run_experiment
from asi_analysis.limit_cycle.answer import limit_cycle

Progress = Callable[[str, float | None], None]

CHIRP_N: Final = 600.0
CHIRP_HZ: Final = (70.0, 100.0)
CHIRP_S: Final = 0.3


def isolation(experiment: Experiment, out: Path, report: Progress = lambda *_: None
              ) -> dict[str, Any]:
    """
    Return the bags of both runs and the segments of both, judged together.

    experiment: its reference is a step, whose size is the force held in both runs.
    """
    held = float(experiment.controller.get('reference.amplitude', 100.0))
    chirp: dict[str, Value] = {
        'reference.shape': 'chirp', 'reference.amplitude': CHIRP_N, 'reference.offset': held,
        'reference.frequency': CHIRP_HZ[0], 'reference.end_frequency': CHIRP_HZ[1],
        'reference.duration': CHIRP_S}
    runs = {'inside': experiment,
            'outside': replace(experiment, controller={**experiment.controller, **chirp},
                               duration_s=experiment.duration_s + CHIRP_S)}
    bags = [run_experiment(checked(run), out / name, report) for name, run in runs.items()]
    return {'bags': list(map(str, bags)), **limit_cycle([read_bag(bag) for bag in bags])}
