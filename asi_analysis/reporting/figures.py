"""
Figures of reports in one style: each function draws arrays in one matplotlib figure.

5.2 inches wide with 9 point text, so that they need no scaling on a phone.
"""

import html
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import Formatter, MaxNLocator

from asi_analysis.arrays import Array, Mask
from asi_common.files import replacing

WIDTH_IN: Final = 5.2
# Okabe and Ito's colours, which people with colour blindness can distinguish.
BLUE, ORANGE, GREEN, PURPLE, GREY = '#0072b2', '#d55e00', '#009e73', '#a0519b', '#9aa3ab'
COLOURS: Final = (BLUE, ORANGE, GREEN, PURPLE)
# Lines that differ without colour too; the dashed one is that of a reference.
LINES: Final = ('-', '-.', (0, (1.2, 0.8)), (0, (6, 1, 1, 1, 1, 1)))
# Prefix of a unit for each power of 1000.
PREFIXES: Final = dict(zip(range(-5, 5), ('f', 'p', 'n', 'µ', 'm', '', 'k', 'M', 'G', 'T'),
                           strict=True))
STYLE: Final[Any] = {
    'font.size': 9.0, 'axes.titlesize': 9.5, 'axes.titleweight': 'bold',
    'axes.titlelocation': 'left', 'axes.labelsize': 9.0, 'legend.fontsize': 8.5,
    'axes.spines.top': False, 'axes.spines.right': False, 'axes.edgecolor': '#555555',
    'axes.grid': True, 'grid.color': '#e3e6e8', 'grid.linewidth': 0.7,
    'axes.axisbelow': True, 'lines.linewidth': 1.4, 'legend.frameon': False,
    'xtick.color': '#333333', 'ytick.color': '#333333', 'savefig.dpi': 160.0,
    'svg.fonttype': 'path', 'svg.hashsalt': 'asi', 'path.simplify_threshold': 0.3,
}


def style() -> AbstractContextManager[None]:
    """Return the context in which every figure is drawn and saved."""
    return matplotlib.rc_context(STYLE)


class UnitFormatter(Formatter):
    """Ticks in a unit, all of an axis with one prefix: −20 µm, 0 µm, 20 µm."""

    def __init__(self, unit: str) -> None:
        self.unit = unit

    def __call__(self, x: float, pos: int | None = None) -> str:
        assert self.axis is not None
        first, last = sorted(self.axis.get_view_interval())
        largest = max(abs(first), abs(last))
        power = math.floor(math.log10(largest) / 3.0) if largest > 0.0 else 0
        power = min(max(power, min(PREFIXES)), max(PREFIXES))
        # A tick at 0 may be a rounding error.
        text = f'{round(x / 1000.0 ** power, 6):.10g} {PREFIXES[power]}{self.unit}'
        return self.fix_minus(text).rstrip()


@contextmanager
def drawing(height_in: float, width_in: float = WIDTH_IN) -> Iterator[Figure]:
    """Yield a new figure to draw in."""
    with style():
        yield Figure(figsize=(width_in, height_in), layout='constrained')


def save(figure: Figure, path: Path, dpi: float = STYLE['savefig.dpi']) -> None:
    """Write a figure to a file."""
    with style(), replacing(path) as temporary:
        figure.savefig(temporary, dpi=dpi)


def svg(figure: Figure, description: str) -> str:
    """Return a figure as an <svg> element for HTML, with its description for screen readers."""
    text = io.StringIO()
    with style():
        figure.savefig(text, format='svg', metadata={'Date': None})
    element = text.getvalue()[text.getvalue().index('<svg'):]
    return element.replace('<svg', f'<svg role="img" aria-label="{html.escape(description)}"', 1)


Responses = Mapping[str, tuple[Array, Array, Array | None]]


def step_responses(runs: Responses, end_s: float, name: str = 'force',
                   first_s: float | None = None) -> Figure:
    """
    Draw a signal and the command after a step, relative to the size of the step.

    runs: label -> time since the step (s), signal and command (% of the step; None: not drawn), to
    end_s; name: of the signal; first_s: time to which a panel of its own shows the beginning.
    """
    starts, ends = ([-0.01], [end_s]) if first_s is None else (
        [-0.1 * first_s, first_s], [first_s, end_s])
    with drawing(4.9) as figure:
        panels = figure.subplots(2, len(ends), sharey='row', squeeze=False, height_ratios=(3, 2),
                                 width_ratios=(3, 2)[:len(ends)])
        for start, end, above, below in zip(starts, ends, *panels, strict=True):
            _step_panels(above, below, runs, start, end)
        (above, *_), (below, *_) = panels
        above.set(ylabel=f'{name} (% of the step)')
        above.set_title(name.capitalize())
        below.set(ylabel='command (% of the step)')
        below.set_title('Valve command')
        figure.supxlabel('time after the step (ms)', fontsize=STYLE['axes.labelsize'])
        figure.legend(*above.get_legend_handles_labels(), loc='outside upper center',
                      ncols=min(len(runs), 2), handlelength=3.5)
        return figure


def _step_panels(above: Axes, below: Axes, runs: Responses, start_s: float, end_s: float) -> None:
    """Draw the signals above and the commands below, from start to end."""
    above.step([1e3 * min(start_s, -0.01), 0.0, 1e3 * end_s], [0.0, 0.0, 100.0], color='black',
               linewidth=0.9, linestyle='--', where='pre', label='reference')
    for (label, (time, signal, command)), colour, line in zip(
            runs.items(), COLOURS, LINES, strict=False):
        shown = (time >= start_s) & (time <= end_s)
        above.plot(1e3 * time[shown], signal[shown], color=colour, linestyle=line, label=label)
        if command is not None:
            below.plot(1e3 * time[shown], command[shown], color=colour, linestyle=line,
                       linewidth=1.1)
    for axes in (above, below):
        axes.set(xlim=(1e3 * start_s, 1e3 * end_s))
    above.tick_params(labelbottom=False)


def recording(time: Array, signals: Mapping[str, tuple[Array, str]]) -> Figure:
    """Draw signals (name -> values and unit) over time (s), those of one unit in one panel."""
    units = list(dict.fromkeys(unit for _, unit in signals.values()))
    with drawing(1.0 + 1.6 * max(len(units), 1)) as figure:
        axes = figure.subplots(max(len(units), 1), 1, sharex=True, squeeze=False)[:, 0]
        for name, (values, unit) in signals.items():
            axes[units.index(unit)].plot(time, values, linewidth=0.9,
                                         label=name.replace('_', ' '))
        for panel, unit in zip(axes, units, strict=False):
            panel.set(ylabel=unit)
            panel.legend(loc='upper right')
        axes[-1].set(xlabel='time (s)')
        return figure


def bode(frequency: Array, gain: Array, phase: Array, coherence: Array) -> Figure:
    """Draw gain (dB), phase (degrees) and coherence over frequency (Hz)."""
    with drawing(5.2) as figure:
        axes = figure.subplots(3, 1, sharex=True, height_ratios=(3, 3, 2))
        for panel, values, label in zip(axes, (20.0 * np.log10(gain), phase, coherence),
                                        ('gain (dB)', 'phase (°)', 'coherence'), strict=True):
            panel.semilogx(frequency, values, color=BLUE, linewidth=1.0)
            panel.set(ylabel=label)
        axes[-1].set(xlabel='frequency (Hz)', ylim=(0.0, 1.05))
        return figure


def oscillation_in_time(time: Array, force: Array, reference: Array, zoom_s: float,
                        label: str = 'force (N)') -> Figure:
    """Draw a signal over time (s), with the label of its axis: all of it, and the last zoom_s."""
    with drawing(4.2) as figure:
        above, below = figure.subplots(2, 1)
        above.plot(time, force, color=BLUE, linewidth=0.6)
        above.set(ylabel=label, xlabel='time (s)', xlim=(time[0], time[-1]))
        above.set_title('The whole run')
        start = time[-1] - zoom_s
        above.axvspan(start, time[-1], color=ORANGE, alpha=0.18, linewidth=0.0)
        last = time >= start
        below.plot(1e3 * time[last], force[last], color=BLUE, label=label.rpartition(' ')[0])
        below.plot(1e3 * time[last], reference[last], color='black', linestyle='--',
                   linewidth=0.9, label='reference')
        below.set(ylabel=label, xlabel='time (ms)',
                  xlim=(1e3 * start, 1e3 * time[-1]))
        below.set_title(f'The last {1e3 * zoom_s:.0f} ms (shaded above)')
        figure.legend(*below.get_legend_handles_labels(), loc='outside lower right', ncols=2)
        return figure


def phase_plane(time: Array, force: Array, steady: Mask) -> Figure:
    """Draw force rate (kN/s) against force (N): the transient and the last cycles."""
    with drawing(3.9) as figure:
        axes = figure.subplots()
        # Central differences; the ends of the record have none.
        rate = 1e-3 * np.gradient(force, time)[:-1]
        force, steady = force[:-1], steady[:-1]
        axes.plot(force[~steady], rate[~steady], color=GREY, linewidth=0.5,
                  label='transient')
        axes.plot(force[steady], rate[steady], color=BLUE, linewidth=0.9,
                  label='the last cycles')
        start = int(np.flatnonzero(np.abs(np.diff(force)) > 0)[0])
        axes.plot(force[start], rate[start], 'o', color='black', markersize=4, label='start')
        axes.set(xlabel='force (N)', ylabel='force rate (kN/s)')
        figure.legend(*axes.get_legend_handles_labels(), loc='outside upper center', ncols=3)
        return figure


def spectrum(frequency: Array, amplitude: Array, harmonics: Sequence[tuple[float, float]],
             end_hz: float) -> Figure:
    """
    Draw the amplitude (N) of each frequency (Hz) up to end_hz, on a logarithmic axis.

    harmonics: frequency (Hz) and amplitude (N) of the fundamental and its multiples.
    """
    with drawing(3.0) as figure:
        axes = figure.subplots()
        shown = (frequency > 0.0) & (frequency <= end_hz)
        axes.semilogy(frequency[shown], amplitude[shown], color=BLUE, linewidth=0.9)
        top = max(level for _, level in harmonics)
        axes.set(xlabel='frequency (Hz)', ylabel='amplitude (N)', xlim=(0.0, end_hz),
                 ylim=(1e-4 * top, 4.0 * top))
        for number, (place, level) in enumerate(harmonics, 1):
            if place <= end_hz and level > 1e-4 * top:
                text = f'{place:.1f} Hz\n{level:.0f} N' if number == 1 else f'{number}×'
                # The main lobe of the window may be a little higher than the fitted sine.
                peak = max(level, float(np.interp(place, frequency, amplitude)))
                axes.annotate(text, (place, peak), xytext=(7 if number == 1 else 0, 3),
                              textcoords='offset points', ha='left' if number == 1 else 'center',
                              va='center' if number == 1 else 'bottom', color=ORANGE)
        return figure


def hysteresis_loop(command: Array, valve_position: Array, straight: tuple[float, float],
                    width_n: float) -> Figure:
    """
    Draw valve position (um) against command (N), with arrows in the direction of time.

    straight: slope (m/N) and offset (m) of the line through the middle of the loop; width_n: its
    width at the middle (N).
    """
    with drawing(3.7) as figure:
        axes = figure.subplots()
        slope, offset = straight
        ends = np.array([command.min(), command.max()])
        axes.plot(ends, 1e6 * (slope * ends + offset), color=GREY, linewidth=0.9,
                  linestyle='--', label='straight line through the middle')
        axes.plot(command, 1e6 * valve_position, color=BLUE, label='recorded')
        rising = np.diff(command, append=command[-1]) > 0
        for up, sign in ((True, 1), (False, -1)):
            branch = np.flatnonzero(rising == up)
            k = branch[int(np.argmin(np.abs(command[branch] - sign * 0.4 * ends[1])))]
            ahead = min(k + max(3, command.size // 100), command.size - 1)
            axes.annotate('', (command[ahead], 1e6 * valve_position[ahead]),
                          (command[k], 1e6 * valve_position[k]),
                          arrowprops={'arrowstyle': '-|>', 'color': BLUE, 'mutation_scale': 14})
        axes.annotate('', (-0.5 * width_n, 1e6 * offset), (0.5 * width_n, 1e6 * offset),
                      arrowprops={'arrowstyle': '<|-|>', 'color': ORANGE, 'shrinkA': 0,
                                  'shrinkB': 0})
        axes.annotate(f'{width_n:.0f} N', (0.5 * width_n, 1e6 * offset), xytext=(6, -12),
                      textcoords='offset points', color=ORANGE, fontweight='bold')
        axes.set(xlabel='valve command (N)', ylabel='valve position (µm)')
        axes.xaxis.set_major_locator(MaxNLocator(7))
        figure.legend(*axes.get_legend_handles_labels(), loc='outside upper center', ncols=2)
        return figure


class Panel(NamedTuple):
    """Curves over each other: label -> x and y."""

    title: str
    x: str
    y: str
    lines: Mapping[str, tuple[Array, Array]]
    logarithmic: bool = False   # x


def overlays(panels: Sequence[Panel], columns: int = 1) -> Figure:
    """Draw panels with one legend; a label has the same line in each, 'reference' a dashed one."""
    rows = -(-len(panels) // columns)
    labels = [label for label in dict.fromkeys(label for panel in panels for label in panel.lines)
              if label != 'reference']
    with drawing(0.6 + 2.3 * rows) as figure:
        for panel, axes in zip(panels, np.ravel(figure.subplots(rows, columns, squeeze=False)),
                               strict=False):
            for label, (x, y) in panel.lines.items():
                if label == 'reference':
                    axes.plot(x, y, color='black', linewidth=0.9, linestyle='--', label=label)
                    continue
                number = labels.index(label)
                axes.plot(x, y, color=COLOURS[number % len(COLOURS)], linewidth=1.1, label=label,
                          linestyle=('-', '-.', ':')[number // len(COLOURS) % 3])
            axes.set(xlabel=panel.x, ylabel=panel.y)
            axes.set_title(panel.title)
            if panel.logarithmic:
                axes.set_xscale('log')
        handles = {text: handle for axes in figure.axes for handle, text in zip(
            *axes.get_legend_handles_labels(), strict=True)}
        figure.legend(list(handles.values()), list(handles), loc='outside upper center', ncols=2)
        return figure
