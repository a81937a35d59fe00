"""
Model error and tolerances of a machine whose laws may not be formulated as the simulator's.

Textbooks formulate friction, hysteresis and damping in several ways. With another formulation a
model error remains, and a nominal parameter has a slightly different meaning.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.gap.model.effects import DOTTED, Free
from asi_analysis.gap.model.group import NOISIER, Group, Values, least_error

TOLERANCE_FACTOR = 1.5    # of nominal parameters, with laws formulated in another way
MODEL_SAMPLES = 25.0      # effective sample size of the model error of a channel


def with_formulation(group: Group, other: bool) -> Group:
    """
    Return a group with the error floor and tolerances of the simulator's own laws, or of others.

    other: the laws are formulated in another way. Then the error floor holds a model error, which
    has a small effective sample size, and the nominal parameters have wider tolerances.
    """
    if group.other_formulation == other or group.floor_measured:
        return group
    floor, weight = {}, {}
    for channel, noise in group.noise.items():
        own = group.error_floor[channel] - (group.other_error[channel] if not other else 0.0)
        floor[channel] = own + (group.other_error[channel] if other else 0.0)
        count = sum(int(r.known.sum()) for r in group.recordings) * group.judged_share[channel]
        model = 1.0 - noise ** 2 / floor[channel]
        weight[channel] = 1.0 / (1.0 + count * model / MODEL_SAMPLES) if other else 1.0
    moved = replace(group, other_formulation=other, error_floor=floor, weight=weight)
    return replace(moved, nuisance=with_tolerance_of_formulation(group.nuisance, group, moved))


def with_lower_floor(group: Group, residual: Values) -> Group:
    """
    Return a group whose error floor is at most the residual of a model, down to LEAST_ERROR.

    residual: mean square by channel. A machine that is the simulator itself, recorded without
    noise, shows that there is hardly a model error. One of laws formulated in another way has
    that of these laws, and a baseline has the one that was measured.
    """
    if group.other_formulation or group.floor_measured:
        return group
    # A signal that is 0 shows nothing.
    floor = {channel: min(level, max(residual[channel], least_error(group, channel))) or level
             for channel, level in group.error_floor.items()}
    if all(floor[channel] >= NOISIER ** 2 * level
           for channel, level in group.error_floor.items()):
        return group
    return replace(group, error_floor=floor, noise={
        channel: min(level, math.sqrt(floor[channel])) for channel, level in group.noise.items()})


def with_tolerance_of_formulation(frees: Sequence[Free], before: Group, after: Group
                            ) -> tuple[Free, ...]:
    """
    Return free parameters with their tolerance after a change of the group's formulation.

    Only the parameters of the laws that have several formulations mean something else in another.
    """
    wider = TOLERANCE_FACTOR if after.may_differ else 1.0
    ratio = wider ** (after.other_formulation - before.other_formulation)
    return tuple(free._replace(prior=ratio * free.prior) if is_of_law(free, after) else free
                 for free in frees)


def is_of_law(free: Free, group: Group) -> bool:
    """Return whether a nominal parameter is of a law that books formulate in several ways."""
    def block(field: str) -> str:
        return DOTTED.get(field, '').partition('.')[0]

    return free.scale == 'nominal' and block(free.field) in {
        block(shape.field) for shape in group.shapes}


def model_error(group: Group) -> Array:
    """Return the mean square model error of each channel, in error floors."""
    return np.array([1.0 - group.noise[channel] ** 2 / group.error_floor[channel]
                     for channel in group.channels])


def with_usual_shapes(group: Group, frees: Sequence[Free]) -> tuple[Free, ...]:
    """Return free parameters with the simulator's own shapes of the laws, or near to them."""
    usual = {free.field: free for free in group.usual_shapes}
    shapes = (*group.shapes, *group.other_shapes)
    return tuple(usual.get(free.field, free) if free in shapes else free for free in frees
                 if free not in shapes or free.field in usual)
