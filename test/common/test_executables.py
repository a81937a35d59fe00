"""What `ros2 run` starts: the entry points, and signals while a node is still importing."""

import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from conftest import PATIENCE_S, ROOT, NodeProcess, wait_until
from rclpy.parameter_client import AsyncParameterClient

from asi_analysis.bags.bag_file import read_contents
from asi_common.node import executor
from asi_common.writable import choose_folder

# The import of a node, as slow as can be.
SLOW_IMPORT = """
import sys
import time
from asi_actuator import executables

class Slow:
    def find_spec(self, name, path=None, target=None):
        if name == 'asi_actuator.actuator_node':
            print(name, flush=True)
            time.sleep(600.0)

sys.meta_path.insert(0, Slow())
executables.actuator()
"""


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_signal_while_a_node_imports_ends_it_cleanly(number):
    process = subprocess.Popen(
        [sys.executable, '-c', SLOW_IMPORT], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, env={**os.environ, 'PYTHONPATH': str(ROOT)})
    assert process.stdout.readline() == 'asi_actuator.actuator_node\n'
    process.send_signal(number)
    _, complaint = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, complaint) == (0, '')


def test_a_signal_while_a_node_compiles_ends_it_at_once(
        start_node: Callable[..., NodeProcess], ros_environment: dict[str, str],
        tmp_path: Path) -> None:
    ros_environment['NUMBA_CACHE_DIR'] = str(tmp_path)
    node = start_node('asi_actuator.actuator_node')
    node.wait_for('compiling')
    assert node.stop() == 0
    assert 'lockstep at' not in node.text and 'Traceback' not in node.text


# The simulated firmware has no log: it prints that it begins to compile.
FIRMWARE = """
import sys
from asi_actuator.executables import can_actuator
from asi_common.jit import when_compiling

when_compiling(lambda: print('compiling', flush=True))
sys.argv = ['can_actuator', '--pty']
can_actuator()
"""


def test_a_signal_while_the_simulated_firmware_compiles_ends_it_at_once(
        ros_environment: dict[str, str], tmp_path: Path) -> None:
    firmware = NodeProcess([sys.executable, '-c', FIRMWARE],
                           {**ros_environment, 'NUMBA_CACHE_DIR': str(tmp_path / 'empty')},
                           tmp_path / 'log')
    try:
        firmware.wait_for('compiling')
        assert (firmware.stop(), firmware.text) == (0, 'compiling\n')
    finally:
        firmware.kill()


# A signal comes while a node is made; with more signals than one, as from `ros2 launch`.
SIGNAL_FIRST = """
import signal
import sys
import time
from rclpy.node import Node
from asi_common.node import executor as spin

class Made(Node):
    def __init__(self):
        super().__init__('made')
        for number in (signal.SIGINT, signal.SIGINT, signal.SIGTERM):
            signal.raise_signal(number)
        if {hangs}:
            time.sleep(600.0)
        print('made', flush=True)

    def destroy_node(self):
        super().destroy_node()
        print('destroyed', flush=True)

sys.exit(spin.run_node(Made, {at_once}))
"""


@pytest.mark.parametrize(('at_once', 'hangs', 'printed'), [
    (True, False, 'made\ndestroyed\n'), (False, False, 'made\ndestroyed\n'), (True, True, '')])
def test_a_node_that_is_interrupted_while_it_is_made_leaves_the_graph_unless_it_hangs(
        at_once: bool, hangs: bool, printed: str, ros_environment: dict[str, str]) -> None:
    code = SIGNAL_FIRST.replace('{at_once}', str(at_once)).replace('{hangs}', str(hangs))
    result = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                            env={**ros_environment, 'PYTHONPATH': str(ROOT)}, timeout=PATIENCE_S)
    assert (result.returncode, result.stdout, result.stderr) == (0, printed, '')


# A signal comes when the recorder has just made its bag.
RECORDER_SIGNALLED = """
import signal
import sys
from asi_analysis.bags.nodes import recorder_node
from asi_analysis.bags.bag_writer import BagWriter

class Signalled(BagWriter):
    def __init__(self, *arguments):
        super().__init__(*arguments)
        signal.raise_signal(signal.SIGINT)

recorder_node.BagWriter = Signalled
sys.exit(recorder_node.main())
"""


def test_a_recorder_that_is_interrupted_while_it_is_made_finishes_its_bag(
        ros_environment: dict[str, str], tmp_path: Path) -> None:
    result = subprocess.run(
        [sys.executable, '-c', RECORDER_SIGNALLED, '--ros-args', '-p', f'output:={tmp_path}/bag'],
        capture_output=True, text=True, env={**ros_environment, 'PYTHONPATH': str(ROOT)})
    assert result.returncode == 0 and 'Traceback' not in result.stderr, result.stderr
    assert (tmp_path / 'bag' / 'metadata.yaml').is_file()
    assert read_contents(tmp_path / 'bag', lambda _: True).problems == []


def test_a_node_that_is_interrupted_again_and_again_ends_cleanly(
        start_node: Callable[..., NodeProcess]) -> None:
    """`ros2 launch` passes on the Ctrl-C that the terminal has sent to the node already."""
    node = start_node('asi_controller.controller_node', mode='realtime')
    node.wait_for('realtime at')
    while node.poll() is None:
        node.send(signal.SIGINT)
        time.sleep(0.001)
    assert node.poll() == 0 and 'Traceback' not in node.text, node.text


def test_ctrl_c_while_asi_imports_ends_it_with_one_line() -> None:
    code = SLOW_IMPORT
    for old, new in (('from asi_actuator import executables',
                      'from asi_analysis.command import asi'),
                     ('asi_actuator.actuator_node', 'asi_analysis.cli'),
                     ('executables.actuator()', 'asi()')):
        code = code.replace(old, new)
    process = subprocess.Popen(
        [sys.executable, '-c', code], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, env={**os.environ, 'PYTHONPATH': str(ROOT)})
    assert process.stdout is not None and process.stdout.readline() == 'asi_analysis.cli\n'
    process.send_signal(signal.SIGINT)
    _, complaint = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, complaint) == (130, 'asi: interrupted\n')


# A library that makes another error of any exception while it is imported, as pybind11 does.
LOST_AT_IMPORT = """
import signal
import sys
import asi_analysis.cli
from asi_analysis.command import asi

class Lossy:
    def find_spec(self, name, path=None, target=None):
        if name == 'lossy':
            try:
                signal.raise_signal(signal.SIGINT)
            except BaseException:
                raise ImportError('initialization failed') from None

def main():
    import lossy

sys.meta_path.insert(0, Lossy())
asi_analysis.cli.main = main
sys.exit(asi())
"""


def test_ctrl_c_is_not_lost_in_an_import_of_a_command() -> None:
    result = subprocess.run([sys.executable, '-c', LOST_AT_IMPORT], capture_output=True, text=True,
                            env={**os.environ, 'PYTHONPATH': str(ROOT)}, timeout=PATIENCE_S)
    assert (result.returncode, result.stderr) == (130, 'asi: interrupted\n')


# A Ctrl-C that comes while Python ignores exceptions.
IGNORED = """
import signal
import sys
import time
import asi_analysis.cli
from asi_analysis.command import asi

class Callback:
    def __del__(self):
        signal.raise_signal(signal.SIGINT)

def main():
    Callback()
    time.sleep(600.0)

asi_analysis.cli.main = main
sys.exit(asi())
"""


def test_ctrl_c_is_not_lost_where_python_ignores_exceptions() -> None:
    result = subprocess.run([sys.executable, '-c', IGNORED], capture_output=True, text=True,
                            env={**os.environ, 'PYTHONPATH': str(ROOT)}, timeout=PATIENCE_S)
    assert (result.returncode, result.stderr) == (130, 'asi: interrupted\n')


# A node whose middleware never lets go, as Fast DDS was seen to, with Python's lock held.
HANGING_END = """
import ctypes
from rclpy.node import Node
from asi_common.node import executor as spin

class Hanging(Node):
    def __init__(self):
        super().__init__('hanging')
        self.create_timer(0.01, self.finish)

    def finish(self):
        raise spin.RunFinished

    def destroy_node(self):
        ctypes.PyDLL(None).sleep(600)

spin.END_S = 1.0
spin.run_node(Hanging)
"""


def test_node_that_hangs_as_it_ends_says_where_and_exits(ros_environment):
    result = subprocess.run([sys.executable, '-c', HANGING_END], capture_output=True, text=True,
                            env={**ros_environment, 'PYTHONPATH': str(ROOT)})
    assert result.returncode == 1
    assert 'in destroy_node' in result.stderr


@pytest.mark.parametrize('home', ['/proc/none', None])
def test_node_starts_where_no_home_can_be_written(home, ros_environment, tmp_path):
    code = ('from rclpy.node import Node; from asi_common.node import executor as spin\n'
            'class Done(Node):\n'
            '    def __init__(self):\n'
            '        super().__init__("done")\n'
            '        self.create_timer(0.01, self.finish)\n'
            '    def finish(self):\n'
            '        raise spin.RunFinished\n'
            'raise SystemExit(spin.run_node(Done))')
    given = {name: value for name, value in ros_environment.items()
             if name not in ('ROS_LOG_DIR', 'ROS_HOME', 'HOME')} | ({'HOME': home} if home else {})
    result = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, env={
        **given, 'PYTHONPATH': str(ROOT), 'TMPDIR': str(tmp_path)})
    assert (result.returncode, result.stderr) == (0, '')
    assert list(tmp_path.glob('*/ros_log_dir/*'))


def test_folder_that_cannot_be_written_is_replaced(monkeypatch, tmp_path):
    monkeypatch.setattr(tempfile, 'tempdir', str(tmp_path))
    monkeypatch.setenv('HOME', '/proc/none')
    monkeypatch.setenv('MPLCONFIGDIR', '')
    choose_folder('MPLCONFIGDIR', '~/.config/matplotlib')
    assert Path(os.environ['MPLCONFIGDIR']).is_relative_to(tmp_path)
    choose_folder('MPLCONFIGDIR', tmp_path / 'another')     # a folder that is given stays
    assert not (tmp_path / 'another').exists()


EXECUTABLES = re.findall(r"'(\w+) = ([\w.]+\.executables):(\w+)'",
                         (ROOT / 'setup.py').read_text())


@pytest.mark.parametrize('name, module, function', EXECUTABLES)
def test_nothing_that_takes_time_is_imported_before_ctrl_c_is_handled(name, module, function):
    """As Python starts without site, for which an environment may import more."""
    code = f"""
import os, sys
before = {{*sys.modules, *sys.builtin_module_names}}
import {module}
print(*(set(sys.modules) - before))"""
    found = subprocess.run([sys.executable, '-S', '-c', code], capture_output=True, text=True,
                           env={'PYTHONPATH': str(ROOT)}, check=True).stdout.split()
    assert module in found
    assert [each for each in found if not each.startswith('asi_')] == []


@pytest.mark.parametrize('name, module, function', EXECUTABLES)
def test_every_executable_says_what_it_cannot_do(name, module, function):
    code = f'import sys; from {module} import {function}; sys.exit({function}())'
    result = subprocess.run(
        [sys.executable, '-c', code, '--ros-args', '--remap', 'no_rule'], capture_output=True,
        text=True, env={**os.environ, 'PYTHONPATH': str(ROOT)})
    assert name == function
    assert (result.returncode, 'Traceback' in result.stderr) == (2, False)
    assert 'no_rule' in result.stderr or 'socketcan' in result.stderr


@pytest.mark.parametrize('argument, status', [
    ('--help', 0), ('my_run', 2), pytest.param('--params-file', 2, marks=pytest.mark.slow)])
@pytest.mark.parametrize('module, function', [row[1:] for row in EXECUTABLES
                                              if row[0] != 'can_actuator'])
def test_a_node_says_which_arguments_it_takes(module, function, argument, status, tmp_path):
    code = f'import sys; from {module} import {function}; sys.exit({function}())'
    result = subprocess.run([sys.executable, '-c', code, argument], capture_output=True, text=True,
                            env={**os.environ, 'PYTHONPATH': str(ROOT)}, cwd=tmp_path)
    assert result.returncode == status, result.stderr
    assert '--ros-args -p NAME:=VALUE' in result.stdout + result.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize('name', ['actuator', 'controller'])
def test_a_warning_of_python_is_a_log_line_of_the_node(name, tmp_path):
    module, function = next(row[1:] for row in EXECUTABLES if row[0] == name)
    # No place for compiled code but the temporary directory, of which there is a warning.
    places = dict.fromkeys(('HOME', 'NUMBA_CACHE_DIR', 'XDG_CACHE_HOME'), '/proc')
    said = subprocess.run(
        [sys.executable, '-c', f'from {module} import {function}; {function}()', '--help'],
        env={**os.environ, **places, 'PYTHONPATH': str(ROOT)}, cwd=tmp_path, text=True,
        capture_output=True).stderr
    assert re.fullmatch(r'\[WARN\] \[[\d.]+\] \[asi\]: compiled code .*\n', said), said


def test_every_executable_is_tried():
    assert {name for name, *_ in EXECUTABLES} == {
        'actuator', 'can_actuator', 'controller', 'recorder', 'replay'}


def test_ctrl_c_beside_a_fork_is_not_lost() -> None:
    """Python ignores what functions beside a fork raise, a KeyboardInterrupt too."""
    said = subprocess.run([sys.executable, '-c', """
import os, signal, subprocess
from asi_common.executable import interrupt_later
os.register_at_fork(after_in_parent=lambda: signal.raise_signal(signal.SIGINT))
try:
    with interrupt_later():
        subprocess.Popen(['true'], preexec_fn=lambda: None).wait()
except KeyboardInterrupt:
    print('interrupted')
"""], capture_output=True, text=True, check=True)
    assert (said.stdout, said.stderr) == ('interrupted\n', '')


def test_each_step_of_an_answer_of_a_service_is_taken_at_the_next_tick(
        ros_node: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """And not at the next look for events of the middleware, as the recorder's requests were."""
    monkeypatch.setattr(executor, 'EVENT_PERIOD_NS', 10**9 * 10**6)
    names: list[str] = []
    client = AsyncParameterClient(ros_node, ros_node.get_name())
    assert client.wait_for_services(PATIENCE_S)
    client.list_parameters(callback=lambda listed: client.get_parameters(
        listed.result().result.names,
        callback=lambda values: names.extend(map(str, values.result().values))))
    wait_until(lambda: names, 'the answer of the second service')
