"""
`python -m bench.killed_reader`: how long a loop in real time stops after a reader was killed.

Fast DDS keeps what a killed reader has not received; 20 s later it declares the reader dead and
drops that while the publisher waits. For each depth of the publishers, a subscriber of all
topics is killed, and the longest period between two states of the actuator is printed.
"""

import argparse
import itertools
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

import numpy as np
import rclpy
from rclpy.node import Node
from sensor_msgs.msg import JointState

from asi_common.node.topics import nanoseconds
from asi_common.topics import REALTIME_DEPTH, TOPICS

DEPTHS: Final = (REALTIME_DEPTH, 5000, 30_000)
RATE_HZ: Final = 1000.0
FILLED_S: Final = 5.0     # before the reader is killed
DEAD_S: Final = 30.0      # after that
TOPICS_READ: Final = [name for name, topic in TOPICS.items() if topic.publisher == 'actuator']
# A reader that is killed while it receives.
READER: Final = """
import rclpy
from asi_common.node.topics import create_subscription
rclpy.init()
node = rclpy.create_node('reader')
for name in {names}:
    create_subscription(node, name, lambda received: None)
print('reads', flush=True)
rclpy.spin(node)
"""


@contextmanager
def process(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Run Python with arguments while the context lasts."""
    running = subprocess.Popen([sys.executable, *arguments], text=True, stdout=subprocess.PIPE)
    try:
        yield running
    finally:
        running.kill()
        running.wait()


def longest_period(node: Node, depth: int) -> float:
    """Return the longest time between two states (s) about the death of a reader."""
    stamps: list[int] = []
    subscription = node.create_subscription(
        JointState, 'joint_states', lambda state: stamps.append(nanoseconds(state.header.stamp)),
        REALTIME_DEPTH)
    depths = [part for name in TOPICS_READ for part in (
        '-p', f'qos_overrides.{node.resolve_topic_name(name)}.publisher.depth:={depth}')]
    with process('-m', 'asi_actuator.actuator_node', '--ros-args', '-p', 'mode:=realtime', '-p',
                 f'rate_hz:={RATE_HZ}', '-p', 'command_timeout:=60.0', *depths), process(
                     '-c', READER.format(names=TOPICS_READ)) as reader:
        assert reader.stdout is not None and reader.stdout.readline().strip() == 'reads'
        receive(node, FILLED_S)
        first = len(stamps)
        reader.kill()
        receive(node, DEAD_S)
    node.destroy_subscription(subscription)
    return float(np.diff(stamps[first:]).max()) * 1e-9


def receive(node: Node, seconds: float) -> None:
    """Receive for a time."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        rclpy.spin_once(node, timeout_sec=0.1)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--depth', type=int, nargs='*', default=DEPTHS)
    parser.add_argument('--times', type=int, default=1, help='of each depth')
    given = parser.parse_args()
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    rclpy.init()
    node = rclpy.create_node('bench')
    print('| depth | longest period (s) |\n|---|---|', flush=True)
    for depth, _ in itertools.product(given.depth, range(given.times)):
        print(f'| {depth} | {longest_period(node, depth):.3f} |', flush=True)
    rclpy.shutdown()


if __name__ == '__main__':
    main()
