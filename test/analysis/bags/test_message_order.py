"""`TickOrder`: the same messages give the same order, however they come."""

import math
import random
import struct

import pytest

from asi_analysis.bags.nodes.message_order import HOLD_S, Arrival, ReceiptOrder, TickOrder

STATE, FORCE, VALVE, REFERENCE, COMMAND = range(5)
PERIOD_NS = 200_000


def tick(number: int, *, resent: int = 0) -> list[Arrival]:
    """Return what comes of one tick; `resent` states before have shifted the state's numbers."""
    stamp = number * PERIOD_NS

    def arrival(topic: int, own: int, stamp_ns: int | None) -> Arrival:
        return Arrival(topic, own, stamp_ns, 0, 0, struct.pack('<iq', topic, number))

    return [arrival(STATE, number + resent, stamp), arrival(FORCE, number, stamp),
            Arrival(VALVE, number, None, 0, 0, b'the same each time'),
            arrival(REFERENCE, number, stamp), arrival(COMMAND, number, stamp)]


def sorted_by(order: TickOrder, arrivals: list[Arrival], batch: int) -> list[tuple]:
    """Return (topic, number, time) of what comes out when it goes in by batches, at no time."""
    items = []
    for start in range(0, len(arrivals), batch):
        items += order.ready(arrivals[start:start + batch], 0.0)
    items += order.ready([], math.inf)
    return [(item.topic, item.number, item.log_ns) for item in items]


@pytest.mark.parametrize('seed', range(5))
def test_any_interleaving_gives_the_same(seed: int) -> None:
    """Each topic in its own order, the topics against each other at random, in any batches."""
    rng = random.Random(seed)
    by_topic = list(zip(*[tick(k) for k in range(1, 400)], strict=True))
    queues = [list(messages) for messages in by_topic]
    arrivals = []
    while any(queues):
        # One topic runs far ahead now and then, as when DDS sends again what was lost.
        queue = rng.choice([queue for queue in queues if queue])
        for _ in range(min(len(queue), rng.choice([1, 3, 150]))):
            arrivals.append(queue.pop(0))
    expected = [(topic, k, k * PERIOD_NS) for k in range(1, 400) for topic in range(5)]
    assert sorted_by(TickOrder(5, FORCE), arrivals, rng.randint(1, 50)) == expected


def test_what_was_sent_again_is_written_once() -> None:
    first, second = tick(1), tick(2, resent=1)
    again = first[STATE]._replace(number=2)
    answer_again = first[COMMAND]._replace(number=2)
    arrivals = [*first, again, answer_again,
                *(a._replace(number=3) if a.topic == COMMAND else a for a in second)]
    assert sorted_by(TickOrder(5, FORCE), arrivals, 1) == [
        (topic, k, k * PERIOD_NS) for k in (1, 2) for topic in range(5)]


def test_a_silent_topic_does_not_hold_up_the_rest() -> None:
    order = TickOrder(5, FORCE)
    spoken = [a for k in range(1, 6) for a in tick(k) if a.topic != REFERENCE]
    assert order.ready(spoken, 10.0) == []
    assert order.ready([], 10.0 + 0.9 * HOLD_S) == []
    assert len(order.ready([], 10.0 + 1.1 * HOLD_S)) == len(spoken)


def test_the_first_tick_waits_for_its_answer() -> None:
    """A controller that is slow to start does not change the order in the bag."""
    order = TickOrder(5, FORCE)
    first = tick(1)
    assert order.ready([a for a in first if a.topic != REFERENCE], 10.0) == []
    assert order.ready([], 10.0 + 10 * HOLD_S) == []
    late = order.ready([a for a in first if a.topic == REFERENCE], 10.0 + 11 * HOLD_S)
    assert [item.topic for item in late] == [0, 1, 2, 3, 4]


def test_a_topic_that_spoke_every_tick_is_waited_for() -> None:
    order = TickOrder(5, FORCE)
    for k in range(1, 100):
        assert len(order.ready(tick(k), 0.0)) == 5
    late = tick(100)
    assert order.ready(late[:4], 0.0) == []
    assert order.ready([], 3.0 * HOLD_S) == []
    assert [item.topic for item in order.ready(late[4:], 3.0 * HOLD_S)] == [0, 1, 2, 3, 4]


def test_a_reference_of_another_clock_belongs_to_the_newest_tick() -> None:
    order = TickOrder(5, FORCE)
    users = [Arrival(REFERENCE, i + 1, stamp, 0, 0, b'%d' % stamp)
             for i, stamp in enumerate((0, 1_790_000_000 * 10**9))]
    own = [a for a in tick(7) if a.topic != REFERENCE]
    items = order.ready([*own, *users], math.inf)
    assert {item.log_ns for item in items} == {7 * PERIOD_NS}
    assert len(items) == 6


def test_real_time_is_the_order_of_receipt() -> None:
    arrivals = [Arrival(0, 1, 5, 30, 29, b'a'), Arrival(1, 1, None, 20, 19, b'b')]
    items = ReceiptOrder().ready(arrivals, 0.0)
    assert [(item.topic, item.log_ns, item.publish_ns) for item in items] == [
        (1, 20, 19), (0, 30, 29)]


def test_the_end_is_the_last_tick_that_has_begun_and_it_is_known_what_that_lacks() -> None:
    order = TickOrder(5, FORCE)
    begun = [a for k in range(1, 31) for a in tick(k)]
    missing = begun.pop()
    assert missing.topic == COMMAND
    # Of a tick after the last of the guide, or after the end, nothing is taken.
    written = order.ready([*begun, tick(31)[STATE]], 0.0)
    assert order.missing_topics() >= {COMMAND}
    order.end()
    assert order.missing_topics() == {COMMAND}
    written += order.ready([missing, *tick(31)[1:], *tick(32)], 0.0)
    assert order.missing_topics() == set()
    assert order.ready([], math.inf) == []
    written += order.ready([], math.inf)
    assert [(item.topic, item.log_ns) for item in written] == [
        (topic, k * PERIOD_NS) for k in range(1, 31) for topic in range(5)]
