"""What has changed since the healthy recordings: the section `baseline` of the answer."""

from typing import Any

from asi_analysis.gap.baseline import Spread
from asi_analysis.gap.diagnosis import Diagnosis
from asi_analysis.gap.document import hypothesis_name
from asi_analysis.gap.inference.hypotheses import Weighed
from asi_analysis.gap.inference.probability import ambiguity_set
from asi_analysis.gap.inference.uncertainty import interval, likelihood
from asi_analysis.gap.model.effects import DOTTED
from asi_analysis.gap.words import SIZES, signal_of, unit_of_free

NONE, CHANGED, UNDECIDED = 'none', 'changed', 'cannot_tell'


def changes(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return what has changed, and what is within the spread of the healthy recordings."""
    healthy = diagnosis.healthy
    assert healthy is not None
    likely = ambiguity_set(diagnosis.joined)
    return {
        'change': CHANGED if () not in likely else NONE if likely == [()] else UNDECIDED,
        'sources': [run.source for run in healthy.runs],
        'verdict': hypothesis_name(healthy.verdict),
        'parameters': [row for weighed in diagnosis.groups for row in _rows(diagnosis, weighed)],
        'left': [{'channel': shrink.channel,
                  'signal': signal_of(shrink.channel, diagnosis.runs[0],
                                      diagnosis.plant),
                  'healthy_nrmse': machine.share[shrink.channel] ** 0.5,
                  # A refit within the spread may absorb much of a change.
                  'now_nrmse': shrink.nominal if diagnosis.verdict else shrink.refitted}
                 for machine in diagnosis.machine.values() for shrink in diagnosis.shrinks
                 if shrink.channel in machine.left]}


def _rows(diagnosis: Diagnosis, weighed: Weighed) -> list[dict[str, Any]]:
    """Return the parameters of a group of channels, those that have changed first."""
    group, best = weighed.group, diagnosis.best(weighed)
    spread, fitted = diagnosis.machine[group.channels].spread, best.fitted
    freed = {free.field: free for variant in best.variants for free in variant.free}
    assert diagnosis.healthy is not None
    named = [*best.names, *diagnosis.healthy.verdict]
    known, rows = likelihood(fitted), []
    for free in fitted.free:
        name = free.field.partition('@')[0]
        if name not in SIZES | DOTTED:
            continue
        low, high = interval(fitted, known, free.field)
        before = spread.get(name, Spread(*3 * (float(group.nominal[free.field]),)))
        rows.append({
            'parameter': DOTTED.get(name, name), 'effect': None if name in DOTTED else next(
                (effect for effect, forms in group.effects.items() if effect in named
                 and any(name == each.field.partition('@')[0] for variant in forms
                         for each in variant.free)), None),
            'recording': free.field.partition('@')[2] or None,
            'unit': unit_of_free(freed.get(free.field, free), group.channels[0],
                                 diagnosis.runs[0], diagnosis.plant),
            'healthy': before.value, 'healthy_low': before.low, 'healthy_high': before.high,
            'now': float(fitted.record[free.field]), 'now_low': low, 'now_high': high,
            'changed': free.field in freed and not (low <= before.high and high >= before.low)})
    return sorted(rows, key=lambda row: not row['changed'])
