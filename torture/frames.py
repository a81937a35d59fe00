"""Damaged CAN frames, and loss of the bus."""

import time
from collections import deque
from random import Random
from typing import Final

from torture.processes import Loop
from torture.rig import NotThere, Rig, Tally, is_alive, until
from torture.wire import END

# Share of the lines that are damaged.
SHARE: Final = 0.2
LENGTH_S: Final = 1.5
# Number of past lines from which frames are replayed.
PAST: Final = 400


class Damage:
    """A way to damage lines; counts how many it has."""

    def __init__(self, kind: str, random: Random):
        self.kind, self.random = kind, random
        self.damaged = 0
        self._past: deque[bytes] = deque(maxlen=PAST)
        self._late: deque[bytes] = deque()

    def __call__(self, line: bytes) -> bytes:
        self._past.append(line)
        if self.random.random() > SHARE:
            return line
        self.damaged += 1
        return getattr(self, self.kind)(line)

    def missing(self, line: bytes) -> bytes:
        return b''

    def corrupted(self, line: bytes) -> bytes:
        place = self.random.randrange(len(line))
        return line[:place] + bytes((self.random.randrange(256),)) + line[place + 1:]

    def truncated(self, line: bytes) -> bytes:
        return line[:self.random.randrange(len(line) - 1)] + END

    def repeated(self, line: bytes) -> bytes:
        return line * self.random.randint(2, 5)

    def replayed(self, line: bytes) -> bytes:
        return line + self.random.choice(self._past)

    def delayed(self, line: bytes) -> bytes:
        self._late.append(line)
        return self._late.popleft() if len(self._late) > 3 else b''

    def reordered(self, line: bytes) -> bytes:
        self._late.append(line)
        return self._late.pop() + self._late.popleft() if len(self._late) > 1 else b''

    def disturbed(self, line: bytes) -> bytes:
        return self.random.randbytes(self.random.randrange(40)) + line


KINDS: Final = ('missing', 'corrupted', 'truncated', 'repeated', 'replayed', 'delayed',
                'reordered', 'disturbed', 'unplugged')


def frames(rig: Rig, tally: Tally, end: float) -> None:
    """Each kind of damage, one after the other, both ways at once."""
    loop = Loop(rig, recorded=False)
    try:
        while time.monotonic() < end or tally.tried < len(KINDS):
            for kind in KINDS:
                try:
                    loop.run()
                    if kind == 'unplugged':
                        tally.count(kind, _unplug(loop, tally))
                    else:
                        _damage(loop, kind, tally)
                except NotThere as error:
                    tally.count(kind, str(error))
                if trace := rig.tracebacks():
                    tally.failures.append(f'{kind}: {trace}')
                    return
    finally:
        loop.wire.close()


def _damage(loop: Loop, kind: str, tally: Tally) -> None:
    """Damage lines for a while; every published force must be one that the actuator has sent."""
    ways = Damage(kind, loop.rig.random), Damage(kind, loop.rig.random)
    begin = len(loop.states)
    loop.wire.to_peer.change, loop.wire.to_node.change = ways
    time.sleep(LENGTH_S)
    loop.wire.to_peer.change = loop.wire.to_node.change = None
    time.sleep(0.2)
    problem = ''
    for name in ('peer', 'actuator'):
        if not is_alive(loop.processes[name]):
            problem = f'{name} has ended: {loop.processes[name].text[-500:]}'
    wrong = {round(state.effort[0], 3) for state in loop.states[begin:]} - loop.wire.forces
    if wrong:
        problem = f'forces that the actuator has not measured: {sorted(wrong)[:5]}'
    tally.notes['wrong numbers'] = tally.notes.get('wrong numbers', 0) + len(wrong)
    tally.count(kind, problem, sum(way.damaged for way in ways))


def _unplug(loop: Loop, tally: Tally) -> str:
    loop.wire.unplug()
    begin = time.monotonic()
    until(lambda: loop.rig.diagnostics['asi_actuator']['state'] == 'fault'
          and loop.rig.diagnostics['asi_actuator']['at'] > begin, 'the fault')
    tally.zero_s.append(loop.rig.diagnostics['asi_actuator']['at'] - begin)
    # The simulated actuator ends with its bus; a real firmware would close its valve.
    loop.processes['peer'].exit_status()
    loop.wire.replug()
    return '' if is_alive(loop.processes['actuator']) else 'the actuator node has ended'
