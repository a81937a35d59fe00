"""
The CAN frames of config/asi_actuator.dbc, packed and unpacked (doc/how_to/bridge.md).

Layout, scaling, limits and units are defined in that file; here are only the checksum, which the
format cannot express, and the conversion of numbers to bytes and back.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import cantools
from cantools.database.can import Database, Message, Signal

from asi_common.files import shipped
from asi_common.parameter import ParameterError

FILE: Final = 'asi_actuator.dbc'
# The signals that this code works with, by frame. A file of the user's own must have them all.
SIGNALS: Final = {
    'COMMAND': {'valve_command', 'enable', 'counter', 'checksum'},
    'STATE_FORCE': {'force', 'valve_position', 'enabled', 'command_lost', 'saturated', 'counter',
                    'checksum'},
    'STATE_MOTION': {'position', 'velocity', 'counter', 'checksum'},
}
# A file with another unit is refused.
UNITS: Final = {'valve_command': 'N', 'force': 'N', 'valve_position': 'm', 'position': 'm',
                'velocity': 'm/s'}
# The counter counts modulo this; it and the checksum take a byte each.
COUNTER: Final = 256
BYTE: Final = 8


def _crc_table() -> tuple[int, ...]:
    table = []
    for value in range(256):
        for _ in range(8):
            value = (value << 1) ^ (0x1D if value & 0x80 else 0)
        table.append(value & 0xFF)
    return tuple(table)


_CRC_TABLE: Final = _crc_table()


def checksum(identifier: int, data: bytes) -> int:
    """
    Return the CRC-8 (SAE J1850: polynomial 0x1D, start and final XOR 0xFF) of a frame.

    Over the identifier (2 bytes, low first), so that one frame is not taken for another, and the
    data without the checksum, which is the last byte.
    """
    crc = 0xFF
    for byte in (identifier & 0xFF, identifier >> 8, *data):
        crc = _CRC_TABLE[crc ^ byte]
    return crc ^ 0xFF


class Frames:
    """Encodes and decodes the frames of a DBC file."""

    def __init__(self, path: str = ''):
        """Read a DBC file, or the one of the package. Raises ParameterError if it is unusable."""
        place = Path(path) if path else shipped(FILE)
        try:
            database = cantools.database.load_file(place, database_format='dbc')
        except (OSError, ValueError, cantools.database.Error) as error:
            raise ParameterError(
                f'can.dbc = {str(place)!r} cannot be read as a DBC file: '
                + ' '.join(str(error).split())) from error
        assert isinstance(database, Database)
        self.messages: dict[str, Message] = {m.name: m for m in database.messages}
        for name, signals in SIGNALS.items():
            have = {s.name for s in self.messages[name].signals} if name in self.messages else {}
            if missing := signals.difference(have):
                raise ParameterError(f'can.dbc = {str(place)!r}: frame {name} lacks the signals '
                                     + ', '.join(sorted(missing)))
            if problem := _problem(self.messages[name]):
                raise ParameterError(f'can.dbc = {str(place)!r}: frame {name}: {problem}')
        # By frame and signal: its range, within what its bits can represent.
        self._ranges = {name: {s.name: _range(s) for s in self.messages[name].signals}
                      for name in SIGNALS}
        self.identifiers = {name: self.messages[name].frame_id for name in SIGNALS}
        self._by_identifier = {m.frame_id: m for m in self.messages.values() if m.name in SIGNALS}

    def encode(self, name: str, values: Mapping[str, float]) -> bytes:
        """Return the data of a frame; a value beyond the range of its signal becomes its end."""
        message = self.messages[name]
        complete = {signal: min(max(values.get(signal, 0), low), high)
                    for signal, (low, high) in self._ranges[name].items()}
        data = message.encode(complete)[:-1]
        return data + bytes((checksum(message.frame_id, data),))

    def decode(self, identifier: int, data: bytes) -> tuple[str, dict[str, float]] | None:
        """
        Return name and values of a frame, None if it is none of ours.

        Raises ValueError if its length or its checksum is wrong.
        """
        message = self._by_identifier.get(identifier)
        if message is None:
            return None
        if len(data) != message.length:
            raise ValueError(f'{message.name} has {len(data)} bytes, not {message.length}')
        if data[-1] != checksum(identifier, data[:-1]):
            raise ValueError(f'{message.name} has a wrong checksum')
        values: dict[str, float] = message.decode(  # type: ignore[assignment]
            data, decode_choices=False)
        return message.name, values


def _problem(message: Message) -> str:
    """Return why a frame cannot be used, '' if it can."""
    if message.is_extended_frame or message.is_fd or message.length > BYTE:
        return 'it takes an 11-bit identifier and at most 8 bytes'
    for signal in message.signals:
        unit = UNITS.get(signal.name)
        if unit is not None and signal.unit != unit:
            return f'{signal.name} is in {signal.unit or "no unit"}, it takes {unit}'
        whole = signal.length == BYTE and not signal.is_signed and signal.scale == 1
        if signal.name in ('counter', 'checksum') and not whole:
            return f'{signal.name} takes 8 bits, unsigned, factor 1'
        if signal.name == 'checksum' and signal.start // BYTE != message.length - 1:
            return 'checksum must be the last byte'
    return ''


def _range(signal: Signal) -> tuple[float, float]:
    """Return the smallest and the largest value that a signal may have."""
    codes = 1 << signal.length
    raw = (-codes // 2, codes // 2 - 1) if signal.is_signed else (0, codes - 1)
    low, high = sorted(signal.offset + signal.scale * code for code in raw)
    return (low if signal.minimum is None else max(low, signal.minimum),
            high if signal.maximum is None else min(high, signal.maximum))


def longest_bits(length: int) -> int:
    """
    Return the longest that a frame of `length` data bytes can be on the bus, in bits.

    47 bits around the data (11-bit identifier, with the gap between frames) and a stuff bit after
    at most every fourth of the 34 + 8 length bits that are stuffed (Davis et al., Controller
    Area Network schedulability analysis, 2007, eq. 4).
    """
    return 47 + 8 * length + (34 + 8 * length - 1) // 4


def load_table(frames: Frames, rate_hz: float, bitrate: float) -> str:
    """Return, as text, what share of a bus each frame takes at worst, sent `rate_hz` times a s."""
    lines = [f'{"frame":14}{"identifier":>10}{"bytes":>7}{"bits":>6}{"us":>8}{"load %":>8}']
    total = 0
    for name, identifier in frames.identifiers.items():
        length = frames.messages[name].length
        bits = longest_bits(length)
        total += bits
        lines.append(f'{name:14}{identifier:#10x}{length:7}{bits:6}{bits / bitrate * 1e6:8.0f}'
                     f'{100.0 * bits * rate_hz / bitrate:8.1f}')
    lines.append(f'{"all":14}{"":10}{"":7}{total:6}{total / bitrate * 1e6:8.0f}'
                 f'{100.0 * total * rate_hz / bitrate:8.1f}')
    return '\n'.join(lines)
