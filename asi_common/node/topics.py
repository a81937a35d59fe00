"""
Publishers and subscriptions of the topics that `asi_common/topics.py` lists; clocks, stamps.

The QoS of each can be overridden by parameters, as ROS 2 names them:
qos_overrides./TOPIC.publisher.depth, or .subscription; history, depth, reliability.
"""

import time
from collections.abc import Callable
from importlib import import_module
from typing import Any, Final

from builtin_interfaces.msg import Time
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

from asi_common.node.priority import in_real_time
from asi_common.parameter import Parameter, ParameterError
from asi_common.topics import REALTIME_DEPTH, STREAM_DEPTH, TOPICS

# A loop needs only the newest message.
CONTROL_QOS: Final = QoSProfile(depth=10)
STREAM_QOS: Final = QoSProfile(depth=STREAM_DEPTH)
QOS_OVERRIDES: Final = 'qos_overrides.'
QOS_POLICIES: Final = {policy.name: policy for policy in (
    Parameter('history', 'keep_last', '', '', choices=('keep_last', 'keep_all')),
    Parameter('depth', 10, '', '', 1, 1_000_000),
    Parameter('reliability', 'reliable', '', '', choices=('reliable', 'best_effort')))}


class SteadyClock:
    """
    A clock that begins with the wall clock and never jumps.

    In a loop in real time, setting the wall clock (NTP at start-up, by hand) must neither make a
    command look old nor bring a recording out of order.
    """

    def __init__(self) -> None:
        self._offset_ns = time.time_ns() - time.monotonic_ns()

    def now_ns(self) -> int:
        """Return the time, ns."""
        return time.monotonic_ns() + self._offset_ns


def create_publisher(node: Node, name: str) -> Publisher:
    """Return a publisher of one of the `TOPICS`, with its type and QoS."""
    topic = TOPICS[name]
    depth = min(topic.depth, REALTIME_DEPTH) if in_real_time(node) else topic.depth
    return node.create_publisher(
        message_class(topic.type), name, QoSProfile(depth=depth),
        qos_overriding_options=QoSOverridingOptions.with_default_policies())


def create_subscription(node: Node, name: str, callback: Callable[[bytes], None]) -> Subscription:
    """Return a subscription of the loop to one of the `TOPICS`; the callback gets CDR bytes."""
    return node.create_subscription(
        message_class(TOPICS[name].type), name, callback, QoSProfile(depth=CONTROL_QOS.depth),
        raw=True, qos_overriding_options=QoSOverridingOptions.with_default_policies())


def check_qos_override(node: Node, name: str, value: object) -> None:
    """Raise ParameterError if a parameter `qos_overrides.…` is unknown or not allowed."""
    topic, _, rest = name.removeprefix(QOS_OVERRIDES).partition('.')
    kind, _, policy = rest.partition('.')
    topics = [node.resolve_topic_name(each) for each in TOPICS]
    for what, given, known in (('topic', topic, topics),
                               ('end', kind, ('publisher', 'subscription')),
                               ('policy', policy, tuple(QOS_POLICIES))):
        if given not in known:
            raise ParameterError(f'{name}: the {what} {given!r} is not one of {", ".join(known)}')
    if problem := QOS_POLICIES[policy]._replace(name=name).problem(value):
        raise ParameterError(problem)


def message_class(type_: str) -> Any:
    """
    Return the class of a message type, as std_msgs/msg/Float64, found by ROS's convention.

    Raises ImportError, AttributeError or ValueError if there is none.
    """
    package, _, kind = type_.split('/')
    return getattr(import_module(f'{package}.msg'), kind)


def nanoseconds(stamp: Time) -> int:
    """Return a stamp in nanoseconds."""
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def set_time(stamp: Time, stamp_ns: int) -> None:
    """Put nanoseconds into a stamp."""
    stamp.sec, stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
