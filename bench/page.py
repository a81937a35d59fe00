"""Write doc/reference/performance.md and its pictures from the results."""

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import jinja2
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from asi_analysis.reporting import figures
from bench.result import Result

Measured = Mapping[str, Mapping[str, Any]]

# Axes of the curves of a module: size and cost.
SIZES: Final = {'many_runs': 'runs at once', 'analysis_speed': 'length of the recording, s'}


def results_of(module: Mapping[str, Any]) -> list[Result]:
    """Return the results of a module."""
    return [Result(**each) for each in module['results']]


def figure(value: float | None) -> str:
    """Return a number as the tables show it."""
    if value is None:
        return ''
    if value != 0.0 and not 1e-3 <= abs(value) < 1e5:
        return f'{value:.1e}'
    return f'{value:.3g}' if abs(value) < 1000.0 else f'{value:,.0f}'


def row(result: Result) -> str:
    """Return a line of a table: the ratio first."""
    ratio = ''
    if result.ratio is not None:
        ratio = f'{figure(result.ratio)} ± {figure(result.spread)}'
    own = figure(result.value)
    if result.ratio is None and result.spread:
        own += f' ± {figure(result.spread)}'
    target = result.target.replace('<=', '≤').replace('>=', '≥')
    met = {True: 'met', False: '**missed**', None: ''}[result.met]
    return f'| {result.what} | {ratio} | {result.rival} | {own} {result.unit} | {target} | {met} |'


def curves(results: Sequence[Result]) -> dict[str, list[Result]]:
    """Return the results that are points of a curve, by the curve's name."""
    found: dict[str, list[Result]] = {}
    for result in results:
        if result.at is not None:
            found.setdefault(result.name.rpartition('.')[0], []).append(result)
    return found


def cost_against_size(measured: Measured) -> Figure:
    """Draw the cost against size, relative to the smallest size."""
    chosen = [name for name in SIZES if name in measured]
    picture = Figure(figsize=(4.4 * len(chosen), 3.2), layout='constrained')
    axes = picture.subplots(1, len(chosen), squeeze=False)
    for name, ax in zip(chosen, axes[0], strict=True):
        sizes: set[float] = set()
        for points in curves(results_of(measured[name])).values():
            ax.semilogx([p.at for p in points], [p.value for p in points], 'o-',
                        label=points[0].what)
            sizes |= {p.at for p in points if p.at is not None}
            ax.set_ylabel(points[0].unit)
        ax.set_xlabel(SIZES[name])
        ax.set_xticks(sorted(sizes), [f'{size:g}' for size in sorted(sizes)], minor=False)
        ax.set_xticks([], minor=True)
        ax.set_ylim(bottom=0.0)
        ax.legend(fontsize=7)
    return picture


def error_against_time(measured: Measured) -> Figure:
    """Draw the error of each solver against the time that it takes."""
    picture = Figure(figsize=(5.6, 4.0), layout='constrained')
    ax = picture.subplots()
    for points in curves(results_of(measured['rivals'])).values():
        ax.loglog([p.value for p in points], [p.at for p in points], 'o-', label=points[0].what)
    ax.set_xlabel('time for a simulated second, s')
    ax.set_ylabel('largest error of the force, share of its size')
    picture.legend(fontsize=7, ncols=3, loc='outside upper center')
    return picture


def shares(measured: Measured) -> Figure:
    """Draw the share of each reference speed that is reached."""
    bars = [r for module in measured.values() for r in results_of(module) if r.share is not None]
    picture = Figure(figsize=(7.0, 0.6 + 0.36 * len(bars)), layout='constrained')
    _bars(picture.subplots(), bars[::-1])
    return picture


def _bars(ax: Axes, bars: Sequence[Result]) -> None:
    ax.barh(range(len(bars)), [100.0 * (r.share or 0.0) for r in bars])
    labels = [textwrap.fill(f"{r.what.removesuffix(', ours / empty nodes')} / {r.rival}", 44)
              for r in bars]
    ax.set_yticks(range(len(bars)), labels, fontsize=7)
    ax.axvline(100.0, color='black', linewidth=0.8)
    ax.set_xlabel("% of the limit's speed")


def parts_of_tick(measured: Measured) -> Figure:
    """Draw the parts of the time of a lock-step tick as one bar."""
    picture = Figure(figsize=(7.0, 1.6), layout='constrained')
    ax = picture.subplots()
    begin = 0.0
    for result in results_of(measured['loop_rate']):
        if result.name.startswith('loop_rate.tick.'):
            ax.barh([0], [result.value], left=[begin],
                    label=result.what.rpartition(': ')[2])
            begin += result.value
    ax.set_yticks([])
    ax.set_xlabel('a tick of both nodes, us')
    ax.legend(fontsize=7, ncols=5, loc='lower center', bbox_to_anchor=(0.5, 1.0))
    return picture


def write_page(measured: Measured, folder: Path) -> Path:
    """Write performance.md and its pictures into a folder; return its path."""
    drawn: dict[str, Figure] = {}
    with figures.style():
        drawn['performance_share'] = shares(measured)
        if any(name in measured for name in SIZES):
            drawn['performance_size'] = cost_against_size(measured)
        if 'rivals' in measured:
            drawn['performance_error'] = error_against_time(measured)
        if 'loop_rate' in measured:
            drawn['performance_tick'] = parts_of_tick(measured)
        for name, picture in drawn.items():
            picture.savefig(folder / f'{name}.png', dpi=110.0)
    template = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), trim_blocks=True,
        undefined=jinja2.StrictUndefined, keep_trailing_newline=True
    ).get_template('performance.md.j2')
    tables = {name: '\n'.join(row(r) for r in results_of(module) if r.at is None)
              for name, module in measured.items()}
    path = folder / 'performance.md'
    path.write_text(template.render(measured=measured, tables=tables, pictures=set(drawn)))
    return path
