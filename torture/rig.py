"""Shared by the scenarios: processes, a listening ROS node, and the tally of faults."""

import math
import os
import signal
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any, Final

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from asi_common.node.executor import LoopExecutor
from asi_common.writable import choose_log_folder

ROOT: Final = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / 'test'))
from conftest import NodeProcess  # noqa: E402

ACTUATOR, CONTROLLER = 'asi_actuator.actuator_node', 'asi_controller.controller_node'
RECORDER, PEER = 'asi_analysis.bags.nodes.recorder_node', 'asi_actuator.can_actuator'
# How long a busy machine may take to start a process or to answer a service.
PATIENCE_S: Final = 60.0
# A thread sleeps for NAP_S; if it wakes up so much later (s), the machine has stalled.
NAP_S: Final = 0.01
LATE_S: Final = 0.05
# If so much later (s), the machine is busy, and the periods of a node may be late too.
BUSY_S: Final = 0.002
# For so long (s) a node reports late periods and lost samples.
COMPLAINS_S: Final = 10.0


class NotThere(Exception):  # noqa: N818
    """Something that must happen did not."""


def until(condition: Callable[[], Any], what: str, timeout_s: float = PATIENCE_S) -> Any:
    """Return condition() once it is true; raises NotThere, naming `what`, if it never is."""
    end = time.monotonic() + timeout_s
    while not (result := condition()):
        if time.monotonic() > end:
            raise NotThere(f'not within {timeout_s:g} s: {what}')
        time.sleep(0.002)
    return result


@dataclass
class Tally:
    """What a scenario tried, and what was lost."""

    name: str
    tried: int = 0
    survived: int = 0
    samples_lost: int = 0
    zero_s: list[float] = field(default_factory=list)
    notes: dict[str, float] = field(default_factory=dict)
    failures: list[str] = field(default_factory=list)

    def count(self, what: str, problem: str = '', times: int = 1) -> None:
        """Count a fault that was survived, or not because of a problem."""
        self.tried += times
        if problem:
            self.failures.append(f'{what}: {problem}')
        else:
            self.survived += times


class Rig:
    """A ROS domain, a folder, and the processes in them; one for each scenario."""

    def __init__(self, folder: Path, random: Random):
        """Listen to the domain that the environment names."""
        folder.mkdir(parents=True)
        self.folder, self.random = folder, random
        self._started: list[NodeProcess] = []
        choose_log_folder()
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        self.node: Node = rclpy.create_node('torture')
        self._executor = LoopExecutor()
        self._executor.add_node(self.node)
        # What each node has said last; nothing yet of a node that has just begun.
        self.diagnostics: dict[str, Any] = defaultdict(
            lambda: {'at': -math.inf, 'text': '', 'state': ''})
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 100)
        # Total time for which this machine has stalled, s.
        self.stood_still_s = 0.0
        self._late_at_s = -math.inf   # when the machine was last busy
        self._threads = [threading.Thread(target=self._executor.spin),
                         threading.Thread(target=self._watch_machine)]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """End everything."""
        for process in self._started:
            process.kill()
        self._executor.stopped = True
        for thread in self._threads:
            thread.join()
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown()

    def start(self, module: str, *arguments: str, limits: Callable[[], None] | None = None,
              environment: Mapping[str, str] | None = None, **parameters: object) -> NodeProcess:
        """Start a node; or the CAN actuator, which takes no parameters."""
        given = [part for name, value in parameters.items() for part in
                 ('-p', f'{name}:={str(value).lower() if isinstance(value, bool) else value}')]
        ros = ['--ros-args', *given] if module != PEER else []
        log = self.folder / f'{module.rpartition(".")[2]}-{len(self._started)}.log'
        complete = dict(os.environ) | dict(environment or {}) | {'PYTHONPATH': os.pathsep.join(
            [str(ROOT), str(ROOT / 'test'), os.environ.get('PYTHONPATH', '')])}
        self._started.append(NodeProcess(
            [sys.executable, '-m', module, *ros, *arguments], complete, log, limits))
        return self._started[-1]

    def tracebacks(self) -> str:
        """Return the first traceback that any process has printed, '' if none."""
        for process in self._started:
            if 'Traceback' in process.text:
                return process.text[process.text.index('Traceback'):][:2000]
        return ''

    def last_words(self) -> str:
        """Return what each node has said last, and each process printed last."""
        said = [f'{node} said {values["text"]!r} {time.monotonic() - values["at"]:.1f} s ago'
                for node, values in self.diagnostics.items()]
        printed = [f'exit status {process.poll()} of {" ".join(process.text[-200:].split())!r}'
                   for process in self._started]
        return '; '.join(said + printed)

    def ask(self, kind: type, name: str, request: Any, timeout_s: float = PATIENCE_S) -> Any:
        """Return the answer of a service; raises NotThere if there is none."""
        client = self.node.create_client(kind, name)
        try:
            until(client.service_is_ready, f'the service {name}', timeout_s)
            future = client.call_async(request)
            until(future.done, f'an answer of {name}', timeout_s)
            return future.result()
        finally:
            self.node.destroy_client(client)

    def enable(self, name: str = '/asi_actuator') -> None:
        """Reset and enable an actuator; raises NotThere if it will not."""
        def enabled() -> bool:
            self.ask(Trigger, f'{name}/reset', Trigger.Request())
            return bool(self.ask(SetBool, f'{name}/enable', SetBool.Request(data=True)).success)
        until(enabled, f'{name} to be enabled')

    def await_running(self, name: str) -> None:
        """Wait until a node says that its loop runs, from now on; raises NotThere if not."""
        since = time.monotonic()
        until(lambda: self.diagnostics[name]['at'] > since and self.runs(name),
              f'{name} to say that it runs')

    def runs(self, name: str) -> bool:
        """Return whether a node said last that its loop runs; late if the machine itself was."""
        said = str(self.diagnostics[name]['text'])
        busy = time.monotonic() - self._late_at_s < COMPLAINS_S
        return said == 'running' or (busy and said.startswith('running, but '))

    def listen(self, kind: type, topic: str) -> list[Any]:
        """Return a list that gets the messages of a topic."""
        messages: list[Any] = []
        self.node.create_subscription(kind, topic, messages.append, 1000)
        return messages

    def states(self, topic: str = 'joint_states') -> list[Any]:
        """Return a list that gets the messages of joint_states."""
        return self.listen(JointState, topic)

    def _watch_machine(self) -> None:
        before = time.monotonic()
        while not self._executor.stopped:
            time.sleep(NAP_S)
            now = time.monotonic()
            late_s, before = now - before - NAP_S, now
            self.stood_still_s += late_s if late_s > LATE_S else 0.0
            self._late_at_s = now if late_s > BUSY_S else self._late_at_s

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        status = message.status[0]
        node, _, kind = status.name.partition(': ')
        if kind != 'loop':
            return
        self.diagnostics[node] = {
            v.key: v.value for v in status.values} | {'text': status.message,
                                                      'at': time.monotonic()}


def is_alive(process: NodeProcess) -> bool:
    """Return whether a process still runs."""
    return process.poll() is None


def pause(process: NodeProcess, seconds: float) -> None:
    """Stop a process for a while."""
    process.send(signal.SIGSTOP)
    time.sleep(seconds)
    process.send(signal.SIGCONT)
