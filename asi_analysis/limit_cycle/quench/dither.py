"""Dither, the classic cure: how much of which frequency quenches the cycle, and what it costs."""

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from asi_actuator.model.actuator import advance, measure, prepare, rest
from asi_actuator.parameters import as_record
from asi_analysis.loop.simulation import Values, loop_of
from asi_analysis.terminal import Progress, silent
from asi_common.jit import jit
from asi_controller.compensator import compensate

FREQUENCIES_HZ: Final = (300.0, 500.0, 800.0, 1200.0, 1700.0)
MOST_N: Final = 4000.0
WATCHED_S: Final = 0.8
MEASURED_S: Final = 0.15
# What is left of the cycle, below which it counts as quenched.
QUENCHED: Final = 0.03
ACCURACY: Final = 0.05


@jit
def _dithered(state, p, c, reference, amplitude, frequency, period, out):
    steady = prepare(p, period)
    for k in range(out.shape[1]):
        force, valve, _, _ = measure(state, p)
        command = compensate(c, reference, force)
        out[0, k] = force
        out[1, k] = valve
        advance(state, command + amplitude * math.sin(2.0 * math.pi * frequency * k * period),
                p, steady)


def _run(actuator: Values, controller: Values, rate_hz: float, amplitude: float,
         frequency: float) -> tuple[np.ndarray, np.ndarray]:
    """Return force and valve position at the end of a step with dither on the command."""
    loop = loop_of(actuator, controller, rate_hz)
    out = np.empty((2, round(WATCHED_S * rate_hz)))
    _dithered(rest(), as_record(actuator), loop.compensator, loop.reference_n, amplitude,
              frequency, loop.period_s, out)
    return tuple(out[:, -round(MEASURED_S * rate_hz):])


def _slow_swing(force: np.ndarray, rate_hz: float) -> float:
    """Return half the swing of a force below 250 Hz (N): the cycle, without the dither."""
    spectrum = np.fft.rfft((force - force.mean()) * np.hanning(len(force)))
    low = np.fft.rfftfreq(len(force), 1.0 / rate_hz) < 250.0
    return 4.0 * float(np.abs(spectrum[low]).max()) / len(force)


def dither(actuator: Values, controller: Values, rate_hz: float,
           frequencies_hz: Sequence[float] = FREQUENCIES_HZ, report: Progress = silent
           ) -> list[dict[str, Any]]:
    """
    Return for each frequency the least dither (N of command) that quenches the cycle.

    With the valve's travel (m/s, mean of its speed) and the force ripple (N rms) that it costs;
    amplitude None where none up to MOST_N does. Beside it the least share of the cycle that any
    dither tried leaves, and that dither (N). The controller must cycle without dither.
    """
    cycling = _slow_swing(_run(actuator, controller, rate_hz, 0.0, 0.0)[0], rate_hz)
    rows = []
    for number, frequency in enumerate(frequencies_hz):
        report(f'dither of {frequency:g} Hz', number / len(frequencies_hz))
        if frequency >= 0.45 * rate_hz:
            continue

        def left(amplitude: float, frequency: float = frequency) -> float:
            force, _ = _run(actuator, controller, rate_hz, amplitude, frequency)
            return _slow_swing(force, rate_hz) / cycling

        tried = np.geomspace(20.0, MOST_N, 14)
        shares = [left(float(amplitude)) for amplitude in tried]
        works = next((float(a) for a, share in zip(tried, shares, strict=True)
                      if share < QUENCHED), None)
        least = int(np.argmin(shares))
        row: dict[str, Any] = {'frequency_hz': frequency, 'amplitude_n': None,
                               'least_left': shares[least], 'least_left_at_n': float(tried[least]),
                               'valve_travel_m_s': None, 'force_ripple_n': None}
        if works is not None:
            low = works / (tried[1] / tried[0])
            while works / low > 1.0 + ACCURACY:
                middle = math.sqrt(works * low)
                low, works = (low, middle) if left(middle) < QUENCHED else (middle, works)
            force, valve = _run(actuator, controller, rate_hz, works, frequency)
            row |= {'amplitude_n': works, 'force_ripple_n': float(force.std()),
                    'valve_travel_m_s': float(np.abs(np.diff(valve)).mean() * rate_hz)}
        rows.append(row)
    return rows
