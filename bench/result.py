"""
`Result`: one figure of a benchmark; timing of alternatives in turns.

Each module of `bench` that measures has `measure(quick) -> list[Result]`; quick: a few rounds
only, as a test. `make bench` runs them all and writes doc/reference/performance.md.
"""

import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple


class Result(NamedTuple):
    """
    One figure: ours, beside a rival's of the same minutes.

    `ratio` says more than `value`: it is ours divided by the rival's, or the other way round,
    whichever `what` says. The target is about the ratio, or the value if there is no ratio.
    """

    name: str                    # 'model.locked': the module, then what; no two are the same
    what: str                    # in words, for the table
    value: float                 # the median over the rounds, ours
    unit: str
    spread: float = 0.0          # median absolute deviation: of the ratio, or else of the value
    rival: str = ''              # what the ratio is against
    ratio: float | None = None
    target: str = ''             # '<= 1.1' or '>= 100'; '' if there is none
    share: float | None = None   # of the rival's speed that we reach, if it is an upper limit
    at: float | None = None      # of a point of a curve: the size at which `value` was measured

    @property
    def met(self) -> bool | None:
        """Whether the target is met; None if there is none."""
        if not self.target:
            return None
        figure = self.value if self.ratio is None else self.ratio
        sign, limit = self.target.split()
        return figure <= float(limit) if sign == '<=' else figure >= float(limit)


def deviation(values: Sequence[float]) -> float:
    """Return the median absolute deviation of values."""
    middle = statistics.median(values)
    return statistics.median(abs(value - middle) for value in values)


def interleaved(rivals: Mapping[str, Callable[[], object]], rounds: int,
                clock: Callable[[], float] = time.perf_counter) -> dict[str, list[float]]:
    """
    Return the times (s) of each rival, one a round.

    After one run each to warm up they take turns, each round in the opposite order of the last
    (ABBA), so that a machine that drifts cancels out of the ratios of a round.
    """
    for run in rivals.values():
        run()
    times: dict[str, list[float]] = {name: [] for name in rivals}
    names = list(rivals)
    for _ in range(rounds):
        for name in names:
            begin = clock()
            rivals[name]()
            times[name].append(clock() - begin)
        names.reverse()
    return times


def ratios(times: Sequence[float], others: Sequence[float]) -> tuple[float, float]:
    """Return the median of the rounds' ratios times / others, and its deviation."""
    each = [a / b for a, b in zip(times, others, strict=True)]
    return statistics.median(each), deviation(each)


def show(results: Iterable[Result]) -> None:
    """Print results, a line each."""
    for r in results:
        ratio = '' if r.ratio is None else f'{r.ratio:9.3g} x {r.rival}'
        met = {True: 'met', False: 'MISSED', None: ''}[r.met]
        print(f'{r.what:<64} {r.value:10.4g} {r.unit:<24} {ratio:<32} {r.target:<8} {met}',
              flush=True)
