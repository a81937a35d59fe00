"""
`asi run`: one experiment. Recorder, controller and actuator as processes, from start to stop.

The actuator ends by itself when the time is up; the others are asked to (SIGINT). Whatever
happens, Ctrl-C and errors included, no process is left behind and the bag so far is whole.
"""

import ctypes
import fcntl
import importlib.metadata
import json
import os
import platform
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Final

import yaml

from asi_actuator.node_parameters import ACTUATOR_NODE_PARAMETERS, DEFAULT_RATE_HZ
from asi_actuator.parameters import (
    ACTUATOR_PARAMETERS,
    Parameter,
    ParameterError,
    Value,
    completed,
)
from asi_analysis.errors import InputError
from asi_analysis.terminal import Progress, silent
from asi_controller.parameters import (
    COMPENSATOR_PARAMETERS,
    CONTROLLER_NODE_PARAMETERS,
    REFERENCE_PARAMETERS,
)

CONTROLLER_PARAMETERS: Final = COMPENSATOR_PARAMETERS + REFERENCE_PARAMETERS
TABLES: Final = {'actuator': ACTUATOR_PARAMETERS, 'controller': CONTROLLER_PARAMETERS}
OF_THE_NODE: Final = frozenset(
    parameter.name for parameter in ACTUATOR_NODE_PARAMETERS + CONTROLLER_NODE_PARAMETERS)
# Started in this order, asked to end in the reverse: while the recorder waits for the last
# messages, the controller is still there to send a lost one again.
MODULES: Final = {'controller': 'asi_controller.controller_node',
                  'recorder': 'asi_analysis.recorder_node',
                  'actuator': 'asi_actuator.actuator_node'}
# The ports of these domains are clear of those that Linux hands out.
DOMAINS: Final = range(42, 102)
# A node that is asked to end and does not within this time is killed.
PATIENCE_S: Final = 15.0
POLL_S: Final = 0.1
# Loaded here, not between fork and exec, where a lock of another thread may be held.
LIBC: Final = ctypes.CDLL(None)



class RunFailedError(RuntimeError):
    """A node failed; the text names it and its last words."""


@dataclass(frozen=True)
class Experiment:
    """What is to be run: parameters by name, the rest at their defaults."""

    actuator: Mapping[str, Value] = field(default_factory=dict)
    controller: Mapping[str, Value] = field(default_factory=dict)
    duration_s: float = 1.0
    mode: str = 'lockstep'
    rate_hz: float = 0.0      # 0: the default of the mode

    @property
    def control_rate_hz(self) -> float:
        """The rate at which the loop is closed."""
        return self.rate_hz or DEFAULT_RATE_HZ[self.mode]

    @property
    def of_the_node(self) -> dict[str, Value]:
        """What the actuator's node is told around the physics."""
        return {'mode': self.mode, 'rate_hz': float(self.rate_hz),
                'duration': float(self.duration_s)}

    @property
    def ticks(self) -> int:
        """How many states the actuator is to publish."""
        return round(self.duration_s * self.control_rate_hz)


def checked(experiment: Experiment) -> Experiment:
    """Return the experiment with every parameter; raises InputError if one is not allowed."""
    try:
        from asi_controller.compensator import design, discretise
        completed(experiment.of_the_node, ACTUATOR_NODE_PARAMETERS)
        controller = completed(experiment.controller, CONTROLLER_PARAMETERS)
        discretise(design({p.name: controller[p.name] for p in COMPENSATOR_PARAMETERS}),
                   experiment.control_rate_hz)
        complete = Experiment(completed(experiment.actuator, ACTUATOR_PARAMETERS), controller,
                              experiment.duration_s, experiment.mode, experiment.rate_hz)
    except ParameterError as error:
        raise InputError(str(error)) from None
    if complete.ticks < 1:
        raise InputError(f'duration = {complete.duration_s:g} s is not allowed: it takes at least '
                         f'a period of {1.0 / complete.control_rate_hz:g} s')
    return complete


def read_parameters(path: Path, which: str) -> dict[str, Value]:
    """
    Return the parameters of a ROS parameter file for 'actuator' or 'controller', by dotted name.

    The node may be named asi_actuator, /asi_actuator, /**/asi_actuator or /**. Parameters of the
    node alone, such as its mode, are left out: `asi run` sets them. Raises InputError.
    """
    try:
        content = yaml.safe_load(path.read_text())
    except OSError as error:
        raise InputError(f'{path}: {error.strerror}') from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f'{path} is not YAML: {" ".join(str(error).split())}') from None
    names = ('/**', f'/**/asi_{which}', f'/asi_{which}', f'asi_{which}')
    values: dict[str, Value] = {}
    found = [content[name] for name in names
             if isinstance(content, dict) and name in content]
    for section in found:
        if not isinstance(section, dict) or not isinstance(section.get('ros__parameters'), dict):
            raise InputError(f'{path}: ros__parameters is missing under the node')
        values |= dict(_flat(section['ros__parameters']))
    if not found:
        raise InputError(f'{path} has nothing for the node asi_{which}: it takes a ROS parameter '
                         f'file with asi_{which}: ros__parameters: ...')
    known = {parameter.name: parameter for parameter in TABLES[which]}
    return {name: _as_meant(known[name], value) if name in known else value
            for name, value in values.items() if name not in OF_THE_NODE}


def _flat(tree: Mapping[str, Any], prefix: str = '') -> Iterator[tuple[str, Value]]:
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f'{prefix}{name}.')
        else:
            yield prefix + str(name), value


def _as_meant(parameter: Parameter, value: Value) -> Value:
    """Return 8 as 8.0 where a number is wanted; a text of digits stays what YAML says it is."""
    if isinstance(parameter.default, float) and type(value) is int:
        return float(value)
    return value


def parse_setting(text: str) -> tuple[str, str, Value]:
    """
    Return (actuator or controller, parameter, value) of 'actuator.load.type=spring'.

    Raises InputError if it is not of that form or names no parameter.
    """
    name, sign, value = text.partition('=')
    which, _, parameter = name.strip().partition('.')
    if not sign or which not in TABLES:
        raise InputError(f'--set {text}: it takes actuator.NAME=VALUE or controller.NAME=VALUE')
    known = {each.name: each for each in TABLES[which]}
    if parameter not in known:
        import difflib
        near = difflib.get_close_matches(parameter, known, 3)
        hint = f'; did you mean {", ".join(near)}?' if near else ''
        raise InputError(f'--set {text}: {parameter!r} is not a parameter of the {which}{hint}')
    table_entry = known[parameter]
    if isinstance(table_entry.default, str):
        return which, parameter, value.strip()
    try:
        return which, parameter, _as_meant(table_entry, yaml.safe_load(_as_number(value)))
    except yaml.YAMLError:
        raise InputError(f'--set {text}: {value!r} is not a value') from None


def _as_number(text: str) -> str:
    """Return 1e5 as 1.0e+5: YAML 1.1 takes the first for a text."""
    try:
        return repr(float(text)) if re.search(r'\d[eE]', text) else text
    except ValueError:
        return text


def gather(files: Mapping[str, Path | None], settings: list[str],
           named: Mapping[str, Mapping[str, Value | None]], duration_s: float
           ) -> dict[str, dict[str, Value]]:
    """
    Return the parameters of 'actuator' and 'controller' from files, --set and named options.

    The later wins; a named option that is None is not given. With no reference at all it is a
    step; a chirp or ramp without a duration of its own lasts to the end of the run.
    """
    values = {which: read_parameters(path, which) if path else {}
              for which, path in files.items()}
    for text in settings:
        which, name, value = parse_setting(text)
        values[which][name] = value
    for which, options in named.items():
        values[which] |= {name: value for name, value in options.items() if value is not None}
    controller = values['controller']
    shape = controller.setdefault('reference.shape', 'step')
    if shape in ('chirp', 'ramp') and 'reference.duration' not in controller:
        start = float(controller.get('reference.start', 0.05))
        controller['reference.duration'] = max(duration_s - start, 1e-3)
    return values


def versions() -> dict[str, str]:
    """Return the versions of what a run depends on."""
    names = ('asi_actuator', 'numpy', 'numba', 'scipy', 'ros-jazzy-rclpy', 'rosbags')
    found = {'python': platform.python_version()}
    for name in names:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def information(experiment: Experiment) -> dict[str, Any]:
    """Return what goes into the bag as `asi.run`; the same experiment gives the same."""
    return {
        'experiment': {'mode': experiment.mode, 'rate_hz': experiment.control_rate_hz,
                       'duration_s': experiment.duration_s, 'ticks': experiment.ticks},
        'actuator': dict(experiment.actuator),
        'controller': dict(experiment.controller),
        'seed': {'noise': experiment.actuator['force_sensor.noise_seed'],
                 'reference': experiment.controller['reference.seed']},
        'versions': versions(),
    }


def run_experiment(experiment: Experiment, out: Path, progress: Progress = silent) -> Path:
    """
    Run an experiment over ROS and return its bag.

    out: a directory that does not exist or is empty; gets `bag`, `log`, and what was run:
    `experiment.json` and the parameter files of the nodes. Raises InputError for what cannot be
    run, RunFailedError if a node fails. Its ROS domain is ROS_DOMAIN_ID, or one of its own.
    """
    experiment = checked(experiment)
    bag = out / 'bag'
    with (_environment() as environment,
          _nodes(experiment, out, environment) as nodes, _watched(environment) as ticks):
        progress('starting the nodes', None)
        while nodes['actuator'].poll() is None:
            _complain_of_dead(nodes, out)
            done, text = ticks()
            _complain_of_fault(text, bag)
            if done:
                progress(f'{experiment.mode}: {done} of {experiment.ticks} ticks',
                         done / experiment.ticks)
            else:
                progress(text, None)
        if nodes['actuator'].returncode:
            raise RunFailedError(_last_words('actuator', nodes['actuator'], out)
                                 + f'; the bag so far: {bag}')
        progress('finishing the bag', 1.0)
    return bag


def _complain_of_fault(text: str, bag: Path) -> None:
    """Raise if the actuator says that it is in fault: from there on the valve was shut."""
    if text.startswith('fault'):
        raise RunFailedError(f'the actuator ended in a {text}; the bag so far: {bag}')


def _prepare(experiment: Experiment, out: Path) -> None:
    """Write what the nodes are to read."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        if any(out.iterdir()):
            raise InputError(f'{out} is not empty: nothing is overwritten; name another --out')
        (out / 'log').mkdir()
        (out / 'experiment.json').write_text(json.dumps(information(experiment), indent=2) + '\n')
        node = experiment.of_the_node | {'await_recorder': True}
        _write_parameters(out, 'actuator', {**experiment.actuator, **node})
        del node['duration']
        _write_parameters(out, 'controller', {**experiment.controller, **node})
    except OSError as error:
        raise InputError(f'{out}: {error.strerror}') from None


def _write_parameters(out: Path, which: str, values: Mapping[str, Value]) -> None:
    (out / f'{which}.yaml').write_text(yaml.safe_dump(
        {f'asi_{which}': {'ros__parameters': dict(values)}}, sort_keys=False))


@contextmanager
def _environment() -> Iterator[dict[str, str]]:
    """
    Give the environment of the nodes: by default alone on this machine, in a free domain.

    No other `asi run` uses that domain meanwhile: its nodes would answer ours, and be recorded.
    """
    given = os.environ.get('ROS_DOMAIN_ID')
    if given is not None and not (given.isascii() and given.isdigit() and int(given) <= 232):
        raise InputError(f'ROS_DOMAIN_ID = {given!r} is not allowed: it takes a whole number '
                         'from 0 to 232')
    domains = DOMAINS if given is None else [int(given)]
    taken = next((each for each in map(_take_domain, domains) if each), None)
    if taken is None:
        raise InputError('another asi run is using ' + (
            'every ROS domain' if given is None else f'ROS_DOMAIN_ID = {given}: unset it'))
    domain, lock = taken
    with lock:
        yield {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', **os.environ,
               'ROS_DOMAIN_ID': str(domain)}


def _take_domain(domain: int) -> tuple[int, IO[str]] | None:
    """Return a domain and the open file that keeps it ours; None if another process has it."""
    try:
        lock = open(Path(tempfile.gettempdir()) / f'asi_run_domain_{domain}', 'w')
    except OSError:  # of another user
        return None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.close()
        return None
    return domain, lock


def _end_with_parent() -> None:
    """Have Linux send SIGINT to this node when the process that started it dies."""
    if sys.platform == 'linux':
        LIBC.prctl(1, signal.SIGINT)  # PR_SET_PDEATHSIG


@contextmanager
def _nodes(experiment: Experiment, out: Path, environment: Mapping[str, str]
           ) -> Iterator[dict[str, subprocess.Popen]]:
    """Start the nodes; at the end, whatever happened, ask them to end and see that they do."""
    _prepare(experiment, out)
    arguments = {
        'recorder': ['-p', f'output:={out / "bag"}',
                     '-p', f'configuration:={out / "experiment.json"}'],
        'controller': ['--params-file', str(out / 'controller.yaml')],
        'actuator': ['--params-file', str(out / 'actuator.yaml')],
    }
    nodes: dict[str, subprocess.Popen] = {}
    try:
        for name, module in MODULES.items():
            with open(out / 'log' / f'{name}.log', 'w') as log:
                # A session of its own: Ctrl-C in the terminal comes to us alone.
                nodes[name] = subprocess.Popen(
                    [sys.executable, '-m', module, '--ros-args', *arguments[name]],
                    stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT,
                    env=dict(environment), start_new_session=True, preexec_fn=_end_with_parent)
        yield nodes
    finally:
        _stop(nodes)
    failed = [name for name, process in nodes.items() if process.returncode]
    if failed:
        raise RunFailedError(_last_words(failed[0], nodes[failed[0]], out))


def _stop(nodes: Mapping[str, subprocess.Popen]) -> None:
    for name in reversed(MODULES):
        process = nodes.get(name)
        if process is None or process.poll() is not None:
            continue
        process.send_signal(signal.SIGINT)
        try:
            process.wait(PATIENCE_S)
        except (subprocess.TimeoutExpired, KeyboardInterrupt):
            process.kill()
            process.wait()


def _complain_of_dead(nodes: Mapping[str, subprocess.Popen], out: Path) -> None:
    for name, process in nodes.items():
        if name != 'actuator' and process.poll() is not None:
            raise RunFailedError(_last_words(name, process, out))


def _last_words(name: str, process: subprocess.Popen, out: Path) -> str:
    """Say how a node ended and the last line of its log."""
    path = out / 'log' / f'{name}.log'
    lines = [line for line in path.read_text(errors='replace').splitlines() if line.strip()]
    status = process.returncode
    how = (f'killed by {signal.Signals(-status).name}' if status is not None and status < 0
           else f'ended with status {status}')
    return f'the {name} {how}: {lines[-1] if lines else "it said nothing"} (see {path})'


@contextmanager
def _watched(environment: Mapping[str, str]) -> Iterator[Callable[[], tuple[int, str]]]:
    """
    Give a function that waits a moment and returns the actuator's ticks and its state in words.

    From /diagnostics, which comes twice a second: the loop does not notice.
    """
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE',
                          environment['ROS_AUTOMATIC_DISCOVERY_RANGE'])
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    ticks, state = 0, 'starting the nodes'

    def hear(message: DiagnosticArray) -> None:
        nonlocal ticks, state
        for status in message.status:
            if status.name == 'asi_actuator: loop':
                values = {value.key: value.value for value in status.values}
                ticks, state = int(values.get('ticks', 0)), status.message

    context = rclpy.Context()
    rclpy.init(context=context, domain_id=int(environment['ROS_DOMAIN_ID']),
               signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node('asi_run', context=context, enable_rosout=False,
                             start_parameter_services=False)
    node.create_subscription(DiagnosticArray, '/diagnostics', hear, 10)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)

    def look() -> tuple[int, str]:
        executor.spin_once(timeout_sec=POLL_S)
        return ticks, state

    try:
        yield look
    finally:
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()


def run_as_dict(experiment: Experiment, bag: Path) -> dict[str, Any]:
    """Return what `asi run --json` prints of a finished run."""
    from asi_analysis.analysis import analyze_bag
    return {'bag': str(bag), 'mode': experiment.mode, 'ticks': experiment.ticks,
            'compensator': experiment.controller['compensator'], **analyze_bag(bag)}


def run_as_text(document: Mapping[str, Any]) -> str:
    """Return what `asi run` says of a finished run for people."""
    from asi_analysis.analysis import as_text
    return (f'{document["compensator"]}, {document["mode"]}, {document["ticks"]} ticks\n'
            + as_text(document))


def free_directory(parent: Path, name: str) -> Path:
    """Return runs/<time>-<name>, a directory that does not exist."""
    stem = f'{time.strftime("%Y-%m-%d_%H-%M-%S")}-{name}'
    for number in range(1, 1000):
        path = parent / (stem if number == 1 else f'{stem}-{number}')
        if not path.exists():
            return path
    raise InputError(f'{parent}: no free name left for {stem}')
