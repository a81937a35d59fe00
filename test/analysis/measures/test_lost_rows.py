"""Rows lost at regular intervals, times numbered again: told by the motion and by the command."""

from dataclasses import replace

import numpy as np
import pytest

from asi_analysis.bags.run import SIGNALS, Run
from asi_analysis.loop.in_process import simulate
from asi_analysis.measures.checks.lost_rows import skipped_in_motion
from asi_analysis.measures.quality import findings


def a_loop(shape: str = 'step', compensator: str = 'lead_lag', **controller: float) -> Run:
    """Return a run with noise, without the record of its controller."""
    return replace(simulate({'load.type': 'spring', 'force_sensor.noise': 0.3}, {
        'compensator': compensator, 'reference.shape': shape, 'reference.amplitude': 100.0,
        'reference.frequency': 2.0, **controller}, 1.0, 1000.0), information={})


def without_each(run: Run, number: int) -> Run:
    """Return a run without each such row, at even times."""
    rows = np.flatnonzero(np.arange(len(run)) % number)
    return replace(run, time_s=run.time_s[:len(rows)], **{
        each.field: run.signal(each.name)[rows] for each in SIGNALS if each.name in run.signals()})


@pytest.mark.parametrize('shape', ['step', 'triangle'])
@pytest.mark.parametrize('number', [4, 17, pytest.param(10, marks=pytest.mark.slow)])
def test_the_command_shows_rows_that_were_lost(shape: str, number: int) -> None:
    run = replace(a_loop(shape), position_m=None, velocity_m_s=None)
    assert findings(run) == []
    assert 'missing' in {each.kind for each in findings(without_each(run, number))}


@pytest.mark.parametrize('number', [3, 4, 10])
def test_the_position_shows_rows_that_were_lost(number: int) -> None:
    t = np.arange(2000) / 1000.0
    position, velocity = 0.05 * np.sin(9.0 * t), 0.45 * np.cos(9.0 * t)
    assert skipped_in_motion(t, position, velocity) == ()
    rows = np.flatnonzero(np.arange(len(t)) % number)
    assert skipped_in_motion(t[rows], position[rows], velocity[rows]) == ()     # the times tell it
    lost = skipped_in_motion(t[:len(rows)], position[rows], velocity[rows])
    assert len(lost) > 0.7 * len(t) / number
    coarse = 1e-4 * np.round(1e4 * position[rows])      # an encoder: nothing is certain
    assert skipped_in_motion(t[:len(rows)], coarse, velocity[rows]) == ()


@pytest.mark.parametrize('addition', [
    {'hysteresis_inverse.size': 20.0}, *(pytest.param(each, marks=pytest.mark.slow) for each in (
        {'gain_schedule.velocity': 0.1}, {'saturation': 110.0}))])
def test_a_controller_that_is_not_linear_lost_no_rows(addition: dict[str, float]) -> None:
    for shape in ('step', 'triangle'):
        assert findings(a_loop(shape, **addition)) == []


@pytest.mark.parametrize('shape', ['sine', 'triangle', 'multisine'])
def test_rows_left_out_of_a_run_of_this_package_are_no_cut_at_its_beginning(shape: str) -> None:
    """Either leaves the first states unknown; but the reference of a part is a part of it."""
    run = simulate({'load.type': 'spring', 'force_sensor.noise': 0.2}, {
        'compensator': 'lead_lag', 'reference.shape': shape, 'reference.amplitude': 100.0},
        1.0, 1000.0)
    rows = run[5::10]
    assert [each.kind for each in findings(replace(
        rows, time_s=0.001 * np.arange(len(rows)))) if each.severity == 'doubtful'] == ['answer']
    assert findings(run[40:]) == []
