"""
Reference for the loop: two nodes that exchange the messages of the loop and do nothing else.

`python bench/empty_nodes.py controller …` answers every state. `… actuator` sends the next state
at each answer, or with --rate at each tick of a timer, and prints as JSON how often, how evenly,
and how long an answer takes.
"""

import argparse
import json
import os
import time
from typing import Any, Final

import numpy as np
import rclpy
from geometry_msgs.msg import WrenchStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64

from asi_common.node.executor import LoopExecutor, choose_transport
from asi_common.node.topics import CONTROL_QOS, STREAM_QOS
from asi_common.topics import FRAME, JOINTS

# Topics that each node sends: none, one, those for which the loop waits, all.
SENT: Final = {
    'none': ((), ()),
    'one': (('joint_states',), ('valve_command',)),
    'three': (('joint_states', '/clock'), ('valve_command',)),
    'all': (('joint_states', '/clock', 'force', 'valve_position', 'velocity'),
            ('force_reference', 'valve_command')),
}
WARM_UP_S: Final = 1.0


class Finished(Exception):  # noqa: N818
    """The measurement is over."""


def messages() -> dict[str, Any]:
    """Return messages as large as those of the loop, by topic."""
    found = {'joint_states': JointState(name=list(JOINTS), position=[0.0, 0.0],
                                        velocity=[0.0, 0.0], effort=[0.0, 0.0]),
             '/clock': Clock(), 'force': WrenchStamped(), 'valve_position': Float64(),
             'velocity': Float64(), 'force_reference': WrenchStamped(),
             'valve_command': WrenchStamped()}
    for message in found.values():
        if hasattr(message, 'header'):
            message.header.frame_id = FRAME
    return found


class Empty(Node):
    """Sends messages on request: objects, or bytes that were serialised before."""

    def __init__(self, name: str, sent: tuple[str, ...], serialised: bool):
        super().__init__(name)
        self.serialised = serialised
        self._sent = [
            (self.create_publisher(type(message), topic, STREAM_QOS),
             serialize_message(message) if serialised else message)
            for topic, message in messages().items() if topic in sent]
        self._heard: list[Any] = []

    def hear(self, topic: str, callback: Any) -> None:
        """Call back with each message of a topic."""
        self._heard.append(self.create_subscription(
            type(messages()[topic]), topic, callback, CONTROL_QOS, raw=self.serialised))

    def all_there(self) -> bool:
        """Return whether the first topic has a subscription and every subscription a publisher."""
        return (all(p.get_subscription_count() for p, _ in self._sent[:1])
                and all(s.get_publisher_count() for s in self._heard))

    def send(self) -> None:
        """Publish every message."""
        for publisher, message in self._sent:
            publisher.publish(message)


class Controller(Empty):
    """Answers when all topics that it waits for have arrived."""

    def __init__(self, arguments: argparse.Namespace):
        super().__init__('empty_controller', SENT[arguments.messages][1], arguments.serialised)
        awaited = [topic for topic in SENT[arguments.messages][0]
                   if topic in ('joint_states', '/clock')]
        self._come, self._needed = 0, len(awaited)
        for topic in awaited:
            self.hear(topic, self._take)

    def _take(self, _: object) -> None:
        self._come += 1
        if self._come == self._needed:
            self._come = 0
            self.send()


class Actuator(Empty):
    """Sends states one after the other, and measures the times."""

    def __init__(self, arguments: argparse.Namespace):
        super().__init__('empty_actuator', SENT[arguments.messages][0], arguments.serialised)
        self._seconds = arguments.seconds
        self._sent_s: list[float] = []
        self._latencies_s: list[float] = []
        self._lockstep = not arguments.rate
        self._end_s = 0.0
        for topic in SENT[arguments.messages][1][-1:]:
            self.hear(topic, self._answered)
        if arguments.rate:
            self.create_timer(1.0 / arguments.rate, self._tick)
        self.create_timer(0.1, self._watch)

    def _watch(self) -> None:
        now_s = time.perf_counter()
        if not self._end_s and self.all_there():
            self._end_s = now_s + WARM_UP_S + self._seconds
            if self._lockstep:
                self._next()
        elif self._end_s and now_s > self._end_s:
            raise Finished

    def _tick(self) -> None:
        if self._end_s:
            self._next()

    def _answered(self, _: object) -> None:
        self._latencies_s.append(time.perf_counter() - self._sent_s[-1])
        if self._lockstep:
            self._next()

    def _next(self) -> None:
        self._sent_s.append(time.perf_counter())
        self.send()

    def results(self) -> dict[str, float]:
        """Return what was measured after the warm-up."""
        sent_s = np.array(self._sent_s)
        sent_s = sent_s[sent_s > self._end_s - self._seconds]
        periods_ms = np.diff(sent_s) * 1e3
        latencies_ms = np.array(self._latencies_s[-len(sent_s):]) * 1e3
        jitter_ms = abs(periods_ms - np.median(periods_ms))
        return {'rate_hz': 1e3 / periods_ms.mean(),
                'period_median_ms': float(np.median(periods_ms)),
                'jitter_p99_ms': float(np.quantile(jitter_ms, 0.99)),
                **({'latency_median_ms': float(np.median(latencies_ms)),
                    'latency_p99_ms': float(np.quantile(latencies_ms, 0.99))}
                   if latencies_ms.size else {})}


def main() -> None:
    """Run one node until it has measured, or is killed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('end', choices=('actuator', 'controller'))
    parser.add_argument('--messages', choices=SENT, default='all')
    parser.add_argument('--serialised', action='store_true')
    parser.add_argument('--our-executor', action='store_true')
    parser.add_argument('--rate', type=float, default=0.0, help='Hz; 0: as fast as it goes')
    parser.add_argument('--seconds', type=float, default=3.0)
    arguments = parser.parse_args()
    if arguments.our_executor:
        choose_transport(os.environ, rclpy.get_rmw_implementation_identifier())
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = {'actuator': Actuator, 'controller': Controller}[arguments.end](arguments)
    executor = (LoopExecutor if arguments.our_executor else SingleThreadedExecutor)()
    executor.add_node(node)
    try:
        executor.spin()
    except Finished:
        pass
    if isinstance(node, Actuator):
        print(json.dumps(node.results()))


if __name__ == '__main__':
    main()
