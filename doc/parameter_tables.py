"""The YAML files of parameters and doc/reference/parameters.md, for `python doc/generate.py`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Final, NamedTuple

from asi_actuator.joint_parameters import JOINT_PARAMETERS
from asi_actuator.node_parameters import ACTUATOR_NODE_PARAMETERS
from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_common.parameter import Parameter, defaults
from asi_common.parameter_file import parameter_file, parameter_lines, scalar
from asi_controller import additions
from asi_controller.compensators import COMPENSATORS, DOCUMENTATION
from asi_controller.parameters import (
    CHOICE_PARAMETERS,
    CONTROLLER_NODE_PARAMETERS,
    REFERENCE_PARAMETERS,
)

COMMAND: Final = 'python doc/generate.py'


class NodeTables(NamedTuple):
    """A node, its YAML file, and the tables of its parameters by title."""

    node: str
    file: str
    tables: dict[str, tuple[Parameter, ...]]
    texts: Mapping[str, str] = {}    # text above a table in doc/reference/parameters.md
    condition: str = ''              # the value of a parameter with which the node has these

    @property
    def title(self) -> str:
        """The node and, if it has these parameters not always, when."""
        return self.node + (f' with {self.condition}' if self.condition else '')


NODES: Final = (
    NodeTables('asi_actuator', 'config/actuator.yaml',
               {'Node': ACTUATOR_NODE_PARAMETERS, 'Physics': ACTUATOR_PARAMETERS}),
    NodeTables('asi_controller', 'config/controller.yaml',
               {'Node': CONTROLLER_NODE_PARAMETERS, 'Compensator': CHOICE_PARAMETERS,
                **{f'Compensator {name}': each.table for name, each in COMPENSATORS.items()},
                **{f'Addition {name}': table for name, table in additions.ADDITIONS.items()},
                'Reference': REFERENCE_PARAMETERS},
               {f'Compensator {name}': text for name, text in DOCUMENTATION.items()}
               | {f'Addition {name}': text for name, text in additions.DOCUMENTATION.items()}),
)
# The physics of the actuator's node with plant: joint.
JOINT: Final = NodeTables(
    'asi_actuator', 'config/joint.yaml',
    {'Plant': tuple(parameter._replace(default='joint')
                    for parameter in ACTUATOR_NODE_PARAMETERS if parameter.name == 'plant'),
     'Physics of a joint': JOINT_PARAMETERS},
    {'Physics of a joint': '[How to simulate a joint](../how_to/simulate_a_joint.md). A joint '
     'that turns has rad, Nm and kg m2, one that slides m, N and kg.'}, 'plant: joint')
WRITTEN: Final = (NODES[0], JOINT, *NODES[1:])


def _comments(parameter: Parameter) -> list[str]:
    unit = '' if parameter.allowed.endswith(parameter.unit) else f' in {parameter.unit}'
    fixed = '; fixed while the node runs' if parameter.read_only else ''
    return [parameter.description, f'{parameter.allowed}{unit}{fixed}']


def yaml_text(node: NodeTables) -> str:
    """Return the parameter file of a node with the defaults, as `ros2 run` takes it."""
    lines = []
    for title, table in node.tables.items():
        if table:
            lines += [f'    # {title}', *parameter_lines(
                defaults(table), {parameter.name: _comments(parameter) for parameter in table})]
    return parameter_file(f'/**/{node.node}', lines, [
        f'Parameters of {node.title}, all at their defaults.', f'Written by `{COMMAND}`.'])


def _row(parameter: Parameter) -> str:
    cells = (f'`{parameter.name}`' + (' (fixed)' if parameter.read_only else ''),
             f'`{scalar(parameter.default)}`', parameter.unit, parameter.description,
             parameter.allowed, parameter.source)
    return '| ' + ' | '.join(cell.replace('|', '\\|') for cell in cells) + ' |'


def markdown_text() -> str:
    """Return doc/reference/parameters.md."""
    lines = ['# Parameters', '', f'Written by `{COMMAND}`.', '',
             'Change one while a node runs by `ros2 param set /asi_controller gain 8.0`; those '
             'marked (fixed) only at the start. A value that is not allowed is refused with the '
             'reason and changes nothing.']
    for node in WRITTEN:
        lines += ['', f'## /{node.title}', '', f'File: `{node.file}`']
        for title, table in node.tables.items():
            lines += ['', f'### {title}']
            if text := node.texts.get(title):
                lines += ['', text]
            if table:
                lines += ['', '| parameter | default | unit | what it is | allowed | source |',
                          '|---|---|---|---|---|---|', *map(_row, table)]
    return '\n'.join(lines) + '\n'


def files() -> dict[Path, str]:
    """Return the text of each file by its path in the repository."""
    return {Path(node.file): yaml_text(node) for node in WRITTEN} | {
        Path('doc/reference/parameters.md'): markdown_text()}
