"""`asi tune`: settings of the controller for an actuator, proved under attack."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from matplotlib.figure import Figure

from asi_analysis.errors import InputError
from asi_analysis.limit_cycle.quench.answer import quench_cycles
from asi_analysis.loop.closed_loop import Values
from asi_analysis.reporting.result import Pictures, Result, Table, filled, table_of
from asi_analysis.terminal import Progress, silent
from asi_analysis.tuning.figures import ROWS, figures, missed
from asi_analysis.tuning.margins import margins
from asi_analysis.tuning.search import attacked_rates, front, tune
from asi_common.parameter_file import write_parameters

# Values to reach instead of those of ROWS.
PREFERENCES: Final[Mapping[str, Mapping[str, float]]] = {
    'balanced': {},
    'stiff': {'settling_median_s': 0.012, 'sine_error_percent': 8.0, 'felt_force_slow_n': 40.0,
              'felt_force_fast_n': 150.0},
    'transparent': {'felt_force_slow_n': 15.0, 'felt_force_fast_n': 50.0,
                    'settling_median_s': 0.03, 'settling_worst_s': 0.06,
                    'sine_error_percent': 25.0},
    'quiet': {'felt_force_fast_n': 100.0, 'least_re_z_n_s_m': 4.0},
}
# Figures of the Pareto front: error, settling, felt force and effort.
FRONT: Final = ('sine_error_percent', 'settling_median_s', 'felt_force_slow_n', 'noise_gain')


class Tuning(Result):
    """
    Settings found, their figures, and the front: `tune_controller`.

    The keys are those of `asi tune --json`.
    """

    title = 'Controller tuned'
    rows = 'rows'

    def parts(self) -> Iterator[str | Table]:
        yield table_of(self['rows'], {
            'figure': '{text}', 'before': '{before:.3g}', 'found': '{value:.3g}',
            'target': '{goal:.3g}', '': '{unit}', 'reached': '{met}'},
            f'{self.prefer}, at {self.rate_hz:g} Hz, after {self.evaluations} settings tried')
        yield table_of(self.margins, {
            'moved at m/s': '{velocity_m_s:g}', 'gain margin': '{gain:.2f}',
            'at Hz': '{gain_frequency_hz:.0f}', 'phase margin °': '{phase_deg:.0f}',
            'disk margin': '{disk:.2f}'}, 'Margins of the linear loop')
        yield filled('{sustained_found} sustained oscillations in {conditions_tried} conditions, '
                     'limit-cycle margin {margin:.3g}', self)
        yield (f'{len(self.front)} settings tried are quiet under attack, and none is better in '
               'one of ' + ', '.join(FRONT) + ' without being worse in another')
        if self.file:
            yield f'written: {self.file}'

    def pictures(self) -> Pictures:
        return {'front': (_draw(self), 'Pareto front of the settings; below and to the left is '
                                       'better')}


def tune_controller(actuator: Values, start: Values, prefer: str = 'balanced',
                    evaluations: int = 480, conditions: int = 300, seed: int = 1,
                    out: Path | None = None, rate_hz: float = 5000.0,
                    progress: Progress = silent) -> Tuning:
    """
    Search the settings of the controller for an actuator, and attack those that are found.

    actuator, start: parameters by name, the rest at their defaults; the search begins at `start`.
    prefer: one of PREFERENCES. evaluations: settings tried; conditions: of the last attack; seed:
    of both. out: directory for `controller.yaml`. rate_hz: control rate of the figures; the attack
    also tries lower ones. Takes a minute and more. Raises InputError for another preference.

    >>> import asi_analysis as asi
    >>> found = asi.tune_controller({}, {}, evaluations=100)  # doctest: +SKIP
    """
    if prefer not in PREFERENCES:
        raise InputError(f'prefer = {prefer!r}: it is one of {", ".join(PREFERENCES)}')
    goals = PREFERENCES[prefer]
    before = figures(actuator, start, rate_hz)
    best, tried = tune(actuator, start, goals, evaluations, seed, rate_hz, progress)
    progress('attack', None)
    attack = quench_cycles(actuator, best.controller, attacked_rates(rate_hz), conditions,
                           seed + 1000)
    file = None
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        file = out / 'controller.yaml'
        write_parameters(file, '/**/asi_controller', best.controller,
                         header=['Written by `asi tune`.'])
    return Tuning({
        'prefer': prefer, 'rate_hz': rate_hz, 'evaluations': evaluations,
        'controller': dict(best.controller),
        'rows': _rows(best.figures, before, goals),
        **{key: attack[key] for key in ('margin', 'conditions_tried', 'sustained_found',
                                        'worst_amplitude_n')},
        'margins': [each._asdict() for each in margins(actuator, best.controller, rate_hz)],
        'front': [{**each.figures, 'controller': dict(each.controller)}
                  for each in front(tried, FRONT)],
        'file': str(file) if file else None}, best=best)


def _rows(found: Mapping[str, float], before: Mapping[str, float], goals: Mapping[str, float]
          ) -> list[dict[str, Any]]:
    """Return the figures with their goals, and whether these are reached."""
    misses = missed(found, goals)
    return [{'name': row.name, 'text': row.text, 'unit': row.unit,
             'goal': goals.get(row.name, row.goal),
             'before': before[row.name], 'value': found[row.name],
             'met': bool(misses[row.name] <= 0.0)} for row in ROWS]


def _draw(tuning: Tuning) -> Figure:
    drawn = Figure(figsize=(8.0, 3.2), layout='constrained')
    chosen = {row['name']: row['value'] for row in tuning['rows']}
    labels = {row.name: f'{row.text} ({row.unit})' for row in ROWS}
    first = FRONT[0]
    for axes, name in zip(drawn.subplots(1, len(FRONT) - 1), FRONT[1:], strict=True):
        axes.loglog([each[name] for each in tuning.front], [each[first] for each in tuning.front],
                    '.', alpha=0.4)
        axes.plot(chosen[name], chosen[first], 'o', color='tab:red')
        axes.set_xlabel(labels[name], fontsize=7)
    drawn.axes[0].set_ylabel(labels[first], fontsize=7)
    return drawn
