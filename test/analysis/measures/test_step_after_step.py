"""Steps of a reference that changes again before the signal has come to rest, or has moved."""

import numpy as np
import pytest
from scipy import signal

from asi_analysis.bags.run import Run
from asi_analysis.measures.step_response import step_response

TAU = 20.0      # samples of 1 ms


def following(reference, late=0, noise=0.0):
    """Return a run of a first-order lag that was at rest before it."""
    pole = np.exp(-1.0 / TAU)
    wanted = np.concatenate([np.full(late, reference[0]), reference])[:reference.size]
    force = signal.lfilter([1.0 - pole], [1.0, -pole], wanted, zi=[pole * wanted[0]])[0]
    force += noise * np.random.default_rng(1).standard_normal(force.size)
    return Run(np.arange(reference.size) / 1000.0, reference_n=reference, force_n=force)


def test_a_response_after_the_next_step_is_not_that_of_it():
    # Each level was measured as the response to the step before it, without a note.
    levels = np.random.default_rng(3).standard_normal(60).cumsum()
    reference = np.repeat(levels, 20)
    late = np.concatenate([np.full(30, reference[0]), reference])[:reference.size]
    found = step_response(Run(np.arange(late.size) / 1000.0, reference_n=reference, force_n=late))
    assert found.rise_time_s is None
    assert 'follows 30 ms late, after the reference has changed again' in found.notes[0]
    assert all(each['rise_time_s'] is None for each in found.steps)


@pytest.mark.parametrize('noise', [0.0, 0.2])
@pytest.mark.parametrize('hold', [2.5, 3.5, 4.5])
def test_a_signal_that_still_moves_gives_no_figure_without_a_note(hold, noise):
    reference = np.repeat([0.0, 100.0], [200, int(hold * TAU)])
    found = step_response(following(reference, noise=noise))
    assert found.rise_time_s is None or not (
        found.reliable['rise_time_s'] or found.reliable['settling_time_2_s'])
    assert any('still moves' in each or 'come to rest' in each for each in found.notes)


def test_a_step_before_the_response_to_the_last_one_has_ended():
    # The level before it was the mean of a whole transient.
    reference = np.repeat([0.0, 50.0, 150.0], [100, 50, 400])
    second = step_response(following(reference)).steps[1]
    assert any('before the step' in each for each in second['notes'])
    reference = np.repeat([0.0, 50.0, 150.0], [100, 150, 900])
    second = step_response(following(reference)).steps[1]
    assert not second['notes'] and second['rise_time_s'] == pytest.approx(0.044, rel=0.02)


@pytest.mark.parametrize('late', [0, 40])
def test_steps_that_settle_have_no_note(late):
    reference = np.repeat([10.0, 100.0, -50.0, 30.0, 100.0], 200)
    found = step_response(following(reference, late))
    for each in found.steps:
        assert not each['notes']
        assert each['rise_time_s'] == pytest.approx(0.044, rel=0.05)
        assert each['settling_time_5_s'] == pytest.approx(0.06 + late / 1000.0, rel=0.1)
