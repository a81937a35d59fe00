"""
What a node says about itself on /diagnostics: about its loop, and each change of its state.

The first, named `NODE: loop`, comes twice a second of wall time. The second, `NODE: state`, is
stamped in the time of the loop and holds nothing of the wall clock: in lock-step it is the same in
each run of an experiment, so a recorder keeps it there, and the first not.
"""

from array import array
from collections.abc import Callable, Mapping
from typing import Final

import numpy as np
import numpy.typing as npt
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node

from asi_common.node import messages as wire
from asi_common.node.executor import Unhurried

PERIOD_S: Final = 0.5
LOOP, STATE = ': loop', ': state'
# How long lock-step waits at most until all who listen have heard of a change, s; it takes a
# millisecond, unless a listener has died.
HEARD_S: Final = 2.0
# Ticks over which period and latency are taken.
WINDOW: Final = 5000

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


class LoopStatistics:
    """Period and latency of the last ticks (wall time), and how many of them saturated."""

    def __init__(self) -> None:
        self.ticks = 0
        # Cut when they are looked at. Numpy takes 5000 numbers of an array at once, of a deque one
        # by one, for half a millisecond: a tick that came meanwhile would be late.
        self._ticked_ns, self._latencies_ns = array('q'), array('q')
        self._saturated = array('q')  # the numbers of such ticks
        # Takes how long the answer of the last tick took, ns.
        self.latency = self._latencies_ns.append

    def tick(self, now_ns: int, saturated: bool) -> None:
        """Count a tick that happens now, by the steady clock."""
        self.ticks += 1
        self._ticked_ns.append(now_ns)
        if saturated:
            self._saturated.append(self.ticks)

    def values(self) -> dict[str, object]:
        """Return what there is to say, by key; the unit is part of the key."""
        for noted in (self._ticked_ns, self._latencies_ns, self._saturated):
            del noted[:-WINDOW]
        saturated = np.count_nonzero(np.array(self._saturated) > self.ticks - WINDOW)
        return {
            'ticks': self.ticks,
            **_summary('period', np.diff(np.array(self._ticked_ns))),
            **_summary('latency', np.array(self._latencies_ns)),
            'saturation share': saturated / max(1, len(self._ticked_ns)),
        }


def _summary(name: str, times_ns: npt.NDArray[np.int64]) -> dict[str, object]:
    if not times_ns.size:
        return {}
    times_ms = times_ns * 1e-6
    middle = float(np.median(times_ms))
    return {f'{name} median (ms)': middle, f'{name} mean (ms)': float(times_ms.mean()),
            f'{name} jitter p99 (ms)': float(np.quantile(np.abs(times_ms - middle), 0.99)),
            f'{name} max (ms)': float(times_ms.max())}


class Diagnostics:
    """Publishes a node's state of health."""

    def __init__(self, node: Node,
                 describe: Callable[[], tuple[bytes, str, Mapping[str, object]]]):
        """describe() returns level, message, and values by key."""
        self._node = node
        self._describe = describe
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        node.create_timer(PERIOD_S, self.publish, Unhurried(),
                          Clock(clock_type=ClockType.STEADY_TIME))

    def publish(self) -> None:
        level, text, values = self._describe()
        name = full_name(self._node)
        self._publisher.publish(wire.status(
            self._node.get_clock().now().nanoseconds, level, name, name + LOOP, text,
            {key: _text(value) for key, value in values.items()}))


class StateChanges:
    """Publishes what state a node is in, and why, when that changes."""

    def __init__(self, node: Node):
        self._name = full_name(node)
        # Of its own, so that the numbers of its messages are the same in each run.
        self.publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)

    def publish(self, stamp_ns: int, level: bytes, state: str, reason: str, wait: bool) -> None:
        """
        Tell a state that holds from a time (ns) of the loop on, and the reason, '' for none.

        wait: return when all who listen have it, so that it comes before what is published next.
        """
        self.publisher.publish(wire.status(
            stamp_ns, level, self._name, self._name + STATE,
            f'{state}: {reason}' if reason else state, {'state': state, 'reason': reason}))
        if wait:
            self.publisher.wait_for_all_acked(Duration(seconds=HEARD_S))


def full_name(node: Node) -> str:
    """Return namespace and name of a node, without the first slash."""
    return node.get_fully_qualified_name().lstrip('/')


def _text(value: object) -> str:
    return f'{value:.6g}' if isinstance(value, float) else str(value)
