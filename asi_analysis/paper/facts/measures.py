"""What is measured on the simulator: groups of values by name, for the table of facts."""

import math
from collections.abc import Mapping
from functools import partial
from typing import Final

import numpy as np

from asi_actuator.model.hydraulic_damping import damping_curve, damping_force
from asi_actuator.parameters import as_record
from asi_analysis.bags.run import Run
from asi_analysis.loop.bench import (
    BEFORE_S,
    RATE_HZ,
    Array,
    Bench,
    Runner,
    Values,
    in_process,
    step_experiment,
)
from asi_analysis.loop.describing_functions import SAMPLES
from asi_analysis.loop.linear_model import fluid_phase_deg, linear_model
from asi_analysis.loop.one_harmonic import (
    Intersection,
    OneHarmonic,
    at_gain,
    first_intersection,
    linear_limit,
    locus,
)
from asi_analysis.loop.onset import onset
from asi_analysis.loop.simulation import loop_of, step_run, sustained
from asi_analysis.measures.oscillation import Oscillation, of_samples
from asi_analysis.measures.step_response import headline, step_responses
from asi_analysis.paper.facts.bandwidth import bandwidth_hz, closed_loop_gain, open_loop_gain
from asi_analysis.paper.facts.conditions import LOCKED, Conditions, StepTest
from asi_analysis.paper.facts.static import (
    breakaway,
    coulomb,
    damping_sweep,
    hysteresis_loop,
    loop_half_width,
    static_characteristic,
)
from asi_common.parameter import Value

OPEN_LOOP_HZ: Final = (12.0, 16.0, 20.0, 24.0, 30.0, 40.0, 60.0)
CLOSED_LOOP_HZ: Final = (50.0, 70.0, 80.0, 90.0, 100.0, 110.0, 125.0, 150.0, 200.0)
LARGE_HZ: Final = (10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0, 90.0, 100.0, 120.0, 150.0)
PAPER_GAIN: Final = 15.0
PAPER_PROPORTIONAL_GAIN: Final = 3.0
# The family of Fig. 3: valve positions as shares of full opening, up to a speed.
OPENINGS: Final = (-1.0, -0.5, 0.0, 0.5, 1.0)
FASTEST_M_S: Final = 1.0
SPEEDS_M_S: Final = np.geomspace(0.01, FASTEST_M_S, 60)
HYSTERESIS_AS_GAIN: Final = {'valve_hysteresis.model': 'linear',
                             'valve_characteristic.model': 'linear'}
NO_HYSTERESIS: Final = {'valve_hysteresis.model': 'off'}
NO_DAMPING: Final = {'hydraulic_damping.model': 'off', 'friction.model': 'off'}
STEP_S: Final = 0.8
# The gain at which an onset is looked for first, and the highest that is tried.
FIRST_LOOK: Final = 6.0
HIGHEST_GAIN: Final = 80.0
CYCLE_S: Final = 1.2
# At its onset a cycle takes long to settle.
ONSET_CYCLE_S: Final = 8.0
SETTLING_S: Final = 1.0
# Amplitudes of the command (N) at which the paper's prediction is worked out.
PREDICTED_N: Final = np.geomspace(60.0, 8e3, 30)
# A command that varies more than so many times its range chatters; the kick of a lead makes 3.
CHATTER: Final = 6.0
# Samples at the end of a run over which a cycle is measured.
LAST: Final = 1500

Measured = dict[str, float]


def _plant(actuator: Values, *changes: Mapping[str, Value]) -> np.void:
    values = dict(actuator)
    for change in changes:
        values.update(change)
    return as_record(values)


def _gain(conditions: Conditions, gain: float) -> Values:
    return {'compensator': 'proportional', 'gain': gain, 'feedforward': conditions.feedforward}


def _loop(plant: np.void, conditions: Conditions, gain: float) -> Bench:
    return Bench(plant, _gain(conditions, gain))


def static(actuator: Values, conditions: Conditions) -> Measured:
    """Return what Figs. 3 to 5 and the friction tests show: nothing moves fast by itself."""
    thrust = static_characteristic(actuator)
    full = float(as_record(actuator)['valve_characteristic_full_opening'])
    inside = np.abs(thrust.x) < 0.97 * full
    slope = np.polyfit(thrust.x[inside], thrust.y[inside], 1)
    bent = np.abs(np.polyval(slope, thrust.x[inside]) - thrust.y[inside]).max()
    return {
        **error_within_loop(actuator, conditions),
        'thrust_push_n': float(thrust.y.max()),
        'thrust_pull_n': float(-thrust.y.min()),
        'characteristic_bend_percent': 100.0 * bent / float(thrust.y.max()),
        'coulomb_n': coulomb(actuator),
        'stiction_push_n': breakaway(actuator, 1),
        'stiction_pull_n': breakaway(actuator, -1),
    }


def error_within_loop(actuator: Values, conditions: Conditions) -> Measured:
    """Return the error at Kp = 3 that the loop hides: (1 + Kp G) e = half width, in force."""
    width = loop_half_width(hysteresis_loop(actuator, conditions.open_loop_amplitude_n))
    gain = float(as_record(actuator)['valve_characteristic_gain'])
    return {'error_within_loop_n': width / (1.0 + PAPER_PROPORTIONAL_GAIN * gain)}


def _exponent(speeds: Array, force: Array) -> float:
    return float((np.diff(np.log(np.maximum(force, 1e-9))) / np.diff(np.log(speeds))).max())


def damping_exponent(actuator: Values) -> Measured:
    """Return the highest power of the velocity with which the damping rises, valve closed."""
    p = as_record(actuator)
    curve = damping_curve(0.0, p)
    closed = np.array([damping_force(speed, curve, p)[0] for speed in SPEEDS_M_S])
    return {'damping_exponent': _exponent(SPEEDS_M_S, closed)}


def linear(actuator: Values) -> Measured:
    model = linear_model(actuator)
    return {'linear_order': float(model.denominator.size - 1),
            'linear_delays': float(sum(delay > 0.0 for delay in model.delays_s)),
            'fluid_corner_hz': float(as_record(actuator)['fluid_dynamics_frequency']),
            'fluid_phase_deg': fluid_phase_deg(actuator, 400.0)}


def damping(actuator: Values) -> Measured:
    """Return the shape of the damping family (Fig. 3)."""
    speeds = SPEEDS_M_S
    family = {opening: damping_sweep(actuator, opening, speeds).y for opening in OPENINGS}
    closed = family[0.0]
    slope = np.diff(closed) / np.diff(speeds)
    middle = [float(np.interp(0.5 * curve.max(), curve, speeds)) for curve in family.values()]
    return {
        'damping_largest_n': max(float(np.abs(curve).max()) for curve in family.values()),
        'damping_exponent': _exponent(speeds, closed),
        'damping_taper': float(slope[-1] / slope.max()),
        'damping_spread': max(middle) / min(middle),
    }


def bandwidths(actuator: Values, conditions: Conditions) -> Measured:
    plant = _plant(actuator, LOCKED)
    controller = _gain(conditions, PAPER_PROPORTIONAL_GAIN)
    small, large = (
        bandwidth_hz(partial(closed_loop_gain, plant, controller, amplitude), 5.0, steps)
        for amplitude, steps in ((conditions.small_amplitude_n, CLOSED_LOOP_HZ),
                                 (conditions.large_amplitude_n, LARGE_HZ)))
    return {
        'open_loop_bandwidth_hz': bandwidth_hz(
            partial(open_loop_gain, plant, conditions.open_loop_amplitude_n), 2.0,
            OPEN_LOOP_HZ),
        'closed_loop_bandwidth_hz': small,
        'closed_loop_bandwidth_fall_percent': 100.0 * (1.0 - large / small),
    }


def onset_name(step_n: float, quantity: str) -> str:
    return f'onset_{quantity}_at_{step_n:.0f}_n'


def step_settings(conditions: Conditions, gain: float, step_n: float) -> Values:
    """
    Return the controller's parameters for a step of Fig. 7 from rest.

    A step of 0 N starts nothing: it is a step back from `start_n`.
    """
    from_n = conditions.start_n if step_n == 0.0 else 0.0
    return {**_gain(conditions, gain), 'reference.offset': from_n,
            'reference.amplitude': step_n - from_n, 'reference.start': BEFORE_S}


def onsets(actuator: Values, conditions: Conditions, known: Mapping[str, float] | None = None
           ) -> Measured:
    """Return the gains of Fig. 7; those that are known already, by name, are not measured."""
    locked = {**actuator, **LOCKED}
    measured: Measured = dict(known or {})
    near = next((gain for gain in measured.values() if math.isfinite(gain)), None)
    for step in conditions.onset_steps_n:
        name = onset_name(step, 'gain')
        if name not in measured:
            # The next onset is near the last one.
            start = 0.95 * near if near else FIRST_LOOK
            found = onset(locked, step_settings(conditions, start, step), RATE_HZ, start,
                          conditions.onset_accuracy, conditions.onset_watched_s,
                          HIGHEST_GAIN / start)
            measured[name] = found.gain if found else math.inf
        if math.isfinite(measured[name]):
            near = measured[name]
    return measured


def onset_rise(measured: Measured, conditions: Conditions) -> Measured:
    """Return how the onset gain rises with the step, of the gains that have been measured."""
    gains = np.array([measured[onset_name(step, 'gain')] for step in conditions.onset_steps_n])
    if not np.isfinite(gains).all():
        return {'onset_least_rise_percent': -math.inf, 'onset_rise_percent': -math.inf}
    return {'onset_least_rise_percent': 100.0 * float(np.min(gains[1:] / gains[:-1]) - 1.0),
            'onset_rise_percent': 100.0 * float(gains[-1] / gains[0] - 1.0)}


def onset_frequencies(actuator: Values, conditions: Conditions, gains: Measured,
                      runner: Runner = in_process) -> Measured:
    """Return the frequencies of Fig. 7: of the cycles at the onset gains."""
    measured: Measured = {}
    for step in conditions.onset_steps_n:
        gain, frequency = gains[onset_name(step, 'gain')], 0.0
        if math.isfinite(gain):
            run = runner(step_experiment(
                {**actuator, **LOCKED}, _gain(conditions, gain), step, ONSET_CYCLE_S,
                conditions.start_n if step == 0.0 else 0.0))
            frequency = of_samples(run.force_n[-LAST:], RATE_HZ).frequency_hz
        measured[onset_name(step, 'frequency_hz')] = frequency
    return measured


def high_gain_cycle(actuator: Values, conditions: Conditions, onset_gain: float,
                    runner: Runner = in_process) -> Measured:
    """Return the cycle of Fig. 6."""
    if not math.isfinite(onset_gain):
        return {'cycle_frequency_hz': 0.0, 'cycle_thd_percent': 100.0, 'cycle_amplitude_n': 0.0,
                'cycle_peak_valve_percent': 100.0}
    run = runner(step_experiment(
        {**actuator, **LOCKED}, _gain(conditions, conditions.cycle_gain * onset_gain),
        conditions.cycle_step_n, CYCLE_S))
    found = of_samples(run.force_n[-LAST:], RATE_HZ)
    full = float(as_record(actuator)['valve_characteristic_full_opening'])
    return {'cycle_frequency_hz': found.frequency_hz, 'cycle_amplitude_n': found.amplitude_n,
            'cycle_thd_percent': 100.0 * found.thd,
            'cycle_peak_valve_percent':
                100.0 * float(np.abs(run.valve_position_m[-LAST:]).max()) / full}


def same_cycle(actuator: Values, conditions: Conditions, onset_gain: float) -> Measured:
    """Return how far the cycle of Fig. 6 is from itself after pushes and from other starts."""
    if not math.isfinite(onset_gain):
        return {'cycle_frequency_spread_percent': math.inf,
                'cycle_amplitude_spread_percent': math.inf}
    plant = _plant(actuator, LOCKED)
    gain, step = conditions.cycle_gain * onset_gain, conditions.cycle_step_n

    def start(before_n: float = 0.0, push_n: float = 0.0) -> Oscillation:
        bench = _loop(plant, conditions, gain)
        bench.run(0.3, before_n)
        bench.run(0.3, step)
        bench.run(0.03, step, push_n=push_n)
        bench.run(SETTLING_S, step)
        return of_samples(bench.run(0.3, step).force_n, RATE_HZ)

    base = start()
    others = [start(push_n=push) for push in (400.0, -400.0, 800.0)]
    others += [start(before_n=before) for before in (600.0, -600.0)]
    return {
        'cycle_frequency_spread_percent': 100.0 * max(
            abs(other.frequency_hz / base.frequency_hz - 1.0) for other in others),
        'cycle_amplitude_spread_percent': 100.0 * max(
            abs(other.amplitude_n / base.amplitude_n - 1.0) for other in others),
    }


def free_onset(actuator: Values, conditions: Conditions, changes: Mapping[str, Value],
               onset_gain: float, most: float, accuracy: float = 0.01) -> float:
    """Return the onset gain of a changed actuator as a multiple; `most` if it is not less."""
    if not math.isfinite(onset_gain):
        return 0.0
    found = onset({**actuator, **LOCKED, **changes},
                  step_settings(conditions, onset_gain, conditions.cycle_step_n),
                  RATE_HZ, onset_gain, accuracy, conditions.onset_watched_s, most)
    return min(found.gain / onset_gain, most) if found else most


def paper_prediction(actuator: Values, samples: int = SAMPLES) -> tuple[
        OneHarmonic, list[Intersection]]:
    """Return the paper's prediction: continuous time, no limit of the command, fluid a gain."""
    of = OneHarmonic(loop_of({**actuator, **LOCKED, 'fluid_dynamics.model': 'off'},
                             {'gain': 1.0}, RATE_HZ), held=False, limited=False, samples=samples)
    return of, locus(of, PREDICTED_N)


def prediction_error(actuator: Values, conditions: Conditions, onset_gain: float) -> Measured:
    """
    Return the one-harmonic prediction over the simulated cycle, from the onset to Kp = 15.

    Frequency: the worst ratio, above 1. Amplitude: predicted over simulated at Kp = 15, and
    simulated without over with damping and friction.
    """
    of, rows = paper_prediction(actuator)
    first = first_intersection(of, rows)

    def predicted(gain: float) -> Intersection:
        return at_gain(of, rows, gain) or (first if gain <= first.gain else rows[-1])

    def simulated(gain: float, changes: Mapping[str, Value]) -> Oscillation | None:
        return sustained(step_run(
            {**actuator, **LOCKED, **changes},
            step_settings(conditions, gain, conditions.cycle_step_n), RATE_HZ,
            conditions.onset_watched_s))

    low = max(conditions.cycle_gain * min(onset_gain, PAPER_GAIN), first.gain)
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


def describing(actuator: Values, samples: int = SAMPLES) -> Measured:
    """
    Return what the describing function of the hysteresis alone predicts (Fig. 9).

    samples: a period, of the describing function.
    """
    of, rows = paper_prediction(actuator, samples)
    first = first_intersection(of, rows)
    reach = at_gain(of, rows, PAPER_GAIN) or rows[-1]
    used = [first, *(row for row in rows if row.command_n > first.command_n
                     and row.gain < reach.gain), reach]
    rises = (all(np.diff([row.amplitude_n for row in used]) > 0.0)
             and all(np.diff([row.frequency_hz for row in used]) < 0.0))
    limit = linear_limit(of)
    return {
        'predicted_onset_gain': first.gain,
        'predicted_onset_frequency_hz': first.frequency_hz,
        'predicted_highest_gain': reach.gain,
        'predicted_frequency_fall_percent': 100.0 * (1.0 - reach.frequency_hz
                                                     / first.frequency_hz),
        'predicted_amplitude_rise': reach.amplitude_n / first.amplitude_n,
        'predicted_monotone': float(rises),
        'linear_critical_gain': limit[0] if limit else math.inf,
    }


def step_test(actuator: Values, conditions: Conditions, test: StepTest, name: str,
              runner: Runner = in_process) -> Measured:
    """Return one column of Table 1, with what its waveform says about artefacts."""
    run = runner(step_experiment(
        {**actuator, **test.load}, {'feedforward': conditions.feedforward, **test.controller},
        test.amplitude_n, STEP_S))
    step = headline(step_responses(Run(*run)))
    nothing = math.inf
    if step is None or step.rise_time_s is None:
        return {f'{name}_rise_s': nothing, f'{name}_overshoot_percent': nothing,
                f'{name}_settling_s': nothing, f'{name}_error_n': nothing,
                f'{name}_monotone': 0.0}
    variation = float(np.abs(np.diff(run.command_n)).sum())
    steady = variation <= CHATTER * float(np.ptp(run.command_n))
    return {f'{name}_rise_s': step.rise_time_s,
            f'{name}_overshoot_percent': step.overshoot_percent or 0.0,
            f'{name}_settling_s': step.settling_time_2_s or nothing,
            f'{name}_error_n': abs(step.steady_state_error_n or 0.0),
            f'{name}_monotone': float(bool(step.monotone_rise) and steady)}
