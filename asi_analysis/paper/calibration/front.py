"""
`asi calibrate --front`: the cost of the facts as a function of one fixed quantity or row.

For each value all that is free is fitted again (a profile of the cost), starting from the result
for the previous value, so that neighbours can be compared. A row at a value shows which others pay
for it. Each point is written as a file that `asi reproduce --candidate` takes.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from matplotlib.figure import Figure

from asi_analysis.errors import InputError
from asi_analysis.paper.calibration.cost import cost, misses
from asi_analysis.paper.calibration.plausible import penalty
from asi_analysis.paper.calibration.quantities import (
    STRUCTURES,
    Candidate,
    read_best,
    write_best,
)
from asi_analysis.paper.calibration.search import at_value, new_search, result
from asi_analysis.paper.facts.conditions import Conditions
from asi_analysis.paper.facts.fact import Measured, Row
from asi_analysis.paper.facts.table import FACTS, FITTED_ROWS
from asi_analysis.reporting.figures import BLUE, drawing, save
from asi_analysis.reporting.result import Result, Table, table_of
from asi_analysis.terminal import Progress, silent
from asi_common.files import write_text


class FrontPoint(NamedTuple):
    """The best result with the quantity or row at a value."""

    value: float
    cost: float
    evaluations: int
    measured: Measured
    best: Candidate

    @property
    def not_met(self) -> list[Row]:
        return [row for row in FITTED_ROWS
                if row.name in self.measured and not row.met(self.measured[row.name])]


def parsed(text: str) -> tuple[str, list[float]]:
    """Return name and values of 'NAME=V1,V2,...'. Raises InputError for any other text."""
    name, _, values = text.partition('=')
    try:
        return name, [float(value) for value in values.split(',')]
    except ValueError:
        raise InputError(f'--front {text} is not allowed: it takes NAME=V1,V2,… with numbers'
                         ) from None


class Fit(NamedTuple):
    """How each point of a front is fitted: see `asi calibrate`."""

    evaluations: int = 0
    rounds: int = 20
    structure: str = 'side'
    seed: int = 1
    spread: float = 0.1
    only: Sequence[str] = ()
    table_1: bool = True


def front(name: str, values: Sequence[float], start: Candidate, fit: Fit,
          report: Progress = silent) -> list[FrontPoint]:
    """
    Return the best with a quantity, or a fitted row, at each value.

    Raises InputError for an unknown name.
    """
    points = []
    for done, value in enumerate(values):
        report(f'{name} = {value:g}', done / len(values))
        row, structure = at_value(name, value), STRUCTURES[fit.structure]
        if row is None:
            structure = structure._replace(fixed={**structure.fixed, name: value})
        search = new_search(start, structure, fit.seed, fit.spread, fit.only,
                            table_1=fit.table_1, demanded=row)
        while search.evaluations < fit.evaluations and not search.strategy.stop():
            search.generation()
        search.polish(fit.rounds)
        measured, best = search.problem.measure(search.best), result(search)
        points.append(FrontPoint(value, cost(misses(measured)) + penalty(best),
                                 search.evaluations + search.polished, measured, best))
        start = best
    return points


def table(name: str, points: Sequence[FrontPoint]) -> str:
    """Return the front as a table in Markdown."""
    lines = [f'| `{name}` | cost | rows not met | evaluations |', '|---|---|---|---|']
    for each in points:
        rows = ', '.join(f'{fact.id} {row.name} {each.measured[row.name]:.4g}'
                         for fact in FACTS for row in fact.rows if row in each.not_met) or 'none'
        lines.append(f'| {each.value:g} | {each.cost:.2f} | {rows} | {each.evaluations} |')
    return '\n'.join(lines) + '\n'


def picture(name: str, points: Sequence[FrontPoint]) -> Figure:
    """Draw the cost against the quantity, with the number of rows that are not met."""
    with drawing(2.8) as figure:
        axes = figure.subplots()
        axes.plot([each.value for each in points], [each.cost for each in points], 'o-',
                  color=BLUE)
        for each in points:
            axes.annotate(f'{len(each.not_met)}', (each.value, each.cost),
                          textcoords='offset points', xytext=(0.0, 7.0), ha='center')
        axes.set(xlabel=name, ylabel='sum of misses (half widths)')
        axes.margins(y=0.2)
        axes.set_title('Cost of the facts; number: rows not met')
    return figure


class Front(Result):
    """The cost over the values of one quantity, by the keys of `asi calibrate --front --json`."""

    rows = 'front'

    def parts(self) -> Iterator[str | Table]:
        yield table_of([{**each, 'missed': len(each['not_met'])} for each in self.front], {
            self.quantity: '{value:g}', 'cost': '{cost:.3g}', 'rows not met': '{missed:d}'})
        yield f'table and picture: {self.out}'


def run(text: str, start: Path | None, fit: Fit, out: Path, report: Progress) -> Front:
    """
    Compute a front, write its table, picture and points; return the result.

    Raises InputError for an invalid front or start.
    """
    name, values = parsed(text)
    points = front(name, values, read_best(start) if start else Candidate({}, Conditions()),
                   fit, report)
    out.mkdir(parents=True, exist_ok=True)
    for each in points:
        write_best(each.best, out / f'{each.value:g}.json')
    write_text(out / 'front.md', table(name, points))
    save(picture(name, points), out / 'front.png', 110.0)
    return Front({
        'quantity': name, 'out': str(out),
        'front': [{'value': each.value, 'cost': each.cost, 'evaluations': each.evaluations,
                   'not_met': [row.name for row in each.not_met]} for each in points]})
