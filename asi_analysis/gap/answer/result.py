"""The diagnosis as a result: sentences and tables, as printed and in the report, and pictures."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from asi_analysis.bags.run import Run
from asi_analysis.gap.diagnosis import Diagnosis
from asi_analysis.gap.model.effects import NO_GAP, UNKNOWN
from asi_analysis.gap.words import (
    between,
    chance,
    digits,
    in_words,
    percent,
    sentences,
    shrink_in_words,
    sizes_in_words,
    with_id,
)
from asi_analysis.reporting.result import Pictures, Result, Table
from asi_common.parameter import Value

LEAST_PROBABILITY: Final = 0.01   # of an effect that is listed
QUANTITIES: Final = {
    'onset_gain': ('gain at which the loop begins to oscillate', ''),
    'onset_frequency_hz': ('frequency of that oscillation', 'Hz'),
    'onset_amplitude_n': ('amplitude of that oscillation', 'N'),
    'rise_time_s': ('rise time', 's'), 'overshoot_percent': ('overshoot', '%'),
    'bandwidth_hz': ('bandwidth', 'Hz'), 'tracking_error_rms_n': ('tracking error, rms', 'N'),
    'oscillation_frequency_hz': ('frequency of a sustained oscillation', 'Hz'),
    'oscillation_amplitude_n': ('amplitude of a sustained oscillation', 'N')}


class Gap(Result):
    """
    Where, why and how far a model differs from recordings: `diagnose`.

    The keys are those of `asi gap --json`; `runs` are the recordings, `diagnosis` what was fitted,
    `model` the nominal parameters of actuator or joint, None of a characteristic.
    """

    title = 'The sim-to-real gap'
    rows = 'which'
    runs: list[Run]
    diagnosis: Diagnosis
    model: Mapping[str, Value] | None

    def parts(self) -> Iterator[str | Table]:
        if not self.reliable:
            yield 'The recordings are doubtful, and so is this answer: see the notes.'
        yield from sentences(self)
        yield from tables(self)
        if self.characteristic:
            from asi_analysis.gap.answer.characteristic import figures
            yield figures(self.characteristic)
        yield from (f'note: {note}' for note in self.notes)
        if self.report:
            yield f'report: {self.report}'
        if self.exports:
            from asi_analysis.gap.answer.export import in_words as exports_in_words
            yield from exports_in_words(self.exports)

    def pictures(self) -> Pictures:
        from asi_analysis.gap.answer.report import drawn
        return drawn(self.diagnosis, self)

    def write_report(self, out: Path) -> Path:
        """Write report.html, its pictures and, of actuator or joint, improved.yaml into `out`."""
        from asi_analysis.gap.answer.report import write_gap_report
        page = write_gap_report(self.diagnosis, self, out, self.model)
        self['report'] = str(page)
        return page

    def write_export(self, path: Path) -> Path:
        """
        Write what was found for a simulator: MJCF (.xml), URDF (.urdf) or parameters (.yaml).

        With the package mujoco the recordings are replayed with an MJCF. Raises InputError for
        another ending, or for what the format has no words for.
        """
        from asi_analysis.gap.answer.export import write_export
        self['exports'].append(write_export(self.diagnosis, self.model, path))
        return path


def tables(answer: Mapping[str, Any], chances: bool = True) -> Iterator[Table]:
    """
    Yield the explanations with their sizes, the errors, and the figures of the loop.

    chances: with the probabilities, which a picture shows too.
    """
    gap = answer['verdict'] != NO_GAP
    explanations = _explanations(answer, chances)
    if explanations.rows:
        yield explanations
    if len(answer['channels']) > 1:   # else the sentence says it
        yield _errors(answer, gap)
    if loop := [row for row in map(_of_the_loop, answer['consequences'])
                if any(cell != '-' for cell in (row[1:3] if gap else row[3:]))]:
        columns = ('quantity', 'nominal', 'improved (95 % interval)', 'measured')
        chosen = (0, 1, 2, 3) if gap else (0, 1, 3)
        yield Table([columns[n] for n in chosen], [[row[n] for n in chosen] for row in loop],
                    'in the closed loop', columns[1:])


def _explanations(answer: Mapping[str, Any], chances: bool) -> Table:
    plant, rows = answer['plant'], []
    known: list[str] = []   # sizes that effects of the verdict share are told once
    for row in answer['which']:
        if row['probability'] >= LEAST_PROBABILITY:
            rows.append((with_id(row['effect'], plant), chance(row['probability']),
                         in_words(row['block'], plant), sizes_in_words(row, known)))
            known += row['parameters'] if row['effect'] in answer['verdict'].split('+') else []
    if chances:
        rows += [(with_id(name, plant), chance(answer[f'{name}_probability']), '', '')
                 for name in (NO_GAP, UNKNOWN)]
    columns = ('explanation', 'probability', 'block', 'size (95 % interval)')
    chosen = (0, 1, 2, 3) if chances else (0, 2, 3)
    return Table([columns[n] for n in chosen], [[row[n] for n in chosen] for row in rows],
                 'possible explanations', columns[1:2])


def _errors(answer: Mapping[str, Any], gap: bool) -> Table:
    columns = ['signal', 'nominal', 'refitted', 'noise']
    if gap:
        columns[3:3] = ['improved']
        columns.append('shrink (95 % interval)')
    rows = []
    for row in answer['channels']:
        there = row['before_nrmse'] > row['noise_floor_nrmse']   # else there is nothing to shrink
        edge = row['edge_hz']
        cells = {'signal': row['signal'].replace('_', ' ') + (
                     ', from the motion' if row['channel'] == 'load' else '') + (
                     f', up to {digits(edge, "Hz")}' if edge else ''),
                 'nominal': percent(row['before_nrmse']),
                 'refitted': percent(row['refitted_nrmse']),
                 'improved': percent(row['after_nrmse']),
                 'noise': percent(row['noise_floor_nrmse']),
                 'shrink (95 % interval)': shrink_in_words(row) if there else '-'}
        rows.append([cells[name] for name in columns])
    return Table(columns, rows, 'error (rms) on the validation samples, as a share of the signal',
                 columns[1:])


def _of_the_loop(row: Mapping[str, Any]) -> list[str]:
    name, unit = QUANTITIES[row['quantity']]

    def shown(value: float | None) -> str:
        return '-' if value is None else digits(value, unit)

    improved = (shown(row['improved']) if row['improved_low'] is None else between(
        row['improved'], row['improved_low'], row['improved_high'], unit))
    return [name, shown(row['nominal']), improved, shown(row['measured'])]
