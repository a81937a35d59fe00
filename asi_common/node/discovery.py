"""Whether a recorder has subscribed to a node's topics, so that a bag begins with the run."""

import time
from collections.abc import Iterable
from typing import Final

from rclpy.node import Node
from rclpy.publisher import Publisher

from asi_common.node.executor import RunError

# After waiting so long (s), the recorder has ended or was never started.
RECORDER_S: Final = 120.0
RECORDER: Final = 'asi_recorder'


class AwaitedRecorder:
    """Delays a node until a recorder has its topics (parameter `await_recorder`)."""

    def __init__(self, node: Node, awaited: bool):
        self._node = node
        self._awaited = awaited
        self._since_s: float | None = None

    def missing(self, publishers: Iterable[Publisher]) -> list[str]:
        """Return the topics without a recorder so far; raises RunError after RECORDER_S."""
        names = not_recorded(self._node, publishers) if self._awaited else []
        now_s = time.monotonic()
        if not names:
            self._since_s = None
        elif self._since_s is None:
            self._since_s = now_s
        elif now_s - self._since_s > RECORDER_S:
            raise RunError(f'await_recorder is true, but no {RECORDER} has subscribed to '
                           f'{", ".join(names)} within {RECORDER_S:g} s: has it ended?')
        return names


def not_recorded(node: Node, publishers: Iterable[Publisher]) -> list[str]:
    """
    Return the topics to which no recorder has subscribed yet.

    As seen by the publisher: once matched, a reliable publisher keeps its messages until the
    recorder has received them.
    """
    return [publisher.topic_name for publisher in publishers if not _recorded(node, publisher)]


def _recorded(node: Node, publisher: Publisher) -> bool:
    known = node.get_subscriptions_info_by_topic(publisher.topic_name)
    return (any(info.node_name == RECORDER for info in known)
            and publisher.get_subscription_count() >= len(known))
