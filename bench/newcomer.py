"""
The first minutes of a user: `python -m bench.newcomer`, from a fresh clone to a turned gain.

What the README says, in a clone of the last commit without a compile cache: `make demo`, then
`asi live --simulate` in a headless Chromium, until a slider is dragged and the node has that gain.
Packages come from pip's cache or the network, as on the user's machine.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Final

import rclpy
from rclpy.parameter_client import AsyncParameterClient
from rclpy.signals import SignalHandlerOptions

from bench.browser import chromium
from bench.live_page import address_of, free_port
from bench.result import Result, show

ROOT: Final = Path(__file__).parents[1]
PATIENCE_S: Final = 120.0
PATIENCE_MS: Final = 1e3 * PATIENCE_S
# Of the slider's length; the default gain is elsewhere.
PLACE: Final = 0.45


def gain(client: AsyncParameterClient) -> float:
    """Return the gain that the controller has."""
    future = client.get_parameters(['gain'])
    rclpy.spin_until_future_complete(client.node, future, timeout_sec=PATIENCE_S)
    return float(future.result().values[0].double_value)


def turned(page: Any, address: str) -> float:
    """Return when the gain's slider was there, s, and leave once the node has what it says."""
    page.set_default_timeout(PATIENCE_MS)
    page.goto(address)
    slider = page.get_by_role('slider', name='gain', exact=True)
    slider.wait_for()
    there_s = time.monotonic()
    client = AsyncParameterClient(rclpy.create_node('newcomer'), 'asi_controller')
    if not client.wait_for_services(PATIENCE_S):
        raise TimeoutError('the controller does not answer')
    before, box = gain(client), slider.bounding_box()
    page.mouse.click(box['x'] + PLACE * box['width'], box['y'] + box['height'] / 2)
    field = page.get_by_role('textbox', name='gain', exact=True)
    while gain(client) == before or float(field.input_value()) != gain(client):
        if time.monotonic() > there_s + PATIENCE_S:
            raise TimeoutError('the gain has not changed')
        page.wait_for_timeout(50)
    client.node.destroy_node()
    return there_s


def measure(quick: bool = False) -> list[Result]:
    """Return how long each step takes, s; quick makes no difference."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    with tempfile.TemporaryDirectory() as folder, chromium() as browser:
        clone, environment = Path(folder) / 'clone', os.environ | {
            'NUMBA_CACHE_DIR': f'{folder}/compiled'}
        subprocess.run(['git', 'clone', '-q', ROOT, clone], check=True)
        times_s = [time.monotonic()]
        for target in ('ready', 'demo'):
            subprocess.run(['make', target], cwd=clone, env=environment, check=True,
                           stdout=subprocess.DEVNULL)
            times_s.append(time.monotonic())
        port = free_port()
        with subprocess.Popen(
                [clone / '.venv/bin/asi', 'live', '--simulate', '--no-browser', '--port',
                 str(port)], cwd=clone, env=environment, stdout=subprocess.DEVNULL) as live:
            try:
                times_s.append(turned(browser.new_page(), address_of(port)))
                times_s.append(time.monotonic())
            finally:
                live.terminate()
    rclpy.shutdown()
    steps = [end - begin for begin, end in zip(times_s, times_s[1:], strict=False)]
    return [*(Result(f'newcomer.{name}', what, seconds, 's') for (name, what), seconds in zip(
                {'setup': 'to set up .venv', 'demo': '`make demo`, without that',
                 'page': '`asi live --simulate`, until the page has its sliders',
                 'gain': 'to turn the gain on the page'}.items(), steps, strict=True)),
            Result('newcomer.all', 'from a fresh clone to a turned gain', sum(steps), 's',
                   target='<= 180')]


if __name__ == '__main__':
    show(measure('--quick' in sys.argv))
