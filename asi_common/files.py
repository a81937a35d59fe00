"""Atomic writing of files: complete, or not at all."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """
    Yield a temporary path in the same directory, which replaces `path` when it is on the disk.

    If writing fails, the temporary file is removed and `path` is unchanged; an OSError names
    `path`.
    """
    path = Path(path)
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
