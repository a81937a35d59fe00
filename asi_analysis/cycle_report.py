"""The report of `asi limit-cycle`, `predict`, `attribute` and `quench`: HTML and PNGs."""

from collections.abc import Mapping
from pathlib import Path

from matplotlib.figure import Figure

from asi_analysis import figures
from asi_analysis.experiment import versions
from asi_analysis.report import environment


def write_report(out: Path, title: str, text: str, drawn: Mapping[str, tuple[Figure, str]]
                 ) -> Path:
    """
    Write report.html, and a PNG of each figure, into `out`; return the path of report.html.

    text: the answer for people; drawn: file name without its end -> figure and caption.
    """
    out.mkdir(parents=True, exist_ok=True)
    for name, (figure, _) in drawn.items():
        with figures.style():
            figure.savefig(out / f'{name}.png')
    page = out / 'report.html'
    page.write_text(environment().get_template('cycle.html').render(
        title=title, text=text, versions=versions(),
        figures=[{'svg': figures.svg(figure, caption), 'caption': caption}
                 for figure, caption in drawn.values()]))
    return page
