"""
How long `asi gap` takes: the full model, 10 s at 1 kHz, with each effect of the vocabulary.

A machine is the simulator itself on a spring, with one effect at its example, recorded in the loop
of the two nodes with noise on every signal. Wall time of the diagnosis, compiled code loaded. All
take some 20 minutes; Ctrl-C ends it with the table of those that are done.

    python -m bench.gap_speed [--quick]      # --quick: the unchanged machine and one effect
"""

import sys
import time
from contextlib import suppress
from typing import Final

import numpy as np
from rich.console import Console
from rich.table import Table

from asi_actuator.model.effects import EFFECTS
from asi_analysis.bags.run import Run
from asi_analysis.gap.diagnose import diagnose
from asi_analysis.loop.closed_loop import simulate_loop
from asi_common.parameter import Value
from asi_examiner.own import EXCITATIONS, NOISE

NOMINAL: Final[dict[str, Value]] = {'load.type': 'spring'}
CONTROLLER: Final[dict[str, Value]] = {
    **EXCITATIONS['loop'], 'reference.amplitude': 250.0, 'reference.start': 0.05}
DURATION_S, RATE_HZ = 10.0, 1000.0


def recorded(effect: dict[str, Value]) -> Run:
    """Return the recording of a machine with an effect."""
    signals = simulate_loop(NOMINAL | effect, CONTROLLER, DURATION_S, RATE_HZ)._asdict()
    rng = np.random.default_rng(1)
    for name, level in NOISE.items():
        signals[name] = signals[name] + level * rng.standard_normal(signals[name].size)
    del signals['reference_n']
    return Run(**signals)


def measure(count: int) -> Table:
    """Return the table of the unchanged machine and of the first `count` effects."""
    machines: dict[str, dict[str, Value]] = {'none': {}} | {
        each.name: dict(each.example) for each in EFFECTS[:count]}
    diagnose([recorded({})], NOMINAL)   # loads the compiled code
    table = Table('effect', 'answer', 'probability', 'wall, s', 'processor, s')
    walls: list[float] = []
    with suppress(KeyboardInterrupt):
        for name, effect in machines.items():
            run, wall, used = recorded(effect), time.perf_counter(), time.process_time()
            answer = diagnose([run], NOMINAL)
            walls.append(time.perf_counter() - wall)
            table.add_row(name, '+'.join(answer.verdict) or 'no_gap',
                          f'{answer.joined[answer.verdict]:.2f}', f'{walls[-1]:.1f}',
                          f'{time.process_time() - used:.1f}')
            print(f'{len(walls)} of {len(machines)}: {name}, {walls[-1]:.1f} s', file=sys.stderr)
    if walls:
        table.caption = (f'wall time of {len(walls)} of {len(machines)}: median '
                         f'{np.median(walls):.1f} s (to reach: 5), worst {max(walls):.1f} s '
                         '(to reach: 20)')
    return table


if __name__ == '__main__':
    Console(width=100).print(measure(1 if '--quick' in sys.argv else len(EFFECTS)))
