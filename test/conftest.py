"""What the tests that run real nodes share: a domain of their own, processes, and a ROS node."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

# As the `asi` command does, before numpy is imported.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from asi_analysis.experiments.running import reserve

ROOT = Path(__file__).parents[1]
# Domains whose ports stay below those that Linux gives to clients.
DOMAINS = range(30, 100)
# Generous: a process starts in two seconds, but a busy machine takes far longer.
PATIENCE_S = 120.0
# Looks in a row that find nothing new are silence: a machine that stands still takes only one.
SILENT_LOOKS = 20
LOOK_S = 0.05

# The same examples each time, however long one takes: what has passed here passes in CI. Others
# are looked for by `pytest --hypothesis-profile=search`.
settings.register_profile('suite', derandomize=True, deadline=None,
                          suppress_health_check=[HealthCheck.too_slow])
settings.register_profile('search', settings.get_profile('suite'), derandomize=False,
                          max_examples=5000)
settings.load_profile('suite')

# A shell that starts something in the background has it, and all that it starts, ignore SIGINT.
signal.signal(signal.SIGINT, signal.default_int_handler)


def wait_until(condition: Callable[[], Any], what: str, evidence: Callable[[], str] = str) -> Any:
    """Return condition() once it is true; fail, naming `what` with its evidence(), if never."""
    end = time.monotonic() + PATIENCE_S
    while not (result := condition()):
        if time.monotonic() > end:
            pytest.fail(f'not within {PATIENCE_S:g} s: {what} {evidence()}')
        time.sleep(0.01)
    return result


def wait_for_silence(what: str, *lists: list[Any]) -> None:
    """Wait until no list gets longer any more; fail, naming `what`, if they go on."""
    counts = [-1] * SILENT_LOOKS

    def silent() -> bool:
        time.sleep(LOOK_S)
        counts.append(sum(map(len, lists)))
        return len(set(counts[-SILENT_LOOKS:])) == 1

    wait_until(silent, f'the end of {what}')


class Listener:
    """The messages of a topic, in the order in which they come."""

    def __init__(self, node: Any, kind: type, topic: str):
        """Subscribe."""
        self.messages: list[Any] = []
        node.create_subscription(kind, topic, self.messages.append, 1000)

    def wait(self, count: int = 1) -> list[Any]:
        """Return the next `count` messages."""
        begin = len(self.messages)
        wait_until(lambda: len(self.messages) >= begin + count, f'{count} messages')
        return self.messages[begin:begin + count]

    def wait_until(self, condition: Callable[[Any], bool], what: str) -> Any:
        """Return the newest message once it meets a condition."""
        return wait_until(lambda: next((m for m in self.messages[-1:] if condition(m)), None),
                          what)


class NodeProcess:
    """A node in a process of its own; what it prints goes to a file."""

    def __init__(self, command: list[str], environment: dict[str, str], log: Path,
                 limits: Callable[[], None] | None = None):
        """Start it; limits() runs in the new process before it begins."""
        self._log = log
        with log.open('w') as out:
            self._process = subprocess.Popen(
                command, env=environment, stdout=out, stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL, preexec_fn=limits)

    @property
    def text(self) -> str:
        """What it has printed so far."""
        return self._log.read_text()

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    def wait_for(self, text: str) -> None:
        """Wait until it has printed `text`."""
        wait_until(lambda: text in self.text or self._process.poll() is not None,
                   f'{text!r} in {self._log.name}', evidence=lambda: self.text)
        assert text in self.text, f'ended with {self._process.poll()}: {self.text}'

    def poll(self) -> int | None:
        """Return its exit status, None while it runs."""
        return self._process.poll()

    def send(self, number: signal.Signals) -> None:
        """Send it a signal."""
        self._process.send_signal(number)

    def exit_status(self) -> int:
        """Wait until it ends by itself and return its exit status."""
        try:
            return self._process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            pytest.fail(f'has not ended within {PATIENCE_S:g} s: {self.text}')

    def stop(self) -> int:
        """End it as a user does, by SIGINT, and return its exit status."""
        self.send(signal.SIGINT)
        return self.exit_status()

    def kill(self) -> None:
        """End it so that it cannot say anything any more."""
        self._process.kill()
        self._process.wait()


@pytest.fixture
def ros_environment(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, str]]:
    """Give the test a domain id that no other test on this machine has; return the environment."""
    for domain in DOMAINS:
        if claim := reserve(f'asi_test_domain_{domain}'):
            break
    else:
        pytest.fail(f'all domains from {DOMAINS[0]} to {DOMAINS[-1]} are in use')
    monkeypatch.setenv('ROS_DOMAIN_ID', str(domain))
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    monkeypatch.setenv('AMENT_PREFIX_PATH', os.environ.get('AMENT_PREFIX_PATH', sys.prefix))
    monkeypatch.setenv('PYTHONPATH', os.pathsep.join(
        [str(ROOT), str(ROOT / 'test'), os.environ.get('PYTHONPATH', '')]))
    with claim:
        yield dict(os.environ)


@pytest.fixture
def start_node(ros_environment: dict[str, str], tmp_path: Path) -> Iterator[
        Callable[..., NodeProcess]]:
    """
    Return start(module, *ros_arguments, **parameters), which starts a node as a process.

    Parameters with a dot in the name go into a dictionary: start(..., **{'load.type': 'free'}).
    """
    started: list[NodeProcess] = []

    def start(module: str, *arguments: str, **parameters: object) -> NodeProcess:
        given = [part for name, value in parameters.items()
                 for part in ('-p', f'{name}:={_yaml(value)}')]
        command = [sys.executable, '-m', module, '--ros-args', *given, *arguments]
        log = tmp_path / f'{module}-{len(started)}.log'
        started.append(NodeProcess(command, ros_environment, log))
        return started[-1]

    yield start
    for process in started:
        process.kill()


@pytest.fixture
def serve(ros_environment: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
          ) -> Iterator[Callable[..., tuple[int, NodeProcess]]]:
    """Return a function that starts `asi live` with options: to its port and process."""
    monkeypatch.chdir(tmp_path)
    started: list[NodeProcess] = []

    def start(*arguments: str) -> tuple[int, NodeProcess]:
        with socket.socket() as free:
            free.bind(('127.0.0.1', 0))
            port = free.getsockname()[1]
        command = [sys.executable, '-m', 'asi_analysis.cli', 'live', '--no-browser',
                   '--port', str(port), *arguments]
        # NiceGUI takes a process with this variable for a test of its own.
        environment = {name: value for name, value in ros_environment.items()
                       if name != 'PYTEST_CURRENT_TEST'}
        process = NodeProcess(command, environment, tmp_path / f'live-{port}.log')
        started.append(process)

        def listens() -> bool:
            with socket.socket() as probe:
                return probe.connect_ex(('127.0.0.1', port)) == 0 or process.poll() is not None
        wait_until(listens, 'the page')
        assert process.poll() is None, process.text
        return port, process

    yield start
    for process in started:
        process.kill()


def _yaml(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


@pytest.fixture
def ros_node(ros_environment: dict[str, str]) -> Iterator[Any]:
    """Return an rclpy node of this process that a thread spins, in the domain of the test."""
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    from asi_common.node.discovery import RECORDER
    from asi_common.node.executor import LoopExecutor

    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    # Named as a recorder, so that nodes with await_recorder wait for it.
    node = rclpy.create_node(RECORDER)
    executor = LoopExecutor()
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin)
    thread.start()
    yield node
    executor.stopped = True
    thread.join()
    executor.shutdown()
    node.destroy_node()
    rclpy.shutdown()


@pytest.fixture
def states(ros_node: Any) -> Listener:
    """Return the messages of joint_states."""
    from sensor_msgs.msg import JointState
    return Listener(ros_node, JointState, 'joint_states')


@pytest.fixture
def call(ros_node: Any) -> Callable[[type, str, Any], Any]:
    """Return a function that calls a service: (type, name, request) to response."""
    def call_service(kind: type, name: str, request: Any) -> Any:
        client = ros_node.create_client(kind, name)
        assert client.wait_for_service(PATIENCE_S), f'there is no service {name}'
        future = client.call_async(request)
        wait_until(future.done, f'an answer of {name}')
        return future.result()

    return call_service


@pytest.fixture
def set_parameters(call: Callable) -> Callable[..., list[Any]]:
    """Return what `ros2 param set` calls: (node, {name: value}) to results."""
    from rcl_interfaces.srv import SetParameters
    from rclpy.parameter import Parameter

    def set_by_service(node: str, values: dict[str, object]) -> list[Any]:
        return call(SetParameters, f'/{node}/set_parameters', SetParameters.Request(parameters=[
            Parameter(name, value=value).to_parameter_msg()
            for name, value in values.items()])).results

    return set_by_service


@pytest.fixture
def get_parameters(call: Callable) -> Callable[..., dict[str, object]]:
    """Return what `ros2 param get` calls: (node, names) to {name: value}."""
    from rcl_interfaces.srv import GetParameters
    from rclpy.parameter import parameter_value_to_python

    def get_by_service(node: str, names: list[str]) -> dict[str, object]:
        answer = call(GetParameters, f'/{node}/get_parameters', GetParameters.Request(names=names))
        return dict(zip(names, map(parameter_value_to_python, answer.values), strict=True))

    return get_by_service
