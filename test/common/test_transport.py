"""What the nodes can be reached by: without a range, or with LOCALHOST, by this machine alone."""

import itertools
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import pytest
from conftest import PATIENCE_S, ROOT, Listener, NodeProcess

from asi_common.node.executor import CHOICES, HERE_ALONE, choose_transport, stay_here

ACTUATOR = 'asi_actuator.actuator_node'
# Prints the nodes that are found once `asi_open` is, and has been for a while.
LOOK = """
import time, rclpy
rclpy.init()
node = rclpy.create_node('looker')
names = set()
while 'asi_open' not in names:
    rclpy.spin_once(node, timeout_sec=0.1)
    names |= set(node.get_node_names())
for _ in range(50):
    rclpy.spin_once(node, timeout_sec=0.1)
    names |= set(node.get_node_names())
print(*sorted(names))
"""


def sockets(pid: int) -> set[str]:
    """Return the IPv4 addresses that the UDP sockets of a process are bound to."""
    inodes = set()
    for file in Path(f'/proc/{pid}/fd').iterdir():
        with suppress(FileNotFoundError):   # closed in between
            kind, _, inode = os.readlink(file).partition(':')
            if kind == 'socket':
                inodes.add(inode[1:-1])
    rows = [line.split() for line in Path(f'/proc/{pid}/net/udp').read_text().splitlines()[1:]]
    return {'.'.join(str(int(row[1][place:place + 2], 16)) for place in (6, 4, 2, 0))
            for row in rows if row[9] in inodes}


@pytest.mark.skipif(sys.platform != 'linux', reason='needs /proc')
@pytest.mark.parametrize('local', [
    {'ROS_AUTOMATIC_DISCOVERY_RANGE': ''},
    pytest.param({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}, marks=pytest.mark.slow),
    {'ROS_LOCALHOST_ONLY': '1', 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET',
     'ROS_STATIC_PEERS': '192.0.2.1'}])
def test_without_a_range_or_with_localhost_no_socket_is_bound_to_another_address(
        local: dict[str, str], ros_environment: dict[str, str],
        start_node: Callable[..., NodeProcess], states: Listener) -> None:
    ros_environment |= local
    node = start_node(ACTUATOR, mode='realtime', rate_hz=200.0)
    states.wait(3)
    assert sockets(node.pid) == {'127.0.0.1'}
    by_default = not local['ROS_AUTOMATIC_DISCOVERY_RANGE']
    assert (HERE_ALONE in node.text) == by_default


@pytest.mark.skipif(sys.platform != 'linux', reason='needs /proc')
def test_with_a_subnet_a_socket_is_bound_to_every_address(
        ros_environment: dict[str, str], start_node: Callable[..., NodeProcess]) -> None:
    ros_environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'SUBNET'
    open_ = start_node(ACTUATOR, '-r', '__node:=asi_open', mode='realtime', rate_hz=200.0)
    open_.wait_for('realtime at')
    assert '0.0.0.0' in sockets(open_.pid)


def test_a_node_says_twice_a_second_that_it_is_there(
        ros_environment: dict[str, str], start_node: Callable[..., NodeProcess]) -> None:
    """To the ports of processes that it does not know; DDS would say it every 3 s."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as unknown:
        # Where DDS has the last of the 32 processes that a node looks for.
        unknown.bind(('127.0.0.1', 7410 + 250 * int(ros_environment['ROS_DOMAIN_ID']) + 2 * 31))
        unknown.settimeout(PATIENCE_S)
        start_node(ACTUATOR, mode='realtime', rate_hz=200.0)
        times = [time.monotonic() for _ in range(12) if unknown.recv(65536).startswith(b'RTPS')]
    # The first five are 0.1 s apart. A busy machine delays some, but hardly each of the others.
    assert min(after - before for before, after in itertools.pairwise(times[6:])) < 2.0


# Prints how many of 1500 states it misses, as best effort delivers them.
HEAR = """
import os, rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from asi_common.node.executor import choose_transport
choose_transport(os.environ, rclpy.get_rmw_implementation_identifier())
rclpy.init()
node, numbers = rclpy.create_node('listener'), []
def heard(_, info):
    numbers.append(info['publication_sequence_number'])
    print('heard' if len(numbers) == 1 else '', flush=True)
node.create_subscription(JointState, 'joint_states', heard, QoSProfile(
    depth=5000, reliability=ReliabilityPolicy.BEST_EFFORT))
while len(numbers) < 1500:
    rclpy.spin_once(node)
print(numbers[-1] - numbers[0] + 1 - len(numbers), 'missed')
"""


@pytest.mark.skipif(int(Path('/proc/sys/net/core/rmem_max').read_text()) < 2 ** 22,
                    reason='net.core.rmem_max does not permit so large a buffer')
def test_a_listener_that_stands_still_misses_nothing_that_its_buffer_holds(
        ros_environment: dict[str, str], start_node: Callable[..., NodeProcess],
        tmp_path: Path) -> None:
    """Best effort: nothing is sent again."""
    ros_environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    listener = NodeProcess([sys.executable, '-c', HEAR], {
        **ros_environment, 'PYTHONPATH': str(ROOT)}, tmp_path / 'listener')
    try:
        start_node(ACTUATOR, mode='realtime', rate_hz=500.0)
        listener.wait_for('heard')
        listener.send(signal.SIGSTOP)
        time.sleep(2.0)
        listener.send(signal.SIGCONT)
        listener.wait_for('missed')
        assert '\n0 missed' in listener.text
    finally:
        listener.kill()


@pytest.fixture
def other_namespace() -> Iterator[tuple[list[str], str]]:
    """Return how to run a command in another network namespace, and our address as seen there."""
    name, ours, theirs = f'asi_{os.getpid()}', '10.213.77.1', '10.213.77.2'
    inside = ['ip', 'netns', 'exec', name]
    veth = f'asi{os.getpid() % 10**6}'
    if os.geteuid():
        pytest.skip('a network namespace can be made by root only')
    with ExitStack() as made:
        for command in (
                ['ip', 'netns', 'add', name],
                ['ip', 'link', 'add', f'{veth}a', 'type', 'veth', 'peer', 'name', f'{veth}b',
                 'netns', name],
                ['ip', 'addr', 'add', f'{ours}/30', 'dev', f'{veth}a'],
                ['ip', 'link', 'set', f'{veth}a', 'up'],
                [*inside, 'ip', 'addr', 'add', f'{theirs}/30', 'dev', f'{veth}b'],
                [*inside, 'ip', 'link', 'set', f'{veth}b', 'up'],
                [*inside, 'ip', 'link', 'set', 'lo', 'up']):
            try:
                result = subprocess.run(command, capture_output=True, text=True)
            except FileNotFoundError:
                pytest.skip('needs iproute2')
            if result.returncode:
                pytest.skip(f'{" ".join(command)}: {result.stderr.strip()}')
            if command[2] == 'add' and command[1] == 'netns':
                made.callback(subprocess.run, ['ip', 'netns', 'del', name])
        yield inside, ours


def test_a_node_is_out_of_reach_of_another_network_namespace_unless_it_is_opened(
        other_namespace: tuple[list[str], str], ros_environment: dict[str, str],
        start_node: Callable[..., NodeProcess]) -> None:
    """Of one who names this machine as a peer; a node with the range SUBNET is found so."""
    inside, address = other_namespace
    for name, range_ in (('asi_actuator', 'LOCALHOST'), ('asi_default', ''),
                         ('asi_open', 'SUBNET')):
        ros_environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] = range_
        start_node(ACTUATOR, '-r', f'__node:={name}', mode='realtime', rate_hz=200.0
                   ).wait_for('realtime at')
    result = subprocess.run(
        [*inside, sys.executable, '-c', LOOK], capture_output=True, text=True, timeout=300.0,
        env={**ros_environment, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET',
             'ROS_STATIC_PEERS': address})
    assert result.stdout.split() == ['asi_open', 'looker'], result.stderr


@pytest.mark.parametrize(('rmw', 'given', 'changed', 'word'), [
    ('rmw_fastrtps_cpp', {}, True, ''),
    ('rmw_fastrtps_cpp', {'ROS_STATIC_PEERS': '10.0.0.2'}, False, 'ROS_STATIC_PEERS'),
    ('rmw_fastrtps_cpp', {'FASTRTPS_DEFAULT_PROFILES_FILE': 'mine.xml'}, False,
     'FASTRTPS_DEFAULT_PROFILES_FILE'),
    ('rmw_cyclonedds_cpp', {}, False, 'rmw_cyclonedds_cpp'),
    ('rmw_zenoh_cpp', {}, False, 'rmw_zenoh_cpp')])
def test_the_range_is_kept_where_no_profile_replaces_it_and_what_it_does_not_do_is_said(
        rmw: str, given: dict[str, str], changed: bool, word: str) -> None:
    environment: dict[str, Any] = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', **given}
    warning = choose_transport(environment, rmw)
    assert (environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'SYSTEM_DEFAULT') == changed
    assert given.items() <= environment.items()
    assert bool(warning) == bool(word) and word in warning
    assert choose_transport({**given, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET'}, rmw) == ''


@pytest.mark.parametrize('name', CHOICES)
def test_a_range_is_set_only_where_the_user_has_chosen_nothing(name: str) -> None:
    environment = {name: ''}
    assert stay_here(environment, 'rmw_fastrtps_cpp')
    assert environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'LOCALHOST'
    assert not stay_here({}, 'rmw_cyclonedds_cpp')
    chosen = {name: '0'}
    assert not stay_here(chosen, 'rmw_fastrtps_cpp') and chosen == {name: '0'}
