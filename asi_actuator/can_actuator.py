"""
Simulated firmware: the actuator on a CAN bus, at the other end of the bridge.

Needs no ROS. `--pty` makes two linked pseudo-terminals and speaks slcan over them, so that
neither hardware nor SocketCAN is needed.
"""

import argparse
import select
import signal
import sys
import time
from collections.abc import Callable, Sequence
from typing import Final

import can

from asi_actuator.driver.can_bus import close_bus, open_bus, received
from asi_actuator.driver.frames import COUNTER, Frames, load_table
from asi_actuator.driver.pseudo_terminals import LinkedTerminals
from asi_actuator.driver.simulated import SimulatedActuator
from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_common.executable import end_while_compiling
from asi_common.parameter import ParameterError, Value, completed
from asi_common.parameter_file import read_scalar
from asi_common.signals import SIGNALS

# Step of the simulation, s, and the most that it catches up at once.
PERIOD_S: Final = 0.2e-3
MOST_CATCH_UP_S: Final = 0.1
# Largest step of the counter from one command to the next: a few may be lost; a repeated or an
# old one is ignored.
MOST_AHEAD: Final = 16

Frame = tuple[int, bytes]


class Firmware:
    """
    The actuator's side of the protocol; time (s) is an argument.

    The valve is driven while commands arrive in time, and only after one with `enable` 0: after a
    loss of the link the valve must be enabled anew.
    """

    def __init__(self, frames: Frames, values: dict[str, Value], command_timeout_s: float,
                 now_s: float):
        self._frames = frames
        self._actuator = SimulatedActuator(values, PERIOD_S)
        self._actuator.open()
        self._timeout_s = command_timeout_s
        self._advanced_to_s = self._commanded_at = self._spoken_at = now_s
        # Counter of the last command (None: the next one may have any), and the one to echo.
        self._counter: int | None = None
        self._echo = 0
        self._command_n = 0.0
        self._ready = self.driving = False

    def receive(self, now_s: float, identifier: int, data: bytes) -> bool:
        """Process a frame; return whether it was a valid command, to be answered by state()."""
        try:
            decoded = self._frames.decode(identifier, data)
        except ValueError:
            return False
        if decoded is None or decoded[0] != 'COMMAND':
            return False
        values = decoded[1]
        counter = int(values['counter'])
        if self._counter is not None and not (
                1 <= (counter - self._counter) % COUNTER <= MOST_AHEAD):
            return False
        self._advance(now_s)
        self._counter = self._echo = counter
        self._commanded_at = now_s
        self._ready = self._ready or not values['enable']
        self.driving = self._ready and bool(values['enable'])
        self._command_n = values['valve_command'] if self.driving else 0.0
        return True

    def watch(self, now_s: float) -> bool:
        """Close the valve if no command arrives; return whether state() should be sent."""
        if now_s - self._commanded_at > self._timeout_s:
            self._advance(now_s)
            self._ready = self.driving = False
            self._command_n = 0.0
            # The counter may begin anywhere: the sender may have been restarted.
            self._counter = None
            return now_s - self._spoken_at > self._timeout_s
        return False

    def _advance(self, now_s: float) -> None:
        self._advanced_to_s = max(self._advanced_to_s, now_s - MOST_CATCH_UP_S)
        periods = int((now_s - self._advanced_to_s) / PERIOD_S)
        self._measurement = self._actuator.exchange(self._command_n, self.driving, periods)
        self._advanced_to_s += periods * PERIOD_S

    def state(self, now_s: float) -> list[Frame]:
        """Return the frames of the state."""
        self._spoken_at = now_s
        force, valve, position, velocity = self._measurement
        return [(self._frames.identifiers[name], self._frames.encode(name, values))
                for name, values in (
                    ('STATE_FORCE', {
                        'force': force, 'valve_position': valve, 'enabled': self.driving,
                        'command_lost': not self._ready,
                        'saturated': self._actuator.health.saturated, 'counter': self._echo}),
                    ('STATE_MOTION', {
                        'position': position, 'velocity': velocity, 'counter': self._echo}))]


def serve(bus: can.BusABC, firmware: Firmware, command_timeout_s: float,
          stopped: Callable[[], bool]) -> None:
    """Answer the commands on a bus until stopped() is true."""
    driving = False
    while not stopped():
        select.select([bus], [], [], command_timeout_s / 4.0)
        due = firmware.watch(time.monotonic())
        # After a delay only the newest command is answered; else it would never catch up.
        for message in received(bus):
            due |= firmware.receive(
                time.monotonic(), message.arbitration_id, bytes(message.data))
        for identifier, data in firmware.state(time.monotonic()) if due else ():
            try:
                bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False),
                         timeout=0.0)
            except can.CanOperationError:
                break  # the queue is full: nobody listens
        if firmware.driving != driving:
            driving = firmware.driving
            print('the valve is driven' if driving else 'the valve is closed', flush=True)


def physical_values(settings: Sequence[str]) -> dict[str, Value]:
    """
    Return the actuator's parameters, changed by settings as 'name=value'.

    Raises ParameterError for one that is not allowed.
    """
    values: dict[str, Value] = {}
    for setting in settings:
        name, _, text = setting.partition('=')
        values[name] = read_scalar(text.strip())
    return completed(values, ACTUATOR_PARAMETERS)


def arguments() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog='can_actuator', description=__doc__.splitlines()[1])
    parser.add_argument('--interface', default='socketcan', help='of python-can')
    parser.add_argument('--channel', default='can0')
    parser.add_argument('--bitrate', type=int, default=1_000_000, help='bit/s')
    parser.add_argument('--pty', action='store_true',
                        help='make two linked pseudo-terminals, print the other end, speak slcan')
    parser.add_argument('--dbc', default='',
                        help='file with the layout of the frames; default: that of the package')
    parser.add_argument('--command-timeout', type=float, default=0.02, metavar='S',
                        help='time without a command after which the valve is closed')
    parser.add_argument('--set', action='append', default=[], metavar='NAME=VALUE',
                        help='a parameter of the simulated actuator (doc/reference/parameters.md)')
    parser.add_argument('--load', type=float, metavar='HZ',
                        help='print the load of the bus at a control rate, and end')
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the actuator; return the exit status: 2 if it cannot start, 1 if the bus is lost."""
    # ros2 run and launch files add their own.
    given = sys.argv[1:] if argv is None else list(argv)
    if '--ros-args' in given:
        given = given[:given.index('--ros-args')]
    options = arguments().parse_args(given)
    try:
        frames = Frames(options.dbc)
        if options.load:
            print(load_table(frames, options.load, options.bitrate))
            return 0
        made = end_while_compiling(SIGNALS, 0)
        firmware = Firmware(frames, physical_values(options.set), options.command_timeout,
                            time.monotonic())
        made()
    except ParameterError as error:
        print(error, file=sys.stderr)
        return 2
    stop: list[int] = []
    for number in SIGNALS:
        signal.signal(number, lambda number, _: stop.append(number))
    link = LinkedTerminals() if options.pty else None
    interface, channel = (('slcan', link.first) if link
                          else (options.interface, options.channel))
    try:
        bus = open_bus(interface, channel, options.bitrate)
    except (can.CanError, OSError, ValueError, TypeError, ImportError) as error:
        print(f'{interface} {channel}: {error}', file=sys.stderr)
        return 2
    print(f'slcan {link.second}' if link else f'{interface} {channel}', flush=True)
    try:
        serve(bus, firmware, options.command_timeout, lambda: bool(stop))
    except (can.CanError, OSError) as error:
        print(f'{interface} {channel}: {error}', file=sys.stderr)
        return 1
    finally:
        close_bus(bus)
        if link:
            link.close()
    return 0


if __name__ == '__main__':
    sys.exit(main())
