"""Pictures of `asi compare`: the responses of several controllers over each other."""

from collections.abc import Mapping

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.bags.run import Run
from asi_analysis.measures.step_response import step_response
from asi_analysis.reporting.figures import Panel, overlays
from asi_analysis.reporting.result import Pictures
from asi_analysis.tuning.figures import (
    BAND_HZ,
    BEFORE_S,
    IMPEDANCE_HZ,
    IMPEDANCE_M_S,
    MOTIONS,
    SIZES_N,
    Responses,
    gains_db,
)

# Steps that are drawn, N, and for how long, ms.
DRAWN_N = (20.0, 100.0, 300.0, 700.0)
DRAWN_MS = 100.0

Lines = dict[str, tuple[Array, Array]]


def simulated(found: Mapping[str, Responses], rate_hz: float) -> Pictures:
    """Return the pictures of controllers: steps, 10 Hz sine, gain, felt force, impedance."""
    sizes = [Panel(f'{size:g} N', 'time after the step (ms)', 'force (% of the step)',
                   _step(found, SIZES_N.index(size), size, rate_hz)) for size in DRAWN_N]
    period = round(rate_hz / 10.0)
    time_ms = 1e3 * np.arange(period, dtype=np.float64) / rate_hz
    first = next(iter(found.values()))
    sine: Lines = {'reference': (time_ms, first.sines[0, 0, -period:])}
    sine |= {name: (time_ms, each.sines[0, 2, -period:]) for name, each in found.items()}
    gain: Lines = {name: (np.array(BAND_HZ), np.array(gains_db(each.sines, rate_hz)))
                   for name, each in found.items()}
    felt = [Panel(f'{velocity:g} m/s at {frequency:g} Hz', 'time (s)', 'force felt (N)', {
        name: (np.arange(each.motions[key].shape[1]) / rate_hz, each.motions[key][2])
        for name, each in found.items()}) for key, (velocity, frequency) in MOTIONS.items()]
    impedance = [Panel(f'{velocity:g} m/s', 'frequency (Hz)', 'Re Z (N s/m)', {
        name: (np.array(IMPEDANCE_HZ), each.impedance[k].real) for name, each in found.items()},
        logarithmic=True) for k, velocity in enumerate(IMPEDANCE_M_S)]
    return {
        'steps': (overlays(sizes, 2), 'Steps of the reference on the locked piston'),
        'sine': (overlays([Panel('10 Hz, 100 N', 'time (ms)', 'force (N)', sine)]),
                 'A sine of the reference on the locked piston'),
        'gain': (overlays([Panel('From reference to force at 50 N', 'frequency (Hz)', 'gain (dB)',
                                 gain)]), 'Gain of the closed loop'),
        'felt_force': (overlays(felt), 'Force of a moved piston at reference 0'),
        'impedance': (overlays(impedance), 'Real part of the impedance; below 0 not passive')}


def _step(found: Mapping[str, Responses], number: int, size: float, rate_hz: float) -> Lines:
    count = round((BEFORE_S + 1e-3 * DRAWN_MS) * rate_hz)
    time_ms = 1e3 * (np.arange(count) / rate_hz - BEFORE_S)
    lines: Lines = {'reference': (np.array([time_ms[0], 0.0, 0.0, DRAWN_MS]),
                                  np.array([0.0, 0.0, 100.0, 100.0]))}
    return lines | {name: (time_ms, 100.0 * each.steps[number, 2, :count] / size)
                    for name, each in found.items()}


def recorded(runs: Mapping[str, Run]) -> Pictures:
    """Return overlays of the outputs of recordings, each from its largest step on."""
    lines: dict[str, Lines] = {}
    for name, run in runs.items():
        steps = step_response(run).steps
        largest = max(steps, key=lambda step: abs(step['final_n'] - step['initial_n']),
                      default={'time_s': 0.0})
        output = run.output()
        lines.setdefault(f'{output} ({run.unit(output)})', {})[name] = (
            run.time_s - largest['time_s'], run.signal(output))
    return {'recordings': (overlays([Panel('Recordings', 'time after the step (s)', *each)
                                     for each in lines.items()]), 'Recordings')}
