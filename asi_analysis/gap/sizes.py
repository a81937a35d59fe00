"""Sizes of effects with their intervals, and nominal parameters at a limit of their tolerance."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from asi_analysis.gap.diagnosis import Diagnosis
from asi_analysis.gap.inference.fit import AT_LIMIT, Fitted
from asi_analysis.gap.inference.probability import marginals
from asi_analysis.gap.inference.uncertainty import (
    Likelihood,
    at_limit,
    interval,
    likelihood,
)
from asi_analysis.gap.model.effects import DOTTED, Free, fields_of
from asi_analysis.gap.model.static import zero_of
from asi_analysis.gap.words import UNITS, unit_of, unit_of_free


def _holding(diagnosis: Diagnosis, name: str) -> tuple[Fitted, tuple[Free, ...]] | None:
    """Return the fit of the best hypothesis that holds an effect, and the effect's parameters."""
    # Of an effect in several groups of channels: the one in which it is most probable.
    for weighed in sorted(diagnosis.groups, reverse=True,
                          key=lambda w: (marginals(w.probability).get(name, 0.0),
                                         w.group.channels == ('load',))):
        holding = [candidate for names, candidate in weighed.candidates.items() if name in names]
        if holding:
            own = diagnosis.best(weighed)
            chosen = own if name in own.names else max(
                holding, key=lambda c: weighed.probability.get(c.names, 0.0))
            frees = tuple(free for form in weighed.group.effects[name]
                          if form in chosen.variants for free in form.free)
            if frees:   # else it is seen here as another effect
                return chosen.fitted, frees
    return None


def is_shown(fitted: Fitted, field: str) -> bool:
    """Return whether recordings show a size: not a limit that their reference never reaches."""
    if field not in ('servo_upper', 'servo_lower'):
        return True
    reference = np.concatenate([r.input[r.valid] for r in fitted.problem.group.recordings])
    limit = fitted.values[field]
    return bool(reference.max() > limit if field == 'servo_upper' else reference.min() < limit)


def sizes_of(diagnosis: Diagnosis, names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return the fitted parameters of effects, by effect: values, intervals, units, limits."""
    known: dict[int, Likelihood] = {}   # shared by all effects of a hypothesis
    sizes: dict[str, dict[str, Any]] = {}
    for name in names:
        row: dict[str, Any] = {key: {} for key in (
            'parameters', 'parameters_low', 'parameters_high', 'units', 'nominal', 'tolerance')}
        sizes[name] = row | {'at_limit': []}
        fitted, frees = _holding(diagnosis, name) or (None, ())
        if fitted is None:
            continue
        if id(fitted) not in known:
            known[id(fitted)] = likelihood(fitted)
        group = fitted.problem.group
        of_the_effect = {free.field: free for free in frees}
        for free, share in zip(fitted.free, fitted.theta, strict=True):
            if (field := free.field) not in of_the_effect or not is_shown(fitted, field):
                continue
            zero = zero_of(group, field)
            row['parameters'][field] = fitted.values[field] + zero
            row['parameters_low'][field], row['parameters_high'][field] = (
                each + zero for each in interval(fitted, known[id(fitted)], field))
            own = of_the_effect[field]
            row['units'][field] = unit_of_free(own, group.channels[0], diagnosis.runs[0],
                                               diagnosis.plant)
            if own.scale == 'nominal':
                row['nominal'][field] = float(group.as_given[field])
                row['tolerance'][field] = diagnosis.tolerances.get(field, diagnosis.tolerance)
            if share > 1.0 - AT_LIMIT or (share < AT_LIMIT and free.low != 0.0):
                sizes[name]['at_limit'].append(field)
    return sizes


def limits_of(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Return the nominal parameters at a limit of their tolerance in the fit of the verdict."""
    return [{'parameter': DOTTED[field], 'channel': weighed.group.channels[-1],
             'value': float(best.fitted.record[field]),
             'nominal': float(weighed.group.nominal[field]),
             'unit': unit_of(UNITS[field], weighed.group.channels[-1], diagnosis.runs[0],
                             diagnosis.plant),
             'limit': limit}
            for weighed in diagnosis.groups for best in [diagnosis.best(weighed)]
            for field, limit in at_limit(best.fitted).items()
            if field not in fields_of(best.variants)]
