"""
Foxglove Studio in a headless Chromium, with our layout and a bag: its picture.

npm holds an open Foxglove Studio as a library of components, built for a browser. Here is the page
around it: React, a configuration, a storage of layouts, and a server of the bag that
answers requests for ranges. `npm` gets the packages into `build/`, 40 MB.
"""

import contextlib
import functools
import http.server
import json
import subprocess
import tarfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

CONFIG: Final = Path(__file__).parents[1] / 'config'
PACKAGES: Final = ('@foxglove/studio-base@1.48.0', 'react@17.0.2', 'react-dom@17.0.2')
SIZE: Final[Any] = {'width': 1500, 'height': 1050}
PATIENCE_MS: Final = 300_000.0
# Foxglove draws its plots in workers and tells nobody when they are done: so long it is waited.
DRAWN_MS: Final = 20_000
PAGE: Final = """<!doctype html><meta charset=utf-8><title>Foxglove Studio</title>
<style>html, body, #root { height: 100%; margin: 0 }</style><div id=root></div>
<script>var process = { env: {} }, global = window;</script>
<script src=react/umd/react.production.min.js></script>
<script src=react-dom/umd/react-dom.production.min.js></script>
<script>window.react = React; window["react-dom"] = ReactDOM;</script>
<script src=studio-base/assets/index.js></script>
<script>
const values = new Map([["colorScheme", "light"], ["timezone", "UTC"]]);
const configuration = {
  get: (key) => values.get(key), set: async (key, value) => { values.set(key, value); },
  addChangeListener() {}, removeChangeListener() {} };
const layouts = new Map();
const storage = {
  list: async () => [...layouts.values()], get: async (_, id) => layouts.get(id),
  put: async (_, layout) => { layouts.set(layout.id, layout); return layout; },
  delete: async (_, id) => { layouts.delete(id); }, importLayouts: async () => {} };
const file = new URL("bag.mcap", location).href;
const link = new URL(location);
link.searchParams.set("ds", "remote-file");
link.searchParams.set("ds.url", file);
// The end of a run in lock-step, whose time begins at 0; else it is the end of the bag.
link.searchParams.set("time", "1970-01-01T00:00:00.990000000Z");
localStorage.setItem("studio.profile-data", JSON.stringify({ currentLayoutId: "asi" }));
(async () => {
  const data = await (await fetch("layout.json")).json();
  layouts.set("asi", { id: "asi", name: "asi_actuator", permission: "CREATOR_WRITE",
    baseline: { data, savedAt: new Date().toISOString() }, working: undefined,
    syncInfo: undefined });
  await initI18n();
  ReactDOM.render(React.createElement(App, {
    deepLinks: [link.href], appConfiguration: configuration, layoutStorage: storage,
    dataSources: [new RemoteDataSourceFactory()], extensionLoaders: [],
    enableGlobalCss: true }), document.getElementById("root"));
})();
</script>
"""


def fetched(folder: Path) -> None:
    """Get the packages from npm into a folder, unless they are there: by their last names."""
    folder.mkdir(parents=True, exist_ok=True)
    for package in PACKAGES:
        place = folder / package.rpartition('@')[0].rpartition('/')[2]
        if place.is_dir():
            continue
        name = subprocess.run(['npm', 'pack', '--silent', package], cwd=folder, check=True,
                              capture_output=True, text=True).stdout.strip()
        with tarfile.open(folder / name) as archive:
            archive.extractall(folder / 'new', filter='data')
        (folder / 'new' / 'package').rename(place)


class Handler(http.server.SimpleHTTPRequestHandler):
    """Serves the page, the layout and the packages, and a bag in ranges."""

    bag: Path

    def do_GET(self) -> None:
        """Answer a request."""
        if self.path.startswith('/bag.mcap'):
            data, (first, last) = self.bag.read_bytes(), (0, None)
            if wanted := self.headers.get('Range'):
                first, last = (int(each) for each in wanted.removeprefix('bytes=').split('-'))
            part = data[first:None if last is None else last + 1]
            self.send_response(206 if wanted else 200)
            self.send_header('Accept-Ranges', 'bytes')
            self.send_header('Content-Range', f'bytes {first}-{first + len(part) - 1}/{len(data)}')
            self._send('application/octet-stream', part)
        elif self.path.startswith('/layout.json'):
            self.send_response(200)
            self._send('application/json', (CONFIG / 'foxglove_layout.json').read_bytes())
        elif self.path.partition('?')[0] == '/':
            self.send_response(200)
            self._send('text/html', PAGE.encode())
        else:
            super().do_GET()

    def _send(self, kind: str, data: bytes) -> None:
        self.send_header('Content-Type', kind)
        self.send_header('Content-Length', str(len(data)))
        self.end_headers()
        with contextlib.suppress(ConnectionError):
            self.wfile.write(data)

    def log_message(self, *_: object) -> None:
        """Say nothing."""


@contextlib.contextmanager
def served(packages: Path, bag: Path) -> Iterator[str]:
    """Serve the page on this machine; yield its address."""
    handler = type('BagHandler', (Handler,), {'bag': next(bag.glob('*.mcap'))})
    server = http.server.ThreadingHTTPServer(
        ('127.0.0.1', 0), functools.partial(handler, directory=str(packages)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f'http://127.0.0.1:{server.server_port}/'
    finally:
        server.shutdown()


def photograph(browser: Any, packages: Path, bag: Path, picture: Path) -> str:
    """Take the picture of the layout with a bag; return the text that is on the page."""
    with served(packages, bag) as address, browser.new_page(viewport=SIZE) as page:
        page.set_default_timeout(PATIENCE_MS)
        page.goto(address)
        panels = json.loads((CONFIG / 'foxglove_layout.json').read_text())['configById'].values()
        for title in (each['foxglovePanelTitle'] for each in panels if 'paths' in each):
            page.get_by_text(title).first.wait_for()
        page.wait_for_timeout(DRAWN_MS)
        page.screenshot(path=picture)
        return str(page.inner_text('body'))
