"""The shipped settings: the rows that each gives up and no other, the default ones quiet."""

import json

import numpy as np
import pytest
from conftest import ROOT

from asi_analysis.experiments.experiment import read_parameters
from asi_analysis.limit_cycle.quench.attack import NAMES, Condition, run_trials, search
from asi_analysis.tuning import figures as figures_module
from asi_analysis.tuning.figures import figures, missed
from asi_analysis.tuning.search import RATES_HZ

FELT = {'felt_force_slow_n', 'felt_force_fast_n'}
GIVEN_UP = {'quiet': {'felt_force_fast_n'}, 'stiff': FELT, 'transparent': {'steady_state_error_n'}}


def shipped(name):
    return read_parameters(ROOT / 'config' / f'{name}.yaml', 'controller')


@pytest.mark.parametrize(('name', 'actuator'), [
    *((name, {}) for name in GIVEN_UP),
    pytest.param('quiet', {'maximum_substep': 1.25e-5}, marks=pytest.mark.slow)])
def test_settings_miss_the_rows_that_they_give_up(name, actuator):
    misses = missed(figures(actuator, shipped(name)))
    assert {row for row, miss in misses.items() if miss > 0.0} == GIVEN_UP[name]


def test_default_settings_are_passive_where_the_row_does_not_look(monkeypatch):
    monkeypatch.setattr(figures_module, 'IMPEDANCE_M_S', (0.05, 0.2, 0.3, 0.5))
    monkeypatch.setattr(figures_module, 'IMPEDANCE_HZ', (1.0, 3.0, 5.0, 8.0, 30.0))
    for rate in (5000.0, 1000.0):
        assert figures_module.impedance({}, shipped('quiet'), rate).real.min() >= 0.0


def test_moved_piston_does_not_oscillate():
    random = np.random.default_rng(3)
    moved = 0.99   # the last of LOADS
    conditions = [Condition({**dict(zip(NAMES, random.random(len(NAMES)), strict=True)),
                             'load': moved}) for _ in range(60)]
    trials = run_trials(conditions, {}, shipped('quiet'), RATES_HZ)
    assert not any(trial.sustained for trial in trials)


def test_attack_finds_nothing():
    assert not any(trial.sustained for trial in search(
        {}, shipped('quiet'), RATES_HZ, 60, seed=4))


def test_conditions_in_which_bolder_settings_cycle_are_quiet():
    """Heavy loads on springs, and moved pistons: the attack found them for other settings."""
    known = [Condition(numbers) for numbers in json.loads(
        (ROOT / 'test' / 'controller' / 'known_cycles.json').read_text())]
    cycling = {name: sum(trial.sustained for trial in run_trials(
        known, {}, shipped(name), (1000.0,))) for name in ('quiet', 'transparent')}
    assert cycling['quiet'] == 0 < cycling['transparent']
