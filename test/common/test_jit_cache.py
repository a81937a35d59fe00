"""The cache of compiled code: it belongs to its source, and a start needs no place to write."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ROOT

# Prints the folder, the value of 600 sub-steps ago, and whether it was compiled now.
PROBE = """
import numpy as np
from asi_common import jit
from asi_actuator.model.delay import DelaySteps, delay
ring = np.arange(1024.0)
print(jit._FOLDER)
print(delay(ring, 1023, 1023.0, DelaySteps(600, 0.0)))
print('loaded' if sum(delay.stats.cache_hits.values()) else 'compiled')
"""


def without_cache(folder: Path, **environment: str) -> dict[str, str]:
    """Return the environment for the packages in a folder, without the caller's cache."""
    return {name: value for name, value in os.environ.items()
            if name not in ('NUMBA_CACHE_DIR', 'XDG_CACHE_HOME')} | {
        'PYTHONPATH': str(folder), **environment}


# Prints the folder, of which every program takes the same, and compiles nothing.
FOLDER = 'from asi_common import jit; print(jit._FOLDER)'


def start(folder: Path, probe: str = PROBE, **environment: str) -> tuple[list[str], str]:
    """Run a probe on the packages in a folder; return its lines and what it complained of."""
    result = subprocess.run([sys.executable, '-c', probe], capture_output=True, text=True,
                            env=without_cache(folder, **environment), cwd=folder)
    assert result.returncode == 0, result.stderr
    return result.stdout.splitlines(), result.stderr


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """Return a folder with a copy of the packages that the model is in."""
    for package in ('asi_common', 'asi_actuator', 'asi_controller'):
        shutil.copytree(ROOT / package, tmp_path / 'copy' / package,
                        ignore=shutil.ignore_patterns('__pycache__'))
    return tmp_path / 'copy'


def test_changed_constant_of_another_module_is_compiled_in(copy: Path, tmp_path: Path) -> None:
    home = {'HOME': str(tmp_path / 'home')}
    first, _ = start(copy, **home)
    again, _ = start(copy, **home)
    assert first[1:] == ['423.0', 'compiled'] and again == [*first[:2], 'loaded']
    parameters = copy / 'asi_actuator' / 'parameters.py'
    source = parameters.read_text()
    assert 'RING: Final = 1024' in source
    parameters.write_text(source.replace('RING: Final = 1024', 'RING: Final = 512'))
    changed, _ = start(copy, **home)
    # (1023 - 600) modulo 512, and the old folder is gone.
    assert changed[1:] == [str(float((1023 - 600) % 512)), 'compiled']
    assert changed[0] != first[0] and not Path(first[0]).exists()


def test_module_that_compiles_nothing_leaves_the_key(copy: Path, tmp_path: Path) -> None:
    home = {'HOME': str(tmp_path / 'home')}
    first, _ = start(copy, **home)
    node = copy / 'asi_actuator' / 'actuator_node.py'
    node.write_text(node.read_text() + '\n# Another line.\n')
    assert start(copy, **home)[0] == [*first[:2], 'loaded']


def test_folder_in_use_is_not_removed(copy: Path, tmp_path: Path) -> None:
    home = {'HOME': str(tmp_path / 'home')}
    environment = without_cache(copy, **home)
    with subprocess.Popen([sys.executable, '-c', FOLDER + '; input()'], stdin=subprocess.PIPE,
                          stdout=subprocess.PIPE, text=True, env=environment, cwd=copy) as running:
        assert running.stdout is not None
        used = Path(running.stdout.readline().strip())
        parameters = copy / 'asi_actuator' / 'parameters.py'
        parameters.write_text(parameters.read_text() + '\n')
        start(copy, FOLDER, **home)
        assert used.exists()
        running.communicate('\n')
    parameters.write_text(parameters.read_text() + '\n')
    start(copy, FOLDER, **home)
    assert not used.exists()


@pytest.mark.parametrize(('given', 'place'), [
    ({'NUMBA_CACHE_DIR': 'n', 'XDG_CACHE_HOME': 'x', 'HOME': 'h'}, 'n'),
    ({'XDG_CACHE_HOME': 'x', 'HOME': 'h'}, 'x/numba'),
    ({'HOME': 'h'}, 'h/.cache/numba'),
    ({'NUMBA_CACHE_DIR': '/proc/none', 'XDG_CACHE_HOME': 'x', 'HOME': 'h'}, 'x/numba')])
def test_place_is_the_first_that_can_be_written(copy: Path, tmp_path: Path,
                                                given: dict[str, str], place: str) -> None:
    lines, complaint = start(
        copy, FOLDER, **{name: str(tmp_path / value) for name, value in given.items()})
    assert Path(lines[0]).is_relative_to(tmp_path / place) and not complaint


def test_without_a_home_that_can_be_written_a_temporary_folder_serves(copy: Path, tmp_path: Path
                                                                      ) -> None:
    (tmp_path / 'tmp').mkdir()
    environment = {'HOME': '/proc', 'TMPDIR': str(tmp_path / 'tmp')}
    lines, complaint = start(copy, **environment)
    assert Path(lines[0]).is_relative_to(tmp_path / 'tmp')
    assert complaint.count('set NUMBA_CACHE_DIR') == 1 and 'Traceback' not in complaint
    again, _ = start(copy, **environment)
    assert again == [*lines[:2], 'loaded']


def test_temporary_folder_of_another_user_is_not_used(copy: Path, tmp_path: Path) -> None:
    foreign = tmp_path / 'tmp' / f'asi_actuator-{os.getuid()}'
    foreign.mkdir(parents=True)
    foreign.chmod(0o777)
    lines, _ = start(copy, FOLDER, HOME='/proc', TMPDIR=str(tmp_path / 'tmp'))
    assert not Path(lines[0]).is_relative_to(foreign)


def test_start_where_nothing_can_be_written_compiles_without_a_cache(copy: Path) -> None:
    # Where there is no temporary folder either, Python takes the current one.
    program = ('import tempfile\ntempfile.tempdir = "/proc"\n' + PROBE)
    result = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True,
                            env=without_cache(copy, HOME='/proc'))
    assert result.stdout.splitlines() == ['None', '423.0', 'compiled']
    assert result.stderr.count('set NUMBA_CACHE_DIR') == 1 and 'Traceback' not in result.stderr
