"""A bad line: passes messages on, but drops, repeats and delays some, at random."""

import json
import random
import sys
from typing import Any, Final

from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from asi_common.node.executor import run_node
from asi_common.node.topics import CONTROL_QOS

TOPICS: Final = ((JointState, 'joint_states'), (WrenchStamped, 'valve_command'),
                 (Clock, '/clock'))


class Relay(Node):
    """Passes each topic on from its name with `_sent` at the end."""

    def __init__(self) -> None:
        super().__init__('relay')
        self._random = random.Random(1)
        self._late: list[tuple[Any, bytes]] = []
        self.counts = dict.fromkeys(('passed', 'dropped', 'repeated', 'delayed'), 0)
        for kind, name in TOPICS:
            publisher = self.create_publisher(kind, name, CONTROL_QOS)
            self.create_subscription(
                kind, f'{name}_sent', lambda message, to=publisher: self._pass(message, to),
                CONTROL_QOS, raw=True)
        self.create_timer(0.004, self._deliver_late)

    def destroy_node(self) -> None:
        print(json.dumps(self.counts), flush=True)
        super().destroy_node()

    def _pass(self, message: bytes, to: Any) -> None:
        fate = self._random.choices(list(self.counts), (85, 5, 5, 5))[0]
        self.counts[fate] += 1
        if fate in ('passed', 'repeated'):
            to.publish(message)
        if fate in ('repeated', 'delayed'):
            self._late.append((to, message))

    def _deliver_late(self) -> None:
        late, self._late = self._late, []
        for to, message in late:
            to.publish(message)


if __name__ == '__main__':
    sys.exit(run_node(Relay))
