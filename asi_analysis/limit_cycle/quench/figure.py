"""Figures of `asi quench`: Nyquist plot at the least margin, and the trade-off of designs."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from asi_actuator.parameters import as_record
from asi_analysis.limit_cycle.quench.margin import (
    AMPLITUDES_N,
    FREQUENCIES_HZ,
    LOADS,
    hysteresis_table,
    plant,
)
from asi_analysis.loop.simulation import Values, loop_of
from asi_analysis.reporting.figures import BLUE, GREY, ORANGE, drawing
from asi_controller.compensator import frequency_response


def draw(actuator: Values, controller: Values, document: dict[str, Any]) -> Figure:
    """Draw the loop in the Nyquist plane, and the trade-off if there is a design."""
    rate, at, curve = document['rate_hz'], document['margin_at'], document['design']
    loop = loop_of(actuator, controller, rate)
    compensated = frequency_response(loop.compensator, FREQUENCIES_HZ, rate)
    table = hysteresis_table(as_record(actuator), loop.compensator)
    with drawing(7.4 if curve else 4.2) as figure:
        axes = figure.subplots(2 if curve else 1, 1, squeeze=False)[:, 0]
        for name, load in LOADS.items():
            response = compensated * plant(as_record({**actuator, **load}), at['bias_n'],
                                           1.0 / rate)
            worst = name == at['load']
            axes[0].plot(response.real, response.imag, color=BLUE if worst else GREY,
                         linewidth=1.4 if worst else 0.7,
                         label=f'loop, {name}' if worst else None)
        k = int(np.argmin(np.abs(FREQUENCIES_HZ - at['frequency_hz'])))
        locus = np.array([-1.0 / row[k] if abs(row[k]) > 1e-6 else np.nan for row in table])
        axes[0].plot(locus.real, locus.imag, '.-', color=ORANGE,
                     label=f'-1/N, {AMPLITUDES_N[0]:.0f} to {AMPLITUDES_N[-1]:.0f} N, '
                           f'{at["frequency_hz"]:.3g} Hz')
        axes[0].axhline(0.0, color='#777777', linewidth=0.6)
        axes[0].axvline(0.0, color='#777777', linewidth=0.6)
        axes[0].set(xlim=(-3.0, 1.5), ylim=(-2.5, 1.5), xlabel='real part',
                    ylabel='imaginary part',
                    title=f'{document["compensator"]}: margin {document["margin"]:.2g} '
                          '(grey: other loads)')
        axes[0].legend(loc='lower right')
        if curve:
            axes[1].plot([row['margin'] for row in curve['trade_off']],
                         [1e3 * row['rise_time_s'] for row in curve['trade_off']], 'o-',
                         color=BLUE, markersize=4, label='Pareto front')
            for name, colour in (('rival', GREY), ('best', ORANGE)):
                axes[1].plot(curve[name]['margin'], 1e3 * curve[name]['rise_time_s'], 's',
                             color=colour, label=name)
            axes[1].set(xlabel='limit-cycle margin', ylabel='rise time (ms)')
            axes[1].legend()
        return figure
