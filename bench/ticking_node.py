"""
Jitter of the actuator node: `python -m bench.ticking_node SECONDS --ros-args ...`.

Runs the unchanged node, stores the times of its ticks, and prints the jitter of the period (JSON):
of the last SECONDS, the steady part, and of the start before, with discovery and first calls.
"""

import json
import sys
import time

import numpy as np
import numpy.typing as npt

from asi_actuator import actuator_node
from asi_common.node.diagnostics import LoopStatistics


def jitter_p99_ms(periods_s: npt.NDArray[np.float64]) -> float:
    """Return the 99th percentile of how far periods are from their median, ms."""
    return 1e3 * float(np.quantile(abs(periods_s - np.median(periods_s)), 0.99))


def main() -> None:
    """Run the node until it is stopped."""
    seconds = float(sys.argv.pop(1))
    ticked_s: list[float] = []
    tick = LoopStatistics.tick

    def noted(statistics: LoopStatistics, now_ns: int, saturated: bool) -> None:
        ticked_s.append(time.perf_counter())
        tick(statistics, now_ns, saturated)

    setattr(LoopStatistics, 'tick', noted)  # noqa: B010 (mypy does not let a method be replaced)
    actuator_node.main()
    times_s = np.array(ticked_s)
    steady = times_s[1:] > times_s[-1] - seconds
    periods_s = np.diff(times_s)
    print(json.dumps({'jitter_p99_ms': jitter_p99_ms(periods_s[steady]),
                      'start_jitter_p99_ms': jitter_p99_ms(periods_s[~steady])}))


if __name__ == '__main__':
    main()
