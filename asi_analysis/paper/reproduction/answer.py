"""The result of `asi reproduce`: every published fact compared with the simulator."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from asi_analysis.bags.bag import read_bag
from asi_analysis.bags.run import SIGNALS
from asi_analysis.experiments.experiment import Experiment
from asi_analysis.experiments.running import RunFailedError, run_experiment
from asi_analysis.loop.closed_loop import LoopRun
from asi_analysis.paper.calibration.plausible import findings
from asi_analysis.paper.calibration.quantities import ONE_PLAYS, Candidate
from asi_analysis.paper.facts.conditions import Conditions
from asi_analysis.paper.facts.converged import Converged
from asi_analysis.paper.facts.fact import Fact, Measured, Row, Setup
from asi_analysis.paper.facts.table import FACTS, FITTED_ROWS, measure, met
from asi_analysis.paper.reproduction.table_1 import columns_alone
from asi_analysis.reporting.result import Pictures, Result, Table, finite, table_of
from asi_analysis.terminal import Progress, silent
from asi_common.parameter import Value

Values = Mapping[str, Value]


class Reproduction(Result):
    """
    Every published fact and its simulated value, returned by `reproduce_paper`.

    The keys are those of `asi reproduce --json`. Attributes: the simulated `actuator` and
    `conditions`, and `measured`, every measured value by name with its change.
    """

    title = 'Reproduction of the paper'
    rows = 'facts'
    actuator: Values
    conditions: Conditions
    measured: Mapping[str, Converged]

    def parts(self) -> Iterator[str | Table]:
        yield table_of(self.facts, {
            'fact': '{id}', 'quantity': '{quantity}', 'paper': '{section}',
            'published': '{published:.4g}', 'simulated': '{simulated:.4g}', 'unit': '{unit}',
            'change %': '{change_percent:.2g}', 'tolerance': '{tolerance}', 'met': '{met}'})
        yield (f'{self["met"]} of {self.total} rows met; all rows of {len(self.ids_met)} of '
               f'{self.ids_total} facts met')
        yield ('a fit has {free_quantities} free quantities for {fitted_rows} rows, '
               '{two_sided_rows} of them two-sided'.format(**self.freedom))
        for each in self.alone:
            yield (f'{each["id"]} alone, {each["conditions"]}: {each["met"]} of {each["total"]} '
                   'rows met, not counted')
        if self.not_plausible:
            yield table_of(self.not_plausible, {
                'not plausible': '{name}', 'value': '{value:.3g}', 'low': '{low:.3g}',
                'high': '{high:.3g}', 'unit': '{unit}', 'because': '{problem}',
                'source': '{source}'})
        if self.over_ros:
            different = [each['value'] for each in self.over_ros if not each['equal']]
            yield (f'{len(self.over_ros)} values measured over ROS as well: '
                   + (f'DIFFERENT: {", ".join(different)}' if different else 'all equal'))
        if self.report:
            yield f'report: {self.report}'

    def pictures(self) -> Pictures:
        from asi_analysis.paper.reproduction.figures import paper_figures
        return {name: (figure, name) for name, figure in paper_figures(
            self.actuator, self.conditions, self.measured).items()}

    def write_report(self, out: Path) -> Path:
        """Write report.html, table.md and a PNG of each figure into `out`."""
        from asi_analysis.paper.reproduction.report import write_reproduction_report
        page = write_reproduction_report(self, out)
        self['report'] = str(page)
        return page

    def repeat_over_ros(self, out: Path, report: Progress = silent) -> None:
        """Measure the closed-loop rows again with the real nodes, one bag each in `out`."""
        self['over_ros'] = over_ros(self, out, report)


def reproduce_paper(actuator: Values | None = None, conditions: Conditions | None = None,
                    report: Progress = silent) -> Reproduction:
    """
    Measure every published fact on the simulator and compare it with its published value.

    actuator: parameters by name, the others have their defaults; conditions: loads and steps that
    the paper does not state. Takes minutes.

    >>> import asi_analysis as asi
    >>> result = asi.reproduce_paper()                                    # doctest: +SKIP
    >>> print(result.met, 'of', result.total)                             # doctest: +SKIP
    """
    actuator, conditions = actuator or {}, conditions or Conditions()
    setup = Setup(actuator, conditions, {})
    measured = measure(setup, report)
    facts = [_as_document(fact, row, setup, measured) for fact in FACTS for row in fact.rows]
    whole = [fact.id for fact in FACTS if all(met(row, measured) for row in fact.rows)]
    return Reproduction(
        {'facts': facts, 'met': sum(fact['met'] for fact in facts), 'total': len(facts),
         'ids_met': whole, 'ids_total': len(FACTS), 'alone': columns_alone(setup),
         'not_plausible': [each._asdict() for each in findings(Candidate(actuator, conditions))],
         'freedom': {'free_quantities': len(ONE_PLAYS), 'fitted_rows': len(FITTED_ROWS),
                     'two_sided_rows': sum(not row.one_sided for row in FITTED_ROWS)},
         'over_ros': [], 'report': None},
        actuator=actuator, conditions=conditions, measured=measured)


def _as_document(fact: Fact, row: Row, setup: Setup, measured: Mapping[str, Converged]
                 ) -> dict[str, Any]:
    figure = measured[row.name]
    return {
        'id': fact.id, 'quantity': row.quantity, 'published': row.published,
        'simulated': finite(figure.value), 'refined': finite(figure.refined),
        'change_percent': finite(100.0 * figure.relative_change), 'note': figure.note,
        'unit': row.unit, 'tolerance': row.tolerance, 'met': met(row, measured),
        'section': row.section, 'conditions': fact.conditions(setup), 'method': fact.method,
        'role': str(row.role)}


def over_ros(result: Reproduction, out: Path, report: Progress = silent) -> list[dict[str, Any]]:
    """
    Measure the closed-loop rows again with the real nodes in lock-step, one bag each in `out`.

    Return each value with that in this process, by the keys of doc/reference/json.md. Lock-step is
    the same calculation, so every value must be equal to the last bit. Raises the errors of
    `run_experiment`, and RunFailedError for an incomplete bag.
    """
    def runner(experiment: Experiment) -> LoopRun:
        number = len(list(out.iterdir())) if out.exists() else 0
        run = read_bag(run_experiment(experiment, out / f'{number:02d}', report))
        if len(run) != experiment.ticks:
            raise RunFailedError(f'{run.source} holds {len(run)} states, {experiment.ticks} were '
                                 'published')
        return LoopRun(run.time_s, **{signal.field: run.signal(signal.name)
                                      for signal in SIGNALS})

    setup = Setup(result.actuator, result.conditions,
                  {name: figure.value for name, figure in result.measured.items()}, runner)
    again: Measured = {}
    for fact in FACTS:
        if fact.over_ros:
            again.update(fact.over_ros(setup))
    pairs = {name: (result.measured[name].value, float(value)) for name, value in again.items()}
    return [{'value': name, 'in_process': finite(here), 'over_ros': finite(there),
             'equal': here == there} for name, (here, there) in pairs.items()]
