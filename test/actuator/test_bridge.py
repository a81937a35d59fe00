"""The bridge: frames, what a firmware does, and the node over a real slcan link and real DDS."""

import json
import re
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import cantools
import numpy as np
import pytest
from conftest import Listener, NodeProcess, wait_for_silence, wait_until
from hypothesis import given
from hypothesis import strategies as st

from asi_actuator.can_actuator import Firmware, physical_values
from asi_actuator.driver import frames as frames_module
from asi_actuator.driver.can_bus import CanActuator, close_bus, open_bus, received
from asi_actuator.driver.frames import COUNTER, SIGNALS, Frames, checksum, longest_bits
from asi_actuator.driver.pseudo_terminals import LinkedTerminals
from asi_actuator.model.actuator import Measurement
from asi_actuator.node_parameters import ACTUATOR_NODE_PARAMETERS
from asi_actuator.parameters import as_record
from asi_analysis.bags.bag import write_bag
from asi_analysis.bags.run import Run
from asi_common.files import shipped
from asi_common.node.topics import nanoseconds
from asi_common.parameter import ParameterError, completed
from torture.watchdogs import WATCHDOGS, Bench, periods_until_shut, shut_when_the_bus_returns

ACTUATOR, CONTROLLER = 'asi_actuator.actuator_node', 'asi_controller.controller_node'
PEER = 'asi_actuator.can_actuator'
FRAMES = Frames()
COMMAND = FRAMES.identifiers['COMMAND']
MULTICAST = '239.74.163.2'
# A busy machine is no fault of the bridge.
SLOW: dict[str, Any] = {'mode': 'realtime', 'rate_hz': 200.0}
PATIENT: dict[str, Any] = SLOW | {'driver': 'can', 'can.interface': 'slcan',
                                  'limit.state_age': 60.0, 'command_timeout': 60.0,
                                  'limit.lost_states': 10**6, 'limit.bad_frames': 10**6}


def test_checksum_is_crc_8_sae_j1850() -> None:
    # The catalogue's check value (reveng: CRC-8/SAE-J1850, 0x4B) is that of b'123456789'.
    assert checksum(0x3231, b'3456789') == 0x4B


@given(st.sampled_from(sorted(SIGNALS)), st.data())
def test_frame_tells_what_was_put_in_within_its_resolution(name: str, data: st.DataObject) -> None:
    signals = {s.name: s for s in FRAMES.messages[name].signals if s.name != 'checksum'}
    values = {key: data.draw(st.floats(s.minimum, s.maximum)) if s.scale < 1
              else data.draw(st.integers(int(s.minimum), int(s.maximum)))
              for key, s in signals.items()}
    encoded = FRAMES.encode(name, values)
    decoded = FRAMES.decode(FRAMES.identifiers[name], encoded)
    assert decoded is not None and decoded[0] == name
    for key, s in signals.items():
        assert abs(decoded[1][key] - values[key]) <= 0.5001 * s.scale
    # Beyond its range a signal is at its end, not wrapped around.
    far = FRAMES.decode(FRAMES.identifiers[name], FRAMES.encode(
        name, values | {key: 1e9 for key, s in signals.items() if s.scale < 1}))
    assert far is not None
    assert all(far[1][key] == pytest.approx(s.maximum) for key, s in signals.items()
               if s.scale < 1)


def test_number_beyond_the_bits_of_a_signal_is_at_their_end(tmp_path: Path) -> None:
    file = tmp_path / 'no_ranges.dbc'
    file.write_text(re.sub(r'\[[-+.E0-9]*\|[-+.E0-9]*\]', '[0|0]',
                           shipped(frames_module.FILE).read_text()))
    frames = Frames(str(file))
    for force, bits in ((1e9, 2**23 - 1), (-1e9, -2**23)):
        decoded = frames.decode(257, frames.encode('STATE_FORCE', {'force': force}))
        assert decoded is not None and decoded[1]['force'] == pytest.approx(1e-3 * bits)


@given(st.sampled_from(sorted(SIGNALS)), st.data())
def test_changed_bits_are_noticed(name: str, data: st.DataObject) -> None:
    identifier = FRAMES.identifiers[name]
    good = FRAMES.encode(name, dict.fromkeys(SIGNALS[name] - {'checksum'}, 1))
    # Any one bit, and any burst of up to 8.
    burst = data.draw(st.integers(1, 255)) << data.draw(st.integers(0, 8 * len(good) - 8))
    bad = (int.from_bytes(good, 'big') ^ burst).to_bytes(len(good), 'big')
    with pytest.raises(ValueError, match=f'{name} has a wrong checksum'):
        FRAMES.decode(identifier, bad)
    with pytest.raises(ValueError, match=rf'{name} has {len(good) - 1} bytes'):
        FRAMES.decode(identifier, good[:-1])
    assert FRAMES.decode(0x7FF, good) is None


def test_longest_frame_is_that_of_the_literature() -> None:
    # Davis et al. 2007: 135 bits for 8 bytes, 55 + 10 s in general.
    assert [longest_bits(n) for n in range(9)] == [55 + 10 * n for n in range(9)]


def test_layout_that_cannot_be_used_is_refused(tmp_path: Path) -> None:
    broken = tmp_path / 'broken.dbc'
    broken.write_text('BO_ not a database')
    poor = tmp_path / 'poor.dbc'
    own = shipped(frames_module.FILE).read_text()
    poor.write_text(own.replace('SG_ velocity', 'SG_ speed'))
    for number, (old, new, words) in enumerate((
            ('"N" BRIDGE', '"kN" BRIDGE', 'STATE_FORCE: force is in kN, it takes N'),
            ('"m" BRIDGE', '"mm" BRIDGE', 'STATE_FORCE: valve_position is in mm, it takes m'),
            ('"m/s" BRIDGE', '"" BRIDGE', 'STATE_MOTION: velocity is in no unit, it takes m/s'),
            ('counter : 48|8@1+', 'counter : 48|4@1+', 'counter takes 8 bits'),
            ('checksum : 56|8@1+', 'checksum : 56|4@1+', 'checksum takes 8 bits'),
            ('BO_ 257 ', 'BO_ 2147483905 ', 'STATE_FORCE: it takes an 11-bit identifier'),
            ('BO_ 256 COMMAND: 6', 'BO_ 256 COMMAND: 8', 'checksum must be the last byte'))):
        path = tmp_path / f'{number}.dbc'
        path.write_text(own.replace(old, new))
        with pytest.raises(ParameterError, match=words):
            Frames(str(path))
    for path, words in ((broken, 'cannot be read'), (tmp_path / 'no.dbc', 'cannot be read'),
                        (poor, 'STATE_MOTION lacks the signals velocity')):
        with pytest.raises(ParameterError, match=words) as caught:
            Frames(str(path))
        assert str(path) in str(caught.value) and '\n' not in str(caught.value)


class Wire:
    """A firmware, and a bridge's side of it that sends commands."""

    def __init__(self) -> None:
        self.now = 0.0
        self.counter = 0
        self.firmware = Firmware(FRAMES, physical_values([]), 0.02, self.now)

    def frame(self, command_n: float, enable: bool, skip: int = 0) -> bytes:
        self.counter = (self.counter + 1 + skip) % 256
        return FRAMES.encode('COMMAND', {'valve_command': command_n, 'enable': enable,
                                         'counter': self.counter})

    def send(self, data: bytes, after_s: float = 0.001) -> bool:
        self.now += after_s
        return self.firmware.receive(self.now, COMMAND, data)

    def state(self) -> dict[str, float]:
        merged: dict[str, float] = {}
        for identifier, data in self.firmware.state(self.now):
            decoded = FRAMES.decode(identifier, data)
            assert decoded is not None
            merged |= decoded[1]
        return merged


@pytest.fixture
def wire() -> Wire:
    return Wire()


def test_firmware_drives_the_valve_only_after_a_command_that_does_not(wire: Wire) -> None:
    for _ in range(300):
        assert wire.send(wire.frame(500.0, enable=True))
    assert wire.state()['enabled'] == 0 and wire.state()['valve_position'] == 0.0
    wire.send(wire.frame(0.0, enable=False))
    for _ in range(300):
        assert wire.send(wire.frame(500.0, enable=True))
    assert wire.state()['enabled'] == 1
    # Gain * (command - half width of the hysteresis), of the maximum force at full opening.
    p = as_record()
    opening = p['valve_characteristic_gain'] * (
        500.0 - p['valve_hysteresis_radius']) / p['valve_characteristic_maximum_force']
    assert wire.state()['valve_position'] == pytest.approx(opening * 2e-5, rel=0.02)
    assert wire.state()['counter'] == wire.counter


def test_firmware_closes_the_valve_when_commands_stop_and_keeps_it_closed(wire: Wire) -> None:
    wire.send(wire.frame(0.0, enable=False))
    wire.send(wire.frame(500.0, enable=True))
    wire.now += 0.0199
    assert not wire.firmware.watch(wire.now) and wire.firmware.driving
    wire.now += 0.0002
    assert wire.firmware.watch(wire.now) and not wire.firmware.driving
    assert wire.state()['command_lost'] == 1
    assert wire.send(wire.frame(500.0, enable=True)) and not wire.firmware.driving
    wire.send(wire.frame(0.0, enable=False))
    wire.send(wire.frame(500.0, enable=True))
    assert wire.firmware.driving and wire.state()['command_lost'] == 0


def test_firmware_takes_no_frame_twice_nor_from_the_past_nor_damaged(wire: Wire) -> None:
    old = wire.frame(0.0, enable=False)
    assert wire.send(old)
    new = wire.frame(500.0, enable=True)
    assert wire.send(new)
    for bad in (new, old, new[:-1], bytes(6), new[:-1] + bytes((new[-1] ^ 1,))):
        assert not wire.send(bad)
    assert wire.firmware.driving
    assert wire.send(wire.frame(500.0, enable=True, skip=3))
    # Frames that it does not take are no commands: the valve closes.
    for _ in range(25):
        wire.send(old)
        wire.firmware.watch(wire.now)
    assert not wire.firmware.driving


class Bus:
    """The driver and a firmware on a bus within this process; time passes when it is told to."""

    def __init__(self) -> None:
        values = completed({'mode': 'realtime', 'driver': 'can', 'can.interface': 'virtual',
                            'can.channel': 'test'}, ACTUATOR_NODE_PARAMETERS)
        self.driver = CanActuator(values, 1e-3)
        self.driver.open()
        self.bus = can.Bus(interface='virtual', channel='test')
        self.firmware = Firmware(FRAMES, physical_values([]), 0.02, 0.0)
        self.now = 0.0

    def answers(self, command_n: float = 0.0, enable: bool = False) -> list[can.Message]:
        """Have the driver send a command; return how the firmware answers."""
        self.driver.exchange(command_n, enable, 1)
        return self.frames()

    def frames(self) -> list[can.Message]:
        self.now += 0.001
        taken = [self.firmware.receive(self.now, m.arbitration_id, bytes(m.data))
                 for m in received(self.bus)]
        return [can.Message(arbitration_id=identifier, data=data, is_extended_id=False)
                for identifier, data in self.firmware.state(self.now)] if any(taken) else []

    def take(self, frames: list[can.Message]) -> Measurement | None:
        """Put frames on the bus and return the state that the driver makes of them."""
        for frame in frames:
            self.bus.send(frame)
        return self.driver.exchange(0.0, False, 1)


@pytest.fixture
def bus() -> Iterator[Bus]:
    bus = Bus()
    yield bus
    bus.driver.close()
    bus.bus.shutdown()


def test_driver_counts_lost_states_and_takes_each_only_once(bus: Bus) -> None:
    first = bus.answers()
    assert bus.take(first) is not None
    assert bus.take(first) is None                      # the same again
    for _ in range(3):
        bus.answers()                                   # lost on the way
    later = bus.answers()
    assert bus.take(later) is not None
    # Commands that were sent by take() were answered by nobody: they are lost states too.
    assert bus.driver.health.lost_states == 5
    assert bus.take(first) is None                      # from the past
    assert bus.driver.health.bad_frames == 1


def test_driver_forgets_a_counter_that_has_gone_round(bus: Bus) -> None:
    assert bus.take(bus.answers()) is not None
    for _ in range(COUNTER // 2):
        bus.driver.exchange(0.0, False, 1)
        assert list(received(bus.bus))                  # nobody answers
    bus.now += 1.0
    bus.firmware.watch(bus.now)
    assert bus.take(bus.answers()) is not None
    assert bus.driver.health.lost_states == bus.driver.health.bad_frames == 0


def test_driver_takes_no_half_or_damaged_state(bus: Bus) -> None:
    force, motion = bus.answers()
    assert bus.take([force]) is None
    assert bus.take([bus.answers()[1]]) is None         # motion of another state
    damaged = can.Message(arbitration_id=motion.arbitration_id, is_extended_id=False,
                          data=bytes(7) + b'x')
    short = can.Message(arbitration_id=force.arbitration_id, is_extended_id=False, data=b'123')
    remote = can.Message(arbitration_id=force.arbitration_id, is_extended_id=False,
                         is_remote_frame=True)
    assert bus.take([force, damaged, short, remote]) is None
    assert bus.driver.health.bad_frames == 2
    assert bus.take(bus.answers()) is not None


def test_driver_sees_its_states_among_those_of_others(bus: Bus) -> None:
    foreign = can.Message(arbitration_id=0x123, data=b'12345678', is_extended_id=False)
    extended = can.Message(arbitration_id=0x101, data=b'12345678', is_extended_id=True)
    force, motion = bus.answers()
    assert bus.take([foreign, force, extended, foreign, motion, foreign]) is not None
    assert bus.driver.health.bad_frames == 0


def test_answers_of_an_adapter_hide_no_frame() -> None:
    """An slcan adapter says z, or only ends a line, when it has sent; a bell if it has not."""
    link = LinkedTerminals()
    bus = open_bus('slcan', link.second, 1_000_000)
    with open(link.first, 'wb', buffering=0) as adapter:
        adapter.write(b'z\rt10121122\r\r\r\at10123344\rz\rt1012')
        frames: list[can.Message] = []
        wait_until(lambda: frames.extend(received(bus)) or len(frames) == 2, 'two frames')
        assert [bytes(frame.data) for frame in frames] == [b'\x11\x22', b'\x33\x44']
        adapter.write(b'5566\r')
        last, = wait_until(lambda: list(received(bus)), 'the last frame')
    assert (last.arbitration_id, bytes(last.data)) == (0x101, b'\x55\x66')
    close_bus(bus)
    link.close()


def test_actuator_that_stays_closed_although_enabled_is_a_problem(bus: Bus) -> None:
    for _ in range(21):
        # The firmware was never told enable = 0 before: it does not drive.
        assert bus.driver.health.problem == ''
        for frame in bus.answers(100.0, enable=True):
            bus.bus.send(frame)
    bus.driver.exchange(100.0, True, 1)
    assert 'keeps its valve closed' in bus.driver.health.problem
    assert 'missed commands' in bus.driver.health.problem
    bus.driver.reset()
    assert bus.driver.health.problem == ''


@pytest.fixture
def peer(ros_environment: dict[str, str], tmp_path: Path) -> Iterator[Callable[..., NodeProcess]]:
    """Return start(*options), which starts the simulated actuator on pseudo-terminals."""
    started: list[NodeProcess] = []

    def start(*options: str, pty: bool = True) -> NodeProcess:
        started.append(NodeProcess(
            [sys.executable, '-m', PEER, *(['--pty'] if pty else []), '--command-timeout', '60',
             *options], ros_environment, tmp_path / f'peer-{len(started)}.log'))
        started[-1].wait_for('slcan /dev/pts/' if pty else MULTICAST)
        return started[-1]

    yield start
    for process in started:
        process.kill()


def channel(peer: NodeProcess) -> str:
    return peer.text.split()[1]


@pytest.fixture
def ask(call: Callable) -> Callable[[str], tuple[bool, str]]:
    """Return a function that calls a service of the actuator: success and message."""
    from std_srvs.srv import SetBool, Trigger

    def ask(name: str) -> tuple[bool, str]:
        if name in ('enable', 'disable', 'pause'):
            service = 'enable' if name == 'disable' else name
            answer = call(SetBool, f'/asi_actuator/{service}',
                          SetBool.Request(data=name != 'disable'))
        else:
            answer = call(Trigger, f'/asi_actuator/{name}', Trigger.Request())
        return answer.success, answer.message

    return ask


@pytest.mark.parametrize('interface', [
    'slcan', pytest.param('udp_multicast', marks=pytest.mark.slow)])
def test_force_loop_over_can(
        interface: str, start_node: Callable, peer: Callable, states: Listener, ask: Callable,
        ros_environment: dict[str, str], tmp_path: Path) -> None:
    if interface == 'slcan':
        actuator_peer = peer()
        bus = PATIENT | {'can.channel': channel(actuator_peer)}
    else:
        # A port of its own, which no client is given, nor DDS takes; by python-can's way for
        # options that are not ours.
        ros_environment['CAN_CONFIG'] = json.dumps(
            {'port': 7_000 + int(ros_environment['ROS_DOMAIN_ID']), 'hop_limit': 0})
        actuator_peer = peer('--interface', interface, '--channel', MULTICAST, pty=False)
        bus = PATIENT | {'can.interface': interface, 'can.channel': MULTICAST}
    actuator = start_node(ACTUATOR, **bus)
    start_node(CONTROLLER, **SLOW, gain=1.0, state_timeout=10.0,
               **{'reference.shape': 'step', 'reference.amplitude': 200.0})
    # Hardware powers up disabled.
    assert not any(state.effort[1] for state in states.wait(50))
    assert 'disabled' in actuator.text
    assert ask('enable')[0]
    states.wait_until(lambda state: abs(state.effort[0] - 200.0) < 30.0, 'the force')
    assert states.messages[-1].position[0] > 0.0 and states.messages[-1].position[1] > 0.0
    refused = ask('calibrate'), ask('pause')
    assert [success for success, _ in refused] == [False, False]
    assert 'disable it first' in refused[0][1]
    assert ask('disable')[0]
    states.wait_until(lambda state: state.effort[1] == 0.0, 'the command to be 0')
    actuator_peer.wait_for('the valve is closed')
    assert actuator.stop() == 0


def test_calibration_is_kept_for_the_next_start(
        start_node: Callable, peer: Callable, states: Listener, ask: Callable,
        tmp_path: Path) -> None:
    file = tmp_path / 'kept' / 'calibration.yaml'
    parameters = PATIENT | {'can.channel': channel(peer('--set', 'force_sensor.offset=40')),
                            'calibration_file': str(file)}
    first = start_node(ACTUATOR, **parameters)
    assert {round(state.effort[0], 3) for state in states.wait(50)} == {40.0}
    success, message = ask('calibrate')
    assert success and '+40.000 N' in message and str(file) in message
    states.wait_until(lambda state: round(state.effort[0], 3) == 0.0, 'a calibrated state')
    assert {round(state.effort[0], 3) for state in states.wait(50)} == {0.0}
    assert first.stop() == 0
    text = file.read_text()
    wait_for_silence('the states of the first', states.messages)
    file.write_text(text.replace('scale: 1.0', 'scale: 2.0').replace('40.0', '30.0'))
    second = start_node(ACTUATOR, **parameters)
    assert {round(state.effort[0], 3) for state in states.wait(50)} == {20.0}
    assert second.stop() == 0
    file.write_text('offset_n: 1.0\nscale: 0\n')
    third = start_node(ACTUATOR, **parameters)
    assert third.exit_status() == 2
    assert str(file) in third.text and 'scale = 0 is not allowed' in third.text


def test_killed_actuator_is_a_fault_and_the_bus_is_found_again(
        start_node: Callable, peer: Callable, states: Listener, ask: Callable,
        tmp_path: Path) -> None:
    link = tmp_path / 'adapter'
    first = peer()
    link.symlink_to(channel(first))
    actuator = start_node(ACTUATOR, **PATIENT, **{'can.channel': str(link)})
    states.wait(10)
    assert ask('enable')[0]
    first.kill()
    actuator.wait_for('fault, the valve command is 0')
    assert f'slcan {link}: ' in actuator.text
    success, message = ask('enable')
    assert not success and 'in fault, reset first' in message
    second = peer()
    link.unlink()
    link.symlink_to(channel(second))
    states.wait(10)
    # What is over stays a fault until somebody has seen it; then it begins disabled.
    assert not ask('enable')[0]
    assert ask('reset') == (True, 'reset: disabled')
    assert ask('enable')[0]
    second.wait_for('the valve is driven')


def test_simulated_actuator_that_loses_its_bus_says_so_in_one_line(
        ros_environment: dict[str, str], tmp_path: Path) -> None:
    link = LinkedTerminals()
    process = NodeProcess([sys.executable, '-m', PEER, '--interface', 'slcan', '--channel',
                           link.first], ros_environment, tmp_path / 'log')
    process.wait_for(f'slcan {link.first}')
    link.close()
    assert process.exit_status() == 1
    # Whether it reads, sends or still opens the bus when that goes is chance.
    said, = process.text.splitlines()[1:]
    assert said in {f'slcan {link.first}: {reason}' for reason in (
        'cannot be read', 'cannot be written',
        "Could not configure port: (5, 'Input/output error')")}


def test_silent_actuator_is_a_fault_that_names_signal_value_and_limit(
        start_node: Callable, peer: Callable, states: Listener, ask: Callable,
        set_parameters: Callable) -> None:
    stopped = peer()
    actuator = start_node(ACTUATOR, **PATIENT, **{'can.channel': channel(stopped)})
    states.wait(10)
    assert ask('enable')[0]
    stopped.send(signal.SIGSTOP)
    set_parameters('asi_actuator', {'limit.state_age': 2.0})
    actuator.wait_for('fault, the valve command is 0: ')
    said = re.search(r'age of the newest state = (\S+) s exceeds limit.state_age = 2 s',
                     actuator.text)
    assert said and float(said[1]) >= 2.0, actuator.text
    stopped.send(signal.SIGCONT)


def test_bus_that_is_not_there_is_waited_for_and_named(
        start_node: Callable, peer: Callable, states: Listener, tmp_path: Path) -> None:
    link = tmp_path / 'adapter'
    actuator = start_node(ACTUATOR, **PATIENT, **{'can.channel': str(link)})
    actuator.wait_for(f'waiting for a state of the actuator; slcan {link}: ')
    link.symlink_to(channel(peer()))
    states.wait(10)
    assert actuator.stop() == 0


@pytest.mark.parametrize('interface', sorted(can.VALID_INTERFACES))
def test_interface_that_is_not_there_is_a_problem_in_one_line(interface: str) -> None:
    values = completed({'mode': 'realtime', 'driver': 'can', 'can.interface': interface,
                        'can.channel': '239.74.163.2'}, ACTUATOR_NODE_PARAMETERS)
    driver = CanActuator(values, 1.0)
    driver.open()
    problem = driver.health.problem
    driver.close()
    assert '\n' not in problem
    if interface not in ('virtual', 'udp_multicast'):  # these need nothing
        assert problem.startswith(f'{interface} 239.74.163.2: ')


@pytest.mark.parametrize(('parameters', 'words'), [
    ({'driver': 'can'}, "mode = 'lockstep' is not allowed with driver = 'can'"),
    ({'driver': 'can', 'mode': 'realtime', 'can.dbc': '/nowhere.dbc'}, '/nowhere.dbc'),
    ({'driver': 'replay', 'replay.bag': '/nowhere'}, "replay.bag = '/nowhere'"),
    *(pytest.param(*each, marks=pytest.mark.slow) for each in (
        ({'driver': 'can', 'mode': 'realtime', 'can.interface': 'pigeon'}, 'can.interface = '),
        ({'driver': 'pigeon'}, 'one of can, replay, simulated'))),
])
def test_driver_that_cannot_work_is_one_line_and_exit_status_2(
        parameters: dict, words: str, start_node: Callable) -> None:
    node = start_node(ACTUATOR, **parameters)
    assert node.exit_status() == 2
    assert words in node.text and 'Traceback' not in node.text
    assert len(node.text.splitlines()) == 1


def test_replayed_bag_is_played_to_the_controller(
        start_node: Callable, ros_node: Any, states: Listener, tmp_path: Path) -> None:
    from diagnostic_msgs.msg import DiagnosticArray
    from geometry_msgs.msg import WrenchStamped
    from rosgraph_msgs.msg import Clock
    from std_msgs.msg import Float64
    # The actuator waits for a recorder of them all.
    for kind, name in ((WrenchStamped, 'force'), (Float64, 'valve_position'),
                       (Float64, 'velocity'), (Clock, '/clock'),
                       (DiagnosticArray, '/diagnostics')):
        ros_node.create_subscription(kind, name, lambda message: None, 1000)
    t = np.arange(300) / 5000.0
    force = 100.0 * np.sin(2 * np.pi * 20.0 * t)
    force[7] = np.nan
    write_bag(Run(t, None, None, force, 1e-6 * t, 2e-3 * t, 3.0 * t, 'test', {}),
              tmp_path / 'bag')
    controller = start_node(CONTROLLER, gain=0.0, feedforward=0.0)
    actuator = start_node(ACTUATOR, driver='replay', await_recorder=True,
                          **{'replay.bag': str(tmp_path / 'bag')})
    assert actuator.exit_status() == 0, actuator.text
    # Every state was answered, or there would be an error.
    expected = force.copy()
    expected[7] = force[6]

    def played() -> dict[int, tuple[float, float]]:
        """Return force and position by stamp: those that were sent again count once."""
        return {nanoseconds(m.header.stamp): (m.effort[0], m.position[0])
                for m in states.messages}

    wait_until(lambda: len(played()) >= t.size, 'every state')
    np.testing.assert_array_equal(list(played().values()), np.column_stack([expected, 2e-3 * t]))
    assert controller.stop() == 0


def test_units_are_those_of_the_topics() -> None:
    units = {s.name: s.unit for m in cantools.database.load_file(
        shipped(frames_module.FILE)).messages for s in m.signals if s.scale != 1}
    assert units == {'valve_command': 'N', 'force': 'N', 'valve_position': 'm', 'position': 'm',
                     'velocity': 'm/s'}


def test_command_that_is_no_number_is_a_fault_until_the_reset(
        start_node: Callable, ros_node: Any, states: Listener, ask: Callable) -> None:
    from geometry_msgs.msg import WrenchStamped
    from rosgraph_msgs.msg import Clock
    from sensor_msgs.msg import JointState
    commands = ros_node.create_publisher(WrenchStamped, 'valve_command', 10)
    # This test is the controller: it answers every state, the tenth with nan.
    ros_node.create_subscription(Clock, '/clock', lambda message: None, 10)
    command = WrenchStamped()
    applied = {}

    def answer(state: JointState) -> None:
        applied[nanoseconds(state.header.stamp)] = state.effort[1]
        command.header.stamp = state.header.stamp
        tenth = nanoseconds(state.header.stamp) == 2_000_000
        command.wrench.force.x = np.nan if tenth else 500.0
        commands.publish(command)

    ros_node.create_subscription(JointState, 'joint_states', answer, 10)
    actuator = start_node(ACTUATOR, give_up_after=60.0)
    actuator.wait_for('fault, the valve command is 0: valve_command = nan N')
    # In lock-step the ticks go on, with a valve that is shut.
    states.wait(50)
    assert [applied[200_000 * k] for k in range(8, 14)] == [500.0, 500.0, 500.0, 0.0, 0.0, 0.0]
    assert not any(m.effort[1] for m in states.messages[-20:])
    assert ask('reset') == (True, 'reset: enabled')
    states.wait_until(lambda state: state.effort[1] == 500.0, 'the command')
    assert actuator.stop() == 0


@pytest.mark.parametrize('what', WATCHDOGS)
def test_valve_is_shut_on_the_bus_within_two_periods(
        what: str, ros_node: Any, tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    try:
        assert periods_until_shut(bench, what) <= 2
    finally:
        bench.close()


def test_bus_that_returns_finds_the_valve_shut(ros_node: Any, tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    try:
        assert shut_when_the_bus_returns(bench)
    finally:
        bench.close()
