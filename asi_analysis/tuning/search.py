"""
Search of the settings of the controller: the figures of `figures.py`, under attack.

The structure is declared: two leads without their lag, and all additions. The strategy is CMA-ES
(Hansen, The CMA Evolution Strategy: A Tutorial, 2016). The cost is the distance of the figures
from their goals, of the steps and sines also at the lower control rates, and the oscillation that
remains under the worst conditions known, each made worse by a margin. The strategy follows a
smoother cost, whose settling times and steady-state errors do not jump (`distances`). First the
loop is searched, then the reference model outside of it. The conditions are found by the attack of
`asi quench`, which is repeated on the best settings during the search.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Final, NamedTuple

import cma
import numpy as np
from scipy import signal

from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_analysis.arrays import Array
from asi_analysis.limit_cycle.quench.attack import EXCITED_S, FREE_S, Condition, search
from asi_analysis.loop.closed_loop import Values, close_many, loops_of
from asi_analysis.terminal import Progress, silent
from asi_analysis.tuning.figures import (
    ROWS,
    figures,
    held,
    held_figures,
    late_errors,
    missed,
    responses,
)
from asi_common.parameter import Value, defaults
from asi_controller.parameters import COMPENSATOR_PARAMETERS

STRUCTURE: Final[Mapping[str, Value]] = {'compensator': 'lead2', 'lead2.lag_ratio': 1.0}
# Least, first and largest value, on a logarithmic scale.
RANGES: Final[Mapping[str, tuple[float, float, float]]] = {
    'gain': (0.2, 1.8, 6.0),
    'lead2.ratio': (1.0, 6.5, 8.0),
    'lead2.zero_frequency': (20.0, 85.0, 300.0),
    'integrator.rate': (5.0, 60.0, 400.0),
    'hysteresis_inverse.size': (5.0, 25.0, 30.0),
    'hysteresis_inverse.dead_zone': (2.0, 4.0, 60.0),
    'reference_model.bandwidth': (60.0, 180.0, 1000.0),
    'reference_model.lag_frequency': (12.0, 17.0, 26.0),
    'reference_model.drive': (900.0, 1600.0, 2500.0),
    'reference_model.delay': (0.0004, 0.0025, 0.006),
    'reference_model.lead_time': (0.0003, 0.001, 0.006),
    'reference_model.slope': (5e3, 2e4, 6e4),
    'gain_schedule.velocity': (0.05, 0.1, 1.0),
    'gain_schedule.least': (0.05, 0.2, 0.8),
    'velocity_feedforward.share': (0.05, 0.35, 1.0),
    'velocity_feedforward.lead_time': (0.001, 0.015, 0.05),
    'saturation': (1200.0, 1400.0, 4000.0),
    'feedforward': (0.9, 0.97, 1.1),
}
# The reference model is outside the loop: it changes the steps and sines, which cost little.
REFERENCE: Final = ('feedforward', *(name for name in RANGES
                                     if name.startswith('reference_model.')))
POPULATION: Final = 14
SPREAD: Final = 0.03
RATES_HZ: Final = (5000.0, 2000.0, 1000.0)
# The margin: factor of the loop gain, and addition to the delay (s), in each condition.
MARGIN: Final = (1.1, 1e-4)
# Largest remaining amplitude (N, rms) that is no oscillation; length (s) of the last two windows
# in which it is measured; least fall of its logarithm from one to the other for a decay.
REMAINING_N: Final = 0.2
WATCHED_S: Final = 0.12
FALL: Final = 0.2
# The attacks during the search: conditions tried, how many of the worst are kept, and generations
# from one attack to the next.
ATTACKED: Final = 160
KEPT: Final = 8
GENERATIONS: Final = 12
# Factors of the settings that make the loop oscillate: to find the first conditions.
AGGRESSIVE: Final[Sequence[Mapping[str, float]]] = (
    {'integrator.rate': 2.5, 'gain': 1.3}, {'gain': 2.5},
    {'velocity_feedforward.share': 2.0, 'integrator.rate': 1.5})
# Cost per logarithm of a figure that misses its goal, of one that reaches it (down to
# MOST_REACHED), and of the remaining oscillations; cost of a point outside the ranges.
MISSED: Final = 1.0
REACHED: Final = 0.03
MOST_REACHED: Final = -1.0
OSCILLATES: Final = 0.5
OUTSIDE: Final = 100.0
# Weight of the steps and sines at each of the lower control rates.
LOWER_RATES: Final = 0.3
# Steady-state error (N) that counts as much as a factor e of another figure, in the smooth cost.
ERROR_SCALE: Final = 1.0
# Significant digits of a setting.
DIGITS: Final = 4


class Candidate(NamedTuple):
    """
    Settings with their cost, figures, and remaining amplitude (sum of logarithms).

    smooth_cost: that which the strategy follows.
    """

    cost: float
    controller: Mapping[str, Value]
    figures: Mapping[str, float]
    remaining_amplitude: float
    smooth_cost: float = 0.0


def settings(point: Array) -> dict[str, Value]:
    """Return the controller's parameters of a point in the unit cube, rounded."""
    inside = np.clip(point, 0.0, 1.0)
    return {**STRUCTURE, **{name: float(f'{low * (high / low) ** float(x):.{DIGITS}g}')
                            for (name, (low, _, high)), x
                            in zip(RANGES.items(), inside, strict=True)}}


def first_point(start: Values) -> Array:
    """Return the point of parameters, of RANGES where one is missing."""
    values = {name: float(start.get(name, first)) for name, (_, first, _) in RANGES.items()}
    return np.clip([math.log(max(values[name], low) / low) / math.log(high / low)
                    for name, (low, _, high) in RANGES.items()], 0.0, 1.0)


def attacked_rates(rate_hz: float) -> tuple[float, ...]:
    """Return the control rates (Hz) of the attack: that one, and the lower ones of RATES_HZ."""
    return (rate_hz, *(each for each in RATES_HZ if each < rate_hz))


def remaining_amplitude(conditions: Sequence[Condition], actuator: Values, controller: Values,
                        rates_hz: tuple[float, ...]) -> float:
    """Return the sum of log(amplitude / REMAINING_N) of the oscillations that do not decay."""
    gain, delay = MARGIN
    table = defaults(ACTUATOR_PARAMETERS)
    total = 0.0
    every = [condition.settings(rates_hz, actuator) for condition in conditions]
    for rate in {each['rate_hz'] for each in every}:
        chosen = [each for each in every if each['rate_hz'] == rate]
        actuators = [{**table, **actuator, **each['actuator']} for each in chosen]
        for values in actuators:
            values['valve_characteristic.gain'] *= gain
            values['force_sensor.delay'] += delay
        forces = close_many(loops_of(actuators, [{**controller, **each['reference']}
                                                 for each in chosen], rate),
                            EXCITED_S + FREE_S, 2.0 * WATCHED_S)[:, 2]
        forces = np.nan_to_num(np.clip(forces, -1e6, 1e6), nan=1e6)
        # Without its trend, since a slow creep is no oscillation.
        first, last = (signal.detrend(part).std(axis=1) for part in np.split(
            forces[:, :2 * (forces.shape[1] // 2)], 2, axis=1))
        lasts = np.clip(1.0 + np.log(np.maximum(last, 1e-9) / np.maximum(first, 1e-9)) / FALL,
                        0.0, 1.0)
        total += float((np.log(np.maximum(last / REMAINING_N, 1.0)) * lasts).sum())
    return total


def _sum(misses: Mapping[str, float]) -> float:
    return sum(MISSED * max(miss, 0.0) + REACHED * min(max(miss, MOST_REACHED), 0.0)
               for miss in misses.values())


def distances(found: Mapping[str, float], steps: Array, goals: Mapping[str, float],
              rate_hz: float) -> tuple[float, float]:
    """
    Return the distance of figures from their goals, and one that a search can follow.

    steps: those of `held`. Settling times jump where a ripple leaves the 2 %, and the steady-state
    error, of tenths of a newton, depends on where the play stops: the second distance takes the
    error after the time to reach, and the steady-state error in newtons, not as a logarithm.
    """
    reach = {row.name: goals.get(row.name, row.goal) for row in ROWS}
    misses = missed(found, goals)
    late = [late_errors(steps, rate_hz, reach[name])
            for name in ('settling_median_s', 'settling_worst_s')]
    error = 'steady_state_error_n'
    return _sum(misses), _sum({**misses, 'settling_median_s': float(np.median(late[0])),
                               'settling_worst_s': max(late[1]),
                               error: (found[error] - reach[error]) / ERROR_SCALE})


def tune(actuator: Values, start: Values, goals: Mapping[str, float], evaluations: int, seed: int,
         rate_hz: float = 5000.0, report: Progress = silent) -> tuple[Candidate, list[Candidate]]:
    """
    Return the best settings found, and those whose whole figures were tried.

    start: parameters of the controller to begin with; goals: values to reach by name, where they
    are not those of ROWS. rate_hz: control rate of the figures; the attack also tries the lower
    ones of RATES_HZ. A third of the evaluations searches the loop, the rest the reference model.
    """
    rates = attacked_rates(rate_hz)
    conditions: list[Condition] = []

    def attacked(controller: Values, number: int) -> None:
        found = search(actuator, controller, rates, ATTACKED, seed + number)
        conditions.extend(trial.condition for trial in found[:KEPT])

    def candidate(point: Array) -> Candidate:
        controller = settings(point)
        runs = responses(actuator, controller, rate_hz)
        found = figures(actuator, controller, rate_hz, runs)
        costs = (np.array(distances(found, runs.steps, goals, rate_hz))
                 + _held_costs(actuator, controller, goals, rates[1:], rate_hz)
                 + _outside(point))
        oscillation = remaining_amplitude(conditions, actuator, controller, rates)
        costs += OSCILLATES * oscillation
        return Candidate(float(costs[0]), controller, found, oscillation, float(costs[1]))

    def followed(point: Array) -> Candidate:
        controller = settings(point)
        costs = _held_costs(actuator, controller, goals, rates, rate_hz) + _outside(point)
        return Candidate(float(costs[0]), controller, {}, 0.0, float(costs[1]))

    report('first conditions', 0.0)
    highest = {each.name: each.high for each in COMPENSATOR_PARAMETERS}
    first = settings(first_point(start))
    for number, factors in enumerate(AGGRESSIVE):
        attacked({**first, **{name: min(float(first[name]) * factor, highest[name])
                              for name, factor in factors.items()}}, number)
    best = candidate(first_point(start))
    tried: list[Candidate] = []
    loop = math.ceil(evaluations / 3)
    for number, found in enumerate(_generations(
            candidate, best, [name for name in RANGES if name not in REFERENCE], loop, seed), 1):
        tried += found
        best = min([best, *found], key=_cost)
        report(f'loop, cost {best.cost:.3g}', len(tried) / evaluations)
        if number % GENERATIONS == 0:
            attacked(best.controller, number)
            best = candidate(first_point(best.controller))
    shaped, done = followed(first_point(best.controller)), loop
    for found in _generations(followed, shaped, REFERENCE, evaluations - loop, seed):
        shaped, done = min([shaped, *found], key=_cost), done + len(found)
        report(f'reference model, cost {shaped.cost:.3g}', min(done / evaluations, 1.0))
    return min([best, candidate(first_point(shaped.controller))], key=_cost), tried


def _cost(one: Candidate) -> float:
    return one.cost


def _outside(point: Array) -> float:
    return OUTSIDE * float(np.sum((point - np.clip(point, 0.0, 1.0)) ** 2))


def _held_costs(actuator: Values, controller: Values, goals: Mapping[str, float],
                rates_hz: Sequence[float], first_hz: float) -> Array:
    """Return the distances of steps and sines at some control rates; that of `first_hz` whole."""
    total = np.zeros(2)
    for rate in rates_hz:
        steps, sines = held({**actuator, 'load.type': 'locked'}, controller, rate)
        weight = 1.0 if rate == first_hz else LOWER_RATES
        total += weight * np.array(distances(
            held_figures(steps, sines, rate), steps, goals, rate))
    return total


def _generations(evaluated: Callable[[Array], Candidate], start: Candidate, names: Sequence[str],
                 evaluations: int, seed: int) -> Iterator[list[Candidate]]:
    """Yield generations of a search over some of RANGES, the others as in `start`."""
    begin = first_point(start.controller)
    chosen = [list(RANGES).index(name) for name in names]
    strategy = cma.CMAEvolutionStrategy(
        begin[chosen], SPREAD, {'seed': seed, 'popsize': POPULATION, 'verbose': -9})
    for _ in range(math.ceil(evaluations / POPULATION)):
        points = strategy.ask()
        whole = [begin.copy() for _ in points]
        for point, part in zip(whole, points, strict=True):
            point[chosen] = part
        found = [evaluated(point) for point in whole]
        strategy.tell(points, [each.smooth_cost for each in found])
        yield found


def front(tried: Sequence[Candidate], names: Sequence[str]) -> list[Candidate]:
    """Return those quiet under attack that no other one beats in all the figures of `names`."""
    quiet = [each for each in tried if each.remaining_amplitude == 0.0]
    values = np.array([[each.figures[name] for name in names] for each in quiet])
    return [each for each, row in zip(quiet, values, strict=True)
            if not ((values <= row).all(1) & (values < row).any(1)).any()]
