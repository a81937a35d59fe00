"""The worst finds of the attack, run again over ROS: the nodes, a bag, a verdict on it."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from asi_analysis.bags.bag import read_bag
from asi_analysis.experiments.experiment import Experiment, checked
from asi_analysis.experiments.running import RunFailedError, run_experiment
from asi_analysis.limit_cycle.detection.verdict import judge_run
from asi_analysis.limit_cycle.quench.attack import EXCITED_S, Trial
from asi_analysis.loop.simulation import Values
from asi_analysis.terminal import Progress, silent

# After the excitation the loop is left alone for so long.
LEFT_ALONE_S = 0.75


def replay(trials: Sequence[Trial], controller: Values, actuator: Values,
           rates_hz: tuple[float, ...], out: Path, report: Progress = silent
           ) -> list[dict[str, Any]]:
    """
    Return bag and verdict of each trial, under the same condition: the same parameters.

    The verdict is on what is left when reference and push have ended; `fault` where the nodes
    ended the run for their safety.
    """
    rows = []
    for number, trial in enumerate(trials):
        s = trial.condition.settings(rates_hz)
        experiment = checked(Experiment(
            {**actuator, **s['actuator']}, {**controller, **s['reference']},
            EXCITED_S + LEFT_ALONE_S, 'lockstep', s['rate_hz']))
        name = out / f'worst_{number + 1}'
        try:
            bag = run_experiment(experiment, name, report)
        except RunFailedError as error:
            # A free piston that is pushed for long passes the nodes' limit of the velocity.
            rows.append({'bag': str(name / 'bag'), 'verdict': 'fault', 'confidence': 1.0,
                         'why': str(error), 'amplitude_n': None, 'frequency_hz': None})
            continue
        run = read_bag(bag)
        last = judge_run(run.between(EXCITED_S, run.time_s[-1] + run.period_s))[-1]
        # Of what is unsteady for want of any swing there is no size.
        found = (last.verdict in ('limit_cycle', 'saturating', 'growing', 'unsteady')
                 and math.isfinite(last.amplitude) and math.isfinite(last.frequency_hz))
        rows.append({'bag': str(bag), 'verdict': last.verdict, 'confidence': last.confidence,
                     'why': last.why,
                     'amplitude_n': last.amplitude if found else None,
                     'frequency_hz': last.frequency_hz if found else None})
    return rows
