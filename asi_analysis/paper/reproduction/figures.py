"""The paper's Figs. 3 to 12 from the simulator, on the paper's axes."""

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from asi_actuator.parameters import as_record
from asi_analysis.loop.bench import Values, in_process, step_experiment
from asi_analysis.loop.one_harmonic import at_gain, first_intersection
from asi_analysis.paper.facts.conditions import LOCKED, Conditions
from asi_analysis.paper.facts.converged import Converged
from asi_analysis.paper.facts.fact import Setup
from asi_analysis.paper.facts.measures import onset_name, paper_prediction
from asi_analysis.paper.facts.static import (
    FASTEST_M_S,
    OPENINGS,
    damping_sweep,
    hysteresis_loop,
    static_characteristic,
)
from asi_analysis.paper.reproduction.table_1 import figure_of_sweep
from asi_analysis.reporting.figures import BLUE, COLOURS, GREY, ORANGE, WIDTH_IN, style

FIG_9_GAIN: Final = 15.0
MICRO: Final = 1e6


def _figure(title: str, height_in: float = 3.2) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(WIDTH_IN, height_in), layout='constrained')
    axes = figure.subplots()
    axes.set_title(title)
    return figure, axes


def hydraulic_damping(actuator: Values) -> Figure:
    """Draw Fig. 3: damping force against velocity, one curve a valve position."""
    figure, axes = _figure('Fig. 3: hydraulic damping')
    speeds = np.linspace(-FASTEST_M_S, FASTEST_M_S, 121)
    full = as_record(actuator)['valve_characteristic_full_opening']
    for opening, colour in zip(OPENINGS, (*COLOURS, GREY), strict=True):
        axes.plot(*damping_sweep(actuator, opening, speeds), color=colour,
                  label=f'{MICRO * opening * full:g}')
    axes.set(xlabel='velocity (m/s)', ylabel='damping force (N)')
    axes.legend(title='valve position (µm)')
    return figure


def static_force(actuator: Values) -> Figure:
    """Draw Fig. 4: thrust against valve position."""
    figure, axes = _figure('Fig. 4: static characteristic of the valve')
    curve = static_characteristic(actuator)
    axes.plot(1e5 * curve.x, curve.y, color=BLUE)
    axes.set(xlabel='valve position (10$^{-5}$ m)', ylabel='force (N)', xlim=(-3.0, 3.0))
    return figure


def hysteresis(actuator: Values) -> Figure:
    """Draw Fig. 5: major and minor loops, slow, and one as fast as the limit cycle."""
    figure, axes = _figure('Fig. 5: hysteresis', 3.6)
    for amplitude in (900.0, 500.0, 200.0):
        axes.plot(*hysteresis_loop(actuator, amplitude), color=BLUE, linewidth=1.0,
                  label='slow' if amplitude == 900.0 else None)
    axes.plot(*hysteresis_loop(actuator, 500.0, 20.0), color=ORANGE, linewidth=1.0,
              label='20 Hz')
    axes.set(xlabel='valve command (N)', ylabel='force (N)')
    axes.legend()
    return figure


def high_gain_step(actuator: Values, conditions: Conditions, onset_gain: float) -> Figure:
    """Draw Fig. 6: the step response that ends in the limit cycle."""
    gain = conditions.cycle_gain * onset_gain
    figure, axes = _figure(f'Fig. 6: step response with high gain, Kp = {gain:.3g}')
    run = in_process(step_experiment(
        {**actuator, **LOCKED}, {'gain': gain, 'feedforward': conditions.feedforward},
        conditions.cycle_step_n, 0.4))
    axes.plot(run.time_s, run.force_n, color=BLUE, linewidth=1.0)
    axes.set(xlabel='time (s)', ylabel='force (N)', xlim=(0.0, 0.4))
    return figure


def onset_against_input(conditions: Conditions, measured: Mapping[str, Converged]) -> Figure:
    """Draw Fig. 7: gain and frequency at the onset of the cycle, against the step."""
    figure = Figure(figsize=(WIDTH_IN, 3.6), layout='constrained')
    steps = np.array(conditions.onset_steps_n)
    above, below = figure.subplots(2, 1, sharex=True)
    for axes, quantity, label in ((above, 'gain', 'onset gain (N/N)'),
                                  (below, 'frequency_hz', 'frequency (Hz)')):
        axes.plot(steps, [measured[onset_name(step, quantity)].value
                          for step in conditions.onset_steps_n], 'o-', color=BLUE,
                  label='simulated')
        axes.set_ylabel(label)
    below.plot([0.0, 600.0], [95.0, 75.0], '--', color=ORANGE, label='published ends')
    below.set_xlabel('step (N)')
    below.legend()
    above.set_title('Fig. 7: the limit cycle as a function of the input, piston locked')
    return figure


def nyquist_of_damping(actuator: Values) -> Figure:
    """
    Draw Fig. 8: S / (1 + S H) of section 4.1, and the locus -1/D of damping and friction.

    H has the proportional gain of the first intersection; D is real, so -1/D is the real axis.
    """
    figure, axes = _figure('Fig. 8: Nyquist plot for friction and damping')
    of, rows = paper_prediction(actuator)
    response = of.per_gain(np.geomspace(1.0, 400.0, 600))
    right = 1.0 / (1.0 + first_intersection(of, rows).gain * response)
    axes.plot(right.real, right.imag, color=BLUE, label='S / (1 + S H)')
    axes.axhline(0.0, color=ORANGE, label='-1/D')
    axes.set(xlabel='real', ylabel='imaginary')
    axes.legend()
    return figure


def nyquist_of_hysteresis(actuator: Values) -> Figure:
    """Draw Fig. 9: Kp H S and -1/N(A) at Kp = 15, with frequencies and amplitudes marked."""
    figure, axes = _figure('Fig. 9: Nyquist plot of the hysteresis, Kp = 15', 3.8)
    of, rows = paper_prediction(actuator)
    response = FIG_9_GAIN * of.per_gain(np.geomspace(60.0, 400.0, 300))
    axes.plot(response.real, response.imag, color=BLUE, label='Kp H S')
    cycle_hz = (at_gain(of, rows, FIG_9_GAIN) or rows[-1]).frequency_hz
    amplitudes = np.geomspace(100.0, 6000.0, 60)
    locus = np.array([-1.0 / of.hysteresis(a, cycle_hz) for a in amplitudes])
    axes.plot(locus.real, locus.imag, color=ORANGE, label=f'-1/N at {cycle_hz:.0f} Hz')
    for marked in (80.0, 100.0, 120.0, 160.0, 200.0):
        at = FIG_9_GAIN * of.per_gain(marked)
        axes.annotate(f'{marked:.0f} Hz', (at.real, at.imag), fontsize=7.5)
        axes.plot(at.real, at.imag, '.', color=BLUE)
    axes.set(xlabel='real', ylabel='imaginary', xlim=(-2.5, 0.5), ylim=(-4.0, 0.5))
    axes.legend()
    return figure


def table_1_step(actuator: Values, conditions: Conditions, name: str, title: str) -> Figure:
    """Draw one of Figs. 10 to 12: a step response of Table 1."""
    test = getattr(conditions, name)
    figure, axes = _figure(f'{title}, step of {test.amplitude_n:g} N')
    run = in_process(step_experiment(
        {**actuator, **test.load}, {'feedforward': conditions.feedforward, **test.controller},
        test.amplitude_n, 0.4))
    axes.plot(run.time_s, run.reference_n, '--', color='black', linewidth=0.8)
    axes.plot(run.time_s, run.force_n, color=BLUE)
    axes.set(xlabel='time (s)', ylabel='force (N)', xlim=(0.0, 0.4))
    return figure


def paper_figures(actuator: Values, conditions: Conditions, measured: Mapping[str, Converged]
                  ) -> dict[str, Figure]:
    """Return every figure by its number in the paper, and Table 1 over steps and loads."""
    onset = measured[onset_name(conditions.cycle_step_n, 'gain')].value
    drawn: Mapping[str, Callable[[], Figure]] = {
        'figure_03': lambda: hydraulic_damping(actuator),
        'figure_04': lambda: static_force(actuator),
        'figure_05': lambda: hysteresis(actuator),
        'figure_06': lambda: high_gain_step(actuator, conditions, onset),
        'figure_07': lambda: onset_against_input(conditions, measured),
        'figure_08': lambda: nyquist_of_damping(actuator),
        'figure_09': lambda: nyquist_of_hysteresis(actuator),
        'figure_10': lambda: table_1_step(actuator, conditions, 'proportional',
                                          'Fig. 10: proportional control'),
        'figure_11': lambda: table_1_step(actuator, conditions, 'lead_lag',
                                          'Fig. 11: lead-lag control'),
        'figure_12': lambda: table_1_step(actuator, conditions, 'lead4',
                                          'Fig. 12: fourth-order lead'),
        'table_1': lambda: figure_of_sweep(Setup(actuator, conditions, {})),
    }
    with style():
        return {name: draw() for name, draw in drawn.items()}
