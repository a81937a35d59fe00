"""Cases of the simulator itself: the same seed gives the same case, and only one thing differs."""

import numpy as np
import pytest

from asi_actuator.parameters import as_record
from asi_analysis.gap.diagnose import diagnose
from asi_analysis.gap.document import document
from asi_common.record import field_name
from asi_examiner.own import CHANGED, VISIBLE, draw_own, truth


@pytest.mark.parametrize('seed', [
    pytest.param(61000, marks=pytest.mark.slow), *range(61001, 61006)])
def test_own_case_is_what_its_answer_says(seed):
    case = draw_own(seed)
    assert case.run.rate_hz == pytest.approx(case.rate_hz)
    kind, effects, blocks = truth(case)
    if case.changed is None:
        assert (kind, effects, case.visibility, case.sizes) == ('none', [], 0.0, {})
    else:
        if case.changed in CHANGED:
            assert (effects[0], blocks[0]) == CHANGED[case.changed]
            assert not 1.0 / 1.3 < case.factor < 1.3
            nominal = float(as_record(case.nominal)[field_name(case.changed)])
            assert case.sizes == {field_name(case.changed): nominal * case.factor}
        else:
            assert effects == [case.changed] and case.sizes
        assert (kind == 'effect') == (case.visibility > VISIBLE)


def test_same_seed_is_the_same_case():
    case, again = draw_own(61001), draw_own(61001)
    np.testing.assert_array_equal(case.run.force_n, again.run.force_n)
    assert case.visibility == again.visibility


@pytest.mark.slow
def test_what_the_tolerances_explain_is_too_small():
    """A locked load at a lower supply pressure: thrust and gains within 20 % do the same."""
    case = draw_own(160018)
    assert case.changed == 'supply_pressure' and truth(case)[0] == 'small'


@pytest.mark.slow
@pytest.mark.parametrize('share', [1.0, 0.9, 0.5])
def test_the_form_with_fewer_parameters_stands_for_an_effect(share):
    """An asymmetric Coulomb friction costs a little less, but is far less probable."""
    case = draw_own(161003)
    assert case.changed == 'coulomb_friction'
    run = case.run[:int(share * case.run.time_s.size)]
    answer = document(diagnose([run], case.nominal))
    assert answer['verdict'] == 'coulomb_friction' and answer['probability'] > 0.9
    friction, = (each for each in answer['which'] if each['effect'] == 'coulomb_friction')
    assert set(friction['parameters']) == {'friction_coulomb'}
