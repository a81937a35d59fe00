"""
Lead compensators designed for the fastest step within a margin, a saturation and a noise gain.

A random search over the family of leads with a lag, then local steps from the best; every
candidate is judged by the step of Table 1 in the simulator and by its limit-cycle margin.
"""

from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np

from asi_actuator.parameters import as_record, defaults
from asi_analysis.closed_loop import simulate_loop
from asi_analysis.facts.conditions import Conditions
from asi_analysis.prediction.simulation import Values, loop_of
from asi_analysis.quench.margin import (
    FREQUENCIES_HZ,
    Margin,
    hysteresis_table,
    margin_of,
    plants,
)
from asi_analysis.run import Run
from asi_analysis.step_response import headline, step_responses
from asi_controller.compensator import OWN_GAIN, frequency_response
from asi_controller.parameters import COMPENSATOR_PARAMETERS

Report = Callable[[str, float | None], None]

# Table 1's conditions for the fourth-order lead: its load, its step, its settings.
TABLE_1: Final = Conditions().lead4
DURATION_S: Final = 0.35
# The drive may be used so far by that step.
HEADROOM: Final = 0.9
RANDOM_SHARE: Final = 0.4
FAMILIES: Final = ('lead2', 'lead4')
# name: (least, most), searched evenly in the logarithm
RANGES: Final = {
    'gain': (0.4, 16.0), 'ratio': (1.2, 24.0), 'zero_frequency': (60.0, 800.0),
    'lag_ratio': (3.0, 800.0), 'lag_time': (0.05, 3.0)}


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
        """Table 1's columns; less is better. Errors are compared by size."""
        return (self.rise_time_s, self.overshoot_percent, self.settling_time_2_s,
                abs(self.steady_state_error_n))


class Judge:
    """Judges compensators for one actuator and rate; what all share is worked out once."""

    def __init__(self, actuator: Values, rate_hz: float) -> None:
        self.actuator, self.rate_hz = actuator, rate_hz
        self.cases = list(plants(actuator, rate_hz))
        self.table = hysteresis_table(as_record(actuator))

    def candidate(self, controller: Values) -> Candidate | None:
        """Return a compensator judged; None if its step is none (it oscillates, or never ends)."""
        settings = dict(controller)
        loop = loop_of(self.actuator, settings, self.rate_hz)
        response = frequency_response(loop.compensator, FREQUENCIES_HZ, self.rate_hz)
        found = margin_of(response, self.cases, self.table)
        run = simulate_loop({**self.actuator, **TABLE_1.load},
                            {**settings, 'reference.shape': 'step', 'reference.start': 0.01,
                             'reference.amplitude': TABLE_1.amplitude_n}, DURATION_S, self.rate_hz)
        if not np.isfinite(run.force_n).all():
            return None
        step = headline(step_responses(Run(run.time_s, run.reference_n, run.command_n,
                                           run.force_n)))
        if step is None or None in (step.rise_time_s, step.settling_time_2_s):
            return None
        closed = response / (1.0 + response * self.cases[0][2])
        # Mean over the band, in frequency, not in its logarithm: white noise.
        weight = np.gradient(FREQUENCIES_HZ)
        noise = float(np.sqrt((np.abs(closed) ** 2 * weight).sum() / weight.sum()))
        return Candidate(settings, float(step.rise_time_s or 0.0),
                         float(step.overshoot_percent or 0.0),
                         float(step.settling_time_2_s or 0.0),
                         float(step.steady_state_error_n or 0.0), found, noise,
                         float(np.abs(run.command_n).max()))


def _controller(family: str, point: np.ndarray) -> dict[str, Any]:
    """Return the parameters of a point in the unit cube."""
    values = {name: low * (high / low) ** float(x)
              for (name, (low, high)), x in zip(RANGES.items(), point, strict=True)}
    return {'compensator': family, 'gain': values['gain'],
            f'{family}.ratio': values['ratio'],
            f'{family}.zero_frequency': values['zero_frequency'],
            f'{family}.lag_ratio': values['lag_ratio'],
            'lead_lag.lag_time': values['lag_time']}


def _point(controller: Values) -> np.ndarray:
    """Return the point of a lead's parameters in the unit cube: the inverse of _controller."""
    v = {**defaults(COMPENSATOR_PARAMETERS), **controller}
    family = v['compensator']
    values = [float(v['gain']) or OWN_GAIN[str(family)]]
    values += [float(v[f'{family}.{name}']) for name in ('ratio', 'zero_frequency', 'lag_ratio')]
    values.append(float(v['lead_lag.lag_time']))
    return np.clip([np.log(value / low) / np.log(high / low)
                    for value, (low, high) in zip(values, RANGES.values(), strict=True)], 0.0, 1.0)


def worse_by(found: Candidate, rival: Candidate, noise_limit: float) -> float:
    """
    Return how far a candidate is from beating its rival: 0 or less if it does, in all measures.

    At the rival's margin, within the saturation and the noise gain. Beyond that it is the mean of
    the measures' logarithms: the more negative the better.
    """
    ratios = np.log([max(a, 1e-4) / max(b, 1e-4)
                     for a, b in zip(found.measures, rival.measures, strict=True)])
    # An overshoot below what is measured (0.1 %), or an error below 0.05 N, is none.
    for k, (value, least) in enumerate(zip(found.measures, (0.0, 0.1, 0.0, 0.05), strict=True)):
        if value <= least:
            ratios[k] = min(ratios[k], 0.0)
    broken = (max(0.0, np.log(max(rival.margin.distance, 1e-3)
                              / max(found.margin.distance, 1e-3)))
              + max(0.0, np.log(found.noise_gain / noise_limit))
              + max(0.0, np.log(found.peak_command_n / max(
                  HEADROOM * float(found.controller.get('saturation', 4000.0)),
                  rival.peak_command_n))))
    excess = float(np.maximum(ratios, 0.0).sum()) + 3.0 * float(broken)
    if excess > 0.0:
        return excess
    return float(np.clip(ratios, -1.0, 0.0)[[0, 2]].mean())


def design(actuator: Values, rival_controller: Values, rate_hz: float, count: int, seed: int,
           report: Report = lambda *_: None) -> dict[str, Any]:
    """
    Return the best design found in `count` candidates, its rival, and the trade-off curve.

    rival_controller: the compensator to beat, at the same margin; a lead4 has the settings of
    Table 1 unless it says otherwise.
    """
    if rival_controller.get('compensator') == 'lead4':
        rival_controller = {**TABLE_1.controller, **rival_controller}
    judge = Judge(actuator, rate_hz)
    rival = judge.candidate(rival_controller)
    if rival is None:
        raise ValueError('the rival makes no step')
    random = np.random.default_rng(seed)
    noise_limit = 1.5 * rival.noise_gain
    # A candidate with its score, family and point.
    found: list[tuple[float, str, np.ndarray, Candidate]] = []
    if rival_controller.get('compensator') in FAMILIES:
        # What is to be beaten is a place to look from.
        found.append((0.0, str(rival_controller['compensator']), _point(rival_controller), rival))
    for number in range(count):
        if number % 10 == 0:
            report('designs', number / count)
        if number < RANDOM_SHARE * count or not found:
            family, point = FAMILIES[number % 2], random.random(len(RANGES))
        else:
            found.sort(key=lambda each: each[0])
            _, family, parent, _ = found[int(random.integers(min(5, len(found))))]
            step = 10.0 ** random.uniform(-2.3, -0.7)
            point = np.clip(parent + step * random.standard_normal(len(RANGES)), 0.0, 1.0)
        candidate = judge.candidate(_controller(family, point))
        if candidate is not None:
            found.append((worse_by(candidate, rival, noise_limit), family, point, candidate))
    found.sort(key=lambda each: each[0])
    best = found[0][3]
    return {'rival': as_dict(rival), 'best': as_dict(best),
            'beats_rival': found[0][0] < 0.0,
            'designs_tried': count, 'noise_gain_limit': noise_limit,
            'trade_off': trade_off([each[3] for each in found], noise_limit)}


def trade_off(candidates: list[Candidate], noise_limit: float) -> list[dict[str, float]]:
    """Return the fastest rise for each margin: only what no other beats in both."""
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
    """Return a candidate with the keys of doc/json.md."""
    return {**found._asdict(), 'margin': found.margin.distance}
