"""What `asi calibrate` does and says, as one plain dictionary."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from asi_analysis.paper.calibration.cost import AIMS, cost, misses
from asi_analysis.paper.calibration.quantities import STRUCTURES, Candidate, read_best, write_best
from asi_analysis.paper.calibration.search import calibrate, load, new_search, result, stages
from asi_analysis.paper.facts.conditions import Conditions
from asi_analysis.terminal import Progress


def run(out: Path, structure: str, evaluations: int, rounds: int, seed: int, spread: float,
        start: Path | None, only: Sequence[str], report: Progress) -> dict[str, Any]:
    """
    Do what `asi calibrate` is asked to; return its document.

    structure: a name of STRUCTURES. Raises InputError for a start, a state or a name that is not
    there.
    """
    out.mkdir(parents=True, exist_ok=True)
    state = out / 'state.pickle'
    if state.exists():
        search = load(state)
    else:
        search = new_search(read_best(start) if start else Candidate({}, Conditions()),
                            STRUCTURES[structure], seed, spread, only)
    calibrate(search, evaluations, rounds, state, report)
    write_best(result(search), out / 'best.json')
    measured = search.problem.measure(search.best)
    names = stages(result(search), {})
    return {'evaluations': search.evaluations,
            'stages': dict(zip(names, search.counts, strict=True)),
            'polish_evaluations': search.polished, 'cost': cost(misses(measured)),
            'best': str(out / 'best.json'),
            'met': sum(fact.met(measured[fact.value]) for fact in AIMS), 'total': len(AIMS),
            'not_met': [fact.value for fact in AIMS if not fact.met(measured[fact.value])]}


def as_text(document: Mapping[str, Any]) -> str:
    """Return what came out, for people."""
    lines = [f'{document["evaluations"]} evaluations and {document["polish_evaluations"]} of the '
             f'polish, cost {document["cost"]:.4g}; {document["met"]} of {document["total"]} rows '
             'that were aimed at are met',
             'measured by stage: ' + ', '.join(f'{name} {count}' for name, count
                                               in document['stages'].items())]
    if document['not_met']:
        lines.append('not met: ' + ', '.join(document['not_met']))
    return '\n'.join([*lines, f'best: {document["best"]}'])
