"""Figures of `asi predict`: Nyquist plots (Figs. 8 and 9), branch of cycles, onset (Fig. 7)."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from asi_analysis.loop import describing_functions as describing
from asi_analysis.loop.harmonic_balance import Loop
from asi_analysis.loop.one_harmonic import COMMANDS_N, OneHarmonic, piston_response
from asi_analysis.reporting.figures import BLUE, GREEN, GREY, ORANGE, drawing

MARKED_HZ = (50, 80, 100, 130, 200)
MARKED_N = (100, 2000, 8000)


def _mark(axes: Axes, points: np.ndarray, texts: list[str], colour: str, side: int) -> None:
    axes.plot(points.real, points.imag, '.', color=colour, markersize=5)
    for number, (point, text) in enumerate(zip(points, texts, strict=True)):
        # Alternately above and below, as neighbours may be close.
        axes.annotate(text, (point.real, point.imag), xytext=(5 * side, (4, -9)[number % 2]),
                      textcoords='offset points', fontsize=7, color=colour,
                      ha='left' if side > 0 else 'right')


def nyquist(loop: Loop, frequency_hz: float) -> Figure:
    """
    Draw K L(jw) and -1/N(A) of the hysteresis (Fig. 9), W and -1/D of damping (Fig. 8).

    frequency_hz: at which N is evaluated, because N depends on amplitude and frequency.
    """
    with drawing(7.0) as figure:
        above, below = figure.subplots(2, 1)
        _of_hysteresis(above, loop, frequency_hz)
        _of_damping(below, loop)
        for axes in (above, below):
            axes.axhline(0.0, color='#777777', linewidth=0.6)
            axes.axvline(0.0, color='#777777', linewidth=0.6)
            axes.legend(loc='best')
        return figure


def _of_hysteresis(axes: Axes, loop: Loop, frequency_hz: float) -> None:
    gain, one = float(loop.compensator['gain']), OneHarmonic(loop, held=True)

    def inverse(amplitudes: np.ndarray) -> np.ndarray:
        return np.array([-1.0 / one.hysteresis(a, frequency_hz) for a in amplitudes])

    line = gain * one.per_gain(np.geomspace(30.0, 400.0, 400))
    axes.plot(line.real, line.imag, color=BLUE, label='K L(jw)')
    _mark(axes, gain * one.per_gain(MARKED_HZ),
          [f'{each} Hz' for each in MARKED_HZ], BLUE, -1)
    smallest = 1.1 * loop.plant['valve_hysteresis_radius']
    locus = inverse(np.geomspace(max(3.0 * smallest, 60.0), COMMANDS_N[-1], 80))
    axes.plot(locus.real, locus.imag, color=ORANGE,
              label=f'-1/N(A) at {frequency_hz:.0f} Hz')
    _mark(axes, inverse(np.array(MARKED_N)), [f'{each} N' for each in MARKED_N], ORANGE, 1)
    axes.set(xlim=(-2.2, 0.6), ylim=(-3.0, 0.8), xlabel='real part', ylabel='imaginary part',
             title=f'hysteresis and limit of the command, K = {gain:.3g}')


def _of_damping(axes: Axes, loop: Loop) -> None:
    for friction, colour, name in ((False, BLUE, 'W(jw), damping'),
                                   (True, GREEN, 'W(jw), friction')):
        response = 1e3 * piston_response(
            OneHarmonic(loop, held=True), np.geomspace(30.0, 400.0, 4000), friction)
        axes.plot(response.real, response.imag, color=colour, label=name)
    velocities = np.geomspace(0.01, 2.0, 60)
    inverse = -1e3 / np.array([describing.damping(v, 0.0, loop.plant) for v in velocities])
    axes.plot(inverse, np.zeros_like(velocities), color=ORANGE, linewidth=3,
              label='-1/D(A), damping, 0.01 to 2 m/s')
    axes.set(title='damping and friction: on the real axis', xlabel='real part ((m/s)/kN)',
             ylabel='imaginary part ((m/s)/kN)')


def branches(document: dict[str, Any]) -> Figure:
    """Draw amplitude and frequency of the predicted and the simulated cycles over the gain."""
    with drawing(5.6) as figure:
        above, below = figure.subplots(2, 1, sharex=True)
        for method, colour, mark in (('describing_function', GREY, '-'),
                                     ('harmonic_balance', BLUE, '-'), ('simulation', ORANGE, '.')):
            for stable in (True, False):
                rows = [c for c in document['cycles']
                        if c['method'] == method and c['stable'] == stable]
                if not rows:
                    continue
                style_ = mark if stable or mark == '.' else '--'
                label = method.replace('_', ' ') + ('' if stable else ', unstable')
                gain = [c['gain'] for c in rows]
                above.plot(gain, [c['amplitude_n'] for c in rows], style_, color=colour,
                           label=label)
                below.plot(gain, [c['frequency_hz'] for c in rows], style_, color=colour)
        above.set(ylabel='amplitude of the force (N)')
        below.set(xlabel='gain', ylabel='frequency (Hz)')
        figure.legend(*above.get_legend_handles_labels(), loc='outside upper center', ncols=2)
        return figure


def onsets(document: dict[str, Any]) -> Figure:
    """Draw onset gain and frequency over the size of the step (Fig. 7)."""
    rows = document['onset_by_step']
    with drawing(4.6) as figure:
        above, below = figure.subplots(2, 1, sharex=True)
        for kind, colour, mark in (('predicted', BLUE, 'o-'), ('simulated', ORANGE, 's--')):
            for axes, quantity in ((above, 'gain'), (below, 'frequency_hz')):
                axes.plot([r['step_n'] for r in rows],
                          [np.nan if r[f'{kind}_{quantity}'] is None else r[f'{kind}_{quantity}']
                           for r in rows], mark, color=colour, markersize=4, label=kind)
        above.set(ylabel='onset gain')
        below.set(xlabel='step (N)', ylabel='frequency (Hz)')
        figure.legend(*above.get_legend_handles_labels(), loc='outside upper center', ncols=2)
        return figure


def drawn(loop: Loop, document: dict[str, Any]) -> dict[str, tuple[Figure, str]]:
    """Return the pictures, each with its caption."""
    at = document['describing_function_onset_frequency_hz'] or 100.0
    pictures = {
        'nyquist': (nyquist(loop, at), 'The loop and -1/N as in Fig. 9 of the paper, '
                    'damping and friction as in Fig. 8: one harmonic'),
        'branches': (branches(document), 'Cycles over the gain: predicted and simulated')}
    if document['onset_by_step']:
        pictures['onset_by_step'] = (onsets(document), 'Onset over the size of the step: Fig. 7')
    return pictures
