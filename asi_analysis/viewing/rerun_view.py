"""`asi view`: a recording in the Rerun viewer, or in a file for it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from scipy import signal

from asi_analysis.arrays import Array
from asi_analysis.bags.run import SIGNALS, Run
from asi_analysis.errors import InputError
from asi_analysis.measures.analysis import analyze
from asi_analysis.viewing.scene import log_scene
from asi_analysis.viewing.window import window
from asi_common.files import replacing

TIME: Final = 'time'
BLUE, ORANGE = 0x0072b2ff, 0xd55e00ff
# A loop is drawn this wide and high, in a view whose two scales are the same.
WIDTH, HEIGHT = 160.0, 100.0
# Largest number of positions of the point that marks the time cursor on a loop.
MARKS: Final = 5000
MOST_HZ: Final = 250.0


def view(run: Run, out: Path | None) -> str:
    """
    Open a recording in the viewer, or write it to a .rrd file; return what was done.

    Raises InputError if no signal of the run can be shown.
    """
    known = {name for name, values in run.signals().items() if np.isfinite(values).any()}
    if not known:
        raise InputError(f'{run.source}: none of its signals can be shown')
    views: list[Any] = []
    stream = rr.RecordingStream('asi view')
    stream.log('summary', rr.TextDocument(_summary(run), media_type='text/markdown'), static=True)
    for title, names in _views(run, known).items():
        for name, colour in zip(names, (BLUE, ORANGE), strict=False):
            factor = 1e6 if name == 'valve_position' else 1.0
            _curve(stream, name, run.time_s, factor * run.signal(name), colour)
        views.append(rrb.TimeSeriesView(contents=[f'/{name}' for name in names], name=title))
    views_of_all = [_loop(stream, f'plane/{number}', title, run.time_s, x, y) for number, (
        title, (x, y)) in enumerate(_planes(run).items())]
    if (output := run.output()) in known:
        views_of_all.append(_spectrum(stream, run, output))
    if (scene := log_scene(stream, TIME, run)) is not None:
        views_of_all.append(scene)
    views_of_all.append(rrb.TextDocumentView(origin='summary', name='asi analyze'))
    blueprint = rrb.Blueprint(
        rrb.Horizontal(rrb.Vertical(*views), rrb.Vertical(*views_of_all), column_shares=[3, 2]),
        rrb.TimePanel(state='collapsed'), rrb.SelectionPanel(state='hidden'),
        rrb.BlueprintPanel(state='hidden'))
    if out is None:
        with window() as address:
            stream.connect_grpc(address, default_blueprint=blueprint)
            stream.disconnect()   # when all is sent
        return 'shown in the Rerun viewer'
    with replacing(out) as temporary:
        stream.save(temporary, default_blueprint=blueprint)
        stream.disconnect()
    return f'written: {out} (rerun {out})'


def _summary(run: Run) -> str:
    try:
        return f'```\n{analyze(run)}\n```'
    except InputError as error:
        return str(error)


def _views(run: Run, known: set[str]) -> dict[str, list[str]]:
    """Return the signals of each view over time, by title; reference and output share one."""
    views = {}
    for name in (row.name for row in SIGNALS if row.name in known):
        beside = ['reference'] if 'reference' in known and name == run.controlled() else []
        if name != 'reference' or run.controlled() not in known:
            unit = 'µm' if name == 'valve_position' else run.unit(name)
            views[f'{name.replace("_", " ")} ({unit})'] = [name, *beside]
    return views


def _curve(stream: rr.RecordingStream, path: str, time_s: Array, values: Array, colour: int
           ) -> None:
    known = ~np.isnan(values)
    stream.log(path, rr.SeriesLines(colors=[colour], names=[path]), static=True)
    stream.send_columns(path, indexes=[rr.TimeColumn(TIME, duration=time_s[known])],
                        columns=rr.Scalars.columns(scalars=values[known]))


def _planes(run: Run) -> Mapping[str, tuple[Array, Array]]:
    """Return the loops that are drawn: their horizontal and vertical signals, by title."""
    planes = {}
    if run.command_n is not None and run.valve_position_m is not None:
        planes[f'valve position (µm) against command ({run.unit("command")})'] = (
            run.command_n, 1e6 * run.valve_position_m)
    if run.force_n is not None and len(run) > 1:
        unit = run.unit('force')
        planes[f'force rate (k{unit}/s) against force ({unit})'] = (
            run.force_n, 1e-3 * np.gradient(run.force_n, run.time_s))
    return {title: (x, y) for title, (x, y) in planes.items() if np.isfinite(x + y).any()}


def _loop(stream: rr.RecordingStream, path: str, title: str, time_s: Array, x: Array, y: Array
          ) -> Any:
    """Log a curve in a plane, scaled to one size, and a point that moves on it with the time."""
    known = ~np.isnan(x + y)
    ends = [(each[known].min(), each[known].max()) for each in (x, y)]
    # Down is positive in these views.
    points = np.column_stack([
        size * (each[known] - low) / ((high - low) or 1.0)
        for size, each, (low, high) in zip((WIDTH, -HEIGHT), (x, y), ends, strict=True)])
    stream.log(f'{path}/curve', rr.LineStrips2D([points], colors=[BLUE], radii=[0.3]), static=True)
    every = slice(None, None, -(-len(points) // MARKS))
    stream.send_columns(
        f'{path}/now', indexes=[rr.TimeColumn(TIME, duration=time_s[known][every])],
        columns=rr.Points2D.columns(positions=points[every], radii=np.full(
            len(points[every]), 1.5), colors=[ORANGE] * len(points[every])))
    texts = [f'{low:.4g}…{high:.4g}' for low, high in ends]
    return rrb.Spatial2DView(origin=path, name=f'{title}: {texts[1]} against {texts[0]}')


def _spectrum(stream: rr.RecordingStream, run: Run, name: str) -> Any:
    """Log the amplitude of a signal over the frequency, by a flat-top window."""
    values = np.nan_to_num(run.signal(name) - np.nanmean(run.signal(name)))
    window = signal.windows.flattop(len(values))
    amplitude = 2.0 * np.abs(np.fft.rfft(window * values)) / window.sum()
    frequency = np.fft.rfftfreq(len(values), run.period_s)
    shown = frequency <= MOST_HZ
    stream.log('spectrum', rr.BarChart(amplitude[shown], abscissa=frequency[shown], color=BLUE),
               static=True)
    return rrb.BarChartView(origin='spectrum',
                            name=f'amplitude of the {name} ({run.unit(name)}) over Hz')
