"""Parameter files of the command line that have nothing for a node: rcl ignores them silently."""

import re
from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Final

from asi_common.parameter import ParameterError
from asi_common.parameter_file import node_names

# The nodes of this package: `ros2 launch` gives each of them the files of all.
NODES: Final = ('asi_actuator', 'asi_controller', 'asi_recorder', 'asi_replay')


def unused_files(arguments: Sequence[str], node: str) -> list[str]:
    """
    Return a warning for each parameter file that was probably meant for a node, but is not.

    arguments: those of the command line; node: with its namespace, as /bench/asi_controller. A
    file for other nodes of this package, without a name like this node's, is none.
    """
    files = [file for option, file in zip(arguments, arguments[1:], strict=False)
             if option == '--params-file']
    return [f'{file} has nothing for the node {node}: it names {", ".join(names)}'
            for file, names in zip(files, map(_names, files), strict=True)
            if _is_meant_for(node, names)]


def _names(file: str) -> list[str]:
    """Return the names of the nodes in a file; none in one that rcl alone can read."""
    try:
        return node_names(Path(file))
    except ParameterError:
        return []


def _is_meant_for(node: str, names: Sequence[str]) -> bool:
    """Return whether a file with these names has nothing for a node, but was meant to have."""
    own = node.rpartition('/')[2]
    others = [name for name in (each.rpartition('/')[2] for each in names)
              if name == own or name not in NODES]
    return (not any(_matches(name, node) for name in names)
            and bool(others)
            and (len(others) == len(names)
                 or any(get_close_matches(name, NODES, 1) == [own] for name in others)))


def _matches(name: str, node: str) -> bool:
    """Return whether a name in a parameter file is that of a node, as rclpy tells it."""
    pattern = re.escape(f'/{name.removeprefix("/")}')
    for given, meant in ((r'/\*\*', r'(/\w+)*'), (r'/\*', r'(/\w+)')):
        pattern = pattern.replace(given, meant)
    return re.fullmatch(pattern, node) is not None
