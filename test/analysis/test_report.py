"""The demo's report: self-contained, its figures those of the runs, its verdicts honest."""

import re
from pathlib import Path

import numpy as np
import pytest

from asi_analysis.bags.run import Run
from asi_analysis.demo.hidden_effect import HIDDEN, find_hidden_effect
from asi_analysis.demo.report import compare, write_demo_report
from asi_analysis.demo.runs import (
    RUNS,
    Published,
    Recorded,
    hysteresis_loop,
    limit_cycle,
)
from asi_analysis.experiments.experiment import Experiment, checked
from asi_analysis.loop.closed_loop import simulate_loop
from asi_analysis.measures.analysis import analyze
from asi_analysis.reporting.figures import UnitFormatter, drawing, step_responses


def recorded(plan, **changes):
    """Return a run of the demo, computed in this process instead of over ROS."""
    experiment = checked(Experiment(
        plan.experiment.actuator, {**plan.experiment.controller, **changes},
        plan.experiment.duration_s, 'lockstep', plan.experiment.rate_hz))
    run = Run(*simulate_loop(experiment.actuator, experiment.controller, experiment.duration_s,
                             experiment.control_rate_hz), source='in process')
    return Recorded(plan, experiment, Path('bag'), run, analyze(run))


@pytest.fixture(scope='module')
def demo():
    return {plan.name: recorded(plan) for plan in RUNS}


@pytest.fixture(scope='module')
def hidden(tmp_path_factory):
    def record(name, experiment):
        complete = checked(experiment)
        return Run(*simulate_loop(complete.actuator, complete.controller, complete.duration_s,
                                  complete.control_rate_hz), source=name,
                   information={'actuator': dict(complete.actuator)})

    return find_hidden_effect(record, tmp_path_factory.mktemp('gap'))


def test_the_withheld_effect_is_found_and_the_gap_shrinks(hidden):
    assert hidden.gap.verdict == HIDDEN.name and hidden.gap.probability > 0.99
    assert hidden.shrink > 0.8


def test_report_is_one_file_with_the_figures_of_the_runs(demo, hidden, tmp_path):
    page = write_demo_report(list(demo.values()), hidden, tmp_path).read_text()
    # Nothing is fetched: no address but the names of XML's namespaces.
    addresses = set(re.findall(r'https?://[^"\s<]+', re.sub(r'xmlns[:\w]*="[^"]*"', '', page)))
    assert {a for a in addresses if 'w3.org' not in a and 'purl.org' not in a
            and 'creativecommons' not in a and 'matplotlib.org' not in a} == set()
    assert not re.search(r'<(script|link|iframe)|src=|@import', page)
    assert page.count('<svg') == 8
    assert {path.stem for path in tmp_path.glob('*.png')} == {
        'step_responses', 'limit_cycle', 'phase_plane', 'spectrum', 'hysteresis',
        'gap_before', 'gap_why', 'gap_after'}
    cells = re.findall(r'<td data-label="rise time[^>]*>\s*(\S+) → <b>([^<]+)</b>', page)
    assert [published for published, _ in cells] == ['40', '10', '7']
    for (_, simulated), name in zip(cells, ('proportional', 'lead_lag', 'lead4'), strict=True):
        assert float(simulated) == pytest.approx(1e3 * demo[name].analysis['rise_time_s'],
                                                 rel=0.01)


def test_report_says_so_where_there_is_no_cycle(demo, hidden, tmp_path):
    plan = demo['limit_cycle'].plan
    runs = demo | {'limit_cycle': recorded(plan, gain=3.0)}
    page = write_demo_report(list(runs.values()), hidden, tmp_path).read_text()
    assert 'No oscillation was found at Kp = 3' in page
    assert page.count('<svg') == 5


def test_cycle_and_loop_are_measured(demo):
    """A cycle near the paper's 90 Hz; a loop at least as wide as the play that makes it."""
    frequency = demo['limit_cycle'].analysis['oscillation']['frequency_hz']
    cycle = limit_cycle(demo['limit_cycle'], frequency)
    # The drawn lines are as high as the amplitudes beside them, also the weak ones.
    place, height = cycle.spectrum
    for harmonic, size in cycle.harmonics[:7]:
        near = np.abs(place - harmonic) < 0.1 * frequency
        assert max(height[near]) == pytest.approx(size, rel=0.05)
    assert 80.0 < frequency < 100.0
    assert cycle.distortion < 0.08
    loop = hysteresis_loop(demo['hysteresis'])
    radius = float(demo['hysteresis'].experiment.actuator['valve_hysteresis.radius'])
    assert 2.0 * radius < loop.width_n < 2.0 * radius + 2.0 * loop.lag_n


@pytest.mark.parametrize('value, verdict, similar', [
    (0.0099, 'similar', True), (0.030, '3.0 times longer', False),
    (0.005, '2.0 times shorter', False), (None, 'not reached', False)])
def test_differences_are_in_words(value, verdict, similar):
    entry = Published('rise time', 'rise_time_s', 'ms', 1e3, '10', 10.0)
    cell = compare({'rise_time_s': value}, entry)
    assert (cell.verdict, cell.similar) == (verdict, similar)


def test_less_than_is_a_bound_on_the_size():
    entry = Published('steady-state error', 'steady_state_error_n', 'N', 1.0, '< 2', 2.0)
    assert compare({'steady_state_error_n': -1.9}, entry).similar
    assert not compare({'steady_state_error_n': -2.1}, entry).similar


@pytest.mark.parametrize('error_n, verdict', [
    (-0.19, 'as published'), (0.8, 'below, not far below'), (-2.1, 'larger')])
def test_much_less_than_is_more_than_less_than(error_n, verdict):
    entry = Published('steady-state error', 'steady_state_error_n', 'N', 1.0, '≪ 2', 2.0)
    assert compare({'steady_state_error_n': error_n}, entry).verdict == verdict


def ticks(low: float, high: float, unit: str) -> list[str]:
    """Return the labels of an axis from low to high."""
    with drawing(2.0) as figure:
        axes = figure.subplots()
        axes.set_ylim(low, high)
        axes.yaxis.set_major_formatter(UnitFormatter(unit))
        figure.draw_without_rendering()
        return [each.get_text() for each in axes.get_yticklabels()
                if low <= each.get_position()[1] <= high]


@pytest.mark.parametrize('low, high, unit, expected', [
    (-30e-6, 30e-6, 'm', ['−20 µm', '0 µm', '20 µm']),
    (0.0, 1.1e3, 'N', ['0 kN', '0.2 kN', '1 kN']),     # 0.2 kN, not 200 N
    (1e-3, 3e-3, '', ['1 m', '2 m', '3 m']),
    (-2.0, 2.0, 'N', ['−2 N', '0 N', '2 N'])])
def test_all_ticks_of_an_axis_have_one_prefix(low: float, high: float, unit: str,
                                              expected: list[str]) -> None:
    """The zero too: it was "0 m" between micrometres."""
    found = ticks(low, high, unit)
    assert set(expected) <= set(found)
    assert {each.split(' ')[1] for each in found} == {expected[0].split(' ')[1]}


def test_the_beginning_of_a_step_has_a_panel_and_each_curve_a_line_of_its_own() -> None:
    time_s = np.linspace(-0.1, 0.3, 401)
    runs = dict.fromkeys('abc', (time_s, time_s, time_s))
    drawn = step_responses(runs, 0.25, first_s=0.05)
    for panel, limits in zip(drawn.axes, 2 * [(-5.0, 50.0), (50.0, 250.0)], strict=True):
        assert panel.get_xlim() == pytest.approx(limits)
        curves = panel.get_lines()[-3:]
        assert len({each.get_linestyle() for each in curves}) == 3
        assert len({each.get_color() for each in curves}) == 3
        assert all(limits[0] - 1e-9 <= x <= limits[1] + 1e-9
                   for each in curves for x in each.get_xdata())
