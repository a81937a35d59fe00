"""Which nonlinearity: the paper's argument as a table, and the shape of foreign oscillations."""

import pytest

from asi_analysis import json_keys
from asi_analysis.attribution.ablation import NONLINEARITIES, attribute, shapley


def test_shapley_values_add_up_and_share_what_only_a_pair_does():
    # A game of known values: 6 for the first alone, 4 more for second and third together.
    def worth(subset):
        return (6.0 * (NONLINEARITIES[0] in subset)
                + 4.0 * ({NONLINEARITIES[1], NONLINEARITIES[2]} <= set(subset)))
    from itertools import combinations
    subsets = [s for size in range(5) for s in combinations(NONLINEARITIES, size)]
    values = shapley({subset: worth(subset) for subset in subsets})
    assert list(values.values()) == pytest.approx([6.0, 2.0, 2.0, 0.0])


@pytest.fixture(scope='module')
def table():
    return attribute({}, {'reference.amplitude': 100.0}, 5000.0)


def test_hysteresis_alone_is_necessary_and_sufficient_as_the_paper_concludes(table):
    by_name = {cause['nonlinearity']: cause for cause in table['causes']}
    assert [name for name, c in by_name.items() if c['necessary'] and c['sufficient']] == [
        'valve_hysteresis']
    assert not any(c['necessary'] or c['sufficient'] for name, c in by_name.items()
                   if name != 'valve_hysteresis')
    # Section 4.2: damping regulates the amplitude, which is far too large without it.
    assert by_name['hydraulic_damping']['share'] < -0.1
    assert 'valve hysteresis causes the cycle' in table['verdict']


def test_balance_meets_each_simulated_cycle_of_the_table(table):
    compared = 0
    for cause in table['causes']:
        for prefix in ('alone', 'all_but'):
            if cause[f'{prefix}_frequency_hz'] is None:
                continue
            compared += 1
            assert cause[f'{prefix}_predicted_frequency_hz'] == pytest.approx(
                cause[f'{prefix}_frequency_hz'], rel=0.02)
            assert cause[f'{prefix}_predicted_amplitude_n'] == pytest.approx(
                cause[f'{prefix}_amplitude_n'], rel=0.05)
    assert compared == 4
    assert json_keys.problems(table, json_keys.DOCUMENTS['asi attribute']) == []


def test_linear_instability_is_not_blamed_on_a_nonlinearity():
    found = attribute({}, {'reference.amplitude': 100.0}, 5000.0, gain=14.0)
    assert 'linear instability' in found['verdict']
