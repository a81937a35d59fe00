"""A rosbag2 of any robot as columns by name: TOPIC/FIELD; of joint states TOPIC/JOINT/FIELD."""

import warnings
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from rosbags.interfaces import MessageDefinitionFormat
from rosbags.rosbag2 import Reader
from rosbags.typesys import TypesysError, get_types_from_msg

from asi_analysis.bags import cdr
from asi_analysis.bags.bag import Series, decode, onto, time_base
from asi_analysis.bags.bag_file import BROKEN, Topic, read_contents
from asi_analysis.bags.bag_writer import typestore
from asi_analysis.bags.exchange.table_file import Table
from asi_analysis.errors import InputError, InputWarning


def is_bag(path: Path) -> bool:
    """Tell whether a path is that of a bag, by its name."""
    return path.is_dir() or path.suffix in ('.mcap', '.db3')


def read_bag_table(path: Path, wanted: Sequence[str]) -> Table:
    """
    Return the numbers of the topics that `wanted` columns are of, and `time`, s.

    The times are those of the topic of the first column; what another topic holds lasts until its
    next message. Raises InputError.
    """
    present: dict[str, None] = {}

    def named(topic: str) -> bool:
        present[topic] = None
        return any(column.startswith(f'{topic}/') for column in wanted)

    contents = read_contents(path, named)
    for problem in contents.problems:
        warnings.warn(problem, InputWarning, stacklevel=3)
    if missing := {topic.type for topic in contents.topics.values()} - set(typestore().fielddefs):
        _learn_types(path, missing)
    series = {topic.name: _decoded(topic, path) for topic in contents.topics.values()
              if len(topic)}
    # The longest that fits: there may be both /arm and /arm/wrist.
    first = next((name for column in wanted for name in sorted(series, key=len, reverse=True)
                  if column.startswith(f'{name}/')), None)
    if first is None:
        raise InputError(f'{path}: no message of a topic is mapped, as SIGNAL=TOPIC/FIELD or '
                         'SIGNAL=TOPIC/JOINT/FIELD; it has ' + ', '.join(present))
    base = time_base(series[first])
    table: Table = {'time': (base.stamp_ns - base.stamp_ns[0]) / 1e9}
    for name, one in series.items():
        for field, values in one.values.items():
            table[f'{name}/{field}'] = onto(base, one, values, lasting=name != first)
    return table


def _learn_types(path: Path, missing: set[str]) -> None:
    """
    Define the message types that a bag brings with it: since Iron rosbag2 writes them down.

    rosbags makes code of them; its grammar lets nothing but names, numbers and literals through.
    """
    with suppress(TypesysError, SyntaxError, *BROKEN), Reader(path) as reader:
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
        return decode(topic, _names)
    except (SyntaxError, *BROKEN) as error:   # a type of the bag's own may be anything
        raise InputError(f'{path}: {topic.name} cannot be read as {topic.type}: {error}') from None


def _names(place: cdr.Layout) -> dict[str, cdr.Path]:
    """Return where the numbers of a message are, by JOINT/FIELD, or by FIELD."""
    joints = {path[1]: name for path, name in place.strings.items()
              if len(path) == 2 and path[0] == 'name'}
    named: dict[str, cdr.Path] = {}
    for path in place.numbers:
        if path[:2] == ('header', 'stamp'):
            named[str(path[2])] = path
        elif len(path) == 2 and path[1] in joints:
            named[f'{joints[path[1]]}/{path[0]}'] = path
        else:
            named['/'.join(map(str, path))] = path
    return named
