"""Ctrl-C of every node and command, at ten times after its start, while the machine is busy."""

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
# Latest Ctrl-C after the start of a command, s.
LONGEST_S: Final = 12.0
# Required time to end, s. A longer time is reported, but is no failure, as the machine may be too
# busy; not to end at all is a failure.
SOON_S: Final = 2.0
# Number of programs that compute beside the commands, as load.
LOAD: Final = int(os.environ.get('TORTURE_LOAD', '0'))
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
        asi('predict'), asi('quench'), asi('reproduce'), asi('calibrate'),
        asi('tune'), asi('sweep', '--over', 'controller.gain=1:10:10'),
        asi('compare', 'lead4', 'proportional')]
    if find_spec('rerun'):
        found.append(asi('view', 'bag', '--out', 'new.rrd'))
    if ros2 := shutil.which('ros2'):
        launch = [ros2, 'launch', str(ROOT / 'launch' / 'asi_actuator.launch.py')]
        found += [Command('ros2 launch', [*launch, 'reference:=sine'], SERVES),
                  Command('ros2 launch record:=', [*launch, 'reference:=sine', 'mode:=realtime',
                                                   'record:=new_bag'], SERVES)]
    return found


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
    """Interrupt each command at each of its moments, in random order, until the time is over."""
    folder = rig.folder / 'endings'
    folder.mkdir()
    material(folder, 1.2)
    trials = [(command, moment) for command in commands() for moment in range(MOMENTS)]
    rig.random.shuffle(trials)
    taken: dict[str, list[float]] = {}
    lasts: dict[str, float] = {}
    with busy(LOAD):
        for command, moment in trials:
            if time.monotonic() > end and tally.tried:
                break
            if command.name not in lasts:
                begin = time.monotonic()
                with running(command, folder) as process, suppress(subprocess.TimeoutExpired):
                    process.wait(LONGEST_S)
                lasts[command.name] = min(time.monotonic() - begin, LONGEST_S)
            after_s = lasts[command.name] * (moment + 0.5) / MOMENTS
            problem, seconds = interrupted(command, after_s, folder)
            tally.count(f'{command.name} after {after_s:.1f} s', problem)
            taken.setdefault(command.name, []).append(seconds)
    for name, each in sorted(taken.items()):
        tally.notes[f'{name}: longest of {len(each)} (s)'] = max(each)
    every = sum(taken.values(), [])
    tally.notes['median (s)'] = statistics.median(every)
    tally.notes[f'later than {SOON_S:g} s, of {len(every)}'] = sum(s > SOON_S for s in every)
    tally.notes['load at the end'] = os.getloadavg()[0]


def interrupted(command: Command, after_s: float, folder: Path) -> tuple[str, float]:
    """Return what is wrong after Ctrl-C, '' for nothing, and how long it took to end, s."""
    with running(command, folder) as process:
        with suppress(subprocess.TimeoutExpired):
            process.wait(after_s)
        begin = time.monotonic()
        if process.poll() is None:
            # To the whole process group, as a terminal does.
            os.killpg(process.pid, signal.SIGINT)
        try:
            status = process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            return f'has not ended {PATIENCE_S:g} s after Ctrl-C', PATIENCE_S
        seconds = time.monotonic() - begin
    said = (folder / 'said').read_text(errors='replace')
    if status not in command.statuses or 'Traceback' in said:
        return f'exit status {status}: {said[-600:]}', seconds
    return '', seconds


@contextmanager
def running(command: Command, folder: Path) -> Iterator[subprocess.Popen]:
    """Run a command in a folder without what earlier ones have written, then end it."""
    for name in ('new', 'runs'):
        for path in folder.glob(f'{name}*'):
            shutil.rmtree(path, ignore_errors=True)
    environment = {**os.environ, 'PYTHONPATH': os.pathsep.join(
        [str(ROOT), os.environ.get('PYTHONPATH', '')])}
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
