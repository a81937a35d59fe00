"""Table 1 at other conditions: over steps and loads, and each column at its best condition."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from asi_analysis.experiments.step_tests import LEAD4, LEAD_LAG, PROPORTIONAL, StepTest
from asi_analysis.paper.calibration.plausible import findings
from asi_analysis.paper.calibration.quantities import Candidate
from asi_analysis.paper.facts.conditions import LOCKED
from asi_analysis.paper.facts.fact import Measured, Row, Setup
from asi_analysis.paper.facts.table import FACTS
from asi_analysis.paper.facts.table_1 import load_in_words, step_test
from asi_analysis.reporting.figures import COLOURS, drawing
from asi_common.parameter import Value

# The columns by their facts and fields of `Conditions`, each at the condition found for it alone.
# With different loads and steps these are three experiments, not one table.
ALONE: Final = {'F14': ('proportional', PROPORTIONAL), 'F15': ('lead_lag', LEAD_LAG),
                'F16': ('lead4', LEAD4)}
STEPS_N: Final = (20.0, 50.0, 100.0, 200.0, 300.0, 450.0, 600.0, 800.0)


def _rows(id_: str) -> tuple[Row, ...]:
    return next(fact.rows for fact in FACTS if fact.id == id_)


def columns_alone(setup: Setup) -> list[dict[str, Any]]:
    """Return each column of Table 1 at its best condition; these rows are not counted."""
    def problems(test: StepTest) -> dict[str, float]:
        return {each.name: each.value for each in findings(Candidate(
            setup.actuator, setup.conditions._replace(proportional=test)))}

    usual = problems(setup.conditions.proportional)
    found = []
    for id_, (name, test) in ALONE.items():
        measured = step_test(setup, test, name)
        rows = _rows(id_)
        found.append({
            'id': id_, 'conditions': f'{load_in_words(setup, test)}; step of '
                                     f'{test.amplitude_n:g} N',
            'met': sum(row.met(measured[row.name]) for row in rows), 'total': len(rows),
            'not_met': [row.name for row in rows if not row.met(measured[row.name])],
            'not_plausible': [f'{name} {value:.3g}' for name, value in problems(test).items()
                              if name not in usual]})
    return found


def sweep(setup: Setup, loads: Mapping[str, Mapping[str, Value]]
          ) -> dict[str, dict[float, Measured]]:
    """Return the cells of Table 1 by the name of the load and the step (N)."""
    conditions = setup.conditions
    return {words: {step_n: {
        key: value for name, _ in ALONE.values() for key, value in step_test(
            setup, getattr(conditions, name)._replace(load=load, amplitude_n=step_n),
            name).items()} for step_n in STEPS_N} for words, load in loads.items()}


def figure_of_sweep(setup: Setup) -> Figure:
    """Draw the twelve cells of Table 1 over the step, one curve per load; shaded: met."""
    loads = {load_in_words(setup, test): test.load for test in (
        setup.conditions.proportional, PROPORTIONAL,
        PROPORTIONAL._replace(load={**PROPORTIONAL.load, 'load.mass': 0.5,
                                    'load.stiffness': 2e5, 'load.damping': 20.0}),
        PROPORTIONAL._replace(load=LOCKED))}
    found = sweep(setup, loads)
    with drawing(9.0, 9.0) as figure:
        grid = figure.subplots(4, 3, sharex=True)
        for across, (id_, _) in enumerate(ALONE.items()):
            for down, row in enumerate(_rows(id_)[:4]):
                axes = grid[down, across]
                axes.axhspan(row.low, row.high, color='0.9')
                for (words, cells), colour in zip(found.items(), COLOURS, strict=False):
                    axes.plot(STEPS_N, [cells[step_n][row.name] for step_n in STEPS_N], '.-',
                              color=colour, label=words)
                axes.set_title(f'{row.quantity} ({row.unit})', fontsize=7.0)
                if np.isfinite(row.high) and row.unit == 's':
                    axes.set_yscale('log')
        for axes in grid[-1]:
            axes.set_xlabel('step (N)')
        figure.legend(*grid[0, 0].get_legend_handles_labels(), loc='outside lower center',
                      fontsize=7.0)
    return figure
