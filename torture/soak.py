"""
A loop that runs for a long time: memory, descriptors and threads must not grow.

One of the scenarios of `make torture`, for its share of the time; alone, `make soak` is an hour of
simulated lock-step and ten minutes of real time, with a table of what each process uses.
"""

import argparse
import os
import random
import sys
import tempfile
import time
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import yaml
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from scipy.stats import theilslopes

from torture.rig import ACTUATOR, CONTROLLER, RECORDER, NodeProcess, Rig, Tally, is_alive, until

# Allowed growth after the first third of the time, which is the warm-up, MB.
MORE_MB: Final = 10.0
MORE_FILES: Final = 2
MORE_THREADS: Final = 1
LOOK_S: Final = 0.5
FEWEST_LOOKS: Final = 6


class Leg(NamedTuple):
    """A part of the soak: so long (s of the loop; 0: without end) in this mode, at this rate."""

    mode: str
    rate_hz: float
    duration_s: float


class Use(NamedTuple):
    """What a process uses, when the loop has run for so long."""

    loop_s: float
    megabytes: float
    files: int
    threads: int


class Series(NamedTuple):
    """What a process has used: at the start, at a third of the time, at the end."""

    start: Use
    warm: Use
    end: Use
    megabytes_per_hour: float   # of the loop, after the first third; see _series

    @property
    def megabytes(self) -> float:
        """How much memory has grown steadily after the first third."""
        return self.megabytes_per_hour * (self.end.loop_s - self.warm.loop_s) / 3600.0

    @property
    def problem(self) -> str:
        """What has grown after the first third, '' if nothing."""
        if (self.megabytes > MORE_MB
                or self.end.files - self.warm.files > MORE_FILES
                or self.end.threads - self.warm.threads > MORE_THREADS):
            return f'uses {self.end}, {self.warm} at a third of the time'
        return ''


def _use(process: NodeProcess, loop_s: float) -> Use:
    place = Path('/proc') / str(process.pid)
    status = dict(line.split(':\t', 1) for line in
                  (place / 'status').read_text().splitlines() if ':\t' in line)
    return Use(loop_s, int(status['VmRSS'].split()[0]) / 1024.0,
               len(list((place / 'fd').iterdir())), int(status['Threads']))


def _series(uses: list[Use]) -> Series:
    """
    Return what was used; the growth is the median slope of all pairs (Theil and Sen).

    So a single step does not count: messages that queue while the machine stalls take memory that
    the process keeps. A leak grows all the time.
    """
    warm = len(uses) // 3
    time_h, megabytes = np.array([(use.loop_s / 3600.0, use.megabytes) for use in uses[warm:]]).T
    return Series(uses[0], uses[warm], uses[-1], float(theilslopes(megabytes, time_h).slope))


def soak(rig: Rig, tally: Tally, end: float) -> None:
    """Run the recorded loop, first in lock-step, then in real time."""
    middle = (time.monotonic() + end) / 2.0
    for leg, leg_end in ((Leg('lockstep', 5000.0, 0.0), middle),
                         (Leg('realtime', 1000.0, 0.0), end)):
        _soak(rig, tally, leg, leg_end)


def _soak(rig: Rig, tally: Tally, leg: Leg, end: float,
          progress: Progress | None = None) -> dict[str, Series]:
    """Run a leg until it is over or time.monotonic() is `end`; return what was used."""
    bag = rig.folder / f'bag-{leg.mode}'
    rig.diagnostics.clear()
    # The speed of the machine is not tested here: a late command is no fault.
    loop = {'mode': leg.mode, 'rate_hz': leg.rate_hz, 'await_recorder': True}
    nodes = {'recorder': rig.start(RECORDER, output=bag),
             'controller': rig.start(CONTROLLER, **loop, gain=1.0, state_timeout=60.0,
                                     **{'reference.shape': 'prbs'}),
             'actuator': rig.start(ACTUATOR, **loop, duration=leg.duration_s,
                                   command_timeout=60.0, give_up_after=60.0)}

    def ticks() -> int:
        return int(rig.diagnostics.get('asi_actuator', {}).get('ticks', 0))

    until(lambda: ticks() > 1000, 'the loop')
    task = progress and progress.add_task(leg.mode, total=leg.duration_s or None)
    uses: dict[str, list[Use]] = {name: [] for name in nodes}
    # At least a few samples, however little time is left.
    while all(map(is_alive, nodes.values())) and (
            time.monotonic() < end or len(uses['actuator']) < FEWEST_LOOKS):
        loop_s = ticks() / leg.rate_hz
        for name, node in nodes.items():
            if not uses[name] or loop_s > uses[name][-1].loop_s:
                uses[name].append(_use(node, loop_s))
        if progress and task is not None:
            progress.update(task, completed=loop_s)
        time.sleep(LOOK_S)
    problem = next((f'the {name} has ended' for name in ('recorder', 'controller')
                    if not is_alive(nodes[name])), '')
    if leg.duration_s and nodes['actuator'].exit_status() != 0:
        problem = f'the actuator has ended: {nodes["actuator"].text[-300:]}'
    for name in ('actuator', 'recorder', 'controller'):
        if is_alive(nodes[name]) and nodes[name].stop() != 0:
            problem = f'the {name} has ended: {nodes[name].text[-300:]}'
    lost = sum(int(line.split('[ERROR]')[-1].split(': ')[1].split()[0])
               for line in nodes['recorder'].text.splitlines() if 'were lost' in line)
    tally.samples_lost += lost
    recorded = _recorded(bag)
    if leg.duration_s and recorded != round(leg.duration_s * leg.rate_hz):
        problem = f'{recorded} states are recorded'
    tally.count(f'{leg.mode}: the run', problem or rig.tracebacks())
    tally.notes[f'{leg.mode}: states recorded'] = recorded
    # Without the last: the actuator may have been ending already.
    series = {name: _series(of_node[:-1]) for name, of_node in uses.items()}
    worst = 'more memory, worst (MB)'
    for name, of_node in series.items():
        tally.notes[worst] = max(of_node.megabytes, tally.notes.get(worst, 0.0))
        tally.count(f'{leg.mode}: {name}', of_node.problem)
    return series


def _recorded(bag: Path) -> int:
    """Return how many states a finished bag holds."""
    described = yaml.safe_load((bag / 'metadata.yaml').read_text())['rosbag2_bagfile_information']
    return next(topic['message_count'] for topic in described['topics_with_message_count']
                if topic['topic_metadata']['name'] == '/joint_states')


def main() -> int:
    """Run both legs to their ends, print what was used; 1 if anything has grown or was lost."""
    parser = argparse.ArgumentParser(prog='python -m torture.soak', description=main.__doc__)
    parser.add_argument('--lockstep', type=float, default=3600.0, metavar='S',
                        help='simulated time')
    parser.add_argument('--lockstep-rate', type=float, default=1000.0, metavar='HZ')
    parser.add_argument('--realtime', type=float, default=600.0, metavar='S')
    parser.add_argument('--realtime-rate', type=float, default=1000.0, metavar='HZ')
    options = parser.parse_args()
    os.environ.setdefault('ROS_DOMAIN_ID', str(42 + os.getpid() % 50))
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    legs = (Leg('lockstep', options.lockstep_rate, options.lockstep),
            Leg('realtime', options.realtime_rate, options.realtime))
    table = Table('', 'after (s)', 'memory (MB)', 'growth (MB/h)', 'files', 'threads',
                  caption='Times are those of the loop; growth is after the first third.')
    tally = Tally('soak')
    with tempfile.TemporaryDirectory(prefix='soak-') as folder:
        rig = Rig(Path(folder) / 'legs', random.Random(1))
        try:
            with Progress(console=Console(stderr=True)) as progress:
                for leg in filter(lambda leg: leg.duration_s, legs):
                    begin = time.monotonic()
                    series = _soak(rig, tally, leg, float('inf'), progress)
                    table.add_section()
                    table.add_row(f'[bold]{leg.mode}, {leg.rate_hz:g} Hz, '
                                  f'{time.monotonic() - begin:.0f} s[/]')
                    for name, of_node in series.items():
                        _add_rows(table, name, of_node)
        finally:
            rig.close()
    console = Console(width=None if sys.stdout.isatty() else 100)
    console.print(table)
    for name, value in tally.notes.items():
        console.print(f'{name}: {value:.6g}')
    console.print(f'messages lost on the way to the bag: {tally.samples_lost}')
    for failure in tally.failures:
        console.print(f'[red]not survived[/]: {failure}')
    return 1 if tally.failures or tally.samples_lost else 0


def _add_rows(table: Table, name: str, series: Series) -> None:
    for what, use in (('start', series.start), ('warm', series.warm), ('end', series.end)):
        table.add_row(f'{name}, {what}', f'{use.loop_s:.0f}', f'{use.megabytes:.1f}',
                      f'{series.megabytes_per_hour:+.2f}' if use is series.end else '',
                      str(use.files), str(use.threads))


if __name__ == '__main__':
    sys.exit(main())
