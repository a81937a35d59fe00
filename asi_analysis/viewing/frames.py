"""Frames of the live page: the points of its charts as bytes, shared by pages with one window."""

import asyncio
import contextlib
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.bags.run import Run
from asi_analysis.viewing.recent import Recent, drawn

# Chart over time -> its curves: name and signal of a `Run`.
CHARTS: Final[Mapping[str, Mapping[str, str]]] = {
    'force (N)': {'force': 'force_n', 'reference': 'reference_n'},
    'valve command (N)': {'command': 'command_n'}}
LOOP: Final = 'valve position (µm) against valve command (N)'
WINDOWS_S: Final = {0.2: '0.2 s', 1.0: '1 s', 5.0: '5 s', 20.0: '20 s'}
# Bins of a curve over time, of two points each: about the width of a chart in pixels.
BINS: Final = 300
# The longest wait for a new state while the loop is at a standstill, s.
STILL_S: Final = 0.5


class Frames:
    """The newest frame for each window."""

    def __init__(self, recent: Recent) -> None:
        """Show what is in `recent`."""
        self._recent = recent
        self._kept: dict[float, tuple[int, bytes]] = {}   # by window: number of states, frame
        self._news = asyncio.Event()

    def follow(self) -> None:
        """Be notified of new messages, in the event loop that calls this."""
        loop = asyncio.get_running_loop()

        def notify() -> None:
            with contextlib.suppress(RuntimeError):   # the loop has ended
                loop.call_soon_threadsafe(self._wake)
        self._recent.on_message = notify

    def _wake(self) -> None:
        """Wake up all that wait for a new frame."""
        self._news.set()
        self._news = asyncio.Event()

    async def after(self, shown: int, window_s: float) -> tuple[int, bytes]:
        """
        Return the number of states so far, once it is not `shown` any more, and their frame.

        A frame is an array of float32: states/s, loop time s/s, messages missed; the number of
        points of each curve; their points, x and y. Raises ValueError for another window than
        WINDOWS_S has.
        """
        if window_s not in WINDOWS_S:
            raise ValueError(f'window {window_s:g} s')
        if self._recent.heard == shown:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._news.wait(), STILL_S)
        if self._kept.get(window_s, (-1, b''))[0] != self._recent.heard:
            heard = self._recent.heard
            self._kept[window_s] = heard, encoded((*self._recent.rate(), self._recent.lost),
                                                  curves(self._recent.run(window_s)))
        return self._kept[window_s]


def curves(run: Run | None) -> list[Array]:
    """Return the points of each curve of CHARTS, and of LOOP, n x 2."""
    fields = [field for chart in CHARTS.values() for field in chart.values()]
    if run is None:
        return [np.empty((0, 2))] * (len(fields) + 1)
    time_s = run.time_s - run.time_s[-1]
    found = [np.empty((0, 2)) if (values := getattr(run, field)) is None
             else drawn(time_s, values, BINS) for field in fields]
    loop = np.empty((0, 2))
    if run.command_n is not None and run.valve_position_m is not None:
        every = slice(None, None, -(-len(run) // (2 * BINS)))
        loop = np.column_stack([run.command_n[every], 1e6 * run.valve_position_m[every]])
    return [*found, loop[~np.isnan(loop).any(axis=1)]]


def encoded(numbers: Sequence[float], points: Sequence[Array]) -> bytes:
    """Return numbers, the numbers of points, and the points as float32."""
    parts = [np.array(numbers), np.array([len(each) for each in points]),
             *(each.ravel() for each in points)]
    return np.concatenate(parts).astype(np.float32).tobytes()
