"""The driver for hardware on a CAN bus; doc/how_to/bridge.md says what the other end must do."""

import math
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

import can
from can.interfaces.slcan import slcanBus

from asi_actuator.driver import Health
from asi_actuator.driver.frames import COUNTER, Frames
from asi_actuator.model.actuator import Measurement
from asi_common.parameter import ParameterError, Value

# How long an slcan adapter takes to start, s.
ADAPTER_START_S: Final = 2.0
# First letters of the lines of slcan that are frames.
FRAME_LETTERS: Final = b'tTrRdDbB'
# Period of the attempts to connect to a bus, s.
RETRY_S: Final = 0.5
# Most frames that are read in a period, so that a flooded bus cannot block the loop.
MOST_FRAMES: Final = 64
# Successive states that may report "not enabled" after the valve was enabled: a round trip.
ENABLE_STATES: Final = 20
# After so many commands without a state the counter is ambiguous: it may have wrapped.
FORGET_AFTER: Final = COUNTER // 4


class SlcanBus(slcanBus):
    """
    python-can's slcan, but reading all available bytes at once instead of one at a time.

    A state frame takes 7 us of computing time instead of 90 (bench/can_cost.py); a period of
    1000 us has two.
    """

    def _read(self, timeout: float | None) -> str | None:
        if self.LINE_TERMINATOR not in self._buffer:
            with can.exceptions.error_check('cannot be read'):
                if waiting := self.serialPortOrig.in_waiting:
                    self._buffer += self.serialPortOrig.read(waiting)
        while (end := self._buffer.find(self.LINE_TERMINATOR)) >= 0:
            line = bytes(self._buffer[:end + 1]).lstrip(self._ERROR)
            del self._buffer[:end + 1]
            if line[:1] in FRAME_LETTERS:
                return line.decode()
            # Any other line is the adapter's acknowledgement of a command. If it were returned,
            # the caller would stop reading.
        return None

    def _write(self, string: str) -> None:
        with can.exceptions.error_check('cannot be written'):
            super()._write(string)


def open_bus(interface: str, channel: str, bitrate: int) -> can.BusABC:
    """
    Return an open bus.

    What an interface takes beyond channel and bit rate comes from python-can's own configuration
    (CAN_CONFIG, ~/.canrc). Raises can.CanError, OSError, ValueError, TypeError or ImportError if
    it cannot be opened.
    """
    if interface == 'slcan':
        # An adapter may start anew when it is opened; a terminal does not.
        terminal = Path(channel).resolve().parent == Path('/dev/pts')
        return SlcanBus(channel=channel, bitrate=bitrate, timeout=0.0,
                        sleep_after_open=0.0 if terminal else ADAPTER_START_S)
    return can.Bus(interface=interface, channel=channel, bitrate=bitrate)


def close_bus(bus: can.BusABC) -> None:
    """Close a bus, also one that is gone already."""
    try:
        bus.shutdown()
    except (can.CanError, OSError):
        pass


def received(bus: can.BusABC) -> Iterator[can.Message]:
    """
    Yield the received frames of a bus, at most MOST_FRAMES, without waiting.

    A line that cannot be parsed becomes an error frame.
    """
    for _ in range(MOST_FRAMES):
        try:
            message = bus.recv(0.0)
        except (ValueError, IndexError):
            message = can.Message(is_error_frame=True)
        if message is None:
            return
        yield message


class CanActuator:
    """Sends a command each period and collects the states that answer it, without waiting."""

    hardware = True
    last_tick = None

    def __init__(self, values: Mapping[str, Value], period_s: float):
        """Read the layout of the frames. Raises ParameterError for values that are not allowed."""
        if values['mode'] != 'realtime':
            raise ParameterError("mode = 'lockstep' is not allowed with driver = 'can': hardware "
                                 'does not wait; it takes realtime')
        self._interface = str(values['can.interface'])
        if self._interface not in can.VALID_INTERFACES:
            raise ParameterError(f'can.interface = {self._interface!r} is not allowed: it takes '
                                 'one of ' + ', '.join(sorted(can.VALID_INTERFACES)))
        self._channel, self._bitrate = str(values['can.channel']), int(values['can.bitrate'])
        self._frames = Frames(str(values['can.dbc']))
        self._bus: can.BusABC | None = None
        self._retry_at = 0.0
        self._problem = ''
        # Counter of the newest command; number of commands since the newest state.
        self._sent = self._unanswered = 0
        self._received: int | None = None
        self._received_at = -math.inf
        self._force: dict[str, float] = {}
        self._lost_states = self._bad_frames = self._not_following = 0
        self._enabled = self._saturated = False

    def open(self) -> None:
        self._retry_at = time.monotonic() + RETRY_S
        try:
            # Without python-can's filters: recv(0.0) returns None for a frame that they drop.
            self._bus = open_bus(self._interface, self._channel, self._bitrate)
            for _ in range(MOST_FRAMES):
                if not any(received(self._bus)):  # drop what was sent before the bus was opened
                    break
        except (can.CanError, OSError, ValueError, TypeError, ImportError) as error:
            # TypeError: a missing option; ImportError: a library that is not installed.
            self._problem = self._described(error)
        else:
            self._problem = ''
            self._received = None

    def exchange(self, command_n: float, enabled: bool, periods: int) -> Measurement | None:
        if self._bus is None:
            if time.monotonic() > self._retry_at:
                self.open()
            return None
        measurement = None
        try:
            measurement = self._receive(self._bus)
            self._send(self._bus, command_n, enabled)
        except (can.CanError, OSError) as error:
            self._drop(error)
        return measurement

    @property
    def health(self) -> Health:
        problem = self._problem
        if self._not_following > ENABLE_STATES:
            problem = ('the actuator keeps its valve closed although it is enabled: '
                       + ('it has missed commands' if self._force.get('command_lost')
                          else 'it does not say why'))
        return Health(time.monotonic() - self._received_at, self._lost_states, self._bad_frames,
                      problem, self._saturated)

    def configure(self, values: Mapping[str, Value]) -> None:
        pass

    def reset(self) -> None:
        self._not_following = 0

    def close(self) -> None:
        if self._bus is None:
            return
        try:
            self._send(self._bus, 0.0, False)
        except (can.CanError, OSError):
            pass
        self._drop(None)

    def _drop(self, error: Exception | None) -> None:
        """Close the bus, and connect again after RETRY_S."""
        bus, self._bus = self._bus, None
        self._retry_at = time.monotonic() + RETRY_S
        if error is not None:
            self._problem = self._described(error)
        if bus is not None:
            close_bus(bus)

    def _described(self, error: Exception) -> str:
        return f'{self._interface} {self._channel}: ' + ' '.join(str(error).split())

    def _send(self, bus: can.BusABC, command_n: float, enabled: bool) -> None:
        self._sent = (self._sent + 1) % COUNTER
        self._unanswered += 1
        data = self._frames.encode('COMMAND', {
            'valve_command': command_n, 'enable': enabled, 'counter': self._sent})
        bus.send(can.Message(arbitration_id=self._frames.identifiers['COMMAND'], data=data,
                             is_extended_id=False), timeout=0.0)
        self._enabled = enabled

    def _receive(self, bus: can.BusABC) -> Measurement | None:
        """Process the received frames; return the newest state."""
        newest = None
        for message in received(bus):
            newest = self._decode(message) or newest
        return newest

    def _decode(self, message: can.Message) -> Measurement | None:
        """Process a frame; return the state if it completes a new one."""
        if message.is_remote_frame or message.is_extended_id:
            return None  # of another device
        try:
            if message.is_error_frame:
                raise ValueError('an error frame')
            decoded = self._frames.decode(message.arbitration_id, bytes(message.data))
        except ValueError:
            self._bad_frames += 1
            return None
        if decoded is None:
            return None
        name, values = decoded
        if name == 'STATE_FORCE':
            self._force = values
            return None
        if (name != 'STATE_MOTION' or values['counter'] != self._force.get('counter')
                or not self._is_new(int(values['counter']))):
            return None
        self._received_at = time.monotonic()
        self._unanswered = 0
        self._saturated = bool(self._force['saturated'])
        follows = self._force['enabled'] or not self._enabled
        self._not_following = 0 if follows else self._not_following + 1
        return (self._force['force'], self._force['valve_position'],
                values['position'], values['velocity'])

    def _is_new(self, counter: int) -> bool:
        """Return whether a state is newer than the last; count those lost in between."""
        if self._unanswered > FORGET_AFTER:
            self._received = None
        if (self._sent - counter) % COUNTER > FORGET_AFTER:
            self._bad_frames += 1  # answers no recent command: an old frame
            return False
        if self._received is not None:
            ahead = (counter - self._received) % COUNTER
            if ahead == 0:
                return False  # sent without a command, as none has arrived
            if ahead > COUNTER // 2:
                self._bad_frames += 1
                return False
            self._lost_states += ahead - 1
        self._received = counter
        return True
