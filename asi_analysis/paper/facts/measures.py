"""Measures of the limit cycle that several facts share: onset, cycle, prediction."""

import math
from collections.abc import Mapping
from typing import Final

import numpy as np

from asi_analysis.loop.bench import BEFORE_S, RATE_HZ, Values, step_experiment
from asi_analysis.loop.describing_functions import SAMPLES
from asi_analysis.loop.one_harmonic import (
    Intersection,
    OneHarmonic,
    at_gain,
    first_intersection,
    locus,
)
from asi_analysis.loop.onset import disagreement, fold, onset
from asi_analysis.loop.simulation import loop_of, step_run, sustained
from asi_analysis.measures.oscillation import Oscillation, of_samples
from asi_analysis.paper.facts.conditions import LOCKED
from asi_analysis.paper.facts.fact import Measured, Setup
from asi_common.parameter import Value

PAPER_GAIN: Final = 15.0
NO_DAMPING: Final = {'hydraulic_damping.model': 'off', 'friction.model': 'off'}
# Initial gain of the search for an onset.
FIRST_GAIN: Final = 6.0
CYCLE_S: Final = 1.2
# Amplitudes of the command (N) at which the paper's prediction is computed.
PREDICTED_N: Final = np.geomspace(60.0, 8e3, 30)
# Samples at the end of a run over which a cycle is measured.
LAST_SAMPLES: Final = 1500
# Upper limit of the search for an onset without a nonlinearity, as a multiple of the onset gain.
HIGHEST_RATIO: Final = 3.0


def onset_name(step_n: float, quantity: str) -> str:
    return f'onset_{quantity}_at_{step_n:.0f}_n'


def step_settings(setup: Setup, gain: float, step_n: float) -> Values:
    """
    Return the controller's parameters for a step of Fig. 7 from rest.

    A step of 0 N would excite nothing, so it is a step from `start_n` to 0.
    """
    from_n = setup.conditions.start_n if step_n == 0.0 else 0.0
    return {**setup.proportional(gain), 'reference.offset': from_n,
            'reference.amplitude': step_n - from_n, 'reference.start': BEFORE_S}


def onset_gains(setup: Setup, steps_n: tuple[float, ...]) -> Measured:
    """Return `setup.measured` with the onset gains of Fig. 7 at some steps (N) added."""
    conditions, measured = setup.conditions, setup.measured
    last = next((gain for name, gain in measured.items()
                 if name.startswith('onset_gain_') and math.isfinite(gain)), None)
    for step in steps_n:
        name = onset_name(step, 'gain')
        if name not in measured:
            # The onset of the next step is near this one.
            start = 0.95 * last if last else FIRST_GAIN
            found = onset({**setup.actuator, **LOCKED}, step_settings(setup, start, step),
                          RATE_HZ, start, conditions.onset_accuracy, conditions.onset_watched_s,
                          conditions.highest_gain / start, conditions.first_watched_s)
            measured[name] = found.gain if found else math.inf
        if math.isfinite(measured[name]):
            last = measured[name]
    return measured


def onset_gain(setup: Setup) -> float:
    """Return the onset gain at the step of Fig. 6."""
    conditions = setup.conditions
    steps_n = (conditions.cycle_step_n,) if setup.fitted_only else conditions.onset_steps_n
    return onset_gains(setup, steps_n)[onset_name(conditions.cycle_step_n, 'gain')]


def onset_notes(setup: Setup) -> dict[str, str]:
    """Return a note, by name, for each onset that differs from the fold of harmonic balance."""
    notes: dict[str, str] = {}
    for step in setup.conditions.onset_steps_n:
        gain = setup.measured[onset_name(step, 'gain')]
        if math.isfinite(gain):
            balance = fold({**setup.actuator, **LOCKED}, step_settings(setup, gain, step),
                           RATE_HZ, gain)
            if note := disagreement(gain, balance):
                notes[onset_name(step, 'frequency_hz')] = note
    return notes


def onset_rise(setup: Setup) -> Measured:
    """Return the rise (%) of the measured onset gains: the least between steps, and in total."""
    gains = np.array([setup.measured[onset_name(step, 'gain')]
                      for step in setup.conditions.onset_steps_n])
    if not np.isfinite(gains).all():
        return {'onset_least_rise_percent': -math.inf, 'onset_rise_percent': -math.inf}
    return {'onset_least_rise_percent': 100.0 * float(np.min(gains[1:] / gains[:-1]) - 1.0),
            'onset_rise_percent': 100.0 * float(gains[-1] / gains[0] - 1.0)}


def onset_frequencies(setup: Setup) -> Measured:
    """Return the frequencies (Hz) of Fig. 7: those of the cycles at the onset gains."""
    measured: Measured = {}
    for step in setup.conditions.onset_steps_n:
        gain, frequency = setup.measured[onset_name(step, 'gain')], 0.0
        if math.isfinite(gain):
            run = setup.runner(step_experiment(
                {**setup.actuator, **LOCKED}, setup.proportional(gain), step,
                setup.conditions.onset_cycle_s, setup.conditions.start_n if step == 0.0 else 0.0))
            frequency = of_samples(run.force_n[-LAST_SAMPLES:], RATE_HZ).frequency_hz
        measured[onset_name(step, 'frequency_hz')] = frequency
    return measured


def high_gain_cycle(setup: Setup) -> Measured:
    """Return the cycle of Fig. 6: frequency, amplitude, distortion and largest valve opening."""
    conditions, gain = setup.conditions, onset_gain(setup)
    if not math.isfinite(gain):
        return {'cycle_frequency_hz': 0.0, 'cycle_thd_percent': 100.0, 'cycle_amplitude_n': 0.0,
                'cycle_peak_valve_percent': 100.0}
    run = setup.runner(step_experiment(
        {**setup.actuator, **LOCKED}, setup.proportional(conditions.cycle_gain * gain),
        conditions.cycle_step_n, setup.refinement * CYCLE_S))
    last = setup.refinement * LAST_SAMPLES
    found = of_samples(run.force_n[-last:], RATE_HZ)
    full = float(setup.record()['valve_characteristic_full_opening'])
    return {'cycle_frequency_hz': found.frequency_hz, 'cycle_amplitude_n': found.amplitude_n,
            'cycle_thd_percent': 100.0 * found.thd,
            'cycle_peak_valve_percent':
                100.0 * float(np.abs(run.valve_position_m[-last:]).max()) / full}


def onset_ratio(setup: Setup, changes: Mapping[str, Value]) -> float:
    """Return the onset gain of a changed actuator over its own, at most HIGHEST_RATIO."""
    conditions, gain = setup.conditions, onset_gain(setup)
    if not math.isfinite(gain):
        return 0.0
    found = onset({**setup.actuator, **LOCKED, **changes},
                  step_settings(setup, gain, conditions.cycle_step_n), RATE_HZ, gain,
                  conditions.ratio_accuracy, conditions.onset_watched_s, HIGHEST_RATIO,
                  conditions.first_watched_s)
    return min(found.gain / gain, HIGHEST_RATIO) if found else HIGHEST_RATIO


def paper_prediction(actuator: Values, samples: int = SAMPLES) -> tuple[
        OneHarmonic, list[Intersection]]:
    """
    Return the loop of the paper's prediction, and the locus of its intersections.

    Continuous time, no limit of the command, the fluid as a gain.
    """
    of = OneHarmonic(loop_of({**actuator, **LOCKED, 'fluid_dynamics.model': 'off'},
                             {'gain': 1.0}, RATE_HZ), held=False, limited=False, samples=samples)
    return of, locus(of, PREDICTED_N)


def prediction_error(setup: Setup) -> Measured:
    """
    Return ratios of the one-harmonic prediction to the simulated cycle, from the onset to Kp = 15.

    Frequency: the worst ratio, as a number above 1. Amplitude, at Kp = 15: predicted over
    simulated, and simulated without damping and friction over simulated with them.
    """
    conditions = setup.conditions
    of, rows = paper_prediction(setup.actuator, conditions.describing_samples)
    first = first_intersection(of, rows)

    def predicted(gain: float) -> Intersection:
        return at_gain(of, rows, gain) or (first if gain <= first.gain else rows[-1])

    def simulated(gain: float, changes: Mapping[str, Value]) -> Oscillation | None:
        return sustained(step_run(
            {**setup.actuator, **LOCKED, **changes},
            step_settings(setup, gain, conditions.cycle_step_n), RATE_HZ,
            conditions.onset_watched_s, conditions.first_watched_s))

    low = max(conditions.cycle_gain * min(onset_gain(setup), PAPER_GAIN), first.gain)
    ratios = []
    for gain in np.linspace(low, PAPER_GAIN, 3):
        found = simulated(gain, {})
        if found is not None:
            ratio = predicted(gain).frequency_hz / found.frequency_hz
            ratios.append(max(ratio, 1.0 / ratio))
    full, undamped = (simulated(PAPER_GAIN, changes) for changes in ({}, NO_DAMPING))
    return {
        'prediction_frequency_ratio': max(ratios, default=math.inf),
        'prediction_amplitude_ratio':
            predicted(PAPER_GAIN).amplitude_n / full.amplitude_n if full else 0.0,
        'undamped_amplitude_ratio':
            undamped.amplitude_n / full.amplitude_n if full and undamped else 0.0}


def predict_cycle(setup: Setup) -> Measured:
    """Return the prediction with the describing function of the hysteresis alone (Fig. 9)."""
    of, rows = paper_prediction(setup.actuator, setup.conditions.describing_samples)
    first = first_intersection(of, rows)
    reached = at_gain(of, rows, PAPER_GAIN)
    last = reached or rows[-1]
    branch = [first, *(row for row in rows if row.command_n > first.command_n
                       and row.gain < last.gain), last]
    monotone = (all(np.diff([row.amplitude_n for row in branch]) > 0.0)
                and all(np.diff([row.frequency_hz for row in branch]) < 0.0))
    return {
        'predicted_onset_gain': first.gain,
        'predicted_onset_frequency_hz': first.frequency_hz,
        # Exactly, not with the rounding error of the root.
        'predicted_highest_gain': PAPER_GAIN if reached else last.gain,
        'predicted_frequency_fall_percent': 100.0 * (1.0 - last.frequency_hz
                                                     / first.frequency_hz),
        'predicted_monotone': float(monotone),
    }
