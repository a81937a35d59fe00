"""Who hears a node's topics, so that nothing is missed at the start of a run."""

from collections.abc import Iterable
from typing import Final

from rclpy.node import Node
from rclpy.publisher import Publisher

RECORDER: Final = 'asi_recorder'


def not_recorded(node: Node, publishers: Iterable[Publisher]) -> list[str]:
    """
    Return the topics that no recorder hears yet.

    Matched at the publisher: from then on a reliable publisher keeps what it sends until the
    recorder has it.
    """
    return [publisher.topic_name for publisher in publishers if not _recorded(node, publisher)]


def _recorded(node: Node, publisher: Publisher) -> bool:
    known = node.get_subscriptions_info_by_topic(publisher.topic_name)
    return (any(info.node_name == RECORDER for info in known)
            and publisher.get_subscription_count() >= len(known))
