"""`asi sweep`: the step figures of a loop over a grid of parameters, computed in this process."""

import csv
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import numpy as np

from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.experiments.experiment import TABLES, Experiment, parse_setting, planned
from asi_analysis.experiments.running import RunFailedError
from asi_analysis.loop.closed_loop import LoopRun, Values, close_many, loops_of
from asi_analysis.loop.in_process import fault_of, run_in_process
from asi_analysis.measures.step_response import step_response
from asi_analysis.parallel import each
from asi_analysis.reporting.result import Result, Table, frame, number
from asi_analysis.terminal import Progress, silent
from asi_common.files import replacing
from asi_common.parameter import Value

# Runs in a piece of work, and the largest grid.
PIECE: Final = 16
MOST_RUNS: Final = 100_000
FIGURES: Final = ('rise_time_s', 'overshoot_percent', 'settling_time_2_s', 'steady_state_error_n')
# Of the printed table: heading -> key.
COLUMNS: Final = dict(zip(('rise (s)', 'overshoot (%)', 'settling to 2 % (s)',
                           'steady-state error (N)', 'ripple (N)'), (*FIGURES, 'ripple_n'),
                          strict=True))


class Sweep(Result):
    """The result of `sweep`, with the keys of `asi sweep --json`."""

    title = 'Sweep'
    rows = 'runs'

    def parts(self) -> Iterator[str | Table]:
        yield f'{len(self.runs)} runs of {self.duration_s:g} s at {self.rate_hz:g} Hz'
        names = list(self.runs[0]['values'])
        yield Table([*names, *COLUMNS], [
            [*map(str, run['values'].values()),
             *(number(run[key], '', 3) for key in COLUMNS.values())] for run in self.runs],
            right=list(COLUMNS))
        yield from (f'note: run {number}: the valve was closed by a fault, {run["fault"]}'
                    for number, run in enumerate(self.runs, 1) if run['fault'])
        if any(run['values'].get('controller.gain') == 0.0 for run in self.runs):
            yield "note: controller.gain = 0 is the compensator's own gain"

    def to_frame(self) -> Any:
        return frame(self.table())

    def table(self) -> list[dict[str, Any]]:
        """Return a row of each run: the values of the parameters by name, and the figures."""
        return [run['values'] | {key: value for key, value in run.items() if key != 'values'}
                for run in self['runs']]

    def write_csv(self, path: Path) -> None:
        """Write the table as CSV; the cell of an unknown figure is empty."""
        rows = self.table()
        with replacing(path) as temporary, temporary.open('w', newline='') as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)


def grid(over: Sequence[str]) -> dict[str, list[Value]]:
    """
    Return the values of each parameter, by its name with 'actuator.' or 'controller.' before it.

    over: texts such as 'controller.gain=1,2,5' or 'actuator.load.mass=0.5:2:4' (4 values from 0.5
    to 2). Raises InputError for another form, or a name that is no parameter.

    >>> grid(['controller.gain=1:2:3', 'actuator.load.type=locked,free'])
    {'controller.gain': [1.0, 1.5, 2.0], 'actuator.load.type': ['locked', 'free']}
    """
    found: dict[str, list[Value]] = {}
    for text in over:
        name, _, listed = text.partition('=')
        name = name.strip()
        if name in found:
            raise InputError(f'--over {text}: {name} is given twice')
        parts = listed.split(',')
        if listed.count(':') == 2:
            parts = _spaced(text, *listed.split(':'))
        try:
            which, parameter, _ = parse_setting(f'{name}={parts[0]}')
            found[name] = [parse_setting(f'{name}={part}')[2] for part in parts]
        except InputError as error:
            raise InputError(str(error).replace('--set', '--over')) from None
        row = next(row for row in TABLES[which] if row.name == parameter)
        for problem in filter(None, map(row.problem, found[name])):
            raise InputError(f'--over {text}: {problem}')
    if not found:
        raise InputError('--over NODE.NAME=VALUES is missing: which parameter is varied?')
    if (count := math.prod(map(len, found.values()))) > MOST_RUNS:
        raise InputError(f'--over asks for {count} runs: at most {MOST_RUNS}')
    return found


def _spaced(text: str, start: str, stop: str, count: str) -> list[str]:
    """Return evenly spaced numbers as texts."""
    try:
        ends, number = (float(start), float(stop)), int(count)
        if not (all(map(math.isfinite, ends)) and 1 <= number <= MOST_RUNS):
            raise ValueError
    except ValueError:
        raise InputError(f'--over {text}: it takes NODE.NAME=START:STOP:COUNT with two finite '
                         f'numbers and a count from 1 to {MOST_RUNS}') from None
    return [f'{value:.12g}' for value in np.linspace(*ends, number)]


def sweep(over: Mapping[str, Sequence[Value]], actuator: Values, controller: Values,
          duration_s: float = 0.5, rate_hz: float = 5000.0, *, bags: str | Path | None = None,
          progress: Progress = silent) -> Sweep:
    """
    Return the step figures of every combination of some parameters' values.

    over: values by name, as 'controller.gain' or 'actuator.load.mass'; actuator, controller: the
    other parameters by name. bags: a directory; each run's bag is written to a directory in it.
    Computed on all cores, in processes within `workers` of `parallel.py`. Raises InputError for
    parameters that are not allowed.

    >>> import asi_analysis as asi
    >>> found = asi.sweep({'controller.gain': [1.0, 3.0]}, {}, {'reference.amplitude': 300.0})
    >>> [round(run['steady_state_error_n']) for run in found.runs]
    [-7, 8]
    """
    points = [dict(zip(over, values, strict=True)) for values in itertools.product(*over.values())]
    experiments = []
    for point in points:
        values = {'actuator': dict(actuator), 'controller': dict(controller)}
        for name, value in point.items():
            which, _, parameter = name.partition('.')
            values[which][parameter] = value
        experiments.append(planned(values['actuator'], values['controller'], duration_s,
                                   'lockstep', rate_hz))
    progress(f'0 of {len(points)} runs', 0.0)
    out = None if bags is None else Path(bags)
    work = [(experiments[k:k + PIECE], out, k + 1) for k in range(0, len(points), PIECE)]
    runs: list[dict[str, Any]] = []
    for found in each(_figures, work):
        runs += found
        progress(f'{len(runs)} of {len(points)} runs', len(runs) / len(points))
    return Sweep({'duration_s': duration_s, 'rate_hz': experiments[0].control_rate_hz, 'runs': [
        {'values': point, **run} for point, run in zip(points, runs, strict=True)]})


def _figures(experiments: Sequence[Experiment], out: Path | None, number: int
             ) -> list[dict[str, Any]]:
    """Return the figures of experiments of one rate and duration; number: of the first."""
    rate_hz = experiments[0].control_rate_hz
    signals = close_many(loops_of([one.actuator for one in experiments],
                                  [one.controller for one in experiments], rate_hz),
                         experiments[0].duration_s)
    time_s = np.arange(signals.shape[2]) / rate_hz
    found = []
    for k, (experiment, each_) in enumerate(zip(experiments, signals, strict=True)):
        run = LoopRun(time_s, *each_)
        fault = fault_of(experiment, run) or None
        found.append({**_measured(Run(*run), fault), 'bag': _bag(experiment, out, number + k),
                      'fault': fault})
    return found


def _measured(run: Run, fault: str | None) -> dict[str, Any]:
    """Return the figures of the largest step, and the ripple at the end; None after a fault."""
    if fault:
        return dict.fromkeys((*FIGURES, 'ripple_n'))
    assert run.force_n is not None
    step = step_response(run)
    return {**{key: step[key] for key in FIGURES},
            'ripple_n': round(float(run.force_n[-max(len(run) // 5, 1):].std()), 9)}


def _bag(experiment: Experiment, out: Path | None, number: int) -> str | None:
    """Write the bag of an experiment, up to a fault; return where it is."""
    if out is None:
        return None
    folder = out / f'{number:05d}'
    with suppress(RunFailedError):
        run_in_process(experiment, folder)
    return str(folder / 'bag')
