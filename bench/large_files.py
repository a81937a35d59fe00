"""
Large tables: peak memory and time of `asi import` of ten million rows of three columns.

The memory of a row is the increase over an import of a thousand rows, divided by the rows.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Final

from bench.result import Result, show

ROOT: Final = Path(__file__).parents[1]
ROWS: Final = 10_000_000
FEW: Final = 1000
IMPORT: Final = ('import resource, sys; from asi_analysis import cli; status = cli.main(); '
                 'print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss); sys.exit(status)')


def write_table(path: Path, rows: int) -> None:
    """Write time, reference and force at 1 kHz as CSV."""
    with path.open('w') as file:
        file.write('time_s,reference_n,force_n\n')
        for k in range(rows):
            file.write(f'{k // 1000}.{k % 1000:03d},{k % 1013}.25,{k % 997}.125\n')


def imported(rows: int, folder: Path) -> tuple[float, float]:
    """Return peak memory (bytes) and time (s) of an import into a bag."""
    table = folder / f'{rows}.csv'
    write_table(table, rows)
    begin = time.perf_counter()
    done = subprocess.run(
        [sys.executable, '-c', IMPORT, 'import', str(table), '--out', str(folder / str(rows))],
        capture_output=True, text=True, check=True,
        env=os.environ | {'PYTHONPATH': os.pathsep.join([str(ROOT), *sys.path])})
    return 1024.0 * int(done.stdout.split()[-1]), time.perf_counter() - begin


def measure(quick: bool) -> list[Result]:
    """Return peak memory and time of the import."""
    rows = ROWS // 100 if quick else ROWS
    with tempfile.TemporaryDirectory() as folder:
        few, _ = imported(FEW, Path(folder))
        peak, seconds = imported(rows, Path(folder))
    return [
        Result('large.memory', f'import of {rows:,} rows of three numbers: peak', peak / 1e9,
               'GB', target='<= 2'),
        Result('large.row', 'a row, beyond an import of a thousand', (peak - few) / rows, 'B'),
        Result('large.time', 'the same import', seconds, 's')]


if __name__ == '__main__':
    show(measure('--quick' in sys.argv))
