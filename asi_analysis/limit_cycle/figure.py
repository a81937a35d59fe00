"""A picture of a judged record: the signal in time with its verdicts, and its orbit."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from asi_analysis.figures import BLUE, GREEN, GREY, ORANGE, PURPLE, WIDTH_IN, style
from asi_analysis.limit_cycle.verdict import response_of
from asi_analysis.run import Run

COLOUR: Final = {'limit_cycle': ORANGE, 'saturating': PURPLE, 'forced': GREEN,
                 'decaying': BLUE, 'growing': BLUE, 'noise': GREY, 'unsteady': GREY}
# Cycles of the orbit that are drawn: more would cover each other.
DRAWN_CYCLES: Final = 12


def drawn(runs: Sequence[Run], document: dict[str, Any]) -> dict[str, tuple[Figure, str]]:
    """Return the pictures of runs, each with its caption."""
    return {f'cycle_{number}': (draw(run, document),
                                f'{run.source}: the signal with its verdicts, and its orbit')
            for number, run in enumerate(runs, 1)}


def draw(run: Run, document: dict[str, Any]) -> Figure:
    """Draw the segments of `document` that are of `run`."""
    segments = [s for s in document['segments'] if s['source'] == run.source]
    name, values = response_of(run, segments[0]['signal'])
    unit = run.unit(name)
    with style():
        figure = Figure(figsize=(WIDTH_IN, 5.6), layout='constrained')
        above, below = figure.subplots(2, 1)
        for segment in segments:
            part = (run.time_s >= segment['start_s']) & (run.time_s <= segment['end_s'])
            colour = COLOUR[segment['verdict']]
            above.plot(run.time_s[part], values[part], color=colour, linewidth=0.6)
            above.axvline(segment['start_s'], color='#555555', linewidth=0.5)
            above.annotate(segment['verdict'].replace('_', ' '), (segment['start_s'], 1.02),
                           xycoords=('data', 'axes fraction'), rotation=30, fontsize=8,
                           color=colour)
            if segment['frequency_hz'] is None:
                continue
            rate = np.gradient(values[part], run.time_s[part])
            last = run.time_s[part] > segment['end_s'] - DRAWN_CYCLES / segment['frequency_hz']
            below.plot(values[part][last], rate[last], color=colour, linewidth=0.7,
                       label=f'{segment["verdict"].replace("_", " ")}, '
                             f'{segment["frequency_hz"]:.4g} Hz, '
                             f'{segment["amplitude_n"]:.4g} {unit}')
        above.set(xlabel='time (s)', ylabel=f'{name.replace("_", " ")} ({unit})')
        below.set(xlabel=f'{name.replace("_", " ")} ({unit})', ylabel=f'its rate ({unit}/s)')
        if below.lines:
            figure.legend(*below.get_legend_handles_labels(), loc='outside lower center')
        return figure
