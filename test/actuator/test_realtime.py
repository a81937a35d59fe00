"""Real time over DDS: a step, the watchdog, the services, /diagnostics, clean ends."""

import contextlib
import ctypes
import os
import re
import resource
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from conftest import Listener, NodeProcess, wait_for_silence, wait_until

from asi_common.node.topics import SteadyClock
from asi_common.parameter import Value
from asi_controller import controller_node

ACTUATOR, CONTROLLER = 'asi_actuator.actuator_node', 'asi_controller.controller_node'
# A busy machine is no fault of the loop: what is tested here is not how fast it is.
PATIENT: dict[str, Value] = {'mode': 'realtime', 'rate_hz': 200.0, 'state_timeout': 60.0}


@pytest.fixture
def diagnostics(ros_node: Any) -> Callable[..., Any]:
    """Return a function that waits for the next diagnostic status of a node with a text."""
    from diagnostic_msgs.msg import DiagnosticArray
    listener = Listener(ros_node, DiagnosticArray, '/diagnostics')

    def status(node: str, text: str, meets: Callable[[Any], bool] = lambda status: True,
               begin: int | None = None) -> Any:
        begin = len(listener.messages) if begin is None else begin
        return wait_until(
            lambda: next((status for message in listener.messages[begin:]
                          for status in message.status if status.name == f'{node}: loop'
                          and text in status.message and meets(status)), None),
            f'{text!r} from {node}')

    status.listener = listener   # type: ignore[attr-defined]
    return status


def says_how_it_runs(status: Any) -> bool:
    """Return whether a status is OK, or a warning that says why: the machine may be too busy."""
    from diagnostic_msgs.msg import DiagnosticStatus
    return status.level == (DiagnosticStatus.OK if status.message == 'running'
                            else DiagnosticStatus.WARN)


def force(state: Any) -> float:
    return state.effort[0]


def test_step_settles_near_the_reference(start_node: Callable, states: Listener) -> None:
    start_node(ACTUATOR, mode='realtime', rate_hz=1000.0, command_timeout=60.0)
    start_node(CONTROLLER, mode='realtime', rate_hz=1000.0, state_timeout=60.0, gain=1.0,
               **{'reference.shape': 'step', 'reference.amplitude': 300.0})
    states.wait_until(lambda state: force(state) > 200.0, 'the step')
    last = [force(state) for state in states.wait(400)[-200:]]
    # With a gain of 1 and the feed-forward the hysteresis leaves about 14 N.
    assert abs(np.mean(last) - 300.0) < 30.0
    stamps = [(m.header.stamp.sec, m.header.stamp.nanosec) for m in states.messages]
    assert stamps == sorted(set(stamps))


@pytest.mark.parametrize('discovery_range', ['LOCALHOST', 'SUBNET'])
def test_no_shared_memory_whose_locks_a_killed_process_would_keep(
        discovery_range: str, ros_environment: dict[str, str], start_node: Callable,
        states: Listener) -> None:
    ros_environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] = discovery_range
    actuator = start_node(ACTUATOR, mode='realtime', rate_hz=200.0)
    # A node without our profiles, which offers shared memory, hears it all the same.
    states.wait(3)
    assert '/dev/shm/fastrtps' not in Path(f'/proc/{actuator.pid}/maps').read_text()


def test_watchdog_takes_the_command_away_until_the_reset(
        start_node: Callable, states: Listener, diagnostics: Callable, call: Callable,
        set_parameters: Callable) -> None:
    from diagnostic_msgs.msg import DiagnosticStatus
    from std_srvs.srv import SetBool, Trigger

    actuator = start_node(ACTUATOR, mode='realtime', rate_hz=200.0, command_timeout=60.0)
    constant = {'reference.shape': 'step', 'reference.amplitude': 200.0}
    controller = start_node(CONTROLLER, **PATIENT, **constant)
    states.wait_until(lambda state: state.effort[1] > 100.0, 'a valve command')
    assert says_how_it_runs(diagnostics('asi_actuator', 'running'))
    controller.kill()
    set_parameters('asi_actuator', {'command_timeout': 2.0})
    states.wait_until(lambda state: state.effort[1] == 0.0, 'the watchdog')
    status = diagnostics('asi_actuator', 'fault')
    assert status.level == DiagnosticStatus.ERROR
    assert {v.key: v.value for v in status.values}['state'] == 'fault'
    assert 'age of valve_command' in status.message and 'command_timeout = 2 s' in status.message
    actuator.wait_for(status.message)
    set_parameters('asi_actuator', {'command_timeout': 60.0})
    start_node(CONTROLLER, **PATIENT, **constant).wait_for('realtime at')
    assert not any(state.effort[1] for state in states.wait(100))
    refused = call(SetBool, '/asi_actuator/enable', SetBool.Request(data=True))
    assert not refused.success and 'age of valve_command' in refused.message
    assert call(Trigger, '/asi_actuator/reset', Trigger.Request()).success
    states.wait_until(lambda state: state.effort[1] > 100.0, 'the next controller')
    assert says_how_it_runs(diagnostics('asi_actuator', 'running'))


def test_lost_samples_and_long_periods_are_a_warning_that_passes(
        start_node: Callable, diagnostics: Callable) -> None:
    from diagnostic_msgs.msg import DiagnosticStatus

    actuator = start_node(ACTUATOR, mode='realtime', rate_hz=200.0, command_timeout=60.0)
    start_node(CONTROLLER, **PATIENT)
    for node in ('asi_actuator', 'asi_controller'):
        diagnostics(node, 'running')
    # One that stands still cannot tick, nor can the controller hear who does.
    begin = len(diagnostics.listener.messages)
    actuator.send(signal.SIGSTOP)
    time.sleep(1.5)
    actuator.send(signal.SIGCONT)
    for node in ('asi_actuator', 'asi_controller'):
        # A busy machine loses a few before: the first status that says so may count only them.
        status = diagnostics(node, 'samples were lost', lambda status: int(
            {v.key: v.value for v in status.values}['lost samples']) > 100, begin)
        assert status.level == DiagnosticStatus.WARN
    assert 'the longest of the last periods took' in diagnostics(
        'asi_actuator', 'took', begin=begin).message


@pytest.mark.parametrize('mode', ['realtime', pytest.param('lockstep', marks=pytest.mark.slow)])
def test_a_partner_that_is_gone_is_a_warning(
        mode: str, start_node: Callable, diagnostics: Callable) -> None:
    from diagnostic_msgs.msg import DiagnosticStatus

    patient = {'command_timeout': 60.0, 'give_up_after': 0.0, 'mode': mode, 'rate_hz': 200.0}
    actuator = start_node(ACTUATOR, **patient)
    controller = start_node(CONTROLLER, **PATIENT | {'mode': mode})
    diagnostics('asi_actuator', 'running')
    controller.kill()
    words = 'no answer to state' if mode == 'lockstep' else 'no valve_command for'
    assert diagnostics('asi_actuator', words).level == DiagnosticStatus.WARN
    actuator.wait_for(words)
    second = start_node(CONTROLLER, **PATIENT | {'mode': mode, 'state_timeout': 0.5})
    diagnostics('asi_controller', 'running')
    actuator.wait_for('running again')
    actuator.kill()
    assert diagnostics('asi_controller', 'no new state').level >= DiagnosticStatus.WARN
    second.wait_for('no new state')


def test_the_state_is_published_again_and_again(start_node: Callable, ros_node: Any) -> None:
    """An aggregator calls a status stale that came only once."""
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

    listener = Listener(ros_node, DiagnosticArray, '/diagnostics')
    start_node(ACTUATOR)
    for message in listener.wait(3):
        loop, state = message.status
        assert (loop.name, state.name) == ('asi_actuator: loop', 'asi_actuator: state')
        assert (state.message, state.level) == ('enabled', DiagnosticStatus.OK)
        assert message.header.stamp.sec > 0


def test_controller_says_that_the_actuator_is_gone_and_gives_no_command(
        start_node: Callable, ros_node: Any, diagnostics: Callable) -> None:
    from geometry_msgs.msg import WrenchStamped

    commands = Listener(ros_node, WrenchStamped, 'valve_command')
    actuator = start_node(ACTUATOR, mode='realtime', rate_hz=200.0)
    controller = start_node(CONTROLLER, **(PATIENT | {'state_timeout': 0.5}))
    commands.wait(10)
    actuator.kill()
    assert diagnostics('asi_controller', 'no new state: no command is given')
    wait_for_silence('the commands', commands.messages)
    start_node(ACTUATOR, mode='realtime', rate_hz=200.0)
    commands.wait(10)
    assert controller.stop() == 0


@pytest.mark.parametrize('begin', [0.1, 0.45, 0.7, 0.95])
@pytest.mark.parametrize('rate_hz', [500.0, 1000.0, 5000.0])
def test_ticks_of_the_controller_get_in_step_with_the_states(
        monkeypatch: pytest.MonkeyPatch, rate_hz: float, begin: float) -> None:
    """Whatever part of a period after the states they begin; the states jitter a little."""
    node = MagicMock(rate_hz=rate_hz)
    node.parameters.values = {'state_timeout': 1.0}
    loop = controller_node.RealTime(node)
    period_s = 1.0 / rate_hz
    node.create_timer.return_value.timer_period_ns = round(period_s * 1e9)
    jitter_s = 0.1 * period_s * np.random.default_rng(1).uniform(-1.0, 1.0, 400)
    states_s = 1000.0 + period_s * np.arange(400) + jitter_s
    tick_s, ages_s = 1000.0 + begin * period_s, []
    for state_s, next_s in zip(states_s[:-1], states_s[1:], strict=True):
        monkeypatch.setattr(controller_node.time, 'monotonic', lambda now_s=state_s: now_s)
        loop.on_state(loop.clock.now_ns(), 0.0, 0.0)
        while tick_s < next_s:
            if tick_s >= state_s:
                monkeypatch.setattr(controller_node.time, 'monotonic', lambda now_s=tick_s: now_s)
                loop._tick()
                ages_s.append(tick_s - state_s)
            tick_s += loop.timer.timer_period_ns * 1e-9
    wanted_s = min(controller_node.AFTER_STATE_S, 0.25 * period_s)
    assert abs(np.mean(ages_s[-100:]) - wanted_s) < 0.05 * period_s
    assert node.answer.call_count == len(ages_s)


def test_stray_state_of_another_clock_does_not_end_the_controller(
        start_node: Callable, ros_node: Any, states: Listener, diagnostics: Callable) -> None:
    from sensor_msgs.msg import JointState

    start_node(ACTUATOR, mode='realtime', rate_hz=200.0, command_timeout=60.0)
    controller = start_node(CONTROLLER, **PATIENT)
    diagnostics('asi_controller', 'running')
    stray = JointState(name=['piston', 'valve'], effort=[1e6, 0.0])
    stray.header.stamp.sec = 1
    publisher = ros_node.create_publisher(JointState, 'joint_states', 10)
    wait_until(lambda: publisher.get_subscription_count() > 1, 'the controller')
    publisher.publish(stray)
    wait_until(lambda: {v.key: v.value for v in diagnostics('asi_controller', 'running').values}[
        'states ignored'] == '1', 'the stray state to be counted')
    assert controller.stop() == 0
    assert not any(abs(state.effort[1]) > 10.0 for state in states.messages)


@pytest.mark.parametrize(('mode', 'number'), [
    ('lockstep', signal.SIGTERM), *(pytest.param(*each, marks=pytest.mark.slow) for each in (
        ('lockstep', signal.SIGINT), ('realtime', signal.SIGTERM),
        ('realtime', signal.SIGINT)))])   # this one ends nodes of other tests, too
def test_signal_ends_a_running_loop_with_exit_status_0(
        mode: str, number: signal.Signals, start_node: Callable, states: Listener) -> None:
    nodes: list[NodeProcess] = [start_node(module, mode=mode) for module in (ACTUATOR, CONTROLLER)]
    for node in nodes:
        node.wait_for(f'{mode} at')
    states.wait(50)
    for node in nodes:
        node.send(number)
    for node in nodes:
        assert node.exit_status() == 0, node.text
        assert 'Traceback' not in node.text


def test_reference_comes_from_the_topic_and_live_parameters_act(
        start_node: Callable, ros_node: Any, states: Listener, set_parameters: Callable) -> None:
    from geometry_msgs.msg import WrenchStamped

    start_node(ACTUATOR, mode='realtime', rate_hz=200.0, command_timeout=60.0)
    start_node(CONTROLLER, **PATIENT, gain=0.5, feedforward=0.0, reference_timeout=0.0)
    reference = WrenchStamped()
    reference.wrench.force.x = 100.0
    publisher = ros_node.create_publisher(WrenchStamped, 'force_reference', 10)
    wait_until(publisher.get_subscription_count, 'the controller')
    publisher.publish(reference)
    states.wait_until(lambda state: 10.0 < force(state), 'the reference')
    assert abs(states.wait(400)[-1].effort[1]) > 1.0
    # An offset of the sensor moves what is measured, not the piston.
    result, = set_parameters('asi_controller', {'gain': 0})
    assert result.successful
    result, = set_parameters('asi_controller', {'gain': 0.001})
    assert result.successful
    states.wait_until(lambda state: abs(state.effort[1]) < 1.0, 'the next gain')
    after = states.wait(400)[-1]
    result, = set_parameters('asi_actuator', {'force_sensor.offset': 50})
    assert result.successful
    moved = states.wait(100)[-1]
    assert force(moved) - force(after) == pytest.approx(50.0, abs=1.0)
    assert moved.position[0] == pytest.approx(after.position[0], abs=1e-6)


def test_services(start_node: Callable, states: Listener, call: Callable) -> None:
    from std_srvs.srv import SetBool, Trigger

    start_node(ACTUATOR, mode='realtime', rate_hz=200.0, command_timeout=60.0,
               **{'force_sensor.offset': 40.0, 'force_sensor.noise': 0.5})
    states.wait(100)
    answer = call(Trigger, '/asi_actuator/calibrate', Trigger.Request())
    assert answer.success, answer.message
    states.wait_until(lambda state: abs(force(state)) < 10.0, 'a calibrated state')
    assert abs(np.mean([force(state) for state in states.wait(80)])) < 1.0

    sine = {'reference.shape': 'sine', 'reference.frequency': 2.0, 'reference.start': 0.0}
    start_node(CONTROLLER, **PATIENT, **sine)
    states.wait_until(lambda state: abs(force(state)) > 30.0, 'the sine')
    states.wait(100)

    def refusal() -> str:
        answer = call(Trigger, '/asi_actuator/calibrate', Trigger.Request())
        return '' if answer.success else answer.message

    # While the controller stands still, the actuator may come to rest.
    assert re.match('refused: (.* moved |the valve is open)', wait_until(refusal, 'a refusal'))

    assert call(SetBool, '/asi_controller/enable', SetBool.Request(data=False)).success
    states.wait_until(lambda state: state.effort[1] == 0.0, 'the command to be 0')
    assert not any(state.effort[1] for state in states.wait(20))
    assert call(SetBool, '/asi_controller/enable', SetBool.Request(data=True)).success
    states.wait_until(lambda state: abs(force(state)) > 30.0, 'the sine again')

    assert call(SetBool, '/asi_actuator/pause', SetBool.Request(data=True)).success
    wait_for_silence('the states', states.messages)
    assert call(SetBool, '/asi_controller/enable', SetBool.Request(data=False)).success
    assert call(SetBool, '/asi_actuator/pause', SetBool.Request(data=False)).success
    states.wait_until(lambda state: state.effort[1] == 0.0, 'the command to be 0')
    assert states.messages[-1].position[0] != 0.0
    assert call(Trigger, '/asi_actuator/reset', Trigger.Request()).success
    states.wait_until(lambda state: state.position[0] == 0.0, 'the reset')


@pytest.mark.parametrize('mode', ['realtime', pytest.param('lockstep', marks=pytest.mark.slow)])
def test_a_reference_whose_publisher_is_silent_is_let_go(
        mode: str, start_node: Callable, ros_node: Any, states: Listener) -> None:
    from geometry_msgs.msg import WrenchStamped

    start_node(ACTUATOR, mode=mode, rate_hz=200.0, command_timeout=60.0)
    controller = start_node(CONTROLLER, **PATIENT | {'mode': mode}, gain=0.5,
                            reference_timeout=0.5)
    publisher = ros_node.create_publisher(WrenchStamped, 'force_reference', 10)
    reference = WrenchStamped()
    reference.wrench.force.x = 100.0

    def followed() -> bool:
        # Again and again: either node may be seconds later than the other.
        publisher.publish(reference)
        return bool(states.messages) and states.messages[-1].effort[1] > 50.0

    wait_until(followed, 'the reference')
    controller.wait_for('no force_reference for 0.5 s (reference_timeout): the desired force is '
                        '0 N, it was 100 N')
    # With the proportional compensator what is left is the gain times the measured force.
    states.wait_until(lambda state: abs(state.effort[1]) < 30.0, 'the reference at 0 N')
    wait_until(followed, 'the next reference')


def test_calibration_of_the_simulated_sensor_under_load_is_refused_and_a_reset_undoes_one(
        start_node: Callable, states: Listener, call: Callable, set_parameters: Callable) -> None:
    from std_srvs.srv import SetBool, Trigger

    def answer(name: str) -> Any:
        return call(Trigger, f'/asi_actuator/{name}', Trigger.Request())

    start_node(ACTUATOR, mode='realtime', rate_hz=200.0, command_timeout=60.0)
    start_node(CONTROLLER, **PATIENT, gain=0.5, **{
        'reference.shape': 'step', 'reference.amplitude': 150.0, 'reference.start': 0.0})
    states.wait_until(lambda state: force(state) > 100.0, 'the step')
    wait_until(lambda: 'the valve is open and presses with about 1' in answer('calibrate').message,
               'a refusal at rest under load')
    # Closed, the valve is held a little open by its hysteresis.
    assert call(SetBool, '/asi_controller/enable', SetBool.Request(data=False)).success
    states.wait_until(lambda state: abs(force(state)) < 50.0, 'the valve closed')
    wait_until(lambda: 'the valve is open' in answer('calibrate').message, 'a refusal')
    assert answer('reset').success
    set_parameters('asi_actuator', {'load.external_force': 30.0})
    wait_until(lambda: 'load.external_force = 30 N' in answer('calibrate').message, 'a refusal')
    set_parameters('asi_actuator', {'load.external_force': 0.0, 'force_sensor.offset': 40.0})
    wait_until(lambda: answer('calibrate').success, 'the calibration')
    states.wait_until(lambda state: abs(force(state)) < 5.0, 'a calibrated state')
    assert answer('reset').success
    states.wait_until(lambda state: abs(force(state) - 40.0) < 5.0, 'the sensor as it was')


def test_diagnostics_say_how_the_loop_does(
        start_node: Callable, states: Listener, diagnostics: Callable) -> None:
    start_node(ACTUATOR)
    start_node(CONTROLLER, compensator='lead2')
    states.wait(500)
    actuator = {v.key: v.value for v in diagnostics('asi_actuator', 'running').values}
    controller = {v.key: v.value for v in diagnostics('asi_controller', 'running').values}
    for values in (actuator, controller):
        assert values['mode'] == 'lockstep' and values['rate (Hz)'] == '5000'
        assert int(values['ticks']) > 0 and float(values['period mean (ms)']) > 0.0
        assert float(values['period jitter p99 (ms)']) > 0.0
        assert float(values['saturation share']) == 0.0
    assert float(actuator['latency mean (ms)']) > 0.0
    assert {'resent', 'commands ignored'} <= set(actuator)
    assert controller['compensator'] == 'lead2' and 'states ignored' in controller



def test_time_goes_on_evenly_when_the_system_clock_is_set(
        monkeypatch: pytest.MonkeyPatch) -> None:
    """The nodes themselves: `python -m torture clocks`."""
    clock = SteadyClock()
    before_ns = clock.now_ns()
    real = time.time_ns
    monkeypatch.setattr(time, 'time_ns', lambda: real() - 7200 * 10**9)
    assert 0 <= clock.now_ns() - before_ns < 3600 * 10**9


def policies(node: NodeProcess) -> set[tuple[int, int]]:
    """Return the scheduling policy and the priority of the threads of a node."""
    found = set()
    for thread in map(int, os.listdir(f'/proc/{node.pid}/task')):
        with contextlib.suppress(ProcessLookupError):   # it has ended
            found.add((os.sched_getscheduler(thread), os.sched_getparam(thread).sched_priority))
    return found


def without_permission() -> None:
    """Take from this process the capability and the limit by which it may have a priority."""
    resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
    ctypes.CDLL(None).prctl(24, 23)   # PR_CAPBSET_DROP, CAP_SYS_NICE


@pytest.mark.skipif(sys.platform != 'linux', reason='needs /proc')
def test_in_real_time_every_thread_has_the_priority_that_is_permitted(
        start_node: Callable[..., NodeProcess], ros_environment: dict[str, str],
        tmp_path: Path) -> None:
    node = start_node(CONTROLLER, mode='realtime', thread_priority=7)
    node.wait_for('real-time priority')
    if 'no real-time priority' not in node.text:
        wait_until(lambda: policies(node) == {(os.SCHED_FIFO, 7)}, 'the priority',
                   lambda: f'{policies(node)}\n{node.text}')
    refused = NodeProcess(
        [sys.executable, '-m', CONTROLLER, '--ros-args', '-p', 'mode:=realtime'],
        ros_environment, tmp_path / 'refused.log', without_permission)
    refused.wait_for('no real-time priority (thread_priority = 50): [Errno 1]')
    lockstep = start_node(CONTROLLER)
    lockstep.wait_for('lockstep at')
    for other in (refused, lockstep):
        assert policies(other) == {(os.SCHED_OTHER, 0)}
        assert other.stop() == 0
    assert 'priority' not in lockstep.text


def test_a_reset_that_is_refused_is_logged_and_ends_nothing(
        start_node: Callable, states: Listener, call: Callable, tmp_path: Path) -> None:
    from std_srvs.srv import Trigger

    file = tmp_path / 'calibration.yaml'
    node = start_node(ACTUATOR, mode='realtime', rate_hz=200.0, calibration_file=str(file))
    states.wait(10)
    file.write_text('offset_n: much')   # by somebody else, while the node runs
    answer = call(Trigger, '/asi_actuator/reset', Trigger.Request())
    assert not answer.success and str(file) in answer.message
    node.wait_for('~/reset refused: calibration_file')
    states.wait(50)
    assert node.stop() == 0 and 'Traceback' not in node.text
