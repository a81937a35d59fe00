"""Write reports: one self-contained HTML file, and its pictures as PNG."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from matplotlib.figure import Figure

from asi_analysis.reporting import figures
from asi_analysis.versions import versions
from asi_common.files import write_text


def write_report(out: Path, template: str, pictures: Mapping[str, tuple[Figure, str]],
                 **values: Any) -> Path:
    """
    Write report.html, and a PNG of each picture, into `out`; return the path of report.html.

    template: one of templates/; pictures: file name without suffix → figure and caption. The
    template gets both by that name as `figures` (SVG) and `captions`, and `values`.
    """
    out.mkdir(parents=True, exist_ok=True)
    for name, (figure, _) in pictures.items():
        figures.save(figure, out / f'{name}.png')
    page = out / 'report.html'
    write_text(page, _environment().get_template(template).render(
        figures={name: figures.svg(figure, caption)
                 for name, (figure, caption) in pictures.items()},
        captions={name: caption for name, (_, caption) in pictures.items()},
        versions=versions(), **values))
    return page


def write_pictures(out: Path, title: str, text: str, pictures: Mapping[str, tuple[Figure, str]]
                   ) -> Path:
    """Write a report of a text and pictures; as `write_report`."""
    return write_report(out, 'pictures.html', pictures, title=title, text=text)


def _environment() -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader('asi_analysis.reporting'), autoescape=True,
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters['figure'] = lambda value, digits=3: (
        '-' if value is None else np.format_float_positional(
            value, digits, fractional=False, trim='-'))
    return environment
