"""Figure of a recording: the signal over time with the verdicts, and its orbit."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from asi_analysis.arrays import Array, Mask
from asi_analysis.bags.run import Run
from asi_analysis.limit_cycle.detection.verdict import response_of
from asi_analysis.reporting.figures import BLUE, GREEN, GREY, ORANGE, PURPLE, drawing

COLOUR: Final = {'limit_cycle': ORANGE, 'saturating': PURPLE, 'forced': GREEN,
                 'decaying': BLUE, 'growing': BLUE, 'noise': GREY, 'unsteady': GREY}
# Cycles of the orbit that are drawn; more would overlap.
DRAWN_CYCLES: Final = 12


def drawn(runs: Sequence[Run], document: dict[str, Any]) -> dict[str, tuple[Figure, str]]:
    """Return the pictures of runs, each with its caption."""
    return {f'cycle_{number}': (draw(run, document),
                                f'{run.source}: the signal with its verdicts, and its orbit')
            for number, run in enumerate(runs, 1)}


def draw(run: Run, document: dict[str, Any]) -> Figure:
    """Draw the segments of a run, and below the orbits of those that oscillate."""
    segments = [s for s in document['segments'] if s['source'] == run.source]
    oscillations = [s for s in segments if s['frequency_hz'] is not None]
    name, values = response_of(run, segments[0]['signal'])
    label, unit = name.replace('_', ' '), run.unit(name)
    with drawing(5.6 if oscillations else 2.8) as figure:
        axes = figure.subplots(2 if oscillations else 1, 1, squeeze=False)[:, 0]
        _in_time(axes[0], run, values, segments)
        axes[0].set(xlabel='time (s)', ylabel=f'{label} ({unit})')
        if oscillations:
            _orbits(axes[1], run, values, oscillations, unit)
            axes[1].set(xlabel=f'{label} ({unit})', ylabel=f'its rate ({unit}/s)')
            figure.legend(*axes[1].get_legend_handles_labels(), loc='outside lower center')
        return figure


def _part(run: Run, segment: dict[str, Any]) -> Mask:
    return (run.time_s >= segment['start_s']) & (run.time_s <= segment['end_s'])


def _in_time(axes: Axes, run: Run, values: Array, segments: Sequence[dict[str, Any]]) -> None:
    for segment in segments:
        part, colour = _part(run, segment), COLOUR[segment['verdict']]
        axes.plot(run.time_s[part], values[part], color=colour, linewidth=0.6)
        axes.axvline(segment['start_s'], color='#555555', linewidth=0.5)
        axes.annotate(segment['verdict'].replace('_', ' '), (segment['start_s'], 1.02),
                      xycoords=('data', 'axes fraction'), rotation=30, fontsize=8, color=colour)


def _orbits(axes: Axes, run: Run, values: Array, oscillations: Sequence[dict[str, Any]], unit: str
            ) -> None:
    """Draw the last cycles of each segment that oscillates, against their rate."""
    for segment in oscillations:
        part = _part(run, segment)
        rate = np.gradient(values[part], run.time_s[part])
        last = run.time_s[part] > segment['end_s'] - DRAWN_CYCLES / segment['frequency_hz']
        axes.plot(values[part][last], rate[last], color=COLOUR[segment['verdict']], linewidth=0.7,
                  label=f'{segment["verdict"].replace("_", " ")}, '
                        f'{segment["frequency_hz"]:.4g} Hz, {segment["amplitude_n"]:.4g} {unit}')
