"""
`asi run`: one experiment, with recorder, controller and actuator as processes.

The actuator ends at the end of the experiment; the others are ended by SIGINT. After an error or
Ctrl-C too, no process is left running and the bag so far is complete.
"""

import ctypes
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Final, NamedTuple

from asi_analysis.bags.bag import read_bag
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.experiments.experiment import Experiment, checked, information, planned
from asi_analysis.measures.analysis import Analysis, analyze
from asi_analysis.reporting.result import Table
from asi_analysis.terminal import Progress, silent
from asi_common.executable import interrupt_later
from asi_common.files import write_text
from asi_common.parameter import Value
from asi_common.parameter_file import write_parameters

# Started in this order, ended in the reverse: while the recorder waits for the last messages, the
# controller can still send a lost one again.
MODULES: Final = {'controller': 'asi_controller.controller_node',
                  'recorder': 'asi_analysis.bags.nodes.recorder_node',
                  'actuator': 'asi_actuator.actuator_node'}
# Parameters that both nodes take from the experiment.
BOTH: Final = ('mode', 'rate_hz', 'await_recorder')
# The ports of these domains do not overlap the ephemeral ports of Linux.
DOMAINS: Final = range(42, 102)
# A node that has not ended this long after SIGINT is killed.
PATIENCE_S: Final = 15.0
POLL_S: Final = 0.1
QUEUE: Final = 10   # messages of diagnostics that wait to be read
# Loaded here, not between fork and exec, where a lock of another thread may be held.
LIBC: Final = ctypes.CDLL(None)


class RunFailedError(RuntimeError):
    """A node failed; the text names it and the last line of its log."""


def run_experiment(experiment: Experiment, out: Path, progress: Progress = silent) -> Path:
    """
    Run an experiment over ROS and return its bag.

    out: a directory that does not exist or is empty; gets `bag`, `log`, `experiment.json` and the
    parameter files of the nodes. The ROS domain is ROS_DOMAIN_ID, or a free one. Raises InputError
    for an experiment that cannot be run, RunFailedError if a node fails.
    """
    experiment = checked(experiment)
    bag = out / 'bag'
    progress('starting the nodes', None)
    with (_environment() as environment,
          _nodes(experiment, out, environment) as nodes, _watched(environment) as status):
        while nodes['actuator'].poll() is None:
            _raise_if_ended(nodes, out)
            actuator = status()
            _raise_if_fault(actuator, bag)
            if actuator.ticks:
                progress(f'{experiment.mode}: {actuator.ticks} of {experiment.ticks} ticks',
                         actuator.ticks / experiment.ticks)
            else:
                progress(actuator.text, None)
        if nodes['actuator'].returncode:
            for _ in range(QUEUE):   # all messages that it published before its end have arrived
                _raise_if_fault(status(), bag)
            raise RunFailedError(_failure('actuator', nodes['actuator'], out)
                                 + f'; the bag so far: {bag}')
        progress('finishing the bag', 1.0)
    return bag


def prepare(experiment: Experiment, out: Path) -> None:
    """Write the parameter files of the nodes, and experiment.json, into an empty directory."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        if any(out.iterdir()):
            raise InputError(f'{out} is not empty: nothing is overwritten; name another --out')
        write_text(out / 'experiment.json', json.dumps(information(experiment), indent=2) + '\n')
        node = experiment.node_parameters | {'await_recorder': True}
        write_parameters(out / 'actuator.yaml', 'asi_actuator', {**experiment.actuator, **node})
        of_both = {name: value for name, value in node.items() if name in BOTH}
        write_parameters(out / 'controller.yaml', 'asi_controller',
                         {**experiment.controller, **of_both})
    except OSError as error:
        raise InputError(f'{out}: {error.strerror}') from None


@contextmanager
def _environment() -> Iterator[dict[str, str]]:
    """
    Yield the environment of the nodes: by default limited to this machine, in a free ROS domain.

    The domain is reserved: nodes of another `asi run` in it would answer ours and be recorded.
    """
    given = os.environ.get('ROS_DOMAIN_ID')
    if given is not None and not (given.isascii() and given.isdigit() and int(given) <= 232):
        raise InputError(f'ROS_DOMAIN_ID = {given!r} is not allowed: it takes a whole number '
                         'from 0 to 232')
    domains = DOMAINS if given is None else [int(given)]
    for domain in domains:
        if claim := reserve(f'asi_run_domain_{domain}'):
            break
    else:
        raise InputError('another asi run is using ' + (
            'every ROS domain' if given is None else f'ROS_DOMAIN_ID = {given}: unset it'))
    with claim:
        yield {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', **os.environ,
               'ROS_DOMAIN_ID': str(domain)}


def reserve(name: str) -> socket.socket | None:
    """
    Reserve a name until the returned socket is closed; None if another process has it.

    An abstract socket name is unique in a network namespace, which is as far as DDS reaches.
    """
    claim = socket.socket(socket.AF_UNIX)
    try:
        claim.bind(f'\0{name}')
    except OSError:
        claim.close()
        return None
    return claim


def end_with_parent() -> None:
    """Let Linux end this node when the process that started it dies."""
    if sys.platform == 'linux':
        # PR_SET_PDEATHSIG. Of SIGINT, a Python that only begins prints a traceback.
        LIBC.prctl(1, signal.SIGTERM)


@contextmanager
def _nodes(experiment: Experiment, out: Path, environment: Mapping[str, str]
           ) -> Iterator[dict[str, subprocess.Popen]]:
    """Start the nodes; at the end, also after an error, end them and wait for that."""
    prepare(experiment, out)
    (out / 'log').mkdir()
    arguments = {
        'recorder': ['-p', f'output:={out / "bag"}',
                     '-p', f'configuration:={out / "experiment.json"}'],
        'controller': ['--params-file', str(out / 'controller.yaml')],
        'actuator': ['--params-file', str(out / 'actuator.yaml')],
    }
    nodes: dict[str, subprocess.Popen] = {}
    ended_by: float | None = None
    try:
        for name, module in MODULES.items():
            with open(out / 'log' / f'{name}.log', 'w') as log, interrupt_later():
                # In a new session, so that Ctrl-C in the terminal reaches only this process.
                nodes[name] = subprocess.Popen(
                    [sys.executable, '-m', module, '--ros-args', *arguments[name]],
                    stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT,
                    env=dict(environment), start_new_session=True, preexec_fn=end_with_parent)
        yield nodes
    except KeyboardInterrupt:
        # All at once, as by ros2 launch: one after the other takes longer.
        ended_by = time.monotonic() + PATIENCE_S
        for process in nodes.values():
            process.send_signal(signal.SIGINT)
        raise
    finally:
        _stop(nodes, ended_by)
    failed = [name for name, process in nodes.items() if process.returncode]
    if failed:
        raise RunFailedError(_failure(failed[0], nodes[failed[0]], out))


def _stop(nodes: Mapping[str, subprocess.Popen], ended_by: float | None) -> None:
    """End the nodes one after the other; kill those that still run at `ended_by`, if given."""
    for name in reversed(MODULES):
        process = nodes.get(name)
        if process is None or process.poll() is not None:
            continue
        process.send_signal(signal.SIGINT)
        try:
            process.wait(PATIENCE_S if ended_by is None else
                         max(0.0, ended_by - time.monotonic()))
        except (subprocess.TimeoutExpired, KeyboardInterrupt):
            process.kill()
            process.wait()


def _raise_if_ended(nodes: Mapping[str, subprocess.Popen], out: Path) -> None:
    for name, process in nodes.items():
        if name != 'actuator' and process.poll() is not None:
            raise RunFailedError(_failure(name, process, out))


def _raise_if_fault(actuator: 'ActuatorStatus', bag: Path) -> None:
    if actuator.state == 'fault':   # the valve is shut from then on
        raise RunFailedError(f'the actuator ended in a {actuator.text}; the bag so far: {bag}')


def _failure(name: str, process: subprocess.Popen, out: Path) -> str:
    """Return how a node ended, and the last line of its log."""
    path = out / 'log' / f'{name}.log'
    lines = [line for line in path.read_text(errors='replace').splitlines() if line.strip()]
    status = process.returncode
    how = (f'killed by {signal.Signals(-status).name}' if status is not None and status < 0
           else f'ended with status {status}')
    return f'the {name} {how}: {lines[-1] if lines else "it said nothing"} (see {path})'


class ActuatorStatus(NamedTuple):
    """The last diagnostics of the actuator: its ticks, its state, and the message."""

    ticks: int = 0
    state: str = ''
    text: str = 'starting the nodes'


@contextmanager
def _watched(environment: Mapping[str, str]) -> Iterator[Callable[[], ActuatorStatus]]:
    """
    Yield a function that waits up to POLL_S and returns the last diagnostics of the actuator.

    /diagnostics has two messages a second: subscribing to it does not disturb the loop.
    """
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE',
                          environment['ROS_AUTOMATIC_DISCOVERY_RANGE'])
    last = ActuatorStatus()
    # The nodes run already. Ctrl-C in an import would end this command at once, so that it could
    # not say where the bag is; in a call of rclpy it is another error.
    with interrupt_later():
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.signals import SignalHandlerOptions

        from asi_common.node.diagnostics import LOOP
        from asi_common.writable import choose_log_folder

        def receive(message: DiagnosticArray) -> None:
            nonlocal last
            for status in message.status:
                if status.name == f'asi_actuator{LOOP}':
                    values = {value.key: value.value for value in status.values}
                    last = ActuatorStatus(int(values.get('ticks', 0)), values.get('state', ''),
                                          status.message)

        choose_log_folder()
        context = rclpy.Context()
        rclpy.init(args=[], context=context, domain_id=int(environment['ROS_DOMAIN_ID']),
                   signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node('asi_run', context=context, enable_rosout=False,
                                 start_parameter_services=False)
        node.create_subscription(DiagnosticArray, '/diagnostics', receive, QUEUE)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)

    def status() -> ActuatorStatus:
        executor.spin_once(timeout_sec=POLL_S)
        return last

    try:
        yield status
    finally:
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()


def run(actuator: Mapping[str, Value], controller: Mapping[str, Value], duration_s: float = 1.0,
        *, mode: str = 'lockstep', rate_hz: float = 0.0, out: str | Path | None = None,
        progress: Progress = silent, plant: str = 'actuator') -> Run:
    """
    Run one experiment over ROS: actuator, controller and recorder as processes; return its bag.

    actuator, controller: parameters by name (doc/reference/parameters.md), the rest at their
    defaults; without `reference.shape` the reference is a step. mode: 'lockstep' (repeatable) or
    'realtime'. rate_hz: control rate, Hz; 0: 5000 in lock-step, 1000 in real time. out: a
    directory that does not exist or is empty; default: runs/TIME-COMPENSATOR. plant: 'joint' runs
    a joint in place of the actuator, with its own parameters; the command is then the reference,
    unless compensator or gain are given. Raises InputError for a parameter that is not allowed,
    RunFailedError if a node fails.

    >>> import asi_analysis as asi
    >>> run = asi.run({}, {'compensator': 'lead4', 'reference.amplitude': 150.0}, 0.5,
    ...               out='runs/lead4')                                   # doctest: +SKIP
    """
    experiment = planned(actuator, controller, duration_s, mode, rate_hz, plant)
    return read_bag(run_experiment(experiment, directory_of(experiment, out), progress))


class RunSummary(Analysis):
    """Result of `asi run`: the keys of `analyze`, and bag, mode, ticks and compensator."""

    def parts(self) -> Iterator[str | Table]:
        yield f'{self.compensator}, {self.mode}, {self.ticks} ticks'
        yield from super().parts()


def summary(experiment: Experiment, bag: Path) -> RunSummary:
    """Return the analysis of a finished run."""
    analysis = analyze(read_bag(bag))
    return RunSummary({'bag': str(bag), 'mode': experiment.mode, 'ticks': experiment.ticks,
                       'compensator': experiment.controller['compensator'], **analysis},
                      **vars(analysis))


def directory_of(experiment: Experiment, out: str | Path | None) -> Path:
    """Return the directory of an experiment: the given one, or a new one in runs/."""
    name = experiment.controller['compensator'] if experiment.plant == 'actuator' else 'joint'
    return Path(out) if out else free_directory(Path('runs'), str(name))


def free_directory(parent: Path, name: str) -> Path:
    """Return PARENT/TIME-NAME, a directory that does not exist."""
    stem = f'{time.strftime("%Y-%m-%d_%H-%M-%S")}-{name}'
    for number in range(1, 1000):
        path = parent / (stem if number == 1 else f'{stem}-{number}')
        if not path.exists():
            return path
    raise InputError(f'{parent}: no free name left for {stem}')
