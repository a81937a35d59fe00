"""
Parts of the time of a tick: `python -m bench.timed_node actuator|controller --ros-args ...`.

For the overhead of a callback that does nothing: `... empty actuator|controller ...`
(`bench/empty_nodes.py`).

Runs the node with timers around the main functions, and prints their time in a tick (us) as JSON.
A timer adds to the time of the enclosing function, and more with the cold caches of the loop than
in a test of the timer alone. So each function has two nested timers: their difference is the
overhead of one, which is subtracted from the time of the enclosing function.
"""

import json
import signal
import sys
from collections import defaultdict
from collections.abc import Callable
from time import perf_counter_ns
from typing import Any, Final

from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.publisher import Publisher

from asi_actuator import actuator_node, safety
from asi_actuator.driver.simulated import SimulatedActuator
from asi_common.node import executor as spin
from asi_common.node import messages as wire
from asi_common.node.diagnostics import LoopStatistics
from asi_controller import controller_node
from asi_controller.controller import Controller
from bench import empty_nodes

WARM_UP_TICKS: Final = 2000
CALLBACKS, SENDING, WAITING, EXECUTOR = 'callbacks', 'sending', 'waiting', 'executor'
# Parts of the callbacks that are timed; the rest of a callback only calls these.
PARTS: Final[dict[str, tuple[tuple[Any, str], ...]]] = {
    'packing': tuple((wire, name) for name in (
        'state', 'answer', 'time', 'force', 'piston')),
    'model': ((SimulatedActuator, 'exchange'),),
    'compensator': ((Controller, 'answer'),),
    'safety': ((safety.Safety, 'command'), (safety.Safety, 'watch_state')),
    'statistics': ((LoopStatistics, 'tick'),),
}


class WaitSet(rclpy_implementation.WaitSet):  # type: ignore[misc, name-defined]
    """Waits in Python, so that the time can be taken."""

    def wait(self, timeout_ns: int) -> None:
        super().wait(timeout_ns)


class _Spin:
    """What `spin` uses of rclpy's implementation."""

    WaitSet = WaitSet


class Times:
    """How long functions took, ns: from just outside, and from outside that."""

    def __init__(self) -> None:
        self.inner_ns: defaultdict[str, int] = defaultdict(int)
        self.outer_ns: defaultdict[str, int] = defaultdict(int)
        self.ticks = self.begin_ns = 0

    def take(self, part: str, holder: Any, name: str) -> None:
        """Take the time of a function from now on, as a part."""
        inner = _timed(getattr(holder, name), self.inner_ns, part)
        setattr(holder, name, _timed(inner, self.outer_ns, part))

    def take_callbacks(self, name: str, place: int) -> None:
        """Take the time of each callback that a method of a node is given at a place."""
        create = getattr(Node, name)

        def creating(*given: Any, **named: Any) -> Any:
            callback = _timed(given[place], self.inner_ns, CALLBACKS)
            return create(*given[:place], callback, *given[place + 1:], **named)

        setattr(Node, name, creating)

    def count_ticks(self, holder: Any, name: str) -> None:
        """Count the calls of a function, and begin anew after WARM_UP_TICKS of them."""
        tick = getattr(holder, name)

        def counted(*arguments: Any) -> None:
            self.ticks += 1
            if self.ticks == WARM_UP_TICKS:
                self.inner_ns.clear()
                self.outer_ns.clear()
                self.begin_ns = perf_counter_ns()
            tick(*arguments)

        setattr(holder, name, counted)

    def per_tick_us(self) -> dict[str, float]:
        """Return the time of each part a tick, us; that of a callback without what is in it."""
        spent_ns: dict[str, float] = dict(self.inner_ns)
        spent_ns[EXECUTOR] = perf_counter_ns() - self.begin_ns - spent_ns[CALLBACKS]
        for part, outer_ns in self.outer_ns.items():
            around = EXECUTOR if part == WAITING else CALLBACKS
            spent_ns[around] -= outer_ns + (outer_ns - self.inner_ns[part])
        ticks = self.ticks - WARM_UP_TICKS
        return {part: ns * 1e-3 / ticks for part, ns in spent_ns.items()}


def _timed(function: Callable, spent_ns: defaultdict[str, int], part: str) -> Callable:
    """Return a function whose time is added to that of a part."""
    def timed(*arguments: Any) -> Any:
        begin = perf_counter_ns()
        result = function(*arguments)
        spent_ns[part] += perf_counter_ns() - begin
        return result

    return timed


def main() -> int:
    """Run the node that is named first."""
    setattr(spin, 'rclpy_implementation', _Spin)  # noqa: B010 (it is no part of the module)
    node: Any = {'actuator': actuator_node, 'controller': controller_node,
                 'empty': empty_nodes}[sys.argv.pop(1)]
    times = Times()
    for part, functions in (PARTS if '--parts' in sys.argv else {}).items():
        for holder, name in functions:
            times.take(part, holder, name)
    times.take(SENDING, Publisher, 'publish')
    times.take(WAITING, WaitSet, 'wait')
    times.take_callbacks('create_subscription', 3)
    times.take_callbacks('create_timer', 2)
    times.count_ticks(LoopStatistics, 'tick')
    times.count_ticks(empty_nodes.Empty, 'send')
    # Only for the empty nodes: ours have their own handler.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())
    try:
        return node.main() or 0
    finally:
        if times.ticks > 2 * WARM_UP_TICKS:
            print(json.dumps(times.per_tick_us()), flush=True)


if __name__ == '__main__':
    sys.exit(main())
