"""
How fast the loop runs over ROS, beside what the machine can do at all in the same minutes.

`python bench/loop_rate.py` prints a table. Lock-step: our two nodes against a bare ping-pong of
the same two messages between two processes that use rclpy's SingleThreadedExecutor, in turns.
Real time: our two nodes at 1 kHz against an empty timer.
"""

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState

ACTUATOR, CONTROLLER = 'asi_actuator.actuator_node', 'asi_controller.controller_node'


@contextlib.contextmanager
def process(*arguments: str) -> Iterator[subprocess.Popen]:
    """Run python with arguments while the context lasts."""
    with subprocess.Popen([sys.executable, *arguments], stderr=subprocess.DEVNULL,
                          stdout=subprocess.PIPE, text=True) as child:
        try:
            yield child
        finally:
            child.send_signal(signal.SIGINT)


def node(module: str, **parameters: object) -> tuple[str, ...]:
    """Return the arguments that start a node."""
    given = [part for name, value in parameters.items() for part in ('-p', f'{name}:={value}')]
    return ('-m', module, '--ros-args', *given)


def state_message() -> JointState:
    """Return a message as large as the actuator's."""
    message = JointState(name=['piston', 'valve'], position=[0.0, 0.0], velocity=[0.0, 0.0],
                         effort=[0.0, 0.0])
    message.header.frame_id = 'piston'
    return message


def pong() -> None:
    """Answer every state with a command, with rclpy as it is."""
    rclpy.init()
    pong_node = rclpy.create_node('pong')
    command = WrenchStamped()
    command.header.frame_id = 'piston'
    publisher = pong_node.create_publisher(WrenchStamped, 'command', QoSProfile(depth=10))
    pong_node.create_subscription(
        JointState, 'state', lambda _: publisher.publish(command), QoSProfile(depth=10))
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(pong_node)


def ping_pong_rate(count: int) -> float:
    """Return how many states a second are answered in a bare ping-pong."""
    answers = 0
    ping = rclpy.create_node('ping')
    state = state_message()
    publisher = ping.create_publisher(JointState, 'state', QoSProfile(depth=10))

    def answered(_: WrenchStamped) -> None:
        nonlocal answers
        answers += 1
        publisher.publish(state)

    subscription = ping.create_subscription(
        WrenchStamped, 'command', answered, QoSProfile(depth=10))
    executor = SingleThreadedExecutor()
    executor.add_node(ping)
    with process(__file__, '--pong'):
        while not (publisher.get_subscription_count() and subscription.get_publisher_count()):
            executor.spin_once(timeout_sec=0.05)
        time.sleep(0.2)
        publisher.publish(state)
        while answers < count // 10:
            executor.spin_once(timeout_sec=1.0)
        start, before = time.perf_counter(), answers
        while answers < count:
            executor.spin_once(timeout_sec=1.0)
        rate = (answers - before) / (time.perf_counter() - start)
    executor.shutdown()
    ping.destroy_node()
    return rate


def our_rate(seconds: float, recorded: bool) -> float:
    """Return how many ticks a second our nodes make, taken from /diagnostics of the actuator."""
    with tempfile.TemporaryDirectory() as folder, process(*node(ACTUATOR)), \
            process(*node(CONTROLLER, **{'reference.shape': 'sine'})):
        if not recorded:
            return _ticks_a_second(seconds)
        with process(*node('asi_analysis.recorder_node', output=f'{folder}/bag')):
            return _ticks_a_second(seconds)


def _ticks_a_second(seconds: float) -> float:
    listener = rclpy.create_node('listener')
    counts: list[tuple[float, int]] = []

    def take(message: DiagnosticArray) -> None:
        status = message.status[0]
        if status.name == 'asi_actuator: loop' and status.message == 'running':
            ticks = next(int(v.value) for v in status.values if v.key == 'ticks')
            counts.append((time.perf_counter(), ticks))

    listener.create_subscription(DiagnosticArray, '/diagnostics', take, 10)
    # The first second warms up.
    while not counts or counts[-1][0] - counts[0][0] < 1.0 + seconds:
        rclpy.spin_once(listener, timeout_sec=0.5)
    listener.destroy_node()
    begin = next(i for i, (at, _) in enumerate(counts) if at - counts[0][0] >= 1.0)
    (start, first), (end, last) = counts[begin], counts[-1]
    return (last - first) / (end - start)


def lockstep(rounds: int, seconds: float, recorded: bool) -> None:
    """Compare our nodes in lock-step with the ping-pong, in turns."""
    print('lock-step, ticks a second')
    rows: dict[str, list[float]] = {'bare ping-pong': [], 'our nodes': []}
    if recorded:
        rows['our nodes and recorder'] = []
    for _ in range(rounds):
        rows['bare ping-pong'].append(ping_pong_rate(round(3000 * seconds)))
        rows['our nodes'].append(our_rate(seconds, recorded=False))
        if recorded:
            rows['our nodes and recorder'].append(our_rate(seconds, recorded=True))
    bare = np.median(rows['bare ping-pong'])
    for name, rates in rows.items():
        print(f'  {name:24s} median {np.median(rates):6.0f}   {np.median(rates) / bare:4.0%}   '
              f'all: {", ".join(f"{rate:.0f}" for rate in rates)}')


def empty_timer(seconds: float) -> None:
    """Time a timer of 1 kHz that does nothing else."""
    timer_node = rclpy.create_node('empty_timer')
    times: list[float] = []
    timer_node.create_timer(1e-3, lambda: times.append(time.perf_counter()))
    executor = SingleThreadedExecutor()
    executor.add_node(timer_node)
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        executor.spin_once(timeout_sec=0.1)
    executor.shutdown()
    timer_node.destroy_node()
    periods_ms = np.diff(times) * 1e3
    middle = np.median(periods_ms)
    print(f'  empty rclpy timer: period median {middle:.4f} ms, '
          f'jitter p99 {np.quantile(abs(periods_ms - middle), 0.99):.3f} ms, '
          f'max {periods_ms.max():.2f} ms, periods missed {round(seconds * 1e3) - len(times)}')


def realtime(seconds: float) -> None:
    """Run our nodes at 1 kHz and print what they say of themselves."""
    print(f'real time, 1 kHz for {seconds:g} s')
    empty_timer(seconds)
    listener = rclpy.create_node('listener')
    latest: dict[str, dict[str, str]] = {}

    def take(message: DiagnosticArray) -> None:
        status = message.status[0]
        latest[status.name] = {v.key: v.value for v in status.values} | {
            'health': status.message}

    listener.create_subscription(DiagnosticArray, '/diagnostics', take, 10)
    with process(*node(ACTUATOR, mode='realtime')), \
            process(*node(CONTROLLER, mode='realtime', **{'reference.shape': 'sine'})):
        while len(latest) < 2 or 'running' not in {v['health'] for v in latest.values()}:
            rclpy.spin_once(listener, timeout_sec=0.5)
        end = time.perf_counter() + seconds
        while time.perf_counter() < end:
            rclpy.spin_once(listener, timeout_sec=0.5)
    listener.destroy_node()
    for name, values in sorted(latest.items()):
        print(f'  {name} ({values["health"]}), the last 5000 ticks of {values["ticks"]}')
        for key, value in values.items():
            if 'ms' in key or key in ('overruns', 'lost samples', 'watchdog'):
                print(f'    {key}: {value}')


def main() -> None:
    """Run what the arguments ask for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--rounds', type=int, default=3)
    parser.add_argument('--seconds', type=float, default=5.0, help='of each lock-step run')
    parser.add_argument('--realtime-seconds', type=float, default=60.0)
    parser.add_argument('--recorder', action='store_true', help='also with the recorder')
    parser.add_argument('--pong', action='store_true', help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.pong:
        pong()
        return
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    rclpy.init()
    if arguments.rounds:
        lockstep(arguments.rounds, arguments.seconds, arguments.recorder)
    if arguments.realtime_seconds:
        realtime(arguments.realtime_seconds)
    rclpy.shutdown()


if __name__ == '__main__':
    main()
