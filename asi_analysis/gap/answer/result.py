"""The diagnosis as a result: sentences and tables, pictures, the report."""

from collections.abc import Iterator, Mapping
from pathlib import Path

from asi_analysis.bags.run import Run
from asi_analysis.gap.diagnose import Diagnosis, sentences
from asi_analysis.gap.model.effects import NO_GAP
from asi_analysis.reporting.result import Pictures, Result, Table, table_of
from asi_common.parameter import Value


class Gap(Result):
    """
    Where, why and how far a model differs from recordings: `diagnose`.

    The keys are those of `asi gap --json`; `runs` are the recordings, `diagnosis` what was fitted,
    `model` the nominal parameters of the actuator, None of a joint.
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
        where = [row for row in self.where if row['share'] > 0.005]
        if where:
            yield table_of(where, {'block': '{block}', 'share': '{share:.0%}'}, 'where')
        if self.which:
            yield table_of([{**row, 'sizes': ', '.join(
                f'{name} {value:.4g} [{row["parameters_low"][name]:.4g}, '
                f'{row["parameters_high"][name]:.4g}]'
                for name, value in row['parameters'].items())} for row in self.which[:6]], {
                    'effect': '{effect}', 'block': '{block}', 'probability': '{probability:.1%}',
                    'parameters [95 % interval]': '{sizes}'}, 'which effect')
        shrink = {} if self.verdict == NO_GAP else {
            'shrink': '{shrink:.3f}', 'from': '{shrink_low:.3f}', 'to': '{shrink_high:.3f}'}
        yield table_of(self.channels, {
            'channel': '{channel}', 'nominal': '{before_nrmse:.2%}',
            'refitted': '{refitted_nrmse:.2%}', 'with the effect': '{after_nrmse:.2%}',
            'noise floor': '{noise_floor_nrmse:.2%}', **shrink},
            'error on the validation set (share of the signal)')
        loop = [row for row in self.consequences
                if (row['nominal'], row['improved'], row['measured']) != (None, None, None)]
        if loop:
            yield table_of(loop, {
                'quantity': '{quantity}', 'nominal': '{nominal:.4g}', 'improved': '{improved:.4g}',
                'from': '{improved_low:.4g}', 'to': '{improved_high:.4g}',
                'measured': '{measured:.4g}'}, 'in the loop (from, to: 95 % interval)')
        yield from (f'note: {note}' for note in self.notes)
        if self.report:
            yield f'report: {self.report}'

    def pictures(self) -> Pictures:
        from asi_analysis.gap.answer.report import drawn
        return drawn(self.diagnosis, self, self.runs[0], joint=self.model is None)

    def write_report(self, out: Path) -> Path:
        """Write report.html, its pictures and, of the actuator, improved.yaml into `out`."""
        from asi_analysis.gap.answer.report import write_gap_report
        page = write_gap_report(self.diagnosis, self, self.runs[0], out, self.model)
        self['report'] = str(page)
        return page
