"""The most severe trials of the attack, repeated over ROS with a bag and its verdict."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from asi_analysis.bags.bag import read_bag
from asi_analysis.experiments.experiment import Experiment, checked
from asi_analysis.experiments.running import RunFailedError, run_experiment
from asi_analysis.limit_cycle.detection.agreement import judge_run
from asi_analysis.limit_cycle.quench.attack import EXCITED_S, Trial
from asi_analysis.loop.simulation import Values
from asi_analysis.terminal import Progress, silent

# Duration of the run after the excitation.
FREE_S = 0.75


def replay(trials: Sequence[Trial], controller: Values, actuator: Values,
           rates_hz: tuple[float, ...], out: Path, report: Progress = silent
           ) -> list[dict[str, Any]]:
    """
    Return bag and verdict of each trial, repeated with the same parameters.

    The verdict is on the motion after the excitation; `fault` if a safety limit ended the run.
    """
    rows = []
    for number, trial in enumerate(trials):
        s = trial.condition.settings(rates_hz, actuator)
        experiment = checked(Experiment(
            {**actuator, **s['actuator']}, {**controller, **s['reference']},
            EXCITED_S + FREE_S, 'lockstep', s['rate_hz']))
        name = out / f'worst_{number + 1}'
        try:
            bag = run_experiment(experiment, name, report)
        except RunFailedError as error:
            # The nodes detected a fault, such as a free piston above their velocity limit.
            rows.append({'bag': str(name / 'bag'), 'verdict': 'fault', 'confidence': 1.0,
                         'why': str(error), 'amplitude_n': None, 'frequency_hz': None})
            continue
        run = read_bag(bag)
        last = judge_run(run.between(EXCITED_S, run.time_s[-1] + run.period_s))[-1]
        # An unsteady segment without oscillation has no amplitude.
        found = (last.verdict in ('limit_cycle', 'saturating', 'growing', 'unsteady')
                 and math.isfinite(last.amplitude) and math.isfinite(last.frequency_hz))
        rows.append({'bag': str(bag), 'verdict': last.verdict, 'confidence': last.confidence,
                     'why': last.why,
                     'amplitude_n': last.amplitude if found else None,
                     'frequency_hz': last.frequency_hz if found else None})
    return rows
