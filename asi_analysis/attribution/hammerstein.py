"""
How well each kind of valve, followed by a linear process, explains an oscillation.

The output is simulated from the command through a valve operator, a lag (or an integrator) and a
delay, over grids of their parameters; the gain is free. The least simulation error of each kind
is what counts (Hammerstein models: Srinivasan et al., Ind. Eng. Chem. Res. 44, 2005; Jelali,
J. Process Control 18, 2008). Nothing about the controller is assumed.
"""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import signal

from asi_analysis.attribution import valves

Array = npt.NDArray[np.float64]

WIDTHS: Final = (0.08, 0.16, 0.26, 0.38, 0.5, 0.62, 0.74, 0.84, 0.92)
# A valve that slips to `slip` times its width passes a swing of (1 + slip) widths or more: these
# are shares of the largest width that the swing of the command moves.
STUCK: Final = (0.3, 0.5, 0.65, 0.78, 0.88, 0.95)
SLIPS: Final = (0.0, 0.2, 0.4, 0.6, 0.75)
# Cycles at the begin that do not count: the valve's position there is not known.
UNKNOWN: Final = 1.3
CLIPS: Final = (0.85, 0.7, 0.5, 0.3)
# Lags in cycles; the last is an integrator in all but name.
LAGS: Final = (0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 1.0, 5.0)
LONGEST_DELAY: Final = 0.45      # cycles
DELAYS: Final = 18
SAMPLES_A_CYCLE: Final = 40


class Explanation(NamedTuple):
    """
    The best of one kind of valve: share of the output's power that it leaves unexplained.

    width: in the unit of the command; slip: dynamic over static friction; lag and delay in cycles.
    """

    kind: str
    unexplained: float
    width: float
    slip: float
    lag: float
    delay: float
    gain: float
    residual: Array


def around(values: Array, cycle: float) -> Array:
    """Return the values without what is much slower than a cycle (of so many samples)."""
    sections = signal.butter(2, min(2.0 * 0.35 / cycle, 0.9), 'highpass', output='sos')
    pad = min(len(values) - 1, int(3 * cycle))
    return signal.sosfiltfilt(sections, values, axis=-1, padlen=pad)


def _candidates(command: Array, first: int) -> list[tuple[str, float, float, Array]]:
    # Without the extremes of noise.
    half = 0.5 * float(np.subtract(*np.percentile(command, [98.5, 1.5])))
    found = [('linear', 0.0, 1.0, command)]
    for slip in SLIPS:
        for share in STUCK:
            width = share * 2.0 * half / (1.0 + slip)
            found.append(('stiction', width, slip,
                          valves.stick(command, width, slip * width, first)))
    for share in WIDTHS:
        width = share * half
        found.append(('backlash', width, 1.0, valves.stick(command, width, width, first)))
        found.append(('hysteresis', width, 1.0, valves.hysteresis(command, width, first)))
    found += [('saturation', share * half, 1.0, valves.clip(command, share)) for share in CLIPS]
    return found


def explain(command: Array, output: Array, cycle: float) -> dict[str, Explanation]:
    """
    Return the best explanation of each kind; evenly sampled, `cycle` samples a cycle.

    A slow trend of either signal does not count.
    """
    target = around(output, cycle)
    skip = int(UNKNOWN * cycle)
    shifts = np.unique(np.round(np.linspace(0.0, LONGEST_DELAY * cycle, DELAYS)).astype(int))
    best: dict[str, Explanation] = {}
    for kind, width, slip, valve in _candidates(command, skip):
        if np.ptp(valve[skip:]) == 0.0:
            continue
        lagged = np.array([_lag(valve - valve.mean(), lag * cycle) for lag in LAGS])
        lagged = around(lagged, cycle)
        for lag, driven in zip(LAGS, lagged, strict=True):
            for shift in shifts:
                part = driven[skip:len(driven) - shift]
                seen = target[skip + shift:]
                power = float(part @ part)
                if power <= 0.0:
                    continue
                gain = float(part @ seen) / power
                total = float(seen @ seen)
                unexplained = 1.0 - gain * gain * power / total
                if kind not in best or unexplained < best[kind].unexplained:
                    best[kind] = Explanation(kind, unexplained, width, slip, lag,
                                             shift / cycle, gain, seen - gain * part)
    return best


def _lag(values: Array, samples: float) -> Array:
    """Return the values through a first-order lag of so many samples."""
    if samples < 0.1:
        return values
    keep = np.exp(-1.0 / samples)
    return signal.lfilter([1.0 - keep], [1.0, -keep], values)
