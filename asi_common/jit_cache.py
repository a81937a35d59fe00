"""Cache of compiled code: one folder for each state of the source."""

import fcntl
import hashlib
import os
import re
import shutil
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[1]
PACKAGES: Final = ('asi_common', 'asi_actuator', 'asi_controller', 'asi_analysis')
# At the start of a line: compiled code does not depend on imports within functions.
IMPORT: Final = re.compile(rb'\n(?:from|import) (asi_[\w.]+)(?: import (\([^)]*\)|.*))?')
# Lock file that each process using a folder holds until it ends.
LOCK: Final = 'in_use'
# Another process can remove the folder between two steps of this one, once or twice at most.
ATTEMPTS: Final = 10


def _sources() -> dict[str, bytes]:
    """Return the source of each module of the project, by its dotted name."""
    found = {}
    for package in PACKAGES:
        for folder, _, files in os.walk(ROOT / package):
            module = os.path.relpath(folder, ROOT).replace(os.sep, '.')
            for file in files:
                if file.endswith('.py'):
                    name = module if file == '__init__.py' else f'{module}.{file[:-3]}'
                    with open(os.path.join(folder, file), 'rb') as source:
                        found[name] = source.read()
    return found


def key() -> str:
    """
    Return a hash of the source of all compiled code.

    That is each module with compiled functions, and the modules of the project that it imports,
    directly or not, because compiled code contains the values of their constants. Numba itself
    only detects a change of the file of the function.
    """
    sources = _sources()
    needed: set[str] = set()
    to_do = [name for name, source in sources.items() if b'asi_common.jit import' in source]
    while to_do:
        name = to_do.pop()
        if name in needed or name not in sources:
            continue
        needed.add(name)
        to_do.append(name.rpartition('.')[0])
        for module, names in IMPORT.findall(b'\n' + sources[name]):
            start = module.decode()
            to_do += [start, *(f'{start}.{each}' for each in re.findall(r'\w+', names.decode()))]
    text = b''.join(name.encode() + sources[name] for name in sorted(needed))
    return hashlib.sha256(text).hexdigest()[:12]


def _places() -> Iterator[Path]:
    """Yield the parent folders for caches, in order of preference."""
    if given := os.environ.get('NUMBA_CACHE_DIR'):
        yield Path(given)
    if given := os.environ.get('XDG_CACHE_HOME'):
        yield Path(given) / 'numba'
    home = os.path.expanduser('~')
    if os.path.isabs(home):
        yield Path(home) / '.cache' / 'numba'


def temporary_folder() -> Path:
    """
    Return a temporary folder that only this user can write, as code is run from it.

    It is the same for all processes of a user, unless another user owns that name.
    """
    folder = Path(tempfile.gettempdir()) / f'asi_actuator-{os.getuid()}'
    folder.mkdir(mode=0o700, exist_ok=True)
    status = folder.lstat()
    if status.st_uid == os.getuid() and status.st_mode == 0o40700:
        return folder
    return Path(tempfile.mkdtemp(prefix='asi_actuator-'))


def _locked(folder: Path) -> bool:
    """Create a folder if it does not exist and lock it for this process; False if impossible."""
    for _ in range(ATTEMPTS):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            lock = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o600)
            fcntl.flock(lock, fcntl.LOCK_SH)
        except FileNotFoundError:
            continue   # removed by another process in the meantime
        except OSError:
            return False
        if os.fstat(lock).st_nlink:
            return True   # never closed: the lock ends with the process
        os.close(lock)
    return False


def _remove_unused(folders: Path, current: Path) -> None:
    """Remove the caches of other states of the source that no process uses."""
    for folder in folders.iterdir():
        if folder == current:
            continue
        try:
            lock = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o600)
        except OSError:
            continue
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(folder, ignore_errors=True)
        except OSError:
            pass
        finally:
            os.close(lock)


def cache_folder() -> Path | None:
    """
    Return the folder for compiled code of this source, created and locked for this process.

    It is in the first writable of NUMBA_CACHE_DIR, XDG_CACHE_HOME, ~/.cache and, with a warning,
    the temporary directory. None, with a warning, if none is writable. Unused folders of other
    states of the source of this installation are removed.
    """
    name = f'asi_actuator-{hashlib.sha256(bytes(ROOT)).hexdigest()[:12]}'
    this = key()
    for place in _places():
        if _locked(place / name / this):
            _remove_unused(place / name, place / name / this)
            return place / name / this
    advice = 'set NUMBA_CACHE_DIR to a folder that can be written'
    try:
        folder = temporary_folder() / name / this
        if _locked(folder):
            warnings.warn(f'compiled code is kept in {folder}: {advice}', stacklevel=2)
            return folder
    except OSError:
        pass
    warnings.warn(f'compiled code cannot be kept, so every start compiles anew: {advice}',
                  stacklevel=2)
    return None
