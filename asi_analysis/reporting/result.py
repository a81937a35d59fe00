"""`Result` of an analysis: prints as tables, plots itself, and converts to JSON or pandas."""

import html
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from string import Formatter
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from asi_analysis.errors import InputError

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class Table(NamedTuple):
    """A table of a result: cells are texts; `right` names the columns that are right-aligned."""

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ''
    right: Sequence[str] = ()


# Name of a picture -> figure and caption.
Pictures = Mapping[str, tuple['Figure', str]]


class Result(dict[str, Any]):
    """
    The result of an analysis, by the keys of its command's `--json`.

    Keys are attributes too: `result.met` is `result['met']`. It prints as the command does.
    sources: what it was computed from (a run, a loop), stored as attributes.
    """

    title: ClassVar[str] = ''       # heading of the report
    rows: ClassVar[str | None] = None   # key of the list that `to_frame` returns

    def __init__(self, document: Mapping[str, Any], **sources: Any):
        super().__init__(document)
        vars(self).update(sources)

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(f'{type(self).__name__} has no {name}; it has '
                                 f'{", ".join(self)}') from None

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self]

    def parts(self) -> Iterator[str | Table]:
        """Yield the paragraphs and tables of the printed result, in order."""
        raise NotImplementedError

    def pictures(self) -> Pictures:
        """Return the figures of the report, each with its caption, by file name without suffix."""
        raise InputError(f'{type(self).__name__} has no pictures')

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON document that the command prints with `--json`, as a copy."""
        # Figures of huge samples may overflow, and JSON has no infinity.
        document: dict[str, Any] = json.loads(json.dumps(self), parse_constant=lambda _: None)
        return document

    def to_frame(self) -> 'pandas.DataFrame':
        """
        Return the rows of the result as a pandas DataFrame, its columns by the keys of the JSON.

        Raises InputError for a result that is no table, or without pandas.
        """
        if self.rows is None:
            raise InputError(f'{type(self).__name__} is not a table: use to_dict()')
        return frame(self[self.rows])

    def plot(self, picture: str | None = None) -> 'list[Axes]':
        """
        Draw the result in a pyplot figure and return its axes, from top to bottom.

        picture: a name of `pictures()`; the first by default. `matplotlib.pyplot.show()` shows it.
        """
        drawn = self.pictures()
        if picture is not None and picture not in drawn:
            raise InputError(f'no picture {picture!r}: it is one of {", ".join(drawn)}')
        return shown(drawn[picture or next(iter(drawn))][0])

    def write_report(self, out: Path) -> Path:
        """Write report.html and a PNG of each picture into `out`; return the path of the page."""
        from asi_analysis.reporting.report import write_pictures
        return write_pictures(out, self.title, str(self), self.pictures())

    def all_parts(self) -> Iterator[str | Table]:
        """Yield the parts, and the findings on the quality of the samples."""
        yield from self.parts()
        yield from (f'data: {finding["text"]}' for finding in self.get('quality', ()))

    def __str__(self) -> str:
        return as_text(self.all_parts())

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return as_html(self.all_parts())


def frame(data: Any) -> 'pandas.DataFrame':
    """Return columns or rows as a pandas DataFrame; raises InputError without pandas."""
    try:
        import pandas
    except ImportError:
        raise InputError('to_frame() needs pandas: pip install "asi_actuator[pandas]"') from None
    return pandas.DataFrame(data)


def shown(figure: 'Figure') -> 'list[Axes]':
    """Hand a figure to pyplot, which shows it in notebooks and by show(); return its axes."""
    from matplotlib import pyplot
    pyplot.figure(FigureClass=lambda *_, **__: figure)   # type: ignore[arg-type]
    return list(figure.axes)


def as_text(parts: Iterator[str | Table]) -> str:
    """Return paragraphs and tables as text; tables are no wider than the terminal."""
    from asi_analysis.terminal import table
    lines: list[str] = []
    for part in parts:
        if isinstance(part, str):
            lines.append(part)
        else:
            lines += ['', part.title] if part.title else []
            lines.append(table(part.columns, part.rows, part.right))
    return '\n'.join(lines).lstrip('\n')


def as_html(parts: Iterator[str | Table]) -> str:
    """Return paragraphs and tables as HTML, every text escaped."""
    return '\n'.join(f'<p>{html.escape(part)}</p>' if isinstance(part, str) else _html_table(part)
                     for part in parts)


def _html_table(table: Table) -> str:
    def row(tag: str, cells: Sequence[str]) -> str:
        return '<tr>' + ''.join(
            f'<{tag} style="text-align: '
            f'{"right; white-space: nowrap" if name in table.right else "left"}">'
            f'{html.escape(cell)}</{tag}>'
            for name, cell in zip(table.columns, cells, strict=True)) + '</tr>'

    caption = f'<caption>{html.escape(table.title)}</caption>' if table.title else ''
    head = f'<thead>{row("th", table.columns)}</thead>' if any(table.columns) else ''
    return (f'<table>{caption}{head}<tbody>'
            + ''.join(row('td', cells) for cells in table.rows) + '</tbody></table>')


class _Cell(Formatter):
    """Formats None as '-', a boolean as yes or no, and a share with ' %'."""

    def format_field(self, value: Any, format_spec: str) -> str:
        if value is None or isinstance(value, bool):
            return {None: '-', True: 'yes', False: 'no'}[value]
        text = format(value, format_spec)
        return text.replace('%', ' %') if format_spec.endswith('%') else text


def filled(template: str, row: Mapping[str, Any]) -> str:
    """Return a format string such as '{gain:.3f}' filled from a mapping; '-' for None."""
    return _Cell().vformat(template, (), row)


def table_of(rows: Sequence[Mapping[str, Any]], columns: Mapping[str, str], title: str = ''
             ) -> Table:
    """
    Return the table of a document's rows.

    columns: heading -> format string; a column with a number format is right-aligned.
    """
    return Table(list(columns), [[filled(cell, row) for cell in columns.values()]
                                 for row in rows], title,
                 [name for name, cell in columns.items() if ':' in cell])


def finite(value: float) -> float | None:
    """Return a number of a document; None for one that is not finite."""
    return float(value) if math.isfinite(value) else None


def number(value: float | None, unit: str = '', digits: int = 4) -> str:
    """Return a number with its unit for a table cell, 0 below 1e-9; '-' if there is none."""
    return '-' if value is None else f'{round(value, 9):.{digits}g} {unit}'.rstrip()
