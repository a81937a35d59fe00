"""The result of `asi calibrate`."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from asi_analysis.paper.calibration.quantities import STRUCTURES, Candidate, read_best, write_best
from asi_analysis.paper.calibration.search import calibrate, load, new_search, result
from asi_analysis.paper.facts.conditions import Conditions
from asi_analysis.paper.facts.table import FITTED_ROWS
from asi_analysis.reporting.result import Result, Table
from asi_analysis.terminal import Progress


class Calibration(Result):
    """The state of a calibration, by the keys of `asi calibrate --json`."""

    def parts(self) -> Iterator[str | Table]:
        yield (f'{self.evaluations} evaluations and {self.polish_evaluations} of the polish, cost '
               f'{self.cost:.4g}; {self.met} of {self.total} rows of the calibration met')
        if self.seconds_per_evaluation:
            yield (f'seed {self.seed}, budget {self.budget}: '
                   f'{self.seconds_per_evaluation:.3g} s an evaluation')
        yield 'measured by stage: ' + ', '.join(
            f'{name} {count}' for name, count in self.stages.items())
        if self.not_met:
            yield 'not met: ' + ', '.join(self.not_met)
        yield f'best: {self.best}'


def run(out: Path, structure: str, evaluations: int, rounds: int, seed: int, spread: float,
        start: Path | None, only: Sequence[str], report: Progress,
        table_1: bool = True) -> Calibration:
    """
    Run or resume a calibration; return its result.

    structure: a name of STRUCTURES. Raises InputError for an unknown name, or a start or state
    that cannot be read.
    """
    out.mkdir(parents=True, exist_ok=True)
    state = out / 'state.pickle'
    if state.exists():
        search = load(state)
    else:
        search = new_search(read_best(start) if start else Candidate({}, Conditions()),
                            STRUCTURES[structure], seed, spread, only, report, table_1)
    calibrate(search, evaluations, rounds, state, report)
    write_best(result(search), out / 'best.json')
    measured = search.problem.measure(search.best)
    rows = [row for row in FITTED_ROWS if row.name in measured]
    return Calibration({
        'evaluations': search.evaluations, 'budget': evaluations, 'seed': search.seed,
        'seconds_per_evaluation': (search.seconds / search.evaluations if search.evaluations
                                   else None),
        'stages': {str(stage): count for stage, count
                   in zip(search.problem.stages, search.counts, strict=True)},
        'polish_evaluations': search.polished, 'cost': search.problem.cost(search.best, measured),
        'best': str(out / 'best.json'),
        'met': sum(row.met(measured[row.name]) for row in rows), 'total': len(rows),
        'not_met': [row.name for row in rows if not row.met(measured[row.name])]})
