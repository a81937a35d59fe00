"""
Where the time of a tick goes: `python -m bench.timed_node actuator|controller --ros-args ...`.

Or, for what Python takes to call a callback that does nothing, `... empty actuator|controller ...`
(`bench/empty_nodes.py`).

Runs the node as it is, but takes the time of the functions that matter, each without those within
it, and prints at the end how long they took a tick (us), as JSON. What taking the time of a
function adds to the one around it is known from a function that does nothing, and taken off; in
the loop, where little is in the processor's caches, it is more. So the callbacks as a whole are
timed with nothing timed within but what belongs to rclpy, and only `--parts` takes them apart.
"""

import json
import signal
import sys
from collections import Counter
from collections.abc import Callable
from time import perf_counter_ns
from typing import Any, Final

from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.publisher import Publisher

from asi_actuator import actuator_node, safety, spin, wire
from asi_actuator.diagnostics import Diagnostics, LoopStatistics
from asi_actuator.driver.simulated import SimulatedActuator
from asi_controller import controller_node
from asi_controller.controller import Controller
from bench import empty_nodes

WARM_UP_TICKS: Final = 2000
Functions = tuple[tuple[Any, str], ...]


class WaitSet(rclpy_implementation.WaitSet):  # type: ignore[misc, name-defined]
    """Waits in Python, so that the time can be taken."""

    def wait(self, timeout_ns: int) -> None:
        super().wait(timeout_ns)


class _Spin:
    """What `spin` uses of rclpy's implementation."""

    WaitSet = WaitSet


CALLBACKS: Final = 'callbacks'
RCLPY: Final[dict[str, Functions]] = {
    'waiting': ((WaitSet, 'wait'),),
    'sending': ((Publisher, 'publish'),),
    'executor': ((spin.LoopExecutor, '_spin_loop'), (SingleThreadedExecutor, 'spin_once')),
}
OWN: Final[Functions] = (
    (actuator_node.ActuatorNode, '_on_command'), (actuator_node.LockStep, '_watch'),
    (controller_node.ControllerNode, '_on_state'), (controller_node.LockStep, '_on_clock'),
    (controller_node.LockStep, '_answer_if_due'), (Diagnostics, 'publish'),
    (empty_nodes.Actuator, '_answered'), (empty_nodes.Controller, '_take'))
# Of the callbacks; what is left of them is wiring.
PARTS: Final[dict[str, Functions]] = {
    'packing': tuple((wire, name) for name in (
        'state', 'answer', 'time', 'force', 'piston_effort')),
    'model': ((SimulatedActuator, 'exchange'),),
    'compensator': ((Controller, 'answer'),),
    'safety': ((safety.Safety, 'command'), (safety.Safety, 'watch_state'),
               (safety.Safety, 'watch_link')),
    'statistics': ((LoopStatistics, 'tick'),),
}


class Times:
    """The times of the parts, ns."""

    def __init__(self, parts: dict[str, Functions]):
        """Take the time of functions, less that of functions within them, from now on."""
        self.total_ns: Counter[str] = Counter()
        self.timed_within: Counter[str] = Counter()     # calls within a part that were timed too
        self.ticks = 0
        # Of the functions that are running: the time of those within, ns, and their number.
        self._running = [[0, 0]]
        for part, functions in parts.items():
            for holder, name in functions:
                setattr(holder, name, self.timed(getattr(holder, name), part))

    def timed(self, function: Callable, part: str) -> Callable:
        """Return a function whose time is taken."""
        running, total_ns, timed_within = self._running, self.total_ns, self.timed_within

        def timed(*arguments: Any, **named: Any) -> Any:
            within = [0, 0]
            running.append(within)
            begin = perf_counter_ns()
            try:
                return function(*arguments, **named)
            finally:
                took = perf_counter_ns() - begin
                running.pop()
                total_ns[part] += took - within[0]
                timed_within[part] += within[1]
                around = running[-1]
                around[0] += took
                around[1] += 1

        return timed

    def count_ticks(self, holder: Any, name: str) -> None:
        """Count the calls of a function, and begin anew after WARM_UP_TICKS of them."""
        tick = getattr(holder, name)

        def counted(*arguments: Any) -> None:
            self.ticks += 1
            if self.ticks == WARM_UP_TICKS:
                self.total_ns.clear()
                self.timed_within.clear()
            tick(*arguments)

        setattr(holder, name, counted)

    def per_tick_us(self) -> dict[str, float]:
        """Return the time of each part a tick, us."""
        added_ns = _added_ns()
        ticks = self.ticks - WARM_UP_TICKS
        return {part: (total_ns - added_ns * self.timed_within[part]) * 1e-3 / ticks
                for part, total_ns in self.total_ns.items()}


def _added_ns() -> float:
    """Return what taking the time of a function adds to the one around it, ns."""
    times, calls = Times({}), 10_000
    inner = times.timed(lambda: None, 'inner')
    times.timed(lambda: [inner() for _ in range(calls)], 'around')()
    return times.total_ns['around'] / calls


def main() -> int:
    """Run the node that is named first."""
    setattr(spin, 'rclpy_implementation', _Spin)  # noqa: B010 (it is no part of the module)
    node: Any = {'actuator': actuator_node, 'controller': controller_node,
                 'empty': empty_nodes}[sys.argv.pop(1)]
    times = Times(RCLPY | {CALLBACKS: OWN} | (PARTS if '--parts' in sys.argv else {}))
    times.count_ticks(LoopStatistics, 'tick')
    times.count_ticks(empty_nodes.Empty, 'send')
    # Our own nodes end by it in their way.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())
    try:
        return node.main() or 0
    finally:
        if times.ticks > 2 * WARM_UP_TICKS:
            print(json.dumps(times.per_tick_us()), flush=True)


if __name__ == '__main__':
    sys.exit(main())
