"""A loop that runs on and on: memory, descriptors and threads stay as they are."""

import time
from pathlib import Path
from typing import Final, NamedTuple

from asi_actuator.topics import nanoseconds
from torture.rig import ACTUATOR, CONTROLLER, RECORDER, NodeProcess, Rig, Tally, until

# What may come on top of the first third of the run.
MORE_MB: Final = 10.0
MORE_FILES: Final = 2
MORE_THREADS: Final = 1


class Use(NamedTuple):
    """What a process uses."""

    megabytes: float
    files: int
    threads: int


def _use(process: NodeProcess) -> Use:
    place = Path('/proc') / str(process.pid)
    status = dict(line.split(':\t', 1) for line in
                  (place / 'status').read_text().splitlines() if ':\t' in line)
    return Use(int(status['VmRSS'].split()[0]) / 1024.0, len(list((place / 'fd').iterdir())),
               int(status['Threads']))


def soak(rig: Rig, tally: Tally, end: float) -> None:
    """Run the recorded loop, first in lock-step, then in real time."""
    middle = (time.monotonic() + end) / 2.0
    for mode, mode_end in (('lockstep', middle), ('realtime', end)):
        _soak(rig, tally, mode, mode_end)
    if trace := rig.tracebacks():
        tally.failures.append(trace)


def _soak(rig: Rig, tally: Tally, mode: str, end: float) -> None:
    """Look at what the processes use after a third of the time, and at its end."""
    states = rig.states()
    loop = {'mode': mode, 'await_recorder': True}
    nodes = {'recorder': rig.start(RECORDER, output=rig.folder / f'bag-{mode}'),
             'controller': rig.start(CONTROLLER, **loop, **{'reference.shape': 'prbs'}),
             'actuator': rig.start(ACTUATOR, **loop)}
    until(lambda: len(states) > 1000, 'the loop')
    begin = time.monotonic()
    time.sleep(max(1.0, (end - begin) / 3.0))
    before = {name: _use(node) for name, node in nodes.items()}
    time.sleep(max(1.0, end - time.monotonic()))
    tally.notes[f'{mode}: seconds of the loop'] = (
        nanoseconds(states[-1].header.stamp) - nanoseconds(states[0].header.stamp)) * 1e-9
    for name, node in nodes.items():
        now, then = _use(node), before[name]
        more = now.megabytes - then.megabytes
        worst = 'more memory, worst (MB)'
        tally.notes[worst] = max(more, tally.notes.get(worst, 0.0))
        problem = ''
        if (more > MORE_MB or now.files - then.files > MORE_FILES
                or now.threads - then.threads > MORE_THREADS):
            problem = f'uses {now}, {then} at a third of the time'
        tally.count(f'{mode}: {name}', problem)
    for node in nodes.values():
        node.stop()
