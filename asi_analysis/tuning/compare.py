"""`asi compare`: controllers and recordings side by side, over plants, rates, loads and noise."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from asi_analysis.bags.bag import read_bag
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.experiments.experiment import read_parameters, stepping
from asi_analysis.limit_cycle.quench.attack import VARIED, Trial, search, with_errors
from asi_analysis.loop.closed_loop import Values
from asi_analysis.measures.analysis import analyze, in_words
from asi_analysis.measures.quality import quality_of
from asi_analysis.reporting.result import Pictures, Result, Table, filled, number
from asi_analysis.terminal import Progress, part_of, silent
from asi_analysis.tuning.figures import (
    BAND_HZ,
    IMPEDANCE_HZ,
    ROWS,
    STEP_S,
    Responses,
    figures,
    held,
    held_figures,
    missed,
    responses,
    step_figures,
)
from asi_analysis.tuning.overlays import recorded, simulated
from asi_analysis.tuning.z_width import z_width
from asi_common.files import write_text
from asi_controller.compensators import COMPENSATORS

# Figures of a recording: key of `asi analyze`, text, unit ('': of the recording), factor.
RECORDED: Final = (
    ('settling_time_2_s', 'settling to 2 % of the level reached', 'ms', 1e3),
    ('overshoot_percent', 'overshoot of the level reached', '%', 1.0),
    ('steady_state_error_n', 'steady-state error', '', 1.0),
    ('bandwidth_hz', 'bandwidth', 'Hz', 1.0),
    ('tracking_error_percent', 'tracking error, rms', '%', 1.0),
    ('tracking_error_peak_n', 'largest error; with a moved piston, the felt force', '', 1.0),
    ('impedance_real', 'real part of the impedance', 'N s/m', 1.0))


class Condition(NamedTuple):
    """Plants at a control rate; figures of several plants are their median and their worst."""

    name: str
    actuators: Sequence[Values]
    rate_hz: float
    held: bool = False      # only steps and sines, on the load of the plant, without goals


class Comparison(Result):
    """
    The result of `compare_controllers`, with the keys of `asi compare --json`.

    `responses` are the runs of each controller on the actuator as it is, `runs` the recordings.
    """

    title = 'Controllers compared'
    rows = 'figures'
    responses: Mapping[str, Responses]
    runs: Mapping[str, Run]

    def parts(self) -> Iterator[str | Table]:
        yield from self.tables('{} *')
        if any(each['met'] is False for each in self['figures']):
            yield '* target not reached'
        yield from self._notes()

    def tables(self, missing: str) -> Iterator[Table]:
        """Yield a table of each condition, and of the recordings; missing: format of a miss."""
        for condition in dict.fromkeys(each['condition'] for each in self['figures']):
            found: dict[str, dict[str, Any]] = {}
            for each in self['figures']:
                if each['condition'] == condition:
                    not_settled = each['unit'] == 's' and each['value'] >= STEP_S
                    text = filled('over {value:.3g}' if not_settled else '{value:.3g}', each)
                    found.setdefault(each['name'], dict(each))[each['controller']] = (
                        missing.format(text) if each['met'] is False else text)
            yield Table(['', 'target', '', *self.controllers], [
                [row['text'], filled('{goal:.3g}', row), row['unit'],
                 *(row[name] for name in self.controllers)] for row in found.values()],
                condition, ['target', *self.controllers])
            if condition == self['figures'][0]['condition']:
                yield self._steps(condition)
        if self['z_width']:
            yield self._z_width()
        if self['recordings']:
            names = [each['source'] for each in self['recordings']]
            yield Table(['', '', *names], [
                *([text, unit, *(number(each[key] and each[key] * factor,
                                        '' if unit else each['unit'], 3)
                                 for each in self['recordings'])]
                  for key, text, unit, factor in RECORDED),
                ['oscillation', '', *(in_words(each['oscillation'], each['unit'])
                                      for each in self['recordings'])]], 'recordings', names)

    def _z_width(self) -> Table:
        frequencies = [f'{each:g} Hz' for each in IMPEDANCE_HZ]
        lines: dict[tuple[str, str], list[str]] = {}
        for each in self['z_width']:
            known = lines.setdefault((each['controller'], f'{each["factor"]:g}'), [
                filled('{least_re_z_n_s_m:.3g}', each)])
            known.append(filled('{size_n_s_m:.3g}', each))
        for each in self['z_width']:
            width = lines.setdefault((each['controller'], 'Z-width, dB'), [''])
            if len(width) <= len(frequencies):
                width.append(filled('{width_db:.3g}', each))
        return Table(['', 'gain times', 'least Re Z, N s/m', *frequencies],
                     [[*key, *cells] for key, cells in lines.items()],
                     f'size of the impedance (N s/m) at {self.rates_hz[0]:g} Hz, and its range '
                     'over the gains that are passive',
                     ['gain times', 'least Re Z, N s/m', *frequencies])

    def _notes(self) -> Iterator[str]:
        if self['figures'] and self['recordings']:
            yield ('Settling and overshoot are about the reference in simulations, about the '
                   'level reached in recordings.')
        yield from (f'note: {each["source"]}: {note}' for each in self['recordings']
                    for note in each['notes'])

    def _steps(self, condition: str) -> Table:
        sizes: dict[float, list[str]] = {}
        for each in self['steps']:
            sizes.setdefault(each['size_n'], []).append(filled(
                ('over ' if each['settling_s'] >= STEP_S else '') + '{settling_s:.3g} s, '
                '{overshoot_percent:.2g} %, {steady_state_error_n:.2g} N', each))
        return Table(['step', *self.controllers],
                     [[f'{size:g} N', *cells] for size, cells in sizes.items()],
                     f'settling to 2 %, overshoot and steady-state error {condition}',
                     ['step', *self.controllers])

    def markdown(self) -> str:
        """Return the tables as Markdown; what is not reached is bold."""
        blocks = []
        for table in self.tables('**{}**'):
            rows = [table.columns, ['---:' if name in table.right else '---'
                                    for name in table.columns], *table.rows]
            blocks.append(f'## {table.title[0].upper()}{table.title[1:]}\n\n' + '\n'.join(
                '| ' + ' | '.join(row) + ' |' for row in rows))
        return '\n\n'.join(blocks) + '\n'

    def write_markdown(self, path: Path, command: str) -> None:
        """Write the tables as a page of Markdown that names the command."""
        write_text(path, f'# {self.title}\n\nWritten by `{command}`. Bold: target not '
                         f'reached.\n\n{self.markdown()}')

    def pictures(self) -> Pictures:
        rate_hz = self['rates_hz'][0]
        return {**(simulated(self.responses, rate_hz) if self.responses else {}),
                **(recorded(self.runs) if self.runs else {})}


def compare_controllers(
        controllers: Mapping[str, Values], recordings: Mapping[str, Run] | None = None,
        actuator: Values | None = None, rates_hz: Sequence[float] = (5000.0, 2000.0, 1000.0),
        springs_n_m: Sequence[float] = (1e4, 1e5, 1e6), plants: int = 12, noise_n: float = 1.0,
        attacks: int = 300, seed: int = 1, gains: Sequence[float] = (),
        progress: Progress = silent) -> Comparison:
    """
    Return the figures of controllers on an actuator, and those of recordings.

    controllers: parameters by the controller's name; actuator: parameters by name, the rest at
    their defaults. Each controller is simulated at each of the rates (Hz), and at the first of
    them with sensor noise (N rms; 0: not), on `plants` actuators whose parameters have errors of
    up to 20 %, on springs (N/m) and free; and attacked as by `asi quench`, under so many
    conditions at all the rates. gains: factors of gain and integrator at which the impedance is
    taken, for the Z-width. Raises InputError for parameters that are not allowed.

    >>> import asi_analysis as asi
    >>> found = asi.compare_controllers({'P': {'gain': 3.0}, 'lead4': {'compensator': 'lead4'}},
    ...                                 rates_hz=[5000.0], springs_n_m=[], plants=0, noise_n=0.0,
    ...                                 attacks=0)
    >>> [f"{each['controller']} {each['value']:.0f} %" for each in found.figures
    ...  if each['name'] == 'sine_error_percent']
    ['P 26 %', 'lead4 36 %']
    """
    rates_hz, springs_n_m = list(dict.fromkeys(rates_hz)), list(dict.fromkeys(springs_n_m))
    if not rates_hz:
        raise InputError('rates: at least one control rate is needed')
    actuator = actuator or {}
    for values in controllers.values():
        stepping(actuator, values, *rates_hz)
    if min(rates_hz) <= 2.0 * BAND_HZ[-1]:
        raise InputError(f'rates = {min(rates_hz):g} Hz is not allowed: a gain at '
                         f'{BAND_HZ[-1]:g} Hz needs more than {2.0 * BAND_HZ[-1]:g} Hz')
    if not all(each > 0.0 for each in gains):
        raise InputError('gains: factors of the gain are above 0')
    chosen = conditions(actuator, rates_hz, springs_n_m, plants, noise_n, seed)
    widths: list[dict[str, object]] = []
    rows: list[dict[str, Any]] = []
    nominal: dict[str, Responses] = {}
    for begun, (name, controller) in enumerate(controllers.items()):
        tell = part_of(progress, name, begun, len(controllers))
        found, nominal[name] = _simulated(controller, chosen, tell)
        if attacks:
            found.append(_attacked(search(actuator, controller, tuple(rates_hz), attacks, seed,
                                          tell), rates_hz))
        rows += [row | {'controller': name} for row in found]
        if gains:
            widths += [{'controller': name, **row} for row in z_width(
                actuator, controller, gains, rates_hz[0])]
    recordings = recordings or {}
    return Comparison({
        'controllers': list(controllers), 'rates_hz': rates_hz, 'plants': plants,
        'noise_n': noise_n, 'figures': rows,
        'steps': [{'controller': name, **step._asdict()} for name, runs in nominal.items()
                  for step in step_figures(runs.steps, rates_hz[0])],
        'z_width': widths,
        'recordings': [_recording(name, run) for name, run in recordings.items()],
        'quality': quality_of(list(recordings.values())),
    }, responses=nominal, runs=recordings)


def _simulated(controller: Values, chosen: Sequence[Condition], progress: Progress
               ) -> tuple[list[dict[str, Any]], Responses]:
    """Return the rows of a controller, and its responses in the first of the conditions."""
    rows: list[dict[str, Any]] = []
    nominal: list[Responses] = []
    plants = sum(len(each.actuators) for each in chosen)
    done = 0
    for condition in chosen:
        found = []
        for plant in condition.actuators:
            progress(condition.name, done / plants)
            done += 1
            if condition.held:
                found.append(held_figures(*held(plant, controller, condition.rate_hz),
                                          condition.rate_hz))
            else:
                runs = responses(plant, controller, condition.rate_hz)
                found.append(figures(plant, controller, condition.rate_hz, runs))
                nominal = nominal or [runs]
        rows += _rows(condition, found)
    return rows, nominal[0]


def conditions(actuator: Values, rates_hz: Sequence[float], springs_n_m: Sequence[float],
               plants: int, noise_n: float, seed: int) -> list[Condition]:
    """Return the conditions of a comparison, the actuator as it is at the first rate first."""
    first = rates_hz[0]
    found = [Condition(f'at {rate:g} Hz', [actuator], rate) for rate in rates_hz]
    if noise_n:
        found.append(Condition(f'with sensor noise of {noise_n:g} N',
                               [{**actuator, 'force_sensor.noise': noise_n}], first))
    if plants:
        random = np.random.default_rng(seed)
        found.append(Condition(f'{plants} plants within 20 %', [
            {**actuator, **with_errors(actuator, dict(zip(VARIED, random.random(len(VARIED)),
                                                          strict=True)))}
            for _ in range(plants)], first))
    for each in springs_n_m:
        sprung = {**actuator, 'load.type': 'spring', 'load.stiffness': each}
        try:
            stepping(sprung, {}, first)
        except InputError as error:
            raise InputError(f'springs: {error}') from None
        found.append(Condition(f'on a spring of {each:g} N/m', [sprung], first, held=True))
    if springs_n_m:
        found.append(Condition('with a free load', [{**actuator, 'load.type': 'free'}], first,
                               held=True))
    return found


def _rows(condition: Condition, found: Sequence[Mapping[str, float]]) -> list[dict[str, Any]]:
    """Return the rows of a condition; for several plants the median, then the worst of them."""
    rows = [row for row in ROWS if row.name in found[0]]
    worst = {row.name: (min if row.more else max)(each[row.name] for each in found)
             for row in rows}
    statistics = {condition.name: worst}
    if len(found) > 1:
        middle = {row.name: float(np.median([each[row.name] for each in found])) for row in rows}
        statistics = {f'{condition.name}, median': middle, f'{condition.name}, worst': worst}
    return [{'condition': name, 'name': row.name, 'text': row.text, 'unit': row.unit,
             'goal': None if condition.held else row.goal, 'value': values[row.name],
             'met': None if condition.held else bool(missed(values)[row.name] <= 0.0)}
            for name, values in statistics.items() for row in rows]


def _attacked(trials: Sequence[Trial], rates_hz: Sequence[float]) -> dict[str, Any]:
    """Return the row of the attack of `asi quench`."""
    found = sum(trial.sustained for trial in trials)
    rates = ', '.join(f'{rate:g}' for rate in rates_hz)
    return {'condition': f'{len(trials)} attacks at {rates} Hz', 'name': 'sustained_found',
            'text': 'sustained oscillations', 'unit': '', 'goal': 0.0, 'value': float(found),
            'met': found == 0}


def _recording(name: str, run: Run) -> dict[str, Any]:
    analysis = analyze(run)
    figures = ('oscillation', *(key for key, *_ in RECORDED))
    return {'source': name, **{key: analysis[key] for key in ('unit', 'notes', *figures)},
            'reliable': {key: analysis['reliable'][key] for key in figures
                         if key in analysis['reliable']}}


def read_compared(texts: Sequence[str]) -> tuple[dict[str, Values], dict[str, Run]]:
    """
    Return the controllers and the recordings that texts name.

    A text is the name of a compensator, a parameter file of a controller, or a bag. Raises
    InputError if it is none of them.
    """
    controllers: dict[str, Values] = {}
    recordings: dict[str, Run] = {}
    for text in texts:
        if texts.count(text) > 1:
            raise InputError(f'{text} is given twice')
        if text in COMPENSATORS:
            controllers[text] = {'compensator': text}
        elif Path(text).suffix in ('.yaml', '.yml'):
            short = Path(text).stem
            controllers[text if short in controllers or short in COMPENSATORS else short] = (
                read_parameters(Path(text), 'controller'))
        elif Path(text).exists():
            recordings[text] = read_bag(text)
        else:
            raise InputError(f'{text} is neither a compensator ({", ".join(COMPENSATORS)}), nor a '
                             'parameter file (.yaml), nor a bag')
    return controllers, recordings
