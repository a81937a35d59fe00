"""
The model's inner loop against the same equations written by hand in C.

`python bench/model_speed.py` prints, for each load and with each block switched off, the time a
sub-step takes in both, and by how much the results differ. The rivals take turns, so that a
machine that drifts cancels out; the ratio is the median of the pairs.
"""

import argparse
import ctypes
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from asi_actuator.model.actuator import STATE_DTYPE, rest, simulate
from asi_actuator.parameters import ACTUATOR_DTYPE, RING, as_record

PERIOD_S = 2e-4
# Half a second near the limit cycle, with noise, so that no branch is always taken.
TIME_S = np.arange(2500) * PERIOD_S
COMMANDS = (1000.0 * np.sin(2.0 * np.pi * 90.0 * TIME_S)
            + np.random.default_rng(1).normal(0.0, 50.0, TIME_S.size))
CASES: dict[str, dict[str, str | float]] = {
    'default': {},
    **{f'load {load}': {'load.type': load, 'load.velocity': 0.2, 'load.frequency': 5.0}
       for load in ('spring', 'free', 'prescribed')},
    **{f'no {block}': {f'{block}.model': 'off'} for block in (
        'valve_hysteresis', 'valve_flexure', 'valve_characteristic', 'hydraulic_damping',
        'fluid_dynamics', 'friction', 'force_sensor')},
}


def header() -> str:
    """Return the records that the Python code uses, as C structures."""
    text = f'#define RING {RING}\n'
    for name, dtype in (('parameters', ACTUATOR_DTYPE), ('state', STATE_DTYPE)):
        fields = ''.join(
            f'    {"long" if field.base.kind == "i" else "double"} {field_name}'
            f'{f"[{field.shape[0]}]" if field.shape else ""};\n'
            for field_name, field in ((n, dtype[n]) for n in dtype.names or ()))
        text += f'struct {name} {{\n{fields}}};\n'
    return text


def compiled(flags: tuple[str, ...]) -> Callable[[np.void], npt.NDArray[np.float64]]:
    """Return the C model as a function of the parameters' record, compiled with `flags`."""
    folder = Path(tempfile.mkdtemp(prefix='asi_bench_'))
    (folder / 'model_parameters.h').write_text(header())
    library = folder / 'model.so'
    subprocess.run(['cc', '-O3', '-march=native', *flags, '-fPIC', '-shared', f'-I{folder}', '-o',
                    library, Path(__file__).with_name('model.c'), '-lm'], check=True)
    function = ctypes.CDLL(str(library)).simulate

    def run(p: np.void) -> npt.NDArray[np.float64]:
        out, state, record = np.empty((4, COMMANDS.size)), rest(), p.copy()
        function(*(ctypes.c_void_p(a.ctypes.data) for a in (np.atleast_1d(record), COMMANDS)),
                 ctypes.c_long(COMMANDS.size), ctypes.c_double(PERIOD_S),
                 *(ctypes.c_void_p(a.ctypes.data) for a in (np.atleast_1d(state), out)))
        return out
    return run


def ours(p: np.void) -> npt.NDArray[np.float64]:
    """Return force, valve position, position and velocity of our model."""
    return np.stack(simulate(p, COMMANDS, PERIOD_S)[2:])


def seconds(run: Callable[[np.void], npt.NDArray[np.float64]], p: np.void) -> float:
    """Return how much processor time one run takes."""
    begin = time.thread_time()
    run(p)
    return time.thread_time() - begin


def main() -> None:
    """Print the table, or one JSON document."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument('--pairs', type=int, default=30, help='runs of each rival')
    arguments.add_argument('--json', action='store_true', help='print one JSON document')
    options = arguments.parse_args()
    rivals = {'ours': ours, 'c': compiled(()), 'c_fast_math': compiled(('-ffast-math',))}
    rows: list[dict[str, Any]] = []
    for case, values in CASES.items():
        p = as_record(values)
        mine, theirs = ours(p), rivals['c'](p)
        difference = float(np.max(np.abs(mine - theirs).max(1) / np.abs(mine).max(1)))
        times = np.array([[seconds(run, p) for run in rivals.values()]
                          for _ in range(options.pairs)])
        substeps = COMMANDS.size * round(PERIOD_S / float(p['maximum_substep']))
        ns = dict(zip(rivals, np.median(times, 0) / substeps * 1e9, strict=True))
        rows.append({
            'case': case, **{f'{name}_ns': round(float(t), 1) for name, t in ns.items()},
            'ratio_to_c': round(float(np.median(times[:, 0] / times[:, 1])), 3),
            'ratio_to_c_fast_math': round(float(np.median(times[:, 0] / times[:, 2])), 3),
            'largest_relative_difference': difference})
        if not options.json:
            if len(rows) == 1:
                print('  '.join(rows[0]))
            print('  '.join(str(value) for value in rows[-1].values()), flush=True)
    if options.json:
        print(json.dumps(rows))
    if any(row['largest_relative_difference'] > 1e-9 for row in rows):
        sys.exit('model.c and the model differ by more than 1e-9')


if __name__ == '__main__':
    main()
