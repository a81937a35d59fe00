"""The last seconds of a running loop, as a `Run`, and as few points as a screen can show."""

import threading
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from asi_analysis.arrays import Array
from asi_analysis.bags.bag import Series, assemble, decode
from asi_analysis.bags.run import Run
from asi_analysis.bags.topic_messages import Topic
from asi_common.topics import TOPICS

# joint_states, which holds all but the reference, comes last: it completes what is shown.
HEARD: Final = ('force_reference', 'joint_states')
KEEP_S: Final = 30.0
# Number of the last states from which the true rate is computed.
RATE_STATES: Final = 2000
# So many messages are kept in one piece: many small ones take long to join.
PIECE: Final = 1000


class Taken(NamedTuple):
    """A message as it came: its bytes, its number on its topic, when it was published (ns)."""

    data: bytes
    number: int
    publish_ns: int


class Recent:
    """
    The messages of the last KEEP_S of loop time. Filled in one thread, read in others.

    heard: how many states have been added; lost: how many are missing between them;
    on_message: is called when states have been added.
    """

    def __init__(self) -> None:
        self.lost = self.heard = 0
        self.on_message: Callable[[], object] = lambda: None
        self._lock = threading.Lock()
        self._parts: dict[str, list[Series]] = {name: [] for name in HEARD}
        self._number = self._changed_ns = 0

    def add(self, name: str, taken: Sequence[Taken]) -> None:
        """
        Add messages of a topic; what came before an older stamp is of an earlier run.

        A state that is published again, as lock-step does when its answer was lost, counts once.
        """
        topic = Topic(name, TOPICS[name].type)
        for each in taken:
            topic.add(0, each.publish_ns, each.data)
        part = _since_start(decode(topic))
        with self._lock:
            if name == 'joint_states':
                numbers = np.array([self._number or taken[0].number - 1,
                                    *(each.number for each in taken)])
                self.lost += int(np.maximum(np.diff(numbers) - 1, 0).sum())
                self._number = taken[-1].number
                known = self._parts[name]
                steps = np.diff(part.stamp_ns, prepend=known[-1].stamp_ns[-1] if known else -1)
                if steps[0] < 0:
                    self._parts, self._changed_ns = {each: [] for each in HEARD}, 0
                part = _of(part, (steps != 0) | (part.stamp_ns == 0))
                self.heard += len(taken)
            parts = self._parts[name]
            if parts and len(parts[-1].stamp_ns) < PIECE and _fit(parts[-1], part):
                part = _joined([parts.pop(), part])
            if len(part.stamp_ns):
                parts.append(part)
            while len(parts) > 1 and (_last_ns(parts[-1]) - _last_ns(parts[0])) * 1e-9 > KEEP_S:
                parts.pop(0)
        if name == 'joint_states':
            self.on_message()

    def plant_changed(self) -> None:
        """Take note that what comes from now on is of another plant."""
        with self._lock:
            if states := self._parts['joint_states']:
                self._changed_ns = _last_ns(states[-1])

    def of_one_plant(self, seconds: float) -> tuple[Run | None, bool]:
        """Return the last seconds since the plant changed, and whether it changed in them."""
        with self._lock:
            states = self._parts['joint_states']
            since_s = max((_last_ns(states[-1]) - self._changed_ns) * 1e-9, 0.0) if states else 0.0
        return self.run(min(seconds, since_s)), since_s < seconds and self._changed_ns > 0

    def run(self, seconds: float, information: Mapping[str, Any] | None = None) -> Run | None:
        """Return the last seconds of loop time; None without two states."""
        with self._lock:
            parts = {name: list(each) for name, each in self._parts.items() if each}
        if 'joint_states' not in parts:
            return None
        states = parts.pop('joint_states')
        begin_ns = _last_ns(states[-1]) - seconds * 1e9
        shown = _joined(states[bisect_left(states, begin_ns, key=_last_ns):])
        series = {'joint_states': shown}
        for name, each in parts.items():
            # With one part more: its last reference may still be valid.
            times = shown.stamp_ns if each[-1].stamp_ns.any() else shown.publish_ns
            before = bisect_left(each, times[0], key=_last_ns)
            series[name] = _joined(each[max(0, before - 1):])
        run = assemble(series, [], 'live', dict(information or {}))
        first = np.searchsorted(run.time_s, run.time_s[-1] - seconds)
        return run[first:] if len(run) > 1 else None

    def rate(self) -> tuple[float, float]:
        """Return states a second of wall time, and seconds of loop time a second; 0 without."""
        with self._lock:
            parts = self._parts['joint_states'][-RATE_STATES // PIECE - 1:]
        if not parts:
            return 0.0, 0.0
        stamps, published = (np.concatenate([getattr(part, name) for part in parts])[-RATE_STATES:]
                             for name in ('stamp_ns', 'publish_ns'))
        wall_s = (published[-1] - published[0]) * 1e-9
        if wall_s <= 0.0:
            return 0.0, 0.0
        return (len(stamps) - 1) / wall_s, (stamps[-1] - stamps[0]) * 1e-9 / wall_s


def _since_start(part: Series) -> Series:
    """Return what follows the last step back of the stamps, where the loop began again."""
    k = int(np.append(np.flatnonzero(np.diff(part.stamp_ns) < 0), -1).max()) + 1
    return _of(part, slice(k, None))


def _last_ns(part: Series) -> int:
    """Return the last stamp, or when it was published if there are none."""
    return int((part.stamp_ns if part.stamp_ns.any() else part.publish_ns)[-1])


def _of(part: Series, rows: npt.NDArray[np.intp] | slice) -> Series:
    return Series(part.stamp_ns[rows], part.publish_ns[rows],
                  {name: values[rows] for name, values in part.values.items()})


def _fit(part: Series, other: Series) -> bool:
    """Return whether both have the same numbers, and both have stamps or neither."""
    return (part.values.keys() == other.values.keys()
            and part.stamp_ns.any() == other.stamp_ns.any())


def _joined(parts: Sequence[Series]) -> Series:
    return Series(np.concatenate([part.stamp_ns for part in parts]),
                  np.concatenate([part.publish_ns for part in parts]),
                  {name: np.concatenate([part.values.get(name, np.full(len(part.stamp_ns), np.nan))
                                         for part in parts]) for name in parts[0].values})


def drawn(time_s: Array, values: Array, bins: int) -> Array:
    """
    Return at most 2 * bins points (time, value), n x 2: of each bin its smallest and largest.

    So an oscillation that is faster than the points keeps its size.
    """
    known = ~np.isnan(values)
    points = np.column_stack([time_s[known], values[known]])
    size = -(-len(points) // bins)
    if size < 3:
        return points
    whole = len(points) // size * size
    blocks = points[:whole, 1].reshape(-1, size)
    starts = np.arange(0, whole, size)
    kept = np.sort(np.concatenate([starts + blocks.argmin(1), starts + blocks.argmax(1),
                                   np.arange(whole, len(points))]))
    shown: Array = points[kept]
    return shown
