"""`asi predict`: predicted cycles over a range of gains, beside the simulated ones."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from asi_analysis.errors import InputError
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
from asi_analysis.loop.simulation import (
    Values,
    loop_of,
    remembering,
    step_run,
    sustained,
)
from asi_analysis.measures.oscillation import Oscillation
from asi_analysis.terminal import Progress, silent


def predict(actuator: Values, controller: Values, rate_hz: float, first_gain: float,
            steps_n: Sequence[float] = (), report: Progress = silent) -> dict[str, Any]:
    """
    Return all that `asi predict --json` prints: cycles by each method, and how they agree.

    first_gain: below the onset; the search begins there. steps_n: sizes of step (N) for which the
    onset is wanted too. Raises InputError for a gain from which no search can begin.
    """
    if not first_gain > 0.0:
        raise InputError(f'gain = {first_gain:g} is not allowed: the search begins there, above 0')
    report('describing function of the hysteresis', 0.0)
    loop = loop_of(actuator, with_gain(controller, first_gain), rate_hz)
    unit = user_gain(controller, loop)
    one = OneHarmonic(loop, held=True)
    rows = locus(one)
    first = first_intersection(one, rows) if rows else None
    report('harmonic balance', 0.1)
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
        cycles += _compared(actuator, controller, rate_hz, points, report, document)
    onsets = onset_by_step(actuator, controller, rate_hz, first_gain, steps_n, report)
    return document | {'cycles': cycles, 'onset_by_step': onsets}


def _cycle(gain: float, frequency: float, amplitude: float, stable: bool, method: str,
           **more: float | None) -> dict[str, Any]:
    return {'gain': float(gain), 'frequency_hz': float(frequency),
            'amplitude_n': float(amplitude), 'stable': stable, 'method': method,
            'thd': None, 'second_multiplier': None, **more}


def _from_locus(one: OneHarmonic, rows: list[Intersection], unit: float,
                points: list[hb.Balance]) -> list[dict[str, Any]]:
    """Return the paper's prediction, up to somewhat above the gains of the balanced cycles."""
    gains = [row.gain / unit for row in rows]
    most = 1.2 * max([point.gain for point in points] or [2.0 * min(gains, default=np.inf)])
    return [_cycle(gain, row.frequency_hz, row.amplitude_n, stable(one, row),
                   'describing_function')
            for gain, row in zip(gains, rows, strict=True) if gain <= most]


def onset_by_step(actuator: Values, controller: Values, rate_hz: float, first_gain: float,
                  steps_n: Sequence[float], report: Progress = silent
                  ) -> list[dict[str, float | None]]:
    """
    Return onset gain and frequency by the size of the step, predicted and simulated (Fig. 7).

    Predicted: the fold, below which no cycle exists. Simulated: the least gain at which the step
    from rest is kick enough to reach it, so never lower.
    """
    rows: list[dict[str, float | None]] = []
    for k, step in enumerate(steps_n):
        report(f'onset for a step of {step:g} N', k / len(steps_n))
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
              report: Progress, document: dict[str, Any]) -> list[dict[str, Any]]:
    """Return balanced and simulated cycles; the largest errors go into the document."""
    lowest = int(np.argmin([point.gain for point in points]))
    cycles, errors = [], []
    for k, point in enumerate(points):
        report('simulation and Floquet multipliers', 0.3 + 0.7 * k / len(points))
        stable = k < lowest
        second = None
        if stable:
            settings = with_gain(controller, point.gain)
            run = step_run(actuator, settings, rate_hz)
            swing = sustained(run)
            if swing is not None:
                point = _as_the_step_left_it(actuator, settings, rate_hz, point, run, swing)
                second = float(multipliers(actuator, settings, rate_hz, swing.frequency_hz)[1])
                errors.append((point.frequency_hz / swing.frequency_hz - 1.0,
                               point.amplitude_n / swing.amplitude_n - 1.0))
                cycles.append(_cycle(point.gain, swing.frequency_hz, swing.amplitude_n, True,
                                     'simulation', thd=swing.thd, second_multiplier=second))
        cycles.append(_cycle(point.gain, point.frequency_hz, point.amplitude_n, stable,
                             'harmonic_balance', thd=point.thd, second_multiplier=second))
    if errors:
        document['largest_frequency_error'], document['largest_amplitude_error'] = (
            float(value) for value in np.abs(errors).max(0))
    return cycles


def _as_the_step_left_it(actuator: Values, controller: Values, rate_hz: float, point: hb.Balance,
                         run: LoopRun, swing: Oscillation) -> hb.Balance:
    """Return the balance near a point of the branch with what the seals of a run remember."""
    loop = remembering(loop_of(actuator, controller, rate_hz), run, swing.frequency_hz)
    own = float(loop.compensator['gain'])
    found = hb.balance(loop, point._replace(gain=own))
    return point if found is None else found._replace(gain=point.gain)


def as_text(document: dict[str, Any]) -> str:
    """Return the answer for people."""
    def figure(value: float | None, unit: str = '', digits: int = 4) -> str:
        return '-' if value is None else f'{value:.{digits}g}{unit}'

    lines = [f'{document["compensator"]} at {document["rate_hz"]:g} Hz, reference '
             f'{document["reference_n"]:g} N', '',
             f'{"gain":>8}{"frequency Hz":>14}{"amplitude N":>13}{"THD %":>8}'
             f'{"multiplier":>12}  stable  method']
    lines += [f'{c["gain"]:8.3f}{c["frequency_hz"]:14.2f}{c["amplitude_n"]:13.1f}'
              f'{figure(c["thd"] and 100 * c["thd"], digits=3):>8}'
              f'{figure(c["second_multiplier"], digits=3):>12}  '
              f'{"yes" if c["stable"] else "no":<8}{c["method"].replace("_", " ")}'
              for c in document['cycles']]
    if document['onset_gain'] is None:
        lines.append('no cycle found: neither balanced nor simulated')
    else:
        lines.append(f'onset (fold): gain {document["onset_gain"]:.4g}, '
                     f'{document["onset_frequency_hz"]:.4g} Hz; the hysteresis alone, one '
                     'harmonic: '
                     f'{figure(document["describing_function_onset_gain"])}, '
                     f'{figure(document["describing_function_onset_frequency_hz"], " Hz")}')
        lines.append('one harmonic, each nonlinearity alone: ' + '; '.join(
            f'{row["nonlinearity"].replace("_", " ")} {figure(row["onset_gain"])}, '
            f'{figure(row["onset_frequency_hz"], " Hz")}' for row in document['one_harmonic'])
            + f'; without any {figure(document["linear_limit_gain"])}')
        if document['largest_frequency_error'] is not None:
            lines.append('harmonic balance against simulation, at most: '
                         f'{100 * document["largest_frequency_error"]:.2g} % in frequency, '
                         f'{100 * document["largest_amplitude_error"]:.2g} % in amplitude')
    lines += [f'step {r["step_n"]:g} N: onset predicted {figure(r["predicted_gain"])}, '
              f'{figure(r["predicted_frequency_hz"], " Hz")}; simulated '
              f'{figure(r["simulated_gain"])}, {figure(r["simulated_frequency_hz"], " Hz")}'
              for r in document['onset_by_step']]
    return '\n'.join(lines)
