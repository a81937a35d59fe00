"""
Reading and writing of ROS parameter files.

Scalars follow the rules of rcl (rcl_yaml_param_parser, parse.c), not those of YAML 1.1 in PyYAML:
`5e-1` is a number and `0x10` is 16. Floats are written so that both parsers read the same value.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

import yaml

from asi_common.files import read_text, write_text
from asi_common.parameter import ParameterError, Value

TRUE: Final = frozenset('Y y yes Yes YES true True TRUE on On ON'.split())
FALSE: Final = frozenset('N n no No NO false False FALSE off Off OFF'.split())
INTEGER: Final = re.compile(
    r'[+-]?(?:0[xX](?P<hex>[0-9a-fA-F]+)|(?P<octal>0[0-7]+)|0|[1-9][0-9]{0,18})')
FLOAT: Final = re.compile(r'[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?')
NOT_FINITE: Final = re.compile(r'[+-]?\.?(nan|inf|infinity)', re.IGNORECASE)


def read_scalar(text: str) -> Value:
    """Return an unquoted scalar as rcl parses it: a truth value, a number or a text."""
    if text in TRUE or text in FALSE:
        return text in TRUE
    if match := INTEGER.fullmatch(text):
        number = int(text, 16 if match['hex'] else 8 if match['octal'] else 10)
        if -2**63 <= number < 2**63:
            return number
    if FLOAT.fullmatch(text) and math.isfinite(float(text)):
        return float(text)
    if NOT_FINITE.fullmatch(text):
        return float(text.replace('.', ''))
    return text


def read_parameters(path: Path, node: str) -> dict[str, Value]:
    """
    Return the parameters of a node in a file, by dotted name.

    node: its name, without a namespace; the file may call it `node`, `/node`, `/**/node` or `/**`.
    Raises ParameterError if the file cannot be read or has nothing for the node.
    """
    root = _root(path)
    sections = [section for name in ('/**', f'/**/{node}', f'/{node}', node)
                for key, section in _entries(root) if key == name]
    values: dict[str, Value] = {}
    for section in sections:
        found = dict(_entries(section)).get('ros__parameters')
        if not isinstance(found, yaml.MappingNode):
            raise ParameterError(f'{path}: ros__parameters is missing under the node')
        values |= dict(_parameters(path, found))
    if not sections:
        raise ParameterError(f'{path} has nothing for the node {node}: it takes a ROS parameter '
                             f'file with {node}: ros__parameters: ...')
    return values


def node_names(path: Path) -> list[str]:
    """
    Return the names of the nodes in a file, namespaces included, as it writes them.

    Raises ParameterError if the file cannot be read.
    """
    def names(node: yaml.Node | None, prefix: str) -> Iterator[str]:
        for name, below in _entries(node):
            if name == 'ros__parameters':
                yield prefix
            else:
                yield from names(below, f'{prefix}/{name}' if prefix else name)

    return list(names(_root(path), ''))


def _root(path: Path) -> yaml.Node | None:
    """Return the top of a file. Raises ParameterError if it cannot be read."""
    try:
        text = read_text(path)
        root = yaml.compose(text)   # first: it refuses deep nesting, which takes the parser hours
        if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text)):
            raise ParameterError(f'{path}: ROS parameter files have no aliases (*name)')
    except OSError as error:
        raise ParameterError(f'{path}: {error.strerror}') from None
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise ParameterError(f'{path} is not YAML: {" ".join(str(error).split())}') from None
    return root


def _entries(node: yaml.Node | None) -> list[tuple[str, yaml.Node]]:
    """Return the keys and values of a mapping; none for another kind of node."""
    return [(str(key.value), value) for key, value in node.value] if isinstance(
        node, yaml.MappingNode) else []


def _parameters(path: Path, tree: yaml.Node, prefix: str = '') -> Iterator[tuple[str, Value]]:
    for name, node in _entries(tree):
        if isinstance(node, yaml.MappingNode):
            yield from _parameters(path, node, f'{prefix}{name}.')
        elif isinstance(node, yaml.ScalarNode):
            yield prefix + name, read_scalar(node.value) if node.style is None else node.value
        else:
            raise ParameterError(f'{path}: {prefix}{name} is a list: no parameter takes one')


def scalar(value: Value) -> str:
    """Return the text of a value that rcl and YAML 1.1 parse to the same value and type."""
    if isinstance(value, float) and math.isfinite(value):
        # In YAML 1.1 a float needs a point: 1e-05 is a text.
        text = float.__repr__(value)
        return text if '.' in text else text.replace('e', '.0e')
    return yaml.safe_dump(value, default_style='"' if isinstance(value, str) else None,
                          width=math.inf).splitlines()[0]


def parameter_lines(values: Mapping[str, Value],
                    comments: Mapping[str, Sequence[str]] | None = None) -> list[str]:
    """
    Return parameters by dotted name as the lines below `ros__parameters:`.

    Parameters of a block are grouped under its name. comments: lines above a parameter, by its
    name.
    """
    blocks: dict[str, list[str]] = {}
    for name, value in values.items():
        block, _, rest = name.partition('.')
        # A parameter without a block has its own group.
        lines = blocks.setdefault(f'{block}:' if rest else name, [])
        indent = '      ' if rest else '    '
        if rest and not lines:
            lines.append(f'    {block}:')
        lines += [f'{indent}# {line}' for line in (comments or {}).get(name, ())]
        lines.append(f'{indent}{rest or block}: {scalar(value)}')
    return [line for lines in blocks.values() for line in lines]


def parameter_file(node: str, lines: Sequence[str], header: Sequence[str] = ()) -> str:
    """Return the text of a parameter file; node: its name in the file."""
    return '\n'.join([*(f'# {line}' for line in header), f'{node}:', '  ros__parameters:',
                      *lines]) + '\n'


def write_parameters(path: Path, node: str, values: Mapping[str, Value],
                     header: Sequence[str] = ()) -> None:
    """Write the parameter file of a node, parameters by dotted name. Raises OSError."""
    write_text(path, parameter_file(node, parameter_lines(values), header))
