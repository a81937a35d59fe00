"""The report of `asi demo`: one HTML file that needs nothing else, and its pictures as PNG."""

from pathlib import Path
from typing import Any, Final, NamedTuple

import jinja2
import numpy as np
from matplotlib.figure import Figure

from asi_analysis import figures
from asi_analysis.demo import (
    Loop,
    Published,
    Recorded,
    hysteresis_loop,
    limit_cycle,
    scaled,
)
from asi_analysis.experiment import versions
from asi_controller.compensator import OWN_GAIN

# Published and simulated figures that differ by less are called alike.
ALIKE: Final = 0.25
# A share of a bound that counts as far below it, for the paper's "≪".
FAR_BELOW: Final = 0.1
DESCRIPTIONS: Final = {
    'step_responses': 'Force and valve command after a step, with three compensators',
    'limit_cycle': 'Force of the limit cycle in time: the whole run and its last cycles',
    'phase_plane': 'Phase plane of the limit cycle: force rate against force',
    'spectrum': 'Spectrum of the force in the limit cycle',
    'hysteresis': 'Loop of valve position against valve command'}


class Cell(NamedTuple):
    published: str
    simulated: str
    verdict: str
    alike: bool


def write_demo_report(recorded: list[Recorded], out: Path) -> Path:
    """Write report.html and the PNGs into `out`; return the path of report.html."""
    by_name = {each.plan.name: each for each in recorded}
    cycle_run, loop_run = by_name['limit_cycle'], by_name['hysteresis']
    swing = cycle_run.analysis['oscillation']
    cycle = limit_cycle(cycle_run, swing['frequency_hz']) if swing['frequency_hz'] else None
    loop = hysteresis_loop(loop_run)
    drawn = {'step_responses': _steps(recorded), 'hysteresis': _hysteresis(loop)}
    if cycle:
        run = cycle_run.run
        drawn |= {
            'limit_cycle': figures.oscillation_in_time(
                run.time_s, run.signal('force'), run.signal('reference'),
                8.0 / cycle.frequency_hz),
            'phase_plane': figures.phase_plane(run.time_s, run.signal('force'), cycle.steady),
            'spectrum': figures.spectrum(*cycle.spectrum, cycle.harmonics,
                                         9.5 * cycle.frequency_hz)}
    for name, figure in drawn.items():
        with figures.style():
            figure.savefig(out / f'{name}.png')
    page = out / 'report.html'
    page.write_text(environment().get_template('demo.html').render(
        rows=[(each.plan.title, [compare(each.analysis, entry)
                                 for entry in each.plan.published])
              for each in recorded if each.plan.published],
        quantities=[f'{entry.quantity} ({entry.unit})' for entry in recorded[0].plan.published],
        shapes=[(each.plan.title, each.analysis['rise_shape']) for each in recorded
                if each.analysis['monotone_rise'] is False and each.plan.published],
        steps=[(each.plan.title, float(each.experiment.controller['reference.amplitude']),
                _load(each)) for each in recorded if each.plan.published],
        cycle=cycle, swing=swing,
        cycle_run=cycle_run, loop=loop, loop_run=loop_run, recorded=recorded,
        gains={each.plan.name: _gain(each) for each in recorded},
        delay_ms=_delay_ms(recorded[0]), versions=versions(),
        figures={name: figures.svg(figure, DESCRIPTIONS[name])
                 for name, figure in drawn.items()}))
    return page


def _steps(recorded: list[Recorded]) -> Figure:
    curves = {}
    for each in recorded:
        if each.plan.published:
            step = each.analysis['steps'][0]
            share = 100.0 / (step['final_n'] - step['initial_n'])
            curves[each.plan.title] = (each.run.time_s - step['time_s'],
                                       share * each.run.signal('force'),
                                       share * each.run.signal('command'))
    return figures.step_responses(curves, 0.25)


def _hysteresis(loop: Loop) -> Figure:
    return figures.hysteresis_loop(loop.command_n, loop.valve_position_m,
                                   (loop.slope_m_n, loop.offset_m), loop.width_n)


def compare(analysis: dict[str, Any], entry: Published) -> Cell:
    """Put our figure beside the published one and say plainly how they differ."""
    value = scaled(analysis, entry)
    if value is None:
        return Cell(entry.words, '-', 'not reached', False)
    text = (f'{value:.3g}' if abs(value) >= 0.01 else '0').replace('-', '−')
    if entry.words.startswith(('<', '≪')):
        if abs(value) >= entry.value:
            return Cell(entry.words, text, 'larger', False)
        met = entry.words.startswith('<') or abs(value) < FAR_BELOW * entry.value
        return Cell(entry.words, text, 'as published' if met else 'below, not far below', met)
    if entry.value == 0.0:
        return Cell(entry.words, text, 'alike' if abs(value) < 2.0 else f'{value:.1f} more',
                     abs(value) < 2.0)
    ratio = abs(value) / entry.value
    if abs(ratio - 1.0) < ALIKE:
        return Cell(entry.words, text, 'alike', True)
    smaller, larger = ('shorter', 'longer') if entry.unit == 'ms' else ('smaller', 'larger')
    return Cell(entry.words, text, f'{ratio:.1f} times {larger}' if ratio > 1.0
                 else f'{1.0 / max(ratio, 1e-3):.1f} times {smaller}', False)


def _gain(recorded: Recorded) -> float:
    """Return the gain that was in use."""
    values = recorded.experiment.controller
    return float(values['gain']) or OWN_GAIN[str(values['compensator'])]


def _load(recorded: Recorded) -> str:
    """Say what the piston pushes against."""
    values = recorded.experiment.actuator
    if values['load.type'] == 'locked':
        return 'piston locked'
    return (f'spring of {float(values["load.stiffness"]) / 1e3:.3g} kN/m, '
            f'{float(values["load.mass"]):.3g} kg, {float(values["load.damping"]):.3g} N s/m')


def _delay_ms(recorded: Recorded) -> float:
    """Return the transport delay in the loop (ms): the model's two; lock-step adds none."""
    values = recorded.experiment.actuator
    return 1e3 * (float(values['valve_flexure.delay']) + float(values['force_sensor.delay']))


def environment() -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader('asi_analysis'), autoescape=True,
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters['figure'] = lambda value, digits=3: (
        '-' if value is None else np.format_float_positional(
            value, digits, fractional=False, trim='-'))
    return environment
