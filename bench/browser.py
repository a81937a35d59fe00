"""A headless Chromium for the live page: that of the system, or the one of playwright."""

import contextlib
import shutil
from collections.abc import Iterator
from typing import Any, Final

NAMES: Final = ('chromium', 'chromium-browser', 'google-chrome', 'google-chrome-stable')
# The points that the page's charts hold, by title and curve.
CURVES: Final = '() => asiLive.curves()'


class NoBrowserError(Exception):
    """There is no Chromium here; the text says how to get one."""


@contextlib.contextmanager
def chromium() -> Iterator[Any]:
    """Run a browser. Raises NoBrowserError."""
    try:
        from playwright.sync_api import Error, sync_playwright
    except ImportError:
        raise NoBrowserError('no playwright: pip install playwright') from None
    with sync_playwright() as playwright:
        program = next(filter(None, map(shutil.which, NAMES)), None)
        try:
            browser = playwright.chromium.launch(executable_path=program)
        except Error as error:
            raise NoBrowserError(
                'no Chromium that starts: apt install chromium, or python -m playwright install '
                f'--only-shell chromium ({str(error).splitlines()[0]})') from None
        with browser:
            yield browser
