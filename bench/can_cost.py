"""What a control period over CAN costs in computing time; `python bench/can_cost.py`."""

import time
from collections.abc import Callable

import can
from can.interfaces.slcan import slcanBus

from asi_actuator.driver.can_bus import open_bus
from asi_actuator.driver.frames import Frames
from asi_actuator.driver.pseudo_terminals import LinkedTerminals

REPEATS = 2000


def nothing() -> None:
    pass


def report(name: str, action: Callable[[], object], after: Callable[[], object] = nothing) -> None:
    """Print the shortest time of an action; after() follows each and is not counted."""
    shortest = float('inf')
    for _ in range(REPEATS):
        begin = time.perf_counter()
        action()
        shortest = min(shortest, time.perf_counter() - begin)
        after()
    print(f'{name:26}{1e6 * shortest:6.1f} us')


def main() -> None:
    frames = Frames()
    state = dict.fromkeys(('force', 'valve_position', 'enabled', 'command_lost', 'saturated',
                           'counter'), 0)
    data = frames.encode('STATE_FORCE', state)
    identifier = frames.identifiers['STATE_FORCE']
    message = can.Message(arbitration_id=identifier, data=data, is_extended_id=False)
    command = {'valve_command': 1.0, 'enable': 1, 'counter': 1}
    report('encode a command', lambda: frames.encode('COMMAND', command))
    report('decode a state frame', lambda: frames.decode(identifier, data))
    link = LinkedTerminals()
    first = open_bus('slcan', link.first, 1_000_000)
    own = open_bus('slcan', link.second, 1_000_000)
    librarys = slcanBus(link.second, sleep_after_open=0.0, timeout=0.0)
    for name, bus in (('SlcanBus', own), ('python-can', librarys)):
        def send() -> None:
            first.send(message, timeout=0.0)
            time.sleep(1e-3)

        send()
        report(f'read a frame, {name}', lambda bus=bus: bus.recv(0.0), send)
    for bus in (first, own, librarys):
        bus.shutdown()
    link.close()


if __name__ == '__main__':
    main()
