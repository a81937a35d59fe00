"""Start-up times: the help, the first simulation, a node."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from functools import partial
from typing import Final

import numpy as np

from bench.result import Result, interleaved, show

HELP: Final = 'asi_analysis.cli', '--help'
# Prints the seconds from the end of the import to the end of the first simulation.
FIRST: Final = """
import time
from asi_analysis.loop.closed_loop import simulate_loop
begin = time.perf_counter()
simulate_loop({}, {'reference.shape': 'step'}, 0.01)
print(time.perf_counter() - begin)
"""
NODES: Final = {'actuator': 'asi_actuator.actuator_node',
                'controller': 'asi_controller.controller_node',
                'recorder': 'asi_analysis.bags.nodes.recorder_node'}
PATIENCE_S: Final = 60.0


def run(*arguments: str, cache: str | None = None) -> str:
    """Run python with arguments, with a compile cache of its own if one is given."""
    environment = os.environ | ({'NUMBA_CACHE_DIR': cache} if cache else {})
    return subprocess.run([sys.executable, *arguments], check=True, capture_output=True,
                          text=True, env=environment).stdout


def node_ready(module: str, folder: str) -> None:
    """Start a node, wait until its services answer for it in the graph, and end it."""
    import rclpy
    listener = rclpy.create_node('ready')
    given = ('-p', f'output:={folder}/bag_{time.monotonic_ns()}') if 'recorder' in module else ()
    with subprocess.Popen([sys.executable, '-m', module, '--ros-args', *given],
                          stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        give_up = time.monotonic() + PATIENCE_S
        # A node declares its parameters first; its publishers and subscriptions are ready after.
        while not any('asi_' in name for name in listener.get_node_names()):
            if time.monotonic() > give_up:
                raise RuntimeError(f'{module} is not there after {PATIENCE_S:g} s')
            time.sleep(0.005)
        process.send_signal(signal.SIGINT)
    while any('asi_' in name for name in listener.get_node_names()):
        time.sleep(0.005)
    listener.destroy_node()


def measure(quick: bool) -> list[Result]:
    """Return the times by the clock."""
    import rclpy
    rounds = 2 if quick else 5
    empty, helped = interleaved({'python': partial(run, '-c', ''),
                                 'help': partial(run, '-m', *HELP)}, rounds).values()
    warm = [float(run('-c', FIRST)) for _ in range(rounds)]
    with tempfile.TemporaryDirectory() as cache:
        cold = float(run('-c', FIRST, cache=cache))
    imported = interleaved({'import': partial(run, '-c', 'import asi_analysis.loop.closed_loop')},
                           rounds)['import']
    results = [
        Result('start.help', 'asi --help', float(np.median(helped)), 's', target='<= 0.5'),
        Result('start.python', 'python that does nothing', float(np.median(empty)), 's'),
        Result('start.import', 'to import the loop: numba, numpy, scipy',
               float(np.median(imported)), 's'),
        Result('start.warm', 'first simulation after the import, warm compile cache',
               float(np.median(warm)), 's', target='<= 1'),
        Result('start.cold', 'the same, nothing compiled before', cold, 's')]
    rclpy.init()
    with tempfile.TemporaryDirectory() as folder:
        for name, module in NODES.items():
            times = interleaved({name: partial(node_ready, module, folder)}, 1 if quick else 3)
            results.append(Result(f'start.{name}', f'{name}: start, discovery by another node, '
                                  'and end', float(np.median(times[name])), 's'))
    rclpy.shutdown()
    return results


if __name__ == '__main__':
    show(measure('--quick' in sys.argv))
