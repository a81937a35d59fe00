"""An installation that another user may only read: what is computed, and where it is cached."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from common.test_jit_cache import PROBE, without_cache
from conftest import ROOT

from asi_analysis.bags.bag import write_bag
from asi_analysis.measures.analysis import analyze
from torture.inputs import recording

NOBODY = 65534
# Read any file and enter any folder, as the tests and Python may be in root's own; write none.
CAPABILITY = 'dac_read_search'


def as_nobody(*command: str) -> list[str]:
    limits = (f'{option}=-all,+{CAPABILITY}' for option in (
        '--inh-caps', '--ambient-caps', '--bounding-set'))
    return ['setpriv', f'--reuid={NOBODY}', f'--regid={NOBODY}', '--clear-groups', *limits,
            *command]


def why_not() -> str:
    """Return why this cannot be tried here, '' if it can."""
    if os.geteuid() != 0:
        return 'only root can start a process of another user'
    if not shutil.which('setpriv'):
        return 'no setpriv (util-linux)'
    tried = subprocess.run(as_nobody(sys.executable, '-c', ''), capture_output=True, text=True)
    return '' if tried.returncode == 0 else f'setpriv: {tried.stderr.strip()[-200:]}'


pytestmark = pytest.mark.skipif(bool(why_not()), reason=why_not() or 'never')


@pytest.fixture
def public() -> Iterator[Path]:
    """Return a folder that everyone may read; those of pytest are the caller's alone."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        yield Path(folder)


@pytest.fixture
def own(public: Path) -> Path:
    """Return a folder of that user, its only one."""
    folder = public / 'own'
    folder.mkdir()
    os.chown(folder, NOBODY, NOBODY)
    return folder


def start(folder: Path, *command: str) -> subprocess.CompletedProcess[str]:
    environment = without_cache(ROOT, HOME='/nonexistent', TMPDIR=str(folder),
                                PYTHONDONTWRITEBYTECODE='1')
    return subprocess.run(as_nobody(sys.executable, *command), capture_output=True, text=True,
                          env=environment, cwd=folder)


def test_the_installation_cannot_be_written(own: Path) -> None:
    result = start(own, '-c', f'open({str(ROOT / "asi_common" / "new")!r}, "w")')
    assert 'PermissionError' in result.stderr and not (ROOT / 'asi_common' / 'new').exists()


def test_compiled_code_is_cached_in_a_folder_of_the_user(own: Path) -> None:
    first, again = start(own, '-c', PROBE), start(own, '-c', PROBE)
    assert first.returncode == again.returncode == 0, first.stderr + again.stderr
    lines = first.stdout.splitlines()
    assert lines[1:] == ['423.0', 'compiled']
    assert Path(lines[0]).is_relative_to(own) and Path(lines[0]).stat().st_uid == NOBODY
    assert again.stdout.splitlines() == [*lines[:2], 'loaded']
    assert first.stderr.count('set NUMBA_CACHE_DIR') == 1 and 'Traceback' not in first.stderr


def test_a_bag_of_someone_else_is_analysed_and_exported(own: Path, public: Path) -> None:
    write_bag(recording(), public / 'bag')
    found = start(own, '-m', 'asi_analysis.cli', 'analyze', str(public / 'bag'), '--json')
    assert found.returncode == 0, found.stderr
    assert json.loads(found.stdout)['rise_time_s'] == pytest.approx(
        analyze(recording())['rise_time_s'])
    for out, status in (('own/force.csv', 0), ('force.csv', 2)):
        result = start(own, '-m', 'asi_analysis.cli', 'export', str(public / 'bag'),
                       '--out', str(public / out))
        assert result.returncode == status and 'Traceback' not in result.stderr
        assert (public / out).exists() == (status == 0)
