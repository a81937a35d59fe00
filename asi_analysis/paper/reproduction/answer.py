"""`asi reproduce`: every published fact beside what the simulator says."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from asi_analysis.bags.bag import read_bag
from asi_analysis.bags.run import SIGNALS
from asi_analysis.experiments.experiment import Experiment
from asi_analysis.experiments.running import RunFailedError, run_experiment
from asi_analysis.loop.closed_loop import LoopRun
from asi_analysis.paper.facts.conditions import Conditions
from asi_analysis.paper.facts.stated import stated
from asi_analysis.paper.facts.table import FACTS, Fact, Measured, closed_loop_groups, measure
from asi_analysis.terminal import Progress, silent, table
from asi_common.parameter import Value

Values = Mapping[str, Value]


class Reproduction(NamedTuple):
    """The table for one parameter set: every measured value, by name."""

    actuator: Values
    conditions: Conditions
    measured: Measured

    def met(self, fact: Fact) -> bool:
        return fact.met(self.measured[fact.value])


def reproduce(actuator: Values, conditions: Conditions | None = None,
              report: Progress = silent) -> Reproduction:
    """
    Measure every fact on the simulator.

    actuator: parameters by name, the rest at their defaults; report: told what is going on.
    """
    conditions = conditions or Conditions()
    return Reproduction(actuator, conditions, measure(actuator, conditions, report))


class Comparison(NamedTuple):
    """One value of a run over ROS, and of the same run in this process."""

    value: str
    in_process: float
    over_ros: float

    @property
    def equal(self) -> bool:
        return self.in_process == self.over_ros


def over_ros(result: Reproduction, out: Path,
             report: Progress = silent) -> list[Comparison]:
    """
    Make the closed-loop rows again with the real nodes in lock-step, one bag each in `out`.

    Lock-step is the same calculation, so every value must come out the same to the last bit.
    Raises what `run_experiment` raises, and RunFailedError for a bag that is not whole.
    """
    def runner(experiment: Experiment) -> LoopRun:
        number = len(list(out.iterdir())) if out.exists() else 0
        run = read_bag(run_experiment(experiment, out / f'{number:02d}', report))
        if len(run) != experiment.ticks:
            raise RunFailedError(f'{run.source} holds {len(run)} states, {experiment.ticks} were '
                                 'published')
        return LoopRun(run.time_s, **{signal.field: run.signal(signal.name)
                                      for signal in SIGNALS})

    again: Measured = {}
    for group in closed_loop_groups(result.actuator, result.conditions, result.measured,
                                    runner).values():
        again.update(group())
    return [Comparison(name, result.measured[name], float(value))
            for name, value in again.items()]


def as_dict(comparison: Comparison) -> dict[str, Any]:
    """Return a comparison with the keys of doc/reference/json.md."""
    return {key: _finite(value) for key, value in comparison._asdict().items()} | {
        'equal': comparison.equal}


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def as_document(result: Reproduction) -> dict[str, Any]:
    """Return the answer of `asi reproduce --json`; a value that does not exist is None."""
    texts = stated(result.actuator, result.conditions)
    facts = []
    for fact in FACTS:
        value = result.measured[fact.value]
        facts.append({
            'id': fact.id, 'quantity': fact.quantity, 'published': fact.published,
            'simulated': _finite(value), 'unit': fact.unit,
            'tolerance': fact.tolerance, 'met': result.met(fact), 'section': fact.section,
            'conditions': texts[fact.id][0], 'method': texts[fact.id][1],
            'role': fact.role})
    ids = dict.fromkeys(fact.id for fact in FACTS)
    whole = [id_ for id_ in ids if all(result.met(fact) for fact in FACTS if fact.id == id_)]
    return {'facts': facts, 'met': sum(fact['met'] for fact in facts), 'total': len(facts),
            'ids_met': whole, 'ids_total': len(ids), 'over_ros': [],
            'report': None}


def as_text(document: Mapping[str, Any]) -> str:
    """Return the table for people."""
    rows, last = [], None
    for fact in document['facts']:
        simulated = '-' if fact['simulated'] is None else f'{fact["simulated"]:.4g}'
        rows.append((fact['id'] if fact['id'] != last else '', fact['quantity'], fact['section'],
                     f'{fact["published"]:.4g}', f'{simulated} {fact["unit"]}',
                     fact['tolerance'], '[green]met[/]' if fact['met'] else '[red]not met[/]'))
        last = fact['id']
    lines = [table(('fact', 'quantity', 'paper', 'published', 'simulated', 'met if', ''), rows,
                   right=('published', 'simulated')),
             f'{document["met"]} of {document["total"]} rows met; '
             f'{len(document["ids_met"])} of {document["ids_total"]} facts met whole']
    if document['over_ros']:
        different = [each['value'] for each in document['over_ros'] if not each['equal']]
        lines.append(f'{len(document["over_ros"])} values measured over ROS as well: '
                     + (f'DIFFERENT: {", ".join(different)}' if different else 'all the same'))
    if document['report']:
        lines.append(f'report: {document["report"]}')
    return '\n'.join(lines)
