"""
What the live page costs the loop: real time at 1 kHz alone, with `asi live`, and with its tabs.

Jitter of the period and lost samples, once the tabs have loaded, in the same minutes: with the
real-time priority of the nodes, where it is permitted, and without. The tabs are of a headless
Chromium; as many of a static page that redraws as many curves show the part of the browser. A bare
loop in C shows the part of the machine: a virtual machine stalls for milliseconds, whatever runs.
Without a Chromium (`bench/browser.py`) only the process of the page is measured.
"""

import contextlib
import os
import re
import shutil
import socket
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import rclpy
from rclpy.signals import SignalHandlerOptions

from bench.browser import NoBrowserError, chromium
from bench.loop_rate import (
    CONTROLLER,
    PATIENCE_S,
    SINE,
    in_turns,
    listener,
    node,
    node_times,
    process,
)
from bench.result import Result, deviation, ratios

RATE_HZ: Final = 1000.0
LOSSES: Final = ('asi_actuator: loop', 'asi_controller: loop')
ALONE, SERVED, ONE, SHOWN = 'no page', 'asi live, no tab', 'asi live, 1 tab', 'asi live, 3 tabs'
# The static page with as many tabs.
STATIC: Final = {ONE: '1 tab of a static page', SHOWN: '3 tabs of a static page'}
TABS: Final = {each: int(text) for each in (*STATIC, *STATIC.values())
               for text in re.findall(r'(\d) tab', each)}
BARE: Final = 'a bare loop in C'
SOURCE: Final = Path(__file__).with_name('bare_loop.c')
PRIORITY: Final = 50   # default of thread_priority
# Three tabs take so long to load on two cores, s.
SETTLE_S: Final = 8.0
# Suffix for runs in which the nodes have no real-time priority.
PLAIN: Final = ', no priority'
# Three canvases as large as our charts, with as many points of a line, and the frames counted.
REDRAWN: Final = """data:text/html,<p>? frames</p>
<canvas width=950 height=208></canvas><canvas width=950 height=208></canvas>
<canvas width=950 height=256></canvas><script>
let frames = 0, since = performance.now();
function draw() {
  for (const canvas of document.querySelectorAll('canvas')) {
    const on = canvas.getContext('2d');
    on.clearRect(0, 0, canvas.width, canvas.height);
    on.beginPath();
    for (let k = 0; k < 600; k++)
      on.lineTo(k * canvas.width / 600, canvas.height * (0.5 + 0.4 * Math.sin(k / 9 + frames)));
    on.stroke();
  }
  const passed = performance.now() - since;
  frames++;
  if (passed > 1000) {
    document.querySelector('p').textContent = (1000 * frames / passed).toFixed() + ' frames/s';
    frames = 0;
    since = performance.now();
  }
  requestAnimationFrame(draw);
}
draw();
</script>"""


def free_port() -> int:
    """Return a port that nobody uses now."""
    with socket.socket() as free:
        free.bind(('127.0.0.1', 0))
        return int(free.getsockname()[1])


def serve(running: contextlib.ExitStack) -> str:
    """Start the page's process; return its address once it answers."""
    port = free_port()
    running.enter_context(process('asi_analysis.cli', 'live', '--no-browser', '--port', str(port)))
    return address_of(port)


def address_of(port: int) -> str:
    """Return the address of a page on this machine, once it answers."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        with socket.socket() as probe:
            if probe.connect_ex(('127.0.0.1', port)) == 0:
                return f'http://127.0.0.1:{port}'
        time.sleep(0.1)
    raise TimeoutError('the page does not answer')


def loop(seconds: float, settle_s: float, browser: Any, what: str) -> dict[str, float]:
    """Return the jitter of the actuator's period, samples lost, and frames/s of a tab, settled."""
    common = {'mode': 'realtime', 'rate_hz': RATE_HZ}
    if what.endswith(PLAIN):
        common['thread_priority'], what = 0, what.removesuffix(PLAIN)
    with contextlib.ExitStack() as running:
        actuator = running.enter_context(
            process(*node('bench.ticking_node', str(seconds), **common)))
        running.enter_context(process(*node(CONTROLLER, **common, **SINE)))
        static = what in STATIC.values()
        address = REDRAWN if static else '' if what == ALONE else serve(running)
        pages = [running.enter_context(browser.new_page()) for _ in range(TABS.get(what, 0))]
        for page in pages:
            page.set_default_timeout(1e3 * PATIENCE_S)
            page.goto(address)
        for page in () if static else pages:
            page.get_by_role('slider', name='gain').wait_for()
        heard = running.enter_context(listener())
        heard.run(settle_s)   # both nodes are heard, and the tabs have loaded
        before = lost(heard.values)
        heard.ticks.clear()
        heard.run(seconds)
        frames = [float(re.findall(r'(\d+) frames', page.get_by_text('frames').inner_text())[0])
                  for page in pages]
        return {'lost': lost(heard.values) - before, **node_times(actuator),
                'frames_hz': statistics.mean(frames or [0.0])}


def bare_loop(program: Path, seconds: float) -> dict[str, float]:
    """Return the periods that a loop at the nodes' priority sleeps through, and steal time (s)."""
    before = steal_s()
    said = subprocess.run([program, str(seconds), str(RATE_HZ), str(PRIORITY)], check=True,
                          capture_output=True, text=True).stdout
    return {'lost': float(said), 'steal_s': steal_s() - before}


def steal_s() -> float:
    """Return the time that a hypervisor has taken from the processors since the start, s."""
    return int(Path('/proc/stat').read_text().split()[8]) / os.sysconf('SC_CLK_TCK')


def compiled(folder: str) -> Path | None:
    """Return the program of the bare loop; None without a C compiler."""
    compiler, program = shutil.which('cc'), Path(folder) / 'bare_loop'
    if compiler is None:
        print('without the bare loop: no C compiler')
        return None
    subprocess.run([compiler, '-O2', '-o', program, SOURCE], check=True)
    return program


def lost(values: dict[str, dict[str, str]]) -> int:
    """Return the samples that both nodes miss."""
    return sum(int(values[name]['lost samples']) for name in LOSSES if name in values)


def measure(quick: bool = False) -> list[Result]:
    """Return jitter beside that without a page, losses, and frames a second."""
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    rounds, seconds, settle_s = (1, 1.0, 0.0) if quick else (3, 5.0, SETTLE_S)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    with contextlib.ExitStack() as running:
        running.callback(rclpy.shutdown)
        names, browser = [ALONE, SERVED, ALONE + PLAIN], None
        try:
            browser = running.enter_context(chromium())
            names[2:2] = [*STATIC, *STATIC.values()]
            names += [SHOWN + PLAIN, STATIC[SHOWN] + PLAIN]
        except NoBrowserError as error:
            print(f'without tabs: {error}')
        rivals: dict[str, Callable[[], Any]] = {
            name: lambda name=name: loop(seconds, settle_s, browser, name) for name in names}
        if program := compiled(running.enter_context(tempfile.TemporaryDirectory())):
            rivals[BARE] = lambda: bare_loop(program, seconds)
        found = in_turns(rivals, rounds)
    return results(found, rounds * seconds)


def results(found: dict[str, list[dict[str, float]]], seconds: float) -> list[Result]:
    """Return jitter beside that without a page, losses, and frames, of rounds of so many s."""
    bare = found.pop(BARE, [])
    rows = [Result('live_page.bare', f'periods that {BARE} sleeps through in {seconds:g} s',
                   sum(each['lost'] for each in bare), ''),
            Result('live_page.steal', f'steal time, of two cores, in these {seconds:g} s',
                   sum(each['steal_s'] for each in bare), 's')] if bare else []
    jitter = {name: [each['jitter_p99_ms'] for each in runs] for name, runs in found.items()}
    losses = {name: [each['lost'] for each in runs] for name, runs in found.items()}
    for name in found:
        rival = ALONE + (PLAIN if name.endswith(PLAIN) else '')
        rows.append(Result(f'live_page.lost.{name}', f'samples lost in {seconds:g} s: {name}',
                           sum(losses[name]), ''))
        if name != rival:
            ratio, spread = ratios(jitter[name], jitter[rival])
            rows.append(Result(
                f'live_page.jitter.{name}', f'period jitter, 99th percentile: {name}',
                statistics.median(jitter[name]), 'ms', spread,
                f'{rival}, {statistics.median(jitter[rival]):.3f} ms', ratio,
                '<= 1.1' if name == SHOWN else ''))
        if name == SHOWN:
            # Without a page the machine loses some samples too, a different number in each round.
            more = [ours - alone for ours, alone in zip(losses[name], losses[ALONE], strict=True)]
            rows.append(Result(
                'live_page.more', f'samples lost in a round more than with {ALONE}; target: no '
                f'more than rounds with {ALONE} differ from each other: {name}',
                statistics.median(more), '', deviation(more),
                target=f'<= {max(losses[ALONE]) - min(losses[ALONE]):g}'))
        if (page := name.removesuffix(PLAIN)) in STATIC:
            rival = name.replace(page, STATIC[page])
            frames, others = ([each['frames_hz'] for each in found[which]]
                              for which in (name, rival))
            ratio, spread = ratios(frames, others)
            rows.append(Result(
                f'live_page.frames.{name}', f'frames of each tab: {name}',
                statistics.median(frames), '/s', spread,
                f'{rival}, {statistics.median(others):.3g} /s', ratio,
                '>= 0.95' if name == ONE else ''))
    return rows
