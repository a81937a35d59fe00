"""
What changed since healthy recordings of the same machine.

The model fitted to them is the nominal model. The tolerances are the uncertainty of its parameters
and their spread over the healthy recordings; its residual there is the error floor.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from scipy.stats import t

from asi_analysis.arrays import Array
from asi_analysis.errors import InputError
from asi_analysis.gap.inference.fit import NOMINAL_FIELDS, Fitted, Problem, fit
from asi_analysis.gap.inference.hypotheses import Candidate, Weighed
from asi_analysis.gap.inference.posterior import Posterior, most_probable
from asi_analysis.gap.inference.probability import with_moved
from asi_analysis.gap.inference.uncertainty import interval, likelihood
from asi_analysis.gap.model.effects import OF_A_RECORDING, UNKNOWN, Free, freed, of_recording
from asi_analysis.gap.model.group import Group, Values
from asi_analysis.gap.model.predict import compared, measured, unexplained
from asi_analysis.gap.prepare import Recording

LEAST_SPREAD: Final = 1e-3    # of a parameter, relative
# By which 95 % intervals are widened, so that all of some twenty parameters lie within theirs.
RANGE_FACTOR: Final = 1.5
NEAR_STARTS: Final = (1.2, 0.85)   # initial guesses of a fit, relative to the healthy value
LEAST_PROBABILITY: Final = 0.01   # of an effect that is looked for in the healthy recordings
# Parameters of a recording that belong to the machine nevertheless.
CONSTANT: Final = ('sensor_offset', 'force_sensor_offset', 'disturbance')
# Share of the healthy signal's power, without the noise, that the model must not leave.
POOR: Final = 0.25
NUMERICAL: Final = frozenset(('maximum_substep',))
# Identified from each recording and subtracted from it before the fit.
REMOVED: Final = frozenset(('gravity_sine', 'gravity_cosine'))


class Spread(NamedTuple):
    """A parameter of the healthy machine: its value, and the range of the healthy recordings."""

    value: float
    low: float
    high: float
    unit: str = ''   # of an effect's size, as the actuator has it


class Healthy(NamedTuple):
    """The model of the healthy machine in a group of channels."""

    fitted: Fitted                # of all its recordings together
    spread: dict[str, Spread]     # by field
    # By channel, of the healthy recording with the largest: mean square residual; that as a share
    # of the signal's mean square; and in error floors.
    left: Values
    share: Values
    over_floor: Values


def healthy_of(fitted: Fitted, tolerance: float, own: Mapping[str, float]) -> Healthy:
    """
    Return the healthy machine as fitted to its recordings.

    tolerance, own: how far nominal parameters may be off at most, as a share; own: by field.
    """
    group = fitted.problem.group
    errors = {channel: np.array([_residual_power(fitted, recording, channel)
                                 for recording in group.recordings]).max(axis=0)
              for channel in group.channels}
    left, share, over = ({channel: float(each[n]) for channel, each in errors.items()}
                         for n in range(3))
    spread = {field: _spread(fitted, field, *values, own.get(field, tolerance))
              for field, values in _values(fitted, over).items()}
    return Healthy(fitted, spread, left, share, over)


def _values(fitted: Fitted, over_floor: Values) -> dict[str, tuple[list[float], list[float]]]:
    """Return, by field, the 95 % intervals of a parameter and its values in single recordings."""
    group = fitted.problem.group
    measured_floor = replace(group, error_floor={
        channel: _measured_floor(level, group.noise[channel], over_floor[channel])
        for channel, level in group.error_floor.items()})
    fitted = fitted._replace(problem=replace(fitted.problem, group=measured_floor))
    known = likelihood(fitted)
    alone = [_fitted_alone(fitted, recording) for recording in group.recordings]
    found: dict[str, tuple[list[float], list[float]]] = {}
    for free in fitted.free:
        field = free.field.partition('@')[0]
        if field not in REMOVED and (field in CONSTANT or field not in OF_A_RECORDING):
            ends, single = found.setdefault(field, ([], []))
            ends.extend(interval(fitted, known, free.field))
            single.extend(values[free.field] for values in alone if free.field in values)
    return found


def _measured_floor(level: float, noise: float, over_floor: float) -> float:
    """Return an error floor (mean square) with the model error of the healthy recordings."""
    return noise ** 2 + (level - noise ** 2) * min(over_floor, 1.0)


def _spread(fitted: Fitted, field: str, ends: Sequence[float], single: Sequence[float],
            tolerance: float) -> Spread:
    """
    Return the spread of a parameter, at most its tolerance.

    From the ends of its 95 % intervals, and from its values in single recordings: one more lies
    with 95 % within their prediction interval (Student's), which is wide if they are two.
    """
    frees = [free for free in fitted.free if free.field.partition('@')[0] == field]
    value = float(np.mean([fitted.record[free.field] for free in frees]))
    bounds = fitted.problem.parameter(frees[0])
    most = tolerance * abs(value) if field in NOMINAL_FIELDS else np.inf
    values = [*ends, *single]
    number = len(single)
    next_one = _next_within(single) if number > 1 else 0.0
    below, above = (min(max(RANGE_FACTOR * each, next_one, LEAST_SPREAD * abs(value)), most)
                    for each in (value - min(values), max(values) - value))
    return Spread(value, max(value - below, bounds.low), min(value + above, bounds.high),
                  frees[0].unit)


def _fitted_alone(fitted: Fitted, recording: Recording) -> Values:
    """Return the parameters fitted to one recording alone; {} if there is only one."""
    problem = fitted.problem
    if len(problem.group.recordings) == 1:
        return {}
    own = [number for number, free in enumerate(problem.free)
           if free.field.partition('@')[0] not in OF_A_RECORDING
           or int(free.field.partition('@')[2] or 1) == recording.number + 1]
    free, theta = tuple(problem.free[n] for n in own), fitted.theta[own]
    return _refitted(problem, replace(problem.group, recordings=[recording]), free, theta)


def _refitted(problem: Problem, group: Group, free: tuple[Free, ...], start: Array) -> Values:
    """Return the free parameters of a problem, by field, fitted to a group of one recording."""
    if not isinstance(problem, Posterior):
        return fit(group, free, [start], problem.fixed).values
    single = replace(problem, group=group, free=free)
    record = single.record(most_probable(single, start).theta)
    return {each.field: float(record[each.field]) for each in free}


def _residual_power(fitted: Fitted, recording: Recording, channel: str
                    ) -> tuple[float, float, float]:
    """Return the mean square residual; as a share of the signal's mean square; in error floors."""
    used = recording.valid
    left = float(np.mean(unexplained(recording, channel, fitted.record)[used] ** 2))
    size = float(np.mean(compared(recording, channel, measured(recording, channel))[used] ** 2))
    return left, left / max(size, 1e-300), left / fitted.problem.group.judged_floor(channel)


def shares(machine: Mapping[tuple[str, ...], Healthy]) -> Values:
    """Return how far nominal parameters differ in the healthy recordings, as a share, by field."""
    return {field: max(spread.high / spread.value - 1.0, 1.0 - spread.low / spread.value)
            for healthy in machine.values() for field, spread in healthy.spread.items()
            if field in NOMINAL_FIELDS and spread.value > 0.0}


def against(group: Group, machine: Mapping[tuple[str, ...], Healthy]) -> Group:
    """
    Return a group of other recordings whose nominal model is the healthy machine.

    Raises InputError if the healthy recordings hold other signals.
    """
    if group.channels not in machine:
        raise InputError(
            f'{group.recordings[0].source}: the healthy recordings hold other signals: here '
            f'{" and ".join(group.channels)} can be compared with a model, there '
            f'{" and ".join(sorted({name for names in machine for name in names}))}')
    healthy = machine[group.channels]
    nominal = group.nominal.copy()
    for name in nominal.dtype.names or ():
        field = name.partition('@')[0]
        if field in healthy.spread:
            nominal[name] = healthy.spread[field].value
        elif (field not in OF_A_RECORDING and field not in NUMERICAL | REMOVED
              and field in (healthy.fitted.record.dtype.names or ())):
            nominal[name] = healthy.fitted.record[field]
    simulated = isinstance(healthy.fitted.problem, Posterior)
    # Shapes of the laws that have a range of their own, and may be 0, stay free in it.
    other = [free for free in group.other_shapes if free.field in healthy.spread]
    spread = healthy.spread.keys() - {free.field for free in (*group.shapes, *other)
                                      if not free.scale}
    kept = [free for free in (*group.nuisance, *other)
            if free.field.partition('@')[0] not in spread]
    known = [_free(name, healthy.spread[field], simulated)
             for name in nominal.dtype.names or ()
             if (field := name.partition('@')[0]) in spread
             and (field not in NOMINAL_FIELDS or nominal[name] != 0.0)]
    noise, floor, before = {}, {}, healthy.fitted.problem.group
    for channel, level in group.noise.items():
        noise[channel] = max(level, before.noise[channel])
        power = float(np.mean([np.mean(compared(r, channel, measured(r, channel))[r.valid] ** 2)
                              for r in group.recordings]))
        band = group.band(channel)
        general = _measured_floor(group.error_floor[channel], level, healthy.over_floor[channel])
        floor[channel] = max(general - level ** 2 + noise[channel] ** 2,
                             healthy.left[channel] / band, healthy.share[channel] * power / band)
    effects = freed(group.effects, lambda frees: tuple(map(_with_near_starts, frees)))
    return replace(group, nominal=nominal, given=None, nuisance=(*kept, *known), noise=noise,
                   error_floor=floor, effects=effects, floor_measured=True,
                   floor_by_best=False)


def _with_near_starts(free: Free) -> Free:
    """Return a free parameter with further initial guesses near to its healthy value."""
    return free._replace(starts=(*NEAR_STARTS, *free.starts)) if free.scale == 'nominal' else free


def _free(name: str, spread: Spread, simulated: bool) -> Free:
    """Return a parameter that is free within its spread."""
    if name.partition('@')[0] not in NOMINAL_FIELDS:
        return Free(name, spread.low, spread.high, (spread.value,), '', spread.unit)
    low, high = sorted((spread.low / spread.value, spread.high / spread.value))
    if simulated:
        return Free(name, 0.05, 5.0, (1.0,), 'nominal', prior=0.5 * max(high - 1.0, 1.0 - low))
    return Free(name, low, high, (1.0,), 'nominal')


def changed_only(weighed: Weighed, healthy: Healthy) -> Weighed:
    """
    Return a group in which an effect that is as large in a healthy recording is not a change.

    Its probability goes to the hypothesis without it.
    """
    chance = dict(weighed.probability)
    for name in sorted({name for names in weighed.candidates for name in names}):
        holding = [c for names, c in weighed.candidates.items() if name in names]
        best = max(holding, key=lambda candidate: chance.get(candidate.names, 0.0))
        if (sum(p for names, p in chance.items() if name in names) < LEAST_PROBABILITY
                or not _is_healthy(name, best, weighed.group, healthy)):
            continue
        for names in [names for names in chance if name in names]:
            rest = tuple(each for each in names if each != name)
            chance = with_moved(chance, names, rest if rest in weighed.candidates else ())
    return weighed._replace(probability=chance)


def doubted(weighed: Weighed, healthy: Healthy, tolerance: float) -> tuple[Weighed, list[str]]:
    """
    Return a group whose probability of no change is partly that of an unknown one, and notes.

    tolerance: as in `_doubt_of_constant`.
    """
    doubts = [_doubt_of_constant(weighed, healthy, tolerance), _doubt_of_rest(healthy)]
    return weighed._replace(probability=with_moved(
        weighed.probability, (), (UNKNOWN,), max(each for each, _ in doubts))), [
            note for _, notes in doubts for note in notes]


def _doubt_of_constant(weighed: Weighed, healthy: Healthy, tolerance: float
                       ) -> tuple[float, list[str]]:
    """
    Return the share of no change that is an unknown one's, since a constant differs; a note.

    From half of the tolerance on it gets more probable, unless healthy recordings differ so much.

    A constant force of a joint is that of its load, which may be another one, but also that of an
    offset of the force sensor; and of a joint that moves one way, of friction and of the sensor's
    gain. tolerance: of the constant force, as a share of the healthy force (rms).
    """
    now = _constants(weighed.candidates[()].fitted, weighed.group)
    before = _constants(healthy.fitted, healthy.fitted.problem.group)
    if not now or not before:
        return 0.0, []
    known = [each for each, _ in before]
    usual, rms = float(np.mean(known)), max(rms for _, rms in before)
    differs = max(abs(each - usual) for each, _ in now)
    limit = max(tolerance * rms, 2.0 * float(np.ptp(known)))
    said, was = (', '.join(f'{each:.4g}' for each, _ in values) for values in (now, before))
    words = f'a constant force of {said}, in the healthy recordings {was}: '
    if differs > limit:
        return 0.5, [
            f'{words}another constant load and an offset of the force sensor are alike, and for '
            'a joint that moves one way friction and gain of the sensor too']
    if len(known) < 2 or differs <= max(_next_within(known), 0.5 * limit):
        return 0.0, []
    return differs / limit - 0.5, [
        f'{words}more than they differ among themselves, less than the tolerance of '
        f'{tolerance:.0%} (--tolerance)']


def _doubt_of_rest(healthy: Healthy) -> tuple[float, list[str]]:
    """
    Return the share of no change that is an unknown one's, since the model fails; a note.

    It fails if much of the healthy machine's signal is neither explained nor noise.
    """
    before = healthy.fitted.problem.group
    beyond = max((healthy.share[channel] * max(
        1.0 - before.band(channel) * before.noise[channel] ** 2 / left, 0.0)
                  for channel, left in healthy.left.items() if left > 0.0), default=0.0)
    if beyond < POOR:
        return 0.0, []
    return 0.5, [
        f'the model leaves {np.sqrt(beyond):.0%} of the signal (rms) of healthy recordings '
        'unexplained, beside their noise: a change within that is not seen']


def _next_within(values: Sequence[float]) -> float:
    """Return how far from the mean of n values one more lies at most, with 95 % (Student)."""
    number = len(values)
    return float(t.ppf(0.975, number - 1) * np.std(values, ddof=1) * np.sqrt(1.0 + 1.0 / number))


def _constants(fitted: Fitted, group: Group) -> list[tuple[float, float]]:
    """
    Return the constant force of a joint in each recording, and the rms of the whole force.

    The mean force, if only the velocity was measured: slow motion is then not judged.
    """
    free = {each.field for each in fitted.free}
    found = []
    for r in group.recordings:
        field, mean = of_recording('load_offset', r.number), r.taken.get('mean', 0.0)
        if r.force is None or r.motion is None or field not in free:
            continue
        force = r.force[r.valid] + mean
        constant = float(fitted.record[field]) + mean if r.motion.measured else float(force.mean())
        found.append((constant, float(np.sqrt(np.mean(force ** 2)))))
    return found


def _is_healthy(name: str, candidate: Candidate, group: Group, healthy: Healthy) -> bool:
    """Return whether an effect is as large in a healthy recording, within its uncertainty."""
    fitted = candidate.fitted
    field = next(form.free[0].field for form in group.effects[name]
                 if form in candidate.variants)
    usual = float(group.nominal[field])
    size = float(fitted.record[field]) - usual
    ends = interval(fitted, likelihood(fitted), field)
    as_large = max(0.5, min((end - usual) / size for end in ends)) if size else 0.0
    own = [number for number, free in enumerate(fitted.free) if '@' not in free.field]
    free = tuple(fitted.free[number] for number in own)
    for recording in healthy.fitted.problem.group.recordings:
        alone = replace(group, recordings=[replace(
            recording, number=0, cache={}, valve_errors={})])   # these are of another fit
        start = fitted.theta[own]
        at = [each.field for each in free].index(field)
        start[at] = min(max(fitted.problem.parameter(free[at]).share(usual), 0.001), 0.999)
        found = _refitted(fitted.problem, alone, free, start)
        if size and (found[field] - usual) / size >= as_large:
            return True
    return False
