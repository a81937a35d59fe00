"""
The node `asi_recorder`: writes the topics of the loop to a bag, as they come from the wire.

In real time the log time of a message is that of its receipt. In lock-step, recognised by stamps
far from the wall clock, it is the time of its tick, and messages are put in order
(`message_order`), so that the same experiment gives the same file. Of /diagnostics only the
changes of state are then recorded: the rest depends on the wall clock.
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
from asi_common.loop_parameters import LOOP_PARAMETERS
from asi_common.node.diagnostics import STATE
from asi_common.node.executor import Polled, RunError, run_node
from asi_common.node.ros_parameters import OF_EVERY_NODE, take_overrides
from asi_common.node.topics import SteadyClock, message_class
from asi_common.parameter import Parameter, ParameterError, completed
from asi_common.topics import TOPICS

DIAGNOSTIC_ARRAY: Final = TOPICS['/diagnostics'].type
NODES: Final = {'actuator': 'asi_actuator', 'controller': 'asi_controller'}
# Topics that a loop always has.
ALWAYS: Final = [name for name, topic in TOPICS.items() if topic.publisher in NODES]
PARAMETERS: Final = ('output', 'configuration', 'topics')
# Short enough that few messages wait, long enough that one wake-up takes many.
DRAIN_PERIOD_S: Final = 0.01
DISCOVERY_PERIOD_S: Final = 0.2
# In lock-step at most so many messages of each topic are taken in one poll: behind a backlog of
# seconds, on a busy machine, Ctrl-C and the answers of the nodes would wait.
MOST_TAKEN: Final = 200
# At the end: without a message for QUIET_S, none is in flight any more. LAST_TICK_S: longest wait
# for a tick with a missing message, which DDS sends again within 50 ms. BACKLOG_S: longest time to
# take what has come until then, beside a loop that runs on.
QUIET_S: Final = 0.05
LAST_TICK_S: Final = 1.0
BACKLOG_S: Final = 0.5
# The time between two polls counts at most this much: while this process or the machine stands
# still, no message can arrive, so none is late.
LONGEST_POLL_S: Final = 2.0 * DRAIN_PERIOD_S
# History of a subscription: ten seconds of lock-step.
DEPTH: Final = 50_000


class _Recorded:
    """One recorded topic: its subscription, its stamps, its lost messages."""

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
        self.one_publisher = name not in TOPICS or TOPICS[name].publisher != 'both'
        self._publishers = node.count_publishers
        self.reliability = ReliabilityPolicy.RELIABLE
        self.subscription = self._subscription(node, group)

    def accept_best_effort(self, node: Node, group: CallbackGroup) -> None:
        """Subscribe again so that best-effort publishers match too."""
        node.destroy_subscription(self.subscription)
        self.reliability = ReliabilityPolicy.BEST_EFFORT
        self.subscription = self._subscription(node, group)

    def _subscription(self, node: Node, group: CallbackGroup) -> Subscription:
        return node.create_subscription(
            self.message, self.name, _unused_callback,
            QoSProfile(depth=DEPTH, reliability=self.reliability), callback_group=group, raw=True)

    def take(self) -> tuple[bytes, dict[str, Any]] | None:
        """Return the next received message and its DDS information; None if there is none."""
        return self.subscription.handle.take_message(self.message, True)

    def stamp(self, data: bytes) -> int | None:
        """Return the stamp (ns) of a message; None if its type has none."""
        if not self.stamped:
            return None
        seconds, nanoseconds = _STAMP[data[1]].unpack_from(data, 4)
        return seconds * 10**9 + nanoseconds

    def count(self, number: int | None) -> int:
        """Return the number of a message on its topic, and note a gap before it."""
        if number is None:      # this RMW has no sequence numbers: losses are not detected
            number = self.number + 1
        # Each publisher has its own numbers, so those of two publishers show no gap.
        gap = number - self.number - 1
        if gap < 0 or (gap and self.number and self._publishers(self.name) > 1):
            self.one_publisher = False
        elif self.number:
            self.lost += gap
        self.number = number
        return number


# Byte 1 of CDR: 1 for little endian. A stamp follows the four bytes of this header.
_STAMP = {1: struct.Struct('<iI'), 0: struct.Struct('>iI')}


def _unused_callback(message: object) -> None:
    """Serve as the callback that rclpy requires; the topics are polled."""


class Recorder(Node):
    """The node; `destroy_node` finishes the bag. Raises InputError for a wrong parameter."""

    def __init__(self) -> None:
        super().__init__('asi_recorder', automatically_declare_parameters_from_overrides=True)
        given = take_overrides(self)
        output = self._parameter('output', datetime.now().strftime('asi_%Y_%m_%d-%H_%M_%S'),
                            'Directory of the bag, which must not exist')
        configuration = self._parameter(
            'configuration', '', 'JSON file with the configuration of the run, kept in the bag; '
            'empty: the parameters that the nodes report')
        of_the_loop = [topic.name for topic in TOPICS.values() if topic.publisher]
        names = self._parameter('topics', of_the_loop, 'Topics to record')
        # A file for all nodes may have what the loop shares.
        completed({name: each.value for name, each in given.items() if name not in PARAMETERS},
                  (*LOOP_PARAMETERS, *(Parameter(name, '', '', '') for name in PARAMETERS)))
        information = _configuration(configuration) if configuration else {}
        self.failed = False
        self._group = Polled()
        self._topics: list[_Recorded] = []
        self._unknown: list[str] = []
        for name in names:
            if name in of_the_loop:
                self._topics.append(_Recorded(self, self._group, name, TOPICS[name].type))
            else:
                validate_topic_name(name)
                self._unknown.append(self.resolve_topic_name(name))
        self._writer = BagWriter(Path(output))
        typestore()   # now, as its first call takes longer than a tick
        if information:
            self._writer.add_information(information)
        # Time spent polling, s; its value at the first message of the loop.
        self._polled_s, self._first_s = 0.0, math.inf
        self._last_poll_s = time.monotonic()
        self._taken_ns = 0   # when the last message that was taken was published
        self._arrived: list[Arrival] = []
        self._order: ReceiptOrder | TickOrder | None = None
        self._steady_clock = SteadyClock()
        self._state_name = f'{self.get_namespace()}/{NODES["actuator"]}'.lstrip('/') + STATE
        self._pending_clients = [] if configuration else [
            (name, AsyncParameterClient(self, node)) for name, node in NODES.items()]
        self._unreported = [name for name, _ in self._pending_clients]
        # Not ROS time: under use_sim_time a stopped /clock would stop the recording.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(DRAIN_PERIOD_S, self._record, clock=steady)
        self.create_timer(DISCOVERY_PERIOD_S, self._discover, clock=steady)
        self.get_logger().info(f'recording to {output}')

    def destroy_node(self) -> None:
        """Write the messages received so far, and finish the bag."""
        if not self.failed:
            try:
                self._finish_in_flight()
                self._write(final=True)
                self._writer.close()
                self._report()
            except OSError as error:
                self._fail(error)
        super().destroy_node()

    def _finish_in_flight(self) -> None:
        """
        Receive what was published before now: the recording ends here.

        In lock-step it ends with the tick that has begun; its missing messages are waited for as
        long as their topics have publishers. Beside a loop that runs on it ends earlier if this
        machine is too busy to take all of them in time.
        """
        ended_ns = self._steady_clock.now_ns()
        end_by_s = time.monotonic() + BACKLOG_S
        while self._drain(ended_ns):
            self._write()
            if self._too_late(end_by_s):
                self._end_early(ended_ns)
                return
        self._write()
        if isinstance(self._order, TickOrder):
            self._order.end()
        moment_s = self._polled_s + QUIET_S
        end_s = self._polled_s + LAST_TICK_S
        while self._polled_s < end_s and (
                self._polled_s < moment_s
                or (self._answer_may_come() and not self._too_late(end_by_s))):
            time.sleep(DRAIN_PERIOD_S)
            known = len(self._arrived)   # received, but not written before the first tick
            self._drain(ended_ns)
            # Messages published after the end do not count.
            if any(arrival.published_ns <= ended_ns for arrival in self._arrived[known:]):
                moment_s = self._polled_s + QUIET_S
            self._write()

    def _too_late(self, end_by_s: float) -> bool:
        """Return whether the time is over, and the loop runs on: an actuator is still there."""
        return time.monotonic() > end_by_s and any(
            self.count_publishers(topic.name) for topic in self._topics
            if topic.type == TOPICS['joint_states'].type)

    def _end_early(self, ended_ns: int) -> None:
        """End the recording with what has been taken, in lock-step with the last whole tick."""
        if isinstance(self._order, TickOrder):
            self._order.drop_held_back()
        self.get_logger().warning(
            f'the recording ends {(ended_ns - self._taken_ns) / 1e9:.2g} s before it was stopped: '
            'this machine was too busy to record what came then')

    def _answer_may_come(self) -> bool:
        """Return whether a missing message of a tick has a publisher that may still send it."""
        return isinstance(self._order, TickOrder) and any(
            self.count_publishers(self._topics[topic].name)
            for topic in self._order.missing_topics())

    def _parameter(self, name: str, default: Any, description: str) -> Any:
        return self.declare_parameter(name, default, ParameterDescriptor(
            description=description, read_only=True)).value

    def _record(self) -> None:
        """Receive and write messages."""
        try:
            self._drain()
            self._write()
            self._writer.flush()
        except OSError as error:
            self._fail(error)
            raise RunError('the recording has ended') from None

    def _drain(self, until_ns: float = math.inf) -> bool:
        """
        Receive messages; of each topic, up to the first one published after `until_ns`.

        Return whether there may be more: in lock-step at most MOST_TAKEN of each topic are taken.
        In real time it is all of them, as they are put in the order of receipt.
        """
        now_s = time.monotonic()
        self._polled_s += min(now_s - self._last_poll_s, LONGEST_POLL_S)
        self._last_poll_s = now_s
        # By how much the wall clock was set since the start; log times follow the steady clock.
        set_ns = time.time_ns() - self._steady_clock.now_ns()
        most, more = MOST_TAKEN if isinstance(self._order, TickOrder) else sys.maxsize, False
        for index, topic in enumerate(self._topics):
            with topic.subscription.handle:
                for _ in range(most):
                    if (taken := topic.take()) is None:
                        break
                    data, info = taken
                    published_ns = info['source_timestamp'] - set_ns
                    self._arrived.append(Arrival(
                        index, topic.count(info['publication_sequence_number']),
                        topic.stamp(data),
                        # Received just before the clock was set back: limited to the present.
                        min((info['received_timestamp'] or time.time_ns()) - set_ns,
                            self._steady_clock.now_ns()),
                        published_ns, data))
                    if published_ns > until_ns:
                        break
                    self._taken_ns = published_ns
                else:
                    more = True
        return more

    def _write(self, final: bool = False) -> None:
        """Write the messages whose order is known; all of them if `final`."""
        if self._order is None and self._arrived:
            self._order = self._choose_order(final)
        if self._order is None:
            return
        arrived, self._arrived = self._arrived, []
        if isinstance(self._order, TickOrder):
            arrived = [arrival for arrival in arrived if self._is_repeatable(arrival)]
        for item in self._order.ready(arrived, math.inf if final else self._polled_s):
            topic = self._topics[item.topic]
            if topic.channel is None:
                self._update_offered_qos(topic)
                topic.channel = self._writer.add_topic(topic.name, topic.type, topic.offered)
            self._writer.write(topic.channel, item.log_ns, item.publish_ns, item.number,
                               item.data)

    def _is_repeatable(self, arrival: Arrival) -> bool:
        """Return whether a message is the same each time an experiment is run in lock-step."""
        if self._topics[arrival.topic].type != DIAGNOSTIC_ARRAY:
            return True
        message = deserialize_message(arrival.data, DiagnosticArray)
        return [status.name for status in message.status] == [self._state_name]

    def _choose_order(self, final: bool) -> ReceiptOrder | TickOrder | None:
        """
        Return the order for real time or lock-step by the first stamp; None without a stamp.

        /diagnostics does not count: before the first tick its stamp is wall time in any mode.
        """
        arrived = [arrival for arrival in self._arrived
                   if self._topics[arrival.topic].type != DIAGNOSTIC_ARRAY]
        for arrival in arrived:
            self._first_s = min(self._first_s, self._polled_s)
            if arrival.stamp_ns:
                if abs(arrival.stamp_ns - arrival.received_ns) < OTHER_CLOCK_NS:
                    return ReceiptOrder()
                stamped = [i for i, topic in enumerate(self._topics) if topic.stamped]
                guides = [i for i in stamped
                          if self._topics[i].type == TOPICS['force'].type] or stamped
                not_awaited = {i for i, topic in enumerate(self._topics)
                             if topic.type == DIAGNOSTIC_ARRAY}
                return TickOrder(len(self._topics), guides[0], not_awaited)
        waited_s = self._polled_s - self._first_s
        return ReceiptOrder() if final or waited_s > HOLD_S else None

    def _update_offered_qos(self, topic: _Recorded) -> None:
        """Store the different QoS of the publishers; without publishers the last known ones."""
        offered = [as_dictionary(publisher.qos_profile)
                   for publisher in self.get_publishers_info_by_topic(topic.name)]
        topic.offered = [profile for i, profile in enumerate(offered)
                         if profile not in offered[:i]] or topic.offered

    def _discover(self) -> None:
        """Adapt to the present publishers, and request the parameters of their nodes."""
        for topic in self._topics:
            self._update_offered_qos(topic)
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
        for name, client in list(self._pending_clients):
            if client.services_are_ready():
                self._pending_clients.remove((name, client))
                client.list_parameters(callback=partial(self._request_parameters, name, client))

    def _request_parameters(self, name: str, client: AsyncParameterClient, listed: Future) -> None:
        names = [name for name in listed.result().result.names
                 if not name.startswith(OF_EVERY_NODE)]
        client.get_parameters(names, callback=partial(self._store_parameters, name, names))

    def _store_parameters(self, node: str, names: list[str], values: Future) -> None:
        self._writer.add_information({node: {
            name: parameter_value_to_python(value)
            for name, value in zip(names, values.result().values, strict=True)}})
        self._unreported.remove(node)

    def _fail(self, error: OSError) -> None:
        self.failed = True
        self._writer.abandon()
        self.get_logger().error(f'the bag cannot be written any more: {error.strerror}; the part '
                                'that is written can be read')

    def _report(self) -> None:
        """Log the numbers of recorded and lost messages, and what is not in the bag."""
        counts = self._writer.counts()
        self.get_logger().info('recorded ' + (', '.join(
            f'{count} {name}' for name, count in counts.items()) or 'nothing'))
        for name, count in self.lost().items():
            self.get_logger().error(f'{count} messages of {name} were lost')
        silent = [topic.name for topic in self._topics if topic.name not in counts
                  and topic.name in map(self.resolve_topic_name, ALWAYS)]
        for published, reason in ((True, 'although there is a publisher'),
                                  (False, 'no publisher is there now: was it remapped?')):
            names = [name for name in silent if bool(self.count_publishers(name)) == published]
            if counts and names:
                self.get_logger().warning(f'nothing came on {", ".join(names)}, {reason}')
        for node in self._unreported:
            if any(row.publisher.startswith(node) and self.resolve_topic_name(row.name) in counts
                   for row in TOPICS.values()):
                self.get_logger().warning(f'the parameters of {NODES[node]} are not in the bag: '
                                          'they were not reported before the end of the recording')

    def lost(self) -> dict[str, int]:
        """Return the number of lost messages by topic, where there are any and it is known."""
        return {topic.name: topic.lost for topic in self._topics
                if topic.lost and topic.one_publisher}


def _configuration(path: str) -> dict[str, Any]:
    """Return the contents of the file. Raises InputError if it is no JSON object."""
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

    # Writing may also fail while the bag is finished, after the node has been run.
    return run_node(make, at_once=False) or int(any(node.failed or node.lost() for node in nodes))


if __name__ == '__main__':
    sys.exit(main())
