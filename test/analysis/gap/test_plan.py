"""`asi gap --plan`: what to record of a joint, within its limits, and what that would tell."""

import json
from pathlib import Path

import numpy as np
import pytest
from documented import problems
from typer.testing import CliRunner

from asi_analysis import cli
from asi_analysis.bags.exchange.importing import import_recording
from asi_analysis.cli import app
from asi_analysis.errors import InputError
from asi_analysis.gap.answer.planned import limits_of, plan_recording
from asi_analysis.gap.experiment import plan
from asi_analysis.gap.experiment.next_motion import CATALOGUE
from asi_analysis.gap.experiment.plan import Limits, answer_of, chances, drawn, nominal_force

GIVEN = {'load.mass': 0.05, 'load.damping': 0.05}
PERIOD = 0.01
MODEL = '/**:\n  ros__parameters:\n    load.mass: 0.05\n    load.damping: 0.05\n'
LIMITS = ('asi_gap:\n  ros__parameters:\n    limit:\n      position: "-40:50[deg]"\n'
          '      velocity: "3[rad/s]"\n')


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / 'joint.yaml'
    path.write_text(MODEL + LIMITS)
    return path


@pytest.mark.parametrize('force', [np.inf, 5.0, 0.5])
@pytest.mark.parametrize('name', CATALOGUE)
def test_a_course_keeps_the_limits_from_rest_to_rest(name: str, force: float) -> None:
    limits = Limits(-0.5, 1.1, 3.0, force)
    x = drawn(name, limits, PERIOD, GIVEN).position
    speed = np.gradient(x, PERIOD)
    assert limits.low < limits.middle - np.abs(x).max()
    assert limits.middle + np.abs(x).max() < limits.high
    assert np.abs(speed).max() < limits.speed
    assert np.abs(nominal_force(x, PERIOD, GIVEN)).max() <= 0.5 * force
    assert [x[0], x[-1], speed[0], speed[-1]] == pytest.approx(np.zeros(4), abs=1e-9)


def _told(name: str, sensors: tuple[str, ...], suspects: list[str], limits: Limits
          ) -> dict[tuple[str, int], float]:
    position = drawn(name, limits, PERIOD, GIVEN).position
    found = answer_of(position, sensors, limits, PERIOD, GIVEN, 0.2, [], only=suspects)
    return {(each.name, each.size): value for each, value in chances(found.tells).items()}


def test_gravity_does_not_show_in_a_small_motion_but_over_the_whole_range() -> None:
    limits = Limits(-0.8, 0.8, 3.0)
    small, whole = (_told(name, ('command', 'position'), ['gravity'], limits)['gravity', 0]
                    for name in ('small quick sine', 'sine over the whole range'))
    assert small < 0.1 < 0.9 < whole


def test_a_short_delay_is_told_with_the_force_recorded_too() -> None:
    limits, delay = Limits(-0.8, 0.8, 3.0), 'transport_delay'
    without, beside = (_told('sine over the whole range', sensors, [delay], limits)[delay, 1]
                       for sensors in (('command', 'position'),
                                       ('command', 'force', 'position')))
    assert without < 0.1 < 0.9 < beside


def test_limits_are_of_the_file_and_the_options(model: Path) -> None:
    found = limits_of(model, ['command=50[Ncm]'], ['position=0.01[deg]'])
    assert found.low == pytest.approx(np.radians(-40.0))
    assert (found.speed, found.force) == pytest.approx((3.0, 0.5))
    assert found.noise == pytest.approx({'position': np.radians(0.01)})
    assert limits_of(model, ['velocity=90[deg/s]']).speed == pytest.approx(0.5 * np.pi)


@pytest.mark.parametrize('options, words', [
    (['--limit', 'position=40:-50[deg]'], 'position=40:-50'),
    (['--limit', 'velocity=3'], 'is not a limit'), (['--limit', 'velocity=-3[rad/s]'], 'above 0'),
    (['--limit', 'velocity=1[m/s]'], 'do not agree'), (['--limit', 'force=1[N]'], 'no limit here'),
    (['--limit', 'velocity=1e-9[rad/s]'], 'takes more than'),
    (['--limit', 'x'], 'expected SIGNAL'),
    (['--sensors', 'temperature'], 'no signal of a plan'), (['--sensors', 'command'], 'nothing'),
    (['--noise', 'position=x[deg]'], '--noise'), (['--rate', '5'], 'from 50 to 1000'),
    (['--plant', 'actuator'], 'a plan is of a joint'),
    (['--out', 'x.txt'], 'expected a .csv')])
def test_what_cannot_be_planned_is_said_in_one_line(
        options: list[str], words: str, model: Path, monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr('sys.argv', ['asi', 'gap', '--plan', str(model), *options])
    assert cli.main() == 2
    assert words in capsys.readouterr().err.strip().splitlines()[-1]


def test_a_reference_that_exists_is_refused_first(model: Path) -> None:
    with pytest.raises(InputError, match='exists already'):
        plan_recording(model, out=model)


def test_what_a_model_lacks_is_asked_for(tmp_path: Path) -> None:
    path = tmp_path / 'joint.yaml'
    path.write_text(MODEL)
    with pytest.raises(InputError, match='how far and how fast may the joint move'):
        plan_recording(path)
    path.write_text(LIMITS)
    with pytest.raises(InputError, match='load.mass is missing'):
        plan_recording(path)


@pytest.mark.slow
def test_a_plan_of_a_servo_is_a_table_and_a_reference(
        model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / 'reference.csv'
    few = ('sine over the whole range', 'to and fro with rests')
    monkeypatch.setattr(plan, 'CATALOGUE', {name: CATALOGUE[name] for name in few})
    printed = CliRunner().invoke(app, [
        'gap', '--plan', str(model), '--sensors', 'reference,position', '--rate', '100', '--out',
        str(out), '--report', str(tmp_path / 'report'), '--json'])
    assert printed.exit_code == 0, printed.exception
    found = json.loads(printed.stdout)
    assert problems(found, 'asi gap --plan') == []
    assert 'record the command' in ' '.join(found['advice'])
    assert {each['suspect'] for each in found['suspects']} == {
        'backlash', 'transport_delay', 'valve_lag'}
    run = import_recording(out, [])
    assert run.unit('reference') == 'rad' and run.rate_hz == pytest.approx(100.0)
    assert np.degrees(run.reference_n[0]) == pytest.approx(5.0)
    assert (tmp_path / 'report/report.html').exists()
