"""The settings of config/force_control*.yaml: what each reaches, and under attack."""

import pytest
from conftest import ROOT

from asi_analysis.experiments.experiment import read_parameters
from asi_analysis.limit_cycle.quench.attack import search
from asi_analysis.tuning.figures import figures, missed

FELT = {'felt_force_slow_n', 'felt_force_fast_n'}
# What each gives up (doc/explanation/force_control.md).
GIVEN_UP = {'force_control': FELT, 'force_control_transparent': {'least_re_z_n_s_m'},
            'force_control_stiff': FELT | {'steady_state_error_n'}}


@pytest.mark.parametrize('name', GIVEN_UP)
def test_settings_reach_all_but_what_they_give_up(name):
    controller = read_parameters(ROOT / 'config' / f'{name}.yaml', 'controller')
    misses = missed(figures({}, controller))
    assert {row for row, miss in misses.items() if miss > 0.0} == GIVEN_UP[name]


def test_attack_finds_nothing_against_the_default_settings():
    controller = read_parameters(ROOT / 'config' / 'force_control.yaml', 'controller')
    assert not any(trial.sustained for trial in search(
        {}, controller, (5000.0, 2000.0, 1000.0), 60, seed=4))
