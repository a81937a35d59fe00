"""What corners, rows, noise and a cut of a signal tell where no controller was recorded."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from asi_analysis.bags.run import SIGNALS, Run
from asi_analysis.loop.in_process import simulate
from asi_analysis.measures.analysis import analyze
from asi_analysis.measures.quality import findings

RATE_HZ = 1000.0


def a_loop(shape: str, compensator: str = 'lead_lag', seconds: float = 1.5, **controller: Any
           ) -> Run:
    """Return a run with noise, without its controller, position and velocity."""
    run = simulate({'load.type': 'spring', 'force_sensor.noise': 0.3}, {
        'compensator': compensator, 'reference.shape': shape, 'reference.amplitude': 100.0,
        **controller}, seconds, RATE_HZ)
    return replace(run, information={}, position_m=None, velocity_m_s=None, valve_position_m=None)


@pytest.fixture(scope='module')
def triangle() -> Run:
    return a_loop('triangle', **{'reference.frequency': 2.0})


def of_rows(run: Run, rows: np.ndarray) -> Run:
    """Return these samples of a run, at even times."""
    return replace(run, time_s=np.arange(len(rows)) / RATE_HZ, **{
        each.field: run.signal(each.name)[rows] for each in SIGNALS if each.name in run.signals()})


def kinds(run: Run) -> set[tuple[str, str]]:
    return {(each.kind, each.signal) for each in findings(run)}


def changed(run: Run, change: Callable[[np.ndarray], np.ndarray]) -> Run:
    return replace(run, force_n=change(run.signal('force')))


# Alterations of a triangle, the kind of the finding, and whether the command is left out.
OF_TRIANGLE: dict[str, tuple[tuple[str, str], Callable[[Run], Run], bool]] = {
    'force before its reference': (('order', 'force'), lambda run: changed(
        run, lambda f: np.append(f[25:], f[-25:])), True),
    'backwards': (('order', 'force'), lambda run: of_rows(run, np.arange(len(run))[::-1]), True),
    'reference and force exchanged': (('order', 'force'), lambda run: replace(
        run, reference_n=run.signal('force'), force_n=run.signal('reference')), False),
    'reference and command exchanged': (('order', 'time'), lambda run: replace(
        run, reference_n=run.signal('command'), command_n=run.signal('reference')), False),
    'command and force exchanged': (('order', 'time'), lambda run: replace(
        run, command_n=run.signal('force'), force_n=run.signal('command')), False),
    'wrong sign': (('sign', 'force'), lambda run: changed(run, lambda f: -f), True),
    'each seventh row lost': (('missing', 'time'), lambda run: of_rows(
        run, np.flatnonzero(np.arange(len(run)) % 7)), True),
    'rows repeated': (('answer', 'time'), lambda run: of_rows(
        run, np.concatenate([np.arange(600), np.arange(500, len(run))])), True),
    'rows reversed': (('answer', 'time'), lambda run: of_rows(run, np.concatenate([
        np.arange(500), np.arange(500, 600)[::-1], np.arange(600, len(run))])), True),
}


@pytest.mark.parametrize('how', OF_TRIANGLE)
def test_the_corners_and_the_rows_of_a_triangle(how: str, triangle: Run) -> None:
    finding, alter, alone = OF_TRIANGLE[how]
    run = replace(triangle, command_n=None) if alone else triangle
    assert findings(run) == []
    assert finding in kinds(alter(run))
    assert analyze(alter(run)).tracking_error_rms_n is None


def test_a_sine_does_not_skip_rows_where_its_time_does_too() -> None:
    run = replace(a_loop('sine', **{'reference.frequency': 3.0}), command_n=None)
    kept = np.arange(len(run)) % 7 > 0
    with_time = replace(run, time_s=run.time_s[kept], reference_n=run.signal('reference')[kept],
                        force_n=run.signal('force')[kept])
    assert {kind for kind, _ in kinds(with_time)} == {'gap'}
    assert ('missing', 'time') in kinds(of_rows(run, np.flatnonzero(kept)))


@pytest.mark.parametrize('shape', ['triangle', 'step'])
@pytest.mark.parametrize('controller', [
    {'gain_schedule.velocity': 0.1}, pytest.param({}, marks=pytest.mark.slow)])
@pytest.mark.parametrize('change', [
    lambda f: f[::-1],
    lambda f: np.interp(0.97 * np.arange(len(f)), np.arange(len(f)), f)])   # its clock drifts
def test_a_force_whose_noise_is_not_in_the_command(
        shape: str, controller: dict[str, float], change: Callable[[np.ndarray], np.ndarray]
        ) -> None:
    """Also if the controller is not linear, so that its command satisfies no law."""
    run = a_loop(shape, 'lead4', **controller)
    assert findings(run) == []
    assert ('answer', 'force') in kinds(changed(run, change))


@pytest.mark.parametrize('compensator', ['lead_lag', 'lead2', 'lead4'])
@pytest.mark.parametrize('every', [2, 5])
def test_each_nth_row_has_noise_in_common_with_the_command(compensator: str, every: int) -> None:
    run = simulate({'load.type': 'locked', 'force_sensor.noise': 0.3}, {
        'compensator': compensator, 'reference.shape': 'ramp', 'reference.amplitude': 100.0},
        1.0, 2000.0)
    assert findings(replace(run, information={})[::every]) == []


@pytest.mark.parametrize('compensator', ['lead_lag', 'proportional'])
@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_a_clipped_force_to_which_noise_was_added(compensator: str, sign: float) -> None:
    run = replace(a_loop('step', compensator, 0.8), command_n=None)
    assert findings(run) == []
    force = run.signal('force')
    noise = np.random.default_rng(3).normal(0.0, 0.1, len(force))
    cut = np.minimum(force, force.min() + 0.8 * np.ptp(force)) + noise
    altered = replace(run, force_n=sign * cut, reference_n=sign * run.signal('reference'))
    assert kinds(altered) == {('clipping', 'force')}
    assert analyze(altered).overshoot_percent is None


@pytest.mark.parametrize('factor', [1e3, 1e-3])
def test_a_rate_that_no_control_loop_has_is_noted(factor: float, triangle: Run) -> None:
    finding, = findings(replace(triangle, time_s=factor * triangle.time_s))
    assert (finding.kind, finding.signal, finding.severity) == ('slow', 'time', 'doubtful')


def test_a_straight_line_of_few_digits_is_not_interpolated() -> None:
    """Its only noise is the resolution of the file."""
    run = simulate({'load.type': 'locked'}, {
        'compensator': 'proportional', 'reference.shape': 'ramp', 'reference.amplitude': 100.0,
        'feedforward': 1.0}, 0.8, RATE_HZ)
    force = np.array([float(f'{each:.5g}') for each in run.signal('force')])
    assert findings(Run(run.time_s, run.reference_n, None, force)) == []


@pytest.mark.parametrize('compensator', ['proportional', 'lead_lag'])
def test_a_force_mirrored_while_its_reference_rests_is_found(compensator: str) -> None:
    """The sign of its changes: no jump shows it, and no gain of a stable loop has its effect."""
    run = a_loop('step', compensator)
    mirrored = changed(run, lambda f: np.append(f[:900], 2.0 * f[900] - f[900:]))
    assert kinds(run) == set()
    assert kinds(mirrored) == {('answer', 'force')}


@pytest.mark.parametrize(('shape', 'compensator'), [('step', 'lead_lag'), ('multisine', 'lead2')])
def test_a_part_of_which_the_rows_are_reversed_follows_from_later_samples(
        shape: str, compensator: str) -> None:
    """The law of the rest of the run is exact there too, in the reverse order."""
    run = a_loop(shape, compensator)
    rows = np.arange(len(run))
    rows[700:800] = rows[700:800][::-1]
    found, = findings(replace(of_rows(run, rows), time_s=run.time_s))
    assert (found.kind, found.signal, found.severity) == ('time_order', 'time', 'doubtful')
    assert found.intervals_s[0] == pytest.approx((0.7, 0.8), abs=0.003)


@pytest.mark.parametrize(('shape', 'frequency_hz'), [
    ('sine', 1.0), ('sine', 20.0), ('multisine', 1.0), ('chirp', 1.0), ('triangle', 1.0)])
@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_a_force_without_its_sign(shape: str, frequency_hz: float, sign: float) -> None:
    run = replace(a_loop(shape, **{'reference.frequency': frequency_hz}), command_n=None)
    assert findings(run) == []
    unsigned = changed(run, lambda f: sign * np.abs(f))
    assert ('sign', 'force') in kinds(unsigned)
    assert analyze(unsigned).tracking_error_rms_n is None


def test_a_limit_cycle_about_0_without_its_sign_has_no_frequency() -> None:
    """It would be twice as large. What rests at 0, or turns there smoothly, has its sign."""
    t = np.arange(1500) / RATE_HZ
    cycle = 40.0 * np.sin(2.0 * np.pi * 80.0 * t)
    for force, found in ((cycle, []), (np.abs(cycle), [('sign', 'force')]),
                         (np.maximum(np.roll(cycle, 3), 0.0), []), (40.0 + cycle, [])):
        run = Run(t, 0.0 * t, None, force)
        assert [(each.kind, each.signal) for each in findings(run)] == found
        assert (analyze(run).oscillation['frequency_hz'] is None) == bool(found)


@pytest.mark.parametrize('load', ['spring', 'locked'])
@pytest.mark.parametrize('compensator', ['lead_lag', 'proportional'])
def test_a_fast_sine_of_the_wrong_sign_begins_against_its_reference(
        load: str, compensator: str) -> None:
    """Later it looks like one that is late by half a period: without the beginning it does."""
    run = replace(simulate({'load.type': load, 'force_sensor.noise': 0.3}, {
        'compensator': compensator, 'reference.shape': 'sine', 'reference.frequency': 20.0,
        'reference.amplitude': 100.0}, 1.0, RATE_HZ), information={}, command_n=None,
        position_m=None, velocity_m_s=None, valve_position_m=None)
    assert findings(run) == []
    wrong = changed(run, lambda f: -f)
    assert kinds(wrong) == {('sign', 'force')}
    assert findings(wrong[60:]) == []
