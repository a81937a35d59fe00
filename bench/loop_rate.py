"""
The loop over ROS beside empty nodes that exchange the same messages, in the same minutes.

Lock-step: ticks a second, and the parts of the time of a tick. Real time: jitter of the period
compared with an empty timer, and latency of the command compared with an echo. References are
rclpy's executor with message objects, as a user would write it, and as a lower bound our executor
with bytes that were serialised before.
"""

import contextlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final
from unittest import mock

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.publisher import Publisher
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.signals import SignalHandlerOptions

from asi_actuator.actuator_node import ActuatorNode
from asi_analysis.terminal import bar
from asi_common.node import messages as wire
from bench.empty_nodes import SENT, messages
from bench.result import Result, deviation, interleaved, ratios
from bench.timed_node import CALLBACKS, EXECUTOR, PARTS, SENDING

ROOT: Final = Path(__file__).parents[1]
ACTUATOR, CONTROLLER = 'asi_actuator.actuator_node', 'asi_controller.controller_node'
RECORDER: Final = 'asi_analysis.bags.nodes.recorder_node'
SINE: Final = {'reference.shape': 'sine'}
REALTIME_HZ: Final = (500.0, 1000.0, 2000.0)
PATIENCE_S: Final = 60.0
CONVERSIONS: Final = 10_000
# Diagnostics with the number of ticks come twice a second; the first second is a warm-up.
WARM_UP_S: Final = 1.0
FLOOR: Final = 'all seven, our executor, bytes'
EMPTY: Final = {
    'one message each way': ('--messages', 'one'),
    'state, clock, command': ('--messages', 'three'),
    'all seven topics': ('--messages', 'all'),
    FLOOR: ('--messages', 'all', '--our-executor', '--serialised'),
}
LIMIT: Final = 'state, clock, command'
OURS, RECORDED = 'our nodes', 'our nodes, recorded'


@contextlib.contextmanager
def process(*arguments: str) -> Iterator[subprocess.Popen]:
    """Run `python -m` with arguments while the context lasts."""
    environment = os.environ | {
        'PYTHONPATH': os.pathsep.join([str(ROOT), os.environ.get('PYTHONPATH', '')])}
    with subprocess.Popen([sys.executable, '-m', *arguments], stderr=subprocess.DEVNULL,
                          stdout=subprocess.PIPE, text=True, env=environment) as child:
        try:
            yield child
        finally:
            child.terminate()


def node(module: str, *arguments: str, **parameters: object) -> tuple[str, ...]:
    """Return the arguments that start a node."""
    given = [part for name, value in parameters.items() for part in ('-p', f'{name}:={value}')]
    return (module, *arguments, '--ros-args', *given)


def empty(arguments: tuple[str, ...], seconds: float) -> dict[str, float]:
    """Return the measurements of two empty nodes."""
    with process('bench.empty_nodes', 'controller', *arguments), \
            process('bench.empty_nodes', 'actuator', *arguments,
                    '--seconds', str(seconds)) as actuator:
        output, _ = actuator.communicate(timeout=PATIENCE_S + seconds)
    measured: dict[str, float] = json.loads(output)
    return measured


class Listener:
    """Subscribes to the /diagnostics of our nodes."""

    def __init__(self) -> None:
        self.node = rclpy.create_node('bench_listener')
        self.values: dict[str, dict[str, str]] = {}
        self.ticks: list[tuple[float, int]] = []    # of the actuator, since it was running
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._take, 10)

    def _take(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {value.key: value.value for value in status.values}
            self.values[status.name] = values
            # On a busy machine the message is a warning.
            if status.name == 'asi_actuator: loop' and int(values['ticks']) > 0:
                self.ticks.append((time.perf_counter(), int(values['ticks'])))

    def run(self, seconds: float) -> None:
        """Listen until the loop has run for so long after it was warm."""
        end = time.perf_counter() + PATIENCE_S + seconds
        while not self.ticks or self.ticks[-1][0] - self.ticks[0][0] < WARM_UP_S + seconds:
            if time.perf_counter() > end:
                raise TimeoutError('the loop does not run')
            rclpy.spin_once(self.node, timeout_sec=0.5)

    def rate_hz(self) -> float:
        """Return the ticks a second after the warm-up."""
        warm = [(at, ticks) for at, ticks in self.ticks if at - self.ticks[0][0] >= WARM_UP_S]
        (start, first), (end, last) = warm[0], warm[-1]
        return (last - first) / (end - start)


@contextlib.contextmanager
def listener() -> Iterator[Listener]:
    """Listen while the context lasts."""
    heard = Listener()
    yield heard
    heard.node.destroy_node()


def our_rate(seconds: float, recorded: bool) -> float:
    """Return how many ticks a second our nodes make."""
    with contextlib.ExitStack() as running:
        folder = running.enter_context(tempfile.TemporaryDirectory())
        if recorded:
            running.enter_context(process(*node(RECORDER, output=f'{folder}/bag')))
        running.enter_context(process(*node(ACTUATOR, await_recorder=str(recorded).lower())))
        running.enter_context(process(*node(CONTROLLER, **SINE)))
        heard = running.enter_context(listener())
        heard.run(seconds)
        return heard.rate_hz()


def our_realtime(rate_hz: float, seconds: float) -> dict[str, float]:
    """Return how even the period is, steady and at the start, and how long answers take."""
    common = {'mode': 'realtime', 'rate_hz': rate_hz}
    with process(*node('bench.ticking_node', str(seconds), **common)) as actuator, \
            process(*node(CONTROLLER, **common, **SINE)), listener() as heard:
        heard.run(seconds)
        latency_ms = float(heard.values['asi_actuator: loop']['latency median (ms)'])
        return {'latency_median_ms': latency_ms, **node_times(actuator)}


def in_turns(rivals: dict[str, Callable[[], Any]], rounds: int) -> dict[str, list[Any]]:
    """Return the results of each by round; the order is reversed from round to round."""
    results: dict[str, list[Any]] = {name: [] for name in rivals}
    names = list(rivals)
    with bar() as progress:
        for done in range(rounds):
            for number, name in enumerate(names):
                progress(name, (done + number / len(names)) / rounds)
                results[name].append(rivals[name]())
            names.reverse()
    return results


def lockstep(rounds: int, seconds: float) -> list[Result]:
    """Return the ticks a second beside those of the empty nodes."""
    rivals: dict[str, Callable[[], float]] = {
        name: lambda arguments=arguments: empty(arguments, seconds)['rate_hz']
        for name, arguments in EMPTY.items()}
    rivals |= {OURS: lambda: our_rate(seconds, recorded=False),
               RECORDED: lambda: our_rate(seconds, recorded=True)}
    rates = in_turns(rivals, rounds)
    results = []
    for ours, key, target in ((OURS, 'rate', '>= 0.9'), (RECORDED, 'recorded', '>= 0.75')):
        for i, name in enumerate(EMPTY):
            ratio, spread = ratios(rates[ours], rates[name])
            results.append(Result(
                f'loop_rate.{key}.{i + 1}', f'lock-step, {ours}: rate, ours / empty nodes',
                statistics.median(rates[ours]), 'ticks/s', spread,
                f'empty nodes: {name}, {statistics.median(rates[name]):.0f} ticks/s', ratio,
                target if name == LIMIT else '', share=ratio if name == LIMIT else None))
    return results


def timed(seconds: float, *options: str) -> Counter[str]:
    """Return the time of both nodes together in a tick, by part, us."""
    with process(*node('bench.timed_node', 'controller', *options, **SINE)) as controller:
        with process(*node('bench.timed_node', 'actuator', *options)) as actuator, \
                listener() as heard:
            heard.run(seconds)
            spent = node_times(actuator)
        spent.update(node_times(controller))
    return spent


def node_times(child: subprocess.Popen) -> Counter[str]:
    """End a timed node and return its time in a tick, by part, us."""
    child.terminate()
    text, _ = child.communicate(timeout=PATIENCE_S)
    return Counter(json.loads(text.splitlines()[-1]))


def timed_empty(seconds: float) -> Counter[str]:
    """Return the same of empty nodes, which only send the messages."""
    command = 'bench.timed_node', 'empty'
    arguments = EMPTY[FLOOR]
    with process(*command, 'controller', *arguments) as controller, \
            process(*command, 'actuator', *arguments, '--seconds', str(seconds)) as actuator:
        actuator.wait(timeout=PATIENCE_S + seconds)
        return node_times(actuator) + node_times(controller)


def tick(rounds: int, seconds: float) -> list[Result]:
    """Return the parts of the time of a tick, of both nodes together."""
    times_us: dict[str, list[Counter[str]]] = in_turns({
        # Measured without the timers, which make a tick longer.
        'period': lambda: Counter({'': 1e6 / our_rate(seconds, recorded=False)}),
        'whole': lambda: timed(seconds), 'apart': lambda: timed(seconds, '--parts'),
        'empty': lambda: timed_empty(seconds)}, rounds)

    def us(of: str, part: str) -> float:
        return statistics.median(times[part] for times in times_us[of])

    period_us, own_us = us('period', ''), us('whole', CALLBACKS)
    shares = [100.0 * whole[CALLBACKS] / period['']
              for whole, period in zip(times_us['whole'], times_us['period'], strict=True)]
    inside = {part: us('apart', part) for part in PARTS} | {'wiring': us('apart', CALLBACKS)}
    scale = own_us / sum(inside.values())
    spent = ({part: us('whole', part) for part in (SENDING, EXECUTOR)}
             | {part: us * scale for part, us in inside.items()})
    # While one node works the other waits; the rest is DDS and waking up.
    spent['DDS, the kernel, waking up'] = period_us - sum(spent.values())
    return [
        Result('loop_rate.own', 'lock-step: our own code, of a tick', statistics.median(shares),
               '%', deviation(shares), target='<= 15'),
        *[Result(f'loop_rate.tick.{part.partition(",")[0]}',
                 f'of a tick of {period_us:.0f} us, both nodes: {part}', us, 'us')
          for part, us in spent.items()],
        Result('loop_rate.empty', f'callbacks of the empty nodes, both: {FLOOR}',
               us('empty', CALLBACKS), 'us')]


def cold(rounds: int) -> list[Result]:
    """Return the time of the actuator's callback without sending: warm, and with cold caches."""
    found = []
    with mock.patch.object(Publisher, 'publish', lambda *_: None):
        node = ActuatorNode()
        loop: Any = node.loop
        loop._advance(0.0, 0)
        for size, what in ((0, 'warm'), (2**20, '1 MiB read before each'),
                           (2**25, '32 MiB read before each')):
            others, taken_ns = np.ones(size // 8), []
            for _ in range(rounds):
                message, _ = wire.answer(loop.stamp_ns, 10.0, 0.0)
                others.sum()
                begin_ns = time.perf_counter_ns()
                node._on_command(message)
                taken_ns.append(time.perf_counter_ns() - begin_ns)
            found.append(Result(
                f'loop_rate.cold.{size}', f"the actuator's callback alone, nothing sent: {what}",
                1e-3 * statistics.median(taken_ns), 'us', 1e-3 * deviation(taken_ns)))
        node.destroy_node()
    return found


def conversions(rounds: int) -> list[Result]:
    """Return how long a tick's messages take to pack and unpack beside rclpy's message objects."""
    sent = messages()
    state, answer = wire.state(1, *[0.0] * 6), wire.answer(1, 0.0, 0.0)

    def ours_of_actuator() -> None:
        wire.state(1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        wire.piston(state[0])
        wire.time(state[1])

    def ours_of_controller() -> None:
        wire.answer(1, 0.0, 0.0)
        wire.force(answer[0])

    found = []
    # Messages that are sent; the first `heard` of them are also received.
    for end, topics, packed, heard, ours in (
            ('actuator', SENT['all'][0], state, 2, ours_of_actuator),
            ('controller', SENT['all'][1][::-1], answer, 1, ours_of_controller)):
        objects = [sent[topic] for topic in topics]
        bytes_heard = list(zip(packed, map(type, objects), strict=True))[:heard]

        def by_rclpy(objects: list[Any] = objects, bytes_heard: list[Any] = bytes_heard) -> None:
            for message in objects:
                serialize_message(message)
            for data, kind in bytes_heard:
                deserialize_message(data, kind)

        times = interleaved({
            'rclpy': lambda by_rclpy=by_rclpy: [by_rclpy() for _ in range(CONVERSIONS)],
            'ours': lambda ours=ours: [ours() for _ in range(CONVERSIONS)]}, rounds)
        ratio, spread = ratios(times['rclpy'], times['ours'])
        us = 1e6 / CONVERSIONS
        found.append(Result(
            f'loop_rate.bytes.{end}', f'encoding the messages of the {end} in a tick, and '
            'decoding those received; ratio: rival / ours', statistics.median(times['ours']) * us,
            'us', spread, f'rclpy, {statistics.median(times["rclpy"]) * us:.0f} us', ratio))
    return found


def realtime(rounds: int, seconds: float) -> list[Result]:
    """Return jitter and latency beside an empty timer and an echo."""
    results = []
    for rate_hz in REALTIME_HZ:
        rate = ('--rate', str(rate_hz))
        timers, echoes, ours = [], [], []
        for _ in range(rounds):
            timers.append(empty(('--messages', 'none', *rate), seconds))
            echoes.append(empty(('--messages', 'one', *rate), seconds))
            ours.append(our_realtime(rate_hz, seconds))
        jitter = 'jitter_p99_ms', 'period jitter, 99th percentile'
        for (key, what), rivals, rival in (
                (jitter, timers, 'empty timer'), (jitter, echoes, 'echo of one message'),
                (('latency_median_ms', 'state to command, median'), echoes,
                 'echo of one message')):
            values = [measured[key] for measured in ours]
            limits = [measured[key] for measured in rivals]
            ratio, spread = ratios(values, limits)
            results.append(Result(
                f'loop_rate.{key}.{rate_hz:.0f}.{rival.split()[0]}',
                f'real time at {rate_hz:g} Hz: {what}, ours / rival',
                statistics.median(values), 'ms', spread,
                f'{rival}, {statistics.median(limits):.3f} ms', ratio))
        starts = [measured['start_jitter_p99_ms'] for measured in ours]
        results.append(Result(
            f'loop_rate.start_jitter.{rate_hz:.0f}', f'real time at {rate_hz:g} Hz: that jitter '
            'of ours, in the seconds of the start', statistics.median(starts), 'ms',
            deviation(starts)))
    return results


def measure(quick: bool = False) -> list[Result]:
    """Return ticks a second, the parts of a tick, jitter and latency."""
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        return (lockstep(1 if quick else 5, 1.0 if quick else 4.0)
                + tick(1 if quick else 5, 2.0 if quick else 4.0)
                + cold(100 if quick else 1000)
                + conversions(1 if quick else 9)
                + realtime(1 if quick else 3, 1.0 if quick else 5.0))
    finally:
        rclpy.shutdown()
