"""
`asi gap check`: diagnose a directory of blind cases and count the right verdicts.

Any examiner may write such a directory (doc/how_to/blind_cases.md). The diagnosis reads bags
and model files; the sealed answers are opened only after the last case.
"""

import base64
import json
import math
import time
import warnings
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from asi_analysis.bags.bag import read_bag
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError, InputWarning
from asi_analysis.gap.answer import pictures
from asi_analysis.gap.answer.command import diagnose
from asi_analysis.gap.diagnosis import Diagnosis
from asi_analysis.gap.document import main_shrink
from asi_analysis.gap.inference.hypotheses import evidence_of
from asi_analysis.gap.inference.probability import as_plain
from asi_analysis.gap.model.effects import (
    BLOCK_OF,
    NO_GAP,
    PARAMETER,
    UNKNOWN,
    block_of,
)
from asi_analysis.gap.model.group import exact, prepared_for
from asi_analysis.gap.model.predict import unexplained
from asi_analysis.gap.model.static import like
from asi_analysis.gap.prepare import prepare
from asi_analysis.parallel import each
from asi_analysis.reporting import figures
from asi_analysis.reporting.result import Result, Table, table_of
from asi_analysis.terminal import Progress
from asi_common.files import read_bytes, read_text, write_text
from asi_common.parameter import ParameterError

# Largest list of cases, and largest answers, bytes.
MOST_CASES: Final = 2**24
CONFIDENT = 0.9   # probability from which a wrong verdict counts as confidently wrong
VISIBLE = 2.0   # an effect is visible if its residual (rms) is above this multiple of the noise
BINS = (0.0, 0.3, 0.5, 0.7, 0.8, 0.9, 0.97, 1.0001)

Row = dict[str, Any]


def fresh_shrink(diagnosis: Diagnosis, run: Run) -> float:
    """Return the shrink of the gap on another recording of the same machine."""
    shrink = main_shrink(diagnosis)
    weighed = diagnosis.compared(shrink.channel)
    group = weighed.group
    recording = like(group, run) if diagnosis.plant == 'static' else prepare([run])[0]
    valid, none = recording.valid, np.zeros_like(recording.fit)
    recording = prepared_for(group, replace(recording, fit=none))   # no fitted initial state
    errors = []
    for p in (group.as_given, diagnosis.best(weighed).fitted.record):
        left = unexplained(recording, shrink.channel, exact(group, p))
        errors.append(math.sqrt(float(np.mean(left[valid] ** 2))))
    return 1.0 - errors[1] / errors[0] if errors[0] else 0.0


def examine(folder: Path, entry: Mapping[str, Any]) -> Row:
    """
    Return the diagnosis of one case, without its answer; `warnings`: what it warned of.

    A ParameterError of the diagnosis names the case.
    """
    started = time.process_time()
    with warnings.catch_warnings(record=True) as found:   # of this case, not of the check
        warnings.simplefilter('always', InputWarning)
        try:
            row = _diagnosed(folder, entry)
        except InputError as error:
            row = {'verdict': 'refused', 'probability': 0.0, 'where': [], 'which': [],
                   'ambiguity_set': [], 'gap': None, 'why': str(error)}
        except ParameterError as error:
            raise ParameterError(f'{folder / entry["bag"]}: {error}') from error
    return {'bag': entry['bag'], **row, 'warnings': [str(each.message) for each in found],
            'seconds': row.get('seconds', time.process_time() - started)}


def _diagnosed(folder: Path, entry: Mapping[str, Any]) -> Row:
    """Return the diagnosis of a case."""
    started = time.process_time()
    plant = entry.get('plant', 'actuator')
    for key in ('more', 'baseline'):
        if not isinstance(entry.get(key) or [], list):
            raise InputError(f'{key} = {entry[key]!r} is no list of bags')
    if plant == 'joint' and 'fresh' in entry:
        raise InputError('fresh takes an actuator or a characteristic: the shrink on another '
                         'recording of a joint is not checked')
    runs, healthy = ([read_bag(folder / name) for name in names] for names in (
        (entry['bag'], *(entry.get('more') or ())), entry.get('baseline') or ()))
    answer = diagnose(runs, folder / entry['model'] if entry.get('model') else None, plant,
                      baseline=healthy)
    diagnosis = answer.diagnosis
    row = {key: answer[key] for key in ('verdict', 'probability', 'where', 'which',
                                        'ambiguity_set', 'gap', 'channels')}
    row['seconds'] = time.process_time() - started
    row['evidence'] = [as_plain(evidence_of(w.group, w.candidates)) for w in diagnosis.groups]
    if 'fresh' in entry:
        row['fresh_shrink'] = fresh_shrink(diagnosis, read_bag(folder / entry['fresh']))
    return row


def run_cases(folder: Path, progress: Progress) -> list[Row]:
    """
    Return the diagnosis of every case of a directory.

    Each result is appended to rows.jsonl, so that an interrupted check can be continued.
    """
    try:
        reading = folder / 'cases.json'
        index = json.loads(read_text(reading, MOST_CASES))
        reading = path = folder / 'rows.jsonl'
        lines = read_text(path, MOST_CASES).splitlines(keepends=True) if path.exists() else []
        whole = [line for line in lines if line.endswith('\n')]   # the last may be incomplete
        rows = [json.loads(line) for line in whole]
        done = {row['bag'] for row in rows}
        left = [entry for entry in index if entry['bag'] not in done]
    except (OSError, ValueError, TypeError, LookupError, RecursionError) as error:
        raise InputError(f'{reading} cannot be read: {_reason(error)}') from None
    write_text(path, ''.join(whole))

    def report() -> None:
        progress(f'{len(rows)} of {len(index)} cases diagnosed', len(rows) / max(len(index), 1))

    report()
    with path.open('a') as file:
        for row in each(examine, ((folder, entry) for entry in left)):
            rows.append(row)
            file.write(json.dumps(rows[-1]) + '\n')
            file.flush()
            report()
    return sorted(rows, key=lambda row: row['bag'])


def truth_of(answer: Mapping[str, Any]) -> str:
    """Return the right verdict: the effects joined by +, no_gap or unknown."""
    if answer['kind'] in ('none', 'small'):
        return NO_GAP
    if answer['kind'] == 'outside':
        return UNKNOWN
    return '+'.join(sorted({name if block_of(name) else UNKNOWN for name in answer['effects']}))


def is_right(row: Row, answer: Mapping[str, Any]) -> bool:
    """Return whether a verdict is right; of an effect that is too small, also `no_gap`."""
    small = answer['kind'] == 'small' and row['verdict'] in answer['effects']
    return is_truth(row['verdict'], answer) or small


def is_truth(verdict: str, answer: Mapping[str, Any]) -> bool:
    """Return whether a verdict is the truth, with or without further effects of the case."""
    truth = truth_of(answer)
    besides = set(answer.get('also', ())) - set(truth.split('+'))
    return set(verdict.split('+')) - besides == set(truth.split('+'))


def parameters_beyond(answer: Mapping[str, Any]) -> list[str]:
    """Return the nominal parameters that are beyond their tolerance besides the effects."""
    return [name for name in answer.get('also', ()) if name.startswith(PARAMETER)]


def sizes_held(row: Row, answer: Mapping[str, Any]) -> list[bool]:
    """Return, for each known size of a right effect, whether its 95 % interval contains it."""
    right = [entry for entry in row['which'] if entry['effect'] in answer['effects']
             and entry['effect'] in row['verdict'].split('+')]
    return [entry['parameters_low'][name] <= size <= entry['parameters_high'][name]
            for name, size in answer.get('sizes', {}).items()
            for entry in right if name in entry['parameters']]


def _share(values: Sequence[bool]) -> float | None:
    """Return the share of true values; None of an empty list."""
    return float(np.mean(values)) if len(values) else None


def _is_visible(row: Row) -> bool:
    """Return whether the refitted model leaves more than VISIBLE times the noise of a signal."""
    return any(channel['refitted_nrmse'] > VISIBLE * channel['noise_floor_nrmse']
               for channel in row.get('channels', ()))


def score(rows: Sequence[Row], answers: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the figures of `asi gap check` from the diagnoses and the answers."""
    both = [(row, answers[row['bag']]) for row in rows]
    single = [(r, a) for r, a in both if a['kind'] == 'effect']
    pairs = [(r, a) for r, a in both if a['kind'] == 'pair']
    kinds = {kind: [(r, a) for r, a in both if a['kind'] == kind]
             for kind in ('none', 'small', 'outside', 'mixed')}

    def first(row: Row) -> str | None:
        return row['which'][0]['effect'] if row['which'] else None

    def finds(row: Row, answer: Mapping[str, Any], also: Sequence[str] = ()) -> bool:
        return (first(row) in (answer['effects'][0], *also)
                and row['verdict'] not in (NO_GAP, UNKNOWN))

    visible = [(r, a) for r, a in single if _is_visible(r)]
    named = [[w['effect'] for w in r['which'] if w['probability'] > 0.5] for r, _ in pairs]
    right = [is_right(r, a) for r, a in both]
    said = [r['probability'] for r, _ in both]
    bins = [[i for i, p in enumerate(said) if low <= p < high]
            for low, high in zip(BINS[:-1], BINS[1:], strict=True)]
    reliability = [{'said': float(np.mean([said[i] for i in chosen])),
                    'right': float(np.mean([right[i] for i in chosen])), 'cases': len(chosen)}
                   for chosen in bins if chosen]
    fresh = [(r['gap'], r['fresh_shrink']) for r, a in both
             if r.get('fresh_shrink') is not None and r['verdict'] not in (NO_GAP, UNKNOWN)]
    seconds = [r['seconds'] for r in rows]
    by_excitation = {kind: _share([first(r) == a['effects'][0] for r, a in single
                                   if a['excitation'] == kind])
                     for kind in sorted({a['excitation'] for _, a in single})}
    by_effect = {name: _share([first(r) == name for r, a in single if a['effects'] == [name]])
                 for name in BLOCK_OF}
    return {
        'cases': len(rows),
        'block_accuracy': _share([bool(r['where']) and r['where'][0]['block'] == a['blocks'][0]
                                  for r, a in single]),
        'effect_accuracy': _share([finds(r, a) for r, a in single]),
        'effect_or_parameter_accuracy': _share([finds(r, a, parameters_beyond(a))
                                                for r, a in single]),
        'visible_effect_accuracy': _share([finds(r, a) for r, a in visible]),
        'ambiguity_coverage': _share([any(is_truth(names, a) for names in r['ambiguity_set'])
                                      for r, a in single]),
        'mean_ambiguity_size': float(np.mean([len(r['ambiguity_set']) for r, _ in single]))
        if single else None,
        'false_alarm_rate': _share([r['verdict'] not in (NO_GAP, 'refused')
                                    for r, _ in kinds['none']]),
        'small_wrong_rate': _share([not is_right(r, a) for r, a in kinds['small']]),
        'unknown_rate': _share([UNKNOWN in r['verdict'] for r, _ in kinds['outside']]),
        'mixed_rate': _share([is_truth(r['verdict'], a) for r, a in kinds['mixed']]),
        'mixed_effect_rate': _share([bool(set(r['verdict'].split('+')) & set(a['effects']))
                                     for r, a in kinds['mixed']]),
        'pair_rate': _share([set(a['effects']) <= set(names)
                             for names, (_, a) in zip(named, pairs, strict=True)]),
        'pair_one_rate': _share([bool(set(a['effects']) & set(names))
                                 for names, (_, a) in zip(named, pairs, strict=True)]),
        'confidently_wrong_rate': _share([p >= CONFIDENT and not ok
                                          for p, ok in zip(said, right, strict=True)]),
        'calibration_error': float(sum(abs(b['said'] - b['right']) * b['cases']
                                       for b in reliability) / len(rows)),
        'shrink_within_005': _share([abs(gap['shrink'] - value) <= 0.05 for gap, value in fresh]),
        'interval_coverage': _share([gap['shrink_low'] <= value <= gap['shrink_high']
                                     for gap, value in fresh]),
        'size_coverage': _share([held for r, a in both for held in sizes_held(r, a)]),
        'median_seconds': float(np.median(seconds)),
        'refused': sum(r['verdict'] == 'refused' for r in rows),
        'by_kind': {kind: len(chosen) for kind, chosen in (
            ('effect', single), ('pair', pairs), *kinds.items())},
        'by_excitation': by_excitation, 'by_effect': by_effect, 'reliability': reliability,
        'wrong': [{'bag': r['bag'], 'truth': truth_of(a), 'verdict': r['verdict'],
                   'probability': r['probability']}
                  for (r, a), ok in zip(both, right, strict=True) if not ok],
    }


def unseal(path: Path) -> dict[str, Any]:
    """Return the answers of a directory of cases: sealed (base 85 of zlib) or plain JSON."""
    try:
        raw = read_bytes(path, MOST_CASES)
        return json.loads(raw if raw[:1] == b'{' else zlib.decompressobj().decompress(
            base64.b85decode(raw), MOST_CASES))
    except (OSError, ValueError, RecursionError, zlib.error) as error:
        raise InputError(f'{path} cannot be read as answers: {_reason(error)}') from None


def _reason(error: Exception) -> str:
    """Return the reason of an error without the path."""
    return getattr(error, 'strerror', None) or str(error)


# The value to reach, by figure of the check.
REACH: Final = {
    'block_accuracy': '0.97', 'effect_accuracy': '0.95',
    'effect_or_parameter_accuracy': '0.85 beyond the tolerance',
    'visible_effect_accuracy': '0.99 of the own world', 'ambiguity_coverage': '0.97',
    'mean_ambiguity_size': 'at most 1.5', 'false_alarm_rate': 'at most 0.03',
    'unknown_rate': '0.90', 'mixed_rate': '', 'mixed_effect_rate': '',
    'pair_rate': '0.85', 'pair_one_rate': '0.99',
    'confidently_wrong_rate': 'at most 0.02', 'calibration_error': 'at most 0.05',
    'shrink_within_005': '0.95', 'interval_coverage': '0.90 to 0.99', 'size_coverage': '',
    'small_wrong_rate': '', 'median_seconds': '', 'refused': ''}


class GapCheck(Result):
    """Figures of the diagnosis of blind cases, by the keys of `asi gap check --json`."""

    rows = 'wrong'

    def parts(self) -> Iterator[str | Table]:
        yield f'{self.cases} cases: ' + ', '.join(
            f'{count} {kind}' for kind, count in self.by_kind.items())
        yield table_of([{'figure': name, 'value': self[name], 'reach': reach}
                        for name, reach in REACH.items()],
                       {'figure': '{figure}', 'value': '{value:.3f}', 'target': '{reach}'})
        if self.wrong:
            yield table_of(self.wrong, {
                'bag': '{bag}', 'truth': '{truth}', 'verdict': '{verdict}',
                'probability': '{probability:.0%}'}, 'wrong verdicts')


def check(folder: Path, progress: Progress) -> GapCheck:
    """Diagnose every case of a directory, then open the answers; return the document."""
    rows = run_cases(folder, progress)
    answers = unseal(folder / 'answers.sealed')
    absent = [row['bag'] for row in rows if row['bag'] not in answers]
    if absent:
        raise InputError(f'{folder / "answers.sealed"} has no answer for {absent[0]}')
    result = score(rows, answers)
    write_text(folder / 'answers.json', json.dumps(answers, indent=1))
    draw(rows, answers, result, folder)
    return GapCheck({**result, 'directory': str(folder)})


def draw(rows: Sequence[Row], answers: Mapping[str, Mapping[str, Any]], result: Mapping[str, Any],
         out: Path) -> None:
    """Write confusion.png and reliability.png."""
    names = [*BLOCK_OF, 'parameter', NO_GAP, UNKNOWN]

    def short(name: str) -> str:
        return 'parameter' if name.startswith(PARAMETER) else name

    columns = [*names, 'refused']
    counts = np.zeros((len(names), len(columns)))
    for row in rows:
        truth = truth_of(answers[row['bag']])
        said = row['verdict'].split('+')[0] if '+' not in truth else None
        if said is not None:
            counts[names.index(short(truth)), columns.index(short(said))] += 1
    used = counts.sum(axis=1) > 0
    bars = result['reliability']
    figures.save(pictures.confusion([n for n, k in zip(names, used, strict=True) if k], columns,
                                    counts[used]), out / 'confusion.png')
    figures.save(pictures.reliability(
        [b['said'] for b in bars], [b['right'] for b in bars], [b['cases'] for b in bars]),
        out / 'reliability.png')
