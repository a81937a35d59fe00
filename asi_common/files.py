"""Files: written atomically (completely or not at all), and read with a limit of their size."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

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
