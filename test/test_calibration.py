"""The calibration: repeats, goes on where it stopped, and is not fooled by a waveform."""

import numpy as np
import pytest
from study import STUDY

from asi_analysis import calibration
from asi_analysis.calibration import (
    FREE,
    Candidate,
    calibrate,
    cost,
    decode,
    encode,
    load,
    misses,
    new_search,
    quantities,
    read_best,
    result,
    write_best,
)
from asi_analysis.errors import InputError
from asi_analysis.facts.conditions import SPRING, Conditions, StepTest
from asi_analysis.facts.measures import step_test

SOME = ('valve_flexure.coil_frequency', 'conditions.lead_lag.gain')


def small_search():
    start = Candidate({}, Conditions())
    return new_search(quantities(start), start.actuator, start.conditions, seed=3, spread=0.05,
                      only=SOME)


def test_points_of_the_cube_are_their_quantities():
    point = np.linspace(0.05, 0.95, len(FREE))
    assert encode(decode(point)) == pytest.approx(point)
    one = calibration.candidate(decode(point), {}, Conditions())
    assert quantities(one) == pytest.approx(decode(point))


def test_search_repeats_and_can_be_resumed(tmp_path, monkeypatch):
    monkeypatch.setattr(calibration, 'POPULATION', 4)
    whole = calibrate(small_search(), 8, 1, tmp_path / 'whole')
    calibrate(small_search(), 4, 0, tmp_path / 'part')
    resumed = calibrate(load(tmp_path / 'part'), 8, 1, tmp_path / 'part')
    assert resumed.evaluations == whole.evaluations
    assert resumed.best_cost == whole.best_cost
    assert np.array_equal(resumed.best, whole.best)
    # What was kept is what it costs: nothing was given up by mistake.
    assert cost(misses(whole.problem.measure(whole.best)[1])) == whole.best_cost
    write_best(result(whole), tmp_path / 'best.json')
    assert quantities(read_best(tmp_path / 'best.json')) == quantities(result(whole))


def test_a_spike_does_not_win_the_row():
    """A mass and spring of the first study that hit Kp = 3's figures by a spike and a dip."""
    values = STUDY | {'load.mass': 6.1, 'load.stiffness': 33.7e3, 'load.damping': 20.0}
    test = StepTest({'compensator': 'proportional', 'gain': 3.0}, 146.0, SPRING)
    measured = step_test(values, Conditions(feedforward=1.869), test, 'proportional')
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
        new_search(quantities(Candidate({}, Conditions())), {}, Conditions(), 1, 0.1,
                   only=('no.such.name',))
