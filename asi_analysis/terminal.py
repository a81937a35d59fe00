"""What a command shows in the terminal: a bar while it works, and tables."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager

# progress(what is going on, share done or None)
Progress = Callable[[str, float | None], None]


def silent(text: str, share: float | None) -> None:
    """Tell nobody how far the work is."""


@contextmanager
def bar() -> Iterator[Progress]:
    """Give a progress that shows a bar on stderr, if that is a terminal; gone at the end."""
    from rich.console import Console
    from rich.progress import BarColumn, SpinnerColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars
    console = Console(stderr=True)
    with Bars(SpinnerColumn(), TextColumn('{task.description}'), BarColumn(),
              TimeElapsedColumn(), console=console, transient=True,
              disable=not console.is_terminal) as bars:
        task = bars.add_task('', total=None)

        def progress(text: str, share: float | None) -> None:
            bars.update(task, description=text, total=None if share is None else 1.0,
                        completed=share or 0.0)

        yield progress


def table(columns: Sequence[str], rows: Iterable[Sequence[str]], title: str | None = None,
          right: Sequence[str] = ()) -> str:
    """
    Return a table as text no wider than the terminal.

    right: the columns that are flush right; cells may hold rich's markup, as '[red]no[/]'.
    """
    from rich.console import Console
    from rich.table import Table
    made = Table(title=title, title_justify='left', box=None, pad_edge=False)
    for column in columns:
        made.add_column(column, justify='right' if column in right else 'left')
    for row in rows:
        made.add_row(*row)
    console = Console()
    with console.capture() as captured:
        console.print(made)
    return captured.get().rstrip('\n')
