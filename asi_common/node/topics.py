"""Publishers and subscriptions of the topics with their QoS; clocks and time stamps."""

import time
from collections.abc import Callable
from importlib import import_module
from typing import Any, Final

from builtin_interfaces.msg import Time
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

from asi_common.topics import STREAM_DEPTH, TOPICS

# A loop wants the newest message.
CONTROL_QOS: Final = QoSProfile(depth=10)
STREAM_QOS: Final = QoSProfile(depth=STREAM_DEPTH)


class SteadyClock:
    """
    The wall clock as it was when this was made, going on evenly from there.

    In a loop in real time a clock that is set (by NTP at start-up, by hand) must neither look like
    a command from the past nor bring a recording out of its order.
    """

    def __init__(self) -> None:
        self._offset_ns = time.time_ns() - time.monotonic_ns()

    def now_ns(self) -> int:
        """Return the time, ns."""
        return time.monotonic_ns() + self._offset_ns


def create_publisher(node: Node, name: str) -> Publisher:
    """Return a publisher of one of the `TOPICS`, with its type and QoS."""
    topic = TOPICS[name]
    return node.create_publisher(message_class(topic.type), name, QoSProfile(depth=topic.depth))


def create_subscription(node: Node, name: str, callback: Callable[[bytes], None]) -> Subscription:
    """Return a subscription of the loop to one of the `TOPICS`; the callback gets CDR bytes."""
    return node.create_subscription(message_class(TOPICS[name].type), name, callback,
                                    CONTROL_QOS, raw=True)


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
