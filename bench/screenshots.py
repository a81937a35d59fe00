"""
Take the pictures of the live page, `asi view` and Foxglove: `python -m bench.screenshots [NAME]`.

It runs the nodes, the page, Rerun's own web viewer and Foxglove Studio, and opens them in a
headless Chromium. The file of Rerun is that of `asi view --out`. Needs the extras `live` and
`view`, a Chromium, and for Foxglove `npm`. NAME: one of them alone.
"""

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Final

import asi_analysis as asi
from bench import foxglove
from bench.browser import CURVES, NoBrowserError, chromium
from bench.live_page import address_of, free_port, serve
from bench.loop_rate import ACTUATOR, CONTROLLER, SINE, node, process

PICTURES: Final = Path(__file__).parents[1] / 'doc' / 'how_to'
SIZE: Final[Any] = {'width': 1500, 'height': 1050}
PATIENCE_MS: Final = 120_000.0
# Rerun does not report when it has drawn everything: wait until its picture is unchanged so long.
STILL_S: Final = 5.0


def live_page(browser: Any, picture: Path) -> None:
    """Show a sine on the live page, at a gain that was chosen with its slider."""
    with contextlib.ExitStack() as running:
        running.enter_context(process(*node(ACTUATOR, rate_hz=1000.0, real_time_factor=1.0)))
        running.enter_context(process(*node(CONTROLLER, rate_hz=1000.0, **SINE)))
        page = browser.new_page(viewport=SIZE)
        page.set_default_timeout(PATIENCE_MS)
        page.goto(serve(running))
        slider = page.get_by_role('slider', name='gain')
        slider.wait_for()
        box = slider.bounding_box()
        page.mouse.click(box['x'] + 0.42 * box['width'], box['y'] + box['height'] / 2)
        page.wait_for_function(f"""() => {{
            const shown = Object.values(({CURVES})()).flatMap(Object.values);
            return shown.length && shown.every(points => points.length);
        }}""")
        page.wait_for_timeout(3000)
        page.screenshot(path=picture)


def recording(browser: Any, picture: Path) -> None:
    """Show a limit cycle in Rerun: every signal, the loops, the spectrum."""
    try:
        from asi_analysis.viewing.rerun_view import view
    except ImportError:
        sys.exit(f'{picture} needs Rerun: pip install "asi_actuator[view]"')
    run = asi.simulate({}, {'gain': 10.0, 'reference.amplitude': 100.0}, 0.5)
    web, data = free_port(), free_port()
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as running:
        file = Path(folder) / 'run.rrd'
        view(run, file)
        rerun = running.enter_context(subprocess.Popen(
            [Path(sys.executable).with_name('rerun'), file, '--serve-web', '--bind', '127.0.0.1',
             '--port', str(data), '--web-viewer-port', str(web)],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True))
        running.callback(os.killpg, rerun.pid, signal.SIGTERM)
        page = browser.new_page(viewport=SIZE)
        page.set_default_timeout(PATIENCE_MS)
        page.goto(f'{address_of(web)}?url=rerun%2Bhttp://127.0.0.1:{data}/proxy')
        before, still_since = b'', time.monotonic()
        while len(before) < 100_000 or time.monotonic() - still_since < STILL_S:
            page.wait_for_timeout(1000)
            now = page.screenshot(path=picture)
            if now != before:
                before, still_since = now, time.monotonic()


def layout(browser: Any, picture: Path) -> None:
    """Show the bag of a step over ROS in Foxglove Studio, with our layout."""
    packages = PICTURES.parents[1] / 'build' / 'foxglove'
    foxglove.fetched(packages)
    with tempfile.TemporaryDirectory() as folder:
        asi.run({}, {'compensator': 'lead_lag', 'reference.shape': 'step',
                     'reference.amplitude': 150.0}, 1.0, out=f'{folder}/run')
        said = foxglove.photograph(browser, packages, Path(folder) / 'run' / 'bag', picture)
    if not all(words in said for words in ('asi_actuator: state', 'valve position', 'velocity')):
        sys.exit(f'Foxglove does not show what its layout names: {said}')


TAKEN: Final = {'live': live_page, 'view': recording, 'foxglove': layout}


def main() -> None:
    """Take the pictures that are named, or all."""
    with chromium() as browser:
        for name in sys.argv[1:] or TAKEN:
            TAKEN[name](browser, PICTURES / f'{name}.png')
            print(PICTURES / f'{name}.png')


if __name__ == '__main__':
    try:
        main()
    except NoBrowserError as error:
        sys.exit(str(error))
