"""What `asi analyze` says of a run: step, bandwidth and oscillation, as one plain dictionary."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.measures.frequency_response import actuator_bandwidth, loop_bandwidth
from asi_analysis.measures.oscillation import oscillation
from asi_analysis.measures.step_response import Step, headline, step_responses


def step_as_dict(step: Step) -> dict[str, Any]:
    """Return a step with the keys of doc/reference/json.md."""
    return step._asdict() | {'monotone_rise': step.monotone_rise, 'notes': list(step.notes)}


def _why_no_step(run: Run) -> str:
    if run.reference_n is None:
        return 'step: the run holds no reference'
    if run.controlled() != 'force':
        return f'step: measured of forces only, the reference asks for a {run.controlled()}'
    return 'step: the reference makes none'


def analyze(run: Run) -> dict[str, Any]:
    """
    Return all that `asi analyze --json` prints of a run; doc/reference/json.md tells the keys.

    What cannot be measured is None; `notes` says why. Raises InputError for a single sample.
    """
    if len(run) < 2:
        raise InputError(f'{run.source}: one sample is too little: at least 2 are needed')
    steps = step_responses(run)
    step = headline(steps)
    swing = oscillation(run)
    width = loop_bandwidth(run)
    notes = [f'fault at {change.time_s:.6g} s, the valve command is 0 from there on: '
             f'{change.reason}' for change in run.states if change.state == 'fault']
    notes += list(step.notes) if step else [_why_no_step(run)]
    notes += [f'oscillation: {swing.reason}'] if swing.reason else []
    notes += [f'bandwidth: {width.reason}'] if width.reason else []
    headline_keys = ('rise_time_s', 'overshoot_percent', 'settling_time_2_s',
                     'settling_time_5_s', 'steady_state_error_n', 'rise_shape', 'monotone_rise')
    return {
        'source': run.source,
        'samples': len(run),
        'duration_s': run.duration_s,
        'rate_hz': run.rate_hz,
        'unit': run.unit('force'),
        **{key: getattr(step, key) if step else None for key in headline_keys},
        'bandwidth_hz': width.bandwidth_hz,
        'bandwidth_method': width.method,
        # A step excites too little of the command to tell.
        'actuator_bandwidth_hz': (actuator_bandwidth(run) if width.method == 'excitation'
                                  else None),
        'delay_s': width.delay_s,
        'correlation_delay_s': width.correlation_delay_s,
        'oscillation': swing.to_dict(),
        'steps': [step_as_dict(each) for each in steps],
        'states': [change._asdict() for change in run.states],
        'notes': notes,
    }


def analyze_bag(path: Path) -> dict[str, Any]:
    """Read a bag and return what `asi analyze --json` prints. Raises InputError."""
    from asi_analysis.bags.bag import read_bag
    return analyze(read_bag(path))


def as_text(document: Mapping[str, Any]) -> str:
    """Return what could be measured as a table; the notes say why the rest could not."""
    rows = [(name, f'{document[key] * scale:.3g} {unit}') for name, key, unit, scale in (
        ('rise time 10-90 %', 'rise_time_s', 'ms', 1e3),
        ('overshoot', 'overshoot_percent', '%', 1.0),
        ('settling time 2 %', 'settling_time_2_s', 'ms', 1e3),
        ('settling time 5 %', 'settling_time_5_s', 'ms', 1e3),
        ('steady-state error', 'steady_state_error_n', document['unit'], 1.0),
        ('bandwidth', 'bandwidth_hz', 'Hz', 1.0),
        ('bandwidth of the actuator', 'actuator_bandwidth_hz', 'Hz', 1.0),
        ('delay, from the phase', 'delay_s', 'ms', 1e3),
        ('delay, by correlation', 'correlation_delay_s', 'ms', 1e3))
        if document[key] is not None]
    rows.append(('oscillation', oscillation_as_text(document['oscillation'], document['unit'])))
    width = max(len(name) for name, _ in rows)
    return '\n'.join([
        f'{document["source"]}: {document["samples"]} samples, {document["duration_s"]:.6g} s '
        f'at {document["rate_hz"]:g} Hz',
        *(f'{name:{width}}  {value}' for name, value in rows),
        *(f'note: {note}' for note in document['notes'])])


def oscillation_as_text(swing: Mapping[str, Any], unit: str = 'N') -> str:
    """Return the oscillation of a document in a few words."""
    if swing['frequency_hz'] is None:
        return 'none' if swing['sustained'] is False else 'cannot be told'
    return (f'{swing["frequency_hz"]:.1f} Hz, {swing["amplitude_n"]:.3g} {unit}, '
            + ('sustained' if swing['sustained'] else 'dying out'))
