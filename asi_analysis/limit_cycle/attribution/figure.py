"""Figures of `asi attribute`: shares of the nonlinearities; command and output of a bag."""

from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from asi_analysis.bags.run import Run
from asi_analysis.limit_cycle.attribution.hammerstein import Explanation
from asi_analysis.limit_cycle.attribution.recording import shape_of
from asi_analysis.limit_cycle.attribution.shape import Shape
from asi_analysis.limit_cycle.detection.verdict import response_of
from asi_analysis.reporting.figures import BLUE, COLOURS, GREY, ORANGE, drawing

DRAWN_CYCLES: Final = 4.0
# Kinds of valve that are drawn: those with the smallest residual.
DRAWN_KINDS: Final = 3


def model(document: dict[str, Any]) -> Figure:
    """Draw the share of each nonlinearity, and its cycle alone and that without it."""
    causes = document['causes']
    names = [cause['nonlinearity'].replace('_', ' ') for cause in causes]
    row = np.arange(len(causes))
    with drawing(2.2 + 0.5 * len(causes)) as figure:
        left, right = figure.subplots(1, 2, sharey=True)
        left.barh(row, [100.0 * (cause['share'] or 0.0) for cause in causes], color=BLUE)
        left.set_yticks(row, names)
        left.invert_yaxis()
        left.set(xlabel='share of the amplitude (%)')
        for offset, prefix, colour in ((-0.2, 'alone', ORANGE), (0.2, 'all_but', GREY)):
            right.barh(row + offset, [cause[f'{prefix}_amplitude_n'] or 0.0 for cause in causes],
                       0.36, color=colour, label=prefix.replace('_', ' ')
                       + (' it' if prefix == 'all_but' else ''))
        right.set(xlabel='amplitude of the cycle (N)')
        figure.legend(*right.get_legend_handles_labels(), loc='outside upper center', ncols=2)
        return figure


def recorded(run: Run, document: dict[str, Any], signal: str | None = None) -> Figure:
    """Draw command and output of the segment, outputs of the fitted valves, and the causes."""
    found = shape_of(run, document, signal)
    with drawing(8.0) as figure:
        plane, time, bars = figure.subplots(3, 1, height_ratios=(3, 2, 2))
        name, _ = response_of(run, signal)
        _plane(plane, found)
        plane.set(xlabel=f'command ({run.unit("command")})',
                  ylabel=f'{name.replace("_", " ")} ({run.unit(name)})')
        _time(time, found)
        causes = document['causes']
        row = np.arange(len(causes))
        bars.barh(row, [100.0 * cause['probability'] for cause in causes], color=BLUE)
        bars.set_yticks(row, [cause['nonlinearity'].replace('_', ' ') for cause in causes])
        bars.invert_yaxis()
        bars.set(xlabel='probability (%)', xlim=(0.0, 100.0))
        return figure


def _best(found: Shape) -> list[Explanation]:
    valves = [each for kind, each in found.explanations.items() if kind != 'linear']
    return sorted(valves, key=lambda each: each.unexplained)[:DRAWN_KINDS]


def _plane(axes: Axes, found: Shape) -> None:
    """Draw output over command: measured, mean cycle, and fitted valves."""
    axes.plot(found.command, found.output, color=GREY, linewidth=0.4, label='measured')
    cycle = np.append(np.arange(len(found.command_cycle)), 0)
    axes.plot(found.command_cycle[cycle], found.output_cycle[cycle], color='black', linewidth=1.8,
              label='its mean cycle')
    period = int(round(len(found.output) / found.cycles))
    for each, colour in zip(_best(found), COLOURS, strict=False):
        last = slice(each.start + len(each.residual) - period, each.start + len(each.residual))
        axes.plot(found.command[last], found.output[last] - each.residual[-period:],
                  color=colour, linewidth=1.0,
                  label=f'{each.kind}, unexplained {100.0 * each.unexplained:.2g} %')
    axes.set_title('slow drift removed')
    axes.legend(loc='best')


def _time(axes: Axes, found: Shape) -> None:
    """Draw the last cycles of command and output, each over its standard deviation."""
    count = int(DRAWN_CYCLES * len(found.output) / found.cycles)
    cycles = np.arange(-count, 0) * found.cycles / len(found.output)
    for name, values, colour in (('output', found.output, BLUE),
                                 ('command', found.command, ORANGE)):
        axes.plot(cycles, values[-count:] / values.std(), color=colour, linewidth=1.0,
                  label=name)
    axes.set(xlabel='cycles before the end', ylabel='over standard deviation')
    axes.legend(loc='upper left', ncols=2)
