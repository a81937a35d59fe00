"""
Ctrl-C of every node and command, at ten times after its start, while the machine is busy.

Half of the times lie in the first second or so, in which Python starts and imports; each is tried
with compiled code in the cache, and with an empty one. TORTURE_LOAD: programs that compute
meanwhile; TORTURE_COMMANDS: only these, separated by commas.
"""

import os
import shutil
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Final, NamedTuple

from torture.options import material
from torture.rig import PATIENCE_S, ROOT, Rig, Tally

MOMENTS: Final = 10
# Earliest and latest Ctrl-C after the start of a command, s; times between are in proportion.
EARLIEST_S: Final = 0.05
LONGEST_S: Final = 12.0
# Required time to end, s. A longer time is reported, but is no failure, as the machine may be too
# busy; not to end at all is a failure.
SOON_S: Final = 2.0
# Number of programs that compute beside the commands, as load.
LOAD: Final = int(os.environ.get('TORTURE_LOAD', '0'))
NAMED: Final = [name for name in os.environ.get('TORTURE_COMMANDS', '').split(',') if name]
# Marks the processes of a trial, so that one that is left behind is found.
MARK: Final = 'TORTURE_ENDING'
# Exit statuses after Ctrl-C: 0 for what serves until it is stopped; 130 for a command that
# computes an answer, or 0 or 1 (a check failed) if it has answered in the meantime.
SERVES, ANSWERS = {0}, {130, 0, 1}


class Command(NamedTuple):
    """A command, by name, and the exit statuses that Ctrl-C may leave."""

    name: str
    arguments: list[str]
    statuses: set[int]


def executable(module: str, name: str, *arguments: str) -> Command:
    """Return an executable as `ros2 run` starts it."""
    return Command(name, [sys.executable, '-c', f'import sys; from {module} import {name}; '
                          f'sys.exit({name}())', *arguments], SERVES)


def asi(*arguments: str, statuses: set[int] = ANSWERS) -> Command:
    """Return a call of `asi`."""
    return Command(f'asi {arguments[0]}', [
        sys.executable, '-c',
        'import sys; from asi_analysis.command import asi; sys.exit(asi())',
        *arguments], statuses)


def commands() -> list[Command]:
    """Return every node, and every command that takes longer than a moment."""
    nodes, bags = 'asi_actuator.executables', 'asi_analysis.bags.nodes.executables'
    found = [
        executable(nodes, 'actuator'), executable('asi_controller.executables', 'controller'),
        executable(nodes, 'can_actuator', '--pty'),
        executable(bags, 'recorder', '--ros-args', '-p', 'output:=new_bag'),
        executable(bags, 'replay', '--ros-args', '-p', 'bag:=bag', '-p', 'loop:=true'),
        # Before it serves, it is a command that has not answered.
        asi('live', '--simulate', '--no-browser', '--port', '18731', statuses=SERVES | ANSWERS),
        asi('run', '--duration', '60', '--out', 'new_run'), asi('demo', '--out', 'new_demo'),
        asi('analyze', 'bag'), asi('limit-cycle', 'bag'), asi('gap', 'bag'), asi('attribute'),
        asi('predict'), asi('quench'), asi('reproduce'), asi('calibrate'), asi('ensemble'),
        asi('tune'), asi('sweep', '--over', 'controller.gain=1:10:10'),
        asi('compare', 'lead4', 'proportional')]
    if find_spec('rerun'):
        found.append(asi('view', 'bag', '--out', 'new.rrd'))
    if ros2 := shutil.which('ros2'):
        launch = [ros2, 'launch', str(ROOT / 'launch' / 'asi_actuator.launch.py')]
        found += [Command('ros2 launch', [*launch, 'reference:=sine'], SERVES),
                  Command('ros2 launch record:=', [*launch, 'reference:=sine', 'mode:=realtime',
                                                   'record:=new_bag'], SERVES)]
    return [each for each in found if not NAMED or each.name in NAMED]


@contextmanager
def busy(programs: int) -> Iterator[None]:
    """Have programs compute."""
    started = [subprocess.Popen([sys.executable, '-c', 'while True: pass'])
               for _ in range(programs)]
    try:
        yield
    finally:
        for each in started:
            each.kill()
            each.wait()


def endings(rig: Rig, tally: Tally, end: float) -> None:
    """Interrupt each command at each of its times, in random order, until the time is over."""
    folder = rig.folder / 'endings'
    folder.mkdir()
    material(folder, 1.2)
    trials = [(command, moment, cold) for command in commands() for moment in range(MOMENTS)
              for cold in (False, True)]
    rig.random.shuffle(trials)
    ended: dict[str, list[Ending]] = {}
    lasts: dict[str, float] = {}
    with busy(LOAD):
        for command, moment, cold in trials:
            if time.monotonic() > end and tally.tried:
                break
            if command.name not in lasts:
                begin = time.monotonic()
                with running(command, folder) as process, suppress(subprocess.TimeoutExpired):
                    process.wait(LONGEST_S)
                lasts[command.name] = min(time.monotonic() - begin, LONGEST_S)
            latest_s = LONGEST_S if cold else lasts[command.name]
            after_s = EARLIEST_S * (latest_s / EARLIEST_S) ** (moment / (MOMENTS - 1))
            ending = interrupted(command, after_s, cold, folder)
            tally.count(f'{command.name} after {after_s:.2f} s' + ', to compile' * cold,
                        ending.problem)
            ended.setdefault(command.name, []).append(ending)
    for name, each in sorted(ended.items()):
        met = [ending for ending in each if ending.met]
        tally.notes[f'{name}: longest of {len(met)} (s)'] = max(
            (ending.seconds for ending in met), default=0.0)
    every = [ending for each in ended.values() for ending in each if ending.met]
    tally.notes['median (s)'] = statistics.median([ending.seconds for ending in every] or [0.0])
    tally.notes[f'later than {SOON_S:g} s, of {len(every)}'] = sum(
        ending.seconds > SOON_S for ending in every)
    tally.notes[f'Python interrupted before our first line, of {len(every)}'] = sum(
        ending.early for ending in every)
    tally.notes['load at the end'] = os.getloadavg()[0]


class Ending(NamedTuple):
    """
    How a command ended after Ctrl-C.

    problem: what is wrong, '' for nothing; met: Ctrl-C came before its own end; early: Python was
    interrupted while it started, before any line of ours, and says so by a traceback of its own.
    """

    seconds: float
    problem: str = ''
    met: bool = True
    early: bool = False


def interrupted(command: Command, after_s: float, cold: bool, folder: Path) -> Ending:
    """Return how a command ends that is interrupted after a time; cold: with an empty cache."""
    with running(command, folder, cold) as process:
        with suppress(subprocess.TimeoutExpired):
            process.wait(after_s)
        begin = time.monotonic()
        met, handled = process.poll() is None, handles_ctrl_c(process.pid)
        if met:
            # To the whole process group, as a terminal does.
            os.killpg(process.pid, signal.SIGINT)
        try:
            status = process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            return Ending(PATIENCE_S, f'has not ended {PATIENCE_S:g} s after Ctrl-C')
        seconds = time.monotonic() - begin
        while others := left(folder):
            if time.monotonic() - begin > PATIENCE_S:
                return Ending(seconds, f'has left processes behind: {others}')
            time.sleep(0.01)
    said = (folder / 'said').read_text(errors='replace')
    if met and (f'{ROOT}/asi_' not in said if 'Traceback' in said else not handled and not said):
        return Ending(seconds, early=True)
    if status not in command.statuses or 'Traceback' in said:
        return Ending(seconds, f'exit status {status}: {said[-600:]}', met)
    return Ending(seconds, '', met)


def handles_ctrl_c(pid: int) -> bool:
    """Return whether a process has a handler of SIGINT, as Python has a moment after its start."""
    try:
        status = Path(f'/proc/{pid}/status').read_text()
    except OSError:   # it has ended
        return False
    caught, = (int(line.split()[1], 16) for line in status.splitlines()
               if line.startswith('SigCgt:'))
    return bool(caught >> (signal.SIGINT - 1) & 1)


def left(folder: Path) -> list[str]:
    """Return the command lines of the processes of a trial, which have its folder as mark."""
    mark = f'{MARK}={folder}'.encode()
    found = []
    for process in Path('/proc').glob('[0-9]*'):
        with suppress(OSError):   # it has ended
            if mark in (process / 'environ').read_bytes().split(b'\0'):
                found.append((process / 'cmdline').read_text().replace('\0', ' ')[:200])
    return found


@contextmanager
def running(command: Command, folder: Path, cold: bool = False) -> Iterator[subprocess.Popen]:
    """Run a command in a folder without what earlier ones have written, then end it."""
    for name in ('new', 'runs'):
        for path in folder.glob(f'{name}*'):
            shutil.rmtree(path, ignore_errors=True)
    environment = {**os.environ, MARK: str(folder), 'PYTHONPATH': os.pathsep.join(
        [str(ROOT), os.environ.get('PYTHONPATH', '')])}
    if cold:
        environment['NUMBA_CACHE_DIR'] = str(folder / 'new_cache')
    with (folder / 'said').open('w') as said:
        process = subprocess.Popen(
            command.arguments, cwd=folder, env=environment, stdin=subprocess.DEVNULL,
            stdout=said, stderr=subprocess.STDOUT, start_new_session=True)
    try:
        yield process
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
