"""The pictures of the diagnosis: each function draws arrays into one matplotlib figure."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from asi_analysis.arrays import Array, Mask
from asi_analysis.gap.words import chance
from asi_analysis.reporting.figures import BLUE, GREY, ORANGE, UnitFormatter, drawing


def _legend(figure: Figure, axes: Axes, **options: Any) -> None:
    """Put the legend above, where it covers nothing."""
    figure.legend(*axes.get_legend_handles_labels(), loc='outside upper center', ncols=4,
                  **options)


def overlay(time: Array, real: Array, models: Mapping[str, Array], held_out: Mask,
            label: str, unit: str) -> Figure:
    """Draw a section of a recording and of models of it, and the differences."""
    with drawing(3.4) as figure:
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        above.plot(time, real, color=GREY, linewidth=2.6, label='machine')
        for (name, model), colour in zip(models.items(), (ORANGE, BLUE), strict=False):
            above.plot(time, model, color=colour, label=name)
            below.plot(time, real - model, color=colour)
        above.set_ylabel(label)
        _legend(figure, above)
        for axes in (above, below):
            axes.yaxis.set_major_formatter(UnitFormatter(unit))
            axes.fill_between(time, 0, 1, where=held_out, transform=axes.get_xaxis_transform(),
                              color='#f0f3f5', zorder=0, linewidth=0)
        below.set_ylabel('difference')
        below.set_xlabel('time (s); shaded: validation samples')
    return figure


def characteristic(given: Array, got: Array, models: Mapping[str, Array], labels: tuple[str, str],
                   units: tuple[str, str]) -> Figure:
    """Draw an output over its input, measured and by models; labels, units: of input, output."""
    with drawing(3.4) as figure:
        axes = figure.subplots()
        axes.plot(given, got, color=GREY, linewidth=2.6, label='machine')
        for (name, model), colour in zip(models.items(), (ORANGE, BLUE), strict=False):
            axes.plot(given, model, color=colour, linewidth=1.0, label=name)
        axes.set_xlabel(labels[0])
        axes.set_ylabel(labels[1])
        axes.xaxis.set_major_formatter(UnitFormatter(units[0]))
        axes.yaxis.set_major_formatter(UnitFormatter(units[1]))
        _legend(figure, axes)
    return figure


def compared(time: Array, real: Array, model: Array, name: str, largest: float) -> Figure:
    """Draw the force (N) of a machine and of one model; largest: of the differences drawn."""
    colour = ORANGE if name == 'nominal' else BLUE
    with drawing(3.0) as figure:
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        above.plot(time, real, color=GREY, linewidth=2.6, label='machine')
        above.plot(time, model, color=colour, label=f'{name} model')
        above.set_ylabel('force (N)')
        _legend(figure, above)
        below.plot(time, real - model, color=colour)
        below.set_ylim(-1.1 * largest, 1.1 * largest)
        below.set_ylabel('difference (N)')
        below.set_xlabel('time (s)')
    return figure


def probabilities(chances: Mapping[str, float]) -> Figure:
    """Draw the probability of each explanation, the most probable first."""
    with drawing(0.8 + 0.24 * len(chances)) as figure:
        axes = figure.subplots()
        place = np.arange(len(chances))[::-1]
        axes.barh(place, list(chances.values()), height=0.7,
                  color=[BLUE if value > 0.5 else GREY for value in chances.values()])
        for y, value in zip(place, chances.values(), strict=True):
            axes.annotate(chance(value), (value, y), textcoords='offset points',
                          xytext=(3, 0), va='center', fontsize=7)
        axes.set_yticks(place, list(chances))
        axes.set_xlim(0.0, 1.25)
        axes.set_xticks((0.0, 0.5, 1.0))
        axes.xaxis.set_major_formatter(PercentFormatter(1.0))
        axes.set_xlabel('probability')
    return figure


def confusion(truth: Sequence[str], named: Sequence[str], counts: Array) -> Figure:
    """Draw how often each true effect got each verdict."""
    with drawing(6.6, 7.2) as figure:
        axes = figure.subplots()
        share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
        axes.imshow(share, cmap='Blues', vmin=0.0, vmax=1.0, aspect='auto')
        axes.set_xticks(range(len(named)), named, rotation=90, fontsize=7)
        axes.set_yticks(range(len(truth)), truth, fontsize=7)
        axes.grid(False)
        for i, j in zip(*np.nonzero(counts), strict=True):
            axes.text(j, i, f'{int(counts[i, j])}', ha='center', va='center', fontsize=7,
                      color='white' if share[i, j] > 0.5 else 'black')
        axes.set_xlabel('verdict')
        axes.set_ylabel('truth')
    return figure


def reliability(said: Sequence[float], right: Sequence[float], counts: Sequence[int]) -> Figure:
    """Draw the share of right verdicts over their probability."""
    with drawing(3.0) as figure:
        axes = figure.subplots()
        axes.plot([0, 1], [0, 1], color=GREY)
        axes.plot(said, right, 'o-', color=BLUE)
        for x, y, count in zip(said, right, counts, strict=True):
            axes.annotate(str(count), (x, y), textcoords='offset points', xytext=(5, -9),
                          fontsize=7)
        axes.set_xlabel('probability of the verdict')
        axes.set_ylabel('share of right verdicts')
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(PercentFormatter(1.0))
    return figure
