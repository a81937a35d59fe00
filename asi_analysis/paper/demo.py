"""`asi demo`: the paper's experiments over ROS, and their report."""

import shutil
from collections.abc import Iterator
from pathlib import Path

from asi_analysis.bags.bag import read_bag
from asi_analysis.errors import InputError
from asi_analysis.experiments.experiment import checked
from asi_analysis.experiments.running import run_experiment
from asi_analysis.measures.analysis import analyze, in_words
from asi_analysis.paper.demo_report import write_demo_report
from asi_analysis.paper.demo_runs import RUNS, Recorded, scaled
from asi_analysis.reporting.result import Result, Table, table_of
from asi_analysis.terminal import Progress, silent


class Demo(Result):
    """The paper's experiments over ROS, by the keys of `asi demo --json`."""

    rows = 'table_1'

    def parts(self) -> Iterator[str | Table]:
        yield table_of(self.table_1, {
            'compensator': '{compensator}', 'quantity': '{quantity}', 'unit': '{unit}',
            'published': '{published}', 'simulated': '{simulated:.3g}'}, 'Table 1')
        for each in self.runs:
            if each['analysis']['oscillation']['sustained']:
                yield f'{each["name"]}: {in_words(each["analysis"]["oscillation"])}'
        yield f'report: {self.report}'


def run_demo(out: Path, progress: Progress = silent) -> Demo:
    """
    Run all experiments into `out`, write report.html and its pictures; return the result.

    An earlier demo in `out` is replaced; raises InputError if `out` holds anything else.
    """
    _clear(out)
    recorded = []
    for number, plan in enumerate(RUNS):
        def report(text: str, share: float | None, number: int = number,
                   title: str = plan.title) -> None:
            progress(f'{title}: {text}', (number + (share or 0.0)) / (len(RUNS) + 1))

        bag = run_experiment(plan.experiment, out / plan.name, report)
        run = read_bag(bag)
        recorded.append(Recorded(plan, checked(plan.experiment), bag, run, analyze(run)))
    progress('writing the report', len(RUNS) / (len(RUNS) + 1))
    return Demo({
        'report': str(write_demo_report(recorded, out)),
        'runs': [{'name': each.plan.name, 'bag': str(each.bag), 'analysis': each.analysis}
                 for each in recorded],
        'table_1': [{'compensator': each.plan.name, 'quantity': entry.quantity,
                     'unit': entry.unit, 'published': entry.words,
                     'simulated': scaled(each.analysis, entry)}
                    for each in recorded for entry in each.plan.published],
    })


def _clear(out: Path) -> None:
    """Remove an earlier demo. Raises InputError if the directory holds anything else."""
    names = {plan.name for plan in RUNS}
    if out.exists():
        foreign = [path.name for path in out.iterdir() if path.name not in names
                   and path.name != 'report.html' and path.suffix != '.png']
        if foreign:
            raise InputError(f'{out} holds {foreign[0]}, which is not of an earlier demo: '
                             'name another --out')
    for name in names:
        shutil.rmtree(out / name, ignore_errors=True)
