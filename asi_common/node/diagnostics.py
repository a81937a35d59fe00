"""
The messages of a node on /diagnostics: statistics of its loop, and its state.

Twice a second of wall time it publishes an array of the statuses `NODE: loop` and, if it has a
state, `NODE: state`. Each change of the state is also published at once, as an array of that
status alone, which is stamped in the time of the loop and contains nothing of the wall clock. In
lock-step this message is the same in each run of an experiment, so only it is recorded there.
"""

import math
import time
from array import array
from collections.abc import Callable, Mapping
from typing import Final

import numpy as np
import numpy.typing as npt
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node

from asi_common.node import messages as wire
from asi_common.node.executor import Unhurried
from asi_common.node.topics import create_publisher

PERIOD_S: Final = 0.5
LOOP, STATE = ': loop', ': state'
# Longest wait of lock-step until all subscribers have received a change, s; it takes a
# millisecond, unless a subscriber has died.
HEARD_S: Final = 2.0
# Ticks over which period and latency are taken.
WINDOW: Final = 5000
# Real time: a period longer than so many nominal ones gives a warning; a lost sample gives one for
# so long (s).
LONGEST_PERIODS: Final = 2.0
LOST_FOR_S: Final = 5.0
# The other node has ended, or stands still, if it sends nothing for so long (s).
SILENT_S: Final = 1.0

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


class LoopStatistics:
    """Period and latency of the last ticks (wall time), how many saturated, samples lost."""

    def __init__(self, period_s: float = math.inf) -> None:
        """period_s: the nominal period in real time; in lock-step a tick may take any time."""
        self.ticks = self.lost = 0
        self._longest_ns = LONGEST_PERIODS * period_s * 1e9
        self._lost_at_s = -math.inf
        # Shortened to WINDOW when they are read. Numpy copies an array at once, but takes half a
        # millisecond for 5000 numbers of a deque, which would delay a tick.
        self._ticked_ns, self._latencies_ns = array('q'), array('q')
        self._saturated = array('q')  # numbers of the saturated ticks
        # Adds the latency of the last tick, ns.
        self.latency = self._latencies_ns.append

    def tick(self, now_ns: int, saturated: bool) -> None:
        """Count a tick that happens now, by the steady clock."""
        self.ticks += 1
        self._ticked_ns.append(now_ns)
        if saturated:
            self._saturated.append(self.ticks)

    def lose(self, samples: int) -> None:
        """Count samples that were lost now."""
        if samples > 0:
            self.lost += samples
            self._lost_at_s = time.monotonic()

    def problems(self) -> list[str]:
        """Return the warnings about the last seconds, in words."""
        problems = []
        if time.monotonic() - self._lost_at_s < LOST_FOR_S:
            problems.append(f'samples were lost within the last {LOST_FOR_S:g} s '
                            f'({self.lost} since the start)')
        longest_ns = np.diff(np.array(self._ticked_ns[-WINDOW:])).max(initial=0)
        if longest_ns > self._longest_ns:
            problems.append(f'the longest of the last periods took {longest_ns * 1e-6:.3g} ms, '
                            f'{longest_ns / self._longest_ns * LONGEST_PERIODS:.1f} times as long '
                            'as it should')
        return problems

    def silence_s(self) -> float:
        """Return how long ago the last tick was, s."""
        return (time.monotonic_ns() - self._ticked_ns[-1]) * 1e-9 if self._ticked_ns else 0.0

    def values(self) -> dict[str, object]:
        """Return the statistics by key; the unit is part of the key."""
        for noted in (self._ticked_ns, self._latencies_ns, self._saturated):
            del noted[:-WINDOW]
        saturated = np.count_nonzero(np.array(self._saturated) > self.ticks - WINDOW)
        return {
            'ticks': self.ticks, 'lost samples': self.lost,
            **_summary('period', np.diff(np.array(self._ticked_ns))),
            **_summary('latency', np.array(self._latencies_ns)),
            'saturation share': saturated / max(1, len(self._ticked_ns)),
        }


def _summary(name: str, times_ns: npt.NDArray[np.int64]) -> dict[str, object]:
    """Return median, mean, jitter and maximum of times, by key; {} without any."""
    if not times_ns.size:
        return {}
    times_ms = times_ns * 1e-6
    middle = float(np.median(times_ms))
    return {f'{name} median (ms)': middle, f'{name} mean (ms)': float(times_ms.mean()),
            f'{name} jitter p99 (ms)': float(np.quantile(np.abs(times_ms - middle), 0.99)),
            f'{name} max (ms)': float(times_ms.max())}


class Diagnostics:
    """Publishes the status of a node twice a second, and on request."""

    def __init__(self, node: Node,
                 describe: Callable[[], tuple[bytes, str, Mapping[str, object]]],
                 state: Callable[[], wire.Status] | None = None):
        """describe() returns level, message, and values by key; state() as StateChanges has it."""
        self._node = node
        self._describe = describe
        self._state = state
        self._publisher = create_publisher(node, '/diagnostics')
        node.create_timer(PERIOD_S, self.publish, Unhurried(),
                          Clock(clock_type=ClockType.STEADY_TIME))

    def publish(self) -> None:
        level, text, values = self._describe()
        name = full_name(self._node)
        statuses = [wire.Status(level, name + LOOP, text,
                                {key: _text(value) for key, value in values.items()})]
        if self._state is not None:
            statuses.append(self._state())
        self._publisher.publish(wire.diagnostics(
            self._node.get_clock().now().nanoseconds, name, statuses))


class LoopLog:
    """Logs that a loop that ran has stood still for PERIOD_S, and that it runs again."""

    def __init__(self, node: Node):
        self._node = node
        self._told = self._ran = False
        self._stood = 0   # so often in succession

    def tell(self, level: bytes, text: str) -> None:
        """Take level and message of the loop, as Diagnostics asks for them."""
        self._ran = self._ran or level == OK
        self._stood = 0 if level == OK else self._stood + 1
        if self._told and not self._stood:
            self._told = False
            self._node.get_logger().info('running again')
        elif self._ran and not self._told and self._stood > 1:
            self._told = True
            self._node.get_logger().warning(text)


class StateChanges:
    """Publishes the state of a node, and its reason, when it changes."""

    def __init__(self, node: Node):
        self._name = full_name(node)
        # Of its own, so that the numbers of its messages are the same in each run.
        self.publisher = create_publisher(node, '/diagnostics')

    def status(self, level: bytes, state: str, reason: str) -> wire.Status:
        """Return the status of a state and the reason for it, '' for none."""
        return wire.Status(level, self._name + STATE, f'{state}: {reason}' if reason else state,
                           {'state': state, 'reason': reason})

    def publish(self, stamp_ns: int, status: wire.Status, wait: bool) -> None:
        """
        Publish the status of a state that holds from a time (ns) of the loop on.

        wait: return when all subscribers have it, so that it precedes what is published next.
        """
        self.publisher.publish(wire.diagnostics(stamp_ns, self._name, [status]))
        if wait:
            self.publisher.wait_for_all_acked(Duration(seconds=HEARD_S))


def full_name(node: Node) -> str:
    """Return namespace and name of a node, without the first slash."""
    return node.get_fully_qualified_name().lstrip('/')


def _text(value: object) -> str:
    return f'{value:.6g}' if isinstance(value, float) else str(value)
