"""The figures of the limit cycle with the change that twice the resolution makes to each."""

import math

from asi_actuator.parameters import as_record
from asi_analysis.loop.bench import RATE_HZ, Values
from asi_analysis.loop.describing_functions import SAMPLES
from asi_analysis.loop.onset import Onset, disagreement, fold
from asi_analysis.paper.facts import measures
from asi_analysis.paper.facts.conditions import LOCKED, Conditions
from asi_analysis.paper.facts.converged import Converged, converged
from asi_analysis.paper.facts.measures import Measured, onset_name


def refined(actuator: Values, conditions: Conditions, refinement: int
            ) -> tuple[Values, Conditions]:
    """Return the actuator with shorter sub-steps and the conditions with longer searches."""
    substep = float(as_record(actuator)['maximum_substep']) / refinement
    return {**actuator, 'maximum_substep': substep}, conditions._replace(
        onset_accuracy=conditions.onset_accuracy / refinement,
        onset_watched_s=conditions.onset_watched_s * refinement)


def figures(actuator: Values, conditions: Conditions, refinement: int = 1) -> Measured:
    """Return the figures of the limit cycle and its prediction (F6 to F13) at a refinement."""
    actuator, conditions = refined(actuator, conditions, refinement)
    measured = measures.onsets(actuator, conditions)
    gain = measured[onset_name(conditions.cycle_step_n, 'gain')]
    accuracy = 0.01 / refinement
    return {
        **measured,
        **measures.onset_rise(measured, conditions),
        **measures.onset_frequencies(actuator, conditions, measured),
        **measures.high_gain_cycle(actuator, conditions, gain),
        **measures.same_cycle(actuator, conditions, gain),
        **measures.describing(actuator, SAMPLES * refinement),
        **measures.prediction_error(actuator, conditions, gain),
        'linear_onset_ratio': measures.free_onset(
            actuator, conditions, measures.HYSTERESIS_AS_GAIN, gain, 3.0, accuracy),
        'no_hysteresis_onset_ratio': measures.free_onset(
            actuator, conditions, measures.NO_HYSTERESIS, gain, 3.0, accuracy)}


def onset_notes(actuator: Values, conditions: Conditions, gains: Measured) -> dict[str, str]:
    """Return what to say of each onset that is not the fold of harmonic balance, by name."""
    notes: dict[str, str] = {}
    for step in conditions.onset_steps_n:
        gain = gains[onset_name(step, 'gain')]
        if not math.isfinite(gain):
            continue
        controller = measures.step_settings(conditions, gain, step)
        at = fold({**actuator, **LOCKED}, controller, RATE_HZ, gain)
        note = disagreement(Onset(gain, math.nan, math.nan, math.nan), at)
        notes |= {onset_name(step, quantity): note for quantity in ('gain', 'frequency_hz')
                  if note}
    return notes


def limit_cycle(actuator: Values, conditions: Conditions | None = None) -> dict[str, Converged]:
    """Return the figures of the limit cycle, each with its change at twice the resolution."""
    conditions = conditions or Conditions()
    found = converged(lambda refinement: figures(actuator, conditions, refinement))
    notes = onset_notes(actuator, conditions, {
        name: figure.value for name, figure in found.items()})
    return {name: figure._replace(note=notes.get(name, '')) for name, figure in found.items()}
