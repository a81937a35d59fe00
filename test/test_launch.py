"""The launch file: what it starts, as `ros2 launch` would, and that this runs; with real nodes."""

import importlib.util
import sys
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest import mock

import pytest
import yaml
from conftest import NodeProcess

from asi_analysis.bags.bag_file import read_contents

ROOT = Path(__file__).parents[1]
MODULES = {'actuator': 'asi_actuator.actuator_node',
           'controller': 'asi_controller.controller_node',
           'recorder': 'asi_analysis.bags.nodes.recorder_node'}
Evaluated = Callable[..., dict[str, Any]]


class Action(SimpleNamespace):
    """Stands for any action of launch and launch_ros: keeps what it was made with."""


class NotFoundError(Exception):
    """Stands for ament's PackageNotFoundError."""


def packages(installed: dict[str, str]) -> dict[str, ModuleType]:
    """Return as much of launch, launch_ros and ament_index_python as the launch file uses."""
    def share(package: str) -> str:
        if package not in installed:
            raise NotFoundError(package)
        return installed[package]

    names: dict[str, dict[str, Any]] = {
        'ament_index_python.packages': {
            'PackageNotFoundError': NotFoundError, 'get_package_share_directory': share},
        'launch': {'LaunchDescription': lambda actions: actions},
        'launch.actions': {
            'DeclareLaunchArgument': lambda name, **options: Action(name=name, **options),
            **dict.fromkeys(('LogInfo', 'OpaqueFunction', 'Shutdown'), Action)},
        'launch_ros': {},
        'launch_ros.actions': {'Node': Action},
        'launch_ros.parameter_descriptions': {
            'ParameterValue': lambda value, value_type: Action(value=value, type=value_type)},
    }
    modules = {}
    for name, content in names.items():
        modules[name] = ModuleType(name)
        vars(modules[name]).update(content)
    return modules


@pytest.fixture
def evaluated() -> Evaluated:
    """Return what is started with arguments: nodes by executable, `log`, what is said."""
    def evaluate(installed: tuple[str, ...] = (), **arguments: str) -> dict[str, Any]:
        shares = dict.fromkeys(('asi_actuator', *installed), str(ROOT))
        with mock.patch.dict(sys.modules, packages(shares)):
            spec = importlib.util.spec_from_file_location(
                'launch_file', ROOT / 'launch' / 'asi_actuator.launch.py')
            assert spec and spec.loader
            file = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(file)
            *declared, opaque = file.generate_launch_description()
            given = {argument.name: argument.default_value for argument in declared}
            given |= arguments
            actions = opaque.function(SimpleNamespace(launch_configurations=given))
        for action in actions:
            for values in getattr(action, 'parameters', ()):
                if isinstance(values, dict):
                    values.update({name: plain(value) for name, value in values.items()})
        return {'log': [action.msg for action in actions if hasattr(action, 'msg')],
                **{action.executable: action for action in actions
                   if hasattr(action, 'executable')}}

    def plain(value: Any) -> Any:
        if isinstance(value, Action):
            assert type(value.value) is value.type
        return getattr(value, 'value', value)

    return evaluate


@pytest.fixture
def start_launched(start_node: Callable[..., NodeProcess], tmp_path: Path
                   ) -> Callable[[Any], NodeProcess]:
    """Return a function that starts a node as launch_ros does."""
    def start(node: Any) -> NodeProcess:
        arguments = [*node.ros_arguments, '-r', f'__ns:=/{node.namespace}']
        for place, parameters in enumerate(node.parameters):
            if isinstance(parameters, dict):
                file = tmp_path / f'{node.namespace}{node.executable}-{place}.yaml'
                file.write_text(yaml.safe_dump({'/**': {'ros__parameters': parameters}}))
                parameters = str(file)
            arguments += ['--params-file', parameters]
        for old, new in node.remappings:
            arguments += ['-r', f'{old}:={new}']
        return start_node(MODULES[node.executable], *arguments)

    return start


def test_without_arguments_nothing_is_set_but_the_tuned_controller(evaluated: Evaluated) -> None:
    launched = evaluated()
    assert set(launched) == {'actuator', 'controller', 'log'} and not launched['log']
    assert launched['actuator'].parameters == []
    # The proportional default of the node oscillates on heavy loads.
    assert launched['controller'].parameters == [str(ROOT / 'config' / 'quiet.yaml')]
    for argument in ('compensator', 'gain'):
        assert 'quiet.yaml' not in str(evaluated(**{argument: '2'})['controller'].parameters)


def test_an_argument_is_set_after_the_files_where_it_belongs(evaluated: Evaluated) -> None:
    config = ROOT / 'config'
    launched = evaluated(params_file=f'{config}/actuator.yaml,quiet.yaml', rate_hz='500', gain='2',
                         driver='can', compensator='lead2', reference='sine', duration='3',
                         real_time_factor='0.5', mode='realtime', record='bag', namespace='left',
                         log_level='debug', use_sim_time='true')
    files, common = [str(config / 'actuator.yaml'), str(config / 'quiet.yaml')], {
        'rate_hz': 500.0, 'mode': 'realtime', 'await_recorder': True, 'use_sim_time': True}
    assert launched['actuator'].parameters == [
        *files, common | {'driver': 'can', 'duration': 3.0, 'real_time_factor': 0.5}]
    assert launched['controller'].parameters == [
        *files, common | {'compensator': 'lead2', 'gain': 2.0, 'reference.shape': 'sine'}]
    assert launched['recorder'].parameters == [*files, {'output': 'bag', 'use_sim_time': True}]
    for name in MODULES:
        assert launched[name].namespace == 'left'
        assert launched[name].ros_arguments[:2] == ['--log-level', 'debug']


@pytest.mark.parametrize(('name', 'status', 'why'), [
    ('recorder', 2, 'the recorder could not start'), ('recorder', 1, ''), ('controller', 1, ''),
    ('controller', 2, 'the controller could not start'), ('actuator', 0, ''),
    ('actuator', 1, 'the actuator has ended with exit status 1')])
def test_a_node_that_cannot_start_and_a_run_that_fails_end_all_with_an_error(
        name: str, status: int, why: str, evaluated: Evaluated) -> None:
    def ended(is_shutdown: bool) -> list[Any]:
        event = SimpleNamespace(returncode=status, action=SimpleNamespace(node_executable=name))
        actions: list[Any] = evaluated(record='bag')[name].on_exit(
            event, SimpleNamespace(is_shutdown=is_shutdown))
        return [action.reason for action in actions]

    expected = ['the run has ended'] * (name == 'actuator')
    with pytest.raises(RuntimeError, match=why) if why else nullcontext():
        assert ended(is_shutdown=False) == expected
    assert ended(is_shutdown=True) == expected   # after Ctrl-C nothing is an error


def test_debug_lines_are_those_of_the_nodes_not_one_for_each_message(
        evaluated: Evaluated, start_launched: Callable[[Any], NodeProcess]) -> None:
    launched = evaluated(log_level='debug', duration='0.05', reference='step')
    controller, actuator = (start_launched(launched[name]) for name in ('controller', 'actuator'))
    assert actuator.exit_status() == 0, actuator.text
    assert controller.stop() == 0
    for node in (actuator, controller):
        assert '[DEBUG]' in node.text and '[rcl]' not in node.text


@pytest.mark.parametrize(('name', 'value'), [
    ('gain', 'eight'), ('rate_hz', '5kHz'), ('use_sim_time', 'perhaps'), ('rviz', 'yes'),
    ('params_file', 'missing.yaml')])
def test_an_argument_that_is_wrong_is_named_before_anything_is_started(
        name: str, value: str, evaluated: Evaluated) -> None:
    with pytest.raises(ValueError, match=f'{name}:={value}'):
        evaluated(**{name: value})


def test_a_name_that_is_none_of_ours_but_like_one_is_told(evaluated: Evaluated) -> None:
    assert evaluated(refrence='sine', robot='b')['log'] == [
        'asi_actuator.launch.py has no argument refrence: is reference meant?']


def test_rviz_where_it_is_installed_and_otherwise_what_is_missing(evaluated: Evaluated) -> None:
    launched = evaluated(installed=('robot_state_publisher', 'rviz2'), rviz='true')
    assert '<robot' in launched['robot_state_publisher'].parameters[0]['robot_description']
    assert Path(launched['rviz2'].arguments[1]).exists() and not launched['log']
    missing = evaluated(rviz='true')
    assert 'rviz2' not in missing
    assert [word in line for word, line in zip(
        ('robot_state_publisher', 'rviz2'), missing['log'], strict=True)] == [True, True]


@pytest.mark.parametrize('file', [
    'can.yaml', 'quiet.yaml', *(pytest.param(file, marks=pytest.mark.slow) for file in (
        'actuator.yaml', 'controller.yaml'))])
def test_each_shipped_file_gives_the_nodes_what_it_says(
        file: str, evaluated: Evaluated, start_launched: Callable[[Any], NodeProcess],
        get_parameters: Callable) -> None:
    path = ROOT / 'config' / file
    launched = evaluated(params_file=str(path))
    for name, nodes in yaml.safe_load(path.read_text()).items():
        executable = name.removeprefix('/**/asi_')
        start_launched(launched[executable]).wait_for(f'asi_{executable}]:')
        given = {key: value for key, value in nodes['ros__parameters'].items()
                 if not isinstance(value, dict)}
        assert get_parameters(f'asi_{executable}', list(given)) == given


def test_two_pairs_in_namespaces_run_and_are_recorded_side_by_side(
        evaluated: Evaluated, start_launched: Callable[[Any], NodeProcess], tmp_path: Path
        ) -> None:
    pairs = [evaluated(namespace=side, duration='0.05', reference='step', rate_hz=rate,
                       record=str(tmp_path / side))
             for side, rate in (('left', '5000'), ('right', '1000'))]
    nodes = [[start_launched(pair[name]) for name in ('recorder', 'controller', 'actuator')]
             for pair in pairs]
    for (recorder, controller, actuator), side, ticks in zip(
            nodes, ('left', 'right'), (250, 50), strict=True):
        assert actuator.exit_status() == 0, actuator.text
        assert recorder.stop() == 0 == controller.stop(), recorder.text
        topics = read_contents(tmp_path / side, lambda _: True).topics
        counts = {name: len(topic.data) for name, topic in topics.items()
                  if name != '/diagnostics'}
        assert counts == {f'/{side}/{name}': ticks for name in (
            'joint_states', 'force', 'valve_position', 'velocity', 'force_reference',
            'valve_command', 'clock')}
