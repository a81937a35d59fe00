"""The settings of config/force_control.yaml: every row reached, quiet at rest and moved."""

import pytest
from conftest import ROOT

from asi_analysis.experiments.experiment import read_parameters
from asi_analysis.limit_cycle.quench.attack import search
from asi_analysis.tuning.figures import figures, missed
from asi_analysis.tuning.search import left_in_motion

SUBSTEP = 'maximum_substep'


@pytest.fixture(scope='module')
def controller():
    return read_parameters(ROOT / 'config' / 'force_control.yaml', 'controller')


@pytest.mark.parametrize('actuator', [{}, {SUBSTEP: 1.25e-5}])
def test_settings_reach_every_row(controller, actuator):
    misses = missed(figures(actuator, controller))
    assert {row for row, miss in misses.items() if miss > 0.0} == set()


def test_moved_piston_does_not_oscillate(controller):
    assert left_in_motion({}, controller, (5000.0, 2000.0)) == 0.0


def test_attack_finds_nothing(controller):
    assert not any(trial.sustained for trial in search(
        {}, controller, (5000.0, 2000.0, 1000.0), 60, seed=4))
