"""Table 1 of the paper: the measurement that its three columns share."""

import math
from typing import Final

import numpy as np

from asi_actuator.parameters import as_record
from asi_analysis.bags.run import Run
from asi_analysis.loop.bench import RATE_HZ, step_experiment
from asi_analysis.measures.step_response import largest_step, step_responses
from asi_analysis.paper.facts.conditions import StepTest
from asi_analysis.paper.facts.fact import Fact, Measured, Row, Setup, Stage, around
from asi_controller.compensator import design

SECTION: Final = 'Table 1'
STEP_S: Final = 0.8
# A command whose total variation exceeds this multiple of its range chatters; a lead's kick has 3.
CHATTER: Final = 6.0


def step_test(setup: Setup, test: StepTest, name: str) -> Measured:
    """Return one column of Table 1, and whether its waveform is a single rise without chatter."""
    run = setup.runner(step_experiment(
        {**setup.actuator, **test.load},
        {'feedforward': setup.conditions.feedforward, **test.controller}, test.amplitude_n,
        STEP_S * setup.refinement))
    step = largest_step(step_responses(Run(*run)))
    if step is None or step.rise_time_s is None:
        return {f'{name}_rise_s': math.inf, f'{name}_overshoot_percent': math.inf,
                f'{name}_settling_s': math.inf, f'{name}_error_n': math.inf,
                f'{name}_monotone': 0.0}
    variation = float(np.abs(np.diff(run.command_n)).sum())
    quiet = variation <= CHATTER * float(np.ptp(run.command_n))
    return {f'{name}_rise_s': step.rise_time_s,
            f'{name}_overshoot_percent': step.overshoot_percent or 0.0,
            f'{name}_settling_s': step.settling_time_2_s or math.inf,
            f'{name}_error_n': abs(step.steady_state_error_n or 0.0),
            f'{name}_monotone': float(bool(step.monotone_rise) and quiet)}


def load_in_words(setup: Setup, test: StepTest) -> str:
    if test.load['load.type'] == 'locked':
        return 'piston locked'
    p = as_record({**setup.actuator, **test.load})
    return (f'spring {p["load_stiffness"]:.3g} N/m, {p["load_mass"]:.3g} kg, '
            f'{p["load_damping"]:.3g} N s/m')


def _controller(test: StepTest, feedforward: float) -> str:
    gain = design({**test.controller}).gain
    others = ', '.join(f'{name} {value:.4g}' for name, value in test.controller.items()
                       if name not in ('compensator', 'gain') and isinstance(value, float))
    return (f'{test.controller["compensator"]}, gain {gain:.4g}'
            + (f', {others}' if others else '') + f', feed-forward {feedforward:g}')


def column(id_: str, name: str, words: str, rise_s: float,
           overshoot: tuple[float, float, float], settling_s: float,
           error: tuple[float, float, float]) -> Fact:
    """
    Return a column of Table 1 as a fact.

    name: the field of `Conditions` that holds its test; rise_s, settling_s: published values,
    met within 20 %; overshoot (%), error (N): published value, low and high limit.
    """
    def measure(setup: Setup) -> Measured:
        return step_test(setup, getattr(setup.conditions, name), name)

    def conditions(setup: Setup) -> str:
        test: StepTest = getattr(setup.conditions, name)
        return (f'{load_in_words(setup, test)}; {_controller(test, setup.conditions.feedforward)}'
                f', {RATE_HZ:g} Hz; step of {test.amplitude_n:g} N')

    rows = (
        around(f'{name}_rise_s', f'{words}: rise time 10 to 90 %', SECTION, rise_s, 's', 0.2),
        Row(f'{name}_overshoot_percent', f'{words}: overshoot', SECTION, overshoot[0], '%',
            *overshoot[1:]),
        around(f'{name}_settling_s', f'{words}: settling time 2 %', SECTION, settling_s, 's',
               0.2),
        Row(f'{name}_error_n', f'{words}: steady-state error', SECTION, error[0], 'N',
            *error[1:]),
        Row(f'{name}_monotone', f'{words}: one rise: no spike, dip, creep or chatter', SECTION,
            1.0, '', 1.0, 1.0))
    return Fact(id_, rows, measure, conditions, 'stepinfo measures of asi analyze on the force',
                Stage.TABLE_1, over_ros=measure)
