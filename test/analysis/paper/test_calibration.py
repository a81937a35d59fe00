"""The calibration: repeats, goes on where it stopped, and is not fooled by a waveform."""

import math

import numpy as np
import pytest
from study import STUDY

from asi_analysis.errors import InputError
from asi_analysis.free_parameter import to_values, to_vector
from asi_analysis.paper.calibration import search
from asi_analysis.paper.calibration.cost import INNER, cost, misses
from asi_analysis.paper.calibration.front import Fit, front
from asi_analysis.paper.calibration.plausible import findings, penalty
from asi_analysis.paper.calibration.quantities import (
    FREE,
    STRUCTURES,
    TESTS,
    Candidate,
    candidate,
    quantities,
    read_best,
    write_best,
)
from asi_analysis.paper.calibration.search import LINES, calibrate, load, new_search, result
from asi_analysis.paper.facts.conditions import LOCKED, SPRING, Conditions, StepTest
from asi_analysis.paper.facts.fact import Setup, Stage
from asi_analysis.paper.facts.table import FITTED_ROWS
from asi_analysis.paper.facts.table_1 import step_test

SOME = ('valve_flexure.coil_frequency', 'conditions.lead_lag.gain')


def small_search():
    start = Candidate({}, Conditions())
    return new_search(start, STRUCTURES['side'], seed=3, spread=0.05, only=SOME)


def test_points_of_the_cube_are_their_quantities():
    point = np.linspace(0.05, 0.95, len(FREE))
    assert to_vector(FREE, to_values(FREE, point)) == pytest.approx(point)
    one = candidate(to_values(FREE, point), {}, Conditions())
    assert quantities(one) == pytest.approx(to_values(FREE, point))


@pytest.mark.slow
def test_search_repeats_and_can_be_resumed(tmp_path, monkeypatch):
    monkeypatch.setattr(search, 'RACE', (4, 3, 2, 2, 2))
    whole = calibrate(small_search(), 8, 1, tmp_path / 'whole')
    calibrate(small_search(), 4, 0, tmp_path / 'part')
    resumed = calibrate(load(tmp_path / 'part'), 8, 1, tmp_path / 'part')
    assert resumed.evaluations == whole.evaluations
    assert resumed.best_cost == whole.best_cost
    assert np.array_equal(resumed.best, whole.best)
    assert whole.counts == [8, 6, 4, 4, 4]
    # What was kept is what it costs: the race has measured it to the end.
    assert whole.problem.cost(whole.best, whole.problem.measure(whole.best)) == whole.best_cost
    write_best(result(whole), tmp_path / 'best.json')
    assert quantities(read_best(tmp_path / 'best.json')) == quantities(result(whole))


def test_polish_steps_to_the_limits_and_not_through_others():
    """Two rows, two quantities: the first row is missed, the second would be by going too far."""
    here, slopes = np.full(len(LINES), -5.0), np.zeros((len(LINES), 2))
    is_two_sided = np.array([not row.one_sided for row in LINES])
    here[is_two_sided] = 0.0
    two_sided = np.flatnonzero(is_two_sided)[:2]
    here[two_sided[0]] = 2.0
    slopes[two_sided[0]] = -10.0, -10.0
    slopes[two_sided[1]] = 20.0, 0.0
    after = search._step(np.array([0.5, 0.5]), here, slopes, 0.2) - 0.5
    rows = here + slopes @ after
    assert np.all(np.abs(rows[two_sided]) < INNER)
    assert np.all(np.abs(after) <= 0.2)
    # Too short a reach: as far as it goes.
    assert search._step(np.array([0.5, 0.5]), here, slopes, 0.01) == pytest.approx(0.51)


@pytest.mark.slow
def test_structures_hold_what_they_say():
    cylinder = new_search(Candidate({}, Conditions()), STRUCTURES['cylinder'], 1, 0.1)
    assert result(cylinder).actuator['force_sensor.mass_share'] == 0.0
    locked = result(new_search(Candidate({}, Conditions()), STRUCTURES['locked'], 1, 0.1))
    assert [getattr(locked.conditions, name).load for name in TESTS] == 3 * [LOCKED]
    spring = result(new_search(Candidate({}, Conditions()), STRUCTURES['spring'], 1, 0.1))
    assert spring.conditions.proportional.load == pytest.approx(Conditions().proportional.load)


def test_table_1_can_be_left_out_or_be_all_that_is_fitted():
    start = Candidate({}, Conditions())
    without = new_search(start, STRUCTURES['side'], 1, 0.1, SOME, table_1=False).problem
    assert [FREE[k].name for k in without.free] == ['valve_flexure.coil_frequency']
    assert without.stages == tuple(stage for stage in Stage if stage is not Stage.TABLE_1)
    alone = new_search(start, STRUCTURES['side'], 1, 0.1, ['conditions']).problem
    assert alone.stages == (Stage.TABLE_1,)
    with pytest.raises(InputError, match='nothing varies'):
        new_search(start, STRUCTURES['side'], 1, 0.1, ['conditions'], table_1=False)


def test_a_demanded_row_costs_where_it_is_not_at_its_value():
    name = 'predicted_onset_frequency_hz'
    demanded = search.at_value(name, 125.0)
    assert (demanded.low + demanded.high) / 2.0 == pytest.approx(125.0)
    assert search.at_value('nothing', 1.0) is None
    alone = new_search(Candidate({}, Conditions()), STRUCTURES['side'], 1, 0.1, ['conditions'])
    problem = alone.problem._replace(demanded=demanded)
    free = problem.cost(alone.best, {})
    assert problem.cost(alone.best, {name: 125.0}) == pytest.approx(free)
    assert problem.cost(alone.best, {name: 130.0}) > free + 5.0
    assert alone.problem.cost(alone.best, {name: 130.0}) == pytest.approx(free)


def test_table_1_is_one_experiment(tmp_path):
    tests = [getattr(Conditions(), name) for name in TESTS]
    assert len({test.amplitude_n for test in tests}) == 1
    assert all(test.load == tests[0].load for test in tests)
    mixed = Conditions()._replace(lead4=Conditions().lead4._replace(load=LOCKED))
    write_best(Candidate({}, mixed), tmp_path / 'mixed.json')
    with pytest.raises(InputError, match='one load'):
        read_best(tmp_path / 'mixed.json')


def test_what_is_not_plausible_is_found_and_costs():
    stiff = {'load.locked_stiffness': 1e6, 'load.mass': 0.5, 'friction.presliding_damping': 40.0}
    damper = 2.0 * math.sqrt(1e6 * 0.5)
    steel = Candidate({**stiff, 'load.locked_damping': 0.02 * damper}, Conditions())
    rubber = Candidate({**stiff, 'load.locked_damping': 0.5 * damper}, Conditions())
    name = 'damping ratio of the locked structure'
    assert name not in [each.name for each in findings(steel)]
    found = next(each for each in findings(rubber) if each.name == name)
    assert found.value == pytest.approx(0.5) and found.high == 0.05
    assert penalty(rubber) - penalty(steel) == pytest.approx(math.log(10.0))
    at_bound = Candidate({**steel.actuator, 'load.mass': 5.0}, Conditions())
    assert 'on a bound of the search' in [each.problem for each in findings(at_bound)
                                          if each.name == 'load.mass']


def test_front_holds_its_quantity_and_begins_where_the_last_ended(monkeypatch):
    """Of a made-up row that only the coil moves: the rest is polished, the held is not."""
    seen = []

    def measured(problem, point):
        found = to_values(FREE, problem.whole(point))
        seen.append(found['valve_hysteresis.radius'])
        middle = {row.name: 0.5 * (row.low + row.high) if math.isfinite(row.high)
                  else 2.0 * row.low + 1.0 for row in FITTED_ROWS}
        return middle | {'open_loop_bandwidth_hz': found['valve_flexure.coil_frequency'] + 4.0}

    monkeypatch.setattr(search.Problem, 'measure', measured)
    plausible = {'load.locked_damping': 110.0, 'friction.presliding_damping': 100.0}
    held = front('valve_hysteresis.radius', [20.0, 10.0], Candidate(plausible, Conditions()),
                 Fit(rounds=8))
    assert [each.value for each in held] == pytest.approx(sorted(set(seen), reverse=True))
    assert [each.cost for each in held] == [0.0, 0.0]
    assert held[0].evaluations > 1 == held[1].evaluations
    assert not held[0].not_met


def test_a_chattering_command_is_no_one_rise():
    """The setting that settled in Table 1's 0.04 s by chattering between the limits."""
    setup = Setup({}, Conditions(), {})
    test = Conditions().lead4
    wild = test._replace(controller={**test.controller, 'gain': 60.0, 'lead4.ratio': 13.8})
    assert step_test(setup, test, 'lead4')['lead4_monotone'] == 1.0
    assert step_test(setup, wild, 'lead4')['lead4_monotone'] == 0.0


def test_a_spike_does_not_win_the_row():
    """A mass and spring of the first study that hit Kp = 3's figures by a spike and a dip."""
    values = STUDY | {'load.mass': 6.1, 'load.stiffness': 33.7e3, 'load.damping': 20.0}
    test = StepTest({'compensator': 'proportional', 'gain': 3.0}, 146.0, SPRING)
    measured = step_test(Setup(values, Conditions(feedforward=1.869), {}), test, 'proportional')
    assert measured['proportional_monotone'] == 0.0
    others = {name: value for name, value in measured.items() if not name.endswith('monotone')}
    assert cost(misses(measured)) > cost(misses(others))


def test_bad_files_are_named(tmp_path):
    (tmp_path / 'state').write_text('no state')
    with pytest.raises(InputError, match='state'):
        load(tmp_path / 'state')
    with pytest.raises(InputError, match='nowhere.json'):
        read_best(tmp_path / 'nowhere.json')
    with pytest.raises(InputError, match='no.such.name'):
        new_search(Candidate({}, Conditions()), STRUCTURES['side'], 1, 0.1,
                   only=('no.such.name',))
