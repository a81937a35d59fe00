"""
What the live page costs the loop: real time at 1 kHz alone, with `asi live`, and with three tabs.

Jitter of the period and lost samples, in the same minutes. The tabs are of a headless Chromium;
without one (`bench/browser.py`) only the process of the page is measured.
"""

import contextlib
import os
import re
import socket
import statistics
import time
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
TABS: Final = 3
LOSSES: Final = ('asi_actuator: loop', 'asi_controller: loop')
ALONE, SERVED, SHOWN = 'no page', 'asi live, no tab', f'asi live, {TABS} tabs'


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


def loop(seconds: float, browser: Any, served: bool, tabs: int) -> dict[str, float]:
    """Return the jitter of the actuator's period, samples lost, and frames/s of a tab."""
    common = {'mode': 'realtime', 'rate_hz': RATE_HZ}
    with contextlib.ExitStack() as running:
        actuator = running.enter_context(
            process(*node('bench.ticking_node', str(seconds), **common)))
        running.enter_context(process(*node(CONTROLLER, **common, **SINE)))
        address = serve(running) if served else ''
        pages = [running.enter_context(browser.new_page()) for _ in range(tabs)]
        for page in pages:
            page.goto(address)
        for page in pages:
            page.get_by_role('slider', name='gain').wait_for(timeout=1e3 * PATIENCE_S)
        heard = running.enter_context(listener())
        heard.run(0.0)   # both nodes are heard
        before = lost(heard.values)
        heard.run(seconds)
        frames = [float(re.findall(r'(\d+) frames', page.get_by_text('states/s').inner_text())[0])
                  for page in pages]
        return {'lost': lost(heard.values) - before, **node_times(actuator),
                'frames_hz': statistics.mean(frames or [0.0])}


def lost(values: dict[str, dict[str, str]]) -> int:
    """Return the samples that both nodes miss."""
    return sum(int(values[name]['lost samples']) for name in LOSSES if name in values)


def measure(quick: bool = False) -> list[Result]:
    """Return jitter beside that without a page, losses, and frames a second."""
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    rounds, seconds = (1, 1.0) if quick else (3, 5.0)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    with contextlib.ExitStack() as running:
        running.callback(rclpy.shutdown)
        rivals = {ALONE: lambda: loop(seconds, None, False, 0),
                  SERVED: lambda: loop(seconds, None, True, 0)}
        try:
            browser = running.enter_context(chromium())
            rivals[SHOWN] = lambda: loop(seconds, browser, True, TABS)
        except NoBrowserError as error:
            print(f'without tabs: {error}')
        found = in_turns(rivals, rounds)
    jitter = {name: [each['jitter_p99_ms'] for each in runs] for name, runs in found.items()}
    results = []
    for name, target in ((SERVED, ''), (SHOWN, '<= 1.1')):
        if name in found:
            ratio, spread = ratios(jitter[name], jitter[ALONE])
            results.append(Result(
                f'live_page.jitter.{len(results)}', f'period jitter, 99th percentile: {name}',
                statistics.median(jitter[name]), 'ms', spread,
                f'{ALONE}, {statistics.median(jitter[ALONE]):.3f} ms', ratio, target))
    for name, runs in found.items():
        results.append(Result(
            f'live_page.lost.{name}', f'samples lost in {rounds * seconds:g} s: {name}',
            sum(each['lost'] for each in runs), '', target='<= 0'))
    if SHOWN in found:
        frames = [each['frames_hz'] for each in found[SHOWN]]
        results.append(Result('live_page.frames', f'frames of each of {TABS} tabs',
                              statistics.median(frames), '/s', deviation(frames)))
    return results
