"""`asi tune`: its figures, its front, and a search that ends better than it begins."""

import numpy as np
import pytest
from documented import problems

from asi_analysis.experiments.experiment import read_parameters
from asi_analysis.tuning import search
from asi_analysis.tuning.answer import tune_controller
from asi_analysis.tuning.figures import (
    ROWS,
    figures,
    held,
    late_errors,
    missed,
    step_figures,
)
from asi_analysis.tuning.search import RANGES, Candidate, first_point, front, settings
from asi_controller.parameters import COMPENSATOR_PARAMETERS

# An actuator that does what it is told, at once: its figures are known.
IDEAL = {f'{block}.model': 'off' for block in (
    'valve_hysteresis', 'valve_flexure', 'fluid_dynamics', 'friction', 'force_sensor',
    'hydraulic_damping')} | {'force_sensor.mass_share': 0.0}
OPEN = {'gain': 1e-12}


def test_figures_of_an_ideal_actuator_are_those_of_a_tick_of_delay():
    found = figures(IDEAL, OPEN)
    assert found['settling_worst_s'] == pytest.approx(1.0 / 5000.0)
    assert found['overshoot_percent'] == pytest.approx(0.0, abs=1e-6)
    assert found['felt_force_slow_n'] == pytest.approx(0.0, abs=1e-6)
    assert found['sine_error_percent'] == pytest.approx(200.0 * np.pi * 10.0 / 5000.0, rel=0.01)
    assert found['gain_100_hz_db'] == pytest.approx(0.0, abs=1e-6)


def test_felt_force_and_impedance_of_a_damper_are_its_own():
    damper = IDEAL | {'hydraulic_damping.model': 'linear', 'hydraulic_damping.linear_gain': 500.0}
    found = figures(damper, OPEN)
    assert found['felt_force_slow_n'] == pytest.approx(100.0, rel=1e-3)
    assert found['least_re_z_n_s_m'] == pytest.approx(500.0, rel=1e-3)
    # A gain of 0.5 leaves two thirds of it.
    held = figures(damper, {'gain': 0.5})
    assert held['felt_force_slow_n'] == pytest.approx(100.0 / 1.5, rel=0.01)


def test_a_row_is_missed_by_its_ratio_and_reached_at_its_value():
    at = {row.name: row.goal for row in ROWS}
    assert all(abs(miss) < 1e-9 for miss in missed(at).values())
    worse = missed(at | {'felt_force_slow_n': 60.0, 'gain_100_hz_db': -6.0, 'peak_db': 5.0,
                         'least_re_z_n_s_m': -10.0})
    assert worse['felt_force_slow_n'] == pytest.approx(np.log(2.0))
    assert [worse[name] > 0.0 for name in ('gain_100_hz_db', 'peak_db', 'least_re_z_n_s_m')] == (
        3 * [True])
    assert missed(at, {'peak_db': 3.0})['peak_db'] < 0.0


def test_attack_is_at_the_rate_asked_for_and_at_lower_ones():
    assert search.attacked_rates(2000.0) == (2000.0, 1000.0)
    assert search.attacked_rates(800.0) == (800.0,)


def test_front_has_those_that_nothing_quiet_beats():
    def at(a, b, left=0.0):
        return Candidate(0.0, {}, {'a': a, 'b': b}, left)
    tried = [at(1, 3), at(2, 2), at(2, 3), at(3, 1), at(0, 0, left=1.0)]
    assert [(each.figures['a'], each.figures['b']) for each in front(tried, ('a', 'b'))] == [
        (1, 3), (2, 2), (3, 1)]


def test_late_errors_say_what_the_settling_time_says_without_its_jumps():
    steps = held({'load.type': 'locked'}, {'gain': 3.0}, 5000.0)[0]
    settling = [step.settling_s for step in step_figures(steps, 5000.0)]
    for after in (0.005, 0.02, 0.1):
        assert [late <= 0.0 for late in late_errors(steps, 5000.0, after)] == [
            each <= after for each in settling]
    # A ripple of 2.1 % of 100 N after 0.2 s: nearly settled, though it settles late.
    steps[2, 2] = 100.0
    steps[2, 2, 1050:1060] = 102.1
    assert step_figures(steps, 5000.0)[2].settling_s > 0.2
    assert late_errors(steps, 5000.0, 0.015)[2] == pytest.approx(np.log(1.05))


def test_points_are_settings_and_within_what_the_controller_takes():
    parameters = {each.name: each for each in COMPENSATOR_PARAMETERS}
    for corner in (0.0, 1.0):
        for name, value in settings(np.full(len(RANGES), corner)).items():
            assert parameters[name].problem(value) is None
    point = np.linspace(0.0, 1.0, len(RANGES))
    # Four digits of a value.
    assert first_point(settings(point)) == pytest.approx(point, abs=1e-3)


def test_search_writes_what_it_finds_and_says_what_it_is(monkeypatch, tmp_path):
    monkeypatch.setattr(search, 'ATTACKED', 2)
    monkeypatch.setattr(search, 'POPULATION', 2)
    found = tune_controller({}, {}, 'quiet', 2, 4, 1, tmp_path)
    assert problems(found.to_dict(), 'asi tune') == []
    assert read_parameters(tmp_path / 'controller.yaml', 'controller') == found.controller
    assert found.evaluations == 2 and found.conditions_tried == 4
    assert {row['name'] for row in found['rows']} == {row.name for row in ROWS}
    found.write_report(tmp_path)
