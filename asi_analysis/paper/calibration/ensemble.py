"""
An ensemble of parameter sets that meet the facts about equally well.

Members are drawn about the best set along the directions to which the facts are insensitive,
according to the slopes of all rows (the sloppy directions of Gutenkunst and others, "Universally
sloppy parameter sensitivities", PLoS Computational Biology 3, 2007). Each draw is measured, and
accepted if it meets as many rows and differs clearly from all accepted before.
"""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.errors import InputError
from asi_analysis.free_parameter import Scale, to_values, to_vector
from asi_analysis.paper.calibration import ensemble_figures
from asi_analysis.paper.calibration.cost import position
from asi_analysis.paper.calibration.quantities import FREE, PHYSICAL, Candidate, quantities
from asi_analysis.paper.calibration.search import SEARCH, Problem
from asi_analysis.paper.facts.conditions import Conditions
from asi_analysis.paper.facts.fact import Measured
from asi_analysis.paper.facts.table import FITTED_ROWS
from asi_analysis.parallel import each
from asi_analysis.reporting import figures
from asi_analysis.reporting.result import Result, Table
from asi_analysis.terminal import Progress, silent
from asi_common.files import write_text
from asi_common.parameter_file import write_parameters

SLOPE_STEP: Final = 0.02
# Members differ from each other by at least this share of the range of some parameter.
LEAST_DISTANCE: Final = 0.1
# Initial spread of the draws, in half widths of the rows; it falls when a draw misses a row, and
# grows when one is too near to another.
FIRST_SPREAD: Final = 0.1
# Draws that are measured in parallel; the spread is adapted after each generation.
GENERATION: Final = 8
# Points that are drawn for a generation; the linear prediction excludes most of them.
DRAWS: Final = 4096


class Sensitivity(NamedTuple):
    """Slopes, rows x parameters: half widths of the row for 10 % of the parameter."""

    rows: tuple[str, ...]
    parameters: tuple[str, ...]
    slopes: Array


class Member(NamedTuple):
    """A parameter set of the ensemble, and the number of fitted rows that it meets."""

    quantities: dict[str, float]
    met: int


def problem_of(best: Candidate) -> Problem:
    """Return the problem whose start is a candidate and whose physical parameters are free."""
    return Problem({**best.actuator, **SEARCH}, best.conditions, PHYSICAL,
                   to_vector(FREE, quantities(best)))


def _positions(measured: Measured) -> Array:
    return np.array([np.clip(position(row, measured[row.name]), -10.0, 10.0)
                     if row.low != row.high and math.isfinite(measured[row.name]) else 0.0
                     for row in FITTED_ROWS])


def _met(measured: Measured) -> int:
    return sum(row.met(measured[row.name]) for row in FITTED_ROWS)


def slopes(problem: Problem, report: Progress = silent) -> Array:
    """Return the slope of each row's position over the unit cube: rows x free quantities."""
    point = problem.start[list(problem.free)]
    moved = [np.clip(point + step * unit, 0.0, 1.0)
             for unit in np.eye(point.size) for step in (-SLOPE_STEP, SLOPE_STEP)]
    found: list[Array] = []
    report('sensitivity', 0.0)
    for measured in each(Problem.measure, ((problem, one) for one in moved)):
        report('sensitivity', len(found) / len(moved))
        found.append(_positions(measured))
    return np.array([(found[2 * k + 1] - found[2 * k]) / (moved[2 * k + 1][k] - moved[2 * k][k])
                     for k in range(point.size)]).T


def sensitivity(problem: Problem, found: Array) -> Sensitivity:
    """Return slopes over the unit cube as those for 10 % of each parameter."""
    scale = []
    for k in problem.free:
        free = FREE[k]
        value = free.value(problem.start[k])
        scale.append(math.log(1.1) / math.log(free.high / free.low) if free.scale is Scale.LOG
                     else 0.1 * abs(value) / (free.high - free.low))
    return Sensitivity(tuple(row.name for row in FITTED_ROWS),
                       tuple(FREE[k].name for k in problem.free), found * np.array(scale))


def members(problem: Problem, found: Array, count: int, seed: int, most: int,
            report: Progress = silent) -> tuple[list[Member], int]:
    """
    Return `count` members (fewer if `most` evaluations do not find them) and the evaluations used.

    found: the slopes.
    """
    random = np.random.default_rng(seed)
    point = problem.start[list(problem.free)]
    _, sizes, directions = np.linalg.svd(found)
    stiffness = np.zeros(point.size)
    stiffness[:sizes.size] = sizes
    at_best = problem.measure(point)
    needed, best_positions = _met(at_best), _positions(at_best)
    two_sided = np.array([not row.one_sided for row in FITTED_ROWS])
    accepted: list[tuple[Array, Member]] = []
    spread, tried = FIRST_SPREAD, 0
    while len(accepted) < count and tried < most:
        report(f'{len(accepted)} of {count} members', tried / most)
        # A unit step along a direction of stiffness s moves the rows by s; so insensitive
        # directions get large steps, up to the bounds.
        along = (random.normal(size=(DRAWS, point.size))
                 / np.hypot(stiffness / spread, 1.0 / 0.3))
        drawn = np.clip(point + along @ directions, 0.0, 1.0)
        # Only draws that meet all rows according to the linear prediction are measured.
        expected = best_positions + (drawn - point) @ found.T
        inside = (expected <= 1.0) & ((expected >= -1.0) | ~two_sided)
        drawn = drawn[inside.all(axis=1)][:min(GENERATION, most - tried)]
        if not len(drawn):
            spread *= 0.8
            continue
        tried += len(drawn)
        for one, measured in zip(drawn, each(Problem.measure, ((problem, one) for one in drawn)),
                                 strict=True):
            met = _met(measured)
            near = any(np.abs(one - other).max() < LEAST_DISTANCE for other, _ in accepted)
            if met < needed:
                spread *= 0.98
            elif near:
                spread *= 1.1
            elif len(accepted) < count:
                values = to_values(FREE, problem.whole(one))
                accepted.append((one, Member({FREE[k].name: values[FREE[k].name]
                                              for k in problem.free}, met)))
    return [member for _, member in accepted], tried


def write_members(found: Sequence[Member], out: Path) -> None:
    """Write each member as a ROS parameter file of the actuator."""
    out.mkdir(parents=True, exist_ok=True)
    for number, member in enumerate(found, 1):
        write_parameters(
            out / f'member_{number:02d}.yaml', '/**/asi_actuator',
            {name: float(f'{value:.6g}') for name, value in member.quantities.items()},
            [f'Ensemble, member {number}: meets {member.met} of the {len(FITTED_ROWS)} fitted '
             'rows.', 'Written by `asi ensemble`.'])


def sensitivity_table(found: Sensitivity) -> str:
    """Return the rows that are most sensitive to each parameter, as a table in Markdown."""
    lines = ['| parameter | 10 % of it moves most | half widths | then | half widths |',
             '|---|---|---|---|---|']
    for k, name in enumerate(found.parameters):
        order = np.argsort(-np.abs(found.slopes[:, k]))[:2]
        cells = ' | '.join(f'{found.rows[row]} | {found.slopes[row, k]:+.2f}' for row in order)
        lines.append(f'| `{name}` | {cells} |')
    return '\n'.join(lines) + '\n'


class Ensemble(Result):
    """The members of an ensemble, by the keys of `asi ensemble --json`."""

    def parts(self) -> Iterator[str | Table]:
        yield (f'{self.members} members of {self.evaluations} tried, in {self.out}: they meet '
               f'{min(self.met, default=0)} to {max(self.met, default=0)} of {self.total} rows')


def run(out: Path, pictures: Path, count: int, most: int, seed: int, report: Progress
        ) -> Ensemble:
    """
    Draw an ensemble about the default parameters, write it and its pictures; return the result.

    out: directory of the members; pictures: directory of the pictures and the sensitivity table.
    Raises InputError if no member is found.
    """
    best = Candidate({}, Conditions())
    problem = problem_of(best)
    found = slopes(problem, report)
    ensemble, tried = members(problem, found, count, seed, most, report)
    if not ensemble:
        raise InputError(f'none of {tried} candidates is a member: try more')
    write_members(ensemble, out)
    pictures.mkdir(parents=True, exist_ok=True)
    write_text(pictures / 'sensitivity.md', sensitivity_table(sensitivity(problem, found)))
    for name, draw in (('ensemble_spread', ensemble_figures.spread),
                       ('ensemble_pairs', ensemble_figures.pairs)):
        figures.save(draw([member.quantities for member in ensemble], quantities(best)),
                     pictures / f'{name}.png', 110.0)
    return Ensemble({'members': len(ensemble), 'evaluations': tried, 'out': str(out),
                     'met': [member.met for member in ensemble], 'total': len(FITTED_ROWS)})
