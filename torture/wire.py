"""The CAN bus of the scenarios: two linked pseudo-terminals, with frames inspected and damaged."""

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from asi_actuator.driver.frames import Frames
from asi_actuator.driver.pseudo_terminals import LinkedTerminals

END: Final = b'\r'
# change(line) returns what arrives of a line (with its end).
Change = Callable[[bytes], bytes]


class Direction:
    """Cuts what goes one way into lines, looks at each, and changes it."""

    def __init__(self, see: Callable[[bytes], None]):
        self._see = see
        self._rest = b''
        self.change: Change | None = None

    def __call__(self, data: bytes) -> bytes:
        *lines, self._rest = (self._rest + data).split(END)
        arrives = b''
        for line in lines:
            self._see(line)
            whole = line + END
            arrives += self.change(whole) if self.change and line[:1] == b't' else whole
        return arrives


class Wire:
    """Node and actuator are at `node` and `peer`, paths that stay when the bus is replaced."""

    def __init__(self, folder: Path):
        self._frames = Frames()
        self.node, self.peer = folder / 'bus-of-node', folder / 'bus-of-actuator'
        self.forces: set[float] = set()
        self.mark()
        self.last_enabled = (False, -math.inf)
        self.last_command_n = 0.0
        self._plug()

    def mark(self) -> None:
        """Forget when the valve was shut; look for it from now on."""
        self.marked = time.monotonic()
        self.shut_commanded_s: float | None = None
        self.shut_s: float | None = None

    def driven(self) -> bool:
        """Return whether the valve follows a command: both ends have just said so."""
        enabled, at = self.last_enabled
        return enabled and self.last_command_n != 0.0 and time.monotonic() - at < 0.1

    def unplug(self) -> None:
        """Take the bus away."""
        self._link.close()

    def replug(self) -> None:
        """Bring a new bus."""
        self._plug()

    def close(self) -> None:
        """Take the bus away for good."""
        self._link.close()

    def _plug(self) -> None:
        self.to_peer, self.to_node = Direction(self._see), Direction(self._see)
        self._link = LinkedTerminals(to_first=self.to_node, to_second=self.to_peer)
        for path, terminal in ((self.node, self._link.first), (self.peer, self._link.second)):
            path.unlink(missing_ok=True)
            path.symlink_to(terminal)

    def _see(self, line: bytes) -> None:
        """Store the contents of an undamaged frame."""
        if line[:1] != b't':
            return
        try:
            decoded = self._frames.decode(int(line[1:4], 16), bytes.fromhex(line[5:].decode()))
        except ValueError:
            return  # cut by a terminal that was full, as nobody had read for a second
        since = time.monotonic() - self.marked
        if decoded is None:
            return
        name, values = decoded
        if name == 'COMMAND':
            self.last_command_n = values['valve_command']
            if not values['enable'] and self.shut_commanded_s is None:
                self.shut_commanded_s = since
        if name == 'STATE_FORCE':
            self.forces.add(round(values['force'], 3))
            self.last_enabled = bool(values['enabled']), time.monotonic()
            if not values['enabled'] and self.shut_s is None:
                self.shut_s = since
