"""What a node says about its loop on /diagnostics, twice a second of wall time."""

import time
from collections.abc import Callable, Mapping
from typing import Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

PERIOD_S: Final = 0.5
# Ticks over which period and latency are taken.
WINDOW: Final = 5000

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


class LoopStatistics:
    """Period and latency of the last ticks (wall time), and how many of them saturated."""

    def __init__(self) -> None:
        self.ticks = 0
        self._last_ns = 0
        self._periods_ns = np.full(WINDOW, np.nan)
        self._latencies_ns = np.full(WINDOW, np.nan)
        self._saturated = np.zeros(WINDOW, bool)

    def tick(self, saturated: bool) -> None:
        """Count a tick that happens now."""
        now_ns = time.perf_counter_ns()
        place = self.ticks % WINDOW
        if self._last_ns:
            self._periods_ns[place] = now_ns - self._last_ns
        self._last_ns = now_ns
        self._saturated[place] = saturated
        self.ticks += 1

    def latency(self, latency_ns: float) -> None:
        """Note how long the answer of the last tick took."""
        self._latencies_ns[self.ticks % WINDOW] = latency_ns

    def values(self) -> dict[str, object]:
        """Return what there is to say, by key; the unit is part of the key."""
        return {
            'ticks': self.ticks,
            **_summary('period', self._periods_ns),
            **_summary('latency', self._latencies_ns),
            'saturation share': self._saturated[:self.ticks].mean() if self.ticks else 0.0,
        }


def _summary(name: str, times_ns: np.ndarray) -> dict[str, object]:
    times_ms = times_ns[~np.isnan(times_ns)] * 1e-6
    if not times_ms.size:
        return {}
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
        node.create_timer(PERIOD_S, self.publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def publish(self) -> None:
        level, text, values = self._describe()
        message = DiagnosticArray(status=[DiagnosticStatus(
            level=level, name=f'{self._node.get_name()}: loop', message=text,
            hardware_id=self._node.get_name(),
            values=[KeyValue(key=key, value=_text(value)) for key, value in values.items()])])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)


def _text(value: object) -> str:
    return f'{value:.6g}' if isinstance(value, float) else str(value)
