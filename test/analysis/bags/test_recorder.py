"""The recorder against publishers in other processes: nothing lost, nothing changed."""

import hashlib
import json
import math
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from conftest import Listener, NodeProcess, wait_for_silence, wait_until
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosbags.rosbag2 import Reader
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool

from asi_analysis.bags.bag import read_bag, write_bag
from asi_analysis.bags.bag_file import read_contents
from asi_analysis.bags.nodes import recorder_node
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError, InputWarning
from asi_analysis.measures.analysis import analyze

RECORDER = 'asi_analysis.bags.nodes.recorder_node'
# The topics of a loop.
LOOP = ('/joint_states', '/force', '/valve_position', '/velocity', '/force_reference',
        '/valve_command', '/clock')
ACTUATOR, CONTROLLER = 'asi_actuator.actuator_node', 'asi_controller.controller_node'
REPLAY = 'asi_analysis.bags.nodes.replay_node'
# Period of lock-step by default.
TICK_NS = 200_000

Start = Callable[..., NodeProcess]
Call = Callable[[type, str, Any], Any]


def a_bag(path: Path, count: int, rate_hz: float) -> Run:
    rng = np.random.default_rng(4)
    columns: dict[str, Any] = {field: rng.normal(size=count) for field in (
        'reference_n', 'command_n', 'force_n', 'valve_position_m', 'position_m', 'velocity_m_s')}
    run = Run(np.arange(count) / rate_hz, **columns)
    write_bag(run, path)
    return run


def record_replay(start: Start, call: Call, bag: Path, **options: object
                  ) -> tuple[NodeProcess, NodeProcess]:
    """Start a recorder, and the replay of a bag that begins when the recorder hears it."""
    recorder = start(RECORDER, **options)
    recorder.wait_for('recording to')
    replay = start(REPLAY, bag=bag, start_paused=True, await_recorder=True, delay=0.0)
    assert call(SetBool, '/asi_replay/pause', SetBool.Request(data=False)).success
    return recorder, replay


def recorded(topic: str, bag: Path) -> int:
    """Return how many messages of a topic a bag holds that is being written."""
    return counts(bag).get(topic, 0)


def counts(bag: Path) -> dict[str, int]:
    """Return how many messages of each topic a bag holds that is being written, after a pause."""
    time.sleep(0.1)   # a look takes longer than the processes need that it waits for
    try:
        topics = read_contents(bag, lambda _: True).topics
    except InputError:  # nothing is written yet
        return {}
    return {name: len(topic.data) for name, topic in topics.items()}


def digest(bag: Path) -> str:
    return hashlib.sha256(next(bag.glob('*.mcap')).read_bytes()).hexdigest()


def test_records_every_byte_and_twice_the_same(start_node: Start, call: Call, tmp_path: Path
                                               ) -> None:
    run = a_bag(tmp_path / 'played', 3000, 2000.0)
    configuration = tmp_path / 'run.json'
    configuration.write_text(json.dumps({'seed': 5, 'actuator': {'load.type': 'locked'}}))
    for name in ('one', 'two'):
        recorder, replay = record_replay(start_node, call, tmp_path / 'played',
                                         output=tmp_path / name, configuration=configuration)
        assert replay.exit_status() == 0
        assert recorder.stop() == 0, recorder.text
        assert 'lost' not in recorder.text
    played = read_contents(tmp_path / 'played', lambda _: True)
    recorded = read_contents(tmp_path / 'one', lambda _: True)
    assert recorded.information == {'seed': 5, 'actuator': {'load.type': 'locked'}}
    for name, topic in played.topics.items():
        assert recorded.topics[name].data == topic.data
        assert recorded.topics[name].log_ns == topic.log_ns
    np.testing.assert_array_equal(read_bag(tmp_path / 'one').force_n, run.force_n)
    assert digest(tmp_path / 'one') == digest(tmp_path / 'two')
    metadata = yaml.safe_load((tmp_path / 'one/metadata.yaml').read_text())
    offered = metadata['rosbag2_bagfile_information']['topics_with_message_count'][0][
        'topic_metadata']['offered_qos_profiles']
    assert [profile['reliability'] for profile in offered] == ['reliable']


@pytest.mark.slow
def test_the_same_experiment_gives_the_same_file(ros_environment: dict[str, str], tmp_path: Path
                                                 ) -> None:
    for name in ('one', 'two'):
        subprocess.run([sys.executable, '-m', 'asi_analysis.cli', 'run', '--step', '200',
                        '--duration', '0.3', '--out', str(tmp_path / name)],
                       env=ros_environment, check=True, capture_output=True)
    assert digest(tmp_path / 'one/bag') == digest(tmp_path / 'two/bag')
    assert len(read_bag(tmp_path / 'one/bag')) == 1500


@pytest.mark.parametrize('names', [
    ('one',), pytest.param(('one', 'two'), marks=pytest.mark.slow)])
def test_a_fault_in_lockstep_is_in_the_bag_with_its_time_and_reason(  # twice: the same
        names: tuple[str, ...], start_node: Start, tmp_path: Path) -> None:
    configuration = tmp_path / 'run.json'
    configuration.write_text('{}')
    for name in names:
        recorder = start_node(RECORDER, output=tmp_path / name, configuration=configuration)
        controller = start_node(CONTROLLER, await_recorder=True,
                                **{'reference.shape': 'step', 'reference.amplitude': 400.0,
                                   'reference.start': 0.01})
        actuator = start_node(ACTUATOR, await_recorder=True, duration=0.05,
                              **{'limit.force': 150.0})
        assert actuator.exit_status() == 1
        assert recorder.stop() == 0 == controller.stop()
    for again in names[1:]:
        assert digest(tmp_path / again) == digest(tmp_path / 'one')
    run = read_bag(tmp_path / 'one')
    assert run.force_n is not None
    begin, fault = run.states
    assert begin == (0.0, 'enabled', '')
    first = int(np.argmax(np.abs(run.force_n) > 150.0))
    assert fault.time_s == run.time_s[first] and fault.state == 'fault'
    assert fault.reason == (f'force = {run.force_n[first]:.6g} N exceeds limit.force = 150 N')
    assert analyze(run)['notes'][0].startswith(f'fault at {fault.time_s:.6g} s')


def test_a_killed_recorder_loses_less_than_a_second(
        start_node: Start, call: Call, ros_node: Any, tmp_path: Path) -> None:
    """At a low rate, where a chunk takes long to fill; once it has taken what has come."""
    run = a_bag(tmp_path / 'played', 6000, 100.0)
    forces = Listener(ros_node, WrenchStamped, '/force')
    recorder, replay = record_replay(start_node, call, tmp_path / 'played',
                                     output=tmp_path / 'bag')
    forces.wait(250)
    assert call(SetBool, '/asi_replay/pause', SetBool.Request(data=True)).success
    wait_for_silence('the replay', forces.messages)
    last = forces.messages[-1].header.stamp

    def all_but_a_second_is_there() -> bool:
        try:
            with pytest.warns(InputWarning):
                # The first stamp is one period, the first time 0.
                return read_bag(tmp_path / 'bag').time_s[-1] > (
                    last.sec + last.nanosec * 1e-9 - 0.01 - 1.0)
        except InputError:  # nothing is written yet
            return False

    wait_until(all_but_a_second_is_there, 'all but a second on the disk')
    recorder.kill()
    replay.stop()
    with pytest.warns(InputWarning, match='was not ended properly'):
        part = read_bag(tmp_path / 'bag')
    np.testing.assert_array_equal(part.force_n, run[:len(part)].force_n)


def test_a_full_disk_ends_the_recording_but_keeps_what_is_there(
        start_node: Start, tmp_path: Path) -> None:
    a_bag(tmp_path / 'played', 12000, 4000.0)
    recorder = start_node(RECORDER, output=tmp_path / 'bag')
    recorder.wait_for('recording to')
    resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (200_000, 200_000))
    replay = start_node(REPLAY, bag=tmp_path / 'played')
    assert recorder.exit_status() == 1
    assert 'cannot be written any more: File too large; the part that is' in recorder.text
    assert 'Traceback' not in recorder.text
    replay.stop()
    with pytest.warns(InputWarning):
        assert len(read_bag(tmp_path / 'bag')) > 100


def test_real_time_hears_best_effort_publishers_and_logs_the_receipt(
        start_node: Start, ros_node: Any, tmp_path: Path) -> None:
    publisher = ros_node.create_publisher(
        WrenchStamped, 'force', QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT))
    recorder = start_node(RECORDER, output=tmp_path / 'bag', topics='[force, /extra]')
    extra = ros_node.create_publisher(WrenchStamped, '/extra', 10)

    # One that asks for more than best effort is no match.
    wait_until(lambda: publisher.get_subscription_count() and extra.get_subscription_count(),
               'a subscription that takes best effort')
    message = WrenchStamped()
    for k in range(20):
        message.header.stamp = ros_node.get_clock().now().to_msg()
        message.wrench.force.x = float(k)
        publisher.publish(message)
        extra.publish(message)
        time.sleep(0.01)
    # Nothing acknowledges them; what comes after them takes them to the disk.
    wait_until(lambda: extra.publish(message) or recorded('/force', tmp_path / 'bag') == 20,
               'all in the bag')
    assert recorder.stop() == 0
    contents = read_contents(tmp_path / 'bag', lambda _: True)
    assert set(contents.topics) == {'/force', '/extra'}
    assert read_bag(tmp_path / 'bag').signals()['force'].tolist() == [float(k) for k in range(20)]
    now_ns = time.time_ns()
    assert all(now_ns - 60 * 10**9 < time_ns < now_ns for time_ns in
               contents.topics['/force'].log_ns)


def test_standing_still_is_no_silence(
        ros_node: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What comes with the second look is there, though the machine stood still until the first."""
    monkeypatch.chdir(tmp_path)
    recorder = recorder_node.Recorder()
    publisher = ros_node.create_publisher(WrenchStamped, 'force', 10)
    wait_until(publisher.get_subscription_count, 'the recorder')
    stood_still_s = 0.0
    looks = iter([lambda: None, lambda: publisher.publish(WrenchStamped())])

    def sleep(seconds: float) -> None:
        nonlocal stood_still_s
        stood_still_s += 1.0
        time.sleep(seconds)
        next(looks, lambda: None)()

    monkeypatch.setattr(recorder_node, 'time', SimpleNamespace(
        monotonic=lambda: time.monotonic() + stood_still_s, sleep=sleep, time_ns=time.time_ns))
    recorder.destroy_node()
    bag, = tmp_path.iterdir()
    with Reader(bag) as reader:
        assert reader.message_count == 1


def test_what_waits_for_the_first_tick_keeps_no_recorder_from_ending(
        ros_node: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(recorder_node, 'LAST_TICK_S', math.inf)
    recorder = recorder_node.Recorder()
    publisher = ros_node.create_publisher(DiagnosticArray, '/diagnostics', 10)
    wait_until(publisher.get_subscription_count, 'the recorder')
    publisher.publish(DiagnosticArray())
    wait_until(lambda: recorder._drain() or recorder._arrived, 'the message')
    looks = iter(range(1000))

    def sleep(seconds: float) -> None:
        next(looks)
        time.sleep(seconds)

    monkeypatch.setattr(recorder_node, 'time', SimpleNamespace(
        monotonic=time.monotonic, sleep=sleep, time_ns=time.time_ns))
    recorder.destroy_node()
    bag, = tmp_path.iterdir()
    with Reader(bag) as reader:
        assert reader.message_count == 1


def test_ends_beside_a_running_lock_step_with_a_whole_tick(start_node: Start, tmp_path: Path
                                                           ) -> None:
    recorder = start_node(RECORDER, output=tmp_path / 'bag')
    loop = [start_node(CONTROLLER, await_recorder=True, **{'reference.shape': 'sine'}),
            start_node(ACTUATOR, await_recorder=True)]
    wait_until(lambda: recorded('/force', tmp_path / 'bag') > 500, 'a part of the run')
    assert recorder.stop() == 0, recorder.text
    assert 'lost' not in recorder.text
    topics = read_contents(tmp_path / 'bag', lambda name: name != '/diagnostics').topics
    count, = {len(topic.data) for topic in topics.values()}
    assert len(topics) == 7 and len(read_bag(tmp_path / 'bag')) == count > 500
    assert [node.stop() for node in loop] == [0, 0]


def test_started_late_and_stopped_early_beside_a_running_lock_step_it_misses_nothing_between(
        start_node: Start, states: Listener, tmp_path: Path) -> None:
    loop = [start_node(CONTROLLER, **{'reference.shape': 'sine'}),
            start_node(ACTUATOR, real_time_factor=0.2)]
    states.wait(50)
    recorder = start_node(RECORDER, output=tmp_path / 'bag')
    # Topics are discovered one after another.
    wait_until(lambda: (found := counts(tmp_path / 'bag')) and all(
        found.get(topic, 0) > 100 for topic in LOOP), 'a part of the run')
    assert recorder.stop() == 0, recorder.text
    assert 'lost' not in recorder.text
    assert [node.stop() for node in loop] == [0, 0]
    topics = read_contents(tmp_path / 'bag', lambda name: name != '/diagnostics').topics
    assert len(topics) == 7
    ends = set()
    for topic in topics.values():
        first_ns, *_, last_ns = topic.log_ns
        assert first_ns > 50 * TICK_NS
        assert len(topic.log_ns) == (last_ns - first_ns) // TICK_NS + 1
        ends.add(last_ns)
    assert len(ends) == 1
    # Topics are discovered one after another, so one may begin later than the others.
    with pytest.warns(InputWarning, match=r'\d+ states were published before the recording'):
        first, *others = read_bag(tmp_path / 'bag').problems
    assert 'before the recording' in first and all('the first ' in each for each in others)


def test_waits_for_no_answer_that_nobody_is_left_to_give(
        start_node: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ros_node: Any) -> None:
    """As after Ctrl-C on a launch file; without a limit to the wait, so that it would not end."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(recorder_node, 'LAST_TICK_S', math.inf)
    recorder = recorder_node.Recorder()
    loop = [start_node(module, await_recorder=True) for module in (CONTROLLER, ACTUATOR)]
    wait_until(lambda: recorder._record() or recorder._writer.counts().get('/force', 0) > 50,
               'a part of the run')
    for node in loop:
        assert node.stop() == 0
    recorder.destroy_node()
    bag, = (path for path in tmp_path.iterdir() if path.is_dir())
    run = read_bag(bag)
    assert run.force_n is not None and len(run) > 50


@pytest.mark.parametrize('runs_on', [True, pytest.param(False, marks=pytest.mark.slow)])
def test_ctrl_c_behind_a_backlog_waits_for_what_ends_not_for_a_loop_that_runs_on(
        start_node: Start, states: Listener, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
        capfd: pytest.CaptureFixture[str], runs_on: bool) -> None:
    """As on a machine that is too busy; without time left for the backlog."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(recorder_node, 'MOST_TAKEN', 10)
    monkeypatch.setattr(recorder_node, 'BACKLOG_S', 0.0)
    recorder = recorder_node.Recorder()
    loop = [start_node(module, await_recorder=True, **options) for module, options in (
        (CONTROLLER, {'reference.shape': 'sine'}), (ACTUATOR, {'real_time_factor': 0.1}))]
    wait_until(lambda: recorder._record() or recorder._writer.counts().get('/force', 0) > 50,
               'a part of the run')
    states.wait(200)
    if not runs_on:
        assert [node.stop() for node in loop] == [0, 0]
        wait_until(lambda: not recorder.count_publishers('joint_states'), 'the end of the loop')
    recorder.destroy_node()
    said = capfd.readouterr().err
    assert ('s before it was stopped: this machine was too busy' in said) == runs_on
    assert 'lost' not in said
    bag, = (path for path in tmp_path.iterdir() if path.is_dir())
    topics = read_contents(bag, lambda name: name != '/diagnostics').topics
    times = topics['/force'].log_ns
    assert times == [TICK_NS * (1 + tick) for tick in range(len(times))]
    if runs_on:
        assert {tuple(topic.log_ns) for topic in topics.values()} == {tuple(times)}
        assert [node.stop() for node in loop] == [0, 0]
    else:
        newest = states.messages[-1].header.stamp
        assert times[-1] == newest.sec * 10**9 + newest.nanosec


def test_a_run_that_ends_waits_for_a_recorder_that_stands_still(
        start_node: Start, call: Call, tmp_path: Path) -> None:
    a_bag(tmp_path / 'bag', 5000, 1000.0)
    recorder, replay = record_replay(start_node, call, tmp_path / 'bag', output=tmp_path / 'again')
    # Stopped before it has subscribed, it could not be waited for.
    wait_until(lambda: recorded('/force', tmp_path / 'again') > 0, 'the first message in the bag')
    recorder.send(signal.SIGSTOP)
    try:
        replay.wait_for('published all')
        time.sleep(3.0)   # longer than a node waits after Ctrl-C
    finally:
        recorder.send(signal.SIGCONT)
    assert replay.exit_status() == 0
    assert recorder.stop() == 0, recorder.text
    topics = read_contents(tmp_path / 'again', lambda _: True).topics
    assert {len(topic.data) for topic in topics.values()} == {5000}


def test_lost_messages_are_told_and_the_exit_status_is_1(
        start_node: Start, ros_node: Any, tmp_path: Path) -> None:
    recorder = start_node(RECORDER, output=tmp_path / 'bag', topics='[force]')
    # Keeps one message only, so a recorder that stands still misses most.
    publisher = ros_node.create_publisher(WrenchStamped, 'force', 1)
    wait_until(publisher.get_subscription_count, 'the recorder')
    message = WrenchStamped()
    message.header.frame_id = 'x' * 10_000

    def publish(count: int) -> None:
        for _ in range(count):
            message.header.stamp = ros_node.get_clock().now().to_msg()
            publisher.publish(message)

    def is_recorded_since(time_ns: int) -> bool:
        publish(1)
        try:
            topics = read_contents(tmp_path / 'bag', lambda _: True).topics
        except InputError:  # nothing is written yet
            return False
        return any(max(topic.log_ns) > time_ns for topic in topics.values())

    wait_until(lambda: is_recorded_since(0), 'the first message in the bag')
    recorder.send(signal.SIGSTOP)
    publish(10_000)
    recorder.send(signal.SIGCONT)
    for _ in range(2):   # the second is heard after what was told of the first
        wait_until(partial(is_recorded_since, time.time_ns()), 'a later message in the bag')
    assert recorder.stop() == 1
    assert 'messages of /force were lost' in recorder.text and 'Traceback' not in recorder.text
    assert len(read_bag(tmp_path / 'bag')) > 1


def test_asks_the_nodes_for_their_parameters(start_node: Start, tmp_path: Path) -> None:
    start_node(CONTROLLER, gain=4.5).wait_for('lockstep at')
    recorder = start_node(RECORDER, output=tmp_path / 'bag')
    file = tmp_path / 'bag/bag_0.mcap'
    wait_until(lambda: file.exists() and b'asi.run' in file.read_bytes(),
               'the parameters of the controller in the bag')
    assert recorder.stop() == 0
    assert 'the parameters of' not in recorder.text
    controller = read_contents(tmp_path / 'bag', lambda _: True).information['controller']
    assert controller['gain'] == 4.5
    assert controller['compensator'] == 'proportional'


def test_parameters_that_were_not_reported_in_time_are_told(
        ros_node: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
        capfd: pytest.CaptureFixture[str]) -> None:
    """As of a recorder that was stopped soon after its start."""
    monkeypatch.chdir(tmp_path)
    recorder = recorder_node.Recorder()
    publisher = ros_node.create_publisher(WrenchStamped, 'force', 10)
    idle = ros_node.create_publisher(JointState, 'joint_states', 10)
    for each in (publisher, idle):
        wait_until(each.get_subscription_count, 'the recorder')
    wait_until(lambda: recorder.count_publishers('joint_states'), 'its publisher')
    publisher.publish(WrenchStamped())
    wait_until(lambda: recorder._drain() or recorder._arrived, 'the message')
    recorder.destroy_node()
    said = capfd.readouterr().err
    assert 'the parameters of asi_actuator are not in the bag' in said
    assert 'the parameters of asi_controller' not in said   # none of its topics is
    assert 'nothing came on /joint_states, although there is a publisher' in said
    assert ('nothing came on /valve_position, /velocity, /valve_command, '
            'no publisher is there now: was it remapped?') in said


@pytest.mark.parametrize(('options', 'reason'), [
    ({'output': '.'}, 'exists already: a bag is never written over'),
    ({'configuration': '/absent.json', 'output': 'bag'},
     "configuration = '/absent.json' cannot be used"),
    pytest.param({'topics': "['a b']", 'output': 'bag'}, 'Invalid topic name',
                 marks=pytest.mark.slow),
    pytest.param({'outptu': 'bag'}, 'outptu is not a parameter: did you mean output?',
                 marks=pytest.mark.slow)])
def test_refuses_bad_parameters(start_node: Start, tmp_path: Path, options: dict[str, str],
                                reason: str) -> None:
    options = {name: str(tmp_path / value) if name == 'output' else value
               for name, value in options.items()}
    recorder = start_node(RECORDER, **options)
    assert recorder.exit_status() == 2
    assert reason in recorder.text
    assert len(recorder.text.splitlines()) <= 2
    assert not (tmp_path / 'bag').exists()


def test_ends_cleanly_by_sigterm_with_nothing_recorded(start_node: Start, tmp_path: Path) -> None:
    # The mode is what a file for all nodes gives.
    recorder = start_node(RECORDER, output=tmp_path / 'bag', mode='realtime', use_sim_time=True)
    recorder.wait_for('recording to')
    recorder.send(signal.SIGTERM)
    assert recorder.exit_status() == 0
    with Reader(tmp_path / 'bag') as reader:
        assert reader.message_count == 0
