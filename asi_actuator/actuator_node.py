"""The node `asi_actuator`: publishes the actuator's state, takes valve commands."""

import math
import sys
import time
from typing import Any, Final, NoReturn, Protocol

from geometry_msgs.msg import WrenchStamped
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64
from std_srvs.srv import SetBool, Trigger

from asi_actuator import calibration
from asi_actuator.calibration import Rest
from asi_actuator.driver import Health, make_driver
from asi_actuator.driver.simulated import physical
from asi_actuator.model.actuator import Measurement
from asi_actuator.node_parameters import ACTUATOR_NODE_PARAMETERS
from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_actuator.safety import Safety, State
from asi_common.loop_parameters import control_rate
from asi_common.node import messages as wire
from asi_common.node.diagnostics import (
    ERROR,
    OK,
    SILENT_S,
    WARN,
    Diagnostics,
    LoopStatistics,
    StateChanges,
)
from asi_common.node.discovery import AwaitedRecorder
from asi_common.node.executor import RunError, RunFinished, Unhurried, run_node
from asi_common.node.ros_parameters import RosParameters
from asi_common.node.topics import CONTROL_QOS, STREAM_QOS, SteadyClock

# How often the lock-step looks whether it must send again, s.
WATCH_PERIOD_S: Final = 0.005
# Real time: at most so many periods are caught up at once; the rest is lost time.
MOST_CATCH_UP: Final = 10


class ActuatorNode(Node):
    """Wires the actuator to its topics, services and parameters; a loop runs it."""

    def __init__(self, **options: Any) -> None:
        """Make the node with options of rclpy's Node, such as parameter_overrides."""
        super().__init__('asi_actuator', automatically_declare_parameters_from_overrides=True,
                         **options)
        self.parameters = RosParameters(
            self, ACTUATOR_NODE_PARAMETERS + ACTUATOR_PARAMETERS, physical)
        values = self.parameters.values
        self.rate_hz = control_rate(values)
        self.period_s = 1.0 / self.rate_hz
        self.calibration = calibration.load(str(values['calibration_file']))
        self.rest = Rest(self.rate_hz)
        self.driver = make_driver(values, self.period_s)
        self.driver.open()
        self.applied_n = 0.0
        self.safety = Safety(values, self.period_s,
                             State.DISABLED if self.driver.hardware else State.ENABLED,
                             self._safety_changed)
        self.parameters.when_changed(self._configure)
        self.last_tick = self._last_tick()
        lockstep = values['mode'] == 'lockstep'
        self.statistics = LoopStatistics(math.inf if lockstep else self.period_s)
        self.recorder = AwaitedRecorder(self, bool(values['await_recorder']))
        self.ignored = 0
        self.paused = False
        # The newest state, the link it came by, and the periods since then.
        self.measured: Measurement | None = None
        self.health = Health()
        self.lost_states = 0  # of the link, that statistics knows
        self.unseen = 0

        self._valve_m = 0.0
        self.states = self.create_publisher(JointState, 'joint_states', STREAM_QOS)
        self.forces = self.create_publisher(WrenchStamped, 'force', STREAM_QOS)
        self.valve_positions = self.create_publisher(Float64, 'valve_position', STREAM_QOS)
        self.velocities = self.create_publisher(Float64, 'velocity', STREAM_QOS)
        self.state_changes = StateChanges(self)
        self.topics = [self.states, self.forces, self.valve_positions, self.velocities,
                       self.state_changes.publisher]
        self.loop: Loop = (LockStep if lockstep else RealTime)(self)
        self.commands = self.create_subscription(
            WrenchStamped, 'valve_command', self._on_command, CONTROL_QOS, raw=True)
        self.create_service(SetBool, '~/enable', self._enable)
        self.create_service(Trigger, '~/calibrate', self._calibrate)
        self.create_service(Trigger, '~/reset', self._reset)
        self.create_service(SetBool, '~/pause', self._pause)
        self.diagnostics = Diagnostics(self, self._describe, self._state)
        self.get_logger().info(f'{values["driver"]}, {values["mode"]} at {self.rate_hz:g} Hz, '
                               f'{self.safety.state}')

    def missing(self) -> list[str]:
        """Return the recorders that the first state still waits for."""
        return [f'a recorder of {name}' for name in self.recorder.missing(self.topics)]

    def exchange(self, command_n: float, periods: int) -> bool:
        """
        Give a command (N) to the actuator and take its state `periods` control periods later.

        Return whether there is a new state. What is not safe shuts the valve with the next call.
        """
        safety, driver = self.safety, self.driver
        self.applied_n = applied_n = safety.command(command_n)
        reading = driver.exchange(applied_n, safety.enabled, periods)
        self.health = driver.health
        self.unseen += periods
        if reading is not None:
            self.rest.add((reading, applied_n))
            self.measured = measured = self.calibration.applied(reading)
            safety.watch_state(measured, self.unseen)
            self.unseen = 0
        if driver.hardware and self.measured is not None:
            safety.watch_link(self.health)
        return reading is not None

    def sense(self, stamp_ns: int, now_ns: int) -> tuple[bytes, bytes, bytes, bytes, bytes]:
        """Count the tick, and return the messages of what was measured last (wire.state)."""
        assert self.measured is not None
        self.statistics.tick(now_ns, self.health.saturated)
        force, valve, position, velocity = self.measured
        valve_velocity = (valve - self._valve_m) * self.rate_hz
        self._valve_m = valve
        return wire.state(stamp_ns, position, valve, velocity, valve_velocity,
                          force, self.applied_n)

    def tell_state(self, stamp_ns: int) -> None:
        """Publish the state that the safety logic is in from the control period of a stamp on."""
        # In lock-step, before the state of that stamp: so a recorder knows where it belongs.
        self.state_changes.publish(stamp_ns, self._state(),
                                   wait=self.parameters.values['mode'] == 'lockstep')

    def _state(self) -> wire.Status:
        level = {State.ENABLED: OK, State.DISABLED: WARN, State.FAULT: ERROR}[self.safety.state]
        return self.state_changes.status(level, self.safety.state, self.safety.reason)

    def publish_rest(self, force: bytes, valve: bytes, velocity: bytes) -> None:
        """Publish what no controller waits for."""
        self.forces.publish(force)
        self.valve_positions.publish(valve)
        self.velocities.publish(velocity)

    def destroy_node(self) -> None:
        """Close the valve, then end."""
        self.driver.close()
        super().destroy_node()

    def finish(self) -> NoReturn:
        """End the run that `duration` bounds: one that ended in a fault has failed."""
        if self.safety.state is State.FAULT:
            raise RunError(f'the run ended in a fault: {self.safety.reason}')
        raise RunFinished

    def _last_tick(self) -> int | None:
        """Return the number of ticks after which the run has ended, None for no end."""
        duration = float(self.parameters.values['duration'])
        ends = [self.driver.last_tick,
                math.ceil(duration * self.rate_hz - 1e-9) if duration else None]
        return min((end for end in ends if end is not None), default=None)

    def _configure(self, _: set[str]) -> None:
        self.driver.configure(self.parameters.values)
        self.safety.configure(self.parameters.values)

    def _safety_changed(self) -> None:
        """Tell a change of state at once, in the log and on /diagnostics, so in the bag."""
        if self.safety.state is State.FAULT:
            self.get_logger().error(f'fault, the valve command is 0: {self.safety.reason}; '
                                    '~/reset when the cause is gone')
        else:
            self.get_logger().info(self.safety.state)
        self.diagnostics.publish()
        if self.statistics.ticks:
            self.tell_state(self.loop.next_stamp_ns())

    def _on_command(self, message: bytes) -> None:
        stamp_ns, command_n = wire.force(message)
        self.loop.on_command(stamp_ns, command_n)

    def _enable(self, request: SetBool.Request, answer: SetBool.Response) -> SetBool.Response:
        if not request.data:
            self.safety.disable()
        elif self.measured is None and self.driver.hardware:
            answer.message = f'refused: no state of the actuator yet; {self.health.problem}'
            return answer
        elif problem := self.safety.enable():
            answer.message = f'refused: {problem}'
            return answer
        answer.success, answer.message = True, str(self.safety.state)
        return answer

    def _calibrate(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        """Zero the force sensor: the mean of the last readings becomes 0."""
        values = self.parameters.values
        problem = self.rest.problem(float(values['calibration_noise']))
        if self.driver.hardware and self.safety.state is State.ENABLED:
            problem = 'the actuator is enabled, disable it first'
        if problem:
            answer.message = f'refused: {problem}'
            return answer
        before, now_n = self.calibration.offset_n, self.rest.mean_n()
        self.calibration = self.calibration._replace(offset_n=now_n)
        answer.success = True
        answer.message = f'force sensor zeroed: {now_n - before:+.3f} N taken off'
        if path := str(values['calibration_file']):
            try:
                calibration.save(path, self.calibration)
                answer.message += f', kept in {path}'
            except OSError as error:
                answer.success = False
                answer.message += f', but not kept: {error}'
        self.get_logger().info(answer.message)
        return answer

    def _reset(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        self.driver.reset()
        self.safety.reset()
        self.loop.on_reset()
        answer.success, answer.message = True, f'reset: {self.safety.state}'
        self.get_logger().info(answer.message)
        return answer

    def _pause(self, request: SetBool.Request, answer: SetBool.Response) -> SetBool.Response:
        if self.driver.hardware:
            answer.message = 'refused: hardware does not wait; ~/enable false closes the valve'
            return answer
        if request.data != self.paused:
            self.paused = request.data
            self.loop.on_pause()
        answer.success, answer.message = True, 'paused' if self.paused else 'running'
        self.get_logger().info(answer.message)
        return answer

    def _describe(self) -> tuple[bytes, str, dict[str, object]]:
        self.statistics.lose(self.health.lost_states - self.lost_states)
        self.lost_states = self.health.lost_states
        if self.safety.state is State.FAULT:
            level, text = ERROR, f'fault, the valve command is 0: {self.safety.reason}'
        elif self.paused:
            level, text = WARN, 'paused'
        else:
            level, text = self.loop.health()
            if level == OK and self.safety.state is State.DISABLED:
                level, text = WARN, 'disabled: the valve command is 0'
            if problems := self.statistics.problems():
                level, text = max(level, WARN), f'{text}, but {"; ".join(problems)}'
        return level, text, {
            'state': self.safety.state, 'driver': self.parameters.values['driver'],
            'mode': self.parameters.values['mode'], 'rate (Hz)': self.rate_hz,
            **self.statistics.values(), 'commands ignored': self.ignored,
            'states lost': self.health.lost_states, 'bad frames': self.health.bad_frames,
            **self.loop.counts()}


class Loop(Protocol):
    """What runs the actuator: lock-step or real time."""

    def __init__(self, node: ActuatorNode): ...

    def on_command(self, stamp_ns: int, command_n: float) -> None:
        """Take a valve command that answers the state of `stamp_ns`."""

    def on_pause(self) -> None:
        """Follow node.paused, which has changed."""

    def on_reset(self) -> None:
        """Forget what was asked for before the reset."""

    def next_stamp_ns(self) -> int:
        """Return the stamp of the state that comes next, or, in real time, now."""

    def health(self) -> tuple[bytes, str]:
        """Return diagnostic level and message."""

    def counts(self) -> dict[str, object]:
        """Return what was counted, by name."""


class LockStep:
    """The actuator owns time (doc/explanation/lock_step.md)."""

    def __init__(self, node: ActuatorNode):
        self.node = node
        self.tick = 0
        self.stamp_ns = 0
        # The bytes of the newest state, and of its stamp.
        self.state = self.clock = b''
        # While the node is paused: what is to be done then.
        self.command_n: float | None = None
        # The newest state that was answered, and how.
        self.answered = (0, 0.0)
        self.resent = 0
        self.silent_since_ns = self.sent_ns = time.monotonic_ns()
        self.clocks = node.create_publisher(ClockMessage, 'clock', STREAM_QOS)
        node.topics.append(self.clocks)
        node.create_timer(WATCH_PERIOD_S, self._watch, Unhurried(),
                          Clock(clock_type=ClockType.STEADY_TIME))

    def on_command(self, stamp_ns: int, command_n: float) -> None:
        node = self.node
        if stamp_ns != self.stamp_ns or self.command_n is not None:
            node.ignored += 1
            # A lost answer is asked for again, and is the same.
            if (stamp_ns, command_n) != self.answered and stamp_ns == self.answered[0]:
                node.safety.trip(
                    f'valve_command = {self.answered[1]:g} N and {command_n:g} N answer the same '
                    'state: do two controllers run?')
            return
        self.answered = stamp_ns, command_n
        node.statistics.latency(time.monotonic_ns() - self.silent_since_ns)
        if node.paused:
            self.command_n = command_n
        else:
            self._advance(command_n, 1)

    def on_pause(self) -> None:
        self.silent_since_ns = self.sent_ns = time.monotonic_ns()
        if not self.node.paused and self.command_n is not None:
            command_n, self.command_n = self.command_n, None
            self._advance(command_n, 1)

    def on_reset(self) -> None:
        pass

    def next_stamp_ns(self) -> int:
        return round((self.tick + 1) * 1e9 / self.node.rate_hz)

    def health(self) -> tuple[bytes, str]:
        if self.tick == 0:
            return WARN, 'waiting for ' + ', '.join(self._missing())
        silence = self._silence(time.monotonic_ns())
        if silence > float(self.node.parameters.values['resend_after']):
            return WARN, f'no answer to state {self.tick} for {silence:.1f} s'
        return OK, 'running'

    def counts(self) -> dict[str, object]:
        return {'resent': self.resent}

    def _silence(self, now_ns: int) -> float:
        """Return for how long (s) no answer has come."""
        return (now_ns - self.silent_since_ns) * 1e-9

    def _advance(self, command_n: float, periods: int) -> None:
        """Go on to the next state, which comes `periods` periods later: 1, and the first 0."""
        node = self.node
        if self.tick == node.last_tick:
            node.finish()
        node.exchange(command_n, periods)
        self.stamp_ns = stamp_ns = self.next_stamp_ns()
        if self.tick == 0:
            node.tell_state(stamp_ns)
        self.tick += 1
        self.silent_since_ns = self.sent_ns = now_ns = time.monotonic_ns()
        self.state, self.clock, force, valve, velocity = node.sense(stamp_ns, now_ns)
        self._publish()
        # After what the controller waits for: it computes meanwhile.
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
        """Publish the first state when all are there; later, see to it that it is answered."""
        if self.node.paused:
            return
        if self.tick == 0:
            if missing := self._missing():
                self.node.get_logger().info('waiting for ' + ', '.join(missing),
                                            throttle_duration_sec=5.0)
            else:
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

    def __init__(self, node: ActuatorNode):
        self.node = node
        self.command_n = 0.0
        self.commanded_at: float | None = None
        self.clock = SteadyClock()
        # In the second that goes on.
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


def main() -> int:
    """Run the node; return the exit status."""
    return run_node(ActuatorNode)


if __name__ == '__main__':
    sys.exit(main())
