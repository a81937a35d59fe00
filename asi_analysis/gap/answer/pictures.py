"""The pictures of the diagnosis: each function draws arrays into one matplotlib figure."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, PercentFormatter

from asi_analysis.gap.prepare import Array, Mask
from asi_analysis.reporting.figures import BLUE, GREEN, GREY, ORANGE, WIDTH_IN, style


def _new(height_in: float) -> Figure:
    return Figure(figsize=(WIDTH_IN, height_in), layout='constrained')


def _legend(figure: Figure, axes: Axes, **options: Any) -> None:
    """Put the legend above, where it covers nothing."""
    figure.legend(*axes.get_legend_handles_labels(), loc='outside upper center', ncols=4,
                  **options)


def overlay(time: Array, real: Array, nominal: Array, improved: Array, held_out: Mask,
            label: str, unit: str) -> Figure:
    """Draw a section of recording, nominal and improved model, and the residuals of both."""
    with style():
        figure = _new(3.4)
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        above.plot(time, real, color=GREY, linewidth=2.6, label='real')
        above.plot(time, nominal, color=ORANGE, label='nominal')
        above.plot(time, improved, color=BLUE, label='improved')
        above.set_ylabel(f'{label} ({unit})')
        _legend(figure, above)
        below.plot(time, real - nominal, color=ORANGE)
        below.plot(time, real - improved, color=BLUE)
        for axes in (above, below):
            axes.fill_between(time, 0, 1, where=held_out, transform=axes.get_xaxis_transform(),
                              color='#f0f3f5', zorder=0, linewidth=0)
        below.set_ylabel(f'real - model ({unit})')
        below.set_xlabel('time (s); shaded: held out')
    return figure


def compared(time: Array, real: Array, model: Array, name: str, largest: float) -> Figure:
    """Draw the force (N) of a machine and of one model; largest: of the differences drawn."""
    colour = ORANGE if name == 'nominal' else BLUE
    with style():
        figure = _new(3.0)
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
    """Draw the probability of each explanation, the first being the most probable."""
    with style():
        figure = _new(0.8 + 0.24 * len(chances))
        axes = figure.subplots()
        place = np.arange(len(chances))[::-1]
        axes.barh(place, list(chances.values()), height=0.7,
                  color=[BLUE, *(GREY for _ in place[1:])])
        for y, value in zip(place, chances.values(), strict=True):
            axes.annotate(f'{100.0 * value:.1f} %', (value, y), textcoords='offset points',
                          xytext=(3, 0), va='center', fontsize=7)
        axes.set_yticks(place, [name.replace('_', ' ') for name in chances])
        axes.set_xlim(0.0, 1.12)
        axes.xaxis.set_major_formatter(PercentFormatter(1.0))
        axes.set_xlabel('probability')
    return figure


def ranking(names: Sequence[str], errors: Sequence[float], verdict: str, nominal: float,
            noise: float) -> Figure:
    """Draw the residual of each hypothesis on the validation set, as a share of the signal."""
    with style():
        figure = _new(0.9 + 0.22 * len(names))
        axes = figure.subplots()
        place = np.arange(len(names))[::-1]
        bars = axes.barh(place, errors, color=GREY, height=0.7)
        for name, bar in zip(names, bars, strict=True):
            if name == verdict:
                bar.set(color=BLUE, label='verdict')
        axes.set_yticks(place, names)
        axes.axvline(nominal, color=ORANGE, label='nominal, refitted')
        axes.axvline(noise, color=GREEN, label='noise')
        axes.set_xscale('log')
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_xlabel('residual, share of the signal')
        _legend(figure, axes)
    return figure


def plane(x: Array, before: Array, after: Array, x_label: str, unit: str) -> Figure:
    """Draw the residual over the quantity that the effect depends on."""
    with style():
        figure = _new(2.6)
        axes = figure.subplots()
        drawn = np.linspace(0, x.size - 1, min(x.size, 4000)).astype(int)
        axes.plot(x[drawn], before[drawn], '.', color=ORANGE, markersize=1.5, label='before')
        axes.plot(x[drawn], after[drawn], '.', color=BLUE, markersize=1.5, label='after')
        axes.set_xlabel(x_label)
        axes.set_ylabel(f'real - model ({unit})')
        _legend(figure, axes, markerscale=6)
    return figure


def regimes(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw the gap by frequency, amplitude, motion and time, relative to its rms."""
    with style():
        figure = _new(0.9 + 0.22 * len(rows))
        axes = figure.subplots()
        place = np.arange(len(rows))[::-1]
        axes.barh(place, [row['relative'] for row in rows], height=0.8, color=ORANGE,
                  label='refitted nominal')
        axes.barh(place, [row['after'] for row in rows], height=0.45, color=BLUE, label='verdict')
        axes.set_yticks(place, [f'{row["kind"]}: {row["regime"]}' for row in rows])
        axes.axvline(1.0, color=GREY)
        axes.set_xlabel('rms of the gap there, over that of all')
        _legend(figure, axes)
    return figure


def spectrum(frequency: Array, powers: Mapping[str, Array], label: str, unit: str) -> Figure:
    """Draw the spectral density of a signal and of the residual of each model."""
    with style():
        figure = _new(2.8)
        axes = figure.subplots()
        colours = {'real': GREY, 'nominal': ORANGE, 'refitted': GREEN, 'improved': BLUE}
        for name, power in powers.items():
            axes.loglog(frequency[1:], np.sqrt(power[1:]), color=colours[name],
                        label=name if name == 'real' else f'real - {name}')
        axes.set_xlabel('frequency (Hz)')
        axes.set_ylabel(f'{label} ({unit} per root Hz)')
        _legend(figure, axes)
    return figure


def confusion(truth: Sequence[str], named: Sequence[str], counts: Array) -> Figure:
    """Draw how often each true effect got each verdict."""
    with style():
        figure = Figure(figsize=(7.2, 6.6), layout='constrained')
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
    with style():
        figure = _new(3.0)
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
