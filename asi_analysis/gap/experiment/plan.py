"""
Design of the recordings of a joint: the courses that separate its likely effects.

The courses are those of `next_motion`, within the limits of the joint. The expected diagnosis of
each is computed with the nominal joint (`suspects.py`); the fewest courses are chosen that find
as many effects as all of them together.
"""

import itertools
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d

from asi_analysis.arrays import Array
from asi_analysis.bags.run import SIGNALS, Run
from asi_analysis.errors import InputError
from asi_analysis.gap.experiment.next_motion import CATALOGUE, Course, steepest
from asi_analysis.gap.experiment.suspects import (
    FITTED,
    Suspect,
    Told,
    size_of,
    suspects_of,
    told,
    with_suspects,
)
from asi_analysis.gap.inference.probability import Evidence, Names
from asi_analysis.gap.model.group import Group, Values
from asi_analysis.gap.model.joint import drive_of, joint_groups
from asi_analysis.terminal import Progress, silent
from asi_common.parameter import Value

LIMIT_SHARE: Final = 0.9   # of a limit that is used: a loop overshoots
FORCE_SHARE: Final = 0.5   # of the largest force; the rest is for friction, gravity and the loop
CORNERS: Final = 0.7     # of that force, for the acceleration in corners
REST_S: Final = 1.0      # between courses
COURSE_S: Final = 10.0   # least duration of a course, which has at least two cycles
LONGEST_S: Final = 120.0
HIGHEST_SHARE: Final = 0.05   # highest frequency of a course, as a share of the sampling rate
SLOWDOWN: Final = 0.85     # factor on the frequency of a course that needs too much force
# In a single sine a spring equals a negative inertia, and a delay a damping or a spring.
LEAST_COURSES, MOST_COURSES = 2, 3
MOST_RUNS: Final = 5
LEAST_RUNS: Final = 2    # their difference shows the noise
IDENTIFIED: Final = 0.8  # probability of a suspect from which it counts as identified
PRICE_OF_COURSE: Final = 0.02   # by which a further course must raise the sum of probabilities
# Assumed noise: quantisation of the position; shares of the largest force and speed.
ENCODER_BITS: Final = 16
FORCE_NOISE: Final = 0.005
SPEED_NOISE: Final = 1e-3
RUN_UP: Final = 0.05   # share of the travel in which full speed is reached, if no force is given


class Limits(NamedTuple):
    """
    The limits of a joint in SI units; rad and Nm of one that turns.

    low, high: of its position; speed; force: of its drive, inf: not given. noise: standard
    deviation of the recorded signals, by signal.
    """

    low: float
    high: float
    speed: float
    force: float = np.inf
    turns: bool = True
    noise: Mapping[str, float] = MappingProxyType({})

    @property
    def reach(self) -> float:
        """Return the largest deviation of a course from the middle."""
        return 0.5 * LIMIT_SHARE * (self.high - self.low)

    @property
    def middle(self) -> float:
        """Return the middle of the travel."""
        return 0.5 * (self.low + self.high)


class Drawn(NamedTuple):
    """A course within the limits of a joint, about its middle, with rests: size, frequency."""

    name: str
    size: float
    frequency_hz: float
    position: Array


def nominal_force(position: Array, period: float, given: Mapping[str, Value]) -> Array:
    """Return the force (N or Nm) of the nominal joint in a motion about its middle."""
    speed = np.gradient(position, period)
    mass, damping, stiffness = (float(given.get(f'load.{name}', 0.0))
                                for name in ('mass', 'damping', 'stiffness'))
    return mass * np.gradient(speed, period) + damping * speed + stiffness * position


def acceleration_of(limits: Limits, given: Mapping[str, Value]) -> float:
    """Return the acceleration of the sharpest corners."""
    mass = float(given.get('load.mass', 0.0))
    if mass > 0.0 and np.isfinite(limits.force):
        return CORNERS * FORCE_SHARE * limits.force / mass
    return limits.speed ** 2 / (2.0 * RUN_UP * (limits.high - limits.low))


def drawn(name: str, limits: Limits, period: float, given: Mapping[str, Value]) -> Drawn:
    """
    Return a course of the catalogue, in whole cycles, with a rest before and after.

    It is as fast as the limits allow. Raises InputError if they do not allow it.
    """
    course, share, speed = CATALOGUE[name]
    size, most = share * limits.reach, acceleration_of(limits, given)
    slope = steepest(course, np.arange(0.0, 20.0, 1e-3))
    frequency = min(speed * LIMIT_SHARE * limits.speed / (size * slope), HIGHEST_SHARE / period)
    while _duration(course, frequency) < LONGEST_S:
        position = _with_rests(course, size, frequency, most, period)
        acceleration = np.abs(np.diff(position, 2)).max() / period ** 2
        force = np.abs(nominal_force(position, period, given)).max()
        if acceleration <= 1.1 * most and force <= FORCE_SHARE * limits.force:
            return Drawn(name, size, frequency, position)
        frequency *= SLOWDOWN
    raise InputError(f'{name} takes more than {LONGEST_S:g} s within the limits: a velocity of at '
                     f'most {limits.speed:.4g}, and half of a command of {limits.force:.4g}; are '
                     'they, and the mass, in the units of the limits?')


def _duration(course: Course, frequency: float) -> float:
    """Return the duration (s) of a course: whole cycles, at least two."""
    # A sweep begins at a tenth of its frequency: its mean frequency is lower.
    sweeps = abs(float(course(np.array([0.0, 0.25 / frequency, 10.0 / frequency]),
                              frequency)[1])) < 0.9
    often = 0.9 * frequency / np.log(10.0) if sweeps else frequency
    return float(max(np.ceil(often * COURSE_S), 2.0) / often)


def _with_rests(course: Course, size: float, frequency: float, acceleration: float,
                period: float) -> Array:
    """Return a course from rest to rest, with corners rounded to a largest acceleration."""
    moving = size * course(np.arange(0.0, _duration(course, frequency), period), frequency)
    rest = np.zeros(round(REST_S / period))
    position = np.concatenate([rest, moving, rest])
    corner = float(np.abs(np.diff(position, 2)).max())
    spread = int(np.clip(np.ceil(corner / (acceleration * period ** 2)), 1, rest.size))
    return np.asarray(uniform_filter1d(position, spread, mode='nearest'))


def recorded(position: Array, sensors: Sequence[str], limits: Limits, period: float,
             given: Mapping[str, Value]) -> Run:
    """Return a simulated recording of the nominal joint in a course about the middle."""
    rng = np.random.default_rng(0)
    force = nominal_force(position, period, given)
    true = {'position': limits.middle + position, 'reference': limits.middle + position,
            'velocity': np.gradient(position, period), 'command': force, 'force': force}
    usual = usual_noise(limits, force)
    units = {'position': 'rad', 'reference': 'rad', 'velocity': 'rad/s', 'command': 'Nm',
             'force': 'Nm'} if limits.turns else {'reference': 'm'}
    level = {**usual, **limits.noise, 'reference': 0.0}
    signals: dict[str, Any] = {
        name: true[name] + level[name] * rng.standard_normal(position.size) for name in sensors}
    field = {signal.name: signal.field for signal in SIGNALS}
    time: Array = period * np.arange(position.size, dtype=float)
    return Run(np.asarray(time, np.float64), source='the plan',
               information={'signals': {name: units[name] for name in sensors if name in units}},
               **{field[name]: values for name, values in signals.items()})


def usual_noise(limits: Limits, force: Array) -> dict[str, float]:
    """Return the assumed noise (standard deviation), by signal."""
    turn = 2.0 * np.pi if limits.turns else limits.high - limits.low
    most = float(np.abs(force).max())
    return {'position': turn / 2 ** ENCODER_BITS / np.sqrt(12.0),
            'velocity': SPEED_NOISE * limits.speed, 'command': FORCE_NOISE * most,
            'force': FORCE_NOISE * most}


def groups_of(position: Array, sensors: Sequence[str], limits: Limits, period: float,
              given: Mapping[str, Value], tolerance: float) -> list[Group]:
    """Return the groups of channels of a course, with the suspects among their effects."""
    run = recorded(position, sensors, limits, period, given)
    groups, _ = joint_groups([run], given, tolerance, [False], drive_of([run]))
    return with_suspects(groups, given, tolerance, limits.turns and 'position' in sensors)


class Answer(NamedTuple):
    """The expected result of courses for each suspect of each size."""

    records: dict[Suspect, np.void]
    tells: dict[Suspect, Told]


def answer_of(position: Array, sensors: Sequence[str], limits: Limits, period: float,
              given: Mapping[str, Value], tolerance: float, scales: Sequence[Values],
              fitted: int = 0, only: Sequence[str] | None = None) -> Answer:
    """
    Return the expected result of a course for each suspect.

    scales: of the sizes of the suspects, by group; only: names of suspects, None: all.
    """
    groups = groups_of(position, sensors, limits, period, given, tolerance)
    # With one more sensor there may be one more group, of the drive, before that of the motion.
    own: list[Values] = [{}] * (len(groups) - len(scales)) + list(scales)
    sized = [replace(group, scale=group.scale | scale)
             for group, scale in zip(groups, own, strict=True)]
    suspects = [each for each in suspects_of(groups) if only is None or each.name in only]
    records = {each: size_of(each, sized) for each in suspects}
    return Answer(records, {each: told(each, groups[each.group], records[each], fitted)
                            for each in suspects})


def joined(tells: Sequence[Told]) -> Told:
    """Return the expected result of several courses, diagnosed together."""
    evidence = [each.evidence for each in tells]
    channel = next(iter(evidence[0].noise))
    weights = np.array([each.held_out_s for each in evidence])
    weights /= weights.sum()

    def mean(values: Sequence[float]) -> float:
        return float(weights @ np.array(values))

    noise = mean([each.noise[channel] for each in evidence])
    # Each course is weighted by its own noise and error floor.
    residual: dict[Names, Values] = {}
    for names in evidence[0].residual:
        ratio = mean([each.residual[names][channel] / each.noise[channel] for each in evidence])
        residual[names] = {channel: noise * ratio}
    first = evidence[0]
    floor = noise * mean([each.error_floor[channel] / each.noise[channel] for each in evidence])
    return Told({}, Evidence(
        {channel: noise}, {channel: floor}, first.formulation,
        {channel: sum(each.independent[channel] for each in evidence)},
        sum(each.held_out_s for each in evidence), residual, first.parameters))


def chances(tells: Mapping[Suspect, Told], runs: int = 1) -> dict[Suspect, float]:
    """Return the expected probability of each suspect, given that it is the truth."""
    return {suspect: each.expected(runs).get((suspect.name,), 0.0)
            for suspect, each in tells.items()}


class Planned(NamedTuple):
    """The courses of a plan, their expected result, and those of the whole catalogue."""

    courses: list[Drawn]
    position: Array      # of all courses, one after the other, about the middle
    period_s: float
    runs: int
    answer: Answer
    alone: dict[str, dict[Suspect, float]]   # probability of each suspect by each course
    groups: list[Group]
    scales: list[Values]   # of the sizes of the suspects, by group


def _by_identity(tells: Mapping[Suspect, Told]) -> dict[tuple[str, int], tuple[Suspect, Told]]:
    """Return results by name and size of suspects, which are the same in all courses."""
    return {(each.name, each.size): (each, found) for each, found in tells.items()}


def plan_courses(sensors: Sequence[str], limits: Limits, period: float,
                 given: Mapping[str, Value], tolerance: float, progress: Progress = silent
                 ) -> Planned:
    """Return the fewest courses that identify as many suspects as the whole catalogue does."""
    usual_course = drawn('sine over the whole range', limits, period, given)
    courses = {}
    for name in CATALOGUE:
        with suppress(InputError):   # too slow
            courses[name] = drawn(name, limits, period, given)
    progress('the nominal joint', 0.0)
    # The sizes of the suspects are relative to the signals of the fastest motion.
    usual = groups_of(usual_course.position, sensors, limits, period, given, tolerance)
    scales = [group.scale for group in usual]
    answers: dict[str, Answer] = {}
    for number, (name, each) in enumerate(courses.items()):
        progress(f'course {number + 1} of {len(courses)}', number / (len(courses) + 1))
        answers[name] = answer_of(each.position, sensors, limits, period, given, tolerance,
                                  scales)
    by_course = {name: _by_identity(each.tells) for name, each in answers.items()}
    places = next(iter(by_course.values()))

    def worth(names: Sequence[str]) -> float:
        found = chances({suspect: joined([by_course[name][place][1] for name in names])
                         for place, (suspect, _) in places.items()}, LEAST_RUNS)
        return sum(min(value, IDENTIFIED) for value in found.values())

    sets = [names for count in range(min(LEAST_COURSES, len(courses)), MOST_COURSES + 1)
            for names in itertools.combinations(courses, count)]
    best = max(sets, key=lambda names: worth(names) - PRICE_OF_COURSE * len(names))
    position = np.concatenate([courses[name].position for name in best])
    progress('the whole plan', 0.9)
    final = answer_of(position, sensors, limits, period, given, tolerance, scales, FITTED)
    runs = next((count for count in range(LEAST_RUNS, MOST_RUNS) if all(
        (value >= IDENTIFIED) == (most >= IDENTIFIED) for value, most in zip(
            chances(final.tells, count).values(), chances(final.tells, MOST_RUNS).values(),
            strict=True))), MOST_RUNS)
    return Planned([courses[name] for name in best], position, period, runs, final,
                   {name: chances(each.tells) for name, each in answers.items()}, usual, scales)
