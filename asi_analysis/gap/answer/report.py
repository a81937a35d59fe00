"""The report of `asi gap`: a self-contained HTML file, its pictures and the model file."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import welch

from asi_analysis.bags.run import Run
from asi_analysis.gap.answer import pictures
from asi_analysis.gap.diagnose import Diagnosis, hypothesis_name, sentences
from asi_analysis.gap.inference.hypotheses import Weighed
from asi_analysis.gap.inference.probability import Names
from asi_analysis.gap.model.effects import NO_GAP, UNKNOWN
from asi_analysis.gap.model.model_file import improved_model
from asi_analysis.gap.model.predict import measured, predict
from asi_analysis.gap.prepare import BURN_IN_S
from asi_analysis.reporting.report import write_report
from asi_analysis.reporting.result import Pictures
from asi_common.parameter import Value
from asi_common.parameter_file import write_parameters

STRETCH_S = 2.0     # of the overlay
EXPLANATIONS = 5    # effects in the picture of the probabilities
CAPTIONS = {
    'overlay': 'Real, nominal and improved, and the residual of each model',
    'probabilities': 'Probability of each explanation',
    'ranking': 'Residual of each hypothesis on the validation set',
    'plane': 'Residual before and after, over the quantity that the effect depends on',
    'spectrum': 'Spectrum of the signal and of the residual of each model',
    'regimes': 'Size of the gap by frequency, amplitude, motion and time'}


def write_gap_report(diagnosis: Diagnosis, answer: Mapping[str, Any], run: Run, out: Path,
                     model: Mapping[str, Value] | None = None) -> Path:
    """
    Write report.html and its pictures into `out`; with a model, improved.yaml too.

    answer: the document of the diagnosis; run: one of its recordings; model: nominal parameters of
    the actuator, None of a joint. Returns the path of report.html.
    """
    missing = None
    if model is not None and diagnosis.verdict:
        values, missing = improved_model(model, [diagnosis.best(w).fitted.record
                                                 for w in diagnosis.groups])
        out.mkdir(parents=True, exist_ok=True)
        write_parameters(out / 'improved.yaml', '/**/asi_actuator', dict(sorted(values.items())))
    return write_report(out, 'gap.html', drawn(diagnosis, answer, run, joint=model is None),
                        answer=answer, sentences=sentences(answer), missing=missing)


def drawn(diagnosis: Diagnosis, answer: Mapping[str, Any], run: Run, joint: bool) -> Pictures:
    """Return the pictures of a diagnosis, each with its caption."""
    channel = answer['gap']['channel']
    weighed = next(w for w in diagnosis.groups if channel in w.group.channels)
    name = _output_signal(channel, run, joint)
    label, unit = name.replace('_', ' '), run.unit(name)
    figures = {'overlay': _overlay(diagnosis, weighed, channel, label, unit),
            'probabilities': pictures.probabilities(chances(answer)),
            'ranking': _ranking(weighed, channel, diagnosis.best(weighed).names, answer),
            'plane': _plane(diagnosis, weighed, channel, run, unit),
            'spectrum': _spectrum(diagnosis, weighed, channel, label, unit),
            'regimes': pictures.regimes(answer['regimes'])}
    return {name: (figure, CAPTIONS[name]) for name, figure in figures.items()}


def chances(answer: Mapping[str, Any]) -> dict[str, float]:
    """Return the probability of the likeliest explanations, `no_gap` and `unknown` among them."""
    found = {row['effect']: row['probability'] for row in answer['which'][:EXPLANATIONS]}
    found |= {NO_GAP: answer['no_gap_probability'], UNKNOWN: answer['unknown_probability']}
    return dict(sorted(found.items(), key=lambda item: -item[1]))


def _output_signal(channel: str, run: Run, joint: bool) -> str:
    """Return the signal that a channel predicts; `valve` is the drive or servo of a joint."""
    if channel == 'motion':
        return 'velocity'
    if channel != 'valve':
        return 'force' if run.force_n is not None else 'command'
    if not joint:
        return 'valve_position'
    return 'force' if run.command_n is not None else run.controlled()


def _overlay(diagnosis: Diagnosis, weighed: Weighed, channel: str, label: str, unit: str) -> Any:
    recording = weighed.group.recordings[-1]
    real = measured(recording, channel)
    nominal = predict(recording, channel, weighed.group.nominal)
    improved = predict(recording, channel, diagnosis.best(weighed).fitted.record)
    count = int(STRETCH_S / recording.period_s)
    # The section with the largest residual of the nominal model.
    power = np.convolve((real - nominal) ** 2 * recording.report, np.ones(count), 'same')
    middle = int(np.argmax(power))
    chosen = slice(max(0, middle - count // 2), middle + count // 2)
    return pictures.overlay(recording.time_s[chosen], real[chosen], nominal[chosen],
                            improved[chosen], recording.report[chosen], label, unit)


def _spectrum(diagnosis: Diagnosis, weighed: Weighed, channel: str, label: str, unit: str) -> Any:
    recording = weighed.group.recordings[-1]
    real = measured(recording, channel)
    residuals = {'real': real} | {name: real - predict(recording, channel, p) for name, p in (
        ('nominal', weighed.group.nominal), ('refitted', weighed.candidates[()].fitted.record),
        ('improved', diagnosis.best(weighed).fitted.record))}
    judged = slice(int(BURN_IN_S / recording.period_s), None)
    frequency, _ = welch(real[judged], 1.0 / recording.period_s, nperseg=_window(real))
    powers = {name: welch(values[judged], 1.0 / recording.period_s, nperseg=_window(real))[1]
              for name, values in residuals.items()}
    return pictures.spectrum(frequency, powers, label, unit)


def _window(values: Any) -> int:
    return min(values.size // 4, 2048)


def _ranking(weighed: Weighed, channel: str, verdict: Names, answer: Mapping[str, Any]) -> Any:
    size = math.sqrt(float(np.mean([np.mean(measured(r, channel)[r.held_out] ** 2)
                                    for r in weighed.group.recordings])))
    residuals = sorted((math.sqrt(c.fitted.held_out[channel]) / size, hypothesis_name(names))
                       for names, c in weighed.candidates.items() if names)[:12]
    null = math.sqrt(weighed.candidates[()].fitted.held_out[channel]) / size
    return pictures.ranking([name for _, name in residuals], [error for error, _ in residuals],
                            hypothesis_name(verdict), null,
                            max(answer['gap']['noise_floor_nrmse'], 1e-6))


def _plane(diagnosis: Diagnosis, weighed: Weighed, channel: str, run: Run, unit: str) -> Any:
    recording = weighed.group.recordings[-1]
    real = measured(recording, channel)
    if channel == 'valve':
        x, driven = recording.command, 'reference' if run.command_n is None else 'command'
        label = f'{driven} ({run.unit(driven)})'
    else:
        motion = recording.motion
        if motion is not None:
            x = motion.velocity[motion.pad:motion.pad + real.size]
            label = 'velocity ({})'.format(run.unit('velocity') if run.velocity_m_s is not None
                                           else run.unit('position') + '/s')
        else:
            x, label = recording.valve_position, 'valve position (m)'
    assert x is not None
    judged = recording.report
    before = real - predict(recording, channel, weighed.candidates[()].fitted.record)
    after = real - predict(recording, channel, diagnosis.best(weighed).fitted.record)
    return pictures.plane(x[judged], before[judged], after[judged], label, unit)
