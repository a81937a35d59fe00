"""The figures of a characteristic as a data sheet gives them: the section `characteristic`."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.gap.course import passes, rates
from asi_analysis.gap.diagnosis import Diagnosis
from asi_analysis.gap.model.group import Group
from asi_analysis.gap.model.static import static_signals, zero_of
from asi_analysis.reporting.result import Table

BINS, PER_BIN = 60, 20   # over the range of the input, at most; samples of each
FEWEST: Final = 3       # samples of a bin that count


def line_of(group: Group, p: np.void) -> dict[str, float]:
    """Return gain and offset (output at no input) of a fit, from the signals' own origins."""
    taken = group.recordings[0].taken
    return {'gain': float(p['gain']), 'offset': float(
        p['base'] + p['offset'] - p['gain'] * taken['input']) + taken['output']}


def branches(group: Group) -> tuple[Array, Array, Array]:
    """
    Return the centres of bins of the input, and the mean output there, rising and falling.

    Relative to the middles of the ranges; NaN in bins with too few samples. From the slowest
    recording, in which a lag has the least influence.
    """
    slowest = min(group.recordings, key=lambda r: float(np.median(rates(r))) if passes(r) else 0.0)
    x, y = slowest.input, slowest.output
    up = np.gradient(x) > 0.0
    bins = int(np.clip(x.size // PER_BIN, FEWEST, BINS))
    edges = np.linspace(x.min(), x.max(), bins + 1)
    place = np.clip(np.searchsorted(edges, x, 'right') - 1, 0, bins - 1)
    means = []
    for way in (up, ~up):
        count = np.bincount(place[way], minlength=bins)
        # At the mean input of the samples, not of the bin: else a slope would add to the width.
        within = np.bincount(place[way], x[way], bins) / np.maximum(count, 1)
        mean = np.bincount(place[way], y[way], bins) / np.maximum(count, 1)
        middle = 0.5 * (edges[1:] + edges[:-1])
        there = count >= FEWEST
        means.append(np.interp(middle, within[there], mean[there], np.nan, np.nan)
                     if there.any() else np.full(bins, np.nan))
    return middle, means[0], means[1]


def characteristic(diagnosis: Diagnosis) -> dict[str, Any]:
    """
    Return the figures of the characteristic, in % of the span of the recordings.

    As measured: loop, the largest difference between up and down, of any cause, divided by the
    gain, in % of the input's span; linearity, the largest deviation of the mean of both from the
    best straight line, in % of the output's span. From the verdict: hysteresis (without the
    contribution of a lag), threshold (from a reversal of the input until the output follows), dead
    band, limits. None: not found.
    """
    weighed, run = diagnosis.groups[0], diagnosis.runs[0]
    group, best = weighed.group, diagnosis.best(weighed)
    given, got = static_signals(run)
    x, up, down = branches(group)
    spans = [2.0 * group.scale[name] for name in ('command', 'valve_position')]
    p, taken = best.fitted.record, group.recordings[0].taken
    apart = np.abs(up - down)[np.isfinite(up - down)]
    middle = 0.5 * (up + down)
    middle = np.where(np.isfinite(middle), middle, np.where(np.isfinite(up), up, down))
    there = np.isfinite(middle)
    line = np.polyfit(x[there], middle[there], 1) if there.sum() > 1 else np.zeros(2)
    off = np.abs(middle[there] - np.polyval(line, x[there]))

    def limit(field: str) -> float | None:
        """Return a limit of the output, in its unit; None: there is none."""
        return float(p[field]) + zero_of(group, field) if p[field] != 0.0 else None

    return {
        'input': given, 'input_unit': run.unit(given), 'output': got,
        'output_unit': run.unit(got), **line_of(group, p),
        'input_low': taken['input'] - 0.5 * spans[0],
        'input_high': taken['input'] + 0.5 * spans[0],
        'output_low': taken['output'] - 0.5 * spans[1],
        'output_high': taken['output'] + 0.5 * spans[1],
        'loop_percent': None if apart.size < FEWEST else (
            100.0 * float(apart.max()) / abs(float(p['gain'])) / spans[0]),
        'hysteresis_percent': (200.0 * float(p['loop_width']) / spans[0]
                               if p['loop_width'] > 0.0 else None),
        'linearity_percent': (100.0 * float(off.max()) / spans[1] if off.size > FEWEST else None),
        'threshold_percent': (200.0 * float(p['loop_width'] * (1.0 - p['loop_spread'])) / spans[0]
                              if p['loop_width'] > 0.0 and p['loop_share'] > 0.99 else None),
        'deadband_percent': (200.0 * float(p['command_deadband']) / spans[0]
                             if p['command_deadband'] > 0.0 else None),
        'saturation_low': limit('limit_below'), 'saturation_high': limit('limit_above')}


def figures(found: Mapping[str, Any]) -> Table:
    """Return the figures as a table."""
    rows = [(words, f'{found[key]:.3g} %') for key, words in (
        ('loop_percent', 'way up against way down, whatever the cause, of the span of the input'),
        ('hysteresis_percent', 'hysteresis, of the span of the input'),
        ('deadband_percent', 'dead band, of the span of the input'),
        ('threshold_percent', 'threshold (reversal), of the span of the input'),
        ('linearity_percent', 'deviation from a straight line, of the span of the output'))
        if found[key] is not None]
    return Table(('characteristic', 'as measured'), rows, 'figures of a data sheet',
                 ('as measured',))
