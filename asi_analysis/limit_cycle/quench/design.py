"""
Design of lead compensators: the fastest step within a margin, a command peak and a noise gain.

The family: a lag, two second-order leads with their own damping ratios, and feed-forward of the
reference. Table 1's fourth-order lead is the member with equal, critically damped leads. The
search is differential evolution (Storn and Price, J. Global Optimization 11, 1997) around the
rival; the cost of a candidate is computed from the simulated step of Table 1 and its limit-cycle
margin.
"""

from typing import Any, Final, NamedTuple

import numpy as np
from scipy import optimize

from asi_actuator.parameters import as_record
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.experiments.step_tests import LEAD4
from asi_analysis.limit_cycle.quench.margin import (
    FREQUENCIES_HZ,
    Margin,
    hysteresis_table,
    margin_of,
    plants,
)
from asi_analysis.loop.closed_loop import simulate_loop
from asi_analysis.loop.simulation import Values, loop_of
from asi_analysis.measures.step_response import largest_step, step_responses
from asi_analysis.terminal import Progress, silent
from asi_common.parameter import defaults
from asi_controller.compensator import OWN_GAIN, frequency_response
from asi_controller.parameters import COMPENSATOR_PARAMETERS

DURATION_S: Final = 0.35
# Largest noise gain, over the rival's.
NOISE: Final = 1.5
# Cost of a candidate without a step response.
NO_STEP: Final = 100.0
# Resolution of the measures: s, %, s, N.
RESOLVED: Final = (1e-5, 0.1, 1e-5, 0.005)
# Largest peak of the command, over the saturation.
HEADROOM: Final = 0.9
# name: (least, most), on a logarithmic scale
RANGES: Final = {
    'gain': (0.2, 16.0), 'lag_ratio': (3.0, 2000.0), 'lag_time': (0.05, 3.0),
    'zero_1': (40.0, 1000.0), 'zero_2': (40.0, 1000.0), 'ratio_1': (1.1, 24.0),
    'ratio_2': (1.1, 24.0), 'zero_damping_1': (0.3, 1.5), 'zero_damping_2': (0.3, 1.5),
    'pole_damping_1': (0.4, 1.5), 'pole_damping_2': (0.4, 1.5), 'feedforward': (0.7, 1.4)}
POPULATION: Final = 20
# Spread of the first population about the rival, in the unit cube.
SPREAD: Final = 0.02


class Candidate(NamedTuple):
    """A compensator, Table 1's four measures, its margin, noise gain and peak command (N)."""

    controller: dict[str, Any]
    rise_time_s: float
    overshoot_percent: float
    settling_time_2_s: float
    steady_state_error_n: float
    margin: Margin
    noise_gain: float
    peak_command_n: float

    @property
    def measures(self) -> tuple[float, float, float, float]:
        """Columns of Table 1, less is better; the error by its size."""
        return (self.rise_time_s, self.overshoot_percent, self.settling_time_2_s,
                abs(self.steady_state_error_n))


class Evaluation:
    """Evaluates compensators for one actuator and rate, whose linear plants it holds."""

    def __init__(self, actuator: Values, rate_hz: float) -> None:
        self.actuator, self.rate_hz = actuator, rate_hz
        self.cases = list(plants(actuator, rate_hz))
        self.table = hysteresis_table(as_record(actuator))

    def candidate(self, controller: Values) -> Candidate | None:
        """Return an evaluated compensator; None if its step response does not settle."""
        settings = dict(controller)
        loop = loop_of(self.actuator, settings, self.rate_hz)
        response = frequency_response(loop.compensator, FREQUENCIES_HZ, self.rate_hz)
        found = margin_of(response, self.cases, self.table)
        run = simulate_loop({**self.actuator, **LEAD4.load},
                            {**settings, 'reference.shape': 'step', 'reference.start': 0.01,
                             'reference.amplitude': LEAD4.amplitude_n}, DURATION_S, self.rate_hz)
        if not np.isfinite(run.force_n).all():
            return None
        step = largest_step(step_responses(Run(run.time_s, run.reference_n, run.command_n,
                                           run.force_n)))
        if step is None or None in (step.rise_time_s, step.settling_time_2_s):
            return None
        closed = response / (1.0 + response * self.cases[0][2])
        # Mean over frequency (not its logarithm), as for white noise.
        weight = np.gradient(FREQUENCIES_HZ)
        noise = float(np.sqrt((np.abs(closed) ** 2 * weight).sum() / weight.sum()))
        return Candidate(settings, float(step.rise_time_s or 0.0),
                         float(step.overshoot_percent or 0.0),
                         float(step.settling_time_2_s or 0.0),
                         float(step.steady_state_error_n or 0.0), found, noise,
                         float(np.abs(run.command_n).max()))


def _pair(frequency_hz: float, damping: float) -> list[complex]:
    """Return the two roots (rad/s) of a frequency and a damping ratio; real for 1 and above."""
    return [complex(root) for root in 2.0 * np.pi * frequency_hz * np.roots(
        [1.0, 2.0 * damping, 1.0])]


def _written(roots: list[complex]) -> str:
    """Return roots in the format of custom.zeros and custom.poles, in exact conjugate pairs."""
    upper = [root for root in roots if root.imag > 1e-9 * abs(root)]
    real = [root for root in roots if abs(root.imag) <= 1e-9 * abs(root)]
    return ', '.join([f'{root.real:.9g}' for root in real]
                     + [f'{root.real:.9g}{sign}{root.imag:.9g}j' for root in upper
                        for sign in '+-'])


def _controller(point: np.ndarray) -> dict[str, Any]:
    """Return the parameters of a point in the unit cube."""
    v = {name: low * (high / low) ** float(x)
         for (name, (low, high)), x in zip(RANGES.items(), point, strict=True)}
    zeros, poles = [complex(-1.0 / v['lag_time'])], [complex(-1.0 / v['lag_time']
                                                             / v['lag_ratio'])]
    for k in ('1', '2'):
        zeros += _pair(v[f'zero_{k}'], v[f'zero_damping_{k}'])
        poles += _pair(v[f'zero_{k}'] * v[f'ratio_{k}'], v[f'pole_damping_{k}'])
    return {'compensator': 'custom', 'gain': v['gain'] * v['lag_ratio'],
            'feedforward': v['feedforward'], 'custom.zeros': _written(zeros),
            'custom.poles': _written(poles)}


def _point(controller: Values) -> np.ndarray:
    """Return the point of a lead of second or fourth order; its second pair cancels in lead2."""
    v = {**defaults(COMPENSATOR_PARAMETERS), **controller}
    family = str(v['compensator'])
    second = float(v[f'{family}.ratio']) if family == 'lead4' else 1.0
    values = [float(v['gain']) or OWN_GAIN[family], float(v[f'{family}.lag_ratio']),
              float(v[f'{family}.lag_time']), *2 * [float(v[f'{family}.zero_frequency'])],
              float(v[f'{family}.ratio']), second, 1.0, 1.0, 1.0, 1.0, float(v['feedforward'])]
    return np.clip([np.log(value / low) / np.log(high / low)
                    for value, (low, high) in zip(values, RANGES.values(), strict=True)], 0.0, 1.0)


def worse_by(found: Candidate, rival: Candidate, noise_limit: float) -> float:
    """
    Return the cost of a candidate: negative if it is better than its rival in all measures.

    Then it is the largest logarithm of the ratios of the measures; otherwise the sum of those
    above 0 and of the violations of margin, noise gain and command peak.
    """
    ratios = np.log([max(a, least) / max(b, least)
                     for a, b, least in zip(found.measures, rival.measures, RESOLVED, strict=True)
                     # Measures of both below the resolution are equal.
                     if max(a, b) > least])
    violation = (max(0.0, np.log(max(rival.margin.distance, 1e-3)
                              / max(found.margin.distance, 1e-3)))
              + max(0.0, np.log(found.noise_gain / noise_limit))
              + max(0.0, np.log(found.peak_command_n / max(
                  HEADROOM * float(found.controller.get('saturation', 4000.0)),
                  rival.peak_command_n))))
    excess = float(np.maximum(ratios, 0.0).sum()) + 3.0 * float(violation)
    if excess > 0.0:
        return excess
    return float(ratios.max())


def design(actuator: Values, rival_controller: Values, rate_hz: float, count: int, seed: int,
           report: Progress = silent) -> dict[str, Any]:
    """
    Return the best design found in about `count` candidates, its rival, and the trade-off curve.

    rival_controller: the compensator to beat, at the same margin; a lead4 has the settings of
    Table 1 unless given otherwise. Raises InputError if its step response does not settle.
    """
    if rival_controller.get('compensator') == 'lead4':
        rival_controller = {**LEAD4.controller, **rival_controller}
    evaluation = Evaluation(actuator, rate_hz)
    rival = evaluation.candidate(rival_controller)
    if rival is None:
        raise InputError('--designs: the step response of the compensator to beat does not settle')
    noise_limit = NOISE * rival.noise_gain
    found: list[tuple[float, Candidate]] = []
    tried = 0

    def cost(point: np.ndarray) -> float:
        nonlocal tried
        if tried % 10 == 0:
            report('designs', tried / count)
        tried += 1
        candidate = evaluation.candidate(_controller(point))
        if candidate is None:
            return NO_STEP
        found.append((worse_by(candidate, rival, noise_limit), candidate))
        return found[-1][0]

    random = np.random.default_rng(seed)
    family = rival_controller.get('compensator')
    centre = _point(rival_controller if family in ('lead2', 'lead4') else LEAD4.controller)
    start = np.clip(centre + SPREAD * random.standard_normal((POPULATION, len(RANGES))), 0.0, 1.0)
    start[0] = centre
    optimize.differential_evolution(
        cost, [(0.0, 1.0)] * len(RANGES), init=start, maxiter=max(count // POPULATION - 1, 1),
        mutation=(0.4, 0.9), recombination=0.8, strategy='currenttobest1bin', polish=False,
        tol=0.0, seed=seed)
    score, best = min(found, key=lambda each: each[0])
    return {'rival': as_dict(rival), 'best': as_dict(best), 'beats_rival': score < 0.0,
            'designs_tried': tried, 'noise_gain_limit': noise_limit,
            'trade_off': trade_off([each[1] for each in found], noise_limit)}


def trade_off(candidates: list[Candidate], noise_limit: float) -> list[dict[str, float]]:
    """Return the Pareto front of margin and rise time."""
    allowed = sorted((c for c in candidates
                      if c.overshoot_percent < 10.0 and c.noise_gain < noise_limit
                      and c.margin.distance > 0.0),
                     key=lambda c: -c.margin.distance)
    curve: list[dict[str, float]] = []
    for c in allowed:
        if not curve or c.rise_time_s < curve[-1]['rise_time_s']:
            curve.append({'margin': c.margin.distance, 'rise_time_s': c.rise_time_s,
                          'overshoot_percent': c.overshoot_percent})
    return curve


def as_dict(found: Candidate) -> dict[str, Any]:
    """Return a candidate with the keys of doc/reference/json.md."""
    return {**found._asdict(), 'margin': found.margin.distance}
