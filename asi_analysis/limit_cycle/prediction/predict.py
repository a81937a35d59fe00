"""`asi predict`: predicted and simulated limit cycles over a range of gains."""

from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np

from asi_analysis.errors import InputError
from asi_analysis.experiments.experiment import stepping
from asi_analysis.loop import harmonic_balance as hb
from asi_analysis.loop.closed_loop import LoopRun
from asi_analysis.loop.floquet import multipliers
from asi_analysis.loop.one_harmonic import (
    Intersection,
    OneHarmonic,
    each_alone,
    first_intersection,
    linear_limit,
    locus,
    stable,
)
from asi_analysis.loop.onset import branch, fold, onset, user_gain, with_gain
from asi_analysis.loop.simulation import Values, loop_of, step_run, sustained, with_mean_friction
from asi_analysis.measures.oscillation import Oscillation
from asi_analysis.reporting.result import Pictures, Result, Table, filled, table_of
from asi_analysis.terminal import Progress, silent

# Additions to the compensator that neither method contains.
UNKNOWN: Final = ('integrator.rate', 'hysteresis_inverse.size', 'velocity_feedforward.share',
                  'friction_feedforward.level', 'disturbance_observer.bandwidth',
                  'gain_schedule.velocity')


class Prediction(Result):
    """
    Predicted and simulated limit cycles over the gain: `predict_cycles`.

    The keys are those of `asi predict --json`; `actuator` and `controller` are the parameters.
    """

    title = 'Predicted limit cycles'
    rows = 'cycles'
    actuator: Values
    controller: Values
    first_gain: float

    def parts(self) -> Iterator[str | Table]:
        yield (f'{self.compensator} at {self.rate_hz:g} Hz, reference {self.reference_n:g} N')
        yield table_of(self.cycles, {
            'gain': '{gain:.3f}', 'Hz': '{frequency_hz:.2f}', 'amplitude N': '{amplitude_n:.1f}',
            'THD': '{thd:.2%}', 'multiplier': '{second_multiplier:.3g}', 'stable': '{stable}',
            'method': '{method}'})
        if self.onset_gain is None:
            yield 'no cycle found, neither by harmonic balance nor by simulation'
        else:
            yield filled('onset (fold of the branch): gain {onset_gain:.4g}, '
                         '{onset_frequency_hz:.4g} Hz; by the describing function of the '
                         'hysteresis alone: {describing_function_onset_gain:.4g}, '
                         '{describing_function_onset_frequency_hz:.4g} Hz; without any '
                         'nonlinearity: {linear_limit_gain:.4g}', self)
            yield table_of(self.one_harmonic, {
                'nonlinearity': '{nonlinearity}', 'gain': '{onset_gain:.4g}',
                'Hz': '{onset_frequency_hz:.4g}'},
                'onset with one nonlinearity alone, one harmonic')
        if self.largest_frequency_error is not None:
            yield ('largest difference of harmonic balance and simulation: '
                   f'{100.0 * self.largest_frequency_error:.2g} % in frequency, '
                   f'{100.0 * self.largest_amplitude_error:.2g} % in amplitude')
        if self.onset_by_step:
            yield table_of(self.onset_by_step, {
                'step N': '{step_n:g}', 'predicted gain': '{predicted_gain:.4g}',
                'predicted Hz': '{predicted_frequency_hz:.4g}',
                'simulated gain': '{simulated_gain:.4g}',
                'simulated Hz': '{simulated_frequency_hz:.4g}'}, 'onset over the size of the step')

    def pictures(self) -> Pictures:
        from asi_analysis.limit_cycle.prediction.figures import drawn
        gain = 1.2 * (self.onset_gain or self.first_gain)
        return drawn(loop_of(self.actuator, with_gain(self.controller, gain), self.rate_hz), self)


def predict_cycles(actuator: Values, controller: Values, rate_hz: float = 5000.0,
                   first_gain: float = 5.0, steps_n: Sequence[float] = (),
                   progress: Progress = silent) -> Prediction:
    """
    Predict the limit cycles of a loop from its model, and simulate them for comparison.

    Methods: describing function of the hysteresis alone (Gelb and Vander Velde, Multiple-Input
    Describing Functions, 1968), and harmonic balance of all nonlinearities. actuator, controller:
    parameters by name, the rest at their defaults; the steady-state force is
    `reference.amplitude` (N). rate_hz: control rate, Hz. first_gain: start of the search, below
    the onset. steps_n: step sizes (N) for which the onset is computed as well. Raises InputError
    unless first_gain is positive, and for additions that the methods do not know.

    >>> import asi_analysis as asi
    >>> found = asi.predict_cycles({}, {'reference.amplitude': 100.0})    # doctest: +SKIP
    """
    if not first_gain > 0.0:
        raise InputError(f'gain = {first_gain:g} is not allowed: it must be above 0')
    controller = stepping(actuator, controller, rate_hz)
    for name in UNKNOWN:
        if controller.get(name):
            raise InputError(f'{name} = {controller[name]:g} is not allowed: the prediction does '
                             'not know this addition')
    progress('describing function of the hysteresis', 0.0)
    loop = loop_of(actuator, with_gain(controller, first_gain), rate_hz)
    unit = user_gain(controller, loop)
    one = OneHarmonic(loop, held=True)
    rows = locus(one)
    first = first_intersection(one, rows) if rows else None
    progress('harmonic balance', 0.1)
    points = branch(actuator, controller, rate_hz, first_gain)
    cycles = _from_locus(one, rows, unit, points)
    document: dict[str, Any] = {
        'compensator': str(controller.get('compensator', 'proportional')),
        'rate_hz': rate_hz, 'reference_n': loop.reference_n, 'onset_gain': None,
        'onset_frequency_hz': None, 'onset_amplitude_n': None,
        'describing_function_onset_gain': first.gain / unit if first else None,
        'describing_function_onset_frequency_hz': first.frequency_hz if first else None,
        'linear_limit_gain': None, 'largest_frequency_error': None,
        'largest_amplitude_error': None}
    document['one_harmonic'] = [
        {'nonlinearity': name, 'onset_gain': alone[0] / unit if alone else None,
         'onset_frequency_hz': alone[1] if alone else None}
        for name, alone in each_alone(one).items()]
    limit = linear_limit(one)
    if limit:
        document['linear_limit_gain'] = limit[0] / unit
    if points:
        gain, frequency, amplitude = hb.fold(points)
        document |= {'onset_gain': gain, 'onset_frequency_hz': frequency,
                     'onset_amplitude_n': amplitude}
        cycles += _compared(actuator, controller, rate_hz, points, progress, document)
    onsets = onset_by_step(actuator, controller, rate_hz, first_gain, steps_n, progress)
    return Prediction(document | {'cycles': cycles, 'onset_by_step': onsets}, actuator=actuator,
                      controller=controller, first_gain=first_gain)


def _cycle(gain: float, frequency: float, amplitude: float, stable: bool, method: str,
           **more: float | None) -> dict[str, Any]:
    return {'gain': float(gain), 'frequency_hz': float(frequency),
            'amplitude_n': float(amplitude), 'stable': stable, 'method': method,
            'thd': None, 'second_multiplier': None, **more}


def _from_locus(one: OneHarmonic, rows: list[Intersection], unit: float,
                points: list[hb.Balance]) -> list[dict[str, Any]]:
    """Return the paper's prediction, up to 1.2 times the largest gain of the balanced cycles."""
    gains = [row.gain / unit for row in rows]
    most = 1.2 * max([point.gain for point in points] or [2.0 * min(gains, default=np.inf)])
    return [_cycle(gain, row.frequency_hz, row.amplitude_n, stable(one, row),
                   'describing_function')
            for gain, row in zip(gains, rows, strict=True) if gain <= most]


def onset_by_step(actuator: Values, controller: Values, rate_hz: float, first_gain: float,
                  steps_n: Sequence[float], progress: Progress = silent
                  ) -> list[dict[str, float | None]]:
    """
    Return onset gain and frequency by the size of the step, predicted and simulated (Fig. 7).

    Predicted: the fold, below which no cycle exists. Simulated: the least gain at which the step
    from rest leads to the cycle, which cannot be lower.
    """
    rows: list[dict[str, float | None]] = []
    for k, step in enumerate(steps_n):
        progress(f'onset for a step of {step:g} N', k / len(steps_n))
        settings = {**controller, 'reference.amplitude': float(step)}
        row: dict[str, float | None] = dict.fromkeys(
            ('predicted_gain', 'predicted_frequency_hz', 'simulated_gain',
             'simulated_frequency_hz'))
        simulated = onset(actuator, settings, rate_hz, first_gain)
        if simulated:
            row |= {'simulated_gain': simulated.gain,
                    'simulated_frequency_hz': simulated.frequency_hz}
            predicted = fold(actuator, settings, rate_hz, simulated.gain)
            if predicted:
                row |= {'predicted_gain': predicted.gain,
                        'predicted_frequency_hz': predicted.frequency_hz}
        rows.append({'step_n': float(step), **row})
    return rows


def _compared(actuator: Values, controller: Values, rate_hz: float, points: list[hb.Balance],
              progress: Progress, document: dict[str, Any]) -> list[dict[str, Any]]:
    """Return balanced and simulated cycles; put the largest errors into the document."""
    lowest = int(np.argmin([point.gain for point in points]))
    cycles, errors = [], []
    for k, point in enumerate(points):
        progress('simulation and Floquet multipliers', 0.3 + 0.7 * k / len(points))
        stable = k < lowest
        second = None
        if stable:
            settings = with_gain(controller, point.gain)
            run = step_run(actuator, settings, rate_hz)
            cycle = sustained(run)
            if cycle is not None:
                point = _with_friction_of(run, cycle, actuator, settings, rate_hz, point)
                second = float(multipliers(actuator, settings, rate_hz, cycle.frequency_hz)[1])
                errors.append((point.frequency_hz / cycle.frequency_hz - 1.0,
                               point.amplitude_n / cycle.amplitude_n - 1.0))
                cycles.append(_cycle(point.gain, cycle.frequency_hz, cycle.amplitude_n, True,
                                     'simulation', thd=cycle.thd, second_multiplier=second))
        cycles.append(_cycle(point.gain, point.frequency_hz, point.amplitude_n, stable,
                             'harmonic_balance', thd=point.thd, second_multiplier=second))
    if errors:
        document['largest_frequency_error'], document['largest_amplitude_error'] = (
            float(value) for value in np.abs(errors).max(0))
    return cycles


def _with_friction_of(run: LoopRun, oscillation: Oscillation, actuator: Values,
                      controller: Values, rate_hz: float, point: hb.Balance) -> hb.Balance:
    """Return the balance near a point of the branch, with the mean friction of a simulation."""
    loop = with_mean_friction(
        loop_of(actuator, controller, rate_hz), run, oscillation.frequency_hz)
    found = hb.balance(loop, point._replace(gain=float(loop.compensator['gain'])))
    return point if found is None else found._replace(gain=point.gain)
