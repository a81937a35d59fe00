"""The settings of config/force_control.yaml: every row reached, quiet at rest and moved."""

import numpy as np
import pytest
from conftest import ROOT

from asi_analysis.experiments.experiment import read_parameters
from asi_analysis.limit_cycle.quench.attack import NAMES, Condition, run_trials, search
from asi_analysis.tuning.figures import figures, missed
from asi_analysis.tuning.search import RATES_HZ

SUBSTEP = 'maximum_substep'


@pytest.fixture(scope='module')
def controller():
    return read_parameters(ROOT / 'config' / 'force_control.yaml', 'controller')


@pytest.mark.parametrize('actuator', [{}, {SUBSTEP: 1.25e-5}])
def test_settings_reach_every_row(controller, actuator):
    misses = missed(figures(actuator, controller))
    assert {row for row, miss in misses.items() if miss > 0.0} == set()


def test_moved_piston_does_not_oscillate(controller):
    random = np.random.default_rng(3)
    moved = 0.99   # the last of LOADS
    conditions = [Condition({**dict(zip(NAMES, random.random(len(NAMES)), strict=True)),
                             'load': moved}) for _ in range(60)]
    trials = run_trials(conditions, {}, controller, RATES_HZ)
    assert not any(trial.sustained for trial in trials)


def test_attack_finds_nothing(controller):
    assert not any(trial.sustained for trial in search(
        {}, controller, RATES_HZ, 60, seed=4))
