"""A bag of any robot as columns by name: TOPIC/FIELD; of joint states TOPIC/JOINT/FIELD."""

import warnings
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from rosbags.interfaces import MessageDefinitionFormat
from rosbags.typesys import TypesysError, get_types_from_msg

from asi_analysis.bags import cdr
from asi_analysis.bags.bag import Series, align, decode, time_base
from asi_analysis.bags.bag_file import BROKEN, opened_by_rosbags, read_contents
from asi_analysis.bags.bag_writer import typestore
from asi_analysis.bags.exchange.lerobot import is_dataset
from asi_analysis.bags.exchange.ros1_bag import read_ros1_table
from asi_analysis.bags.exchange.table_file import Table
from asi_analysis.bags.information import checked
from asi_analysis.bags.topic_messages import Topic
from asi_analysis.errors import InputError, InputWarning


def is_bag(path: Path) -> bool:
    """Tell whether a path is that of a bag, by its name; a dataset of LeRobot is a folder too."""
    return (path.is_dir() and not is_dataset(path)) or path.suffix in ('.mcap', '.db3', '.bag')


def read_bag_table(path: Path, columns: Sequence[str]) -> tuple[Table, dict[str, Any]]:
    """
    Return all numbers of the topics to which `columns` belong, and `time`, s; and the import.

    The import is that by which the bag was written, empty for others; what it had left out is
    told by warnings again.

    The time base is the topic of the first column; numbers of other topics are held until their
    next message. Raises InputError.
    """
    if path.suffix == '.bag':
        return read_ros1_table(path, columns), {}
    present: dict[str, None] = {}

    def selected(topic: str) -> bool:
        present[topic] = None
        return any(column.startswith(f'{topic}/') for column in columns)

    contents = read_contents(path, selected)
    problems = list(contents.problems)
    imported = checked(contents.information, problems, str(path)).get('imported', {})
    problems += [f'{path}: at its import: {text}' for text in imported.get('problems', ())]
    for problem in problems:
        warnings.warn(problem, InputWarning, stacklevel=3)
    if missing := {topic.type for topic in contents.topics.values()} - set(typestore().fielddefs):
        _learn_types(path, missing)
    series = {topic.name: _decoded(topic, path) for topic in contents.topics.values()
              if len(topic)}
    # The longest name that fits: a bag may have both /arm and /arm/wrist.
    first = next((name for column in columns for name in sorted(series, key=len, reverse=True)
                  if column.startswith(f'{name}/')), None)
    if first is None:
        raise InputError(f'{path}: no message of a topic is mapped, as SIGNAL=TOPIC/FIELD or '
                         'SIGNAL=TOPIC/JOINT/FIELD; it has ' + ', '.join(present))
    base = time_base(series[first], str(path))
    table: Table = {'time': (base.stamp_ns - base.stamp_ns[0]) / 1e9}
    for name, one in series.items():
        for field, values in align(base, one, hold=name != first).items():
            table[f'{name}/{field}'] = values
    return table, imported


def _learn_types(path: Path, missing: set[str]) -> None:
    """
    Define the message types that a bag contains: since Iron rosbag2 stores their definitions.

    rosbags makes code of them; its grammar allows only names, numbers and literals.
    """
    with (suppress(TypesysError, SyntaxError, *BROKEN),
          opened_by_rosbags(path) as reader):
        for connection in reader.connections:
            definition = connection.msgdef
            if connection.msgtype in missing and definition.format == MessageDefinitionFormat.MSG:
                found = get_types_from_msg(definition.data, connection.msgtype)
                typestore().register({name: fields for name, fields in found.items()
                                      if name not in typestore().fielddefs})


def _decoded(topic: Topic, path: Path) -> Series:
    if topic.type not in typestore().fielddefs:
        raise InputError(f'{path}: {topic.name} is of type {topic.type}, which neither the bag '
                         'nor ROS 2 Jazzy defines')
    try:
        return decode(topic, _number_paths)
    except (SyntaxError, *BROKEN) as error:   # the bag may define any type
        raise InputError(f'{path}: {topic.name} cannot be read as {topic.type}: {error}') from None


def _number_paths(layout: cdr.Layout) -> dict[str, cdr.Path]:
    """Return the paths of the numbers of a message, named JOINT/FIELD or FIELD."""
    joints = {path[1]: name for path, name in layout.strings.items()
              if len(path) == 2 and path[0] == 'name'}
    paths: dict[str, cdr.Path] = {}
    for path in layout.numbers:
        if path[:2] == ('header', 'stamp'):
            paths[str(path[2])] = path
        elif len(path) == 2 and path[1] in joints:
            paths[f'{joints[path[1]]}/{path[0]}'] = path
        else:
            paths['/'.join(map(str, path))] = path
    return paths
