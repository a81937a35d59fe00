"""
Ablation of the model: the loop with each nonlinearity alone, and with all but that one.

A nonlinearity that is removed is replaced by its gain for small motion; the limit of the command
stays. Shapley values divide the amplitude of the cycle among the nonlinearities: the contribution
of each, averaged over all orders in which they can be added (Shapley 1953). The share of the
hysteresis is divided among its parts by Owen values: the same average over the orders in which the
parts come one after the other (Owen, in: Mathematical Economics and Game Theory, 1977).
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations
from typing import Any, Final

from asi_actuator.model.hydraulic_damping import damping_curve, damping_force
from asi_actuator.parameters import as_record
from asi_analysis.experiments.experiment import stepping
from asi_analysis.limit_cycle.attribution.answer import Attribution
from asi_analysis.loop.onset import balanced_cycle, onset, with_gain
from asi_analysis.loop.simulation import Values, step_run, step_runs, sustained
from asi_analysis.measures.oscillation import Oscillation
from asi_analysis.terminal import Progress, silent

NONLINEARITIES: Final = ('valve_hysteresis', 'valve_characteristic', 'hydraulic_damping',
                         'friction')
HYSTERESIS, *OTHERS = NONLINEARITIES
# Parts of the hysteresis, each with the parameters that switch it off.
PARTS: Final[Mapping[str, Mapping[str, float]]] = {
    'static_loop': {'valve_hysteresis.radius': 0.0, 'valve_hysteresis.widening': 0.0},
    'rate': {'valve_hysteresis.lag_time': 0.0},
    'iron_saturation': {'valve_hysteresis.saturation': 1e6}}
# Default gain of the comparison, over the onset gain of the complete model.
ABOVE_ONSET: Final = 1.12
HARMONICS: Final = 7


def only(active: Sequence[str], actuator: Values) -> dict[str, Any]:
    """Return the actuator's parameters with the nonlinearities not in `active` made linear."""
    p = as_record(actuator)
    slope = damping_force(0.0, damping_curve(0.0, p), p)[1]
    # Seals that do not slide add little stiffness and no damping: friction needs no linear gain.
    return {**actuator, 'hydraulic_damping.linear_gain': float(slope),
            **{f'{name}.model': 'linear' for name in NONLINEARITIES if name not in active}}


def with_parts(active: Sequence[str], actuator: Values) -> dict[str, Any]:
    """Return the actuator's parameters without the parts of the hysteresis not in `active`."""
    return {**actuator, **{name: value for part, off in PARTS.items() if part not in active
                           for name, value in off.items()}}


def _subsets(names: Iterable[str]) -> list[tuple[str, ...]]:
    names = tuple(names)
    return [subset for size in range(len(names) + 1) for subset in combinations(names, size)]


def _all_subsets() -> list[tuple[str, ...]]:
    return _subsets(NONLINEARITIES)


def _weight(before: int, count: int) -> float:
    """Return the weight of a coalition of `before` of `count` players in Shapley's average."""
    return (math.factorial(before) * math.factorial(count - before - 1)
            / math.factorial(count))


def owen(amplitude: Mapping[tuple[tuple[str, ...], tuple[str, ...]], float]) -> dict[str, float]:
    """
    Return the Owen value of each part of the hysteresis: together, its Shapley value.

    amplitude: by the other nonlinearities and the parts that are active.
    """
    values = dict.fromkeys(PARTS, 0.0)
    for others in _subsets(OTHERS):
        outside = _weight(len(others), len(NONLINEARITIES))
        for parts in _subsets(PARTS):
            for name in PARTS:
                if name not in parts:
                    joined = tuple(each for each in PARTS if each in parts or each == name)
                    values[name] += outside * _weight(len(parts), len(PARTS)) * (
                        amplitude[others, joined] - amplitude[others, parts])
    return values


def shapley(amplitude: dict[tuple[str, ...], float]) -> dict[str, float]:
    """Return the Shapley value of each nonlinearity, from the amplitude of every subset."""
    count = len(NONLINEARITIES)
    values = dict.fromkeys(NONLINEARITIES, 0.0)
    for subset in _all_subsets():
        for name in NONLINEARITIES:
            if name in subset:
                continue
            joined = tuple(each for each in NONLINEARITIES if each in subset or each == name)
            values[name] += _weight(len(subset), count) * (amplitude[joined] - amplitude[subset])
    return values


def attribute_model(actuator: Values, controller: Values, rate_hz: float = 5000.0,
                    gain: float | None = None, progress: Progress = silent) -> Attribution:
    """
    Return what each nonlinearity of a model contributes to its limit cycle.

    The loop is simulated with each one alone and with all but that one; shares of the amplitude
    are Shapley values. actuator, controller: parameters by name, the rest at their defaults;
    rate_hz: control rate, Hz; gain: compensator gain at which the cycles are compared, by default
    a little above the onset.

    >>> import asi_analysis as asi
    >>> found = asi.attribute_model({}, {'reference.amplitude': 100.0})
    >>> [cause['nonlinearity'] for cause in found.causes if cause['necessary']]
    ['valve_hysteresis']
    """
    controller = stepping(actuator, controller, rate_hz)
    progress('onset', 0.0)
    first = onset(actuator, controller, rate_hz, 0.7 * gain if gain else 4.0)
    at = gain or (ABOVE_ONSET * first.gain if first else 0.0)
    whole = sustained(step_run(actuator, with_gain(controller, at), rate_hz)) if at else None
    document: dict[str, Any] = {
        'gain': at or None, 'rate_hz': rate_hz,
        'onset_gain': first.gain if first else None,
        'frequency_hz': whole.frequency_hz if whole else None,
        'amplitude_n': whole.amplitude_n if whole else None}
    if whole is None:
        return Attribution(document | {
            'causes': [], 'hysteresis_parts': [],
            'verdict': 'no cycle at this gain: nothing to attribute'})
    progress('shares', 0.1)
    subsets = _all_subsets()
    runs = step_runs([only(subset, actuator) for subset in subsets],
                     [with_gain(controller, at)] * len(subsets), rate_hz)
    cycles = dict(zip(subsets, map(sustained, runs), strict=True))
    amplitudes = {subset: cycle.amplitude_n if cycle else 0.0 for subset, cycle in cycles.items()}
    shares = shapley(amplitudes)
    total = sum(max(value, 0.0) for value in shares.values()) or 1.0
    causes = []
    for number, name in enumerate(NONLINEARITIES):
        progress(name.replace('_', ' '), 0.4 + 0.15 * number)
        others = tuple(each for each in NONLINEARITIES if each != name)
        causes.append({
            'nonlinearity': name, 'necessary': cycles[others] is None,
            'sufficient': cycles[(name,)] is not None,
            'share': shares[name] / amplitudes[NONLINEARITIES],
            'probability': max(shares[name], 0.0) / total,
            **_figures('alone', cycles[(name,)], only((name,), actuator), controller, rate_hz, at),
            **_figures('all_but', cycles[others], only(others, actuator), controller, rate_hz,
                       at)})
    linear = amplitudes[()] > 0.0
    progress('parts of the hysteresis', None)
    return Attribution(document | {
        'causes': causes,
        'hysteresis_parts': _parts(actuator, with_gain(controller, at), rate_hz, amplitudes),
        'verdict': _verdict(causes, linear, document)})


def _parts(actuator: Values, controller: Values, rate_hz: float,
           known: Mapping[tuple[str, ...], float]) -> list[dict[str, Any]]:
    """Return the share of each part of the hysteresis, and the cycle with it alone."""
    amplitudes: dict[tuple[tuple[str, ...], tuple[str, ...]], float] = {}
    some = [parts for parts in _subsets(PARTS) if 0 < len(parts) < len(PARTS)]
    for others in _subsets(OTHERS):
        # Without any part it is a gain.
        amplitudes[others, ()] = known[others]
        amplitudes[others, tuple(PARTS)] = known[HYSTERESIS, *others]
    tried = [(others, parts) for others in _subsets(OTHERS) for parts in some]
    runs = step_runs([with_parts(parts, only((HYSTERESIS, *others), actuator))
                      for others, parts in tried], [controller] * len(tried), rate_hz)
    cycles = dict(zip(tried, map(sustained, runs), strict=True))
    amplitudes |= {key: cycle.amplitude_n if cycle else 0.0 for key, cycle in cycles.items()}
    shares, found = owen(amplitudes), []
    for name in PARTS:
        alone = with_parts((name,), only((HYSTERESIS,), actuator))
        first = onset(alone, controller, rate_hz, 0.35 * float(controller['gain']), 0.01)
        cycle = cycles[(), (name,)]
        found.append({
            'part': name, 'share': shares[name] / known[NONLINEARITIES],
            'alone_frequency_hz': cycle.frequency_hz if cycle else None,
            'alone_amplitude_n': cycle.amplitude_n if cycle else None,
            'alone_onset_gain': first.gain if first else None,
            'alone_onset_frequency_hz': first.frequency_hz if first else None})
    return found


def _figures(prefix: str, cycle: Oscillation | None, actuator: Values, controller: Values,
             rate_hz: float, gain: float) -> dict[str, float | None]:
    """Return figures of the simulated cycle, that of harmonic balance, and the onset."""
    _, predicted = balanced_cycle(actuator, with_gain(controller, gain), rate_hz, HARMONICS) or (
        None, None)
    first = onset(actuator, controller, rate_hz, 0.35 * gain, 0.01)
    return {
        f'{prefix}_frequency_hz': cycle.frequency_hz if cycle else None,
        f'{prefix}_amplitude_n': cycle.amplitude_n if cycle else None,
        f'{prefix}_predicted_frequency_hz': predicted.frequency_hz if predicted else None,
        f'{prefix}_predicted_amplitude_n': predicted.amplitude_n if predicted else None,
        f'{prefix}_onset_gain': first.gain if first else None}


def _verdict(causes: list[dict[str, Any]], linear: bool, document: dict[str, Any]) -> str:
    where = (f'at gain {document["gain"]:.4g} ({document["frequency_hz"]:.4g} Hz, '
             f'{document["amplitude_n"]:.4g} N)')
    if linear:
        return (f'{where} the loop oscillates without any of the nonlinearities: a linear '
                'instability, bounded by the limit of the command; no nonlinearity causes it')
    both = [c for c in causes if c['necessary'] and c['sufficient']]
    needed = [c for c in causes if c['necessary']]
    if len(both) == 1 and len(needed) == 1:
        cause = both[0]
        without = cause['all_but_onset_gain']
        return (f'{_name(cause)} causes the cycle {where}: alone it produces one '
                f'({cause["alone_frequency_hz"]:.4g} Hz, {cause["alone_amplitude_n"]:.4g} N), '
                'without it there is none '
                + (f'below gain {without:.4g}' if without else 'at any gain tried')
                + f'; the others change its amplitude ({_others(causes, cause)})')
    if needed:
        return (f'{where} the cycle needs {" and ".join(_name(c) for c in needed)}; '
                + ('none of them is sufficient alone' if not both else
                   f'{" and ".join(_name(c) for c in both)} is sufficient alone'))
    sufficient = [c for c in causes if c['sufficient']]
    if sufficient:
        return (f'{where} no single nonlinearity is necessary: each of '
                f'{", ".join(_name(c) for c in sufficient)} is sufficient alone')
    return f'{where} no single nonlinearity is necessary, and none is sufficient alone'


def _name(cause: dict[str, Any]) -> str:
    return str(cause['nonlinearity']).replace('_', ' ')


def _others(causes: list[dict[str, Any]], cause: dict[str, Any]) -> str:
    return ', '.join(f'{_name(c)} {100 * c["share"]:+.0f} %' for c in causes if c is not cause)
