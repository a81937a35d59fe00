"""The node `asi_actuator`: publishes the actuator's state, takes valve commands."""

import math
import sys
from typing import Any, NoReturn, TypeVar

from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from asi_actuator import calibration
from asi_actuator.actuator_loop import LockStep, RealTime
from asi_actuator.calibration import Rest
from asi_actuator.driver import Health, make_driver
from asi_actuator.driver.simulated import physical
from asi_actuator.model.actuator import Measurement
from asi_actuator.node_parameters import ACTUATOR_NODE_PARAMETERS, PHYSICS
from asi_actuator.safety import Safety, State
from asi_common.loop_parameters import control_rate
from asi_common.node import messages as wire
from asi_common.node.compilation import tell_of_compilation
from asi_common.node.diagnostics import (
    ERROR,
    OK,
    WARN,
    Diagnostics,
    LoopLog,
    LoopStatistics,
    StateChanges,
)
from asi_common.node.discovery import AwaitedRecorder
from asi_common.node.executor import RunError, RunFinished, run_node
from asi_common.node.ros_parameters import RosParameters
from asi_common.node.topics import create_publisher, create_subscription
from asi_common.parameter import ParameterError

Answer = TypeVar('Answer', SetBool.Response, Trigger.Response)


class ActuatorNode(Node):
    """Wires the actuator to its topics, services and parameters; a loop runs it."""

    def __init__(self, **options: Any) -> None:
        """Make the node with options of rclpy's Node, such as parameter_overrides."""
        super().__init__('asi_actuator', automatically_declare_parameters_from_overrides=True,
                         **options)
        # Which parameters there are depends on the plant. A plant that is not known is refused.
        plant = 'actuator'
        if self.has_parameter('plant'):
            plant = str(self.get_parameter('plant').value)
        self.parameters = RosParameters(
            self, ACTUATOR_NODE_PARAMETERS + PHYSICS.get(plant, PHYSICS['actuator']), physical)
        values = self.parameters.values
        self.joint = plant == 'joint'
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
        self.lost_states = 0  # of the link, counted in the statistics
        self.unseen = 0

        self._valve_m = 0.0
        self.states = create_publisher(self, 'joint_states')
        self.forces = create_publisher(self, 'force')
        self.valve_positions = create_publisher(self, 'valve_position')
        self.velocities = create_publisher(self, 'velocity')
        self.state_changes = StateChanges(self)
        self.topics = [self.states, self.forces, self.valve_positions, self.velocities,
                       self.state_changes.publisher]
        self.loop: LockStep | RealTime = LockStep(self) if lockstep else RealTime(self)
        self.commands = create_subscription(self, 'valve_command', self._on_command)
        self.create_service(SetBool, '~/enable', self._enable)
        self.create_service(Trigger, '~/calibrate', self._calibrate)
        self.create_service(Trigger, '~/reset', self._reset)
        self.create_service(SetBool, '~/pause', self._pause)
        self.loop_log = LoopLog(self)
        self.diagnostics = Diagnostics(self, self._describe, self._state)
        self.get_logger().info(f'{values["driver"]}, {plant}, {values["mode"]} at '
                               f'{self.rate_hz:g} Hz, {self.safety.state}')

    def missing(self) -> list[str]:
        """Return the recorders that the first state still waits for."""
        return [f'a recorder of {name}' for name in self.recorder.missing(self.topics)]

    def exchange(self, command_n: float, periods: int) -> bool:
        """
        Give a command (N) to the actuator and take its state `periods` control periods later.

        Return whether there is a new state. An unsafe one shuts the valve with the next call.
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
        if self.joint:   # it has no valve
            valve = math.nan
        valve_velocity = (valve - self._valve_m) * self.rate_hz
        self._valve_m = valve
        return wire.state(stamp_ns, position, valve, velocity, valve_velocity,
                          force, self.applied_n)

    def tell_state(self, stamp_ns: int) -> None:
        """Publish the state of the safety logic from the control period of a stamp on."""
        # In lock-step before the state of that stamp, so that a bag has both in order.
        self.state_changes.publish(stamp_ns, self._state(),
                                   wait=self.parameters.values['mode'] == 'lockstep')

    def _state(self) -> wire.Status:
        level = {State.ENABLED: OK, State.DISABLED: WARN, State.FAULT: ERROR}[self.safety.state]
        return self.state_changes.status(level, self.safety.state, self.safety.reason)

    def publish_rest(self, force: bytes, valve: bytes, velocity: bytes) -> None:
        """Publish the topics that no controller waits for."""
        self.forces.publish(force)
        self.valve_positions.publish(valve)
        self.velocities.publish(velocity)

    def destroy_node(self) -> None:
        """Close the valve, then end."""
        self.driver.close()
        super().destroy_node()

    def finish(self) -> NoReturn:
        """End the run after `duration`; if it ended in a fault, it has failed."""
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
        self.loop.on_parameters()

    def _safety_changed(self) -> None:
        """Report a change of state at once, in the log and on /diagnostics, so in the bag."""
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

    def _refused(self, service: str, answer: Answer, why: str) -> Answer:
        """Return the answer of a service that is refused, and log the reason."""
        answer.message = f'refused: {why}'
        self.get_logger().warning(f'~/{service} refused: {why}')
        return answer

    def _enable(self, request: SetBool.Request, answer: SetBool.Response) -> SetBool.Response:
        if not request.data:
            self.safety.disable()
        elif self.measured is None and self.driver.hardware:
            return self._refused(
                'enable', answer, f'no state of the actuator yet; {self.health.problem}')
        elif problem := self.safety.enable():
            return self._refused('enable', answer, problem)
        answer.success, answer.message = True, str(self.safety.state)
        return answer

    def _calibrate(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        """Zero the force sensor: the mean of the last readings becomes 0."""
        values = self.parameters.values
        problem = self.rest.problem(float(values['calibration_noise']))
        if not self.driver.hardware:
            problem = problem or self._load()
        elif self.safety.state is State.ENABLED:
            problem = 'the actuator is enabled, disable it first'
        if problem:
            return self._refused('calibrate', answer, problem)
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

    def _load(self) -> str:
        """Return what loads the simulated force sensor, '' for nothing."""
        values = self.parameters.values
        if self.joint:
            return 'the plant is a joint: force_sensor.offset takes its offset off'
        thrust_n = self.rest.mean_valve_m() * (
            float(values['valve_characteristic.maximum_force'])
            / float(values['valve_characteristic.full_opening']))
        push_n = float(values['load.external_force'])
        if abs(thrust_n) > calibration.CHANGE_N:
            return (f'the valve is open and presses with about {thrust_n:.3g} N: disable the '
                    'controller; ~/reset closes a valve that its hysteresis holds open')
        return f'load.external_force = {push_n:g} N presses on the piston' if push_n else ''

    def _reset(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        if not self.driver.hardware:
            try:
                self.calibration = calibration.load(
                    str(self.parameters.values['calibration_file']))
            except ParameterError as error:   # it was changed while the node ran
                return self._refused('reset', answer, str(error))
            self.rest = Rest(self.rate_hz)
        self.driver.reset()
        self.safety.reset()
        self.loop.on_reset()
        answer.success, answer.message = True, f'reset: {self.safety.state}'
        self.get_logger().info(answer.message)
        return answer

    def _pause(self, request: SetBool.Request, answer: SetBool.Response) -> SetBool.Response:
        if self.driver.hardware:
            return self._refused(
                'pause', answer, 'hardware does not wait; ~/enable false closes the valve')
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
            self.loop_log.tell(level, text)
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


def main() -> int:
    """Run the node; return the exit status."""
    tell_of_compilation('asi_actuator')
    return run_node(ActuatorNode)


if __name__ == '__main__':
    sys.exit(main())
