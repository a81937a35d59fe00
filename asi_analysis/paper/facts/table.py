"""The table of all facts that the files of `published` declare, and its measurement."""

from collections.abc import Mapping
from importlib import import_module
from pkgutil import iter_modules
from typing import Final

from asi_analysis.paper.facts import published
from asi_analysis.paper.facts.converged import Converged, converged
from asi_analysis.paper.facts.fact import Fact, Measured, Role, Row, Setup
from asi_analysis.terminal import Progress, silent


def _declared() -> tuple[Fact, ...]:
    """Return the FACT of each file of `published`, in the order of their names."""
    return tuple(import_module(f'{published.__name__}.{file.name}').FACT
                 for file in iter_modules(published.__path__))


FACTS: Final = _declared()
ROWS: Final[tuple[Row, ...]] = tuple(row for fact in FACTS for row in fact.rows)
FITTED_ROWS: Final = tuple(row for row in ROWS if row.role is Role.FITTED)


def _measure(setup: Setup, report: Progress) -> Measured:
    for done, fact in enumerate(FACTS):
        report(fact.rows[0].quantity, done / len(FACTS))
        setup.measured.update({name: float(value) for name, value in fact.measure(setup).items()})
    return setup.measured


def measure(setup: Setup, report: Progress = silent) -> dict[str, Converged]:
    """
    Return every value of the table, by name, with its change at twice the resolution.

    setup: without measured values; report: called with the progress.
    """
    def at(refinement: int) -> Measured:
        def report_at(text: str, share: float | None) -> None:
            report(f'{text}, resolution x {refinement}', 0.5 * (refinement - 1 + (share or 0.0)))
        return _measure(setup.refined(refinement), report_at)

    found = converged(at)
    known = setup._replace(measured={name: figure.value for name, figure in found.items()})
    for fact in FACTS:
        for name, note in (fact.notes(known) if fact.notes else {}).items():
            found[name] = found[name]._replace(note=note)
    return found


def met(row: Row, measured: Mapping[str, Converged]) -> bool:
    """Return whether a row is met at both resolutions."""
    return row.met(measured[row.name].value) and row.met(measured[row.name].refined)
