"""Figure of `asi quench`: Nyquist plot at the least margin."""

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


def draw(actuator: Values, controller: Values, document: dict[str, Any]) -> Figure:
    """Draw the loop in the Nyquist plane."""
    at, loop = document['margin_at'], loop_of(actuator, controller, document['rate_hz'])
    compensated, table = loop.compensated(FREQUENCIES_HZ), hysteresis_table(loop)
    with drawing(4.2) as figure:
        axes = figure.subplots()
        for name, load in LOADS.items():
            response = compensated * plant(as_record({**actuator, **load}), at['bias_n'],
                                           loop.period_s)
            worst = name == at['load']
            axes.plot(response.real, response.imag, color=BLUE if worst else GREY,
                      linewidth=1.4 if worst else 0.7,
                      label=f'loop, {name}' if worst else None)
        k = int(np.argmin(np.abs(FREQUENCIES_HZ - at['frequency_hz'])))
        locus = np.array([-1.0 / row[k] if abs(row[k]) > 1e-6 else np.nan for row in table])
        axes.plot(locus.real, locus.imag, '.-', color=ORANGE,
                  label=f'-1/N, {AMPLITUDES_N[0]:.0f} to {AMPLITUDES_N[-1]:.0f} N, '
                        f'{at["frequency_hz"]:.3g} Hz')
        axes.axhline(0.0, color='#777777', linewidth=0.6)
        axes.axvline(0.0, color='#777777', linewidth=0.6)
        axes.set(xlim=(-3.0, 1.5), ylim=(-2.5, 1.5), xlabel='real part',
                 ylabel='imaginary part',
                 title=f'{document["compensator"]}: margin {document["margin"]:.2g} '
                       '(grey: other loads)')
        axes.legend(loc='lower right')
        return figure
