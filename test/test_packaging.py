"""What is shipped for an installation fits setup.py: the lock file, pixi.toml, the container."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from importlib.metadata import requires, version
from pathlib import Path
from xml.etree import ElementTree

import pytest
from conftest import ROOT
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name


def needed(*extras: str) -> dict[str, Requirement]:
    """Return the requirements of the installed package, by name, with those of extras."""
    known = map(Requirement, requires('asi_actuator') or ())
    return {canonicalize_name(each.name): each for each in known
            if each.marker is None or any(each.marker.evaluate({'extra': one})
                                          for one in extras)}


def locked() -> dict[str, list[tuple[str, int]]]:
    """Return version and number of hashes of each package of the lock file."""
    found: dict[str, list[tuple[str, int]]] = {}
    for block in re.split(r'\n(?=[a-z0-9])', (ROOT / 'requirements.lock').read_text()):
        if match := re.match(r'([a-z0-9][\w.-]*)(?:\[\w+\])?==([^\s;]+)', block):
            found.setdefault(canonicalize_name(match[1]), []).append(
                (match[2], block.count('--hash=sha256:')))
    return found


def pip_line() -> str:
    """Return what README.md has pip install beside a ROS installation."""
    found, = re.findall(r'^pip install (mcap .+)$', (ROOT / 'README.md').read_text(), re.M)
    return str(found)


def test_every_dependency_has_a_lower_and_an_upper_bound() -> None:
    """But those of ROS, which go together; also those of the extras that a user may take."""
    extras = ('cluster', 'pandas', 'live', 'view', 'mujoco')
    assert {'dask', 'pandas', 'nicegui', 'rerun-sdk', 'mujoco'} <= needed(*extras).keys()
    for name, wanted in needed(*extras).items():
        bounds = {each.operator for each in wanted.specifier}
        assert name.startswith('ros-') or {'>=', '<'} <= bounds, wanted


def test_the_lock_file_has_what_the_two_commands_need_with_hashes() -> None:
    lock = locked()
    for name, wanted in needed('test').items():
        assert name in lock, f'{name}: write requirements.lock anew (doc/how_to/security.md)'
        assert all(wanted.specifier.contains(number) for number, _ in lock[name]), name
    assert all(hashes for each in lock.values() for _, hashes in each)


def test_pixi_has_every_requirement() -> None:
    pixi = tomllib.loads((ROOT / 'pixi.toml').read_text())
    given = {canonicalize_name(name.removesuffix('-base')): bound
             for table in ('dependencies', 'pypi-dependencies')
             for name, bound in pixi[table].items()}
    of_ros = {name for name in needed() if name.startswith('ros-jazzy-')}
    assert set(needed()) - of_ros <= given.keys() and 'ros-jazzy-ros' in given
    # What is needed newer than a distribution may have it, as in README.md.
    bounded = [Requirement(each) for each in shlex.split(pip_line()) if '>' in each]
    assert bounded and all(given[each.name] == str(each.specifier) for each in bounded)


def test_the_version_is_that_of_package_xml() -> None:
    assert version('asi_actuator') == ElementTree.parse(ROOT / 'package.xml').findtext('version')


def test_the_container_installs_what_the_readme_says() -> None:
    container = json.loads((ROOT / '.devcontainer/devcontainer.json').read_text())
    assert f'pip install {pip_line()}' in container['onCreateCommand']
    assert 'colcon build --packages-select asi_actuator' in container['postCreateCommand']


@pytest.mark.skipif(shutil.which('make') is None, reason='make is not installed')
def test_make_takes_the_python_that_is_named_or_stops(tmp_path: Path) -> None:
    for name in ('Makefile', 'setup.py', 'setup.cfg', 'pyproject.toml'):
        shutil.copy(ROOT / name, tmp_path)
    (tmp_path / '.venv/bin').mkdir(parents=True)
    (tmp_path / '.venv/bin/python').symlink_to(sys.executable)
    for stamp in ('installed', 'compiled', 'tested', 'diagnosed'):
        (tmp_path / '.venv' / stamp).touch()
    other = tmp_path / 'python'
    other.write_text('#!/bin/sh\necho "(3, 99)"\n')
    other.chmod(0o755)
    results = [subprocess.run(['make', 'setup', f'PYTHON={python}'], cwd=tmp_path,
                              capture_output=True, text=True, env={'PATH': os.environ['PATH']})
               for python in (sys.executable, other)]
    assert [result.returncode for result in results] == [0, 2], results
    assert 'was made with another version' in results[1].stderr


def test_one_benchmark_alone_leaves_the_page_of_all(tmp_path: Path, capsys: pytest.CaptureFixture,
                                                    monkeypatch: pytest.MonkeyPatch) -> None:
    from bench import __main__ as bench
    pages: list[object] = []
    monkeypatch.setattr(bench, 'LAST', tmp_path / 'build/bench.json')
    monkeypatch.setattr(bench, 'run', lambda name, quick: {'name': name})
    monkeypatch.setattr(bench, 'write_page', lambda results, folder: pages.append(results))
    for name in bench.MODULES:
        assert pages == []
        monkeypatch.setattr(sys, 'argv', ['bench', name])
        bench.main()
    assert len(pages) == 1
    assert 'the page is not written' in capsys.readouterr().err
