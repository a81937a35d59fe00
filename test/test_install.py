"""What `colcon build` makes of the package, as users with a ROS 2 installation do."""

import importlib.util
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from conftest import ROOT, NodeProcess

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec('colcon_core') is None,
    reason='colcon is not installed: pip install colcon-common-extensions')


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
        script = f'cd {tmp_path} && . {prefix.parent}/setup.bash && exec "$@"'
        started.append(NodeProcess(['bash', '-c', script, 'bash', *command], environment,
                                   tmp_path / f'{len(started)}.log'))
        return started[-1]

    yield start_executable
    for process in started:
        process.kill()


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
