"""Files: written completely or not at all, read with a limit of their size; those shipped."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from asi_common.parameter import ParameterError

# Largest file of parameters or settings: YAML of so many bytes takes half a minute to parse.
MOST_SETTINGS: Final = 2**20


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """
    Yield a temporary path in the same directory, which replaces `path` when it is on the disk.

    If writing fails, the temporary file is removed and `path` is unchanged; an OSError names
    `path`.
    """
    path = Path(path)
    if path.exists() and not path.is_file():   # a device would be replaced by a file
        raise OSError(errno.EINVAL, 'is not a file', str(path))
    temporary = path.with_name(f'.{path.name}.{os.getpid()}{path.suffix}')
    try:
        yield temporary
        with temporary.open('rb+') as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        error.filename, error.filename2 = str(path), None
        raise
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write a text in UTF-8 to a file, completely or not at all. Raises OSError."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding='utf-8', errors='backslashreplace')


def read_text(path: str | Path, most_bytes: int = MOST_SETTINGS) -> str:
    """
    Return the text of a file in UTF-8, of at most so many bytes.

    Raises UnicodeDecodeError, and OSError, also for a larger file, a pipe or a device, which may
    have no end.
    """
    return read_bytes(path, most_bytes).decode()


def read_bytes(path: str | Path, most_bytes: int = MOST_SETTINGS) -> bytes:
    """Return the bytes of a file. Raises OSError as `read_text` does."""
    path = Path(path)
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise OSError(errno.EINVAL, 'is not a file', str(path))
    with path.open('rb') as file:
        found = file.read(most_bytes + 1)
    if len(found) > most_bytes:
        raise OSError(errno.EFBIG, f'is larger than {most_bytes} bytes', str(path))
    return found


def shipped(name: str) -> Path:
    """
    Return a file of the package's folder `config`. Raises ParameterError if it is not found.

    Beside the package in a source tree (also if that is what is installed, editable); else where
    setup.py has put it, under the prefix that holds lib/python3.x/site-packages.
    """
    root = Path(__file__).resolve().parents[1]
    # From <prefix>/lib/python3.x/site-packages; a source tree may lie too shallow to have one.
    prefix = root.joinpath('..', '..', '..').resolve()
    places = (root / 'config' / name, prefix / 'share' / 'asi_actuator' / 'config' / name)
    for place in places:
        if place.is_file():
            return place
    raise ParameterError(f'{name} of the package is not found: looked for '
                         + ', '.join(map(str, places)))
