"""Encode arrays as the messages of the topics."""

from collections.abc import Mapping
from typing import Final

import numpy as np
import numpy.typing as npt

from asi_analysis.arrays import Array
from asi_analysis.bags import cdr
from asi_analysis.bags.bag_writer import typestore
from asi_analysis.bags.run import Run
from asi_common.topics import FRAME, JOINTS, TOPICS

SIGNAL_TOPICS: Final = {topic.name: topic for topic in TOPICS.values() if topic.signals}

Nanoseconds = npt.NDArray[np.int64]


def signal_paths(layout: cdr.Layout) -> dict[str, cdr.Path]:
    """Return the paths of the numbers that a run uses, named as in `asi_common.topics`."""
    joints = {path[1]: name for path, name in layout.strings.items() if path[0] == 'name'}
    paths: dict[str, cdr.Path] = {}
    for path in layout.numbers:
        match path:
            case (*_, 'sec' | 'nanosec' as part):
                paths[part] = path
            case ('wrench', 'force', 'x') | ('data',):
                paths['value'] = path
            case (str(quantity), int(joint)) if joint in joints:
                paths[f'{joints[joint]} {quantity}'] = path
    return paths


def topic_values(run: Run) -> dict[str, dict[str, Array]]:
    """Return the numbers of each topic that a run has signals for."""
    present = run.signals()
    other = 'reference' if run.unit('reference') == 'N' else 'force_reference'
    topics = {topic.name: {number: present[signal] for signal, number in topic.signals.items()
                           if signal in present}
              for topic in SIGNAL_TOPICS.values() if topic.name != other}
    return {name: values for name, values in topics.items() if values or name == 'joint_states'}


def encode(type_: str, stamps: Nanoseconds, values: Mapping[str, Array]
           ) -> npt.NDArray[np.uint8]:
    """
    Return one message for each of n stamps (ns), as a table of bytes: n x length.

    values: the numbers of the messages by name (`signal_paths`).
    """
    types = typestore().types
    time = types['builtin_interfaces/msg/Time'](0, 0)
    header = types['std_msgs/msg/Header'](time, FRAME)
    if type_ == TOPICS['joint_states'].type:
        missing = np.full(2, np.nan)
        message = types[type_](header, list(JOINTS), missing, missing, missing)
    elif type_ == TOPICS['force'].type:
        zero = types['geometry_msgs/msg/Vector3'](0.0, 0.0, 0.0)
        message = types[type_](header, types['geometry_msgs/msg/Wrench'](zero, zero))
    else:
        message = types[type_](time if type_ == TOPICS['clock'].type else 0.0)
    template = bytes(typestore().serialize_cdr(message, type_))
    layout = cdr.layout_of(type_, template)
    paths = signal_paths(layout)
    numbers: dict[cdr.Path, npt.NDArray] = {paths[key]: column for key, column in values.items()}
    if 'sec' in paths:
        numbers |= {paths['sec']: stamps // 10**9, paths['nanosec']: stamps % 10**9}
    return cdr.filled(template, layout, numbers)
