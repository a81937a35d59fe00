"""
`asi calibrate`: the parameters that bring the simulator closest to the published facts.

What may vary is FREE; what is aimed at are the rows of `facts.table` with the role 'fitted'. A row
costs nothing inside the inner part of its limits, so that no row is bettered at the expense of
another that is met; outside, the cost grows like a pseudo-Huber loss, so that a row that cannot be
met does not bend all the others. A waveform with a spike, a dip or a creep pays as well as a row
that is missed. First CMA-ES (Hansen, "The CMA evolution strategy: a tutorial", 2016) over the
whole box, each candidate given up as soon as it costs more than the better half of the last
generation; then damped least squares from its best.
"""

import json
import math
import multiprocessing
import pickle
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from asi_actuator.parameters import ACTUATOR_PARAMETERS, Value, completed, defaults
from asi_analysis.errors import InputError
from asi_analysis.facts import measures
from asi_analysis.facts.bench import Values, in_process
from asi_analysis.facts.conditions import Conditions, StepTest
from asi_analysis.facts.measures import Measured
from asi_analysis.facts.table import FACTS, FITTED, Fact, closed_loop_groups
from asi_controller.compensator import OWN_GAIN
from asi_controller.parameters import COMPENSATOR_PARAMETERS

Array = npt.NDArray[np.float64]
Report = Callable[[str, float | None], None]


class Free(NamedTuple):
    """A free quantity: a parameter of the actuator, or 'conditions.TEST.NAME' of Table 1."""

    name: str
    low: float
    high: float
    logarithmic: bool = True


FREE: Final = (
    Free('valve_flexure.coil_frequency', 14.0, 40.0),
    Free('valve_flexure.natural_frequency', 250.0, 2000.0),
    Free('valve_flexure.damping_ratio', 0.2, 2.0, False),
    Free('valve_flexure.delay', 1e-4, 2.5e-3),
    Free('force_sensor.natural_frequency', 300.0, 2000.0),
    Free('force_sensor.card_frequency', 300.0, 4000.0),
    Free('force_sensor.delay', 1e-4, 1.5e-3),
    Free('valve_hysteresis.radius', 8.0, 30.0, False),
    Free('valve_hysteresis.lag_time', 2e-4, 4e-3),
    Free('valve_hysteresis.rate_exponent', 0.0, 0.8, False),
    Free('valve_hysteresis.rate_filter', 60.0, 4000.0),
    Free('valve_hysteresis.saturation', 1100.0, 5000.0),
    Free('hydraulic_damping.centre_share', 0.02, 1.0),
    Free('hydraulic_damping.saturation_velocity', 0.02, 0.8),
    Free('hydraulic_damping.saturation_shift', -0.3, 0.7, False),
    Free('hydraulic_damping.saturation_narrowing', -0.7, 0.5, False),
    Free('hydraulic_damping.velocity_width', 0.015, 0.4),
    Free('hydraulic_damping.width_growth', 0.0, 2.0, False),
    Free('hydraulic_damping.viscous', 20.0, 1500.0),
    Free('friction.presliding_stiffness', 3e4, 5e5),
    Free('friction.presliding_damping', 10.0, 300.0),
    Free('load.mass', 0.2, 4.0),
    Free('load.locked_stiffness', 2e5, 2e7),
    Free('load.locked_damping', 10.0, 1500.0),
    Free('conditions.proportional.amplitude_n', 150.0, 830.0),
    Free('conditions.proportional.load.mass', 0.2, 0.6),
    Free('conditions.proportional.load.stiffness', 8e3, 5e5),
    Free('conditions.proportional.load.damping', 1.0, 1500.0),
    Free('conditions.lead_lag.gain', 3.0, 45.0),
    Free('conditions.lead_lag.lead_lag.centre_frequency', 60.0, 100.0, False),
    Free('conditions.lead_lag.amplitude_n', 50.0, 700.0),
    Free('conditions.lead4.gain', 0.5, 30.0),
    Free('conditions.lead4.lead4.zero_frequency', 80.0, 500.0),
    Free('conditions.lead4.lead4.ratio', 1.5, 14.0),
    Free('conditions.lead4.lead4.lag_ratio', 2.0, 200.0),
    Free('conditions.lead4.amplitude_n', 50.0, 700.0),
)
# For the search only: coarse, as long as every row moves by less than a tenth of its limits.
SEARCH: Final = {'maximum_substep': 1e-4}
SEARCH_STEPS_N: Final = (0.0, 100.0, 300.0, 600.0)
SEARCH_ACCURACY: Final = 0.004
# Share of a row's half width, from the middle, that costs nothing.
INNER: Final = 0.8
# Cost of a row that does not exist: the force does not settle, there is no cycle.
WORST: Final = 4.0
# Cost of a waveform that is not one rise.
WRONG_SHAPE: Final = 1.5
POPULATION: Final = 24
POLISH_STEP: Final = 0.02
MOST_REJECTED: Final = 6


class Candidate(NamedTuple):
    """A point of the search as what it stands for."""

    actuator: Values
    conditions: Conditions


def decode(point: Array) -> dict[str, float]:
    """Return the quantities that belong to a point of the unit cube."""
    found = {}
    for free, share in zip(FREE, np.clip(point, 0.0, 1.0), strict=True):
        found[free.name] = float(free.low * (free.high / free.low) ** share if free.logarithmic
                                 else free.low + (free.high - free.low) * share)
    return found


def encode(quantities: Mapping[str, float]) -> Array:
    """Return the point of the unit cube that belongs to quantities, limited to the cube."""
    return np.clip([
        math.log(quantities[free.name] / free.low) / math.log(free.high / free.low)
        if free.logarithmic else (quantities[free.name] - free.low) / (free.high - free.low)
        for free in FREE], 0.0, 1.0)


def candidate(quantities: Mapping[str, float], fixed: Values, base: Conditions) -> Candidate:
    """Return actuator and conditions: those of `fixed` and `base`, changed by `quantities`."""
    actuator: dict[str, Value] = dict(fixed)
    tests: dict[str, StepTest] = {
        name: getattr(base, name) for name in ('proportional', 'lead_lag', 'lead4')}
    for name, value in quantities.items():
        kind, _, rest = name.partition('.')
        if kind != 'conditions':
            actuator[name] = value
            continue
        which, _, parameter = rest.partition('.')
        test = tests[which]
        if parameter == 'amplitude_n':
            tests[which] = test._replace(amplitude_n=value)
        elif parameter.startswith('load.'):
            tests[which] = test._replace(load={**test.load, parameter: value})
        else:
            tests[which] = test._replace(controller={**test.controller, parameter: value})
    return Candidate(actuator, base._replace(
        proportional=tests['proportional'], lead_lag=tests['lead_lag'], lead4=tests['lead4']))


def one_sided(fact: Fact) -> bool:
    """Return whether a fact only has a limit: at least, or at most from a published 0."""
    return math.isinf(fact.high) or fact.low == 0.0


def position(fact: Fact, value: float) -> float:
    """
    Return where a value is: beyond -1 to 1 it misses the fact; above 1 if the limit is one-sided.

    In half widths of the limits from their middle; of a single limit, in fifths of it (as it is,
    if it is 0), 1 at the limit.
    """
    if not one_sided(fact):
        return (value - 0.5 * (fact.low + fact.high)) / (0.5 * (fact.high - fact.low))
    limit = fact.low if math.isinf(fact.high) else fact.high
    beyond = limit - value if math.isinf(fact.high) else value - limit
    return 1.0 + beyond / (0.2 * abs(limit) or 1.0)


def miss(fact: Fact, value: float) -> float:
    """Return how far a value is outside the inner part of a fact's limits, with its sign."""
    if fact.low == fact.high:
        return 0.0 if value == fact.low else WRONG_SHAPE
    if not math.isfinite(value):
        return WORST
    where = position(fact, value)
    size = where if one_sided(fact) else abs(where)
    return math.copysign(WORST * math.tanh(max(0.0, size - INNER) / WORST), where)


AIMS: Final = tuple(fact for fact in FACTS if fact.role == FITTED)


def cost(misses: Iterable[float]) -> float:
    """Return the pseudo-Huber cost of misses."""
    return float(sum(2.0 * (math.sqrt(1.0 + m * m) - 1.0) for m in misses))


def misses(measured: Measured) -> list[float]:
    """Return the misses of the rows that have been measured so far."""
    return [miss(fact, measured[fact.value]) for fact in AIMS if fact.value in measured]


def evaluate(one: Candidate, give_up: float = math.inf) -> tuple[float, Measured]:
    """
    Return the cost of a candidate and what was measured, the cheapest measurements first.

    give_up: a candidate that costs more is not measured further; its cost is then what it has
    cost so far and the cost of a just missed row for each that is left.
    """
    actuator = one.actuator
    conditions = one.conditions._replace(onset_steps_n=SEARCH_STEPS_N,
                                         onset_accuracy=SEARCH_ACCURACY)
    measured: Measured = {}

    def gain() -> float:
        return measured[measures.onset_name(conditions.cycle_step_n, 'gain')]

    runs = closed_loop_groups(actuator, conditions, measured, in_process)
    groups: tuple[Callable[[], Measured], ...] = (
        lambda: measures.describing(actuator),
        lambda: measures.damping_exponent(actuator),
        runs['Table 1'],
        lambda: measures.bandwidths(actuator, conditions),
        lambda: measures.error_within_loop(actuator, conditions),
        lambda: measures.onsets(actuator, conditions),
        runs['frequency at the onset'],
        runs['the cycle'],
        lambda: {'linear_onset_ratio': measures.free_onset(
            actuator, conditions, measures.HYSTERESIS_AS_GAIN, gain(), 2.5, 0.03)},
        lambda: measures.prediction_error(actuator, conditions, gain()),
    )
    for group in groups:
        measured.update(group())
        so_far = misses(measured)
        if cost(so_far) > give_up:
            return cost(so_far) + (len(AIMS) - len(so_far)) * cost([1.0]), measured
    return cost(misses(measured)), measured


class Problem(NamedTuple):
    """What a search works on: fixed parameters and conditions, and the quantities left free."""

    fixed: Values
    conditions: Conditions
    free: tuple[int, ...]     # numbers of the quantities of FREE that vary
    start: Array              # a point of the whole cube

    def whole(self, point: Array) -> Array:
        """Return the point of the whole cube that a point of the free quantities stands for."""
        full = self.start.copy()
        full[list(self.free)] = np.clip(point, 0.0, 1.0)
        return full

    def measure(self, point: Array, give_up: float = math.inf) -> tuple[float, Measured]:
        """Return cost (with one for leaving the cube) and measured values of a point."""
        outside = float(np.sum((point - np.clip(point, 0.0, 1.0))**2))
        found, measured = evaluate(
            candidate(decode(self.whole(point)), self.fixed, self.conditions), give_up)
        return found + 10.0 * outside, measured


class Search:
    """
    A search that can be stopped and gone on with: the same seed gives the same points.

    problem: what is searched; seed: of CMA-ES; spread: its first standard deviation, as a share
    of the cube.
    """

    def __init__(self, problem: Problem, seed: int, spread: float) -> None:
        import cma
        self.problem = problem
        self.evaluations = 0
        self.best_cost = math.inf
        self.best = problem.start[list(problem.free)]
        self.give_up = math.inf
        self.strategy = cma.CMAEvolutionStrategy(
            self.best, spread, {'seed': seed, 'popsize': POPULATION, 'verbose': -9,
                                'maxfevals': math.inf})

    def generation(self, apply: Callable[..., Any] = map) -> None:
        """Try one generation; `apply` maps a function over the candidates, in order."""
        points = self.strategy.ask()
        found = list(apply(_measure_one, [(self.problem, np.asarray(point), self.give_up)
                                          for point in points]))
        self.strategy.tell(points, found)
        self._keep(points, found)
        self.give_up = sorted(found)[len(found) // 2] + 0.3

    def _keep(self, points: Sequence[Array], found: Sequence[float]) -> None:
        self.evaluations += len(points)
        least = int(np.argmin(found))
        if found[least] < self.best_cost:
            self.best_cost, self.best = found[least], np.clip(points[least], 0.0, 1.0)

    def polish(self, rounds: int, apply: Callable[..., Any] = map,
               report: Report = lambda text, share: None) -> None:
        """Go on from the best point by damped least squares (Levenberg and Marquardt)."""
        point, damping = self.best.copy(), 0.05
        left = self._misses([point], apply)[0]
        for done in range(rounds):
            report(f'polishing, cost {self.best_cost:.3f}', done / rounds)
            steps = np.where(point < 0.5, POLISH_STEP, -POLISH_STEP)
            tried = self._misses([point + step * unit for step, unit in
                                  zip(steps, np.eye(point.size), strict=True)], apply)
            slopes = (np.array(tried) - left).T / steps
            weights = 1.0 / np.sqrt(1.0 + left**2)
            normal, pull = (slopes.T * weights) @ slopes, (slopes.T * weights) @ left
            for _ in range(MOST_REJECTED):
                move = -np.linalg.solve(normal + damping * np.eye(point.size), pull)
                after = np.clip(point + np.clip(move, -0.2, 0.2), 0.0, 1.0)
                missed = self._misses([after], apply)[0]
                if cost(missed) < cost(left):
                    point, left, damping = after, missed, max(damping / 3.0, 1e-3)
                    break
                damping *= 4.0
            else:
                # No step helps: a side step of the slopes may still have found a better point.
                if np.array_equal(self.best, point):
                    return
                point = self.best.copy()
                left = self._misses([point], apply)[0]

    def _misses(self, points: Sequence[Array], apply: Callable[..., Any]) -> list[Array]:
        inside = [np.clip(point, 0.0, 1.0) for point in points]
        found = list(apply(_misses_one, [(self.problem, point) for point in inside]))
        self._keep(inside, [cost(missed) for missed in found])
        return found

    def save(self, path: Path) -> None:
        """Write the state; a crash while writing leaves the last one."""
        part = path.with_suffix('.part')
        part.write_bytes(pickle.dumps(self))
        part.replace(path)


def _measure_one(job: tuple[Problem, Array, float]) -> float:
    problem, point, give_up = job
    return problem.measure(point, give_up)[0]


def _misses_one(job: tuple[Problem, Array]) -> Array:
    problem, point = job
    return np.array(misses(problem.measure(point)[1]))


def load(path: Path) -> Search:
    """Return a search that was saved. Raises InputError if there is none in the file."""
    try:
        found = pickle.loads(path.read_bytes())
    except (OSError, pickle.UnpicklingError, EOFError, AttributeError) as error:
        raise InputError(f'{path} holds no state of a calibration: {error}') from None
    if not isinstance(found, Search):
        raise InputError(f'{path} holds no state of a calibration')
    return found


def new_search(start: Mapping[str, float], fixed: Values, conditions: Conditions, seed: int,
               spread: float, only: Sequence[str] = ()) -> Search:
    """
    Return a search from a start.

    start: quantities by name, all of FREE; only: the names that are to vary (all if empty).
    Raises InputError for a name that FREE does not hold.
    """
    names = [free.name for free in FREE]
    for name in only:
        if name not in names:
            raise InputError(f'{name} is not free; there are {", ".join(names)}')
    free = tuple(k for k, name in enumerate(names) if not only or name in only)
    return Search(Problem({**fixed, **SEARCH}, conditions, free, encode(start)), seed, spread)


def calibrate(search: Search, evaluations: int, rounds: int, state: Path, jobs: int = 1,
              report: Report = lambda text, share: None) -> Search:
    """
    Search until so many evaluations have been made, then polish; the state is kept in a file.

    jobs: processes; the result does not depend on it.
    """
    with multiprocessing.get_context('spawn').Pool(jobs) as pool:
        apply = pool.map if jobs > 1 else map
        while search.evaluations < evaluations and not search.strategy.stop():
            search.generation(apply)
            search.save(state)
            report(f'{search.evaluations} evaluations, cost {search.best_cost:.3f}',
                   search.evaluations / evaluations)
        if rounds:
            search.polish(rounds, apply, report)
        search.save(state)
    return search


def result(search: Search) -> Candidate:
    """Return the best candidate, without what only the search needs."""
    fixed = {name: value for name, value in search.problem.fixed.items() if name not in SEARCH}
    return candidate(decode(search.problem.whole(search.best)), fixed, search.problem.conditions)


TESTS: Final = ('proportional', 'lead_lag', 'lead4')


def write_best(one: Candidate, path: Path) -> None:
    """Write a candidate as JSON: parameters of the actuator, and the tests of Table 1."""
    tests = {name: getattr(one.conditions, name)._asdict() for name in TESTS}
    path.write_text(json.dumps({'actuator': one.actuator, 'table_1': tests}, indent=2) + '\n')


def read_best(path: Path) -> Candidate:
    """Return a candidate that `write_best` wrote. Raises InputError if the file holds none."""
    try:
        document = json.loads(path.read_text())
        tests = {name: StepTest(**document['table_1'][name]) for name in TESTS}
        return Candidate(document['actuator'], Conditions(
            proportional=tests['proportional'], lead_lag=tests['lead_lag'],
            lead4=tests['lead4']))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f'{path} holds no result of a calibration: {error}') from None


def quantities(one: Candidate) -> dict[str, float]:
    """Return the quantities of FREE that belong to a candidate, by name."""
    actuator = completed(one.actuator, ACTUATOR_PARAMETERS)
    controller = defaults(COMPENSATOR_PARAMETERS)
    found = {}
    for free in FREE:
        kind, _, rest = free.name.partition('.')
        if kind != 'conditions':
            found[free.name] = float(actuator[free.name])
            continue
        which, _, parameter = rest.partition('.')
        test: StepTest = getattr(one.conditions, which)
        own = {**actuator, **controller, 'gain': OWN_GAIN[which], **test.controller, **test.load,
               'amplitude_n': test.amplitude_n}
        found[free.name] = float(own[parameter])
    return found


def run(out: Path, evaluations: int, rounds: int, seed: int, spread: float, start: Path | None,
        only: Sequence[str], jobs: int, report: Report) -> dict[str, Any]:
    """
    Do what `asi calibrate` is asked to; return its document.

    Raises InputError for a start, a state or a name that is not there.
    """
    out.mkdir(parents=True, exist_ok=True)
    state = out / 'state.pickle'
    if state.exists():
        search = load(state)
    else:
        first = read_best(start) if start else Candidate({}, Conditions())
        search = new_search(quantities(first), first.actuator, first.conditions, seed, spread,
                            only)
    calibrate(search, evaluations, rounds, state, jobs, report)
    best = result(search)
    write_best(best, out / 'best.json')
    measured = search.problem.measure(search.best)[1]
    return {'evaluations': search.evaluations, 'cost': search.best_cost,
            'best': str(out / 'best.json'),
            'met': sum(fact.met(measured[fact.value]) for fact in AIMS), 'total': len(AIMS),
            'not_met': [fact.value for fact in AIMS if not fact.met(measured[fact.value])]}


def show(document: Mapping[str, Any]) -> None:
    """Print what came out."""
    print(f'{document["evaluations"]} evaluations, cost {document["cost"]:.4g}; '
          f'{document["met"]} of {document["total"]} rows that were aimed at are met')
    if document['not_met']:
        print('not met: ' + ', '.join(document['not_met']))
    print(f'best: {document["best"]}')
