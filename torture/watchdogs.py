"""
How many control periods pass from what breaks a limit until the valve is commanded shut.

The actuator's node, a firmware and the slcan bus between them are real, but time is not: each
period of the node is called when all frames of the last one have arrived. So periods are counted
in frames on the bus, and the count is the same on any machine.
"""

import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

import can
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool

from asi_actuator.actuator_node import ActuatorNode
from asi_actuator.can_actuator import Firmware, physical_values
from asi_actuator.driver.can_bus import (
    RETRY_S,
    CanActuator,
    SlcanBus,
    close_bus,
    open_bus,
    received,
)
from asi_actuator.driver.frames import Frames
from asi_common.parameter import Value
from torture.rig import NotThere, Rig, Tally, until
from torture.wire import Wire

RATE_HZ: Final = 200.0
# Far below every limit of this rig, however slow the machine is.
COMMAND_N: Final = 20.0
WITHIN: Final = 2
# On a slow machine one period may count as ten: a jump must be a fault even then.
FORCE_RATE: Final = 1e4
ON_A_LINE: Final = 6   # characters of slcan around the data: t, identifier, length, end

State = dict[str, float]


class Bench:
    """The node, a firmware, and the bus between them."""

    def __init__(self, folder: Path):
        """Bring the valve to be driven."""
        folder.mkdir(parents=True, exist_ok=True)
        self.wire = Wire(folder)
        self.frames = Frames()
        self.now_s = 0.0
        self.firmware = Firmware(self.frames, physical_values([]), 0.1, self.now_s)
        self.peer = open_bus('slcan', str(self.wire.peer), 1_000_000)
        self.node = ActuatorNode(parameter_overrides=[Parameter(name, value=value) for
                                                      name, value in {
            'mode': 'realtime', 'rate_hz': RATE_HZ, 'driver': 'can', 'can.interface': 'slcan',
            'can.channel': str(self.wire.node), 'command_timeout': 60.0, 'limit.state_age': 60.0,
            'limit.lost_states': 3, 'limit.bad_frames': 2, 'limit.force_rate': FORCE_RATE,
            'limit.valve_position': 4e-5, 'limit.velocity': 2.0,
            'limit.valve_disagreement_time': 1e-3}.items()])
        for _ in range(3):
            self.period()
        answer = self.node._enable(SetBool.Request(data=True), SetBool.Response())
        assert answer.success, answer.message
        for _ in range(5):
            command = self.period()
        if not (command['enable'] and command['valve_command'] == COMMAND_N
                and self.firmware.driving):
            raise NotThere(f'the valve to be driven: {command}, {self.node.safety.reason}')

    def close(self) -> None:
        self.node.destroy_node()
        close_bus(self.peer)
        self.wire.close()

    def set(self, **values: Value) -> None:
        """Change a parameter of the node, named with __ for a dot."""
        result, = self.node.set_parameters(
            [Parameter(name.replace('__', '.'), value=value) for name, value in values.items()])
        assert result.successful, result.reason

    def command(self, force_n: float = COMMAND_N) -> None:
        """Give the node a valve command that answers its newest state."""
        self.node.loop.on_command(self.node.loop.next_stamp_ns(), force_n)

    def period(self, command_n: float | None = COMMAND_N, answered: bool = True,
               changed: Mapping[str, float] | None = None) -> State:
        """Let a control period pass; return the command that comes out at the firmware's end."""
        if command_n is not None:
            self.command(command_n)
        self.node.loop._tick()
        command = self._taken()
        if answered:
            self.answer(changed or {})
        return command

    def answer(self, changed: Mapping[str, float]) -> None:
        """Answer as the firmware does, with these numbers changed on the way, checksums right."""
        frames = []
        for identifier, data in self.firmware.state(self.now_s):
            decoded = self.frames.decode(identifier, data)
            assert decoded is not None
            name, values = decoded
            frames.append((identifier, self.frames.encode(name, values | {
                key: value for key, value in changed.items() if key in values})))
        self.send(frames)

    def send(self, frames: list[tuple[int, bytes]]) -> None:
        """Put frames on the bus and wait until they have arrived."""
        for identifier, data in frames:
            self.peer.send(can.Message(arbitration_id=identifier, data=data,
                                       is_extended_id=False), timeout=0.0)
        driver = self.node.driver
        assert isinstance(driver, CanActuator) and isinstance(driver._bus, SlcanBus)
        port = driver._bus.serialPortOrig
        length = sum(ON_A_LINE + 2 * len(data) for _, data in frames)
        until(lambda: port.in_waiting >= length, 'the answer at the node')

    def _taken(self) -> State:
        """Return the command that the firmware has taken."""
        messages: list[can.Message] = []
        until(lambda: messages.extend(received(self.peer)) or messages, 'a command')
        message, = messages
        self.now_s += 1.0 / RATE_HZ
        self.firmware.receive(self.now_s, message.arbitration_id, bytes(message.data))
        decoded = self.frames.decode(message.arbitration_id, bytes(message.data))
        assert decoded is not None
        return decoded[1]


def _with(**changed: float) -> Callable[[Bench], None]:
    """Return an action that exceeds a limit by a state with these values."""
    return lambda bench: bench.period(changed=changed) and None


def _no_number(bench: Bench) -> None:
    bench.period()
    bench.command(math.nan)


def _old_command(bench: Bench) -> None:
    bench.period()
    bench.set(command_timeout=1e-3)
    time.sleep(2e-3)


def _old_state(bench: Bench) -> None:
    bench.period(answered=False)
    bench.set(limit__state_age=1e-3)
    time.sleep(2e-3)


def _gap(bench: Bench) -> None:
    for _ in range(4):
        bench.period(answered=False)
    bench.period()


def _bad_frames(bench: Bench) -> None:
    bench.period(answered=False)
    bench.wire.to_node.change = _other_checksum
    bench.send(bench.firmware.state(bench.now_s)[:1] * 3)
    bench.wire.to_node.change = None


def _other_checksum(line: bytes) -> bytes:
    """Return a line of slcan whose last hexadecimal digit is another."""
    return line[:-2] + (b'1' if line[-2:-1] == b'0' else b'0') + line[-1:]


def _not_following(bench: Bench) -> None:
    for _ in range(21):
        bench.period(changed={'enabled': 0.0})


# By watchdog: the actions up to the frame or command that exceeds the limit; the beginning of the
# reason; whether no new command follows.
WATCHDOGS: Final[dict[str, tuple[Callable[[Bench], None], str, bool]]] = {
    'age of the command': (_old_command, 'age of valve_command', True),
    'command that is no number': (_no_number, 'valve_command = nan N', True),
    'age of the state': (_old_state, 'age of the newest state', False),
    'gap in the counter': (_gap, 'states lost within 1 s = 4', False),
    'checksum': (_bad_frames, 'bad frames within 1 s = 3', False),
    'force': (_with(force=-3000.0), 'force = -3000 N', False),
    'rate of the force': (_with(force=600.0), 'rate of the force', False),
    'valve position': (_with(valve_position=6e-5), 'valve_position = 6e-05 m', False),
    'velocity': (_with(velocity=5.0), 'velocity = 5 m/s', False),
    'valve disagrees': (_with(valve_position=2e-5), 'valve_position less that of the command',
                        False),
    'actuator does not follow': (_not_following, 'the actuator keeps its valve closed', False),
}


def periods_until_shut(bench: Bench, what: str) -> int:
    """
    Break a limit; return after how many control periods the first command on the bus is shut.

    A state or command is there when the first of them begins. Raises NotThere if it is not shut
    after ten, or for another reason, or does not stay so.
    """
    break_limit, reason, silent = WATCHDOGS[what]
    break_limit(bench)
    commands = [bench.period(None if silent else COMMAND_N) for _ in range(10)]
    shut = [command['enable'] == 0 and command['valve_command'] == 0.0 for command in commands]
    if not bench.node.safety.reason.startswith(reason):
        raise NotThere(f'a fault with the reason {reason}, not: {bench.node.safety.reason}')
    first = shut.index(True) if True in shut else len(shut)
    if not all(shut[first:]) or bench.firmware.driving or first == len(shut):
        raise NotThere(f'a valve that stays shut: {commands}')
    return first + 1


def shut_when_the_bus_returns(bench: Bench) -> bool:
    """Unplug the bus and plug it in again; return whether the first command on it is shut."""
    bench.wire.unplug()
    bench.node.loop._tick()
    close_bus(bench.peer)
    bench.wire.replug()
    bench.peer = open_bus('slcan', str(bench.wire.peer), 1_000_000)
    time.sleep(1.1 * RETRY_S)
    bench.node.loop._tick()
    command = bench.period(answered=False)
    return command['enable'] == 0 and bench.node.safety.reason.startswith('slcan ')


def watchdogs(rig: Rig, tally: Tally, end: float) -> None:
    """Each watchdog, again and again; count the control periods until the valve is shut."""
    while time.monotonic() < end or not tally.tried:
        for what in WATCHDOGS:
            bench = Bench(rig.folder)
            try:
                periods = periods_until_shut(bench, what)
                name = f'{what} (periods)'
                tally.notes[name] = max(periods, tally.notes.get(name, 0))
                tally.count(what, '' if periods <= WITHIN else f'shut after {periods} periods')
            except NotThere as error:
                tally.count(what, str(error))
            finally:
                bench.close()
        bench = Bench(rig.folder)
        tally.count('bus back', '' if shut_when_the_bus_returns(bench) else 'the valve is driven')
        bench.close()

