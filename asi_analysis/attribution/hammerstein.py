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

WIDTHS: Final = (0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.92)
# Of a valve that sticks: its leap as a share of its band, and its band as a share of the widest
# that the command's swing still moves.
LEAPS: Final = (0.15, 0.4, 0.7, 1.0)
BANDS: Final = (0.25, 0.45, 0.65, 0.82, 0.95)
# Cycles at the begin that do not count: the valve's position there is not known.
UNKNOWN: Final = 1.3
CLIPS: Final = (0.85, 0.7, 0.5, 0.3)
# Lags in cycles; the last is an integrator in all but name.
LAGS: Final = (0.0, 0.03, 0.08, 0.2, 0.6, 5.0)
LONGEST_DELAY: Final = 0.45      # cycles
DELAYS: Final = 14


class Explanation(NamedTuple):
    """
    The best of one kind of valve: share of the output's power that it leaves unexplained.

    width: in the unit of the command; leap: as a share of it; lag and delay in cycles; residual:
    what it leaves of the output from sample `start` on.
    """

    kind: str
    unexplained: float
    width: float
    leap: float
    lag: float
    delay: float
    gain: float
    residual: Array
    start: int


def around(values: Array, cycle: float) -> Array:
    """Return the values without what is much slower than a cycle (of so many samples)."""
    sections = signal.butter(2, min(2.0 * 0.35 / cycle, 0.9), 'highpass', output='sos')
    pad = min(len(values) - 1, int(3 * cycle))
    return signal.sosfiltfilt(sections, values, axis=-1, padlen=pad)


def _candidates(command: Array, first: int) -> list[tuple[str, float, float, Array]]:
    # Without the extremes of noise.
    half = 0.5 * float(np.subtract(*np.percentile(command, [98.5, 1.5])))
    found = [('linear', 0.0, 0.0, command)]
    for leap in LEAPS:
        for share in BANDS:
            band = share * 2.0 * half
            found.append(('stiction', band, leap, valves.stick(command, band, leap * band, first)))
    for share in WIDTHS:
        width = share * half
        found.append(('backlash', width, 0.0, valves.play(command, width, first)))
        found.append(('hysteresis', width, 0.0, valves.hysteresis(command, width, first)))
    found += [('saturation', share * half, 0.0, valves.clip(command, share)) for share in CLIPS]
    return found


def explain(command: Array, output: Array, cycle: float) -> dict[str, Explanation]:
    """
    Return the best explanation of each kind; evenly sampled, `cycle` samples a cycle.

    A slow trend of either signal does not count.
    """
    target = around(output, cycle)
    skip = int(UNKNOWN * cycle)
    shifts = np.unique(np.round(np.linspace(0.0, LONGEST_DELAY * cycle, DELAYS)).astype(int))
    # Every delay is the same stretch of the valve seen against a later stretch of the output.
    length = len(target) - skip - int(shifts[-1])
    seen = np.array([target[skip + shift:skip + shift + length] for shift in shifts])
    total = (seen * seen).sum(1)
    best: dict[str, Explanation] = {}
    candidates = [each for each in _candidates(command, skip) if np.ptp(each[3][skip:]) > 0.0]
    # What is slow is taken off before the lag: of a lag of many cycles little else were left.
    valves_moving = around(np.array([each[3] for each in candidates]), cycle)
    for (kind, width, leap, _), moving in zip(candidates, valves_moving, strict=True):
        driven = np.array([_lag(moving, lag * cycle) for lag in LAGS])[:, skip:skip + length]
        power = np.maximum((driven * driven).sum(1), 1e-300)[:, None]
        product = driven @ seen.T
        unexplained = 1.0 - product * product / power / total
        i, j = np.unravel_index(np.argmin(unexplained), unexplained.shape)
        if kind not in best or unexplained[i, j] < best[kind].unexplained:
            gain = float(product[i, j] / power[i, 0])
            best[kind] = Explanation(kind, float(unexplained[i, j]), width, leap, LAGS[i],
                                     shifts[j] / cycle, gain, seen[j] - gain * driven[i],
                                     skip + int(shifts[j]))
    return best


def _lag(values: Array, samples: float) -> Array:
    """Return the values through a first-order lag of so many samples."""
    if samples < 0.1:
        return values
    keep = np.exp(-1.0 / samples)
    return signal.lfilter([1.0 - keep], [1.0, -keep], values)
