"""What `asi quench` says of a compensator, as one plain dictionary."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from asi_analysis.limit_cycle.quench.attack import Trial, search
from asi_analysis.limit_cycle.quench.design import design
from asi_analysis.limit_cycle.quench.dither import dither
from asi_analysis.limit_cycle.quench.margin import margin
from asi_analysis.loop.simulation import Values, step_run, sustained
from asi_analysis.terminal import Progress, silent

WORST: Final = 5


def quench(actuator: Values, controller: Values, rates_hz: Sequence[float], count: int,
           seed: int, designs: int = 0, replayed: tuple[int, Path] | None = None,
           report: Progress = silent) -> dict[str, Any]:
    """
    Return all that `asi quench --json` prints.

    rates_hz: control rates of the attack, the first is that of margin, dither and design; count:
    conditions tried; designs: candidates of the design helper, 0 for none; replayed: how many of
    the worst finds to run over ROS, and the directory for their bags.
    """
    rate = rates_hz[0]
    report('margin', None)
    found = margin(actuator, controller, rate)
    trials = search(actuator, controller, tuple(rates_hz), count, seed, report)
    lasting = [trial for trial in trials if trial.sustained]
    document: dict[str, Any] = {
        'compensator': str(controller.get('compensator', 'proportional')),
        'rate_hz': rate, 'margin': found.distance,
        'margin_at': {'amplitude_n': found.amplitude_n, 'bias_n': found.bias_n,
                      'frequency_hz': found.frequency_hz, 'load': found.load},
        'conditions_tried': count, 'sustained_found': len(lasting),
        'worst_amplitude_n': _finite(lasting[0].amplitude_n) if lasting else 0.0,
        'worst': [_trial(trial, tuple(rates_hz)) for trial in trials[:WORST]],
        'replayed': [], 'dither': [], 'design': None}
    if replayed:
        from asi_analysis.limit_cycle.quench.replay import replay
        document['replayed'] = replay(trials[:replayed[0]], controller, actuator,
                                      tuple(rates_hz), replayed[1], report)
    swing = sustained(step_run(actuator, controller, rate))
    if swing is not None:
        # Only what cycles can be quenched by dither.
        document['dither'] = dither(actuator, controller, rate, report=report)
    if designs:
        document['design'] = design(actuator, controller, rate, designs, seed, report)
    return document


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _trial(trial: Trial, rates_hz: tuple[float, ...]) -> dict[str, Any]:
    return {'amplitude_n': _finite(trial.amplitude_n), 'sustained': trial.sustained,
            'frequency_hz': _finite(trial.found.frequency_hz),
            'condition': trial.condition.settings(rates_hz)}


def as_text(document: dict[str, Any]) -> str:
    """Return the answer for people."""
    at = document['margin_at']
    lines = [f'{document["compensator"]} at {document["rate_hz"]:g} Hz',
             f'margin {document["margin"]:.3g}, least at {at["frequency_hz"]:.3g} Hz, amplitude '
             f'{at["amplitude_n"]:.3g} N, bias {at["bias_n"]:g} N, load {at["load"]}',
             f'{document["sustained_found"]} sustained oscillations in '
             f'{document["conditions_tried"]} conditions'
             + (f', the largest {document["worst_amplitude_n"]:.3g} N'
                if document['sustained_found'] and document['worst_amplitude_n'] else '')]
    for worst in document['worst'][:3]:
        if not worst['sustained']:
            continue
        c, r = worst['condition'], worst['condition']['reference']
        size = worst['amplitude_n']
        lines.append(f'  {"unbounded" if size is None else f"{size:.3g} N"} at '
                     f'{c["rate_hz"]:g} Hz control, load {c["actuator"]["load.type"]}, '
                     f'{r["reference.shape"]} of {r["reference.amplitude"]:.0f} N about '
                     f'{r["reference.offset"]:.0f} N')
    lines += [f'over ROS: {row["bag"]}: {row["verdict"]} ({row["why"]})'
              + (f', {row["amplitude_n"]:.3g} N at {row["frequency_hz"]:.4g} Hz'
                 if row['amplitude_n'] is not None else '') for row in document['replayed']]
    for row in document['dither']:
        lines.append(f'dither of {row["frequency_hz"]:g} Hz: ' + (
            f'none quenches; {row["least_left_at_n"]:.0f} N leaves least of the cycle, '
            f'{100 * row["least_left"]:.0f} %' if row['amplitude_n'] is None else
            f'{row["amplitude_n"]:.0f} N quenches; valve travel '
            f'{1e3 * row["valve_travel_m_s"]:.3g} mm/s, force ripple '
            f'{row["force_ripple_n"]:.3g} N rms'))
    if document['design']:
        for name in ('rival', 'best'):
            d = document['design'][name]
            lines.append(f'{name}: rise {1e3 * d["rise_time_s"]:.3g} ms, overshoot '
                         f'{d["overshoot_percent"]:.2g} %, settling '
                         f'{1e3 * d["settling_time_2_s"]:.3g} ms, error '
                         f'{d["steady_state_error_n"]:.2g} N, margin {d["margin"]:.3g}')
        lines.append('  ' + ', '.join(
            f'{name} = {value:.4g}' if isinstance(value, float) else f'{name} = {value}'
            for name, value in document['design']['best']['controller'].items()))
    return '\n'.join(lines)
