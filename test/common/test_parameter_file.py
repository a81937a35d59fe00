"""Parameter files: read as a node reads them, and written so that every reader finds the same."""

import math
import os
from pathlib import Path

import pytest
import rclpy
import yaml
from hypothesis import given
from hypothesis import strategies as st

from asi_analysis.errors import InputError
from asi_analysis.experiments import experiment as ex
from asi_common.files import write_text
from asi_common.parameter import ParameterError, Value
from asi_common.parameter_file import (
    parameter_file,
    parameter_lines,
    read_parameters,
    read_scalar,
    write_parameters,
)

SCALARS = ['5e-1', '1e5', '1.0e+5', '8', '-8', '+8', '010', '09', '0x10', '-0x10', '1_000', '0b1',
           '.5', '5.', '-.5e3', 'e5', '1:30', '2001-01-01', 'yes', 'No', 'y', 'on', 'true', 'True',
           'tRUE', 'null', '~', 'nan', '.nan', '.inf', '-.inf', 'inf', '9223372036854775807',
           '9223372036854775808', '1e999', '"8"', "'yes'", '"a # b"', 'a text', '"ß\\n"']


def read_by_a_node(path: Path) -> dict[str, Value]:
    """Return the parameters that a node named `asi_actuator` takes from a file."""
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node(
        'asi_actuator', context=context, cli_args=['--ros-args', '--params-file', str(path)],
        automatically_declare_parameters_from_overrides=True, start_parameter_services=False)
    try:
        return {name: parameter.value for name, parameter in
                node.get_parameters_by_prefix('').items()
                if name not in ('use_sim_time', 'start_type_description_service')}
    finally:
        node.destroy_node()
        context.try_shutdown()


def same(one: object, other: object) -> bool:
    """Return whether two values and their types are the same; NaN is the same as NaN."""
    return type(one) is type(other) and (one == other or one != one and other != other)


def test_every_scalar_is_what_a_node_reads(tmp_path: Path) -> None:
    path = tmp_path / 'scalars.yaml'
    path.write_text('asi_actuator:\n  ros__parameters:\n' + ''.join(
        f'    block:\n      p{number}: {text}\n' if number == 3 else f'    p{number}: {text}\n'
        for number, text in enumerate(SCALARS)))
    ours, theirs = read_parameters(path, 'asi_actuator'), read_by_a_node(path)
    assert ours.keys() == theirs.keys()
    assert {name: (ours[name], theirs[name]) for name in ours
            if not same(ours[name], theirs[name])} == {}


VALUES = st.one_of(st.booleans(), st.integers(-2**63, 2**63 - 1), st.floats(allow_nan=False),
                   st.text(st.characters(exclude_categories=['Cs'], exclude_characters='\0')))
NAMES = st.from_regex(r'[a-z]{1,3}(\.[a-z]{1,3}){0,2}', fullmatch=True)


@given(st.dictionaries(NAMES, VALUES, min_size=1))
def test_written_values_are_read_back(tmp_path_factory: pytest.TempPathFactory,
                                      values: dict[str, Value]) -> None:
    path = tmp_path_factory.mktemp('written') / 'file.yaml'
    write_parameters(path, '/**/asi_actuator', values, ['A header'])
    read = read_parameters(path, 'asi_actuator')
    assert read.keys() == values.keys()
    assert all(same(read[name], values[name]) for name in values)


def test_written_file_is_read_alike_by_a_node_and_by_pyyaml(tmp_path: Path) -> None:
    values: dict[str, Value] = {
        'load.mass': 1e-05, 'load.type': 'spring', 'mode': 'on', 'load.damping': 1e22,
        'force_sensor.noise': 0.0, 'force_sensor.noise_seed': 7, 'hold': True, 'far': math.inf}
    path = tmp_path / 'file.yaml'
    write_parameters(path, '/**/asi_actuator', values)
    assert read_by_a_node(path) == read_parameters(path, 'asi_actuator') == values
    tree = yaml.safe_load(path.read_text())['/**/asi_actuator']['ros__parameters']
    assert tree['load'] == {'mass': 1e-05, 'type': 'spring', 'damping': 1e22}


def test_comments_stand_above_their_parameter() -> None:
    lines = parameter_lines({'a.x': 1, 'b': 2.0, 'a.y': 'no'}, {'a.y': ['Why'], 'b': ['Two']})
    assert parameter_file('node', lines, ['Header']).splitlines() == [
        '# Header', 'node:', '  ros__parameters:', '    a:', '      x: 1', '      # Why',
        '      y: "no"', '    # Two', '    b: 2.0']


@pytest.mark.parametrize('name', ['/**', '/**/asi_actuator', '/asi_actuator', 'asi_actuator'])
def test_asi_run_takes_numbers_that_yaml_1_1_does_not(tmp_path: Path, name: str) -> None:
    path = tmp_path / 'file.yaml'
    path.write_text(f'{name}:\n  ros__parameters:\n    load.mass: 5e-1\n    mode: realtime\n')
    assert ex.read_parameters(path, 'actuator') == {'load.mass': 0.5}
    assert ex.parse_setting('actuator.load.mass=5e-1') == ('actuator', 'load.mass', 0.5)


@pytest.mark.parametrize(('text', 'reason'), [
    ('a: [', 'is not YAML'), ('', 'has nothing for the node'), ('- 1', 'has nothing for the node'),
    ('asi_actuator: 5', 'ros__parameters is missing'),
    ('asi_actuator: {ros__parameters: {gain: [1, 2]}}', 'gain is a list'),
    ('asi_actuator: {ros__parameters: &a {b: *a}}', 'no aliases')])
def test_file_that_is_no_parameter_file_says_why(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / 'file.yaml'
    path.write_text(text)
    with pytest.raises(ParameterError, match=reason):
        read_parameters(path, 'asi_actuator')
    with pytest.raises(InputError, match=reason):
        ex.read_parameters(path, 'actuator')


def test_text_that_looks_like_a_number_is_quoted() -> None:
    assert parameter_lines({'text': '8'}) == ['    text: "8"']
    assert read_scalar('8') == 8


def test_a_device_is_never_replaced_by_a_file(tmp_path: Path) -> None:
    pipe = tmp_path / 'pipe'
    os.mkfifo(pipe)
    with pytest.raises(OSError, match='is not a file'):
        write_text(pipe, 'a')
    assert pipe.is_fifo() and list(tmp_path.iterdir()) == [pipe]
