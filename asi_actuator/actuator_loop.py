"""Time base of the actuator node: lock-step or real time, which have the same methods."""

import time
from typing import TYPE_CHECKING, Final

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.timer import Timer

from asi_common.node.diagnostics import OK, SILENT_S, WARN
from asi_common.node.executor import RunError, Unhurried
from asi_common.node.topics import SteadyClock, create_publisher

if TYPE_CHECKING:
    from asi_actuator.actuator_node import ActuatorNode

# Period of the checks of lock-step for a missing answer, s.
WATCH_PERIOD_S: Final = 0.005
# Most periods that are caught up at once, in real time and in lock-step with a real_time_factor;
# the others are lost.
MOST_CATCH_UP: Final = 10


class LockStep:
    """The actuator owns time (doc/explanation/lock_step.md)."""

    def __init__(self, node: 'ActuatorNode'):
        self.node = node
        self.tick = 0
        self.stamp_ns = 0
        # The bytes of the newest state, and of its stamp.
        self.state = self.clock = b''
        # The command that answers the newest state, while the node is paused or ahead of time.
        self.command_n: float | None = None
        # With a real_time_factor: the time at which the newest state was due, the period of the
        # states, and the timer for the next one.
        self.due_ns = 0
        self.step_ns = 0.0
        self.pace: Timer | None = None
        # Stamp (ns) of the newest answered state, and the command (N) that answered it.
        self.answered = (0, 0.0)
        self.resent = 0
        self.silent_since_ns = self.sent_ns = time.monotonic_ns()
        self.clocks = create_publisher(node, 'clock')
        node.topics.append(self.clocks)
        self.steady = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(WATCH_PERIOD_S, self._watch, Unhurried(), self.steady)
        self.on_parameters()

    def on_command(self, stamp_ns: int, command_n: float) -> None:
        """Take a valve command that answers the state of `stamp_ns`."""
        node = self.node
        if stamp_ns != self.stamp_ns or self.command_n is not None:
            node.ignored += 1
            # The answer to a state that was sent again is repeated unchanged.
            if (stamp_ns, command_n) != self.answered and stamp_ns == self.answered[0]:
                node.safety.trip(
                    f'valve_command = {self.answered[1]:g} N and {command_n:g} N answer the same '
                    'state: do two controllers run?')
            return
        self.answered = stamp_ns, command_n
        node.statistics.latency(time.monotonic_ns() - self.silent_since_ns)
        if node.paused or (self.pace and self._is_early()):
            self.command_n = command_n
        else:
            self._advance(command_n, 1)

    def on_pause(self) -> None:
        """Follow node.paused, which has changed."""
        self.silent_since_ns = self.sent_ns = time.monotonic_ns()
        self._advance_if_due()

    def on_reset(self) -> None:
        """Discard commands from before the reset; here there are none."""

    def on_parameters(self) -> None:
        """Follow the node's parameters, which have changed."""
        factor = float(self.node.parameters.values['real_time_factor'])
        self.step_ns = 1e9 * self.node.period_s / factor if factor else 0.0
        self.due_ns = time.monotonic_ns()
        # Only with a pace: each timer costs time in each tick.
        if factor and self.pace is None:
            self.pace = self.node.create_timer(self.node.period_s, self._advance_if_due,
                                               clock=self.steady)
        elif not factor and self.pace is not None:
            self.node.destroy_timer(self.pace)
            self.pace = None
            self._advance_if_due()

    def _is_early(self) -> bool:
        """Return whether the next state is not due yet; if so, have the timer wait for it."""
        if self.pace is None:
            return False
        now_ns = time.monotonic_ns()
        left_ns = round(self.due_ns + self.step_ns) - now_ns
        if left_ns <= 0:
            self.due_ns = max(self.due_ns, now_ns - round(MOST_CATCH_UP * self.step_ns))
            return False
        self.pace.timer_period_ns = left_ns
        self.pace.reset()
        return True

    def _advance_if_due(self) -> None:
        """Advance by the waiting command, if there is one and the next state is due."""
        if self.pace is not None:
            self.pace.cancel()
        if self.command_n is not None and not self.node.paused and not self._is_early():
            command_n, self.command_n = self.command_n, None
            self._advance(command_n, 1)

    def next_stamp_ns(self) -> int:
        """Return the stamp of the state that comes next, or, in real time, now."""
        return round((self.tick + 1) * 1e9 / self.node.rate_hz)

    def health(self) -> tuple[bytes, str]:
        """Return diagnostic level and message."""
        if self.tick == 0:
            return WARN, 'waiting for ' + ', '.join(self._missing())
        silence = self._silence(time.monotonic_ns())
        resend_after_s = float(self.node.parameters.values['resend_after'])
        if self.command_n is None and silence > resend_after_s:
            return WARN, f'no answer to state {self.tick} for {silence:.1f} s'
        return OK, 'running'

    def counts(self) -> dict[str, object]:
        """Return what was counted, by name."""
        return {'resent': self.resent}

    def _silence(self, now_ns: int) -> float:
        """Return the time (s) since the last answer."""
        return (now_ns - self.silent_since_ns) * 1e-9

    def _advance(self, command_n: float, periods: int) -> None:
        """Apply a command (N) for so many control periods (first 0), and publish the state."""
        node = self.node
        if self.tick == node.last_tick:
            node.finish()
        node.exchange(command_n, periods)
        self.stamp_ns = stamp_ns = self.next_stamp_ns()
        if self.tick == 0:
            node.tell_state(stamp_ns)
        self.tick += 1
        if self.pace:
            self.due_ns += round(self.step_ns)
        self.silent_since_ns = self.sent_ns = now_ns = time.monotonic_ns()
        self.state, self.clock, force, valve, velocity = node.sense(stamp_ns, now_ns)
        self._publish()
        # Last, since the controller does not need these: it computes in the meantime.
        node.publish_rest(force, valve, velocity)

    def _missing(self) -> list[str]:
        controller = (self.node.commands.get_publisher_count()
                      and self.node.states.get_subscription_count()
                      and self.clocks.get_subscription_count())
        return ([] if controller else ['a controller in lock-step']) + self.node.missing()

    def _publish(self) -> None:
        self.node.states.publish(self.state)
        self.clocks.publish(self.clock)

    def _watch(self) -> None:
        """Publish the first state once no node is missing; later, repeat an unanswered one."""
        if self.node.paused or self.command_n is not None:
            return
        if self.tick == 0:
            if missing := self._missing():
                self.node.get_logger().info('waiting for ' + ', '.join(missing),
                                            throttle_duration_sec=5.0)
            else:
                self.due_ns = time.monotonic_ns()
                self._advance(0.0, 0)
            return
        values, now_ns = self.node.parameters.values, time.monotonic_ns()
        silence = self._silence(now_ns)
        give_up_after_s = float(values['give_up_after'])
        if self.answered[0] and 0.0 < give_up_after_s < silence:
            raise RunError(f'no valve_command answers state {self.tick} '
                           f'({self.stamp_ns * 1e-9:.6f} s) for {silence:.1f} s: '
                           'has the controller ended?')
        if (now_ns - self.sent_ns) * 1e-9 > float(values['resend_after']):
            self.sent_ns = now_ns
            self.resent += 1
            self._publish()


class RealTime:
    """The wall clock owns time: the actuator follows it."""

    def __init__(self, node: 'ActuatorNode'):
        self.node = node
        self.command_n = 0.0
        self.commanded_at: float | None = None
        self.clock = SteadyClock()
        # In the current second.
        self.commands = self.periods = 0
        self.start: float | None = None
        self.done = 0
        self.overruns = 0
        self.timer = node.create_timer(node.period_s, self._tick,
                                       clock=Clock(clock_type=ClockType.STEADY_TIME))

    def on_command(self, stamp_ns: int, command_n: float) -> None:
        latency_ns = self.clock.now_ns() - stamp_ns
        if abs(latency_ns) * 1e-9 > float(self.node.parameters.values['command_timeout']):
            self.node.ignored += 1
            return
        self.node.statistics.latency(latency_ns)
        self.commands += 1
        self.command_n = command_n
        self.commanded_at = time.monotonic()

    def on_pause(self) -> None:
        self.start = None
        if self.commanded_at is not None:
            self.commanded_at = time.monotonic()

    def on_reset(self) -> None:
        self.command_n = 0.0
        self.commanded_at = None
        self.commands = self.periods = 0

    def on_parameters(self) -> None:
        pass

    def next_stamp_ns(self) -> int:
        return self.clock.now_ns()

    def health(self) -> tuple[bytes, str]:
        if self.node.measured is None:
            problem = self.node.health.problem
            return WARN, 'waiting for ' + ', '.join(self.node.missing() or [
                'a state of the actuator' + (f'; {problem}' if problem else '')])
        if self.commanded_at is None:
            return WARN, 'no valve_command yet, the valve command is 0' + (
                f' ({self.node.ignored} were stamped too far from now)' if self.node.ignored
                else '')
        silence_s = time.monotonic() - self.commanded_at
        if silence_s > SILENT_S:
            return WARN, f'no valve_command for {silence_s:.1f} s: has the controller ended?'
        return OK, 'running'

    def counts(self) -> dict[str, object]:
        return {'overruns': self.overruns}

    def _tick(self) -> None:
        node = self.node
        if node.paused or (node.statistics.ticks == 0 and node.missing()):
            return
        now = time.monotonic()
        if self.start is None:
            self.start, self.done = now, 0
        if self.commanded_at is not None:
            node.safety.watch_command(now - self.commanded_at)
        # At least one: where jitter rounds a tick down and the next one up, nothing is lost.
        due = max(1, round((now - self.start) * node.rate_hz) - self.done)
        self.done += due
        self.periods += due
        if self.periods >= node.rate_hz:
            node.safety.watch_number_of_commands(self.commands, self.periods)
            self.commands = self.periods = 0
        # A timer that fires late has missed samples; the actuator catches up within bounds.
        self.overruns += due > 1
        node.statistics.lose(due - 1)
        if node.exchange(self.command_n, min(due, MOST_CATCH_UP)):
            stamp_ns = self.clock.now_ns()
            if not node.statistics.ticks:
                node.tell_state(stamp_ns)
            state, _, force, valve, velocity = node.sense(stamp_ns, time.monotonic_ns())
            node.states.publish(state)
            node.publish_rest(force, valve, velocity)
            if node.statistics.ticks == node.last_tick:
                node.finish()
        elif node.measured is None:
            node.get_logger().warning(self.health()[1], throttle_duration_sec=5.0)
