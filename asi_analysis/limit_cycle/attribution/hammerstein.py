"""
How well each kind of valve, followed by a linear process, explains an oscillation.

The output is simulated from the command through a valve operator, a lag (or an integrator) and a
delay, over grids of their parameters; the gain is free. The best valve of each kind is then given
any process whose impulse response keeps its sign: its simulation error is what counts
(Hammerstein models: Srinivasan et al., Ind. Eng. Chem. Res. 44, 2005; Jelali, J. Process
Control 18, 2008). Nothing about the controller is assumed.
"""

import math
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import optimize, signal

from asi_analysis.limit_cycle.attribution import valves

Array = npt.NDArray[np.float64]

WIDTHS: Final = (0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.92)
# Of a valve that sticks: its leap as a share of its band, and its band as a share of the widest
# that the command's swing still moves.
LEAPS: Final = (0.15, 0.4, 0.7, 1.0)
BANDS: Final = (0.25, 0.45, 0.65, 0.82, 0.95)
# Cycles at the begin that do not count: the valve's position there is not known.
UNKNOWN: Final = 1.3
CLIPS: Final = (0.85, 0.7, 0.5, 0.3)
# The best of a grid is tried again wider and narrower by these shares, in turn.
FINER: Final = (0.15, 0.07, 0.03)
# Lags in cycles; the last is an integrator in all but name.
LAGS: Final = (0.0, 0.015, 0.03, 0.06, 0.12, 0.25, 0.5, 1.0, 5.0)
LONGEST_DELAY: Final = 0.45      # cycles
DELAYS: Final = 14
# Keeps equations apart that differ by rounding only.
ROUNDING: Final = 1e-9


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


class _Candidate(NamedTuple):
    """A kind of valve, its width in units of the command, its leap as a share of that."""

    kind: str
    width: float
    leap: float


def _grid(half: float) -> list[_Candidate]:
    """Return what is tried first, for a command that swings by `half` to either side."""
    return [_Candidate('linear', 0.0, 0.0),
            *[_Candidate('stiction', 2.0 * share * half, leap)
              for leap in LEAPS for share in BANDS],
            *[_Candidate(kind, share * half, 0.0)
              for share in WIDTHS for kind in ('backlash', 'hysteresis')],
            *[_Candidate('saturation', share * half, 0.0) for share in CLIPS]]


def _finer(found: dict[str, Explanation], step: float) -> list[_Candidate]:
    """Return neighbours of the best of each kind."""
    near = []
    for kind, width, leap in ((each.kind, each.width, each.leap) for each in found.values()):
        if kind == 'linear':
            continue
        leaps = (leap,) if kind != 'stiction' else (
            max(leap - 2.0 * step, 0.0), leap, min(leap + 2.0 * step, 1.0))
        near += [_Candidate(kind, width * (1.0 + change), other)
                 for change in (-step, 0.0, step) for other in leaps
                 if (change, other) != (0.0, leap)]
    return near


def _position(command: Array, candidate: _Candidate, first: int) -> Array:
    kind, width, leap = candidate
    if kind == 'stiction':
        return valves.stick(command, width, leap * width, first)
    if kind == 'backlash':
        return valves.play(command, width, first)
    if kind == 'hysteresis':
        return valves.hysteresis(command, width, first)
    return valves.clip(command, width) if kind == 'saturation' else command


class _Fit:
    """Fits valves, each with the best lag, delay and gain, to one output; keeps the best."""

    def __init__(self, command: Array, output: Array, cycle: float) -> None:
        self.command, self.cycle = command, cycle
        self.skip = int(UNKNOWN * cycle)
        self.shifts = np.unique(np.round(
            np.linspace(0.0, LONGEST_DELAY * cycle, DELAYS)).astype(int))
        target = around(output, cycle)
        # Every delay is the same stretch of the valve seen against a later stretch of the output.
        self.length = len(target) - self.skip - int(self.shifts[-1])
        self.shifted = np.array([target[self.skip + shift:self.skip + shift + self.length]
                              for shift in self.shifts])
        self.total = (self.shifted * self.shifted).sum(1)
        self.best: dict[str, Explanation] = {}

    def try_out(self, candidates: list[_Candidate]) -> None:
        """Keep the candidates that are better than the best so far of their kind."""
        positions = [_position(self.command, each, self.skip) for each in candidates]
        moving = [k for k, each in enumerate(positions) if np.ptp(each[self.skip:]) > 0.0]
        # What is slow is taken off before the lag: of a lag of many cycles little else were left.
        filtered = around(np.array([positions[k] for k in moving]), self.cycle)
        for k, position in zip(moving, filtered, strict=True):
            self._judge(candidates[k], position)

    def _judge(self, candidate: _Candidate, position: Array) -> None:
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


    def through_any_process(self, best: Explanation) -> Explanation:
        """
        Return an explanation with a process of any impulse response that keeps its sign.

        A sum of all lags and delays with weights that are not negative: else a kind of valve
        would be praised for what one lag and one delay, off a grid, leave over.
        """
        position = around(_position(self.command, _Candidate(best.kind, best.width, best.leap),
                                    self.skip), self.cycle)
        last, target = int(self.shifts[-1]), self.shifted[-1]
        columns = []
        for lag in LAGS:
            driven = math.copysign(1.0, best.gain) * _lag(position, lag * self.cycle)
            columns += [driven[self.skip + last - shift:][:self.length] for shift in self.shifts]
        table = np.array(columns)
        table /= np.maximum(np.linalg.norm(table, axis=1, keepdims=True), 1e-300)
        # The normal equations are far smaller than the record.
        root = np.linalg.cholesky(table @ table.T + ROUNDING * np.eye(len(table)))
        weights = optimize.nnls(root.T, np.linalg.solve(root, table @ target))[0]
        residual = target - weights @ table
        return best._replace(unexplained=float(residual @ residual / (target @ target)),
                             residual=residual, start=self.skip + last)


def explain(command: Array, output: Array, cycle: float) -> dict[str, Explanation]:
    """
    Return the best explanation of each kind; evenly sampled, `cycle` samples a cycle.

    A slow trend of either signal does not count.
    """
    fit = _Fit(command, output, cycle)
    # Without the extremes of noise.
    fit.try_out(_grid(0.5 * float(np.subtract(*np.percentile(command, [98.5, 1.5])))))
    for step in FINER:
        fit.try_out(_finer(fit.best, step))
    return {kind: fit.through_any_process(best) for kind, best in fit.best.items()}


def _lag(values: Array, samples: float) -> Array:
    """Return the values through a first-order lag of so many samples."""
    if samples < 0.1:
        return values
    keep = np.exp(-1.0 / samples)
    return signal.lfilter([1.0 - keep], [1.0, -keep], values)
