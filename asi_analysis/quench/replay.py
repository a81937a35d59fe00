"""The worst finds of the attack, run again over ROS: the nodes, a bag, a verdict on it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from asi_analysis.bag import read_bag
from asi_analysis.experiment import Experiment, Progress, checked, run_experiment
from asi_analysis.limit_cycle.verdict import judge_run
from asi_analysis.prediction.simulation import Values
from asi_analysis.quench.attack import EXCITED_S, Trial

# After the excitation the loop is left alone for so long.
LEFT_ALONE_S = 0.75


def replay(trials: Sequence[Trial], controller: Values, actuator: Values,
           rates_hz: tuple[float, ...], out: Path, report: Progress = lambda *_: None
           ) -> list[dict[str, Any]]:
    """
    Return bag and verdict of each trial, under the same condition: the same parameters.

    The verdict is on what is left when reference and push have ended.
    """
    rows = []
    for number, trial in enumerate(trials):
        s = trial.condition.settings(rates_hz)
        experiment = checked(Experiment(
            {**actuator, **s['actuator']}, {**controller, **s['reference']},
            EXCITED_S + LEFT_ALONE_S, 'lockstep', s['rate_hz']))
        bag = run_experiment(experiment, out / f'worst_{number + 1}', report)
        run = read_bag(bag)
        last = judge_run(run.between(EXCITED_S, run.time_s[-1] + run.period_s))[-1]
        found = last.verdict in ('limit_cycle', 'saturating', 'growing', 'unsteady')
        rows.append({'bag': str(bag), 'verdict': last.verdict, 'confidence': last.confidence,
                     'amplitude_n': last.amplitude if found else None,
                     'frequency_hz': last.frequency_hz if found else None})
    return rows
