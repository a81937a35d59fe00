"""Parameters: the tables, the files made of them, and the services that `ros2 param` calls."""

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import yaml
from conftest import Listener, wait_until
from geometry_msgs.msg import WrenchStamped
from hypothesis import given
from hypothesis import strategies as st

from asi_common.node.parameter_files import unused_files
from asi_common.node.ros_parameters import descriptor
from asi_common.parameter import Parameter, ParameterError, completed, defaults
from asi_common.topics import REALTIME_DEPTH
from doc.parameter_tables import WRITTEN, NodeTables, files

ACTUATOR, CONTROLLER = 'asi_actuator.actuator_node', 'asi_controller.controller_node'
ROOT = Path(__file__).parents[2]
EVERY = [parameter for node in WRITTEN for table in node.tables.values() for parameter in table]

# What a user may get wrong, and a word of the reason.
REFUSED = {
    'asi_actuator': [
        ('valve_flexure.coil_frequency', -1.0, '-1.0'),
        ('valve_flexure.delay', math.nan, 'nan'),
        ('force_sensor.gain', math.inf, 'inf'),
        ('load.mass', 'heavy', "'heavy' is not allowed: it takes a number"),
        ('load.type', 'loose', 'one of locked, spring, free, prescribed'),
        ('force_sensor.noise_seed', 1.5, 'a whole number'),
        ('valve_hysteresis.model', True, 'one of off, linear, full'),
        ('load.mess', 1.0, 'load.mess'),
        ('rate_hz', 1000.0, 'read-only'),
    ],
    'asi_controller': [
        ('gain', -3.0, '-3.0'),
        ('gain', [1.0], 'a number from 0 to 10000'),
        ('lead_lag.lag_time', -0.5, '-0.5'),
        ('compensator', 'pid', 'one of proportional, lead_lag'),
        ('custom.zeros', '-50', 'more zeros than poles'),
        ('custom.poles', 'fast', 'numbers in rad/s'),
        ('mode', 'realtime', 'read-only'),
    ],
}


@pytest.mark.parametrize('node', REFUSED)
def test_bad_value_is_refused_with_a_reason_and_changes_nothing(
        node: str, start_node: Callable, set_parameters: Callable, get_parameters: Callable,
        call: Callable) -> None:
    from rcl_interfaces.srv import DescribeParameters, SetParametersAtomically
    from rclpy.parameter import Parameter as RosParameter

    process = start_node(ACTUATOR if node == 'asi_actuator' else CONTROLLER)
    names = sorted({name for name, _, _ in REFUSED[node] if name != 'load.mess'})
    before = get_parameters(node, names)
    for name, value, word in REFUSED[node]:
        result, = set_parameters(node, {name: value})
        assert not result.successful
        assert name in result.reason and word in result.reason
        process.wait_for(f'refused: {name}')
    # A good value in the same set does not get in either.
    good = ('friction.coulomb', 3.0) if node == 'asi_actuator' else ('feedforward', 2.0)
    bad = REFUSED[node][0]
    answer = call(SetParametersAtomically, f'/{node}/set_parameters_atomically',
                  SetParametersAtomically.Request(parameters=[
                      RosParameter(name, value=value).to_parameter_msg()
                      for name, value in (good, bad[:2])]))
    assert not answer.result.successful and bad[0] in answer.result.reason
    assert get_parameters(node, names) == before
    assert get_parameters(node, [good[0]])[good[0]] != good[1]
    described = call(DescribeParameters, f'/{node}/describe_parameters',
                     DescribeParameters.Request(names=names)).descriptors
    assert [d.type for d in described] == [
        RosParameter.Type.from_parameter_value(before[name]).value for name in names]


def test_what_is_typed_is_taken(
        start_node: Callable, set_parameters: Callable, get_parameters: Callable) -> None:
    """`ros2 param set /asi_controller gain 8` sends an integer."""
    controller = start_node(CONTROLLER, gain=5)
    assert get_parameters('asi_controller', ['gain']) == {'gain': 5.0}
    result, = set_parameters('asi_controller', {'gain': 8})
    assert result.successful, result.reason
    controller.wait_for('[asi_controller]: gain = 8.0')
    value = get_parameters('asi_controller', ['gain'])['gain']
    assert value == 8.0 and isinstance(value, float)
    # And 1e-05, from the command line or a dumped file, as a text.
    assert all(each.successful for each in set_parameters('asi_controller', {
        'feedforward': '2e-05', 'transfer_time': '1e-2'}))
    assert get_parameters('asi_controller', ['feedforward', 'transfer_time']) == {
        'feedforward': 2e-05, 'transfer_time': 0.01}
    for text in ('nan', '.inf', '1e5', 'true', ''):
        result, = set_parameters('asi_controller', {'gain': text})
        assert not result.successful and 'gain' in result.reason, text


def test_quality_of_service_is_overridden_by_parameters(
        start_node: Callable, ros_node: Any, get_parameters: Callable,
        set_parameters: Callable) -> None:
    both = {'mode': 'realtime', 'rate_hz': 200.0}
    reliability = 'qos_overrides./joint_states.{}.reliability'
    start_node(ACTUATOR, **both, **{reliability.format('publisher'): 'best_effort',
                                    'qos_overrides./force.publisher.depth': 7})
    start_node(CONTROLLER, **both, **{reliability.format('subscription'): 'best_effort'})
    commands = Listener(ros_node, WrenchStamped, 'valve_command')
    commands.wait(20)   # a reliable subscription would hear no best-effort publisher
    # Those two have found each other; this node may hear of their other topics later.
    for find, topic, expected in (
            (ros_node.get_publishers_info_by_topic, '/joint_states', 'BEST_EFFORT'),
            (ros_node.get_publishers_info_by_topic, '/force', 'RELIABLE'),
            (ros_node.get_subscriptions_info_by_topic, '/joint_states', 'BEST_EFFORT')):
        only, = wait_until(partial(find, topic), f'{find.__name__}({topic})')
        assert only.qos_profile.reliability.name == expected
    assert get_parameters('asi_actuator', [
        'qos_overrides./force.publisher.depth', 'qos_overrides./velocity.publisher.depth']
        ) == {'qos_overrides./force.publisher.depth': 7,
              'qos_overrides./velocity.publisher.depth': REALTIME_DEPTH}
    result, = set_parameters('asi_actuator', {'qos_overrides./force.publisher.depth': 8})
    assert not result.successful and 'read-only' in result.reason


@pytest.mark.parametrize(('text', 'words'), [
    ('asi_controller: {ros__parameters: {qos_overrides: {/force: {publisher: {depth: -1}}}}}',
     'qos_overrides./force.publisher.depth = -1 is not allowed: it takes a whole number from 1'),
    ('asi_controller: {ros__parameters: {qos_overrides: {/forces: {publisher: {depth: 1}}}}}',
     "qos_overrides./forces.publisher.depth: the topic '/forces' is not one of /joint_states"),
    ('asi_controller: {ros__parameters: {lead_leg: {ratio: 2.0}}}', 'did you mean lead_lag.ratio'),
    ('asi_controller: [', 'parameters'),
    *(pytest.param(*each, marks=pytest.mark.slow) for each in (
        ('asi_controller: {ros__parameters: {qos_overrides: {/force: {publisher: {deep: 1}}}}}',
         "the policy 'deep' is not one of history, depth, reliability"),
        ('asi_controller: {ros__parameters: {gain: -1.0}}', 'gain = -1.0 is not allowed'),
        ('asi_controller: {ros__parameters: {gain: [1.0, 2.0]}}', 'gain = '),
        (None, 'parameters'))),
])
def test_wrong_parameter_file_is_one_line_and_exit_status_2(
        text: str | None, words: str, start_node: Callable, tmp_path: Path) -> None:
    file = tmp_path / 'parameters.yaml'
    if text is not None:
        file.write_text(text)
    node = start_node(CONTROLLER, '--params-file', str(file))
    assert node.exit_status() == 2
    assert words in node.text and 'Traceback' not in node.text
    # rcl itself logs that it failed; why, is in our line.
    assert len([line for line in node.text.splitlines() if '[rcl]' not in line]) == 1


@pytest.mark.parametrize(('names', 'node', 'warned'), [
    (['asi_contoller'], '/asi_controller', True),
    (['controller'], '/asi_controller', True),
    (['other'], '/asi_controller', True),
    (['/bench/asi_controller'], '/asi_controller', True),
    (['asi_actuator', 'asi_contoller'], '/asi_controller', True),
    (['asi_actuator', 'asi_contoller'], '/asi_recorder', False),
    (['asi_controller'], '/asi_actuator', False),
    (['asi_controller', 'camera'], '/asi_recorder', False),
    (['asi_controller', 'camera'], '/asi_controller', False),
    (['asi_controller'], '/bench/asi_controller', True),
    (['bench/asi_controller'], '/bench/asi_controller', False),
    (['/**'], '/asi_controller', False),
    (['/**/asi_controller'], '/a/bench/asi_controller', False),
    (['/*/asi_controller'], '/bench/asi_controller', False),
    (['/*/asi_controller'], '/asi_controller', True)], ids=str)
def test_a_parameter_file_without_the_node_that_gets_it_is_told(
        names: list[str], node: str, warned: bool, tmp_path: Path) -> None:
    file = tmp_path / 'parameters.yaml'
    file.write_text(''.join(f'{name}: {{ros__parameters: {{gain: 5.0}}}}\n' for name in names))
    given = ['controller', '--ros-args', '--params-file', str(file), '-p', 'gain:=2.0']
    said = f'{file} has nothing for the node {node}: it names {", ".join(names)}'
    assert unused_files(given, node) == [said] * warned


def test_a_misspelt_node_in_a_parameter_file_is_told(start_node: Callable, tmp_path: Path) -> None:
    """It ran at its defaults, without a word."""
    file = tmp_path / 'parameters.yaml'
    file.write_text('bench: {asi_contoller: {ros__parameters: {gain: 5.0}}}')
    node = start_node(CONTROLLER, '--params-file', str(file))
    node.wait_for(f'{file} has nothing for the node /asi_controller: it names bench/asi_contoller')


def test_written_files_are_current() -> None:
    for path, text in files().items():
        assert (ROOT / path).read_text(encoding='utf-8') == text, (
            f'{path}: run python doc/generate.py')


@pytest.mark.parametrize('node', WRITTEN, ids=lambda node: node.file)
def test_yaml_file_holds_the_defaults(node: NodeTables) -> None:
    def flat(tree: dict, prefix: str = '') -> dict:
        return {key: value for name, branch in tree.items()
                for key, value in (flat(branch, f'{prefix}{name}.').items()
                                   if isinstance(branch, dict) else [(prefix + name, branch)])}

    parameters = yaml.safe_load((ROOT / node.file).read_text())[f'/**/{node.node}']
    table = tuple(p for part in node.tables.values() for p in part)
    read = flat(parameters['ros__parameters'])
    assert read == defaults(table)
    assert {name: type(value) for name, value in read.items()} == {
        p.name: type(p.default) for p in table}


def test_a_descriptor_has_the_range_that_rqt_shows() -> None:
    for parameter in EVERY:
        described = descriptor(parameter)
        ranges = [*described.floating_point_range, *described.integer_range]
        assert [(each.from_value, each.to_value, each.step) for each in ranges] == (
            [] if isinstance(parameter.default, bool | str) else
            [(parameter.low, parameter.high, int(isinstance(parameter.default, int)))])
        assert described.description and described.additional_constraints == parameter.allowed


@given(st.sampled_from(EVERY), st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5),
    st.lists(st.floats(), max_size=2)))
def test_what_is_accepted_is_allowed_and_what_is_not_says_so(
        parameter: Parameter, value: object) -> None:
    problem = parameter.problem(value)
    if problem is None:
        assert type(value) is type(parameter.default) or (
            isinstance(parameter.default, float) and type(value) is int)
        if isinstance(parameter.default, float):
            assert parameter.low <= value <= parameter.high
        assert completed({parameter.name: value}, (parameter,)) == {parameter.name: value}
    else:
        assert parameter.name in problem and repr(value) in problem
        assert parameter.allowed in problem
        with pytest.raises(ParameterError):
            completed({parameter.name: value}, (parameter,))


@pytest.mark.parametrize(('file', 'which'), [
    ('actuator', 'actuator'), ('controller', 'controller'), ('joint', 'actuator')])
def test_shipped_file_is_what_asi_run_reads(file: str, which: str) -> None:
    from asi_analysis.experiments.experiment import read_parameters, table_of

    plant = 'joint' if file == 'joint' else 'actuator'
    assert read_parameters(ROOT / 'config' / f'{file}.yaml', which, plant) == defaults(
        table_of(which, plant))


def test_a_whole_number_that_is_no_float_is_refused() -> None:
    """As the metadata of a bag may hold it."""
    for parameter in EVERY:
        if isinstance(parameter.default, float):
            assert 'is not allowed' in (parameter.problem(10 ** 400) or '')
