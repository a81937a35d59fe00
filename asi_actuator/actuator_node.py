"""The node `asi_actuator`: publishes the actuator's state, takes valve commands."""

import math
import sys
import time
from typing import Final, Protocol

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import WrenchStamped
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64
from std_srvs.srv import SetBool, Trigger

from asi_actuator.diagnostics import ERROR, OK, WARN, Diagnostics, LoopStatistics
from asi_actuator.discovery import not_recorded
from asi_actuator.node_parameters import ACTUATOR_NODE_PARAMETERS, control_rate
from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_actuator.ros_parameters import RosParameters
from asi_actuator.simulated import SimulatedActuator, physical
from asi_actuator.spin import RunError, RunFinished, run_node
from asi_actuator.topics import CONTROL_QOS, FRAME, JOINTS, STREAM_QOS, nanoseconds, set_time

# How often the lock-step looks whether it must send again, s.
WATCH_PERIOD_S: Final = 0.005
# Real time: at most so many periods are caught up at once; the rest is lost time.
MOST_CATCH_UP: Final = 10
# Calibration looks back so far (s), and calls a change of more than this (N) motion.
CALIBRATION_WINDOW_S: Final = 0.2
CALIBRATION_CHANGE_N: Final = 1.0


class ActuatorNode(Node):
    """Wires the actuator to its topics, services and parameters; a loop runs it."""

    def __init__(self) -> None:
        super().__init__('asi_actuator', automatically_declare_parameters_from_overrides=True)
        self.parameters = RosParameters(
            self, ACTUATOR_NODE_PARAMETERS + ACTUATOR_PARAMETERS, physical)
        values = self.parameters.values
        self.rate_hz = control_rate(values)
        self.period_s = 1.0 / self.rate_hz
        self.actuator = SimulatedActuator(values, self.period_s)
        self.parameters.when_changed(lambda _: self.actuator.configure(self.parameters.values))
        duration = float(values['duration'])
        self.last_tick = math.ceil(duration * self.rate_hz - 1e-9) if duration else None
        self.statistics = LoopStatistics()
        self.ignored = 0
        self.paused = False
        self.history_n = np.zeros((2, max(2, round(CALIBRATION_WINDOW_S * self.rate_hz))))

        self._create_messages()
        self.states = self.create_publisher(JointState, 'joint_states', STREAM_QOS)
        self.forces = self.create_publisher(WrenchStamped, 'force', STREAM_QOS)
        self.valve_positions = self.create_publisher(Float64, 'valve_position', STREAM_QOS)
        self.velocities = self.create_publisher(Float64, 'velocity', STREAM_QOS)
        self.topics = [self.states, self.forces, self.valve_positions, self.velocities]
        self.loop: Loop = (LockStep if values['mode'] == 'lockstep' else RealTime)(self)
        self.commands = self.create_subscription(
            WrenchStamped, 'valve_command', self._on_command, CONTROL_QOS)
        self.create_service(Trigger, '~/calibrate', self._calibrate)
        self.create_service(Trigger, '~/reset', self._reset)
        self.create_service(SetBool, '~/pause', self._pause)
        Diagnostics(self, self._describe)
        self.get_logger().info(f'{values["mode"]} at {self.rate_hz:g} Hz')

    def _create_messages(self) -> None:
        """Make each message once; a tick only changes the numbers."""
        self.stamp = Time()
        self.state = JointState(name=list(JOINTS), position=[0.0, 0.0], velocity=[0.0, 0.0],
                                effort=[0.0, 0.0])
        self.force = WrenchStamped()
        for message in (self.state, self.force):
            message.header.frame_id = FRAME
            message.header.stamp = self.stamp
        self.valve_position, self.velocity = Float64(), Float64()

    def missing(self) -> list[str]:
        """Return the recorders that the first state still waits for."""
        if not self.parameters.values['await_recorder']:
            return []
        return [f'a recorder of {name}' for name in not_recorded(self, self.topics)]

    def sense(self, stamp_ns: int) -> None:
        """Measure, and put what is measured into the messages."""
        force, valve, position, velocity = self.actuator.measure()
        set_time(self.stamp, stamp_ns)
        state = self.state
        state.velocity[1] = (valve - state.position[1]) * self.rate_hz
        state.position[0], state.position[1] = position, valve
        state.velocity[0] = velocity
        state.effort[0], state.effort[1] = force, self.actuator.applied_n
        self.force.wrench.force.x = force
        self.valve_position.data = valve
        self.velocity.data = velocity
        place = self.statistics.ticks % self.history_n.shape[1]
        self.history_n[0, place] = force
        self.history_n[1, place] = self.actuator.applied_n
        self.statistics.tick(self.actuator.saturated)

    def publish_rest(self) -> None:
        """Publish what is not `joint_states`."""
        self.forces.publish(self.force)
        self.valve_positions.publish(self.valve_position)
        self.velocities.publish(self.velocity)

    def _on_command(self, message: WrenchStamped) -> None:
        command = message.wrench.force.x
        if math.isfinite(command):
            self.loop.on_command(nanoseconds(message.header.stamp), command)
        else:
            self.ignored += 1
            self.get_logger().error(f'valve_command: {command} N is not a force: ignored',
                                    throttle_duration_sec=1.0)

    def _calibrate(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        """Zero the force sensor: the mean of the last readings becomes 0."""
        if self.statistics.ticks < self.history_n.shape[1]:
            answer.message = f'refused: fewer than {self.history_n.shape[1]} readings so far'
            return answer
        motion = _motion(np.roll(self.history_n,
                                 -(self.statistics.ticks % self.history_n.shape[1]), axis=1))
        if motion:
            answer.message = f'refused: {motion} within the last {CALIBRATION_WINDOW_S:g} s'
            return answer
        zero = float(self.history_n[0].mean())
        self.actuator.zero_n += zero
        self.history_n[0] -= zero
        answer.success = True
        answer.message = f'force sensor zeroed: {zero:+.3f} N taken off'
        self.get_logger().info(answer.message)
        return answer

    def _reset(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        self.actuator.reset()
        answer.success, answer.message = True, 'the actuator is at rest'
        self.get_logger().info(answer.message)
        return answer

    def _pause(self, request: SetBool.Request, answer: SetBool.Response) -> SetBool.Response:
        if request.data != self.paused:
            self.paused = request.data
            self.loop.on_pause()
        answer.success, answer.message = True, 'paused' if self.paused else 'running'
        self.get_logger().info(answer.message)
        return answer

    def _describe(self) -> tuple[bytes, str, dict[str, object]]:
        level, text = (WARN, 'paused') if self.paused else self.loop.health()
        return level, text, {
            'mode': self.parameters.values['mode'], 'rate (Hz)': self.rate_hz,
            **self.statistics.values(), 'commands ignored': self.ignored, **self.loop.counts()}


def _motion(history_n: np.ndarray) -> str | None:
    """Return what moves in a history of (force, command), oldest first; None if all is still."""
    force, command = history_n
    if np.ptp(command) > CALIBRATION_CHANGE_N:
        return f'the valve command moved by {np.ptp(command):.3g} N'
    middle = force.size // 2
    change = abs(force[middle:].mean() - force[:middle].mean())
    # Noise is not motion: the difference of two means of n/2 samples spreads by 2 std / sqrt(n).
    if change > CALIBRATION_CHANGE_N + 4.0 * 2.0 * force.std() / math.sqrt(force.size):
        return f'the force moved by {change:.3g} N'
    return None


class Loop(Protocol):
    """What runs the actuator: lock-step or real time."""

    def __init__(self, node: ActuatorNode): ...

    def on_command(self, stamp_ns: int, command_n: float) -> None:
        """Take a finite valve command that answers the state of `stamp_ns`."""

    def on_pause(self) -> None:
        """Follow node.paused, which has changed."""

    def health(self) -> tuple[bytes, str]:
        """Return diagnostic level and message."""

    def counts(self) -> dict[str, object]:
        """Return what was counted, by name."""


class LockStep:
    """The actuator owns time (doc/architecture.md, "Lock-step")."""

    def __init__(self, node: ActuatorNode):
        self.node = node
        self.tick = 0
        self.stamp_ns = 0
        self.command_n: float | None = None
        self.resent = 0
        self.begun = False
        self.silent_since = self.sent_at = time.monotonic()
        self.clock = ClockMessage(clock=node.stamp)
        self.clocks = node.create_publisher(ClockMessage, '/clock', STREAM_QOS)
        node.topics.append(self.clocks)
        node.create_timer(WATCH_PERIOD_S, self._watch,
                          clock=Clock(clock_type=ClockType.STEADY_TIME))

    def on_command(self, stamp_ns: int, command_n: float) -> None:
        if stamp_ns != self.stamp_ns or self.command_n is not None:
            self.node.ignored += 1
            return
        self.node.statistics.latency((time.monotonic() - self.silent_since) * 1e9)
        self.begun = True
        self.command_n = command_n
        if not self.node.paused:
            self._advance(command_n)

    def on_pause(self) -> None:
        self.silent_since = self.sent_at = time.monotonic()
        if not self.node.paused and self.command_n is not None:
            self._advance(self.command_n)

    def health(self) -> tuple[bytes, str]:
        if self.tick == 0:
            return WARN, 'waiting for ' + ', '.join(self._missing())
        silence = time.monotonic() - self.silent_since
        if silence > float(self.node.parameters.values['resend_after']):
            return WARN, f'no answer to state {self.tick} for {silence:.1f} s'
        return OK, 'running'

    def counts(self) -> dict[str, object]:
        return {'resent': self.resent}

    def _advance(self, command_n: float) -> None:
        if self.tick == self.node.last_tick:
            raise RunFinished
        self.node.actuator.advance(command_n)
        self._publish_next()

    def _missing(self) -> list[str]:
        controller = (self.node.commands.get_publisher_count()
                      and self.node.states.get_subscription_count()
                      and self.clocks.get_subscription_count())
        return ([] if controller else ['a controller']) + self.node.missing()

    def _publish_next(self) -> None:
        self.tick += 1
        self.command_n = None
        self.stamp_ns = round(self.tick * 1e9 / self.node.rate_hz)
        self.node.sense(self.stamp_ns)
        self.silent_since = self.sent_at = time.monotonic()
        self._publish()
        # After what the controller waits for: it computes meanwhile.
        self.node.publish_rest()

    def _publish(self) -> None:
        self.node.states.publish(self.node.state)
        self.clocks.publish(self.clock)

    def _watch(self) -> None:
        """Publish the first state when all are there; later, see to it that it is answered."""
        if self.node.paused:
            return
        if self.tick == 0:
            if missing := self._missing():
                self.node.get_logger().info('waiting for ' + ', '.join(missing),
                                            throttle_duration_sec=5.0)
            else:
                self._publish_next()
            return
        values, now = self.node.parameters.values, time.monotonic()
        silence = now - self.silent_since
        if self.begun and silence > float(values['give_up_after']):
            raise RunError(f'no valve_command answers state {self.tick} '
                           f'({self.stamp_ns * 1e-9:.6f} s) for {silence:.1f} s: '
                           'has the controller ended?')
        if now - self.sent_at > float(values['resend_after']):
            self.sent_at = now
            self.resent += 1
            self._publish()


class RealTime:
    """The wall clock owns time: the physics follows it, and a watchdog looks at the command."""

    def __init__(self, node: ActuatorNode):
        self.node = node
        self.command_n = 0.0
        self.commanded_at: float | None = None
        self.start: float | None = None
        self.done = 0
        self.overruns = 0
        self.lost = 0
        self.tripped = False
        self.timer = node.create_timer(node.period_s, self._tick,
                                       clock=Clock(clock_type=ClockType.STEADY_TIME))

    def on_command(self, stamp_ns: int, command_n: float) -> None:
        latency_ns = self.node.get_clock().now().nanoseconds - stamp_ns
        if latency_ns * 1e-9 > float(self.node.parameters.values['command_timeout']):
            self.node.ignored += 1
            return
        self.node.statistics.latency(latency_ns)
        self.command_n = command_n
        self.commanded_at = time.monotonic()
        if self.tripped:
            self.tripped = False
            self.node.get_logger().info('valve_command is back')

    def on_pause(self) -> None:
        self.start = None
        if self.commanded_at is not None:
            self.commanded_at = time.monotonic()

    def health(self) -> tuple[bytes, str]:
        if self.tripped:
            return ERROR, 'watchdog: no valve_command, the valve command is 0'
        if self.node.statistics.ticks == 0:
            return WARN, 'waiting for ' + ', '.join(self.node.missing())
        if self.commanded_at is None:
            return WARN, 'no valve_command yet, the valve command is 0'
        return OK, 'running'

    def counts(self) -> dict[str, object]:
        return {'watchdog': 'tripped' if self.tripped else 'ok', 'overruns': self.overruns,
                'lost samples': self.lost}

    def _tick(self) -> None:
        node = self.node
        if node.paused or (node.statistics.ticks == 0 and node.missing()):
            return
        now = time.monotonic()
        if self.start is None:
            self.start, self.done = now, 0
        self._watch(now)
        due = round((now - self.start) * node.rate_hz) - self.done
        self.done += due
        # A timer that fires late has missed samples; the physics catches up within bounds.
        self.overruns += due > 1
        self.lost += max(0, due - 1)
        for _ in range(min(due, MOST_CATCH_UP)):
            node.actuator.advance(self.command_n)
        node.sense(node.get_clock().now().nanoseconds)
        node.states.publish(node.state)
        node.publish_rest()
        if node.statistics.ticks == node.last_tick:
            raise RunFinished

    def _watch(self, now: float) -> None:
        timeout = float(self.node.parameters.values['command_timeout'])
        if self.commanded_at is not None and now - self.commanded_at > timeout:
            self.command_n = 0.0
            if not self.tripped:
                self.tripped = True
                self.node.get_logger().error(
                    f'no valve_command for {timeout:g} s: the valve command is 0')


def main() -> int:
    """Run the node; return the exit status."""
    return run_node(ActuatorNode)


if __name__ == '__main__':
    sys.exit(main())
