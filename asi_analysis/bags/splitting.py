"""Divide a bag in which the loop began anew, or stood still, into bags that can be analysed."""

import heapq
import shutil
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import numpy as np

from asi_analysis.bags import cdr
from asi_analysis.bags.bag import MOST_LATE, TIME_BASES, decode
from asi_analysis.bags.bag_file import read_contents
from asi_analysis.bags.bag_writer import RELIABLE, BagWriter, typestore
from asi_analysis.bags.encoding import Nanoseconds
from asi_analysis.bags.topic_messages import Topic
from asi_analysis.errors import InputError, InputWarning

# The loop has stood still if no message comes for so long (s), as the nodes say in their
# diagnostics, and for so many periods.
STILL_S: Final = 1.0
STILL_PERIODS: Final = 10.0


def split_bag(path: str | Path, out: str | Path) -> dict[Path, int]:
    """
    Write each part of a bag as a bag, OUT/1, OUT/2 and so on; return them with their messages.

    A part ends where the stamps go back, as they do when the actuator is started again in
    lock-step, and where none comes for STILL_S. Messages are copied as they are, with what the
    bag says of the run; a topic of which the parts cannot be told is left out, with an
    InputWarning. If one part cannot be written, none is kept. Raises InputError if there is
    nothing to divide, no topic of which the parts can be told, or a part exists already.

    >>> import tempfile
    >>> import asi_analysis as asi
    >>> folder = tempfile.mkdtemp()
    >>> asi.write_bag(asi.simulate({}, {'reference.amplitude': 100.0}, 0.2), f'{folder}/bag')
    >>> asi.split_bag(f'{folder}/bag', f'{folder}/parts')
    Traceback (most recent call last):
    asi_analysis.errors.InputError: ...bag is in one piece: its stamps rise without a pause
    """
    path, out = Path(path), Path(out)
    contents = read_contents(path, lambda name: True)
    topics = [topic for topic in contents.topics.values() if len(topic)]
    if not topics:
        raise InputError(f'{path} holds no message')
    cuts, problems = _cuts(path, topics)
    problems = [*contents.problems, *problems]
    for problem in problems:
        warnings.warn(problem, InputWarning, stacklevel=2)
    written: dict[Path, int] = {}
    for number in range(1 + max(map(len, cuts.values()))):
        parts = {name: slice(*[0, *begins, None][number:number + 2])
                 for name, begins in cuts.items()}
        bag = out / str(number + 1)
        try:
            written[bag] = _copy(bag, contents.topics, parts, contents.information)
        except BaseException:
            # The parts before it would make the next call fail.
            for part in written:
                shutil.rmtree(part, ignore_errors=True)
            raise
    return written


def _cuts(path: Path, topics: Sequence[Topic]) -> tuple[dict[str, list[int]], list[str]]:
    """Return where parts begin, by topic, and sentences on topics of which it is not known."""
    first = _time_base(topics)
    log_ns = np.array(first.log_ns)
    begins = _begins(_ticks(first))
    if not begins:
        raise InputError(f'{path} is in one piece: its stamps rise without a pause')
    # In lock-step times of recording are stamps, too, and go back with them.
    back = _goes_back(log_ns, begins)
    between = [(log_ns[k - 1] + log_ns[k]) // 2 for k in begins]
    cuts: dict[str, list[int]] = {}
    problems = []
    for topic in topics:
        times = np.array(topic.log_ns)
        known = not any(back)
        found = np.searchsorted(times, between).tolist() if known else _begins(times)
        if not known and _goes_back(times, found) != back:   # as the states of two starts
            found = (np.flatnonzero(np.diff(times) <= 0) + 1).tolist()
        known = known or _goes_back(times, found) == back
        if topic.type not in typestore().fielddefs:
            problems.append(f'{path}: {topic.name} is left out: ROS 2 Jazzy does not define '
                            f'its type, {topic.type}')
        elif not known:
            problems.append(f'{path}: {topic.name} is left out: its times do not go back with '
                            f'those of {first.name}')
        else:
            cuts[topic.name] = found
    if not cuts:
        raise InputError('; '.join(problems))
    return cuts, problems


def _goes_back(times: Nanoseconds, begins: Sequence[int]) -> list[bool]:
    """Return, for each begin of a part, whether times go back there and do not only pause."""
    return [bool(times[k] <= times[k - 1]) for k in begins]


def _time_base(topics: Sequence[Topic]) -> Topic:
    """Return the topic that gives the time base of a run, or else the longest one."""
    for name in TIME_BASES:
        for topic in topics:
            if topic.name.rpartition('/')[2] == name:
                return topic
    return max(topics, key=len)


def _ticks(topic: Topic) -> Nanoseconds:
    """Return the stamps (ns) of a topic, or its times of publication without any."""
    stamps = np.zeros(1, np.int64)
    if topic.type in typestore().fielddefs:
        with suppress(cdr.LayoutError):
            stamps = decode(topic).stamp_ns
    return stamps if stamps.any() else topic.publish_ns


def _begins(ticks: Nanoseconds) -> list[int]:
    """Return where stamps go back or pause; a few that are late or wrong are no end of a part."""
    steps = np.diff(ticks)
    rising = steps[steps > 0]
    if not rising.size:
        return []
    still = max(1e9 * STILL_S, STILL_PERIODS * float(np.median(rising)))
    found: list[int] = []
    window = 2 * MOST_LATE + 1
    for k in (np.flatnonzero((steps < 0) | (steps > still)) + 1).tolist():
        step = np.median(ticks[k:k + window]) - np.median(ticks[max(k - window, 0):k])
        if (step < 0 or step > still) and (not found or k - found[-1] > MOST_LATE):
            found.append(k)
    return found


def _copy(bag: Path, topics: Mapping[str, Topic], parts: Mapping[str, slice],
          information: Mapping[str, Any]) -> int:
    """Write a part of each topic, in the order of the times of recording; return its messages."""
    writer = BagWriter(bag)
    try:
        writer.add_information(information)
        counts: dict[int, int] = {}
        rows = []
        for name, part in parts.items():
            topic = topics[name]
            channel = writer.add_topic(name, topic.type, topic.offered or (RELIABLE,))
            counts[channel] = 0
            rows.append(_rows(topic, part, channel))
        for log_ns, channel, publish_ns, data in heapq.merge(*rows):
            counts[channel] += 1
            writer.write(channel, log_ns, publish_ns, counts[channel], data)
        writer.close()
    except BaseException as error:
        writer.abandon(error)
        shutil.rmtree(bag, ignore_errors=True)
        raise
    return sum(counts.values())


def _rows(topic: Topic, part: slice, channel: int) -> Iterator[tuple[int, int, int, bytes]]:
    """Return log time, channel, time of publication and bytes of a part of the messages."""
    times, published = topic.log_ns[part], topic.publish_ns[part].tolist()
    return zip(times, [channel] * len(times), published, topic.data[part], strict=True)
