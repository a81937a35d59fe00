"""Friction of a joint, with a size at the least that its name allows, is the simpler friction."""

import math
from collections.abc import Mapping
from typing import Final

from asi_analysis.gap.inference.fit import AT_LIMIT
from asi_analysis.gap.inference.probability import Names, with_moved
from asi_analysis.gap.inference.related import Candidate
from asi_analysis.gap.inference.uncertainty import end, likelihood
from asi_analysis.gap.model.effects import UNKNOWN

SIMPLE: Final = 'coulomb_friction'
# The size that makes another friction of it.
DISTINGUISHED_BY: Final = {'stiction': 'friction_breakaway',
                           'friction_asymmetry': 'friction_asymmetry'}
# Only an effect that is so probable is worth its interval.
LEAST: Final = 0.01


def as_simple_friction(chance: Mapping[Names, float], candidates: Mapping[Names, Candidate]
                       ) -> dict[Names, float]:
    """
    Return the probabilities of hypotheses; a simpler one gets half of what it may be instead.

    So where the interval of the size that makes it another friction reaches the least allowed:
    smaller sizes are those of the simpler one.
    """
    moved = dict(chance)
    for names, found in candidates.items():
        own = next((name for name in names if name in DISTINGUISHED_BY), None)
        simple = tuple(sorted({*names, SIMPLE} - {own}))
        if own is None or SIMPLE in names or simple not in candidates:
            continue
        beside = [(names, simple), (tuple(sorted((*names, UNKNOWN))),
                                    tuple(sorted((*simple, UNKNOWN))))]
        if sum(chance.get(each, 0.0) for each, _ in beside) < LEAST:
            continue
        if not _may_be_simple(own, found, candidates[simple]):
            continue
        for each, to in beside:
            moved = with_moved(moved, each, to, 0.5)
    return moved


def _may_be_simple(name: str, found: Candidate, simple: Candidate) -> bool:
    """Return whether a friction may be the simple one."""
    fitted, theta = found.fitted, found.fitted.theta
    number = next((number for number, free in enumerate(fitted.free)
                   if free.field == DISTINGUISHED_BY[name]), None)
    if number is None or fitted.free[number].low <= 0.0 <= fitted.free[number].high:
        return False   # 0 is the least size
    if 'viscous_asymmetry' in fitted.values:
        return False   # which symmetric friction has not
    if name == 'friction_asymmetry' and any(
            'constant' in recording.taken for recording in fitted.problem.group.recordings):
        return False   # with a constant load, its own constant force was removed
    low, high = fitted.free[number].low, fitted.free[number].high
    least = min(low, high, key=abs)
    bound = 0.0 if least == low else 1.0
    if abs(theta[number] - bound) < AT_LIMIT or (
            name == 'friction_asymmetry' and _balanced(simple, abs(least))):
        return True
    return bool(end(likelihood(fitted), theta, number, bound) == bound)


def _balanced(simple: Candidate, least: float) -> bool:
    """
    Return whether the constant force beside symmetric friction is too small for an asymmetric one.

    Asymmetric friction makes that force. It may be in the load or, at the middle, in gravity.
    """
    values = simple.fitted.values
    loads = [value for field, value in values.items()
             if field.partition('@')[0] == 'load_offset']
    middle = simple.fitted.problem.group.recordings[0].taken.get('middle', 0.0)
    gravity = (values.get('gravity_sine', 0.0) * math.sin(middle)
               + values.get('gravity_cosine', 0.0) * math.cos(middle))
    most = least * values.get('friction_level', 0.0)
    return bool(loads) and all(abs(load + more) < most
                               for load in loads for more in (0.0, gravity))
