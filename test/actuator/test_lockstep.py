"""Lock-step over DDS, in separate processes: the same run as in one process, whatever happens."""

import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from conftest import wait_for_silence, wait_until
from relay import TOPICS

from asi_analysis.loop.closed_loop import LoopRun, simulate_loop
from asi_common.node.topics import nanoseconds
from asi_common.parameter import Value

ACTUATOR, CONTROLLER = 'asi_actuator.actuator_node', 'asi_controller.controller_node'
RATE_HZ = 5000.0
# Noise, so that a sample too many or too few shows; an odd gain, so that roundings do.
NOISY: dict[str, Value] = {'force_sensor.noise': 0.7, 'force_sensor.offset': -3.3}
LEAD_LAG: dict[str, Value] = {'compensator': 'lead_lag', 'gain': 13.7}
STEP: dict[str, Value] = {'reference.shape': 'step', 'reference.amplitude': 321.0,
                          'reference.start': 0.01}


class Recording:
    """What was said on the topics of the loop, by stamp."""

    def __init__(self, node: Any, suffix: str = ''):
        """Subscribe to every topic of the loop; those that the relay takes have a suffix."""
        from diagnostic_msgs.msg import DiagnosticArray
        from geometry_msgs.msg import WrenchStamped
        from rosgraph_msgs.msg import Clock
        from sensor_msgs.msg import JointState
        from std_msgs.msg import Float64

        self.messages: dict[str, list[Any]] = {}
        for kind, name in ((JointState, 'joint_states'), (WrenchStamped, 'force'),
                           (Float64, 'valve_position'), (Float64, 'velocity'), (Clock, '/clock'),
                           (WrenchStamped, 'valve_command'), (WrenchStamped, 'force_reference')):
            self.messages[name] = []
            topic = name + suffix if (kind, name) in TOPICS else name
            node.create_subscription(kind, topic, self.messages[name].append, 10_000)
        # A node that awaits a recorder awaits that it hears this too.
        node.create_subscription(DiagnosticArray, '/diagnostics', lambda message: None, 10)

    def stamps(self, name: str) -> list[int]:
        """Return the stamps (ns) of a topic, in the order of arrival."""
        return [nanoseconds(m.header.stamp) for m in self.messages[name]]

    def once(self, name: str) -> list[Any]:
        """
        Return the messages of a topic, those that were sent again only once.

        Those of velocity and valve_position have no stamp, and are not sent again.
        """
        messages = list(self.messages[name])
        if name in ('valve_position', 'velocity'):
            return messages
        return list({nanoseconds(m.clock if name == '/clock' else m.header.stamp): m
                     for m in messages}.values())

    def run(self) -> LoopRun:
        """Return the signals, in the order of the stamps."""
        states = self.once('joint_states')
        return LoopRun(
            np.array([nanoseconds(m.header.stamp) for m in states]) * 1e-9,
            *(np.array([m.wrench.force.x for m in self.once(name)])
              for name in ('force_reference', 'valve_command', 'force')),
            np.array([m.data for m in self.once('valve_position')]),
            np.array([m.position[0] for m in states]),
            np.array([m.data for m in self.once('velocity')]))


@pytest.fixture
def recording(ros_node: Any) -> Recording:
    return Recording(ros_node)


def assert_same_run(recording: Recording, expected: LoopRun) -> None:
    """Compare sample for sample, bit for bit."""
    ticks = expected.time_s.size
    for name in recording.messages:
        wait_until(lambda name=name: len(recording.once(name)) >= ticks, f'{ticks} of {name}')
    run = recording.run()
    period_ns = round(1e9 / RATE_HZ)
    assert recording.stamps('force') == [k * period_ns for k in range(1, ticks + 1)]
    for name in LoopRun._fields[1:]:
        np.testing.assert_array_equal(getattr(run, name), getattr(expected, name), name)


def test_run_over_ros_is_the_run_in_process(
        start_node: Callable, recording: Recording) -> None:
    expected = simulate_loop(NOISY, LEAD_LAG | STEP, 0.3, RATE_HZ)
    controller = start_node(CONTROLLER, await_recorder=True, **LEAD_LAG, **STEP)
    actuator = start_node(ACTUATOR, duration=0.3, await_recorder=True, **NOISY)
    assert actuator.exit_status() == 0, actuator.text
    assert_same_run(recording, expected)
    assert controller.stop() == 0


def test_lost_repeated_and_late_messages_change_nothing(
        start_node: Callable, ros_node: Any) -> None:
    expected = simulate_loop(NOISY, LEAD_LAG | STEP, 0.1, RATE_HZ)
    recording = Recording(ros_node, suffix='_sent')
    relay = start_node('relay')
    start_node(CONTROLLER, '-r', 'valve_command:=valve_command_sent', await_recorder=True,
               **LEAD_LAG, **STEP)
    actuator = start_node(ACTUATOR, '-r', 'joint_states:=joint_states_sent',
                          '-r', '/clock:=/clock_sent', duration=0.1, resend_after=0.01,
                          await_recorder=True, **NOISY)
    assert actuator.exit_status() == 0, actuator.text
    assert_same_run(recording, expected)
    assert relay.stop() == 0
    counts = json.loads(relay.text.splitlines()[-1])
    assert min(counts['dropped'], counts['repeated'], counts['delayed']) > 20
    assert len(recording.messages['joint_states']) > expected.time_s.size


def test_paced_run_is_the_same_run_and_no_faster_than_asked_for(
        start_node: Callable, recording: Recording, set_parameters: Callable) -> None:
    expected = simulate_loop(NOISY, LEAD_LAG | STEP, 0.1, RATE_HZ)
    start_node(CONTROLLER, await_recorder=True, **LEAD_LAG, **STEP)
    actuator = start_node(ACTUATOR, duration=0.1, await_recorder=True, real_time_factor=0.01,
                          **NOISY)
    states = recording.messages['joint_states']
    wait_until(lambda: states, 'the first state')
    begin, first = time.monotonic(), len(states)
    wait_until(lambda: len(states) >= first + 150, '150 states')
    # 150 states of 0.2 ms at a hundredth of real time take 3 s, less what is caught up.
    assert time.monotonic() - begin > 2.0
    assert set_parameters('asi_actuator', {'real_time_factor': 0.0})[0].successful
    assert actuator.exit_status() == 0, actuator.text
    assert_same_run(recording, expected)


def test_silent_controller_ends_the_run_with_an_error(
        start_node: Callable, recording: Recording) -> None:
    actuator = start_node(ACTUATOR, give_up_after=0.5, await_recorder=True)
    controller = start_node(CONTROLLER, **STEP)
    # A second state: the actuator itself, not only the recorder, has heard the first command.
    wait_until(lambda: len(recording.once('joint_states')) > 1, 'a second state')
    controller.kill()
    assert actuator.exit_status() == 1
    # What was sent last may come after the end of who sent it.
    wait_until(lambda: f'no valve_command answers state {len(recording.once("joint_states"))} '
               in actuator.text, 'the state that was not answered')
    assert 'Traceback' not in actuator.text


def test_next_controller_goes_on_where_the_killed_one_stopped(
        start_node: Callable, recording: Recording) -> None:
    actuator = start_node(ACTUATOR, give_up_after=0.0)
    first = start_node(CONTROLLER, **STEP)
    wait_until(lambda: recording.messages['valve_command'], 'a command')
    first.kill()
    answered = len(recording.once('valve_command'))
    second = start_node(CONTROLLER, **STEP)
    wait_until(lambda: len(recording.once('valve_command')) > answered + 100, 'more commands')
    assert second.stop() == 0
    assert actuator.stop() == 0
    stamps = sorted(set(recording.stamps('joint_states')))
    assert set(np.diff(stamps)) == {round(1e9 / RATE_HZ)}


def test_controller_begins_anew_with_the_next_actuator(
        start_node: Callable, recording: Recording) -> None:
    expected = simulate_loop(NOISY, LEAD_LAG | STEP, 0.1, RATE_HZ)
    controller = start_node(CONTROLLER, **LEAD_LAG, **STEP)
    first = start_node(ACTUATOR, **NOISY)
    wait_until(lambda: len(recording.messages['valve_command']) > 100, 'commands')
    first.kill()
    wait_for_silence('the first run', *recording.messages.values())
    for messages in recording.messages.values():
        messages.clear()
    second = start_node(ACTUATOR, duration=0.1, resend_after=0.02, await_recorder=True, **NOISY)
    assert second.exit_status() == 0
    assert_same_run(recording, expected)
    assert controller.stop() == 0


def test_stray_state_is_ignored_and_counted(
        start_node: Callable, ros_node: Any, recording: Recording) -> None:
    """At a wrong distance from the last, by one who should not speak; the run stays the same."""
    from sensor_msgs.msg import JointState

    expected = simulate_loop(NOISY, LEAD_LAG | STEP, 0.3, RATE_HZ)
    controller = start_node(CONTROLLER, await_recorder=True, **LEAD_LAG, **STEP)
    strays = ros_node.create_publisher(JointState, 'joint_states', 10)
    wait_until(lambda: strays.get_subscription_count() > 1, 'the controller')
    actuator = start_node(ACTUATOR, duration=0.3, resend_after=0.02, await_recorder=True, **NOISY)
    wait_until(lambda: recording.messages['valve_command'], 'a command')
    stray = JointState(name=['piston', 'valve'], effort=[1e3, 0.0])
    stray.header.stamp.sec = 7
    strays.publish(stray)
    controller.wait_for('s apart, but rate_hz = 5000 asks for 0.0002 s')
    assert actuator.exit_status() == 0, actuator.text
    messages = recording.messages['joint_states']
    wait_for_silence('the states', messages)
    messages[:] = [m for m in messages if m.header.stamp.sec != 7]
    assert_same_run(recording, expected)
    assert controller.stop() == 0


def test_commands_of_two_controllers_that_disagree_are_a_fault(
        start_node: Callable, ros_node: Any, recording: Recording) -> None:
    """Two real ones may never answer the same state: a slow one falls behind, and ends."""
    from geometry_msgs.msg import WrenchStamped

    actuator = start_node(ACTUATOR, give_up_after=60.0)
    # Of this recording, and of the actuator.
    commands = ros_node.create_publisher(WrenchStamped, 'valve_command', 10)
    wait_until(lambda: commands.get_subscription_count() > 1, 'the actuator')
    wait_until(lambda: recording.messages['joint_states'], 'the first state')
    for force_n in (1.0, 2.0):
        command = WrenchStamped(header=recording.messages['joint_states'][0].header)
        command.wrench.force.x = force_n
        commands.publish(command)
    actuator.wait_for('1 N and 2 N answer the same state: do two controllers run?')
    assert actuator.stop() == 0


def test_different_rates_are_an_error_that_says_both(start_node: Callable) -> None:
    start_node(ACTUATOR, rate_hz=2000.0, give_up_after=60.0)
    controller = start_node(CONTROLLER, rate_hz=5000.0)
    assert controller.exit_status() == 1
    assert '0.0005 s apart' in controller.text and '0.0002 s' in controller.text


@pytest.mark.parametrize(('actuator', 'controller'),
                         [('lockstep', 'realtime'),
                          pytest.param('realtime', 'lockstep', marks=pytest.mark.slow)])
def test_different_modes_are_an_error(
        actuator: str, controller: str, start_node: Callable, recording: Recording) -> None:
    start_node(ACTUATOR, mode=actuator)
    node = start_node(CONTROLLER, mode=controller)
    assert node.exit_status() == 1
    assert 'mode' in node.text and 'Traceback' not in node.text


def test_parameter_changes_while_running_without_a_glitch(
        start_node: Callable, recording: Recording, set_parameters: Callable) -> None:
    start_node(CONTROLLER, gain=3.0, **{'reference.shape': 'step',
                                        'reference.amplitude': 300.0})
    start_node(ACTUATOR)
    settled = 2500
    wait_until(lambda: len(recording.messages['valve_command']) > settled, 'the end of the step')
    changed = len(recording.messages['valve_command'])
    result, = set_parameters('asi_controller', {'feedforward': 1.4})
    assert result.successful, result.reason
    wait_until(lambda: len(recording.messages['valve_command']) > changed + 1500, 'the change')
    command = recording.run().command_n[settled:]
    # 0.469 * 300 N less of feed-forward, most of which the gain makes up for.
    assert abs(command[-1] - command[0]) > 30.0
    assert abs(np.diff(command)).max() < 5.0
