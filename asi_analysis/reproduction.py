"""`asi reproduce`: every published fact beside what the simulator says."""

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from asi_actuator.parameters import Value
from asi_analysis.facts.conditions import Conditions
from asi_analysis.facts.stated import stated
from asi_analysis.facts.table import FACTS, Fact, Measured, measure

Values = Mapping[str, Value]


class Reproduction(NamedTuple):
    """The table for one parameter set: every measured value, by name."""

    actuator: Values
    conditions: Conditions
    measured: Measured

    def met(self, fact: Fact) -> bool:
        return fact.met(self.measured[fact.value])


def reproduce(actuator: Values, conditions: Conditions | None = None,
              report: Callable[[str, float | None], None] = lambda text, share: None
              ) -> Reproduction:
    """
    Measure every fact on the simulator.

    actuator: parameters by name, the rest at their defaults; report: told what is going on.
    """
    conditions = conditions or Conditions()
    return Reproduction(actuator, conditions, measure(actuator, conditions, report))


def as_document(result: Reproduction) -> dict[str, Any]:
    """Return the answer of `asi reproduce --json`; a value that does not exist is None."""
    texts = stated(result.actuator, result.conditions)
    facts = []
    for fact in FACTS:
        value = result.measured[fact.value]
        facts.append({
            'id': fact.id, 'quantity': fact.quantity, 'published': fact.published,
            'simulated': value if math.isfinite(value) else None, 'unit': fact.unit,
            'tolerance': fact.tolerance, 'met': result.met(fact), 'section': fact.section,
            'conditions': texts[fact.id][0], 'method': texts[fact.id][1],
            'fitted': fact.fitted})
    ids = dict.fromkeys(fact.id for fact in FACTS)
    whole = [id_ for id_ in ids if all(result.met(fact) for fact in FACTS if fact.id == id_)]
    return {'facts': facts, 'met': sum(fact['met'] for fact in facts), 'total': len(facts),
            'ids_met': whole, 'ids_total': len(ids), 'report': None}


def show(document: Mapping[str, Any]) -> None:
    """Print the table in the terminal."""
    from rich.console import Console
    from rich.table import Table
    table = Table(box=None, pad_edge=False, header_style='bold')
    for column in ('fact', 'quantity', 'paper', 'published', 'simulated', 'met if', ''):
        table.add_column(column, justify='right' if column in ('published', 'simulated')
                         else 'left')
    last = None
    for fact in document['facts']:
        simulated = '-' if fact['simulated'] is None else f'{fact["simulated"]:.4g}'
        table.add_row(fact['id'] if fact['id'] != last else '', fact['quantity'],
                      fact['section'], f'{fact["published"]:.4g}', f'{simulated} {fact["unit"]}',
                      fact['tolerance'], '[green]met[/]' if fact['met'] else '[red]not met[/]')
        last = fact['id']
    Console().print(table)
    print(f'{document["met"]} of {document["total"]} rows met; '
          f'{len(document["ids_met"])} of {document["ids_total"]} facts met whole')
    if document['report']:
        print(f'report: {document["report"]}')
