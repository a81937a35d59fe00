"""`asi demo`: the paper's experiments over ROS, a withheld effect found, and their report."""

import shutil
from collections.abc import Iterator
from pathlib import Path

from asi_analysis.bags.bag import read_bag
from asi_analysis.bags.run import Run
from asi_analysis.demo.hidden_effect import HIDDEN, find_hidden_effect
from asi_analysis.demo.report import write_demo_report
from asi_analysis.demo.runs import RUNS, Recorded, scaled
from asi_analysis.errors import InputError
from asi_analysis.experiments.experiment import Experiment, checked
from asi_analysis.experiments.running import run_experiment
from asi_analysis.measures.analysis import analyze, in_words
from asi_analysis.reporting.result import Result, Table, table_of
from asi_analysis.terminal import Progress, part_of, silent

GAP = 'gap'   # directory of the diagnosis; with the name of a run: of its bag


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
        gap = self.gap
        error_n = gap['improved_error_n']
        improvement = ('No effect was added to the model' if error_n is None else
                       f'With this effect in the model, the error of the force is {error_n:.3g} '
                       f'N, not {gap["nominal_error_n"]:.3g} N (rms)')
        yield (f'withheld effect: {gap["withheld"]}; found: {gap["verdict"]} '
               f'({100.0 * gap["probability"]:.0f} %). {improvement}')
        yield f'report: {self.report}'


def run_demo(out: Path, progress: Progress = silent) -> Demo:
    """
    Run all experiments into `out`, write report.html and its pictures; return the result.

    An earlier demo in `out` is replaced; raises InputError if `out` holds anything else.
    """
    _clear(out)
    steps, done = len(RUNS) + 5, 0   # the last five: three runs, the diagnosis, the report

    def run(name: str, title: str, experiment: Experiment) -> tuple[Path, Run]:
        nonlocal done
        bag = run_experiment(experiment, out / name, part_of(progress, title, done, steps))
        done += 1
        return bag, read_bag(bag)

    recorded = []
    for plan in RUNS:
        bag, found = run(plan.name, plan.title, plan.experiment)
        recorded.append(Recorded(plan, checked(plan.experiment), bag, found, analyze(found)))
    diagnosed = find_hidden_effect(
        lambda name, experiment: run(f'{GAP}_{name}', f'Sim-to-real gap, {name}', experiment)[1],
        out / GAP, part_of(progress, 'Sim-to-real gap', len(RUNS) + 1, steps))
    progress('writing the report', 1.0 - 1.0 / steps)
    return Demo({
        'report': str(write_demo_report(recorded, diagnosed, out)),
        'gap': {'withheld': HIDDEN.name, 'verdict': diagnosed.gap.verdict,
                'probability': diagnosed.gap.probability,
                'nominal_error_n': diagnosed.error_n['nominal'],
                'improved_error_n': diagnosed.error_n['improved'] if diagnosed.has_model else None,
                'shrink': diagnosed.shrink if diagnosed.has_model else None,
                'report': str(out / GAP / 'report.html')},
        'runs': [{'name': each.plan.name, 'bag': str(each.bag), 'analysis': each.analysis}
                 for each in recorded],
        'table_1': [{'compensator': each.plan.name, 'quantity': entry.quantity,
                     'unit': entry.unit, 'published': entry.words,
                     'simulated': scaled(each.analysis, entry)}
                    for each in recorded for entry in each.plan.published],
    })


def _clear(out: Path) -> None:
    """Remove an earlier demo. Raises InputError if the directory holds anything else."""
    names = {plan.name for plan in RUNS} | {
        GAP, *(f'{GAP}_{name}' for name in ('machine', 'nominal', 'improved'))}
    if out.exists():
        foreign = [path.name for path in out.iterdir() if path.name not in names
                   and path.name != 'report.html' and path.suffix != '.png']
        if foreign:
            raise InputError(f'{out} holds {foreign[0]}, which is not of an earlier demo: '
                             'name another --out')
    for name in names:
        shutil.rmtree(out / name, ignore_errors=True)
