"""`analyze`: step response, bandwidth, delay and oscillation of a run together."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import zip_longest
from typing import Any, Final

import numpy as np

from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.measures import oscillation as measure
from asi_analysis.measures.correlation import repetition
from asi_analysis.measures.frequency_response import (
    actuator_bandwidth,
    frequency_response,
    loop_bandwidth,
)
from asi_analysis.measures.quality import Finding, check_rate, check_size, findings, trust
from asi_analysis.measures.step_response import HEADLINE, StepResponse, step_response
from asi_analysis.measures.tracking import tracking
from asi_analysis.reporting.result import Pictures, Result, Table, number

# Largest share of missing samples for a spectrum or the fit of a sine.
LOST_SHARE: Final = 0.01
DRIVEN: Final = ('oscillation: no reference is recorded, so this may be what moved it from '
                 'outside; asi limit-cycle asks that')


class Analysis(Result):
    """
    The result of `analyze`, with the keys of `asi analyze --json`.

    `run` is the recording, `step` its step response.
    """

    title = 'Analysis of a run'
    rows = 'steps'
    run: Run
    step: StepResponse

    def parts(self) -> Iterator[str | Table]:
        yield (f'{self.source}: {self.samples} samples, {self.duration_s:.6g} s '
               f'at {self.rate_hz:g} Hz')
        rows = self.step.measures()
        rows += [(name, number(self[key] * scale, unit, 3)) for name, key, unit, scale in (
            ('bandwidth', 'bandwidth_hz', 'Hz', 1.0),
            ('bandwidth from the command', 'actuator_bandwidth_hz', 'Hz', 1.0),
            ('delay, from the phase', 'delay_s', 'ms', 1e3),
            ('delay, by correlation', 'correlation_delay_s', 'ms', 1e3),
            ('tracking error, rms', 'tracking_error_rms_n', self.unit, 1.0),
            ('tracking error, largest', 'tracking_error_peak_n', self.unit, 1.0),
            ('tracking error, of the reference', 'tracking_error_percent', '%', 1.0),
            ('command, rms', 'command_rms_n', self.run.unit('command'), 1.0),
            ('impedance felt, real part', 'impedance_real', 'N s/m', 1.0))
            if self[key] is not None]
        yield Table(('', ''), [*rows, ('oscillation', in_words(self.oscillation, self.unit))])
        yield from (f'note: {note}' for note in self.notes)

    def pictures(self) -> Pictures:
        pictures: Pictures = self.step.pictures() if self.steps else {}
        if self.bandwidth_method == 'excitation':
            pictures = {**pictures, **frequency_response(self.run).pictures()}
        if not pictures:
            raise InputError('neither a step nor a frequency response to draw: use run.plot()')
        return pictures


def analyze(run: Run, signal: str | None = None) -> Analysis:
    """
    Measure step response, bandwidth, delay and oscillation of a run: `asi analyze`.

    run: a recording of n samples, at least 2; signal: force, position, velocity, pressure or any
    other that was recorded, by default the one that the reference controls. Figures in its unit,
    `Run.unit`. What cannot be measured is None, and `notes` says why. Raises InputError for one
    sample, samples in bursts, or a signal that was not recorded.

    >>> import asi_analysis as asi
    >>> run = asi.simulate({}, {'compensator': 'lead4', 'reference.amplitude': 100.0}, 0.4)
    >>> analysis = asi.analyze(run)
    >>> print(f'{1e3 * analysis.rise_time_s:.1f} ms, {analysis.bandwidth_hz:.0f} Hz')
    6.2 ms, 80 Hz
    >>> analysis.oscillation['sustained']
    False
    """
    if len(run) < 2:
        raise InputError(f'{run.source}: one sample is too little: at least 2 are needed')
    check_size(run)
    check_rate(run.time_s, run.source)
    name = run.output(signal)
    step, swing, width = (step_response(run, name), measure.oscillation(run, name),
                          loop_bandwidth(run, name))
    notes = [*_faults(run), *step.notes]
    notes += [f'oscillation: {swing.reason}'] if swing.reason else []
    if swing.frequency_hz and run.reference_n is None:
        notes.append(DRIVEN)
    notes += [f'bandwidth: {width.reason}'] if width.reason else []
    # A step excites too few frequencies of the valve command.
    actuator, doubt = (actuator_bandwidth(run, name, width.lowest_hz)
                       if width.method == 'excitation' else (None, None))
    notes += [f'bandwidth from the command: {doubt}'] if doubt else []
    figures = ({'bandwidth_hz': width.bandwidth_hz, 'bandwidth_method': width.method,
                'actuator_bandwidth_hz': actuator, 'delay_s': width.delay_s,
                'correlation_delay_s': width.correlation_delay_s}
               | tracking(run, name)._asdict() | {'oscillation': swing.to_dict()})
    reliable = dict(step.reliable)
    notes += _withhold_doubtful(run, name, step, findings(run), figures, reliable)
    for figure, reason in (('bandwidth_hz', width.reason), ('actuator_bandwidth_hz', doubt)):
        if reason and figures[figure]:
            reliable[figure] = False
    return Analysis({
        'source': run.source,
        'samples': len(run),
        'duration_s': run.duration_s,
        'rate_hz': run.rate_hz,
        'signal': name,
        'unit': step.unit,
        **{key: step[key] for key in HEADLINE},
        **figures,
        'steps': step.steps,
        'states': [change._asdict() for change in run.states],
        'notes': notes,
        'quality': step.quality,
        'reliable': reliable,
    }, run=run, step=step)


def _faults(run: Run) -> Iterator[str]:
    """Yield a sentence on each fault of the actuator, and on its end by a reset."""
    for change, after in zip_longest(run.states, run.states[1:]):
        if change.state == 'fault':
            until = f'until {after.time_s:.6g} s' if after else 'from there on'
            yield (f'fault at {change.time_s:.6g} s, the valve command is 0 {until}: '
                   f'{change.reason}')


class Oscillation(Result):
    """
    The result of `oscillation`.

    sustained: None if it cannot be determined; reason says why. `run` is the recording.
    """

    title = 'Oscillation'
    run: Run

    def parts(self) -> Iterator[str | Table]:
        yield Table(('', ''), [('oscillation', in_words(self, self.run.unit(self.signal)))])
        if self.reason:
            yield f'note: {self.reason}'

    def pictures(self) -> Pictures:
        from asi_analysis.reporting import figures
        if not self.frequency_hz:
            raise InputError(self.reason or 'no oscillation to draw')
        reference = self.run.reference_n
        if reference is None or self.signal != self.run.controlled():
            reference = np.full(len(self.run), np.nan)
        words = self.signal.replace('_', ' ')
        return {'oscillation': (figures.oscillation_in_time(
            self.run.time_s, self.run.signal(self.signal), reference, 8.0 / self.frequency_hz,
            f'{words} ({self.run.unit(self.signal)})'),
            f'{words.capitalize()} over time, and its last cycles')}


def oscillation(run: Run, signal: str | None = None) -> Oscillation:
    """
    Return whether a signal oscillates in the steady part of a run, its frequency and amplitude.

    signal: by default the controlled one or the force. The steady part is the second half of the
    time after the last jump of the reference; what a periodic reference forces is taken out.
    Frequency in Hz, amplitude of the fundamental in the unit of the signal. Raises InputError for
    a signal that was not recorded.

    >>> import asi_analysis as asi
    >>> run = asi.simulate({}, {'gain': 10.0, 'reference.amplitude': 100.0}, 1.0)
    >>> print(asi.oscillation(run))
    oscillation  88.2 Hz, 225 N, sustained
    """
    name = run.output(signal)
    found = measure.oscillation(run, name)
    return Oscillation({**found.to_dict(), 'signal': name, 'reason': found.reason}, run=run)


def _withhold_doubtful(run: Run, measured: str, step: StepResponse, found: Sequence[Finding],
                       figures: dict[str, Any], reliable: dict[str, bool]) -> list[str]:
    """Set figures that rest on doubtful samples to None; return a note on each."""
    start, end = float(run.time_s[0]), float(run.time_s[-1])
    notes: list[str] = []
    by_step = figures['bandwidth_method'] == 'step'
    repeats_s = 0.0
    if figures['correlation_delay_s'] is not None and run.reference_n is not None:
        repeats_s = run.period_s * repetition(np.nan_to_num(run.reference_n))
    for name, words, signals in (
            ('bandwidth_hz', 'bandwidth', ('reference', measured)),
            ('actuator_bandwidth_hz', 'bandwidth from the command', ('command', measured)),
            ('delay_s', 'delay', ('reference', measured)),
            ('correlation_delay_s', 'delay by correlation', ('reference', measured)),
            ('tracking_error_rms_n', 'tracking error', ('reference', measured)),
            ('tracking_error_peak_n', 'largest tracking error', ('reference', measured)),
            ('tracking_error_percent', 'share of the tracking error', ('reference', measured)),
            ('command_rms_n', 'command', ('command',)),
            ('impedance_real', 'impedance', ('force', 'velocity')),
            ('impedance_imaginary', 'impedance', ('force', 'velocity'))):
        trusted = trust(found, run, signals, start, end, LOST_SHARE, whole=True)
        if by_step and name == 'bandwidth_hz':
            # It was measured from the step response.
            reliable[name] = step.reliable.get('settling_time_2_s', True)
            if not reliable[name]:
                marked = bool(step.rise_time_s)
                figures[name] = figures[name] if marked else None
                notes.append(f'bandwidth: {"doubtful" if marked else "withheld"}, as the step '
                             'response is')
            continue
        reliable[name] = trusted.reliable
        if figures[name] is None:
            continue
        if figures[name] < -run.period_s and 'delay' in name:
            reliable[name] = False
            notes.append(f'{words}: doubtful, the output precedes the reference')
        if 'delay' in name and repeats_s and figures[name] > 0.5 * repeats_s:
            reliable[name] = False
            notes.append(f'{words}: doubtful, as the reference repeats after '
                         f'{1e3 * repeats_s:.4g} ms: a shorter one fits too')
        held = [each.text for each in found if each.kind == 'held' and each.signal in signals]
        if held and 'delay' in name:
            reliable[name] = False
            notes.append(f'{words}: doubtful, as {held[0]}')
        notes += trusted.note(words)
        if trusted.withheld:
            figures[name] = None
    trusted = trust(found, run, (measured, 'reference'), 0.5 * (start + end), end, LOST_SHARE,
                    whole=True)
    reliable['oscillation'] = trusted.reliable
    notes += trusted.note('oscillation')
    if trusted.withheld:
        figures['oscillation'] = dict.fromkeys(figures['oscillation'])
    return list(dict.fromkeys(notes))   # both parts of the impedance have one


def in_words(swing: Mapping[str, Any], unit: str = 'N') -> str:
    """Return the oscillation of a JSON document in words."""
    if swing['frequency_hz'] is None:
        return 'none' if swing['sustained'] is False else 'cannot be told'
    course = {True: 'sustained', False: 'dying out', None: 'in bursts'}[swing['sustained']]
    digits = '.1f' if swing['frequency_hz'] >= 1.0 else '.3g'
    return f'{swing["frequency_hz"]:{digits}} Hz, {swing["amplitude_n"]:.3g} {unit}, {course}'
