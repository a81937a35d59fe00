"""What `asi analyze` says of a run: step, bandwidth and oscillation, as one plain dictionary."""

from pathlib import Path
from typing import Any

from asi_analysis.errors import InputError
from asi_analysis.frequency_response import actuator_bandwidth, loop_bandwidth
from asi_analysis.oscillation import oscillation
from asi_analysis.run import Run
from asi_analysis.step_response import Step, headline, step_responses


def step_as_dict(step: Step) -> dict[str, Any]:
    """Return a step with the keys of doc/json.md."""
    return step._asdict() | {'monotone_rise': step.monotone_rise, 'notes': list(step.notes)}


def _why_no_step(run: Run) -> str:
    if run.reference_n is None:
        return 'step: the run holds no reference'
    if run.controlled() != 'force':
        return f'step: measured of forces only, the reference asks for a {run.controlled()}'
    return 'step: the reference makes none'


def analyze(run: Run) -> dict[str, Any]:
    """
    Return all that `asi analyze --json` prints of a run; doc/json.md tells the keys.

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
        **{key: getattr(step, key) if step else None for key in headline_keys},
        'bandwidth_hz': width.bandwidth_hz,
        'bandwidth_method': width.method,
        # A step excites too little of the command to tell.
        'actuator_bandwidth_hz': (actuator_bandwidth(run) if width.method == 'excitation'
                                  else None),
        'delay_s': width.delay_s,
        'correlation_delay_s': width.correlation_delay_s,
        'oscillation': {'sustained': swing.sustained, 'frequency_hz': swing.frequency_hz,
                        'amplitude_n': swing.amplitude_n},
        'steps': [step_as_dict(each) for each in steps],
        'states': [change._asdict() for change in run.states],
        'notes': notes,
    }


def analyze_bag(path: Path) -> dict[str, Any]:
    """Read a bag and return what `asi analyze --json` prints. Raises InputError."""
    from asi_analysis.bag import read_bag
    return analyze(read_bag(path))
