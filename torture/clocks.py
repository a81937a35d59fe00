"""Setting the system clock while a loop runs in real time; loop and bag must continue."""

import mmap
import shutil
import struct
import subprocess
import time
from pathlib import Path
from typing import Final

import numpy as np

from asi_analysis.bags.bag_file import read_contents
from asi_common.node.topics import nanoseconds
from torture.rig import ACTUATOR, CONTROLLER, RECORDER, Rig, Tally, is_alive, until

SOURCE: Final = Path(__file__).with_name('system_clock.c')
COMPILER: Final = shutil.which('cc')
RATE_HZ: Final = 200.0
# By how much the clock is set forward or back, s: from a little to more than any delay.
STEPS_S: Final = (0.05, 0.5, 5.0, 7200.0, 1e6)


class SystemClock:
    """A system clock of their own for processes that are started with `environment`."""

    def __init__(self, folder: Path):
        """Build the library that they load first; needs a C compiler."""
        library, offset = folder / 'system_clock.so', folder / 'offset'
        assert COMPILER
        subprocess.run([COMPILER, '-O1', '-shared', '-fPIC', '-o', library, SOURCE], check=True)
        offset.write_bytes(bytes(8))
        self._file = offset.open('r+b')
        self._place = mmap.mmap(self._file.fileno(), 8)
        self.environment = {'LD_PRELOAD': str(library), 'CLOCK_OFFSET': str(offset)}
        self.offset_s = 0.0

    def set(self, offset_s: float) -> None:
        """Set the clock so many seconds before the real one."""
        self.offset_s = offset_s
        self._place[:] = struct.pack('<q', round(offset_s * 1e9))


def clocks(rig: Rig, tally: Tally, end: float) -> None:
    """Set the clock back and forth under a recorded loop; look at the loop, then at the bag."""
    if not COMPILER:
        tally.notes['not tried: no C compiler'] = 1
        return
    clock = SystemClock(rig.folder)
    bag = rig.folder / 'bag'
    loop = {'mode': 'realtime', 'rate_hz': RATE_HZ}
    nodes = {
        'recorder': rig.start(RECORDER, environment=clock.environment, output=bag),
        'controller': rig.start(CONTROLLER, environment=clock.environment, **loop,
                                state_timeout=60.0, **{'reference.shape': 'prbs'}),
        'actuator': rig.start(ACTUATOR, environment=clock.environment, **loop,
                              await_recorder=True, command_timeout=60.0)}
    states = rig.states()
    rig.await_running('asi_actuator')
    while time.monotonic() < end or tally.tried < len(STEPS_S):
        step_s = rig.random.choice(STEPS_S) * rig.random.choice((-1.0, 1.0))
        # Not before 1970.
        clock.set(clock.offset_s + step_s if abs(clock.offset_s + step_s) < 1e7 else 0.0)
        count = len(states)
        until(lambda count=count: len(states) > count + RATE_HZ, 'states')
        for name in ('asi_actuator', 'asi_controller'):
            rig.await_running(name)
        problem = next((f'the {name} has ended: {node.text[-300:]}' for name, node in nodes.items()
                        if not is_alive(node)), '')
        tally.count(f'{step_s:+g} s', problem)
        if problem:
            return
    for name in ('actuator', 'recorder', 'controller'):
        if nodes[name].stop() != 0:
            tally.failures.append(f'{name}: {nodes[name].text[-300:]}')
    tally.count('the bag', disorder(bag, RATE_HZ))
    rising = np.diff([nanoseconds(state.header.stamp) for state in states])
    tally.count('the stamps', '' if (rising > 0).all() else 'they go back')


def disorder(bag: Path, rate_hz: float) -> str:
    """Return how a bag of a loop in real time is out of order, '' if it is in order."""
    topics = read_contents(bag, lambda name: True).topics
    merged = sorted((time_ns, k) for topic in topics.values()
                    for k, time_ns in enumerate(topic.log_ns))
    if any(np.any(np.diff(topic.log_ns) < 0) for topic in topics.values()):
        return 'log times go back'
    gap_s = max(np.diff([time_ns for time_ns, _ in merged])) * 1e-9
    # Between the longest period on a busy machine and the steps of the clock.
    if gap_s > 1e6 / rate_hz:
        return f'a gap of {gap_s:.3f} s'
    return ''
