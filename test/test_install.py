"""What `colcon build` makes of the package, as users with a ROS 2 installation do; with `ros2`."""

import contextlib
import hashlib
import importlib.util
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml
from conftest import ROOT, NodeProcess, wait_until

from asi_analysis.bags.bag import read_bag
from asi_common import jit

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec('colcon_core') is None,
    reason='colcon is not installed: pip install colcon-common-extensions')


needs_ros2 = pytest.mark.skipif(
    shutil.which('ros2') is None, reason='there is no ros2 command line here')
LAUNCH = ('ros2', 'launch', 'asi_actuator', 'asi_actuator.launch.py')


@pytest.fixture(scope='module')
def prefix(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return where colcon has installed the package."""
    base = tmp_path_factory.mktemp('workspace')
    result = subprocess.run(
        [sys.executable, '-m', 'colcon', '--log-base', str(base / 'log'), 'build',
         '--paths', str(ROOT), '--build-base', str(base / 'build'),
         '--install-base', str(base / 'install')],
        cwd=base, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    return base / 'install' / 'asi_actuator'


@pytest.fixture
def start(prefix: Path, ros_environment: dict[str, str], tmp_path: Path) -> Iterator[
        Callable[..., NodeProcess]]:
    """Return a function that starts an installed executable as `ros2 run` does."""
    started: list[NodeProcess] = []
    environment = {name: value for name, value in ros_environment.items() if name != 'PYTHONPATH'}

    def start_executable(*command: str) -> NodeProcess:
        # Not in the root of the repository, where the package would be found without install.
        # In a session of its own: `ros2` waits for what it has started, which a Ctrl-C in a
        # terminal ends too.
        script = f'cd {tmp_path} && . {prefix.parent}/setup.bash && exec setsid "$@"'
        started.append(NodeProcess(['bash', '-c', script, 'bash', *command], environment,
                                   tmp_path / f'{len(started)}.log'))
        return started[-1]

    yield start_executable
    for process in started:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.kill()


@pytest.fixture
def compiled(prefix: Path) -> Iterator[None]:
    """
    Give the installed modules the compiled code of these, which takes half a minute otherwise.

    Numba keeps it in a folder named after that of the module, and loads it for the same source.
    If it finds none there, it compiles.
    """
    root = next(prefix.glob('lib/python*/site-packages'))
    here = jit._FOLDER
    assert here is not None
    own = here.parents[1] / f'asi_actuator-{hashlib.sha256(bytes(root)).hexdigest()[:12]}'

    def kept(base: Path, module: Path) -> Path:
        return base / f'{module.name}_{hashlib.sha1(str(module).encode()).hexdigest()}'

    for package in ('asi_common', 'asi_actuator', 'asi_controller'):
        for module in (ROOT / package, *(ROOT / package).rglob('*/')):
            if kept(here, module).is_dir():
                shutil.copytree(kept(here, module), kept(
                    own / here.name, root / module.relative_to(ROOT)), dirs_exist_ok=True)
    yield
    shutil.rmtree(own, ignore_errors=True)   # nobody else has a use for it


def interrupt(process: NodeProcess) -> int:
    """Press Ctrl-C; return the exit status."""
    os.killpg(process.pid, signal.SIGINT)
    return process.exit_status()


def test_everything_is_where_ros_looks_for_it(prefix: Path) -> None:
    executables = {path.name for path in (prefix / 'lib' / 'asi_actuator').iterdir()}
    assert {'actuator', 'controller', 'recorder', 'replay', 'asi'} <= executables
    share = prefix / 'share'
    assert (share / 'ament_index/resource_index/packages/asi_actuator').is_file()
    for name in ('package.xml', 'config/actuator.yaml', 'config/controller.yaml',
                 'launch/asi_actuator.launch.py'):
        assert (share / 'asi_actuator' / name).read_bytes() == (ROOT / name).read_bytes()


def test_installed_layout_of_the_frames_is_found(prefix: Path, start: Callable) -> None:
    process = start(str(prefix / 'lib' / 'asi_actuator' / 'can_actuator'), '--load', '1000')
    assert process.exit_status() == 0, process.text
    assert [line.split()[0] for line in process.text.splitlines()] == [
        'frame', 'COMMAND', 'STATE_FORCE', 'STATE_MOTION', 'all']
    assert process.text.split()[-1] == '38.5'


@pytest.mark.usefixtures('compiled')
def test_installed_nodes_run_with_the_installed_parameter_files(
        prefix: Path, start: Callable) -> None:
    config = prefix / 'share' / 'asi_actuator' / 'config'
    executables = prefix / 'lib' / 'asi_actuator'
    controller = start(str(executables / 'controller'), '--ros-args',
                       '--params-file', str(config / 'controller.yaml'))
    actuator = start(str(executables / 'actuator'), '--ros-args', '--params-file',
                     str(config / 'actuator.yaml'), '-p', 'duration:=0.02')
    assert actuator.exit_status() == 0, actuator.text
    assert controller.stop() == 0, controller.text
    where = start(sys.executable, '-c', 'import asi_actuator, sys; '
                  'from ament_index_python import get_package_prefix; '
                  'print(asi_actuator.__file__); print(get_package_prefix("asi_actuator"))')
    assert where.exit_status() == 0, where.text
    module, package = where.text.splitlines()
    assert Path(module).is_relative_to(prefix) and Path(package) == prefix


@pytest.fixture
def no_daemon(ros_environment: dict[str, str]) -> Iterator[None]:
    """End the daemon that `ros2` has started in the test's domain."""
    yield
    subprocess.run(['ros2', 'daemon', 'stop'], env=ros_environment, check=False)


def said(start: Callable, *command: str) -> str:
    """Return what a call of `ros2` prints, once it finds the node that it is about."""
    def found() -> NodeProcess | None:
        process = start(*command)
        status = process.exit_status()
        if 'Node not found' in process.text:   # it looks for half a second
            return None
        assert status == 0, process.text
        return process
    return str(wait_until(found, ' '.join(command)).text)


def lines_of_readme() -> list[str]:
    """Return what the README has a user type after the build, without the comments."""
    section = (ROOT / 'README.md').read_text().split('## The ROS 2 way')[1]
    lines = section.split('```sh')[1].split('```')[0].strip().splitlines()
    typed = [re.split(r' {2,}# ', line)[0].strip() for line in lines]
    return typed[1 + next(k for k, line in enumerate(typed) if 'colcon build' in line):]


def test_the_lines_of_the_readme_are_found() -> None:
    assert len(lines := lines_of_readme()) == 8 and all(line.startswith('ros2') for line in lines)


@needs_ros2
@pytest.mark.usefixtures('no_daemon')
def test_each_line_of_the_readme_does_what_it_says(start: Callable, tmp_path: Path) -> None:
    actuator, controller, *turned, echo, record, play = lines_of_readme()
    nodes = [start(*shlex.split(line)) for line in (actuator, controller)]
    for node in nodes:
        node.wait_for('Hz')
    for line in turned:
        assert said(start, *shlex.split(line)).strip() == 'Set parameter successful'
    echoed = start(*shlex.split(echo))
    echoed.wait_for('frame_id')
    interrupt(echoed)   # its exit status is that of ros2
    recorder = start(*shlex.split(record))
    bag = tmp_path / 'my_run'
    wait_until(lambda: sum(file.stat().st_size for file in bag.glob('*.mcap')) > 100_000,
               'messages in the bag', lambda: recorder.text)
    for process in (recorder, *nodes):
        assert interrupt(process) == 0 and 'Traceback' not in process.text, process.text
    assert 'lost' not in recorder.text
    run = read_bag(bag)
    assert run.force_n is not None and run.force_n.max() > 50.0
    about, played = (shlex.split(part) for part in play.split('&&'))
    if start('ros2', 'bag', '--help').exit_status() != 0:
        assert about[:3] + played[:3] == ['ros2', 'bag', 'info', 'ros2', 'bag', 'play']
        return   # it is C++, and not among the wheels
    for line in (about, played):
        assert start(*line).exit_status() == 0


@needs_ros2
@pytest.mark.usefixtures('no_daemon')
@pytest.mark.parametrize('file', sorted(
    path.name for path in (ROOT / 'config').glob('*.yaml')
    if '/**/asi_' in path.read_text()))
def test_launch_with_a_parameter_file_is_as_run_with_it(
        file: str, prefix: Path, start: Callable, tmp_path: Path) -> None:
    path = prefix / 'share' / 'asi_actuator' / 'config' / file

    def dumped(node: str) -> dict:
        text = said(start, 'ros2', 'param', 'dump', node)
        return dict(yaml.safe_load(text)[node]['ros__parameters'])

    def both(*processes: NodeProcess) -> list[dict]:
        for name in ('actuator', 'controller'):
            wait_until(lambda name=name: any(f'asi_{name}]:' in each.text for each in processes),
                       f'the {name}', lambda: ''.join(each.text for each in processes))
        found = [dumped(f'/asi_{name}') for name in ('actuator', 'controller')]
        for each in processes:
            assert interrupt(each) == 0, each.text
        return found

    assert both(start(*LAUNCH, f'params_file:={path}')) == both(*(
        start('ros2', 'run', 'asi_actuator', name, '--ros-args', '--params-file', str(path))
        for name in ('actuator', 'controller')))


@needs_ros2
def test_ctrl_c_of_launch_ends_all_and_the_bag_is_whole(start: Callable, tmp_path: Path) -> None:
    # So slow that the recorder loses nothing on a busy machine either; a loss is its status 1.
    launched = start(*LAUNCH, 'mode:=realtime', 'rate_hz:=200', 'reference:=sine',
                     'record:=my_run')
    wait_until(lambda: sum(file.stat().st_size for file in tmp_path.glob('my_run/*.mcap'))
               > 20_000, 'messages in the bag', lambda: launched.text)
    assert interrupt(launched) == 0
    for word in ('Traceback', 'SIGTERM', 'SIGKILL', 'process has died'):
        assert word not in launched.text
    assert len(read_bag(tmp_path / 'my_run')) > 0


@needs_ros2
@pytest.mark.parametrize(('limit_n', 'status'), [(1e4, 0), (1.0, 1)])
def test_launch_ends_with_the_run_and_says_if_that_ended_in_a_fault(
        limit_n: float, status: int, start: Callable, tmp_path: Path) -> None:
    (tmp_path / 'limit.yaml').write_text(yaml.safe_dump(
        {'/**/asi_actuator': {'ros__parameters': {'limit.force': limit_n}}}))
    launched = start(*LAUNCH, 'params_file:=limit.yaml', 'reference:=step', 'duration:=0.2')
    assert launched.exit_status() == status, launched.text
    assert ('ended in a fault' in launched.text) == (status == 1)


@needs_ros2
@pytest.mark.parametrize(('argument', 'told'), [
    ('gain:=eight', 'gain:=eight is not allowed: it takes a number'),
    ('params_file:=missing.yaml', 'there is no such file'),
    ('reference:=sin', 'reference.shape'), ('record:=/dev/null', '/dev/null')])
def test_launch_ends_all_if_an_argument_is_wrong(
        argument: str, told: str, start: Callable) -> None:
    launched = start(*LAUNCH, argument)
    assert launched.exit_status() == 1, launched.text
    assert told in launched.text and 'Traceback' not in launched.text, launched.text
    with pytest.raises(ProcessLookupError):   # nothing is left of its session
        os.killpg(launched.pid, 0)
