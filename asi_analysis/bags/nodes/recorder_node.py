"""
The node `asi_recorder`: writes the topics of the loop to a bag, as they come from the wire.

In real time a message is logged at the time of its receipt. In lock-step, which it knows by
stamps far from the wall clock, at the time of its tick, and in an order of its own (see
`message_order`), so that the same experiment gives the same file; what nodes say of their loops on
/diagnostics goes by the wall clock, and only what they say of their states is kept.
"""

import json
import math
import struct
import sys
import time
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, Final

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from rclpy.task import Future
from rclpy.validate_topic_name import validate_topic_name

from asi_analysis.bags.bag_writer import RELIABLE, BagWriter, typestore
from asi_analysis.bags.nodes.message_order import (
    HOLD_S,
    OTHER_CLOCK_NS,
    Arrival,
    ReceiptOrder,
    TickOrder,
)
from asi_analysis.bags.qos import as_dictionary
from asi_analysis.errors import InputError
from asi_common.node.diagnostics import STATE
from asi_common.node.executor import RunError, run_node
from asi_common.node.topics import SteadyClock, message_class
from asi_common.parameter import ParameterError
from asi_common.topics import TOPICS

DIAGNOSTIC_ARRAY: Final = TOPICS['/diagnostics'].type
NODES: Final = {'actuator': 'asi_actuator', 'controller': 'asi_controller'}
# Often enough that little waits, seldom enough that one wake-up serves many messages.
DRAIN_PERIOD_S: Final = 0.01
LOOK_AROUND_PERIOD_S: Final = 0.2
# At the end: silence for so long means that nothing is on its way any more. A tick that lacks a
# message, which DDS would send again within 50 ms, is waited for so long.
FAREWELL_S: Final = 0.05
LAST_TICK_S: Final = 1.0
# What counts at most of the time between two looks at what has come: while this process or the
# whole machine stands still nothing can come, and nothing is missing.
LOOK_S: Final = 2.0 * DRAIN_PERIOD_S
# Messages of one topic that may wait: ten seconds of lock-step.
DEPTH: Final = 50_000


class _Polled(CallbackGroup):
    """Keeps the executor's hands off: waking for each message costs more than writing it."""

    def can_execute(self, entity: Any) -> bool:
        return False

    def beginning_execution(self, entity: Any) -> bool:
        return False

    def ending_execution(self, entity: Any) -> None:
        pass


class _Recorded:
    """One topic: its subscription, the place of the stamp, what was lost."""

    def __init__(self, node: Node, group: CallbackGroup, name: str, type_: str) -> None:
        self.message = message_class(type_)
        first = next(iter(self.message.get_fields_and_field_types().values()))
        self.stamped = first in ('std_msgs/Header', 'builtin_interfaces/Time')
        self.type = type_
        self.name = node.resolve_topic_name(name)
        self.channel: int | None = None
        self.offered = [RELIABLE]
        self.number = 0
        self.lost = 0
        self.one_publisher = True
        self.reliability = ReliabilityPolicy.RELIABLE
        self.subscription = self._subscription(node, group)

    def accept_best_effort(self, node: Node, group: CallbackGroup) -> None:
        """Subscribe again so that a best-effort publisher is heard too."""
        node.destroy_subscription(self.subscription)
        self.reliability = ReliabilityPolicy.BEST_EFFORT
        self.subscription = self._subscription(node, group)

    def _subscription(self, node: Node, group: CallbackGroup) -> Subscription:
        return node.create_subscription(
            self.message, self.name, _never,
            QoSProfile(depth=DEPTH, reliability=self.reliability), callback_group=group, raw=True)

    def take(self) -> tuple[bytes, dict[str, Any]] | None:
        """Return the next message that has come, and what DDS says of it."""
        return self.subscription.handle.take_message(self.message, True)

    def stamp(self, data: bytes) -> int | None:
        """Return the stamp (ns) of a message; None if its type has none."""
        if not self.stamped:
            return None
        seconds, nanoseconds = _STAMP[data[1]].unpack_from(data, 4)
        return seconds * 10**9 + nanoseconds

    def count(self, number: int | None) -> int:
        """Return the number of a message on its topic, and note a gap before it."""
        if number is None:      # this RMW does not number: then no gap can be seen
            number = self.number + 1
        if number <= self.number:
            self.one_publisher = False
        elif self.number:
            self.lost += number - self.number - 1
        self.number = number
        return number


# Byte 1 of CDR: 1 for little endian; a stamp, if any, follows the four bytes of this header.
_STAMP = {1: struct.Struct('<iI'), 0: struct.Struct('>iI')}


def _never(message: object) -> None:
    """Stand for the callback that rclpy wants; the topics are polled."""


class Recorder(Node):
    """The node; `destroy_node` finishes the bag. Raises InputError for what cannot be used."""

    def __init__(self) -> None:
        super().__init__('asi_recorder')
        output = self._text('output', datetime.now().strftime('asi_%Y_%m_%d-%H_%M_%S'),
                            'Directory of the bag, which must not exist')
        configuration = self._text(
            'configuration', '', 'JSON file with the configuration of the run, kept in the bag; '
            'empty: the parameters that the nodes report')
        of_the_loop = [topic.name for topic in TOPICS.values() if topic.publisher]
        names = self.declare_parameter('topics', of_the_loop, ParameterDescriptor(
            description='Topics to record', read_only=True)).value
        information = _configuration(configuration) if configuration else {}
        self.failed = False
        self._group = _Polled()
        self._topics: list[_Recorded] = []
        self._unknown: list[str] = []
        for name in names:
            if name in of_the_loop:
                self._topics.append(_Recorded(self, self._group, name, TOPICS[name].type))
            else:
                validate_topic_name(name)
                self._unknown.append(self.resolve_topic_name(name))
        self._writer = BagWriter(Path(output))
        if information:
            self._writer.add_information(information)
        # For how long this node has looked; when it saw the first message of the loop.
        self._looked_for_s, self._first_s = 0.0, math.inf
        self._last_look_s = time.monotonic()
        self._arrived: list[Arrival] = []
        self._order: ReceiptOrder | TickOrder | None = None
        self._even_clock = SteadyClock()
        self._state_name = f'{self.get_namespace()}/{NODES["actuator"]}'.lstrip('/') + STATE
        self._unasked = [] if configuration else [
            (name, AsyncParameterClient(self, node)) for name, node in NODES.items()]
        # Whatever use_sim_time says: a clock that stands still must not stop the recording.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(DRAIN_PERIOD_S, self._record, clock=steady)
        self.create_timer(LOOK_AROUND_PERIOD_S, self._look_around, clock=steady)
        self.get_logger().info(f'recording to {output}')

    def destroy_node(self) -> None:
        """Write what has come so far, and finish the bag."""
        if not self.failed:
            try:
                self._await_rest()
                self._write(final=True)
                self._writer.close()
                self._report()
            except OSError as error:
                self._fail(error)
        super().destroy_node()

    def _await_rest(self) -> None:
        """
        Take what was published before now: the recording ends here.

        In lock-step it ends with the last tick that has begun, whose answer is waited for unless
        nobody is left who could give it.
        """
        ended_ns = self._even_clock.now_ns()
        self._drain(ended_ns)
        self._write()
        if self._order:
            self._order.end()
        moment_s = self._looked_for_s + FAREWELL_S
        end_s = self._looked_for_s + LAST_TICK_S
        while self._looked_for_s < end_s and (
                self._looked_for_s < moment_s or self._answer_may_come()):
            time.sleep(DRAIN_PERIOD_S)
            known = len(self._arrived)   # and waiting to be written: the first tick has not come
            self._drain(ended_ns)
            # What others go on to publish does not count.
            if any(arrival.published_ns <= ended_ns for arrival in self._arrived[known:]):
                moment_s = self._looked_for_s + FAREWELL_S
            self._write()

    def _answer_may_come(self) -> bool:
        """Return whether a tick lacks a message whose topic still has a publisher."""
        return self._order is not None and any(
            self.count_publishers(self._topics[topic].name) for topic in self._order.lacking())

    def _text(self, name: str, default: str, description: str) -> str:
        return self.declare_parameter(name, default, ParameterDescriptor(
            description=description, read_only=True)).value

    def _record(self) -> None:
        """Write what has come since the last time."""
        try:
            self._drain()
            self._write()
            self._writer.flush()
        except OSError as error:
            self._fail(error)
            raise RunError('the recording has ended') from None

    def _drain(self, until_ns: float = math.inf) -> None:
        """Take what has come; of each topic, up to the first message published after a time."""
        now_s = time.monotonic()
        self._looked_for_s += min(now_s - self._last_look_s, LOOK_S)
        self._last_look_s = now_s
        # How far the wall clock was set since the start: log times go on evenly.
        set_ns = time.time_ns() - self._even_clock.now_ns()
        for index, topic in enumerate(self._topics):
            with topic.subscription.handle:
                while (taken := topic.take()) is not None:
                    data, info = taken
                    published_ns = info['source_timestamp'] - set_ns
                    self._arrived.append(Arrival(
                        index, topic.count(info['publication_sequence_number']),
                        topic.stamp(data),
                        # One from just before the clock was set back is not from the future.
                        min((info['received_timestamp'] or time.time_ns()) - set_ns,
                            self._even_clock.now_ns()),
                        published_ns, data))
                    if published_ns > until_ns:
                        break

    def _write(self, final: bool = False) -> None:
        """Write what has been taken, as far as its turn has come; everything, if `final`."""
        if self._order is None and self._arrived:
            self._order = self._choose_order(final)
        if self._order is None:
            return
        arrived, self._arrived = self._arrived, []
        if isinstance(self._order, TickOrder):
            arrived = [arrival for arrival in arrived if self._is_of_the_run(arrival)]
        for item in self._order.ready(arrived, math.inf if final else self._looked_for_s):
            topic = self._topics[item.topic]
            if topic.channel is None:
                self._look_at_publishers(topic)
                topic.channel = self._writer.add_topic(topic.name, topic.type, topic.offered)
            self._writer.write(topic.channel, item.log_ns, item.publish_ns, item.number,
                               item.data)

    def _is_of_the_run(self, arrival: Arrival) -> bool:
        """Return whether a message is the same in each run of an experiment in lock-step."""
        if self._topics[arrival.topic].type != DIAGNOSTIC_ARRAY:
            return True
        message = deserialize_message(arrival.data, DiagnosticArray)
        return [status.name for status in message.status] == [self._state_name]

    def _choose_order(self, final: bool) -> ReceiptOrder | TickOrder | None:
        """
        Tell real time from lock-step by the first stamp; None while there is none.

        That of /diagnostics does not count: before the first tick it is wall time in any mode.
        """
        arrived = [arrival for arrival in self._arrived
                   if self._topics[arrival.topic].type != DIAGNOSTIC_ARRAY]
        for arrival in arrived:
            self._first_s = min(self._first_s, self._looked_for_s)
            if arrival.stamp_ns:
                if abs(arrival.stamp_ns - arrival.received_ns) < OTHER_CLOCK_NS:
                    return ReceiptOrder()
                stamped = [i for i, topic in enumerate(self._topics) if topic.stamped]
                guides = [i for i in stamped
                          if self._topics[i].type == TOPICS['force'].type] or stamped
                unawaited = {i for i, topic in enumerate(self._topics)
                             if topic.type == DIAGNOSTIC_ARRAY}
                return TickOrder(len(self._topics), guides[0], unawaited)
        waited_s = self._looked_for_s - self._first_s
        return ReceiptOrder() if final or waited_s > HOLD_S else None

    def _look_at_publishers(self, topic: _Recorded) -> None:
        """Note the different QoS that are offered; those of the past, if nobody is left."""
        offered = [as_dictionary(publisher.qos_profile)
                   for publisher in self.get_publishers_info_by_topic(topic.name)]
        topic.offered = [profile for i, profile in enumerate(offered)
                         if profile not in offered[:i]] or topic.offered

    def _look_around(self) -> None:
        """Adapt to the publishers that there are now, and ask their nodes for parameters."""
        for topic in self._topics:
            self._look_at_publishers(topic)
            if (topic.reliability == ReliabilityPolicy.RELIABLE
                    and 'best_effort' in [each['reliability'] for each in topic.offered]):
                topic.accept_best_effort(self, self._group)
        types = dict(self.get_topic_names_and_types()) if self._unknown else {}
        for name in [name for name in self._unknown if name in types]:
            self._unknown.remove(name)
            if types[name][0] in typestore().fielddefs:
                self._topics.append(_Recorded(self, self._group, name, types[name][0]))
            else:
                self.get_logger().warning(f'{name} is not recorded: its type {types[name][0]} is '
                                          'not one of the common messages')
        for name, client in list(self._unasked):
            if client.services_are_ready():
                self._unasked.remove((name, client))
                client.list_parameters(callback=partial(self._ask, name, client))

    def _ask(self, name: str, client: AsyncParameterClient, listed: Future) -> None:
        names = listed.result().result.names
        client.get_parameters(names, callback=partial(self._keep, name, names))

    def _keep(self, node: str, names: list[str], values: Future) -> None:
        self._writer.add_information({node: {
            name: parameter_value_to_python(value)
            for name, value in zip(names, values.result().values, strict=True)}})

    def _fail(self, error: OSError) -> None:
        self.failed = True
        self._writer.abandon()
        self.get_logger().error(f'the bag cannot be written any more: {error.strerror}; what is '
                                'there can be read')

    def _report(self) -> None:
        """Say what was recorded, and what was lost on the way."""
        counts = self._writer.counts()
        self.get_logger().info('recorded ' + (', '.join(
            f'{count} {name}' for name, count in counts.items()) or 'nothing'))
        for name, count in self.lost().items():
            self.get_logger().error(f'{count} messages of {name} were lost')

    def lost(self) -> dict[str, int]:
        """Return how many messages of each topic were lost on the way, if it is known."""
        return {topic.name: topic.lost for topic in self._topics
                if topic.lost and topic.one_publisher}


def _configuration(path: str) -> dict[str, Any]:
    """Return what the file says. Raises InputError if it is no JSON object."""
    try:
        configuration = json.loads(Path(path).read_text())
    except (OSError, ValueError) as error:
        raise InputError(f'configuration = {path!r} cannot be used: {error}') from None
    if not isinstance(configuration, dict):
        raise InputError(f'configuration = {path!r} cannot be used: it must hold a JSON object')
    return configuration


def main() -> int:
    """Run the node until it is stopped; return the exit status."""
    nodes: list[Recorder] = []

    def make() -> Recorder:
        try:
            nodes.append(Recorder())
        except (InputError, ParameterException, NameValidationException) as error:
            raise ParameterError(' '.join(str(error).split())) from None
        return nodes[0]

    # Writing may also fail at the very end, after the node has been run.
    return run_node(make) or int(any(node.failed or node.lost() for node in nodes))


if __name__ == '__main__':
    sys.exit(main())
