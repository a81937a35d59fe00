"""What follows a diagnosis: the improved model in a real node, and the next experiment."""

import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
import yaml
from test_gap import REAL, TEXTBOOK, recorded

from asi_analysis import cli
from asi_analysis.bags.bag import read_bag, write_bag
from asi_analysis.experiments.experiment import CONTROLLER_PARAMETERS, gather, read_parameters
from asi_analysis.gap.actuator import actuator_groups
from asi_analysis.gap.answer import command
from asi_analysis.gap.experiment import next_experiment
from asi_analysis.gap.experiment.next_experiment import (
    CATALOGUE,
    DURATION_S,
    RATE_HZ,
    Experiment,
    command_line,
    settings,
)
from asi_analysis.loop.closed_loop import simulate_loop
from asi_common.parameter import completed

LATE = {'valve_flexure__delay': 4.003e-3}


def written(values: dict[str, Any], path: Path) -> Path:
    """Return a ROS parameter file of the actuator with these values."""
    path.write_text(yaml.safe_dump({'asi_actuator': {'ros__parameters': values}}))
    return path


def options(line: str) -> dict[str, Any]:
    """Return what `asi run` understands of a line."""
    words = shlex.split(line)
    assert words[:2] == ['asi', 'run']
    context = typer.main.get_command(cli.app).commands['run'].make_context('run', words[2:])
    return context.params


@pytest.mark.parametrize('experiment', CATALOGUE, ids=lambda experiment: experiment.name)
def test_line_is_the_experiment_that_was_imagined(experiment: Experiment) -> None:
    said = options(command_line(experiment, 300.0, 'spring'))
    assert (said['duration'], said['rate']) == (DURATION_S, RATE_HZ)
    assert said['load'] == (experiment.load or 'spring')
    named = {name: said[option] for name, option in (
        ('compensator', 'compensator'), ('gain', 'gain'), ('reference.shape', 'reference'),
        ('reference.amplitude', 'amplitude'), ('reference.offset', 'offset'),
        ('reference.frequency', 'frequency'), ('reference.end_frequency', 'end_frequency'))}
    values = gather({'actuator': None, 'controller': None}, said['set_'] or [],
                    {'actuator': {}, 'controller': named}, said['duration'])['controller']
    assert completed(values, CONTROLLER_PARAMETERS) == completed(
        settings(experiment, 300.0), CONTROLLER_PARAMETERS)


@pytest.mark.parametrize('experiment', CATALOGUE, ids=lambda experiment: experiment.name)
def test_experiment_for_a_large_machine_is_one_that_the_controller_allows(
        experiment: Experiment) -> None:
    """A recording of 13 kN ended the diagnosis: "reference.amplitude is not allowed"."""
    values = completed(settings(experiment, 13250.0), CONTROLLER_PARAMETERS)
    assert 0.0 < values['reference.amplitude'] <= 1e4


def test_experiment_that_would_not_move_the_nominal_actuator_is_left_out(monkeypatch: Any) -> None:
    group = actuator_groups([recorded()], TEXTBOOK, 0.2, [False])[0][0]
    late = group.nominal.copy()
    late['command_delay'] = 0.003
    monkeypatch.setattr(next_experiment, 'pairs_of', lambda *_: [(group, group.nominal, late)])
    sticky = {**TEXTBOOK, 'valve_hysteresis.model': 'full', 'valve_hysteresis.radius': 100.0}
    found = next_experiment.choose([], [], sticky, 300.0)
    assert found is not None and found['excitation'] in found['separations']
    assert 'small slow triangle' not in found['separations']


@pytest.mark.slow
def test_diagnosed_mended_and_recorded_again(tmp_path: Path, monkeypatch: Any) -> None:
    """The gap of a late valve closes: the node runs the mended model, a new recording fits it."""
    write_bag(recorded(**LATE), tmp_path / 'first')
    write_bag(recorded(seed=6, **LATE), tmp_path / 'second')
    nominal = written(TEXTBOOK, tmp_path / 'nominal.yaml')

    def diagnosed(bag: str, model: Path, report: Path | None) -> dict[str, Any]:
        found = command.diagnose([read_bag(tmp_path / bag)], model)
        if report:
            found.write_report(report)
        return found

    before = diagnosed('first', nominal, tmp_path / 'report')
    assert before['verdict'] == 'transport_delay'
    improved = tmp_path / 'report' / 'improved.yaml'
    after = diagnosed('second', improved, None)
    assert after['verdict'] == 'no_gap'
    assert after['gap']['before_nrmse'] < 0.2 * before['gap']['before_nrmse']

    # The step overshoots with the delay more than the nominal model says: the improved one knows.
    overshoot = next(row for row in before['consequences']
                     if row['quantity'] == 'overshoot_percent')
    real = {**REAL, 'valve_flexure.delay': LATE['valve_flexure__delay']}
    truth = simulated_overshoot(real)
    assert overshoot['nominal'] < truth - 10.0
    assert overshoot['improved'] == pytest.approx(truth, abs=5.0)

    # The improved model, loaded by the node, does over ROS what the real machine does.
    line = command_line(CATALOGUE[7], 200.0, 'spring').replace('--duration 6', '--duration 0.6')
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr('sys.argv', [*shlex.split(line), '--actuator', str(improved),
                                     '--out', 'run', '--json'])
    assert cli.main() == 0
    run = read_bag(tmp_path / 'run' / 'bag')
    controller = settings(CATALOGUE[7], 200.0)
    forces = {name: simulate_loop(model, controller, 0.6, RATE_HZ).force_n for name, model in (
        ('real', real), ('nominal', TEXTBOOK),
        ('improved', read_parameters(improved, 'actuator')))}
    np.testing.assert_allclose(run.signal('force'), forces['improved'], atol=1e-9)
    error = {name: np.std(forces['real'] - force) for name, force in forces.items()}
    assert error['improved'] < 0.2 * error['nominal']


def simulated_overshoot(model: dict[str, Any]) -> float:
    """Return the overshoot (%) of the loop that a bag without a controller is judged by."""
    from asi_analysis.gap.answer.consequences import PLAIN, loop_figures
    overshoot = loop_figures(model, PLAIN, 1000.0, 1.0, [])['overshoot_percent']
    assert overshoot is not None
    return overshoot


def test_experiment_in_which_nothing_moves_is_no_traceback() -> None:
    from dataclasses import replace
    group = next(g for g in actuator_groups([recorded()], TEXTBOOK, 0.2, [False])[0]
                 if 'load' in g.channels)
    still = replace(group.recordings[0], motion=None)
    late = group.nominal.copy()
    late['sensor_lag'] = 0.003
    assert next_experiment.separation(group, still, group.nominal, late) >= 0.0
