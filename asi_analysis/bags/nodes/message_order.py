"""
Order and log times of recorded messages.

In real time: those of receipt. In lock-step every tick has a stamp k T, and its messages come from
two processes over several topics. They are held back until every topic has reached the tick, then
written tick by tick, with its stamp as log time, in the order of the topics. So two runs of the
same experiment give the same file, however their processes were scheduled.
"""

import heapq
import math
from collections import Counter, deque
from collections.abc import Iterable, Set
from typing import Final, NamedTuple

# A tick is held back this long (s) for a topic without a message; a killed recorder loses this
# much and one chunk.
HOLD_S: Final = 0.3
# The same for a topic with messages in most ticks: one was lost, and DDS sends it again after its
# heartbeat period (Fast DDS: 3 s, with our fastdds.xml 50 ms).
PATIENCE_S: Final = 5.0
FEW_TICKS: Final = 10
# Number of written ticks that are kept, to recognise late repetitions.
REMEMBERED: Final = 1000
# Stamps further apart than this (ns) are of different clocks.
OTHER_CLOCK_NS: Final = 3600 * 10**9


class Arrival(NamedTuple):
    """A received message: topic (index), number on its topic, times (ns), CDR bytes."""

    topic: int
    number: int
    stamp_ns: int | None    # None: its type has no stamp; 0: the stamp was not set
    received_ns: int
    published_ns: int
    data: bytes


class Item(NamedTuple):
    """A message to be written."""

    topic: int
    number: int
    log_ns: int
    publish_ns: int
    data: bytes


class ReceiptOrder:
    """Real time: messages in the order of receipt, with log times that never decrease."""

    def __init__(self) -> None:
        self._last_ns = 0

    def ready(self, arrivals: Iterable[Arrival], now_s: float) -> list[Item]:
        """Return the messages that can be written: all."""
        items = []
        for arrival in sorted(arrivals, key=lambda arrival: arrival.received_ns):
            self._last_ns = max(self._last_ns, arrival.received_ns)
            items.append(Item(arrival.topic, arrival.number, self._last_ns, arrival.published_ns,
                              arrival.data))
        return items


class _Tick(NamedTuple):
    arrived_s: float
    items: dict[tuple[int, bytes], Item]
    written: bool


class TickOrder:
    """
    Lock-step: messages tick by tick, without repetitions.

    topics: their number; time_base: index of the stamped topic that defines the ticks;
    not_awaited: topics for which no tick waits, as their messages come before the tick. Messages
    without a stamp belong to the tick of the message of `time_base` with the same number: the
    actuator publishes `force`, `valve_position` and `velocity` together, and repeats none of them.
    """

    def __init__(self, topics: int, time_base: int, not_awaited: Set[int] = frozenset()) -> None:
        self._time_base = time_base
        self._not_awaited = not_awaited
        self._stamps: dict[int, int] = {}       # of the messages of time_base, by number
        self._newest = 0
        self._latest = dict.fromkeys(range(topics), -1)
        self._repeated: Counter[int] = Counter()
        self._unplaced: list[tuple[float, Arrival]] = []
        self._ticks: dict[int, _Tick] = {}
        self._order: list[int] = []             # stamps of the ticks not written, a heap
        self._done: deque[int] = deque()
        self._late: list[Item] = []
        self._ticks_with: Counter[int] = Counter()  # ticks with a message, by topic
        self._written = 0                       # number of written ticks
        self._end: float = math.inf             # stamp of the last tick to write

    def ready(self, arrivals: Iterable[Arrival], now_s: float) -> list[Item]:
        """
        Add received messages; return, in order, those of the ticks that are complete.

        now_s: time on any clock, s; infinite: return everything.
        """
        waiting, self._unplaced = self._unplaced, []
        for arrival in arrivals:
            self._add(arrival, now_s, now_s)
        for arrived_s, arrival in waiting:
            self._add(arrival, arrived_s, now_s)
        items, self._late = self._late, []
        while self._order and self._can_be_written(self._order[0], now_s):
            items += self._release(heapq.heappop(self._order))
        self._forget()
        return items

    def _forget(self) -> None:
        """Delete the oldest written ticks."""
        while len(self._done) > REMEMBERED:
            stamp = self._done.popleft()
            del self._ticks[stamp]
            while self._stamps and next(iter(self._stamps.values())) <= stamp:
                del self._stamps[next(iter(self._stamps))]

    def end(self) -> None:
        """End the recording with the newest tick: later messages are dropped."""
        self._end = self._newest
        self._order = [stamp for stamp in self._order if stamp <= self._end]  # still a heap

    def drop_held_back(self) -> None:
        """End the recording with the last tick that was written: what waits is dropped."""
        self._order, self._unplaced = [], []

    def missing_topics(self) -> set[int]:
        """Return the topics whose message is missing in a tick that is held back."""
        last = max(self._order, default=-1)
        return {topic for topic, latest in self._latest.items()
                if latest < last and topic not in self._not_awaited}

    def _can_be_written(self, stamp: int, now_s: float) -> bool:
        """Return whether a tick is complete, or has waited long enough for missing messages."""
        awaited = [topic for topic, latest in self._latest.items()
                  if latest < stamp and topic not in self._not_awaited]
        age_s = now_s - self._ticks[stamp].arrived_s
        regular = [topic for topic in awaited
                   if self._ticks_with[topic] > max(FEW_TICKS, self._written / 2)]
        if age_s > PATIENCE_S:
            for topic in regular:
                self._ticks_with[topic] = 0
            return True
        # Until there is a second tick, the loop still waits for the answer to the first.
        begun = self._written or stamp < self._newest
        return not awaited or bool(begun and age_s > HOLD_S and not regular)

    def _release(self, stamp: int) -> list[Item]:
        """Mark a tick as written, and return its messages in the order of the topics."""
        tick = self._ticks[stamp]
        self._ticks[stamp] = tick._replace(written=True)
        self._done.append(stamp)
        self._written += 1
        items = sorted(tick.items.values(), key=lambda item: item.topic)
        self._ticks_with.update({item.topic for item in items})
        return items

    def _add(self, arrival: Arrival, arrived_s: float, now_s: float) -> None:
        """Add a message to its tick, or keep it until its tick is known."""
        stamp = arrival.stamp_ns
        if stamp is None:
            self._add_unstamped(arrival, arrived_s, now_s)
            return
        if arrival.topic == self._time_base:
            if stamp > self._end:
                return
            self._stamps[arrival.number] = stamp
            self._newest = max(self._newest, stamp)
        elif not stamp or abs(stamp - self._newest) > OTHER_CLOCK_NS:
            if not self._newest and now_s - arrived_s <= PATIENCE_S:
                self._unplaced.append((arrived_s, arrival))
                return
            stamp = self._newest
        self._place(arrival, stamp, now_s)

    def _add_unstamped(self, arrival: Arrival, arrived_s: float, now_s: float) -> None:
        stamp = self._stamps.get(arrival.number)
        ended = self._end < math.inf
        if stamp is None and ended and arrival.number > max(self._stamps, default=0):
            return
        if stamp is None and now_s - arrived_s > PATIENCE_S:
            stamp = self._newest
        if stamp is None:
            self._unplaced.append((arrived_s, arrival))
        else:
            self._place(arrival, stamp, now_s)

    def _place(self, arrival: Arrival, stamp: int, now_s: float) -> None:
        """Add a message to the tick of a stamp, unless it is a repetition."""
        topic = arrival.topic
        if stamp > self._end and topic not in self._not_awaited:
            return
        self._latest[topic] = max(self._latest.get(topic, -1), stamp)
        tick = self._ticks.get(stamp)
        if tick is None:
            tick = self._ticks[stamp] = _Tick(now_s, {}, False)
            heapq.heappush(self._order, stamp)
        if (topic, arrival.data) in tick.items:
            self._repeated[topic] += 1
            return
        item = Item(topic, arrival.number - self._repeated[topic], stamp, stamp, arrival.data)
        tick.items[topic, arrival.data] = item
        if tick.written:
            self._late.append(item)
