"""Dither: the least amplitude at each frequency that quenches the cycle, and its side effects."""

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from scipy import signal

from asi_actuator.model.actuator import advance, measure, prepare, rest
from asi_analysis.loop.simulation import Values, loop_of
from asi_analysis.measures.oscillation import FLOOR_N, Oscillation, of_samples
from asi_analysis.terminal import Progress, silent
from asi_common.jit import jit
from asi_controller.compensator import compensate

FREQUENCIES_HZ: Final = (300.0, 500.0, 800.0, 1200.0, 1700.0)
MOST_N: Final = 4000.0
WATCHED_S: Final = 0.8
MEASURED_S: Final = 0.35
# The cycle is measured below this frequency; the dither is above it.
CYCLES_BELOW_HZ: Final = 200.0
# Share of the cycle's amplitude below which it counts as quenched.
QUENCHED: Final = 0.03
ACCURACY: Final = 0.05


@jit
def _dithered(state, p, c, reference, amplitude, frequency, period, out):
    steady = prepare(p, period)
    for k in range(out.shape[1]):
        force, valve, _, velocity = measure(state, p)
        command = compensate(c, reference, force, velocity)
        out[0, k] = force
        out[1, k] = valve
        advance(state, command + amplitude * math.sin(2.0 * math.pi * frequency * k * period),
                p, steady)


def _run(actuator: Values, controller: Values, rate_hz: float, amplitude: float,
         frequency: float) -> tuple[np.ndarray, np.ndarray]:
    """Return force and valve position at the end of a step with dither on the command."""
    loop = loop_of(actuator, controller, rate_hz)
    out = np.empty((2, round(WATCHED_S * rate_hz)))
    _dithered(rest(), loop.plant, loop.compensator, loop.reference_n, amplitude, frequency,
              loop.period_s, out)
    return tuple(out[:, -round(MEASURED_S * rate_hz):])


def _cycle(force: np.ndarray, rate_hz: float, noise_floor: float = FLOOR_N) -> Oscillation:
    """Return the oscillation of a force without the dither on it."""
    low_pass = signal.butter(8, CYCLES_BELOW_HZ, fs=rate_hz, output='sos')
    return of_samples(signal.sosfiltfilt(low_pass, force), rate_hz, noise_floor)


def dither(actuator: Values, controller: Values, rate_hz: float,
           frequencies_hz: Sequence[float] = FREQUENCIES_HZ, report: Progress = silent
           ) -> list[dict[str, Any]]:
    """
    Return for each frequency the least dither (N of command) that quenches the cycle.

    Its amplitude (None if none up to MOST_N does), mean speed of the valve (m/s) and force ripple
    (N rms); also the least remaining share of the cycle among all amplitudes tried, and that
    amplitude (N). The loop must cycle without dither.
    """
    cycling = _cycle(_run(actuator, controller, rate_hz, 0.0, 0.0)[0], rate_hz).amplitude_n
    rows = []
    for number, frequency in enumerate(frequencies_hz):
        report(f'dither of {frequency:g} Hz', number / len(frequencies_hz))
        if frequency >= 0.45 * rate_hz:
            continue

        def with_dither(amplitude: float, frequency: float = frequency) -> Oscillation:
            force, _ = _run(actuator, controller, rate_hz, amplitude, frequency)
            return _cycle(force, rate_hz, QUENCHED * cycling)

        tried = np.geomspace(20.0, MOST_N, 14)
        remaining = [with_dither(float(amplitude)) for amplitude in tried]
        least_n = next((float(a) for a, found in zip(tried, remaining, strict=True)
                      if not found.sustained), None)
        shares = np.nan_to_num([found.amplitude_n / cycling for found in remaining])
        weakest = int(np.argmin(shares))
        row: dict[str, Any] = {'frequency_hz': frequency, 'amplitude_n': None,
                               'least_left': float(shares[weakest]),
                               'least_left_at_n': float(tried[weakest]),
                               'valve_travel_m_s': None, 'force_ripple_n': None}
        if least_n is not None:
            low = least_n / (tried[1] / tried[0])
            while least_n / low > 1.0 + ACCURACY:
                middle = math.sqrt(least_n * low)
                if with_dither(middle).sustained:
                    low = middle
                else:
                    least_n = middle
            force, valve = _run(actuator, controller, rate_hz, least_n, frequency)
            row |= {'amplitude_n': least_n, 'force_ripple_n': float(force.std()),
                    'valve_travel_m_s': float(np.abs(np.diff(valve)).mean() * rate_hz)}
        rows.append(row)
    return rows
