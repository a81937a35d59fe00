"""
Hammerstein models of a loop's output: a valve nonlinearity followed by a linear process.

The output is simulated from the command through a valve operator, a lag (or an integrator) and a
delay, over grids of their parameters; the gain is fitted. The best valve of each kind is then
refitted with any process whose impulse response keeps its sign, and its simulation error is
compared (Hammerstein models: Srinivasan et al., Ind. Eng. Chem. Res. 44, 2005; Jelali, J. Process
Control 18, 2008). The controller may be any.
"""

import math
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from scipy import optimize, signal

from asi_analysis.arrays import Array
from asi_analysis.limit_cycle.attribution import valves

WIDTHS: Final = (0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.92)
# Stiction: slip jump as a share of the stick band; stick band as a share of the command's range.
SLIP_JUMPS: Final = (0.15, 0.4, 0.7, 1.0)
BANDS: Final = (0.25, 0.45, 0.65, 0.82, 0.95)
# Cycles at the start that are left out: the valve's position there is unknown.
SKIPPED: Final = 1.3
CLIPS: Final = (0.85, 0.7, 0.5, 0.3)
# Relative changes of the best width that are tried after the grid, in turn.
REFINEMENTS: Final = (0.15, 0.07, 0.03)
# Lags in cycles; the last is practically an integrator.
LAGS: Final = (0.0, 0.015, 0.03, 0.06, 0.12, 0.25, 0.5, 1.0, 5.0)
LONGEST_DELAY: Final = 0.45      # cycles
DELAYS: Final = 14
# Added to the diagonal: equations that differ by rounding only would be singular.
REGULARISATION: Final = 1e-9


class Explanation(NamedTuple):
    """
    The best fit of one kind of valve.

    unexplained: residual power over power of the output; width: in the unit of the command;
    slip_jump: as a share of the width; lag and delay in cycles; residual: from sample `start` on.
    """

    kind: str
    unexplained: float
    width: float
    slip_jump: float
    lag: float
    delay: float
    gain: float
    residual: Array
    start: int


def without_drift(values: Array, cycle: float) -> Array:
    """Return the values high-pass filtered at 0.35 of the oscillation; cycle: samples a cycle."""
    pad = min(len(values) - 1, int(3 * cycle))
    return signal.sosfiltfilt(_highpass(cycle), values, axis=-1, padlen=pad)


@lru_cache(1)
def _highpass(cycle: float) -> Array:
    """Return the sections of the filter; all valves that are fitted to a record share it."""
    return np.asarray(signal.butter(2, min(2.0 * 0.35 / cycle, 0.9), 'highpass', output='sos'))


class _Candidate(NamedTuple):
    """A kind of valve, its width in units of the command, its slip jump as a share of that."""

    kind: str
    width: float
    slip_jump: float


def _grid(half: float) -> list[_Candidate]:
    """Return the first candidates for a command of amplitude `half`."""
    return [_Candidate('linear', 0.0, 0.0),
            *[_Candidate('stiction', 2.0 * share * half, slip_jump)
              for slip_jump in SLIP_JUMPS for share in BANDS],
            *[_Candidate(kind, share * half, 0.0)
              for share in WIDTHS for kind in ('backlash', 'hysteresis')],
            *[_Candidate('saturation', share * half, 0.0) for share in CLIPS]]


def _neighbours(found: dict[str, Explanation], step: float) -> list[_Candidate]:
    """Return candidates close to the best of each kind; step: relative change."""
    near = []
    for each in found.values():
        kind, width, slip_jump = each.kind, each.width, each.slip_jump
        if kind == 'linear':
            continue
        jumps = (slip_jump,) if kind != 'stiction' else (
            max(slip_jump - 2.0 * step, 0.0), slip_jump, min(slip_jump + 2.0 * step, 1.0))
        near += [_Candidate(kind, width * (1.0 + change), other)
                 for change in (-step, 0.0, step) for other in jumps
                 if (change, other) != (0.0, slip_jump)]
    return near


def _position(command: Array, candidate: _Candidate, first: int) -> Array:
    kind, width, slip_jump = candidate
    if kind == 'stiction':
        return valves.stick(command, width, slip_jump * width, first)
    if kind == 'backlash':
        return valves.play(command, width, first)
    if kind == 'hysteresis':
        return valves.hysteresis(command, width, first)
    return valves.clip(command, width) if kind == 'saturation' else command


class _Fit:
    """Fits valves, with lag, delay and gain, to one output; keeps the best of each kind."""

    def __init__(self, command: Array, output: Array, cycle: float) -> None:
        self.command, self.cycle = command, cycle
        self.skip = int(SKIPPED * cycle)
        self.shifts = np.unique(np.round(
            np.linspace(0.0, LONGEST_DELAY * cycle, DELAYS)).astype(int))
        target = without_drift(output, cycle)
        # For each delay the same samples of the valve are compared with later ones of the output.
        self.length = len(target) - self.skip - int(self.shifts[-1])
        self.shifted = np.array([target[self.skip + shift:self.skip + shift + self.length]
                              for shift in self.shifts])
        self.total = (self.shifted * self.shifted).sum(1)
        self.best: dict[str, Explanation] = {}

    def try_out(self, candidates: list[_Candidate]) -> None:
        """Fit candidates; store those that are better than the best so far of their kind."""
        positions = [_position(self.command, each, self.skip) for each in candidates]
        moving = [k for k, each in enumerate(positions) if np.ptp(each[self.skip:]) > 0.0]
        if not moving:      # a constant command moves no valve
            return
        # The drift is removed before the lag, which would amplify it relative to the cycle.
        filtered = without_drift(np.array([positions[k] for k in moving]), self.cycle)
        for k, position in zip(moving, filtered, strict=True):
            self._fit(candidates[k], position)

    def _fit(self, candidate: _Candidate, position: Array) -> None:
        driven = np.array([_lag(position, lag * self.cycle) for lag in LAGS])
        driven = driven[:, self.skip:self.skip + self.length]
        power = np.maximum((driven * driven).sum(1), 1e-300)[:, None]
        product = driven @ self.shifted.T
        unexplained = 1.0 - product * product / power / self.total
        i, j = np.unravel_index(np.argmin(unexplained), unexplained.shape)
        kind = candidate.kind
        if kind not in self.best or unexplained[i, j] < self.best[kind].unexplained:
            gain = float(product[i, j] / power[i, 0])
            self.best[kind] = Explanation(
                *candidate[:1], float(unexplained[i, j]), *candidate[1:], LAGS[i],
                self.shifts[j] / self.cycle, gain, self.shifted[j] - gain * driven[i],
                self.skip + int(self.shifts[j]))

    def with_general_process(self, best: Explanation) -> Explanation:
        """
        Return an explanation with any process whose impulse response keeps its sign.

        The process is a non-negative sum of all lags and delays. With a single lag and delay from
        a grid, a valve could be preferred only because it compensates the coarse grid.
        """
        candidate = _Candidate(best.kind, best.width, best.slip_jump)
        position = without_drift(_position(self.command, candidate, self.skip), self.cycle)
        last, target = int(self.shifts[-1]), self.shifted[-1]
        columns = []
        for lag in LAGS:
            driven = math.copysign(1.0, best.gain) * _lag(position, lag * self.cycle)
            columns += [driven[self.skip + last - shift:][:self.length] for shift in self.shifts]
        table = np.array(columns)
        table /= np.maximum(np.linalg.norm(table, axis=1, keepdims=True), 1e-300)
        # The normal equations are far smaller than the record.
        root = np.linalg.cholesky(table @ table.T + REGULARISATION * np.eye(len(table)))
        weights = optimize.nnls(root.T, np.linalg.solve(root, table @ target))[0]
        residual = target - weights @ table
        return best._replace(unexplained=float(residual @ residual / (target @ target)),
                             residual=residual, start=self.skip + last)


def explain(command: Array, output: Array, cycle: float) -> dict[str, Explanation]:
    """
    Return the best fit of each kind of valve to evenly sampled signals, drift removed.

    cycle: samples a cycle.
    """
    fit = _Fit(command, output, cycle)
    # Percentiles, because noise sets the extremes.
    fit.try_out(_grid(0.5 * float(np.subtract(*np.percentile(command, [98.5, 1.5])))))
    for step in REFINEMENTS:
        fit.try_out(_neighbours(fit.best, step))
    return {kind: fit.with_general_process(best) for kind, best in fit.best.items()}


def _lag(values: Array, samples: float) -> Array:
    """Return the values through a first-order lag of so many samples."""
    if samples < 0.1:
        return values
    keep = np.exp(-1.0 / samples)
    return signal.lfilter([1.0 - keep], [1.0, -keep], values)
