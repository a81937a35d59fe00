"""
`python -m bench [NAME ...]`: run the benchmarks, write doc/reference/performance.md.

With names: only those; for the others the last results are shown with their date. The page is
written if there are results of all. --quick: a few rounds each, as a test, without a page.
"""

import argparse
import importlib
import json
import os
import platform
import subprocess
import sys
import time
import traceback
from collections.abc import Mapping
from datetime import date
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

from bench.page import write_page
from bench.result import Result, show

ROOT: Final = Path(__file__).parents[1]
# Results of the last run of each, so that one alone can be run again.
LAST: Final = ROOT / 'build' / 'bench.json'
MODULES: Final = ('model_speed', 'rivals', 'many_runs', 'loop_rate', 'live_page',
                  'recording', 'large_files', 'analysis_speed', 'start_up', 'cluster_speed',
                  'can_cost')
PACKAGES: Final = ('ros-jazzy-rclpy', 'numpy', 'numba', 'llvmlite', 'scipy', 'control', 'mujoco',
                   'rosbags', 'mcap', 'joblib', 'distributed')


def machine() -> dict[str, str]:
    """Return a description of the machine."""
    model = next((line.partition(':')[2].strip() for line in
                  Path('/proc/cpuinfo').read_text().splitlines() if line.startswith('model name')),
                 platform.processor())
    compiler = subprocess.run(['cc', '--version'], capture_output=True, text=True, check=False)
    versions = []
    for package in PACKAGES:
        try:
            versions.append(f'{package} {version(package)}')
        except PackageNotFoundError:
            versions.append(f'{package} not installed')
    memory_gb = os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30
    return {'processor': f'{model}, {len(os.sched_getaffinity(0))} cores, {memory_gb:.0f} GiB',
            'system': f'{platform.system()} {platform.release()}, '
                      f'Python {platform.python_version()}, {compiler.stdout.splitlines()[0]}',
            'versions': ', '.join(versions)}


def run(name: str, quick: bool) -> dict[str, Any]:
    """Return the results of a benchmark, with date, load of the machine before, and duration."""
    load, begin = os.getloadavg()[0], time.perf_counter()
    results: list[Result] = importlib.import_module(f'bench.{name}').measure(quick)
    seconds = time.perf_counter() - begin
    print(f'\n{name}: {seconds:.0f} s, load before {load:.1f}', file=sys.stderr, flush=True)
    show(results)
    return {'date': date.today().isoformat(), 'load': load, 'seconds': seconds,
            'machine': machine(), 'results': [result._asdict() for result in results]}


def main() -> None:
    """Run the named benchmarks, then write the page from the last results of all."""
    parser = argparse.ArgumentParser(description=__doc__, prog='python -m bench')
    parser.add_argument('names', nargs='*', metavar='NAME', help=', '.join(MODULES))
    parser.add_argument('--quick', action='store_true')
    options = parser.parse_args()
    if unknown := set(options.names) - set(MODULES):
        parser.error(f'{", ".join(unknown)}: there are {", ".join(MODULES)}')
    last: dict[str, Mapping[str, Any]] = json.loads(LAST.read_text()) if LAST.exists() else {}
    failed: list[str] = []
    for name in options.names or MODULES:
        try:
            last[name] = run(name, options.quick)
        except Exception:
            # Continue with the others.
            traceback.print_exc()
            failed.append(name)
        if not options.quick:
            LAST.parent.mkdir(exist_ok=True)
            LAST.write_text(json.dumps(last, indent=1))
    if missing := [name for name in MODULES if name not in last]:
        print('the page is not written, as these have not been measured here: '
              + ', '.join(missing), file=sys.stderr)
    elif not options.quick:
        print(write_page({name: last[name] for name in MODULES}, ROOT / 'doc/reference'))
    if failed:
        sys.exit(f'failed: {", ".join(failed)}')


if __name__ == '__main__':
    main()
