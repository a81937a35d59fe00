"""`asi quench`: limit-cycle margin of a compensator, and conditions under which it cycles."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from asi_analysis.experiments.experiment import stepping
from asi_analysis.limit_cycle.quench.attack import Trial, search
from asi_analysis.limit_cycle.quench.dither import dither
from asi_analysis.limit_cycle.quench.margin import LOADS, margin
from asi_analysis.loop.simulation import Values, step_run, sustained
from asi_analysis.reporting.result import Pictures, Result, Table, filled, finite, table_of
from asi_analysis.terminal import Progress, silent

WORST: Final = 5


class Quench(Result):
    """
    Limit-cycle margin, conditions found and dither: `quench_cycles`.

    The keys are those of `asi quench --json`; `actuator` and `controller` are the parameters.
    """

    title = 'Limit cycles quenched'
    rows = 'worst'
    actuator: Values
    controller: Values

    def parts(self) -> Iterator[str | Table]:
        yield f'{self.compensator} at {self.rate_hz:g} Hz'
        yield filled('margin {margin:.3g}, least at {margin_at[frequency_hz]:.3g} Hz, amplitude '
                     '{margin_at[amplitude_n]:.3g} N, bias {margin_at[bias_n]:g} N, load '
                     '{margin_at[load]}', self)
        yield (f'{self.sustained_found} sustained oscillations in {self.conditions_tried} '
               'conditions')
        if self.sustained_found and self.margin > 0.0:
            yield f'the margin does not show them; its loads are {", ".join(LOADS)}'
        worst = [each for each in self.worst if each['sustained']]
        if worst:
            yield table_of([{**each, 'load': _load(each['condition']['actuator'])}
                            for each in worst], {
                'amplitude N': '{amplitude_n:.3g}', 'control Hz': '{condition[rate_hz]:g}',
                'load': '{load}',
                'reference': '{condition[reference][reference.shape]}',
                'size N': '{condition[reference][reference.amplitude]:.0f}',
                'about N': '{condition[reference][reference.offset]:.0f}'},
                'the largest (-: unbounded)')
        if self.replayed:
            yield table_of(self.replayed, {
                'bag': '{bag}', 'verdict': '{verdict}', 'Hz': '{frequency_hz:.4g}',
                'amplitude N': '{amplitude_n:.3g}', 'why': '{why}'}, 'over ROS')
        if self.dither:
            yield table_of(self.dither, {
                'Hz': '{frequency_hz:g}', 'quenches N': '{amplitude_n:.0f}',
                'least cycle left': '{least_left:.0%}', 'at N': '{least_left_at_n:.0f}',
                'valve travel m/s': '{valve_travel_m_s:.3g}',
                'force ripple N rms': '{force_ripple_n:.3g}'}, 'dither (-: none quenches)')

    def pictures(self) -> Pictures:
        from asi_analysis.limit_cycle.quench.figure import draw
        return {'quench': (draw(self.actuator, self.controller, self),
                           'Loop and -1/N where the margin is least')}


def quench_cycles(actuator: Values, controller: Values, rates_hz: Sequence[float] = (5000.0,),
                  count: int = 200, seed: int = 1,
                  replayed: tuple[int, Path] | None = None, progress: Progress = silent) -> Quench:
    """
    Compute the limit-cycle margin of a compensator, and search for conditions that make it cycle.

    actuator, controller: parameters by name, the rest at their defaults. rates_hz: control rates
    of the search, Hz; the first also for margin and dither. count: conditions tried; seed: of the
    search; replayed: number of the worst conditions to run over ROS, and the directory of their
    bags.

    >>> import asi_analysis as asi
    >>> found = asi.quench_cycles({}, {'compensator': 'lead4'}, count=8)
    >>> found.sustained_found, round(found.margin, 2)
    (0, 0.83)
    """
    controller = stepping(actuator, controller, *rates_hz)
    rate = rates_hz[0]
    progress('margin', None)
    found = margin(actuator, controller, rate)
    trials = search(actuator, controller, tuple(rates_hz), count, seed, progress)
    cycling = [trial for trial in trials if trial.sustained]
    document: dict[str, Any] = {
        'compensator': str(controller.get('compensator', 'proportional')),
        'rate_hz': rate, 'margin': found.distance,
        'margin_at': {'amplitude_n': found.amplitude_n, 'bias_n': found.bias_n,
                      'frequency_hz': found.frequency_hz, 'load': found.load},
        'conditions_tried': count, 'sustained_found': len(cycling),
        'worst_amplitude_n': finite(cycling[0].amplitude_n) if cycling else 0.0,
        'worst': [_trial(trial, tuple(rates_hz), actuator) for trial in trials[:WORST]],
        'replayed': [], 'dither': []}
    if replayed:
        from asi_analysis.limit_cycle.quench.replay import replay
        document['replayed'] = replay(trials[:replayed[0]], controller, actuator,
                                      tuple(rates_hz), replayed[1], progress)
    if sustained(step_run(actuator, controller, rate)) is not None:
        document['dither'] = dither(actuator, controller, rate, report=progress)
    return Quench(document, actuator=actuator, controller=controller)


def _load(actuator: Values) -> str:
    kind = str(actuator['load.type'])
    if kind == 'locked':
        return kind
    if kind == 'prescribed':
        return f'moved at {actuator["load.velocity"]:.2g} m/s'
    spring = f'{actuator["load.stiffness"]:.2g} N/m, ' if kind == 'spring' else ''
    return f'{kind}, {spring}{actuator["load.mass"]:.2g} kg'


def _trial(trial: Trial, rates_hz: tuple[float, ...], actuator: Values) -> dict[str, Any]:
    return {'amplitude_n': finite(trial.amplitude_n), 'sustained': trial.sustained,
            'frequency_hz': finite(trial.found.frequency_hz),
            'condition': trial.condition.settings(rates_hz, actuator)}
