"""Computing time of a control period over CAN."""

import statistics
import sys
import time
from collections.abc import Callable

import can
from can.interfaces.slcan import slcanBus

from asi_actuator.driver.can_bus import open_bus
from asi_actuator.driver.frames import Frames
from asi_actuator.driver.pseudo_terminals import LinkedTerminals
from bench.result import Result, deviation, show

REPEATS = 2000


def nothing() -> None:
    pass


def timed(name: str, what: str, action: Callable[[], object], repeats: int,
          after: Callable[[], object] = nothing) -> Result:
    """Return the time of an action; after() follows each and is not counted."""
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        action()
        times.append(1e6 * (time.perf_counter() - begin))
        after()
    return Result(f'can.{name}', what, statistics.median(times), 'us', deviation(times))


def measure(quick: bool) -> list[Result]:
    """Return the time to encode and to read a frame, ours and that of python-can's own bus."""
    repeats = REPEATS // 20 if quick else REPEATS
    frames = Frames()
    state = dict.fromkeys(('force', 'valve_position', 'enabled', 'command_lost', 'saturated',
                           'counter'), 0)
    data = frames.encode('STATE_FORCE', state)
    identifier = frames.identifiers['STATE_FORCE']
    message = can.Message(arbitration_id=identifier, data=data, is_extended_id=False)
    command = {'valve_command': 1.0, 'enable': 1, 'counter': 1}
    results = [
        timed('encode', 'to encode a command', lambda: frames.encode('COMMAND', command), repeats),
        timed('decode', 'to decode a state frame', lambda: frames.decode(identifier, data),
              repeats)]
    link = LinkedTerminals()
    first = open_bus('slcan', link.first, 1_000_000)
    own = open_bus('slcan', link.second, 1_000_000)
    librarys = slcanBus(link.second, sleep_after_open=0.0, timeout=0.0)

    def send() -> None:
        first.send(message, timeout=0.0)
        time.sleep(1e-3)

    read = []
    for name, bus in (('ours', own), ('library', librarys)):
        send()
        read.append(timed(name, 'to read a frame over slcan', lambda bus=bus: bus.recv(0.0),
                          repeats, send))
    for bus in (first, own, librarys):
        bus.shutdown()
    link.close()
    mine, theirs = read
    return [*results, mine._replace(rival="python-can's bus", ratio=mine.value / theirs.value,
                                    spread=mine.spread / theirs.value)]


if __name__ == '__main__':
    show(measure('--quick' in sys.argv))
