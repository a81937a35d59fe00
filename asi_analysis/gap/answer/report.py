"""The report of `asi gap`: a self-contained HTML file, its pictures and the model file."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from asi_analysis.gap.answer import pictures
from asi_analysis.gap.answer.export import write_export
from asi_analysis.gap.answer.result import LEAST_PROBABILITY, tables
from asi_analysis.gap.diagnosis import Diagnosis
from asi_analysis.gap.model.effects import NO_GAP, UNKNOWN
from asi_analysis.gap.model.predict import measured, predict
from asi_analysis.gap.words import in_words, sentences
from asi_analysis.reporting.report import write_report
from asi_analysis.reporting.result import Pictures, as_html
from asi_common.parameter import Value

WAVES = 12     # of the signal, in the picture of the recording
SHORTEST_S, LONGEST_S = 0.25, 5.0


def write_gap_report(diagnosis: Diagnosis, answer: Mapping[str, Any], out: Path,
                     model: Mapping[str, Value] | None = None) -> Path:
    """
    Write report.html and its pictures into `out`; with a model, improved.yaml too.

    answer: the document of the diagnosis; model: nominal parameters of the actuator, None of a
    joint. Returns the path of report.html.
    """
    missing = None
    if model is not None and diagnosis.verdict:
        out.mkdir(parents=True, exist_ok=True)
        missing = write_export(diagnosis, model, out / 'improved.yaml')['unsaid']
    return write_report(
        out, 'gap.html', drawn(diagnosis, answer), answer=answer, sentences=sentences(answer),
        tables=as_html(tables(answer, chances=False)), missing=missing,
        title=' and '.join(in_words(name, diagnosis.plant)
                           for name in answer['verdict'].split('+')))


def drawn(diagnosis: Diagnosis, answer: Mapping[str, Any]) -> Pictures:
    """Return the pictures of a diagnosis, each with its caption."""
    first: Pictures = {'characteristic': (
        _characteristic(diagnosis, answer), 'The output over the input')
        } if diagnosis.plant == 'static' else {}
    return {**first, 'overlay': (_overlay(diagnosis, answer),
                        'The recording and its models, where the nominal one is worst'),
            'probabilities': (pictures.probabilities(chances(answer)),
                              'Probability of each explanation')}


def chances(answer: Mapping[str, Any]) -> dict[str, float]:
    """Return the probability of the explanations, in words, the most probable first."""
    found = {in_words(row['effect'], answer['plant']): row['probability']
             for row in answer['which'] if row['probability'] >= LEAST_PROBABILITY}
    found |= {name.replace('_', ' '): answer[f'{name}_probability'] for name in (NO_GAP, UNKNOWN)}
    return dict(sorted(found.items(), key=lambda item: -item[1]))


def _characteristic(diagnosis: Diagnosis, answer: Mapping[str, Any]) -> Figure:
    weighed, found = diagnosis.groups[0], answer['characteristic']
    recording = weighed.group.recordings[-1]
    records = {'nominal': weighed.group.as_given}
    if answer['verdict'] != NO_GAP:
        records['improved model'] = diagnosis.best(weighed).fitted.record
    origin = recording.taken
    return pictures.characteristic(
        recording.input + origin['input'], recording.output + origin['output'],
        {name: predict(recording, 'static', p) + origin['output'] for name, p in records.items()},
        (found['input'].replace('_', ' '), found['output'].replace('_', ' ')),
        (found['input_unit'], found['output_unit']))


def _overlay(diagnosis: Diagnosis, answer: Mapping[str, Any]) -> Figure:
    channel, signal = answer['gap']['channel'], answer['gap']['signal']
    weighed = diagnosis.compared(channel)
    number = len(weighed.group.recordings) - 1
    recording = weighed.group.recordings[number]
    real = measured(recording, channel)
    models = {'nominal': predict(recording, channel, weighed.group.as_given)}
    power = (real - models['nominal']) ** 2 * recording.report
    if answer['verdict'] != NO_GAP:
        models['improved model'] = predict(recording, channel,
                                           diagnosis.best(weighed).fitted.record)
    # The section with the largest error of the nominal model.
    rate = float(np.std(np.diff(real)) / np.std(real)) / recording.period_s   # rad/s
    length_s = min(max(WAVES * 2.0 * math.pi / rate, SHORTEST_S), LONGEST_S)
    half = max(int(0.5 * length_s / recording.period_s), 1)
    middle = int(np.argmax(np.convolve(power, np.ones(2 * half), 'same')))
    shown = slice(max(0, middle - half), middle + half)
    return pictures.overlay(
        recording.time_s[shown], real[shown], {name: each[shown] for name, each in models.items()},
        recording.report[shown], signal.replace('_', ' '), diagnosis.runs[number].unit(signal))
