"""Output of commands in the terminal: progress bar and tables."""

import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Final

# progress(text, completed share or None if unknown)
Progress = Callable[[str, float | None], None]
# Columns of output to a file, a pipe or a notebook.
WIDTH: Final = 160
# Seconds between two lines of progress in such an output.
LINE_S: Final = 30.0


def silent(text: str, share: float | None) -> None:
    """Report no progress."""


def part_of(progress: Progress, title: str, before: int, count: int) -> Progress:
    """Return the progress of one of `count` parts, after `before` others; unknown: as it was."""
    last = 0.0

    def part(text: str, share: float | None) -> None:
        nonlocal last
        last = last if share is None else share
        progress(f'{title}: {text}', (before + last) / count)

    return part


@contextmanager
def bar() -> Iterator[Progress]:
    """Yield a progress function that shows a bar on stderr; a line now and then in a file."""
    if not sys.stderr.isatty():     # old versions of rich end a disabled bar with an empty line
        with _lines() as progress:
            yield progress
        return
    from rich.console import Console
    from rich.progress import BarColumn, SpinnerColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars
    console = Console(stderr=True)
    with Bars(SpinnerColumn(), TextColumn('{task.description}'), BarColumn(),
              TimeElapsedColumn(), console=console, transient=True) as bars:
        task = bars.add_task('', total=None)

        def progress(text: str, share: float | None) -> None:
            bars.update(task, description=text, total=1.0, completed=share or 0.0)
            if share is None:   # which `update` takes for: as it is
                bars.tasks[0].total = None

        yield progress


@contextmanager
def _lines() -> Iterator[Progress]:
    """Yield a progress function whose newest text is written as a line every LINE_S seconds."""
    over, begin = threading.Event(), time.monotonic()
    newest: list[tuple[str, float | None]] = []

    def progress(text: str, share: float | None) -> None:
        newest[:] = [(text, share)]

    def write() -> None:
        while not over.wait(LINE_S):
            text, share = newest[0] if newest else ('computing', None)
            done = '' if share is None else f', {share:.0%}'
            # Not print: a process that is forked meanwhile would inherit its lock.
            with suppress(OSError, ValueError):
                os.write(sys.stderr.fileno(), f'asi: {text}{done}, after '
                         f'{time.monotonic() - begin:.0f} s\n'.encode())

    writer = threading.Thread(target=write, daemon=True)
    writer.start()
    try:
        yield progress
    finally:
        over.set()
        writer.join()


def table(columns: Sequence[str], rows: Iterable[Sequence[str]], right: Sequence[str] = ()
          ) -> str:
    """Return a table as text no wider than the terminal; right: the right-aligned columns."""
    from rich.console import Console
    from rich.table import Table
    grid = Table(box=None, pad_edge=False, show_header=any(columns))
    for column in columns:
        grid.add_column(column, justify='right' if column in right else 'left')
    for row in rows:
        grid.add_row(*row)
    console = Console(width=None if sys.stdout.isatty() else WIDTH, color_system=None,
                      markup=False, emoji=False, highlight=False)
    with console.capture() as captured:
        console.print(grid)
    return '\n'.join(line.rstrip() for line in captured.get().rstrip('\n').splitlines())
