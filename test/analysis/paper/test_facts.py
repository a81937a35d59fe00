"""The facts declare themselves; each row is met only if it is at both resolutions."""

import math

import pytest

from asi_analysis.paper.facts import published, table
from asi_analysis.paper.facts.conditions import Conditions
from asi_analysis.paper.facts.converged import Converged
from asi_analysis.paper.facts.fact import Fact, Role, Row, Setup, Stage

A_FACT = """
from asi_analysis.paper.facts.fact import Fact, Row
FACT = Fact('F99', (Row('answer', 'the answer', '6', 42.0, '', 41.0, 43.0),),
            lambda setup: {'answer': 42.0}, lambda setup: 'any', 'by thought')
"""


def test_a_fact_is_one_file(tmp_path, monkeypatch):
    (tmp_path / 'f99_answer.py').write_text(A_FACT)
    monkeypatch.setattr(published, '__path__', [*published.__path__, str(tmp_path)])
    *others, last = table._declared()
    assert [fact.id for fact in others] == [fact.id for fact in table.FACTS]
    assert last.id == 'F99' and last.measure(Setup({}, Conditions(), {})) == {'answer': 42.0}


def test_rows_have_names_of_their_own_and_fitted_facts_a_stage():
    names = [row.name for row in table.ROWS]
    assert len(set(names)) == len(names)
    for fact in table.FACTS:
        fitted = any(row.role is Role.FITTED for row in fact.rows)
        assert (fact.stage is not None) == fitted, fact.id
        assert fact.conditions(Setup({}, Conditions(), {})) and fact.method


@pytest.mark.parametrize(('value', 'refined', 'met'), [
    (9.9, 10.1, False), (10.1, 9.9, False), (10.1, 10.2, True), (math.inf, math.inf, True)])
def test_a_row_is_met_only_at_both_resolutions(value, refined, met):
    row = Row('x', 'x', '1', 10.0, '', 10.0, math.inf)
    assert table.met(row, {'x': Converged(value, refined)}) is met


def test_measures_know_their_resolution_and_what_was_measured(monkeypatch):
    def measure(setup):
        substep = float(setup.record()['maximum_substep'])
        return {'y': setup.measured['x'] + 1.0} if 'x' in setup.measured else {'x': 1e6 * substep}

    def fact(name):
        row = Row(name, name, '1', 0.0, '', -math.inf, math.inf)
        return Fact(name, (row,), measure, lambda setup: '', '', Stage.ONSET)

    monkeypatch.setattr(table, 'FACTS', (fact('x'), fact('y')))
    found = table.measure(Setup({}, Conditions(), {}))
    assert found['x'][:2] == pytest.approx((25.0, 12.5))
    assert found['y'][:2] == pytest.approx((26.0, 13.5))
