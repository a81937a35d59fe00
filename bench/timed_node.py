"""
Where the time of a tick goes: `python -m bench.timed_node actuator|controller --ros-args ...`.

Runs the node as it is, but takes the time of the functions that matter, each without those within
it, and prints at the end how long they took a tick (us), as JSON. What taking the time of a
function adds to the one around it is known from a function that does nothing, and taken off.
"""

import functools
import json
import sys
import time
from collections import Counter
from collections.abc import Callable
from typing import Any, Final

from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.publisher import Publisher

from asi_actuator import actuator_node, safety, spin, wire
from asi_actuator.diagnostics import Diagnostics, LoopStatistics
from asi_actuator.driver.simulated import SimulatedActuator
from asi_controller import controller_node
from asi_controller.controller import Controller

WARM_UP_TICKS: Final = 2000


class WaitSet(rclpy_implementation.WaitSet):  # type: ignore[misc, name-defined]
    """Waits in Python, so that the time can be taken."""

    def wait(self, timeout_ns: int) -> None:
        super().wait(timeout_ns)


class _Spin:
    """What `spin` uses of rclpy's implementation."""

    WaitSet = WaitSet


PARTS: Final[dict[str, tuple[tuple[Any, str], ...]]] = {
    'waiting': ((WaitSet, 'wait'),),
    'sending': ((Publisher, 'publish'),),
    'executor': ((spin.LoopExecutor, '_spin_loop'), (SingleThreadedExecutor, 'spin_once')),
    'packing': tuple((wire, name) for name in (
        'clock', 'number', 'wrench', 'state', 'time', 'force', 'piston_effort')),
    'model': ((SimulatedActuator, 'exchange'),),
    'compensator': ((Controller, 'answer'),),
    'safety': ((safety.Safety, 'command'), (safety.Safety, 'watch_state'),
               (safety.Safety, 'watch_link')),
    'statistics': ((LoopStatistics, 'tick'), (LoopStatistics, 'latency'),
                   (Diagnostics, 'publish')),
    'wiring': ((actuator_node.ActuatorNode, '_on_command'),
               (actuator_node.LockStep, '_watch'),
               (controller_node.ControllerNode, '_on_state'),
               (controller_node.LockStep, '_on_clock'),
               (controller_node.LockStep, '_answer_if_due')),
}
OWN: Final = ('packing', 'model', 'compensator', 'safety', 'statistics', 'wiring')


class Times:
    """The times of the parts, ns."""

    def __init__(self) -> None:
        self.total_ns: Counter[str] = Counter()
        self.timed_within: Counter[str] = Counter()     # calls within a part that were timed too
        self.ticks = 0
        # Of the functions that are running: part, and the time of those within, ns.
        self._running: list[list[Any]] = [['', 0]]

    def take(self, holder: Any, name: str, part: str) -> None:
        """Take the time of a function, less that of functions within it, from now on."""
        setattr(holder, name, self.timed(getattr(holder, name), part))

    def timed(self, function: Callable, part: str) -> Callable:
        """Return a function whose time is taken."""
        @functools.wraps(function)
        def timed(*arguments: Any, **named: Any) -> Any:
            begin = time.perf_counter_ns()
            self._running.append([part, 0])
            try:
                return function(*arguments, **named)
            finally:
                took = time.perf_counter_ns() - begin
                self.total_ns[part] += took - self._running.pop()[1]
                around = self._running[-1]
                around[1] += took
                self.timed_within[around[0]] += 1
                if part in ('model', 'compensator'):
                    self.ticks += 1
                    if self.ticks == WARM_UP_TICKS:
                        self.total_ns.clear()
                        self.timed_within.clear()

        return timed

    def per_tick_us(self) -> dict[str, float]:
        """Return the time of each part a tick, us."""
        added_ns = _added_ns()
        ticks = self.ticks - WARM_UP_TICKS
        return {part: (self.total_ns[part] - added_ns * self.timed_within[part]) * 1e-3 / ticks
                for part in PARTS}


def _added_ns() -> float:
    """Return what taking the time of a function adds to the one around it, ns."""
    times, calls = Times(), 10_000
    inner = times.timed(lambda: None, 'inner')
    times.timed(lambda: [inner() for _ in range(calls)], 'around')()
    return times.total_ns['around'] / calls


def main() -> int:
    """Run the node that is named first."""
    times = Times()
    setattr(spin, 'rclpy_implementation', _Spin)  # noqa: B010 (it is no part of the module)
    for part, functions in PARTS.items():
        for holder, name in functions:
            times.take(holder, name, part)
    node = {'actuator': actuator_node, 'controller': controller_node}[sys.argv.pop(1)]
    status = node.main()
    if times.ticks > 2 * WARM_UP_TICKS:
        print(json.dumps(times.per_tick_us()), flush=True)
    return status


if __name__ == '__main__':
    sys.exit(main())
