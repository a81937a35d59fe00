"""
A group of the simulator whose laws are its own, or are formulated as in other books.

What other formulations may leave, and how far nominal parameters may be off in them.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.gap.model.effects import Free
from asi_analysis.gap.model.group import Group

MEANT = 1.5               # times as wide is the tolerance of a nominal parameter of other books
MODEL_SAMPLES = 100.0     # effective samples of the model error of a channel


def of_books(group: Group, other: bool) -> Group:
    """
    Return a group of the simulator whose laws are its own, or those of `other` books.

    The error of these is that of any model, and of few independent samples; nominal parameters
    mean a little else in them, and have a wider tolerance.
    """
    if group.other_books == other or group.floor_measured:
        return group
    floor, weight = {}, {}
    for channel, noise in group.noise.items():
        own = group.error_floor[channel] - (group.other_error[channel] if not other else 0.0)
        floor[channel] = own + (group.other_error[channel] if other else 0.0)
        count = sum(int(r.known.sum()) for r in group.recordings) * group.judged_share[channel]
        model = 1.0 - noise ** 2 / floor[channel]
        weight[channel] = 1.0 / (1.0 + count * model / MODEL_SAMPLES) if other else 1.0
    moved = replace(group, other_books=other, error_floor=floor, weight=weight)
    return replace(moved, nuisance=with_tolerance_of_books(group.nuisance, group, moved))


def with_tolerance_of_books(frees: Sequence[Free], before: Group, after: Group
                            ) -> tuple[Free, ...]:
    """Return free parameters with their tolerance in a group after the books were changed."""
    ratio = MEANT ** (after.other_books - before.other_books)
    return tuple(free._replace(prior=ratio * free.prior) if free.scale == 'nominal' else free
                 for free in frees)


def model_error(group: Group) -> Array:
    """Return the mean square model error of each channel, in error floors."""
    return np.array([1.0 - group.noise[channel] ** 2 / group.error_floor[channel]
                     for channel in group.channels])


def with_usual_shapes(group: Group, frees: Sequence[Free]) -> tuple[Free, ...]:
    """Return free parameters; those of the shapes of the laws only as uncertain as all others."""
    usual = {free.field: free for free in group.usual_shapes}
    return tuple(usual.get(free.field, free) if free in group.shapes else free for free in frees
                 if free not in group.shapes or free.field in usual)
