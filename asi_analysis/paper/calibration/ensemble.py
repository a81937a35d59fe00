"""
What the paper does not determine: parameter sets that meet its facts about equally well.

Members are drawn about the best set along the directions to which the facts are blind, as the
slopes of all rows tell (the sloppy directions of Gutenkunst and others, "Universally sloppy
parameter sensitivities", PLoS Computational Biology 3, 2007), measured in full, and kept if they
meet as many rows and differ clearly from all that were kept before.
"""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from asi_analysis.errors import InputError
from asi_analysis.free_parameter import Scale, to_values, to_vector
from asi_analysis.paper.calibration import ensemble_figures
from asi_analysis.paper.calibration.cost import position
from asi_analysis.paper.calibration.quantities import FREE, PHYSICAL, Candidate, quantities
from asi_analysis.paper.calibration.search import SEARCH, Problem
from asi_analysis.paper.facts.conditions import Conditions
from asi_analysis.paper.facts.fact import Measured
from asi_analysis.paper.facts.table import AIMS
from asi_analysis.parallel import each
from asi_analysis.reporting import figures
from asi_analysis.reporting.result import Result, Table
from asi_analysis.terminal import Progress, silent
from asi_common.files import write_text
from asi_common.parameter_file import write_parameters

Array = npt.NDArray[np.float64]

SLOPE_STEP: Final = 0.02
# Members differ from each other by at least this share of the range of some parameter.
LEAST_DISTANCE: Final = 0.1
# First reach of the draws, in half widths of the rows; it falls when a draw misses a row, and
# grows when one is too near to another.
FIRST_REACH: Final = 0.1
# Draws that are measured side by side; the reach follows them together.
GENERATION: Final = 8
# Points that are drawn for each of these, most of which the slopes rule out.
DRAWS: Final = 4096


class Sensitivity(NamedTuple):
    """How the rows move: rows x parameters, half widths of the row for 10 % of the parameter."""

    rows: tuple[str, ...]
    parameters: tuple[str, ...]
    slopes: Array


class Member(NamedTuple):
    """A parameter set of the ensemble, and how many of the rows aimed at it meets."""

    quantities: dict[str, float]
    met: int


def problem_of(best: Candidate) -> Problem:
    """Return the problem whose start is a candidate and whose physical parameters are free."""
    known = quantities(best)
    fixed = {name: value for name, value in best.actuator.items() if name not in known}
    return Problem({**fixed, **SEARCH}, best.conditions, PHYSICAL, to_vector(FREE, known))


def _positions(measured: Measured) -> Array:
    return np.array([np.clip(position(row, measured[row.name]), -10.0, 10.0)
                     if row.low != row.high and math.isfinite(measured[row.name]) else 0.0
                     for row in AIMS])


def _measured(problem: Problem, point: Array) -> Measured:
    return problem.measure(point)


def _met(measured: Measured) -> int:
    return sum(row.met(measured[row.name]) for row in AIMS)


def slopes(problem: Problem, report: Progress = silent) -> Array:
    """Return the slope of each row's position over the unit cube: rows x free quantities."""
    point = problem.start[list(problem.free)]
    moved = [np.clip(point + step * unit, 0.0, 1.0)
             for unit in np.eye(point.size) for step in (-SLOPE_STEP, SLOPE_STEP)]
    found: list[Array] = []
    for measured in each(_measured, ((problem, one) for one in moved)):
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
    return Sensitivity(tuple(row.name for row in AIMS),
                       tuple(FREE[k].name for k in problem.free), found * np.array(scale))


def members(problem: Problem, found: Array, count: int, seed: int, most: int,
            report: Progress = silent) -> tuple[list[Member], int]:
    """
    Return so many members (fewer, if `most` evaluations do not find them), and the evaluations.

    found: the slopes.
    """
    random = np.random.default_rng(seed)
    point = problem.start[list(problem.free)]
    _, sizes, directions = np.linalg.svd(found)
    stiffness = np.zeros(point.size)
    stiffness[:sizes.size] = sizes
    at_best = problem.measure(point)
    needed, here = _met(at_best), _positions(at_best)
    two_sided = np.array([not row.one_sided for row in AIMS])
    kept: list[tuple[Array, Member]] = []
    reach, tried = FIRST_REACH, 0
    while len(kept) < count and tried < most:
        report(f'{len(kept)} of {count} members', tried / most)
        # A direction of stiffness s moves some row by s; none moves by more than the box allows.
        along = (random.normal(size=(DRAWS, point.size))
                 / np.hypot(stiffness / reach, 1.0 / 0.3))
        drawn = np.clip(point + along @ directions, 0.0, 1.0)
        # Only those that should meet all rows, were these straight, are worth the measurement.
        expected = here + (drawn - point) @ found.T
        inside = (expected <= 1.0) & ((expected >= -1.0) | ~two_sided)
        drawn = drawn[inside.all(axis=1)][:min(GENERATION, most - tried)]
        if not len(drawn):
            reach *= 0.8
            continue
        tried += len(drawn)
        for one, measured in zip(drawn, each(_measured, ((problem, one) for one in drawn)),
                                 strict=True):
            met = _met(measured)
            near = any(np.abs(one - other).max() < LEAST_DISTANCE for other, _ in kept)
            if met < needed:
                reach *= 0.98
            elif near:
                reach *= 1.1
            elif len(kept) < count:
                whole = to_values(FREE, problem.whole(one))
                kept.append((one, Member({FREE[k].name: whole[FREE[k].name]
                                          for k in problem.free}, met)))
    return [member for _, member in kept], tried


def write_members(found: Sequence[Member], out: Path) -> None:
    """Write each member as a ROS parameter file of the actuator: what differs from defaults."""
    out.mkdir(parents=True, exist_ok=True)
    for number, member in enumerate(found, 1):
        write_parameters(
            out / f'member_{number:02d}.yaml', '/**/asi_actuator',
            {name: float(f'{value:.6g}') for name, value in member.quantities.items()},
            [f'Ensemble, member {number}: meets {member.met} of the {len(AIMS)} rows that the '
             'calibration aims at.', 'Written by `asi ensemble`.'])


def sensitivity_table(found: Sensitivity) -> str:
    """Return which fact pins which parameter, as a table in Markdown."""
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
    Do what `asi ensemble` is asked to, about the defaults; return its document.

    out: directory of the members; pictures: directory of the pictures and the sensitivity table.
    Raises InputError if there is no member.
    """
    best = Candidate({}, Conditions())
    problem = problem_of(best)
    found = slopes(problem, report)
    kept, tried = members(problem, found, count, seed, most, report)
    if not kept:
        raise InputError(f'none of {tried} candidates is a member: try more')
    write_members(kept, out)
    pictures.mkdir(parents=True, exist_ok=True)
    write_text(pictures / 'sensitivity.md', sensitivity_table(sensitivity(problem, found)))
    for name, draw in (('ensemble_spread', ensemble_figures.spread),
                       ('ensemble_pairs', ensemble_figures.pairs)):
        figures.save(draw([member.quantities for member in kept], quantities(best)),
                     pictures / f'{name}.png', 110.0)
    return Ensemble({'members': len(kept), 'evaluations': tried, 'out': str(out),
                     'met': [member.met for member in kept], 'total': len(AIMS)})
