"""
Run the scenarios for TORTURE_MINUTES and print the number of faults and losses.

Without TORTURE_MINUTES: ten thousand damaged files and ten thousand calls, and 10 minutes for the
other scenarios.
"""

import contextlib
import math
import os
import random
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from torture.bags import bags
from torture.clocks import clocks
from torture.disk import disk
from torture.endings import endings
from torture.frames import frames
from torture.inputs import inputs
from torture.lockstep import lockstep
from torture.messages import messages
from torture.options import options
from torture.parameters import parameters
from torture.processes import processes
from torture.rig import NotThere, Rig, Tally
from torture.soak import soak
from torture.watchdogs import watchdogs

# Share of the time for each scenario.
SCENARIOS: dict[Callable[[Rig, Tally, float], None], float] = {
    watchdogs: 0.05, processes: 0.15, frames: 0.1, messages: 0.1, parameters: 0.1, bags: 0.05,
    disk: 0.05, clocks: 0.05, lockstep: 0.1, soak: 0.05, inputs: 0.1, options: 0.1,
    endings: 0.05,
}
# Those that end by themselves, after ten thousand; their time is limited if one is given.
WHOLE = (inputs, options)
# The same seed for a scenario breaks the same things in the same order.
SEED = int(os.environ.get('TORTURE_SEED', '1'))
# Seconds between two lines without a terminal, and between two states of the bar.
LINE_S = 30.0
BAR_S = 0.5


def main() -> int:
    """Return 1 if a fault was not survived."""
    given = os.environ.get('TORTURE_MINUTES')
    minutes = float(given or '10')
    names = sys.argv[1:]
    os.environ.setdefault('ROS_DOMAIN_ID', str(42 + os.getpid() % 50))
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    console = Console(stderr=True)
    tallies = []
    with tempfile.TemporaryDirectory(prefix='torture-') as folder:
        for scenario, share in SCENARIOS.items():
            if names and scenario.__name__ not in names:
                continue
            tally = Tally(scenario.__name__)
            tallies.append(tally)
            rig = Rig(Path(folder) / tally.name, random.Random(SEED))
            begin, lasts_s = time.monotonic(), 60.0 * minutes * (1.0 if names else share)
            if scenario in WHOLE and not given:
                lasts_s = math.inf
            with _shown(console, tally, lasts_s):
                try:
                    scenario(rig, tally, begin + lasts_s)
                except NotThere as error:
                    tally.count('scenario', f'{error}: {rig.last_words()}')
                finally:
                    rig.close()
            console.print(f'{tally.name}: {tally.survived} of {tally.tried} survived, '
                          f'{time.monotonic() - begin:.0f} s')
    _print(tallies)
    return 1 if any(tally.failures for tally in tallies) else 0


@contextlib.contextmanager
def _shown(console: Console, tally: Tally, lasts_s: float) -> Iterator[None]:
    """Show the progress of a scenario: a bar in a terminal, else a line from time to time."""
    over = threading.Event()
    begin = time.monotonic()

    def passed() -> tuple[float, str]:
        failed = f', {len(tally.failures)} not survived' if tally.failures else ''
        return time.monotonic() - begin, f'{tally.name}: {tally.tried} tried{failed}'

    def lines() -> None:
        printed = 0
        while not over.wait(LINE_S):
            console.print('{1}, {0:.0f} s'.format(*passed()))
            for failure in tally.failures[printed:]:   # at once: a later one may end the process
                console.print(f'not survived: {failure}', markup=False)
                printed += 1

    def moving(bars: Progress) -> None:
        task = bars.add_task('', total=lasts_s if lasts_s < math.inf else None)
        while not over.wait(BAR_S):
            bars.update(task, completed=passed()[0], description=passed()[1])

    bars = Progress(TextColumn('{task.description}'), BarColumn(), TimeRemainingColumn(),
                    console=console, transient=True)
    with bars if console.is_terminal else contextlib.nullcontext():
        follower = threading.Thread(target=moving if console.is_terminal else lines,
                                    args=(bars,) if console.is_terminal else (), daemon=True)
        follower.start()
        try:
            yield
        finally:
            over.set()
            follower.join()


def _print(tallies: list[Tally]) -> None:
    table = Table('scenario', 'faults tried', 'survived', 'samples lost',
                  'worst time to a shut valve (s)', 'notes')
    for tally in tallies:
        table.add_row(tally.name, str(tally.tried), str(tally.survived), str(tally.samples_lost),
                      f'{max(tally.zero_s):.3f}' if tally.zero_s else '',
                      '\n'.join(f'{name}: {value:.4g}' for name, value in tally.notes.items()))
    table.add_section()
    zeros = [zero for tally in tallies for zero in tally.zero_s]
    table.add_row('all', *(str(sum(getattr(tally, name) for tally in tallies))
                           for name in ('tried', 'survived', 'samples_lost')),
                  f'{max(zeros):.3f}' if zeros else '', '')
    console = Console(width=None if sys.stdout.isatty() else 130)
    console.print(table)
    for tally in tallies:
        for failure in tally.failures:
            console.print(f'[red]not survived[/]: {tally.name}: {failure}', markup=True)


if __name__ == '__main__':
    sys.exit(main())
