"""Read a bag into a `Run`, and write a `Run` as a bag."""

import shutil
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from asi_analysis.arrays import Array
from asi_analysis.bags import cdr
from asi_analysis.bags.bag_file import read_contents
from asi_analysis.bags.bag_writer import BagWriter, typestore
from asi_analysis.bags.encoding import (
    SIGNAL_TOPICS,
    Nanoseconds,
    encode,
    signal_paths,
    topic_values,
)
from asi_analysis.bags.information import checked, missing_ticks
from asi_analysis.bags.run import SIGNALS, Run, StateChange
from asi_analysis.bags.topic_messages import Topic
from asi_analysis.errors import InputError, InputWarning
from asi_common.topics import JOINTS, TOPICS

# The first of these that a bag has gives the time base; the others may have no stamps.
TIME_BASES: Final = ('joint_states', 'force', 'valve_command', 'force_reference', 'reference')
DIAGNOSTICS: Final = 'diagnostics'
DIAGNOSTIC_ARRAY: Final = TOPICS['/diagnostics'].type
# End of the name of the status of a state (asi_common/node/diagnostics.py, which imports rclpy).
STATE: Final = ': state'
LOST: Final = 'lost samples'     # key of the status of a loop, in that module too
# Tolerated in one recording: delay of a message, in messages; number of messages beyond that.
MOST_LATE: Final = 10
MOST_WRONG: Final = 2
LONGER: Final = 0.05    # share of a recording by which another topic may outlast the first
IRREGULAR: Final = 0.1  # least share of unusual intervals that shows missing messages
CROWDED: Final = 1.5    # ratio of the density of messages to the usual one, where clocks overlap
BLOCK_SAMPLES: Final = 20_000


class Series(NamedTuple):
    """One topic, decoded: times (ns) of n messages, and their numbers by name."""

    stamp_ns: Nanoseconds       # 0 where there is none
    publish_ns: Nanoseconds
    values: dict[str, Array]


def read_bag(path: str | Path) -> Run:
    """
    Return the recording in a bag of this package, or in one of `ros2 bag record` of its topics.

    path: rosbag2 directory, .mcap or .db3 file. The time base is that of the stamps of
    joint_states (without it, of the first topic of TIME_BASES in the bag), from 0; a message
    with another stamp holds until the next one. Of a damaged file the readable part is returned,
    with an InputWarning. Raises InputError if no message can be read.

    >>> import tempfile
    >>> import asi_analysis as asi
    >>> bag = f'{tempfile.mkdtemp()}/bag'
    >>> asi.write_bag(asi.simulate({}, {'reference.amplitude': 100.0}, 0.2), bag)
    >>> run = asi.read_bag(bag)
    >>> list(run.signals())
    ['reference', 'command', 'force', 'valve_position', 'position', 'velocity']
    """
    path = Path(path)
    contents = read_contents(path, lambda name: _base_name(name) in (*SIGNAL_TOPICS, DIAGNOSTICS))
    problems = list(contents.problems)
    series: dict[str, Series] = {}
    changes = []
    for topic in contents.topics.values():
        name = _base_name(topic.name)
        if name == DIAGNOSTICS:
            changes = _state_changes(topic)
            problems += [f'{path}: {node} lost {count} samples' for node, count in
                         _lost_by_nodes(topic).items()]
        elif topic.type != SIGNAL_TOPICS[name].type:
            problems.append(f'{path}: {topic.name} is left out: it is of type {topic.type}, '
                            f'expected {SIGNAL_TOPICS[name].type}')
        elif len(topic):
            if name in series:
                raise InputError(f'{path} has several topics named {name}: expected one actuator '
                                 'a bag')
            try:
                decoded = decode(topic)
            except cdr.LayoutError as error:
                problems.append(f'{path}: {topic.name} is left out: {error}')
                continue
            joints = {key.rpartition(' ')[0] for key in decoded.values} - {''}
            if joints and not joints & set(JOINTS):
                problems.append(f'{path}: {topic.name} is left out: it is of the joints '
                                f'{", ".join(sorted(joints))}, expected {" and ".join(JOINTS)} '
                                '(asi import takes others)')
            else:
                series[name] = decoded
    problems += [f'{path}: {count} messages of {name} were lost on their way to the recorder'
                 for name, count in _lost_on_the_way(contents.topics).items()]
    if not series:
        why = f' ({problems[0]})' if problems else ''
        raise InputError(f'{path} holds no message of the topics {", ".join(SIGNAL_TOPICS)}{why}')
    information = checked(contents.information, problems, str(path))
    problems += [f'{path}: at its import: {text}' for text in
                 information.get('imported', {}).get('problems', ())]
    problems += _wrong_stamps(series, str(path))
    problems += [f'{path}: {text}' for text in _missing_ends(series, contents.topics)]
    for problem in problems:
        warnings.warn(problem, InputWarning, stacklevel=2)
    run = assemble(series, changes, str(path), information)
    if count := missing_ticks(information, len(run)):
        # The data quality tells it with the figures that it affects.
        warnings.warn(f'{path}: {count} of the {len(run) + count} samples of this run are not in '
                      'the recording: it was interrupted or cut', InputWarning, stacklevel=2)
    return replace(run, problems=tuple(problems), lacking=count)


def write_bag(run: Run, path: str | Path, information: Mapping[str, Any] | None = None) -> None:
    """
    Write a run as a recorder would; the first stamp is one period.

    information: the metadata `asi.run` of the bag; `run.information` if None. Raises InputError
    if the bag exists already.

    >>> import tempfile
    >>> import asi_analysis as asi
    >>> folder = tempfile.mkdtemp()
    >>> asi.write_bag(asi.simulate({}, {'reference.amplitude': 100.0}, 0.2), f'{folder}/bag')
    >>> len(asi.read_bag(f'{folder}/bag'))
    1000
    """
    path = Path(path)
    writer = BagWriter(path)
    try:
        _write(run, writer, run.information if information is None else information)
    except BaseException as error:
        # An incomplete bag would make the next call fail.
        writer.abandon(error)
        shutil.rmtree(path, ignore_errors=True)
        raise


def _write(run: Run, writer: BagWriter, information: Mapping[str, Any]) -> None:
    """Write the messages of a run in blocks of samples."""
    writer.add_information(information)
    stamps = np.round((run.time_s - run.time_s[0]) * 1e9).astype(np.int64)
    stamps += round((run.period_s if len(run) > 1 else 1e-3) * 1e9)
    channels = {name: writer.add_topic(f'/{name}', TOPICS[name].type)
                for name in topic_values(run[:0])}
    for start in range(0, len(run), BLOCK_SAMPLES):
        block = slice(start, start + BLOCK_SAMPLES)
        messages = {}
        for name, values in topic_values(run[block]).items():
            known = (np.arange(len(stamps[block])) if name == 'joint_states' else np.flatnonzero(
                np.any([~np.isnan(column) for column in values.values()], axis=0)))
            if len(known):
                messages[channels[name]] = (stamps[block][known], encode(
                    TOPICS[name].type, stamps[block][known],
                    {key: column[known] for key, column in values.items()}))
        writer.write_many(messages)
    writer.close()


def _base_name(topic: str) -> str:
    return topic.rpartition('/')[2]


def decode(topic: Topic, select: Callable[[cdr.Layout], dict[str, cdr.Path]] = signal_paths
           ) -> Series:
    """
    Decode the messages of a topic, those of one layout together. Raises cdr.LayoutError.

    select: returns the paths of the numbers to decode, by name; `sec` and `nanosec`: the stamp.
    """
    count = len(topic)
    stamp_ns = np.zeros(count, np.int64)
    values: dict[str, Array] = {}
    layouts: dict[bytes, cdr.Layout] = {}      # by a message of that layout
    for indices, table in topic.tables():
        remaining = np.ones(len(indices), bool)
        while remaining.any():
            template = _layout_key(layouts, topic.type, table[np.argmax(remaining)])
            group = remaining & cdr.same_layout(table, template, layouts[template])
            remaining &= ~group
            paths = select(layouts[template])
            found = dict(zip(paths, cdr.columns(
                topic.type, table if group.all() else table[group], list(paths.values()),
                layouts[template]), strict=True))
            if 'sec' in found:
                stamp_ns[indices[group]] = (found.pop('sec').astype(np.int64) * 10**9
                                           + found.pop('nanosec').astype(np.int64))
            for name, column in found.items():
                values.setdefault(name, np.full(count, np.nan))[indices[group]] = column
    return Series(stamp_ns, topic.publish_ns, values)


def _layout_key(layouts: dict[bytes, cdr.Layout], type_: str,
                message: npt.NDArray[np.uint8]) -> bytes:
    """Return the key of a message's layout in `layouts`; a new layout is added."""
    for template, layout in layouts.items():
        if len(template) == len(message) and cdr.same_layout(message[None], template, layout)[0]:
            return template
    template = message.tobytes()
    layouts[template] = cdr.layout_of(type_, template)
    return template


def _lost_on_the_way(topics: Mapping[str, Topic]) -> dict[str, int]:
    """
    Return the number of lost messages by topic.

    Empty if every topic has gaps: then the sequence numbers are not counted topic by topic.
    """
    counts = {topic.name: topic.lost for topic in topics.values()
              if _base_name(topic.name) != DIAGNOSTICS}
    lost = {name: count for name, count in counts.items() if count}
    return lost if len(lost) < max(len(counts), 2) else {}


def _statuses(topic: Topic, mark: str) -> Iterator[Any]:
    """Yield the readable messages of /diagnostics in which a text occurs."""
    if topic.type != DIAGNOSTIC_ARRAY:
        return
    for data in (data for data in topic.data if mark.encode() in data):
        with suppress(Exception):   # noqa: B902 - rosbags raises anything for damaged bytes
            yield typestore().deserialize_cdr(data, DIAGNOSTIC_ARRAY)


def _state_changes(topic: Topic) -> list[tuple[int, StateChange]]:
    """Return the state changes of the actuator in /diagnostics, with their stamps (ns)."""
    changes = []
    for message in _statuses(topic, f'{STATE}\0'):
        stamp = message.header.stamp
        # A periodic message has the status of the loop too; a change of state comes alone.
        for status in message.status if len(message.status) == 1 else ():
            values = {pair.key: pair.value for pair in status.values}
            if status.name.endswith(STATE) and 'state' in values:
                changes.append((stamp.sec * 10**9 + stamp.nanosec, StateChange(
                    0.0, values['state'], values.get('reason', ''))))
    return changes


def _lost_by_nodes(topic: Topic) -> dict[str, int]:
    """Return how many samples each node says in /diagnostics that it has lost, if any."""
    lost: dict[str, int] = {}
    for message in _statuses(topic, LOST):
        for status in message.status:
            count = next((pair.value for pair in status.values if pair.key == LOST), '')
            if count.isdecimal() and int(count):
                lost[status.name.partition(':')[0]] = int(count)
    return lost


def assemble(series: Mapping[str, Series], changes: list[tuple[int, StateChange]], source: str,
              information: dict[str, Any]) -> Run:
    """Return the run: the topics aligned to one time base."""
    base = time_base(series[_first(series)], source)
    aligned = {name: align(base, series[name],
                           hold=not {'reference', 'command'}.isdisjoint(topic.signals))
               for name, topic in SIGNAL_TOPICS.items() if name in series}
    signals: dict[str, Any] = {}
    for signal in SIGNALS:
        for name, columns in aligned.items():
            values = columns.get(SIGNAL_TOPICS[name].signals.get(signal.name, ''))
            if values is not None and not np.isnan(values).all():
                signals[signal.field] = values
                break
    if 'command_n' not in signals and 'joint_states' in aligned:
        # The applied command of a state is the answer to the state before.
        applied = aligned['joint_states'].get('valve effort')
        if applied is not None and not np.isnan(applied).all():
            signals['command_n'] = np.append(applied[1:], np.nan)
    time_s = (base.stamp_ns - base.stamp_ns[0]) / 1e9
    states = tuple(change._replace(time_s=(stamp_ns - int(base.stamp_ns[0])) / 1e9)
                   for stamp_ns, change in changes)
    return replace(Run(time_s, source=source, information=information, states=states), **signals)


def _wrong_stamps(series: Mapping[str, Series], source: str) -> list[str]:
    """Return sentences on topics with repeated stamps, stamps of another clock, or losses."""
    found = []
    first = _first(series)
    ticks = np.unique(series[first].stamp_ns)
    period = float(np.median(np.diff(ticks))) if len(ticks) > 1 else np.inf
    usual = np.median(series[first].stamp_ns - series[first].publish_ns)
    for name, one in series.items():
        stamps = np.unique(one.stamp_ns)
        if one.stamp_ns.any() and len(stamps) < 0.5 * len(one.stamp_ns):
            found.append(f'{source}: {len(one.stamp_ns)} messages of {name} have {len(stamps)} '
                         'different stamps: their times are wrong')
        longer = int(stamps[-1] - ticks[-1])
        if longer > max(MOST_LATE * period, LONGER * (ticks[-1] - ticks[0])) and (
                stamps[0] <= ticks[-1]):    # else those of another clock
            found.append(f'{source}: the messages of {first} end {1e-9 * longer:.3g} s before '
                         f'those of {name}')
        stamps = stamps[(stamps >= ticks[0]) & (stamps <= ticks[-1])]
        if not len(stamps):     # none, or those of another clock
            continue
        off = np.abs(one.stamp_ns - one.publish_ns - usual)
        if name != first and np.quantile(off, 0.9) > MOST_LATE * period:
            found.append(f'{source}: the stamps of {name} are up to {1e-9 * off.max():.3g} s off '
                         f'those of messages of {first} that were published at the same time')
        steps = np.diff(np.searchsorted(ticks, stamps))
        if len(steps) and np.mean(steps != np.median(steps)) > IRREGULAR and np.array_equal(
                one.stamp_ns, one.publish_ns):      # in lock-step, each state has an answer
            found.append(f'{source}: messages of {name} are missing: {len(stamps)} came, at no '
                         f'regular interval, with {len(ticks)} of {first}')
    return found


def _missing_ends(series: Mapping[str, Series], topics: Mapping[str, Topic]) -> Iterator[str]:
    """Yield sentences on what is missing before a recorder that began late, or at either end."""
    before = sum(topic.before for topic in topics.values()
                 if _base_name(topic.name) == 'joint_states')
    if before > MOST_LATE:
        yield f'{before} states were published before the recording began'
    if not {'joint_states', 'valve_command'} <= series.keys():
        return
    ticks = np.unique(series['joint_states'].stamp_ns)
    stamps = np.unique(series['valve_command'].stamp_ns)
    if len(ticks) < 2 or stamps[-1] < ticks[0] or stamps[0] > ticks[-1]:    # another clock
        return
    tolerated = MOST_LATE * float(np.median(np.diff(ticks)))
    for missing, part in ((stamps[0] - ticks[0], 'first'), (ticks[-1] - stamps[-1], 'last')):
        if missing > tolerated:
            yield f'the {part} {1e-9 * missing:.3g} s have no valve_command'


def _first(series: Mapping[str, Series]) -> str:
    """Return the topic that gives the time base."""
    return next(name for name in (*TIME_BASES, *SIGNAL_TOPICS) if name in series)


def time_base(series: Series, source: str) -> Series:
    """
    Return the time base of a run: unique stamps, or times of publication without stamps.

    Raises InputError for a clock that was set back: messages before and after would be mixed.
    """
    ticks = series.stamp_ns if series.stamp_ns.any() else series.publish_ns
    steps = np.diff(ticks)
    if (steps < 0).any() and _clock_was_set_back(ticks):
        k = int(np.argmin(steps))
        raise InputError(f'{source}: the stamps go back by {-1e-9 * steps[k]:.4g} s after '
                         f'{1e-9 * (ticks[k] - ticks[0]):.6g} s, where another run begins: '
                         f'asi split {source} --out DIR makes a bag of each')
    count = len(ticks)
    ticks, first = np.unique(ticks, return_index=True)
    if repeated := count - len(ticks):
        warnings.warn(f'{source}: {repeated} of {count} messages repeat the stamp of another one, '
                      'and are left out', InputWarning, stacklevel=3)
    return Series(ticks, np.maximum.accumulate(series.publish_ns[first]), {})


def _clock_was_set_back(ticks: Nanoseconds) -> bool:
    """Return whether the stamps overlap, rather than a few being late or wrong."""
    order = np.argsort(ticks, kind='stable')
    if np.sum(np.abs(order - np.arange(len(ticks))) > MOST_LATE) <= MOST_WRONG:
        return False
    if np.sum(ticks < ticks[0]) > MOST_WRONG:
        return True
    # Late messages fill a gap in time; after a clock was set back they crowd among earlier ones.
    steps, window = np.diff(ticks), 2 * MOST_LATE
    spans = ticks[order][window:] - ticks[order][:-window]
    usual = np.median(steps[steps > 0])
    return bool((spans < window / CROWDED * usual).any())


def align(base: Series, series: Series, hold: bool) -> dict[str, Array]:
    """
    Return the values of a topic on the time base, NaN where there is no message or no number.

    A message belongs to the tick with its stamp; without a stamp, to the tick that was published
    nearest in time. Values are held until the next message if fewer than half of the ticks, or of
    the messages, have a partner. With `hold` they are also held if they have no stamps, or
    were recorded in real time: a state without an answer leaves the valve as it was. In lock-step
    every state has an answer, so a missing one is a lost message and stays NaN.
    """
    ticks, times = base.stamp_ns, series.stamp_ns
    if not times.any():
        ticks, times = base.publish_ns, series.publish_ns
        position, held = _nearest(ticks, times), hold
    else:
        position = np.minimum(np.searchsorted(ticks, times), len(ticks) - 1)
        own = ticks[position] == times
        if not own.any() and (times.max() < ticks[0] or times.min() > ticks[-1]):
            # The stamps are of another clock.
            ticks, times = base.publish_ns, series.publish_ns
        lockstep = np.array_equal(series.publish_ns, series.stamp_ns)
        held = (own.sum() < 0.5 * max(len(ticks), len(times))) or (hold and not lockstep)
        position = np.where(own, position, -1)
    if held:
        order = np.argsort(times, kind='stable')
        # A message stamped when sent, up to half a period after a tick, belongs to that tick.
        late = ticks + int(np.median(np.diff(ticks))) // 2 if len(ticks) > 1 else ticks
        last = np.searchsorted(times[order], late, side='right') - 1
        message = np.where(last >= 0, order[last], -1)
    else:
        message = np.full(len(ticks), -1)
        message[position[position >= 0]] = np.flatnonzero(position >= 0)
    return {name: np.where((message >= 0) & np.isfinite(values[message]), values[message], np.nan)
            for name, values in series.values.items()}


def _nearest(ticks: Nanoseconds, times: Nanoseconds) -> npt.NDArray[np.intp]:
    """Return the index of the tick that is nearest to each time."""
    after = np.clip(np.searchsorted(ticks, times), 1, max(len(ticks) - 1, 1))
    if len(ticks) == 1:
        return np.zeros(len(times), np.intp)
    return np.where(times - ticks[after - 1] < ticks[after] - times, after - 1, after)
