"""
Effect of the gap on the closed loop: limit cycle and step of the nominal and the improved model.

The controller is the recorded one if the bag holds its parameters, otherwise a proportional one.
The improved model is that of `improved.yaml`; its interval comes from models drawn from the
uncertainty of the fits.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from asi_analysis.bags.run import Run
from asi_analysis.gap.diagnosis import Diagnosis, improved_of
from asi_analysis.gap.inference.uncertainty import LIMIT_95, draw, likelihood
from asi_analysis.gap.model.model_file import improved_model
from asi_analysis.loop.closed_loop import simulate_loop
from asi_analysis.loop.onset import onset
from asi_analysis.measures.analysis import analyze
from asi_analysis.parallel import in_threads
from asi_common.parameter import ParameterError, Value
from asi_controller.parameters import COMPENSATOR_PARAMETERS, REFERENCE_PARAMETERS

Values = Mapping[str, Value]

DRAWS = 6
LOWEST_GAINS = (1.0, 10.0)   # where the search for the onset starts
NEAR = 0.6             # of a known onset gain: where the search starts for a similar model
ACCURACY = 0.02        # of the onset gain
LONGEST_S = 3.0        # of a simulated run
RATES_HZ = (500.0, 5000.0)
# Used if the bag holds no controller: it tracks the reference well below the onset gain.
PLAIN: dict[str, Value] = {'compensator': 'proportional', 'gain': 3.0, 'reference.shape': 'step',
                           'reference.amplitude': 100.0, 'reference.start': 0.1}
LOOP_KEYS = ('rise_time_s', 'overshoot_percent', 'bandwidth_hz', 'tracking_error_rms_n')


class Consequence(NamedTuple):
    """One quantity of the loop; None if it does not exist, for instance without onset or step."""

    quantity: str
    nominal: float | None
    improved: float | None
    improved_low: float | None
    improved_high: float | None
    measured: float | None


def consequences(diagnosis: Diagnosis, model: Values, run: Run) -> list[Consequence]:
    """
    Return the figures of the loop with the nominal and the improved model, and as measured.

    model: nominal parameters of the actuator; run: the recording; measured figures are given if
    it holds a closed loop. With a baseline the healthy machine stands for the nominal model.
    """
    known = {p.name for p in (*COMPENSATOR_PARAMETERS, *REFERENCE_PARAMETERS)}
    recorded_settings = {name: value for name, value
                         in run.information.get('controller', {}).items() if name in known}
    recorded = bool(recorded_settings) and run.reference_n is not None
    controller = recorded_settings if recorded else PLAIN
    rate_hz = float(np.clip(1.0 / run.period_s, *RATES_HZ))
    duration_s = min(run.duration_s, LONGEST_S) if recorded else 1.0
    best = [diagnosis.best(weighed) for weighed in diagnosis.groups]

    def loop(records: Sequence[np.void], lowest: Sequence[float]) -> dict[str, float | None]:
        return loop_figures(improved_model(model, records)[0], controller, rate_hz, duration_s,
                            lowest)

    before = improved_of(diagnosis.healthy, model) if diagnosis.healthy else model
    nominal = loop_figures(before, controller, rate_hz, duration_s, LOWEST_GAINS)
    improved = loop([candidate.fitted.record for candidate in best], LOWEST_GAINS)
    known_gain = improved['onset_gain']
    lowest = [NEAR * known_gain] if known_gain else []
    rng = np.random.default_rng(1)
    fits = [(candidate.fitted, likelihood(candidate.fitted)) for candidate in best]
    drawn = [[draw(fitted, found, rng) for fitted, found in fits] for _ in range(DRAWS)]
    others = list(in_threads(lambda records: loop(records, lowest), drawn))
    # All three over the same time, in which the reference is the same.
    measured = _figures_of(run[0.0:duration_s]) if recorded else {}
    return [Consequence(name, nominal[name], improved[name],
                        *_interval(improved[name], [each[name] for each in others]),
                        measured.get(name)) for name in improved]


def loop_figures(actuator: Values, controller: Values, rate_hz: float, duration_s: float,
                 lowest: Sequence[float]) -> dict[str, float | None]:
    """
    Return onset gain, frequency and amplitude of the limit cycle, and the figures of a run.

    lowest: start gains of the search for the onset, tried in turn.
    """
    found: dict[str, float | None] = dict.fromkeys(
        ('onset_gain', 'onset_frequency_hz', 'onset_amplitude_n'))
    try:
        onsets = (onset(actuator, {**controller, 'reference.shape': 'step'}, rate_hz, low,
                        ACCURACY) for low in lowest)
        first = next((each for each in onsets if each is not None), None)
        if first is not None:
            found = dict(zip(found, first[:3], strict=True))
        simulated = simulate_loop(actuator, controller, duration_s, rate_hz)
    except ParameterError:   # a compensator that this rate does not allow
        return found | dict.fromkeys((*LOOP_KEYS, 'oscillation_frequency_hz',
                                      'oscillation_amplitude_n'))
    return found | _figures_of(Run(**simulated._asdict()))


def _figures_of(run: Run) -> dict[str, float | None]:
    measures: dict[str, Any] = analyze(run)
    oscillation = measures['oscillation'] if measures['oscillation']['sustained'] else {}
    return {**{key: measures[key] for key in LOOP_KEYS},
            'oscillation_frequency_hz': oscillation.get('frequency_hz'),
            'oscillation_amplitude_n': oscillation.get('amplitude_n')}


def _interval(value: float | None, drawn: Sequence[float | None]
              ) -> tuple[float | None, float | None]:
    """Return the 95 % interval; None if the value, or that of a drawn model, is missing."""
    known = [each for each in drawn if each is not None]
    if value is None or len(known) < len(drawn):
        return None, None
    half = LIMIT_95 * float(np.sqrt(np.mean((np.array(known) - value) ** 2)))
    return value - half, value + half
