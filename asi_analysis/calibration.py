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
import pickle
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from asi_actuator.parameters import ACTUATOR_PARAMETERS, Value, completed, defaults
from asi_analysis.errors import InputError
from asi_analysis.facts import measures
from asi_analysis.facts.bench import Values
from asi_analysis.facts.conditions import Conditions, StepTest
from asi_analysis.facts.measures import Measured
from asi_analysis.facts.table import FACTS, FITTED, Fact
from asi_analysis.parallel import each
from asi_analysis.terminal import Progress, silent
from asi_controller.compensator import OWN_GAIN
from asi_controller.parameters import COMPENSATOR_PARAMETERS

Array = npt.NDArray[np.float64]


class Free(NamedTuple):
    """A free quantity: a parameter of the actuator, or 'conditions.TEST.NAME' of Table 1."""

    name: str
    low: float
    high: float
    logarithmic: bool = True


FREE: Final = (
    Free('valve_flexure.coil_frequency', 14.0, 40.0),
    Free('valve_flexure.natural_frequency', 150.0, 2500.0),
    Free('valve_flexure.damping_ratio', 0.2, 2.0, False),
    Free('valve_flexure.delay', 5e-5, 2.5e-3),
    Free('force_sensor.natural_frequency', 200.0, 2500.0),
    Free('force_sensor.card_frequency', 200.0, 5000.0),
    Free('force_sensor.delay', 5e-5, 1.5e-3),
    Free('force_sensor.mass_share', 0.0, 1.0, False),
    Free('valve_hysteresis.radius', 8.0, 30.0, False),
    Free('valve_hysteresis.lag_time', 2e-4, 4e-3),
    Free('valve_hysteresis.rate_exponent', 0.0, 1.0, False),
    Free('valve_hysteresis.rate_filter', 60.0, 10000.0),
    Free('valve_hysteresis.saturation', 900.0, 8000.0),
    Free('hydraulic_damping.centre_share', 0.02, 1.0),
    Free('hydraulic_damping.saturation_velocity', 0.01, 0.8),
    Free('hydraulic_damping.saturation_shift', -0.7, 0.7, False),
    Free('hydraulic_damping.saturation_narrowing', -0.7, 0.7, False),
    Free('hydraulic_damping.velocity_width', 0.01, 0.4),
    Free('hydraulic_damping.width_growth', 0.0, 3.0, False),
    Free('hydraulic_damping.viscous', 5.0, 5000.0),
    Free('friction.presliding_stiffness', 3e4, 2e6),
    Free('friction.presliding_damping', 5.0, 3000.0),
    Free('load.mass', 0.2, 5.0),
    Free('load.locked_stiffness', 1e5, 2e7),
    Free('load.locked_damping', 10.0, 10000.0),
    Free('conditions.proportional.amplitude_n', 100.0, 850.0),
    Free('conditions.proportional.load.mass', 0.2, 6.0),
    Free('conditions.proportional.load.stiffness', 4e3, 5e5),
    Free('conditions.proportional.load.damping', 1.0, 1500.0),
    Free('conditions.lead_lag.gain', 3.0, 45.0),
    Free('conditions.lead_lag.lead_lag.centre_frequency', 60.0, 100.0, False),
    Free('conditions.lead_lag.amplitude_n', 50.0, 750.0),
    Free('conditions.lead4.gain', 0.5, 30.0),
    Free('conditions.lead4.lead4.zero_frequency', 60.0, 800.0),
    Free('conditions.lead4.lead4.ratio', 1.2, 14.0),
    Free('conditions.lead4.lead4.lag_ratio', 1.5, 1000.0),
    Free('conditions.lead4.amplitude_n', 50.0, 750.0),
)
# For the search only: coarse, as long as every row moves by less than a tenth of its limits.
SEARCH: Final = {'maximum_substep': 1e-4}
SEARCH_STEPS_N: Final = (0.0, 100.0, 200.0, 300.0, 600.0)
SEARCH_ACCURACY: Final = 0.0015
# Share of a row's half width, from the middle, that costs nothing.
INNER: Final = 0.85
# Half widths beyond which a row only costs this share more: it shall not bend all the others.
FAR: Final = 1.0
FAR_SHARE: Final = 0.3
# Half widths of a row that does not exist: the force does not settle, there is no cycle.
WORST: Final = 9.0
# Cost of a waveform that is not one rise.
WRONG_SHAPE: Final = 1.5
# So many of the points of a generation are measured in each stage: a race.
RACE: Final = (64, 16, 8, 6, 4)
# Sorts a point that left the race behind every point that went on.
BEHIND: Final = 1e3
# Of the polish: first reach of a step, its limits, and the shares of it that are tried.
REACH: Final = 0.08
LEAST_REACH: Final = 0.003
MOST_REACH: Final = 0.25
SHARES: Final = (2.0, 1.0, 0.4, 0.15)
STEEPEST: Final = 80.0


class Structure(NamedTuple):
    """A structure of the model to search: what it says, and the quantities that it holds fixed."""

    words: str
    fixed: Mapping[str, float] = {}
    one_load: bool = False        # all three controllers of Table 1 on the load of the first


STRUCTURES: Final[Mapping[str, Structure]] = {
    'side': Structure('the sensor feels any share of the inertia of the mass'),
    'cylinder': Structure('the sensor between cylinder and piston: it feels all of the inertia',
                          {'force_sensor.mass_share': 0.0}),
    'one-load': Structure('as side, with one load for all of Table 1', one_load=True),
}
TESTS: Final = ('proportional', 'lead_lag', 'lead4')


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


def candidate(quantities: Mapping[str, float], fixed: Values, base: Conditions,
              one_load: bool = False) -> Candidate:
    """Return actuator and conditions: those of `fixed` and `base`, changed by `quantities`."""
    actuator: dict[str, Value] = dict(fixed)
    tests: dict[str, StepTest] = {name: getattr(base, name) for name in TESTS}
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
    if one_load:
        tests = {name: test._replace(load=tests['proportional'].load)
                 for name, test in tests.items()}
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
    """Return how far a value is outside the inner part of a fact's limits, in half widths."""
    if fact.low == fact.high:
        return 0.0 if value == fact.low else WRONG_SHAPE
    where = _bounded(fact, value)
    return max(0.0, (where if one_sided(fact) else abs(where)) - INNER)


def _bounded(fact: Fact, value: float) -> float:
    if not math.isfinite(value):
        return WORST
    return min(max(position(fact, value), -WORST), WORST)


AIMS: Final = tuple(fact for fact in FACTS if fact.role == FITTED)


def cost(misses: Iterable[float]) -> float:
    """Return the cost of misses."""
    return float(sum(min(m, FAR + FAR_SHARE * (m - FAR)) for m in misses))


def misses(measured: Measured) -> list[float]:
    """Return the misses of the rows that have been measured so far."""
    return [miss(fact, measured[fact.value]) for fact in AIMS if fact.value in measured]


def stages(one: Candidate, measured: Measured) -> Mapping[str, Callable[[], Measured]]:
    """Return the measurements of a search, in order: what costs least for what it tells first."""
    actuator = one.actuator
    conditions = one.conditions._replace(onset_steps_n=SEARCH_STEPS_N,
                                         onset_accuracy=SEARCH_ACCURACY)
    first = conditions._replace(onset_steps_n=(conditions.cycle_step_n,))
    name = measures.onset_name(conditions.cycle_step_n, 'gain')

    def steps() -> Measured:
        return {key: value for test in TESTS for key, value in measures.step_test(
            actuator, conditions, getattr(conditions, test), test).items()}

    def cycle() -> Measured:
        found = measures.onsets(actuator, first)
        gain = found[name]
        return {**found,
                **measures.high_gain_cycle(actuator, conditions, gain),
                'linear_onset_ratio': measures.free_onset(
                    actuator, conditions, measures.HYSTERESIS_AS_GAIN, gain, 2.5, 0.004),
                **measures.prediction_error(actuator, conditions, gain)}

    def all_onsets() -> Measured:
        gains = measures.onsets(actuator, conditions, {name: measured[name]})
        return {**gains, **measures.onset_rise(gains, conditions),
                **measures.onset_frequencies(actuator, conditions, gains)}

    return {
        'describing function, damping': lambda: {
            **measures.describing(actuator), **measures.damping_exponent(actuator)},
        'Table 1': steps,
        'cycle': cycle,
        'bandwidths, loop': lambda: {
            **measures.bandwidths(actuator, conditions),
            **measures.error_within_loop(actuator, conditions)},
        'onsets': all_onsets,
    }


class Problem(NamedTuple):
    """What a search works on: fixed parameters and conditions, and the quantities left free."""

    fixed: Values
    conditions: Conditions
    free: tuple[int, ...]     # numbers of the quantities of FREE that vary
    start: Array              # a point of the whole cube
    one_load: bool = False

    def whole(self, point: Array) -> Array:
        """Return the point of the whole cube that a point of the free quantities stands for."""
        full = self.start.copy()
        full[list(self.free)] = np.clip(point, 0.0, 1.0)
        return full

    def candidate(self, point: Array) -> Candidate:
        """Return what a point of the free quantities stands for."""
        return candidate(decode(self.whole(point)), self.fixed, self.conditions, self.one_load)

    def measure(self, point: Array) -> Measured:
        """Return all that the rows need."""
        measured: Measured = {}
        for stage in stages(self.candidate(point), measured).values():
            measured.update(stage())
        return measured


class Search:
    """
    A search that can be stopped and gone on with: the same seed gives the same points.

    problem: what is searched; seed: of CMA-ES; spread: its first standard deviation, as a share
    of the cube. `counts` says how many points have been measured in each stage of the race.
    """

    def __init__(self, problem: Problem, seed: int, spread: float) -> None:
        import cma
        self.problem = problem
        self.counts = [0] * len(RACE)
        self.polished = 0
        self.best_cost = math.inf
        self.best = problem.start[list(problem.free)]
        self.strategy = cma.CMAEvolutionStrategy(
            self.best, spread, {'seed': seed, 'popsize': RACE[0], 'verbose': -9,
                                'maxfevals': math.inf})

    @property
    def evaluations(self) -> int:
        """How many points the global search has tried."""
        return self.counts[0]

    def generation(self, apply: Callable[..., Any] = map) -> None:
        """Try one generation; `apply` maps a function over jobs, in order."""
        points = [np.asarray(point) for point in self.strategy.ask()]
        measured: list[Measured] = [{} for _ in points]
        ranks = np.empty(len(points))
        racing = list(range(len(points)))
        for stage, places in enumerate((*RACE[1:], 0)):
            found = apply(_measure_stage, [(self.problem, points[k], stage, measured[k])
                                           for k in racing])
            self.counts[stage] += len(racing)
            for k, new in zip(racing, found, strict=True):
                measured[k].update(new)
                ranks[k] = (cost(misses(measured[k])) + _outside(points[k])
                            + BEHIND * (len(RACE) - 1 - stage))
            racing = sorted(racing, key=lambda k: ranks[k])[:places]
        self.strategy.tell(points, ranks)
        self._keep(points[int(np.argmin(ranks))], float(ranks.min()))

    def _keep(self, point: Array, found: float) -> None:
        if found < self.best_cost:
            self.best_cost, self.best = found, np.clip(point, 0.0, 1.0)

    def polish(self, rounds: int, apply: Callable[..., Any] = map,
               report: Progress = silent) -> None:
        """
        Go on from the best point by successive linear programs.

        Each row is a straight line about the point, and the step within the reach with the least
        sum of misses is a linear program (Griffith and Stewart, Management Science 7, 1961): it
        sees the limits of the rows that are met as well, which least squares do not.
        """
        point, reach = self.best.copy(), REACH
        measured = self._measured([point], apply)[0]
        for done in range(rounds):
            now = cost(misses(measured))
            self._keep(point, now)
            report(f'polishing, cost {now:.3f}', done / rounds)
            if now == 0.0 or reach < LEAST_REACH:
                return
            slopes, side = self._slopes(point, measured, reach, done, apply)
            reaches = [min(share * reach, MOST_REACH) for share in SHARES]
            tried = [_step(point, _bounds(measured), slopes, each) for each in reaches]
            found = self._measured(tried, apply)
            costs = [cost(misses(each)) for each in found]
            k = int(np.argmin(costs))
            if costs[k] < min(now, side[0]):
                point, measured, reach = tried[k], found[k], reaches[k]
            elif side[0] < now:
                _, point, measured = side
                reach *= 0.6
            else:
                reach *= 0.35
        self._keep(point, cost(misses(measured)))

    def _slopes(self, point: Array, measured: Measured, reach: float, seed: int,
                apply: Callable[..., Any]) -> tuple[Array, tuple[float, Array, Measured]]:
        """Return the slopes of all rows (rows x quantities), and the best point on the way."""
        size = min(max(0.5 * reach, 0.004), 0.02)
        steps = np.where(np.random.default_rng(seed).random(point.size) < 0.5, size, -size)
        steps = np.where((point + steps < 0.0) | (point + steps > 1.0), -steps, steps)
        tried = [point + step * unit
                 for step, unit in zip(steps, np.eye(point.size), strict=True)]
        found = self._measured(tried, apply)
        here = _bounds(measured)
        slopes = np.array([(_bounds(each) - here) / step
                           for each, step in zip(found, steps, strict=True)]).T
        costs = [cost(misses(each)) for each in found]
        k = int(np.argmin(costs))
        return np.clip(slopes, -STEEPEST, STEEPEST), (costs[k], tried[k], found[k])

    def _measured(self, points: Sequence[Array], apply: Callable[..., Any]) -> list[Measured]:
        self.polished += len(points)
        return list(apply(_measure_whole, [(self.problem, point) for point in points]))

    def save(self, path: Path) -> None:
        """Write the state; a crash while writing leaves the last one."""
        part = path.with_suffix('.part')
        part.write_bytes(pickle.dumps(self))
        part.replace(path)


def _outside(point: Array) -> float:
    return 10.0 * float(np.sum((point - np.clip(point, 0.0, 1.0))**2))


LINES: Final = tuple(fact for fact in AIMS if fact.low != fact.high)
TWO_SIDED: Final = np.array([not one_sided(fact) for fact in LINES])


def _bounds(measured: Measured) -> Array:
    """Return where each row that has limits is, in half widths."""
    return np.array([_bounded(fact, measured[fact.value]) for fact in LINES])


def _step(point: Array, here: Array, slopes: Array, reach: float) -> Array:
    """Return the point within a reach with the least sum of misses, were all rows straight."""
    from scipy.optimize import linprog
    slack = -np.eye(here.size)
    # A little further in than needed: the rows are not quite straight.
    inner = INNER - 0.03
    sides = np.vstack([np.hstack([slopes, slack]), np.hstack([-slopes, slack])[TWO_SIDED]])
    limits = np.concatenate([inner - here, (inner + here)[TWO_SIDED]])
    box = [(max(-reach, -x), min(reach, 1.0 - x)) for x in point] + [(0.0, None)] * here.size
    weights = np.concatenate([np.zeros(point.size), np.ones(here.size)])
    return np.clip(point + linprog(weights, sides, limits, bounds=box).x[:point.size], 0.0, 1.0)


def _measure_stage(job: tuple[Problem, Array, int, Measured]) -> Measured:
    problem, point, stage, measured = job
    return list(stages(problem.candidate(point), measured).values())[stage]()


def _measure_whole(job: tuple[Problem, Array]) -> Measured:
    problem, point = job
    return problem.measure(point)


def load(path: Path) -> Search:
    """Return a search that was saved. Raises InputError if there is none in the file."""
    try:
        found = pickle.loads(path.read_bytes())
    except (OSError, pickle.UnpicklingError, EOFError, AttributeError) as error:
        raise InputError(f'{path} holds no state of a calibration: {error}') from None
    if not isinstance(found, Search):
        raise InputError(f'{path} holds no state of a calibration')
    return found


def new_search(start: Candidate, structure: Structure, seed: int, spread: float,
               only: Sequence[str] = ()) -> Search:
    """
    Return a search from a start.

    spread: of the first generation, a share of the range of each; only: the names of the
    quantities that are to vary (all that the structure leaves free, if empty). Raises InputError
    for a spread that is none, or a name that FREE does not hold.
    """
    if not 0.0 < spread <= 1.0:
        raise InputError(f'spread = {spread:g} is not allowed: above 0, at most 1')
    names = [free.name for free in FREE]
    for name in (*only, *structure.fixed):
        if name not in names:
            raise InputError(f'{name} is not free; there are {", ".join(names)}')
    free = tuple(k for k, name in enumerate(names)
                 if name not in structure.fixed and (not only or name in only))
    known = {**quantities(start), **structure.fixed}
    return Search(Problem({**start.actuator, **SEARCH}, start.conditions, free, encode(known),
                          structure.one_load), seed, spread)


def calibrate(search: Search, evaluations: int, rounds: int, state: Path,
              report: Progress = silent) -> Search:
    """Search until so many evaluations are made, then polish; the state is kept in a file."""
    def apply(function: Callable[..., Any], jobs: Iterable[Any]) -> Iterable[Any]:
        return each(function, ((job,) for job in jobs))

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
    best = search.problem.candidate(search.best)
    return best._replace(actuator={name: value for name, value in best.actuator.items()
                                   if name not in SEARCH})


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


def run(out: Path, structure: str, evaluations: int, rounds: int, seed: int, spread: float,
        start: Path | None, only: Sequence[str], report: Progress) -> dict[str, Any]:
    """
    Do what `asi calibrate` is asked to; return its document.

    structure: a name of STRUCTURES. Raises InputError for a start, a state or a name that is not
    there.
    """
    out.mkdir(parents=True, exist_ok=True)
    state = out / 'state.pickle'
    if state.exists():
        search = load(state)
    else:
        search = new_search(read_best(start) if start else Candidate({}, Conditions()),
                            STRUCTURES[structure], seed, spread, only)
    calibrate(search, evaluations, rounds, state, report)
    write_best(result(search), out / 'best.json')
    measured = search.problem.measure(search.best)
    names = stages(result(search), {})
    return {'evaluations': search.evaluations,
            'stages': dict(zip(names, search.counts, strict=True)),
            'polish_evaluations': search.polished, 'cost': cost(misses(measured)),
            'best': str(out / 'best.json'),
            'met': sum(fact.met(measured[fact.value]) for fact in AIMS), 'total': len(AIMS),
            'not_met': [fact.value for fact in AIMS if not fact.met(measured[fact.value])]}


def as_text(document: Mapping[str, Any]) -> str:
    """Return what came out, for people."""
    lines = [f'{document["evaluations"]} evaluations and {document["polish_evaluations"]} of the '
             f'polish, cost {document["cost"]:.4g}; {document["met"]} of {document["total"]} rows '
             'that were aimed at are met',
             'measured by stage: ' + ', '.join(f'{name} {count}' for name, count
                                               in document['stages'].items())]
    if document['not_met']:
        lines.append('not met: ' + ', '.join(document['not_met']))
    return '\n'.join([*lines, f'best: {document["best"]}'])
