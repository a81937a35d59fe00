"""The report of `asi demo`."""

from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from asi_analysis.bags.run import Run
from asi_analysis.demo.hidden_effect import HIDDEN, NOISE, SHOWN_S, FoundEffect
from asi_analysis.demo.runs import (
    Cycle,
    Loop,
    Published,
    Recorded,
    hysteresis_loop,
    limit_cycle,
    scaled,
)
from asi_analysis.gap.answer import pictures
from asi_analysis.gap.answer.report import chances
from asi_analysis.gap.words import sentences
from asi_analysis.reporting import figures
from asi_analysis.reporting.report import write_report
from asi_controller.compensator import OWN_GAIN

# Relative difference below which published and simulated figures are called similar.
SIMILAR: Final = 0.25
# Share of a bound that counts as far below it, for the paper's "≪".
FAR_BELOW: Final = 0.1
# The compensators differ most before this time after a step.
FIRST_S: Final = 0.05
CAPTIONS: Final = {
    'step_responses': 'Force and valve command after a step, with three compensators',
    'limit_cycle': 'Force of the limit cycle in time: the whole run and its last cycles',
    'phase_plane': 'Phase plane of the limit cycle: force rate against force',
    'spectrum': 'Spectrum of the force in the limit cycle',
    'hysteresis': 'Loop of valve position against valve command',
    'gap_before': 'Force of the machine and of its nominal model, and their difference',
    'gap_why': 'Probability of each explanation',
    'gap_after': 'Force of the machine and of the improved model, and their difference'}


class Cell(NamedTuple):
    published: str
    simulated: str
    verdict: str
    similar: bool


def write_demo_report(recorded: list[Recorded], found: FoundEffect, out: Path) -> Path:
    """Write report.html and the PNGs into `out`; return the path of report.html."""
    by_name = {each.plan.name: each for each in recorded}
    cycle_run, loop_run = by_name['limit_cycle'], by_name['hysteresis']
    swing = cycle_run.analysis['oscillation']
    cycle = limit_cycle(cycle_run, swing['frequency_hz']) if swing['frequency_hz'] else None
    loop = hysteresis_loop(loop_run)
    drawn = {'step_responses': _steps(recorded), 'hysteresis': _hysteresis(loop)}
    if cycle:
        drawn |= _of_cycle(cycle_run.run, cycle)
    drawn |= _of_gap(found)
    steps = [each for each in recorded if each.plan.published]
    return write_report(
        out, 'demo.html', {name: (drawn[name], CAPTIONS[name]) for name in drawn},
        rows=[(each.plan.title, [compare(each.analysis, entry)
                                 for entry in each.plan.published]) for each in steps],
        quantities=[f'{entry.quantity} ({entry.unit})' for entry in steps[0].plan.published],
        shapes=[(each.plan.title, each.analysis['rise_shape']) for each in steps
                if each.analysis['monotone_rise'] is False],
        steps=[(each.plan.title, float(each.experiment.controller['reference.amplitude']),
                _load(each)) for each in steps],
        cycle=cycle, swing=swing, cycle_run=cycle_run, loop=loop, loop_run=loop_run,
        recorded=recorded, gains={each.plan.name: _gain(each) for each in recorded},
        delay_ms=_delay_ms(recorded[0]), found=found, effect=HIDDEN, noise=NOISE,
        said=sentences(found.gap)[0])


def _of_gap(found: FoundEffect) -> dict[str, Figure]:
    time_s = found.runs['machine'].time_s
    shown = (time_s >= SHOWN_S[0]) & (time_s < SHOWN_S[1])
    force = {name: run.signal('force')[shown] for name, run in found.runs.items()}
    largest = max(float(np.abs(force['machine'] - force['nominal']).max()), 1e-9)

    def compared(model: str) -> Figure:
        return pictures.compared(time_s[shown], force['machine'], force[model], model, largest)

    return {'gap_before': compared('nominal'),
            'gap_why': pictures.probabilities(chances(found.gap)),
            'gap_after': compared('improved')}


def _of_cycle(run: Run, cycle: Cycle) -> dict[str, Figure]:
    time_s, force_n, frequency_hz = run.time_s, run.signal('force'), cycle.frequency_hz
    return {
        'limit_cycle': figures.oscillation_in_time(
            time_s, force_n, run.signal('reference'), 8.0 / frequency_hz),
        'phase_plane': figures.phase_plane(time_s, force_n, cycle.steady),
        'spectrum': figures.spectrum(*cycle.spectrum, cycle.harmonics, 9.5 * frequency_hz)}


def _steps(recorded: list[Recorded]) -> Figure:
    curves = {}
    for each in recorded:
        if each.plan.published:
            step = each.analysis['steps'][0]
            share = 100.0 / (step['final_n'] - step['initial_n'])
            curves[each.plan.title] = (each.run.time_s - step['time_s'],
                                       share * each.run.signal('force'),
                                       share * each.run.signal('command'))
    return figures.step_responses(curves, 0.25, first_s=FIRST_S)


def _hysteresis(loop: Loop) -> Figure:
    return figures.hysteresis_loop(loop.command_n, loop.valve_position_m,
                                   (loop.slope_m_n, loop.offset_m), loop.width_n)


def compare(analysis: dict[str, Any], entry: Published) -> Cell:
    """Return the published and the simulated figure, and how they differ in words."""
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
        return Cell(entry.words, text, 'similar' if abs(value) < 2.0 else f'{value:.1f} more',
                    abs(value) < 2.0)
    ratio = abs(value) / entry.value
    if abs(ratio - 1.0) < SIMILAR:
        return Cell(entry.words, text, 'similar', True)
    smaller, larger = ('shorter', 'longer') if entry.unit == 'ms' else ('smaller', 'larger')
    return Cell(entry.words, text, f'{ratio:.1f} times {larger}' if ratio > 1.0
                 else f'{1.0 / max(ratio, 1e-3):.1f} times {smaller}', False)


def _gain(recorded: Recorded) -> float:
    """Return the compensator's gain in the run."""
    values = recorded.experiment.controller
    return float(values['gain']) or OWN_GAIN[str(values['compensator'])]


def _load(recorded: Recorded) -> str:
    """Describe the load of the piston."""
    values = recorded.experiment.actuator
    if values['load.type'] == 'locked':
        return 'piston locked'
    return (f'spring of {float(values["load.stiffness"]) / 1e3:.3g} kN/m, '
            f'{float(values["load.mass"]):.3g} kg, {float(values["load.damping"]):.3g} N s/m')


def _delay_ms(recorded: Recorded) -> float:
    """Return the transport delay of the loop (ms): the model's two delays; lock-step adds none."""
    values = recorded.experiment.actuator
    return 1e3 * (float(values['valve_flexure.delay']) + float(values['force_sensor.delay']))
