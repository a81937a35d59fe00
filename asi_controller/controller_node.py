"""The node `asi_controller`: closes the force loop, answering states with valve commands."""

import math
import sys
import time
from typing import Final

from rclpy.clock import Clock, ROSClock
from rclpy.clock_type import ClockType
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.subscription import Subscription
from rclpy.time_source import TimeSource
from std_srvs.srv import SetBool

from asi_common.loop_parameters import control_rate
from asi_common.node import messages as wire
from asi_common.node.compilation import tell_of_compilation
from asi_common.node.diagnostics import (
    ERROR,
    OK,
    SILENT_S,
    WARN,
    Diagnostics,
    LoopLog,
    LoopStatistics,
)
from asi_common.node.discovery import AwaitedRecorder
from asi_common.node.executor import RunError, Unhurried, run_node
from asi_common.node.ros_parameters import RosParameters
from asi_common.node.topics import SteadyClock, create_publisher, create_subscription
from asi_common.topics import PISTON
from asi_controller.controller import Controller
from asi_controller.parameters import (
    COMPENSATOR_PARAMETERS,
    CONTROLLER_NODE_PARAMETERS,
    REFERENCE_PARAMETERS,
    VELOCITY_NEEDED,
)

# An old state is ignored, unless it is repeated so often in a row: then the actuator has begun a
# new run, and repeats its state until that is answered.
BEGIN_ANEW_AFTER: Final = 3
# A state that is not one period after the last is ignored; if for so long (s) no other comes, it
# is an error.
WRONG_FOR_S: Final = 1.0
# A stamp that differs so much from the wall clock is of another clock.
OTHER_CLOCK_NS: Final = 3600 * 10**9
# Stamps below this are simulated time: wall clocks passed it in 2001.
SIMULATED_NS: Final = 10**18
# Real time: delay from a state to its answer, s (at most a quarter of a period), and the share of
# the deviation from it by which a tick corrects the next period.
AFTER_STATE_S: Final = 0.0002
IN_STEP: Final = 0.05
# Looked up once.
ROS_TIME, TimePoint = ClockType.ROS_TIME, rclpy_implementation.rcl_time_point_t
# Period of the checks for an awaited recorder and of the age of the reference, s.
WATCH_PERIOD_S: Final = 0.02


class ControllerNode(Node):
    """Wires the controller to its topics, services and parameters; a loop decides when."""

    def __init__(self) -> None:
        super().__init__('asi_controller', automatically_declare_parameters_from_overrides=True)
        self.parameters = RosParameters(
            self, CONTROLLER_NODE_PARAMETERS + COMPENSATOR_PARAMETERS + REFERENCE_PARAMETERS,
            lambda values: Controller.check(values, control_rate(values)))
        values = self.parameters.values
        self.rate_hz = control_rate(values)
        lockstep = values['mode'] == 'lockstep'
        self.controller = Controller(values, self.rate_hz, lockstep)
        self.parameters.when_changed(self._change)
        self.statistics = LoopStatistics(math.inf if lockstep else 1.0 / self.rate_hz)
        self.ignored = 0
        self.recorder = AwaitedRecorder(self, bool(values['await_recorder']))
        self.recorded = not values['await_recorder']

        self.command = b''
        # The stamp of the newest state that was answered, also when the newest reference came.
        self.answered_ns = 0
        self.referenced_ns: int | None = None
        self.commands = create_publisher(self, 'valve_command')
        self.references = create_publisher(self, 'force_reference')
        self.loop: LockStep | RealTime = LockStep(self) if lockstep else RealTime(self)
        create_subscription(self, 'joint_states', self._on_state)
        self.wanted: Subscription | None = None
        self._listen()
        self.create_service(SetBool, '~/enable', self._enable)
        self.create_timer(WATCH_PERIOD_S, self._watch_reference, Unhurried(),
                          Clock(clock_type=ClockType.STEADY_TIME))
        self.loop_log = LoopLog(self)
        Diagnostics(self, self._describe)
        self.get_logger().info(
            f'{values["compensator"]}, {values["mode"]} at {self.rate_hz:g} Hz')

    def answer(self, stamp_ns: int, force_n: float, velocity_m_s: float) -> None:
        """Publish the answer to the state of a stamp."""
        reference_n, command_n, saturated = self.controller.answer(
            stamp_ns, force_n, velocity_m_s)
        self.answered_ns = stamp_ns
        self.statistics.tick(time.monotonic_ns(), saturated)
        self.command, reference = wire.answer(stamp_ns, command_n, reference_n)
        # First what the actuator waits for.
        self.commands.publish(self.command)
        if self.controller.generates:
            self.references.publish(reference)

    def ready(self) -> bool:
        """Return whether a recorder is there, or none is awaited."""
        if not self.recorded:
            self.recorded = not self.recorder.missing([self.commands, self.references])
        return self.recorded

    def _on_state(self, message: bytes) -> None:
        stamp_ns, force_n, velocity_m_s = wire.piston(message)
        if math.isfinite(force_n) and (math.isfinite(velocity_m_s) or not any(
                self.parameters.values[name] for name in VELOCITY_NEEDED)):
            self.loop.on_state(stamp_ns, force_n, velocity_m_s)
        else:
            self.ignored += 1
            self.get_logger().error(
                f'joint_states without a finite effort of the joint {PISTON}, or a velocity if '
                f'{" or ".join(VELOCITY_NEEDED)} needs it: ignored',
                throttle_duration_sec=1.0)

    def _on_reference(self, message: bytes) -> None:
        _, force_n = wire.force(message)
        if math.isfinite(force_n):
            self.controller.topic_n = force_n
            self.referenced_ns = self.answered_ns
        else:
            self.ignored += 1
            self.get_logger().error(f'force_reference: {force_n} N is not a force: ignored',
                                    throttle_duration_sec=1.0)

    def _watch_reference(self) -> None:
        """Set the desired force to 0 if its publisher is silent."""
        timeout_s = float(self.parameters.values['reference_timeout'])
        if self.referenced_ns is None or not self.answered_ns or not timeout_s:
            return
        # The age of one from before the first state, or from an earlier run, counts from then.
        self.referenced_ns = min(self.referenced_ns or self.answered_ns, self.answered_ns)
        if (self.answered_ns - self.referenced_ns) * 1e-9 > timeout_s:
            self.get_logger().warning(
                f'no force_reference for {timeout_s:g} s (reference_timeout): the desired force '
                f'is 0 N, it was {self.controller.topic_n:g} N')
            self.controller.topic_n = 0.0
            self.referenced_ns = None

    def _change(self, changed: set[str]) -> None:
        self.controller.change(self.parameters.values, changed)
        self._listen()

    def _listen(self) -> None:
        """Subscribe to force_reference unless the controller publishes it itself."""
        if self.controller.generates and self.wanted is not None:
            self.destroy_subscription(self.wanted)
            self.wanted = None
        elif not self.controller.generates and self.wanted is None:
            self.controller.topic_n = 0.0
            self.referenced_ns = None
            self.wanted = create_subscription(self, 'force_reference', self._on_reference)

    def _enable(self, request: SetBool.Request, answer: SetBool.Response) -> SetBool.Response:
        self.controller.enable(request.data, self.parameters.values)
        answer.success = True
        answer.message = 'enabled' if request.data else 'disabled: the valve command is 0'
        self.get_logger().info(answer.message)
        return answer

    def _describe(self) -> tuple[bytes, str, dict[str, object]]:
        values = self.parameters.values
        level, text = self.loop.health()
        self.loop_log.tell(level, text)
        if level == OK and self.wanted is not None and self.referenced_ns is None:
            text += ', without a force_reference: the desired force is 0 N'
        if level == OK and not self.controller.enabled:
            level, text = WARN, 'disabled: the valve command is 0'
        if problems := self.statistics.problems():
            level, text = max(level, WARN), f'{text}, but {"; ".join(problems)}'
        return level, text, {
            'mode': values['mode'], 'rate (Hz)': self.rate_hz,
            'compensator': values['compensator'], **self.statistics.values(),
            'states ignored': self.ignored, **self.loop.counts()}


class LockStep:
    """
    Answers each state once the clock has reached it (doc/explanation/lock_step.md).

    State and clock may arrive in either order, so both check whether an answer is due: the state
    when it arrives, the clock by the timer.
    """

    def __init__(self, node: ControllerNode):
        self.node = node
        self.pending: tuple[int, float, float] | None = None
        self.last_ns: int | None = None
        self.answered_ns: int | None = None
        self.straggler_ns: int | None = None
        self.repeats = 0
        self.wrong_since: float | None = None
        self.resent = 0
        self.period_ns = 1e9 / node.rate_hz
        # ROS time as with use_sim_time, but /clock is received raw, and given to rcl as a number:
        # rclpy's own subscription takes ten times as long (bench/loop_rate.py).
        clock, self.clock_ns = ROSClock(), 0
        source = TimeSource()
        source.ros_time_is_active = True
        source.attach_clock(clock)
        self._set_time = clock.handle.set_ros_time_override
        create_subscription(node, 'clock', self._on_clock)
        node.create_timer(1.0 / node.rate_hz, self._answer_if_due, clock=clock)
        if not node.recorded:
            node.create_timer(WATCH_PERIOD_S, self._answer_if_due,
                              clock=Clock(clock_type=ClockType.STEADY_TIME))

    def on_state(self, stamp_ns: int, force_n: float, velocity_m_s: float) -> None:
        """Take a state."""
        if stamp_ns == self.answered_ns:
            # A repeated state: the answer was lost. It is sent again, not computed again.
            self.resent += 1
            self.node.commands.publish(self.node.command)
            return
        last_ns = self.last_ns
        # Stamps are whole nanoseconds.
        if (last_ns is not None and abs(stamp_ns - last_ns - self.period_ns) > 1.5
                and stamp_ns != last_ns):
            if stamp_ns > last_ns:
                self._ignore(stamp_ns - last_ns)
                return
            if not self._begins_anew(stamp_ns):
                return
        self.last_ns = stamp_ns
        self.straggler_ns = self.wrong_since = None
        self.pending = stamp_ns, force_n, velocity_m_s
        if stamp_ns <= self.clock_ns:
            self._answer_if_due()

    def _on_clock(self, message: bytes) -> None:
        self.clock_ns = clock_ns = wire.time(message)
        self._set_time(TimePoint(clock_ns, ROS_TIME))

    def health(self) -> tuple[bytes, str]:
        """Return diagnostic level and message."""
        silence_s = self.node.statistics.silence_s()
        # First: the actuator may have ended between a state and its clock.
        if self.answered_ns is not None and silence_s > SILENT_S:
            return WARN, f'no new state for {silence_s:.1f} s: the actuator is paused or has ended'
        if self.pending is not None:
            return WARN, ('no /clock for the newest state: is the actuator in lock-step?'
                          if self.node.recorded else 'waiting for a recorder')
        if self.answered_ns is None:
            return WARN, 'waiting for the actuator'
        return OK, 'running'

    def counts(self) -> dict[str, object]:
        """Return what was counted, by name."""
        return {'resent': self.resent}

    def _begins_anew(self, stamp_ns: int) -> bool:
        """Return whether an old state is the first of a new run; if so, discard the last run."""
        self.repeats = self.repeats + 1 if stamp_ns == self.straggler_ns else 1
        self.straggler_ns = stamp_ns
        self.node.ignored += 1
        if self.repeats < BEGIN_ANEW_AFTER:
            return False
        self.node.get_logger().info('the actuator has begun a new run')
        self.node.controller.begin(self.node.parameters.values)
        self.last_ns = self.answered_ns = self.pending = None
        return True

    def _ignore(self, apart_ns: int) -> None:
        """Count a state not a period after the last. Raises RunError if these go on."""
        now = time.monotonic()
        self.wrong_since = self.wrong_since or now
        self.node.ignored += 1
        problem = (f'states are {apart_ns * 1e-9:.9g} s apart, but rate_hz = '
                   f'{self.node.rate_hz:g} asks for {1.0 / self.node.rate_hz:.9g} s: has the '
                   'actuator another mode or rate_hz, or does a second controller answer?')
        if now - self.wrong_since > WRONG_FOR_S:
            raise RunError(problem)
        self.node.get_logger().warning(f'{problem} Ignored', throttle_duration_sec=1.0)

    def _answer_if_due(self) -> None:
        if self.pending is None:
            return
        stamp_ns, force_n, velocity_m_s = self.pending
        if stamp_ns <= self.clock_ns and self.node.ready():
            self.pending = None
            self.answered_ns = stamp_ns
            self.node.answer(stamp_ns, force_n, velocity_m_s)


class RealTime:
    """
    Answers the latest state at each tick of a wall timer.

    The timer is synchronised with the states, so that the latency is constant: a tick comes
    AFTER_STATE_S after a state, so late that jitter does not exchange them.
    """

    def __init__(self, node: ControllerNode):
        self.node = node
        self.clock = SteadyClock()
        self.latest: tuple[int, float, float] | None = None
        self.received_at = 0.0
        self.period_s = 1.0 / node.rate_hz
        self.timer = node.create_timer(self.period_s, self._tick,
                                       clock=Clock(clock_type=ClockType.STEADY_TIME))

    def on_state(self, stamp_ns: int, force_n: float, velocity_m_s: float) -> None:
        latency_ns = self.clock.now_ns() - stamp_ns
        if abs(latency_ns) > OTHER_CLOCK_NS and not self._is_of_this_loop(stamp_ns):
            self.node.ignored += 1
            return
        if self.latest is not None and not self._stale():
            periods = (stamp_ns - self.latest[0]) * 1e-9 * self.node.rate_hz
            self.node.statistics.lose(round(periods) - 1)
        self.latest = stamp_ns, force_n, velocity_m_s
        self.received_at = time.monotonic()
        self.node.statistics.latency(latency_ns)

    def _is_of_this_loop(self, stamp_ns: int) -> bool:
        """
        Return whether a state whose stamp is far from this node's clock belongs to its loop.

        It does if the system clock was set between the starts of the two nodes. Raises RunError if
        the loop has not begun and the stamp is of a simulation.
        """
        if abs(time.time_ns() - stamp_ns) < OTHER_CLOCK_NS:
            return True
        if self.latest is not None and not self._stale():
            return abs(stamp_ns - self.latest[0]) < OTHER_CLOCK_NS
        if stamp_ns < SIMULATED_NS and self.latest is None:
            raise RunError(f'a state of {stamp_ns * 1e-9:.6f} s is not of the wall clock: the '
                           'mode of the actuator is lockstep, that of this controller realtime')
        return stamp_ns >= SIMULATED_NS

    def health(self) -> tuple[bytes, str]:
        if self.latest is None:
            return WARN, 'waiting for the actuator'
        if self._stale():
            return ERROR, 'no new state: no command is given'
        return OK, 'running'

    def counts(self) -> dict[str, object]:
        return {}

    def _stale(self) -> bool:
        silence = time.monotonic() - self.received_at
        return silence > float(self.node.parameters.values['state_timeout'])

    def _tick(self) -> None:
        if self.latest is None or self._stale() or not self.node.ready():
            return
        self.node.answer(*self.latest)
        self.timer.timer_period_ns = round(1e9 * (self.period_s - IN_STEP * self._late_s()))

    def _late_s(self) -> float:
        """Return the delay (s) of the ticks beyond the nominal one, at most half a period."""
        half_s = 0.5 * self.period_s
        late_s = time.monotonic() - self.received_at - min(AFTER_STATE_S, 0.5 * half_s)
        return (late_s + half_s) % self.period_s - half_s


def main() -> int:
    """Run the node; return the exit status."""
    tell_of_compilation('asi_controller')
    return run_node(ControllerNode)


if __name__ == '__main__':
    sys.exit(main())
