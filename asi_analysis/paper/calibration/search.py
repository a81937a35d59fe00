"""
The search for the parameters with which the simulator fits the published facts best.

First CMA-ES (Hansen, "The CMA evolution strategy: a tutorial", 2016) within all bounds; only the
best points of a generation are measured completely. Then sequential linear programming from the
best point.
"""

import math
import pickle
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.errors import InputError
from asi_analysis.free_parameter import to_values, to_vector
from asi_analysis.loop.bench import Values
from asi_analysis.paper.calibration.cost import INNER, bounded, cost, misses
from asi_analysis.paper.calibration.plausible import penalty
from asi_analysis.paper.calibration.quantities import (
    FREE,
    TESTS,
    Candidate,
    Structure,
    candidate,
    quantities,
    with_tests,
)
from asi_analysis.paper.facts.conditions import Conditions
from asi_analysis.paper.facts.fact import Measured, Row, Setup, Stage
from asi_analysis.paper.facts.table import FACTS, FITTED_ROWS
from asi_analysis.parallel import each
from asi_analysis.terminal import Progress, silent
from asi_common.files import replacing

# For the search only: a coarser model, which near the goals changes every row by less than a tenth
# of its limits.
SEARCH: Final = {'maximum_substep': 1e-4}
SEARCH_STEPS_N: Final = (0.0, 100.0, 200.0, 300.0, 600.0)
SEARCH_ACCURACY: Final = 0.0015
SEARCH_RATIO_ACCURACY: Final = 0.004
SEARCH_WATCHED_S: Final = 16.0
SEARCH_FIRST_WATCHED_S: Final = 0.6
SEARCH_ONSET_CYCLE_S: Final = 3.0
# Highest gain at which a cycle is searched.
SEARCH_HIGHEST_GAIN: Final = 24.0
SEARCH_SAMPLES: Final = 360
# Number of points of a generation that are measured in each stage: the best of the stage before.
RACE: Final = (64, 16, 8, 6, 4)
# Ranks a point that was dropped in a stage behind all points that were measured further.
DROPPED_COST: Final = 1e3
# Trust region of the polish: initial radius, limits, and multiples of it that are tried.
TRUST_RADIUS: Final = 0.08
LEAST_RADIUS: Final = 0.003
MOST_RADIUS: Final = 0.25
SHARES: Final = (2.0, 1.0, 0.4, 0.15)
STEEPEST: Final = 80.0
# A row that is held at a value (--front) may deviate by this share of its half width; weight of
# its miss.
DEMANDED: Final = 0.2
WEIGHT: Final = 5.0
# CMA-ES takes no standard deviation near the resolution of a float.
LEAST_SPREAD: Final = 1e-6


def measure_stage(one: Candidate, stage: Stage, measured: Measured) -> Measured:
    """Return `measured` with the values of the fitted rows of a stage added."""
    setup = Setup(one.actuator, one.conditions._replace(
        onset_steps_n=SEARCH_STEPS_N, onset_accuracy=SEARCH_ACCURACY,
        onset_watched_s=SEARCH_WATCHED_S, ratio_accuracy=SEARCH_RATIO_ACCURACY,
        first_watched_s=SEARCH_FIRST_WATCHED_S, onset_cycle_s=SEARCH_ONSET_CYCLE_S,
        describing_samples=SEARCH_SAMPLES, highest_gain=SEARCH_HIGHEST_GAIN),
        dict(measured), fitted_only=True)
    for fact in FACTS:
        if fact.stage is stage:
            setup.measured.update(fact.measure(setup))
    return setup.measured


class Problem(NamedTuple):
    """The problem of a search: actuator and conditions, of which some quantities vary."""

    fixed: Values
    conditions: Conditions
    free: tuple[int, ...]     # indices in FREE of the quantities that vary
    start: Array              # a point of the unit cube of all quantities
    stages: tuple[Stage, ...] = tuple(Stage)   # that are measured
    demanded: Row | None = None     # replaces the row of its name, and counts more

    def whole(self, point: Array) -> Array:
        """Return the point of the cube of all quantities for a point of the free ones."""
        full = self.start.copy()
        full[list(self.free)] = np.clip(point, 0.0, 1.0)
        return full

    def candidate(self, point: Array) -> Candidate:
        """Return the candidate at a point of the free quantities."""
        values = to_values(FREE, self.whole(point))
        return candidate({FREE[k].name: values[FREE[k].name] for k in self.free}, self.fixed,
                         self.conditions)

    def cost(self, point: Array, measured: Measured) -> float:
        """Return the cost of a point: that of its misses and of implausible quantities."""
        demanded = WEIGHT * sum(misses(measured, [self.demanded] if self.demanded else []))
        others = [row for row in FITTED_ROWS if not self._demands(row)]
        return cost(misses(measured, others)) + demanded + penalty(self.candidate(point))

    def _demands(self, row: Row) -> bool:
        return self.demanded is not None and self.demanded.name == row.name

    def lines(self) -> list[Row]:
        """Return the rows with limits."""
        return [self.demanded if self.demanded and self._demands(row) else row for row in LINES]

    def weights(self) -> Array:
        """Return the weight of each of them."""
        return np.array([WEIGHT if self._demands(row) else 1.0 for row in LINES])

    def measure(self, point: Array) -> Measured:
        """Return the values of all fitted rows of its stages."""
        measured: Measured = {}
        for stage in self.stages:
            measured = measure_stage(self.candidate(point), stage, measured)
        return measured


class Search:
    """
    A search that can be stopped and resumed; the same seed gives the same points.

    seed: of CMA-ES; spread: its initial standard deviation, as a share of the cube. `seconds`:
    time spent in the global search. `counts`: number of points measured in each stage.
    """

    def __init__(self, problem: Problem, seed: int, spread: float) -> None:
        import cma
        self.problem = problem
        self.seed = seed
        self.seconds = 0.0
        self.counts = [0] * len(problem.stages)
        self.polished = 0
        self.best = problem.start[list(problem.free)]
        self.best_cost = problem.cost(self.best, problem.measure(self.best))
        self.strategy = cma.CMAEvolutionStrategy(
            self.best, spread, {'seed': seed, 'popsize': RACE[0], 'verbose': -9,
                                'maxfevals': math.inf})

    @property
    def evaluations(self) -> int:
        """Number of points that the global search has tried."""
        return self.counts[0]

    def generation(self) -> None:
        """Evaluate one generation."""
        points = [np.asarray(point) for point in self.strategy.ask()]
        measured: list[Measured] = [{} for _ in points]
        ranks = np.empty(len(points))
        racing = list(range(len(points)))
        stages = self.problem.stages
        places_after = (*RACE[1:len(stages)], 0)
        for done, (stage, places) in enumerate(zip(stages, places_after, strict=True)):
            found = each(measure_stage, [(self.problem.candidate(points[k]), stage, measured[k])
                                         for k in racing])
            self.counts[done] += len(racing)
            for k, new in zip(racing, found, strict=True):
                measured[k].update(new)
                ranks[k] = (self.problem.cost(points[k], measured[k]) + _outside(points[k])
                            + DROPPED_COST * (len(stages) - 1 - done))
            racing = sorted(racing, key=lambda k: ranks[k])[:places]
        self.strategy.tell(points, ranks)
        self._keep(points[int(np.argmin(ranks))], float(ranks.min()))

    def _keep(self, point: Array, found: float) -> None:
        if found < self.best_cost:
            self.best_cost, self.best = found, np.clip(point, 0.0, 1.0)

    def polish(self, rounds: int, report: Progress = silent) -> None:
        """
        Continue from the best point by sequential linear programming.

        Each row is linearised about the point. The step in the trust region with the least sum of
        misses is a linear program (Griffith and Stewart, Management Science 7, 1961). It accounts
        for the limits of rows that are met, which least squares do not.
        """
        point, reach = self.best.copy(), TRUST_RADIUS
        measured = self._measured([point])[0]
        for done in range(rounds):
            now = self.problem.cost(point, measured)
            self._keep(point, now)
            report(f'polishing, cost {now:.3f}', done / rounds)
            if now == 0.0 or reach < LEAST_RADIUS:
                return
            slopes, side = self._slopes(point, measured, reach, done)
            reaches = [min(share * reach, MOST_RADIUS) for share in SHARES]
            lines = self.problem.lines()
            tried = [_step(point, _bounds(measured, lines), slopes, one, lines,
                           self.problem.weights()) for one in reaches]
            found = self._measured(tried)
            costs = list(map(self.problem.cost, tried, found))
            k = int(np.argmin(costs))
            if costs[k] < min(now, side[0]):
                point, measured, reach = tried[k], found[k], reaches[k]
            elif side[0] < now:
                _, point, measured = side
                reach *= 0.6
            else:
                reach *= 0.35
        self._keep(point, self.problem.cost(point, measured))

    def _slopes(self, point: Array, measured: Measured, reach: float, seed: int
                ) -> tuple[Array, tuple[float, Array, Measured]]:
        """Return the slopes of all rows (rows x quantities), and the best of the points tried."""
        size = min(max(0.5 * reach, 0.004), 0.02)
        steps = np.where(np.random.default_rng(seed).random(point.size) < 0.5, size, -size)
        steps = np.where((point + steps < 0.0) | (point + steps > 1.0), -steps, steps)
        tried = [point + step * unit
                 for step, unit in zip(steps, np.eye(point.size), strict=True)]
        found = self._measured(tried)
        lines = self.problem.lines()
        here = _bounds(measured, lines)
        slopes = np.array([(_bounds(one, lines) - here) / step
                           for one, step in zip(found, steps, strict=True)]).T
        costs = list(map(self.problem.cost, tried, found))
        k = int(np.argmin(costs))
        return np.clip(slopes, -STEEPEST, STEEPEST), (costs[k], tried[k], found[k])

    def _measured(self, points: Sequence[Array]) -> list[Measured]:
        self.polished += len(points)
        return list(each(Problem.measure, [(self.problem, point) for point in points]))

    def save(self, path: Path) -> None:
        """Write the state; a crash while writing leaves the previous one."""
        with replacing(path) as temporary:
            temporary.write_bytes(pickle.dumps(self))


def _outside(point: Array) -> float:
    return 10.0 * float(np.sum((point - np.clip(point, 0.0, 1.0))**2))


LINES: Final = tuple(row for row in FITTED_ROWS if row.low != row.high)


def _bounds(measured: Measured, lines: Sequence[Row]) -> Array:
    """Return the bounded position of each row, in half widths; 0 for a row that is left out."""
    return np.array([bounded(row, measured[row.name]) if row.name in measured else 0.0
                     for row in lines])


def _step(point: Array, here: Array, slopes: Array, reach: float,
          lines: Sequence[Row] = LINES, weights: Array | None = None) -> Array:
    """Return the point within `reach` that has the least sum of misses of the linearised rows."""
    from scipy.optimize import linprog
    slack = -np.eye(here.size)
    two_sided = np.array([not row.one_sided for row in lines])
    # Slightly tighter limits than needed, since the rows are not exactly linear.
    inner = INNER - 0.03
    sides = np.vstack([np.hstack([slopes, slack]), np.hstack([-slopes, slack])[two_sided]])
    limits = np.concatenate([inner - here, (inner + here)[two_sided]])
    box = [(max(-reach, -x), min(reach, 1.0 - x)) for x in point] + [(0.0, None)] * here.size
    costs = np.concatenate([np.zeros(point.size),
                            np.ones(here.size) if weights is None else weights])
    return np.clip(point + linprog(costs, sides, limits, bounds=box).x[:point.size], 0.0, 1.0)


def at_value(name: str, value: float) -> Row | None:
    """Return a fitted row with narrow limits about a value; None if no row has this name."""
    for row in FITTED_ROWS:
        if row.name == name and math.isfinite(row.high) and row.low != row.high:
            near = 0.5 * DEMANDED * (row.high - row.low)
            return row._replace(low=value - near, high=value + near)
    return None


def load(path: Path) -> Search:
    """Return a saved search. Raises InputError if the file has none."""
    try:
        found = pickle.loads(path.read_bytes())
    except Exception as error:  # noqa: B902 - damaged bytes raise anything
        raise InputError(f'{path} holds no state of a calibration: {error}') from None
    if not isinstance(found, Search):
        raise InputError(f'{path} holds no state of a calibration')
    return found


def _in_block(name: str, block: str) -> bool:
    """Return whether a quantity is `block` itself or belongs to it."""
    return name == block or name.startswith(f'{block}.')


def new_search(start: Candidate, structure: Structure, seed: int, spread: float,
               only: Sequence[str] = (), report: Progress = silent,
               table_1: bool = True, demanded: Row | None = None) -> Search:
    """
    Return a search that starts from a candidate.

    spread: of the first generation, as a share of each range; only: names of the quantities to
    vary, or of their blocks (if empty, all that the structure leaves free). table_1: whether the
    rows of Table 1 count; without them its conditions do not vary, and where only those vary, the
    other rows are left out. demanded: a row with limits of its own. Raises InputError for an
    invalid spread, a name that is not in FREE, or if nothing varies.
    """
    if not LEAST_SPREAD <= spread <= 1.0:
        raise InputError(f'spread = {spread:g} is not allowed: from {LEAST_SPREAD:g} to 1')
    names = [free.name for free in FREE]
    for name in (*only, *structure.fixed):
        if name not in names and not (name in only and any(_in_block(each, name)
                                                           for each in names)):
            raise InputError(f'{name} is not free; there are {", ".join(names)}')
    load = start.conditions.proportional.load
    if structure.load and structure.load['load.type'] != load['load.type']:
        start = start._replace(conditions=with_tests(start.conditions, {
            name: getattr(start.conditions, name)._replace(load=structure.load)
            for name in TESTS}))
    locked = start.conditions.proportional.load['load.type'] == 'locked'
    free = tuple(k for k, name in enumerate(names)
                 if name not in structure.fixed
                 and (not only or any(_in_block(name, each) for each in only))
                 and not (locked and name.startswith('conditions.load.'))
                 and (table_1 or not name.startswith('conditions.')))
    if not free:
        raise InputError('nothing varies')
    physical = any(not names[k].startswith('conditions.') for k in free)
    stages = tuple(stage for stage in Stage
                   if (table_1 if stage is Stage.TABLE_1 else physical))
    start = candidate(structure.fixed, start.actuator, start.conditions)
    problem = Problem({**start.actuator, **SEARCH}, start.conditions, free,
                      to_vector(FREE, quantities(start)), stages, demanded)
    report('start', 0.0)
    return Search(problem, seed, spread)


def calibrate(search: Search, evaluations: int, rounds: int, state: Path,
              report: Progress = silent) -> Search:
    """Search up to a number of evaluations, then polish; the state is saved to a file."""
    while search.evaluations < evaluations and not search.strategy.stop():
        begin = time.perf_counter()
        search.generation()
        search.seconds += time.perf_counter() - begin
        search.save(state)
        report(f'{search.evaluations} evaluations, cost {search.best_cost:.3f}',
               search.evaluations / evaluations)
    if rounds:
        search.polish(rounds, report)
    search.save(state)
    return search


def result(search: Search) -> Candidate:
    """Return the best candidate, without the settings of the search."""
    best = search.problem.candidate(search.best)
    return best._replace(actuator={name: value for name, value in best.actuator.items()
                                   if name not in SEARCH})
