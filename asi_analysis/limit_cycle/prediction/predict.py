"""`asi predict`: predicted cycles over a range of gains, beside the simulated ones."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from asi_analysis.errors import InputError
from asi_analysis.loop import harmonic_balance as hb
from asi_analysis.loop.closed_loop import LoopRun
from asi_analysis.loop.floquet import multipliers
from asi_analysis.loop.one_harmonic import Locus, each_alone, hysteresis_alone, linear_limit
from asi_analysis.loop.simulation import (
    Values,
    as_balance,
    loop_of,
    remembering,
    step_run,
    step_runs,
    sustained,
)
from asi_analysis.measures.sinusoid import Oscillation
from asi_analysis.terminal import Progress, silent

# The gain is raised by this share until the loop cycles, up to MOST times the first.
RAISE: Final = 1.06
MOST: Final = 12.0
# Gains that are tried at a time.
SIDE_BY_SIDE: Final = 4
COMMANDS_N: Final = np.geomspace(60.0, 1.6e4, 36)


def with_gain(controller: Values, gain: float) -> dict[str, Any]:
    """Return the controller's parameters with another gain."""
    return {**controller, 'gain': float(gain)}


def _user_gain(controller: Values, loop: hb.Loop) -> float:
    """Return the gain of the compensator's record for a gain of 1 in the user's parameters."""
    unit = loop_of({}, with_gain(controller, 1.0), 1.0 / loop.period_s)
    return float(unit.compensator['gain'])


def first_cycle(actuator: Values, controller: Values, rate_hz: float, first: float,
                harmonics: int = hb.HARMONICS) -> tuple[hb.Loop, hb.Balance] | None:
    """
    Return a balanced cycle at a gain somewhat above the simulated onset; None if there is none.

    first: gain to begin with, of the controller's parameter `gain`.
    """
    gain = first
    while gain <= MOST * first:
        settings = with_gain(controller, gain)
        run = step_run(actuator, settings, rate_hz)
        swing = sustained(run)
        if swing is not None:
            loop = remembering(loop_of(actuator, settings, rate_hz), run, swing.frequency_hz)
            own = float(loop.compensator['gain'])
            found = hb.balance(loop, as_balance(run, swing, own, harmonics))
            if found is not None:
                return loop, found
        gain *= RAISE
    return None


def simulated_onset(actuator: Values, controller: Values, rate_hz: float, low: float,
                    accuracy: float = 0.005) -> tuple[float, float, float] | None:
    """Return (gain, frequency, amplitude) of the least gain at which a step leaves a cycle."""
    gains = [low]
    while gains[-1] <= MOST * low:
        gains.append(gains[-1] * RAISE)
    for first in range(1, len(gains), SIDE_BY_SIDE):
        tried = [with_gain(controller, gain) for gain in gains[first:first + SIDE_BY_SIDE]]
        swings = [sustained(run) for run in step_runs([actuator] * len(tried), tried, rate_hz)]
        cycling = [k for k, swing in enumerate(swings, first) if swing is not None]
        if cycling:
            break
    else:
        return None
    below, high, found = gains[cycling[0] - 1], gains[cycling[0]], swings[cycling[0] - first]
    while high > below * (1.0 + accuracy):
        middle = 0.5 * (below + high)
        trial = sustained(step_run(actuator, with_gain(controller, middle), rate_hz))
        if trial is None:
            below = middle
        else:
            high, found = middle, trial
    assert found is not None
    return high, found.frequency_hz, found.amplitude


def branch(actuator: Values, controller: Values, rate_hz: float, first: float,
           onset_only: bool = False) -> list[hb.Balance]:
    """
    Return the branch of cycles by full harmonic balance, gains as in the parameters.

    From the highest gain down and round the fold; onset_only: without what lies above its begin.
    """
    begin = first_cycle(actuator, controller, rate_hz, first)
    if begin is None:
        return []
    loop, start = begin
    unit = _user_gain(controller, loop)
    found = hb.continue_in_gain(loop, start, 0.3 * start.gain, 1.35 * start.gain)
    upward = [] if onset_only else hb.continue_in_gain(
        loop, start, 0.3 * start.gain, 1.3 * start.gain, rising=True)
    return [point._replace(gain=point.gain / unit) for point in [*upward[:0:-1], *found]]


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
    unit = _user_gain(controller, loop)
    locus = hysteresis_alone(loop, COMMANDS_N)
    locus = locus._replace(gain=locus.gain / unit)
    report('harmonic balance', 0.1)
    points = branch(actuator, controller, rate_hz, first_gain)
    cycles = _from_locus(locus, points)
    document: dict[str, Any] = {
        'compensator': str(controller.get('compensator', 'proportional')),
        'rate_hz': rate_hz, 'reference_n': loop.reference_n, 'onset_gain': None,
        'onset_frequency_hz': None, 'onset_amplitude_n': None,
        'describing_function_onset_gain': _first(locus.gain, locus),
        'describing_function_onset_frequency_hz': _first(locus.frequency_hz, locus),
        'linear_limit_gain': None, 'largest_frequency_error': None,
        'largest_amplitude_error': None}
    document['one_harmonic'] = [
        {'nonlinearity': name, 'onset_gain': first[0] / unit if first else None,
         'onset_frequency_hz': first[1] if first else None}
        for name, first in each_alone(loop).items()]
    limit = linear_limit(loop)
    if limit:
        document['linear_limit_gain'] = limit[0] / unit
    if points:
        gain, frequency, amplitude = hb.fold(points)
        document |= {'onset_gain': gain, 'onset_frequency_hz': frequency,
                     'onset_amplitude_n': amplitude}
        cycles += _compared(actuator, controller, rate_hz, points, report, document)
    onsets = onset_by_step(actuator, controller, rate_hz, first_gain, steps_n, report)
    return document | {'cycles': cycles, 'onset_by_step': onsets}


def _first(values: np.ndarray, locus: Locus) -> float | None:
    return float(values[int(np.argmin(locus.gain))]) if len(values) else None


def _cycle(gain: float, frequency: float, amplitude: float, stable: bool, method: str,
           **more: float | None) -> dict[str, Any]:
    return {'gain': float(gain), 'frequency_hz': float(frequency),
            'amplitude_n': float(amplitude), 'stable': stable, 'method': method,
            'thd': None, 'second_multiplier': None, **more}


def _from_locus(locus: Locus, points: list[hb.Balance]) -> list[dict[str, Any]]:
    """Return the paper's prediction at the gains of its locus up to where the balance goes."""
    most = 1.2 * max([point.gain for point in points] or [2.0 * locus.gain.min(initial=np.inf)])
    return [_cycle(g, f, a, bool(s), 'describing_function') for g, f, a, s in zip(
        locus.gain, locus.frequency_hz, locus.amplitude_n, locus.stable, strict=True)
        if g <= most]


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
        simulated = simulated_onset(actuator, settings, rate_hz, first_gain)
        if simulated:
            row |= {'simulated_gain': simulated[0], 'simulated_frequency_hz': simulated[1]}
            points = branch(actuator, settings, rate_hz, 1.02 * simulated[0], onset_only=True)
            if points:
                gain, frequency, _ = hb.fold(points)
                row |= {'predicted_gain': gain, 'predicted_frequency_hz': frequency}
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
                               point.amplitude_n / swing.amplitude - 1.0))
                cycles.append(_cycle(point.gain, swing.frequency_hz, swing.amplitude, True,
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
