"""The JSON document of a diagnosis: `document`."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from asi_analysis.gap.diagnosis import Diagnosis
from asi_analysis.gap.findings import localisation
from asi_analysis.gap.findings.shrink import Shrink
from asi_analysis.gap.inference.probability import Names, ambiguity_set, marginals
from asi_analysis.gap.model.effects import DOTTED, NO_GAP, PARAMETER, UNKNOWN, block_of
from asi_analysis.gap.model.group import SIMULATOR_ERROR, VALVE_GAIN
from asi_analysis.gap.model.simulator import VALVE_ERROR
from asi_analysis.gap.sizes import limits_of, sizes_of
from asi_analysis.gap.words import signal_of, unit_of


def hypothesis_name(names: Names) -> str:
    """Return the name of a hypothesis: effects joined by +, `unknown`, or `no_gap`."""
    return '+'.join(names) if names else NO_GAP


def main_shrink(diagnosis: Diagnosis) -> Shrink:
    """Return the shrink of the channel in which the verdict explains most, in noise floors."""
    shown = list(diagnosis.shrinks)
    # The residual of the refitted model counts, unless it is noise on every channel.
    visible = any(shrink.refitted > max(shrink.noise_floor, SIMULATOR_ERROR) for shrink in shown)

    def explained(shrink: Shrink) -> float:
        before = shrink.refitted if visible else shrink.nominal
        return (before ** 2 - shrink.after ** 2) / max(shrink.noise_floor, 1e-9) ** 2

    if not diagnosis.verdict or UNKNOWN in diagnosis.verdict:
        return max(shown, key=lambda shrink: (
            shrink.refitted if diagnosis.verdict else shrink.nominal
        ) / max(shrink.noise_floor, 1e-9))
    named = {channel for weighed in diagnosis.groups if diagnosis.best(weighed).names
             for channel in weighed.group.channels}
    if PARAMETER + DOTTED[VALVE_GAIN] in diagnosis.verdict:   # found with what follows the valve
        named.add('valve')
    return max([shrink for shrink in shown if shrink.channel in named] or shown, key=explained)


def document(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the answer as `asi gap --json` prints it; plain data."""
    chance = marginals(diagnosis.joined)
    # The effects of the verdict first, by their probability as single effects.
    alone = {name: max(w.probability.get((name,), 0.0) for w in diagnosis.groups)
             for name in chance}
    listed = [name for name in sorted(chance.keys() - {NO_GAP, UNKNOWN}, key=lambda n: (
        n not in diagnosis.verdict, -alone[n] if n in diagnosis.verdict else -chance[n], n))
        if chance[name] > 0.001]
    sizes = sizes_of(diagnosis, listed)
    which = [{'effect': name, 'block': block_of(name), 'probability': chance[name], **sizes[name]}
             for name in listed]
    ambiguous = ambiguity_set(diagnosis.joined)
    main = main_shrink(diagnosis)
    errors = {shrink.channel: {
        'channel': shrink.channel, 'signal': signal_of(shrink.channel, diagnosis.runs[0],
                                                       diagnosis.plant),
        'before_nrmse': shrink.nominal, 'refitted_nrmse': shrink.refitted,
        'after_nrmse': shrink.after, 'noise_floor_nrmse': shrink.noise_alone,
        'shrink': shrink.shrink, 'shrink_low': shrink.low, 'shrink_high': shrink.high,
        'edge_hz': shrink.edge_hz}
        for shrink in diagnosis.shrinks}
    weighed = diagnosis.compared(main.channel)
    best = diagnosis.best(weighed).fitted.record
    regimes = localisation.by_regime(weighed.group, main.channel,
                                     weighed.candidates[()].fitted.record, best)
    unexplained = None
    if UNKNOWN in diagnosis.verdict or UNKNOWN in {name for names in ambiguous for name in names}:
        unexplained = localisation.in_words(
            regimes, localisation.dependence(weighed.group, main.channel, best),
            localisation.ripple(weighed.group, main.channel, best),
            unit_of('m', main.channel, diagnosis.runs[0], diagnosis.plant))
    return {
        'verdict': hypothesis_name(diagnosis.verdict), 'plant': diagnosis.plant,
        'probability': diagnosis.joined[diagnosis.verdict],
        'where': [{'block': block, 'share': share}
                  for block, share in localisation.by_block(diagnosis.groups).items()],
        'which': which,
        'no_gap_probability': chance[NO_GAP], 'unknown_probability': chance[UNKNOWN],
        'ambiguity_set': [hypothesis_name(names) for names in ambiguous],
        'gap': errors[main.channel], 'channels': list(errors.values()),
        'chain': diagnosis.chain,
        'regimes': [regime._asdict() for regime in regimes],
        'unexplained': unexplained,
        'consequences': [], 'baseline': None, 'characteristic': None,
        'next_experiment': diagnosis.next_experiment, 'at_limit': limits_of(diagnosis),
        'notes': diagnosis.notes, 'sources': [run.source for run in diagnosis.runs],
        'nuisance': {weighed.group.channels[-1]: {
            free.field: float(diagnosis.best(weighed).fitted.record[free.field])
            for free in weighed.group.nuisance if not free.field.startswith(VALVE_ERROR)}
            for weighed in diagnosis.groups},
    }


def plain(value: Any) -> Any:
    """Return a document with numpy numbers as plain ones and without infinities."""
    if isinstance(value, Mapping):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
